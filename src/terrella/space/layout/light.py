"""Baked light: radiosity (Goral et al. 1984) on a light map of texels, with the light of lamps, windows, the sky and the sun, and
of bounces between texels; ambient occlusion where surfaces meet; and a film's response."""

import math

import numpy as np

from ..kernels_numba import light as kernels
from ..views import over_views
from .blocks import Blocks
from .daylight import Daylight
from .grids import AXES, Grid, bounds_of, grid

TEXEL_M, CONTACT_M = 0.1, 0.035  # texels of the light map, and of the ambient occlusion
RAYS, CONTACT_RAYS = 80, 12
LAMPS, SUNSPOTS = 48, 64  # points that approximate light sources, per room, and what the sun lights
BOUNCES = 4
SLIM_M = 0.05  # narrower sides emit no light
REACH_M, DARKEST = 0.3, 0.75  # of ambient occlusion
SUN_RADIUS = 0.012  # radians; a little wider than the sun, for a soft edge
_OPEN = ("glass", "sky")


class LitBoxes:
    """The boxes of a place as rays meet them."""

    def __init__(self, blocks: Blocks, daylight: Daylight):
        self.boxes, self.daylight = blocks.boxes, daylight
        solid = self.boxes.copy()
        solid[[look.material == "leaves" for look in blocks.looks]] = 1e6  # light passes through leaves
        self.solid, self.bounds = solid, bounds_of(solid, kernels.CHUNK)
        self.clear = np.array([look.material in _OPEN for look in blocks.looks])
        self.colours = np.array([look.colour for look in blocks.looks]) ** 2.2
        sky = np.where(self.clear[:, None], np.array(daylight.sky), daylight.lamps)
        self.glow = (
            np.array([look.glow for look in blocks.looks])[:, None]
            * sky
            * np.where(self.clear[:, None], 1.0, self.colours)
        )
        self.rays = self.solid, self.bounds

    def sun(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Sunlight through windows and open roofs at points [T, 3] with normals [T, 3]: [T, 3]."""
        lit = np.zeros(len(points))
        if self.daylight.sun is not None:
            heading, height = (math.radians(v) for v in self.daylight.sun)
            sun = np.array(
                [math.cos(heading) * math.cos(height), math.sin(heading) * math.cos(height), math.sin(height)]
            )
            given = (
                np.ascontiguousarray(points),
                np.ascontiguousarray(normals),
                sun,
                SUN_RADIUS,
                *self.rays,
                self.clear,
                lit,
            )
            over_views(len(points), lambda first, last: kernels.sunlit(first, last, *given))
        return lit[:, None] * np.array(self.daylight.sunlight)


def light_map(scene: LitBoxes, texels: Grid, bare: np.ndarray, rooms: int, seed: int) -> np.ndarray:
    """Irradiance of each texel without direct sunlight [T, 3]; texels that are not `bare` [T] have that of their neighbours."""
    rows = np.flatnonzero(bare)
    normals, blocks = texels.normals[rows], texels.blocks[rows]
    points = texels.points[rows] + 0.003 * normals
    axes = AXES[texels.sides[rows] // 2]
    narrow = (scene.boxes[blocks[:, None], axes + 3] - scene.boxes[blocks[:, None], axes]).min(1)
    glow = scene.glow[blocks] * (narrow > SLIM_M)[:, None]
    albedo = np.where(glow.sum(1, keepdims=True) > 0, 0.0, 0.88 * scene.colours[blocks])
    areas, rng = texels.areas[rows], np.random.default_rng(seed)
    sun = scene.sun(points, normals)
    direct = _shone(scene, points, normals, glow, areas, LAMPS * rooms, rng)
    direct += _shone(scene, points, normals, albedo * sun, areas, SUNSPOTS, rng)
    hits, sides = np.empty((len(rows), RAYS), np.int32), texels.sides[rows]
    given = points, sides, hemisphere(RAYS), *scene.rays, texels.starts, texels.counts, hits
    over_views(len(rows), lambda first, last: kernels.meet(first, last, *given))
    at = np.full(len(bare) + 1, len(rows), np.int32)
    at[rows] = np.arange(len(rows))
    hits = at[hits]  # the number among the bare, the last for none
    light, around, total = np.zeros((len(bare), 3)), np.empty((len(rows), 3)), direct
    for _ in range(BOUNCES):
        thrown = np.concatenate([albedo * total, np.zeros((1, 3))]).astype(np.float32)
        kernels.gather(hits, thrown, around)
        light[rows] = around
        kernels.smooth(texels.starts, texels.counts, bare, light, 3)
        total = direct + light[rows]
    light[rows] = total
    return _filled(texels, bare, light)


def _shone(scene: LitBoxes, points, normals, glow, areas, many: int, rng) -> np.ndarray:
    """The light that falls at points [T, 3] from `many` points sampled among those that send out `glow` [T, 3]."""
    light, weight = np.zeros((len(points), 3)), areas * glow.sum(1)
    if weight.sum() > 0:
        ends = np.cumsum(weight) / weight.sum()
        picked = np.minimum(np.searchsorted(ends, (np.arange(many) + rng.random(many)) / many), len(points) - 1)
        power = glow[picked] * (weight.sum() / many / glow[picked].sum(1))[:, None]
        given = points, normals, points[picked], power, normals[picked], *scene.rays, light
        over_views(len(points), lambda first, last: kernels.shine(first, last, *given))
    return light


def _filled(texels: Grid, bare: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Light [T, 3] of all texels: hidden ones have that of their neighbours, else that of their block or of the place."""
    known = bare.copy()
    kernels.carry(texels.starts, texels.counts, known, light)
    count = int(texels.blocks.max()) + 1
    total, many = np.zeros((count, 3)), np.bincount(texels.blocks[bare], minlength=count)
    np.add.at(total, texels.blocks[bare], light[bare])
    mean = np.where(many[:, None] > 0, total / np.maximum(many, 1)[:, None], light[bare].mean(0))
    light[~known] = mean[texels.blocks[~known]]
    return light


def contact(scene: LitBoxes, used: np.ndarray, spacing: float) -> tuple[Grid, np.ndarray]:
    """Texels on the sides `used` [6 K], and which part of the light from around reaches each [T, 1]."""
    texels = grid(scene.boxes, np.full(len(scene.boxes), spacing), used)
    closed = np.empty(len(texels.points))
    given = texels.points + 0.002 * texels.normals, texels.sides, hemisphere(CONTACT_RAYS), *scene.rays, REACH_M, closed
    over_views(len(closed), lambda first, last: kernels.shut(first, last, *given))
    values = np.repeat(1 - DARKEST * closed[:, None], 3, 1)
    kernels.smooth(texels.starts, texels.counts, np.ones(len(closed), np.bool_), values, 1)
    return texels, np.ascontiguousarray(values[:, :1])


def sampled(texels: Grid, values: np.ndarray, boxes: np.ndarray, points, normals, owners) -> np.ndarray:
    """Values [T, C] of texels at points [N, 3] with normals [N, 3] of blocks owners [N]: [N, C]."""
    out = np.empty((len(points), values.shape[1]))
    given = points, normals, owners, boxes, texels.starts, texels.counts, values, out
    over_views(len(points), lambda first, last: kernels.sample(first, last, *given))
    return out


def hemisphere(many: int) -> np.ndarray:
    """Cosine-weighted directions about z: [many, 3]."""
    at = (np.arange(many) + 0.5) / many
    turn = np.arange(many) * (math.pi * (3 - math.sqrt(5)))
    across = np.sqrt(at)
    return np.stack([across * np.cos(turn), across * np.sin(turn), np.sqrt(1 - at)], 1)


def filmed(own: np.ndarray, falls: np.ndarray, exposure: float) -> np.ndarray:
    """Colours [N, 3] in sRGB of surfaces of the colours `own` [N, 3] under the light `falls` [N, 3], as a film shows them (the
    curve of Narkowicz 2015)."""
    x = own**2.2 * falls * exposure
    x = 0.85 * x + 0.15 * x.mean(1, keepdims=True)  # bright colours turn pale
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1) ** (1 / 2.2)
