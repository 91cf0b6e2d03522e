"""Blocks as flat Gaussians with light baked in: a fine picture of every visible side, cut into cells."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..camera import planar_pose
from ..edits import REVEALED
from ..kernels_numba import light as kernels
from ..raster import Gaussians
from ..raster.gaussians import join
from ..views import over_views
from .blocks import Blocks, blocks_of
from .cells import cells_of, gaussians_of
from .daylight import daylight_of
from .extras import flame, foliage, leaves_in, outside
from .grids import AXES, Grid, grid
from .light import CONTACT_M, TEXEL_M, LitBoxes, contact, filmed, light_map, sampled
from .room_layout import RoomLayout
from .shapes import bend, numbers
from .styles import style_of
from .textures import texture_colours

OPACITY = REVEALED
PER_CELL = 11  # texels of the fine picture for each Gaussian
THINGS_M, FINEST_M = 0.65, 0.004  # spacing on things relative to the building; the finest
HIDDEN = 0.4  # contrast of what lies beneath things
BEYOND_M = (0.01, 0.07)  # metres past an edge at which there may be air
_SURE = 0.004  # metres in front of a surface that must be free


@dataclass(frozen=True)
class BuiltPlace:
    """A place built from a layout."""

    gaussians: Gaussians
    objects: (
        torch.Tensor
    )  # int32 [N], the object of each Gaussian (0: the building; -k: the building beneath the object k)
    names: tuple[str, ...]  # of objects 1, 2, ...
    solids: torch.Tensor  # float32 [S, 6], boxes that stop walkers
    bodies: torch.Tensor  # int32 [S], the movable object of each box (0: none)
    starts: torch.Tensor  # float32 [R, 7], a pose in each room, at the height of its floor


def build(plan: RoomLayout, count: int = 120_000, report: Callable[[str], None] = lambda text: None) -> BuiltPlace:
    """Builds a layout with about `count` Gaussians. The same layout gives the same place. ContractError if parts do not fit.
    `report` gets what is being done, in words."""
    blocks = blocks_of(plan)
    boxes, bodies, objects = blocks.boxes, blocks.bodies, np.asarray(blocks.objects, np.int32)
    daylight = daylight_of(plan.time)
    scene = LitBoxes(blocks, daylight if plan.sun is None else replace(daylight, sun=plan.sun))
    shapes = numbers(blocks.shapes)
    texels = grid(boxes, np.full(len(boxes), _coarse(plan, TEXEL_M)))
    kinds = _kinds(texels, blocks, bodies)
    bare = kinds == 1
    report("light from lamps, windows and walls")
    light = light_map(scene, texels, bare, len(plan.rooms), plan.seed)
    used = np.zeros(6 * len(boxes), np.bool_)
    used[texels.faces[kinds > 0]] = True
    drawn = np.array([look.material != "glass" and shape.drawn for look, shape in zip(blocks.looks, blocks.shapes)])
    used &= np.repeat(drawn, 6)
    report("shadows where surfaces meet")
    close = contact(scene, used, _coarse(plan, CONTACT_M))
    fine = _fine(boxes, objects, texels, kinds, used, count)
    kinds = _kinds(fine, blocks, bodies)
    report("textures and sunlight")
    picture, exposure = _picture(plan, blocks, scene, shapes, fine, kinds, (texels, light), close)
    edges = _edges(fine, kinds, _opaque(blocks), shapes)
    report("Gaussians on all surfaces")
    cells = cells_of(fine, picture, kinds, edges, (_weights(blocks, objects), _round(boxes, shapes)), count)
    owner = objects[cells.faces // 6]
    owner = np.where(cells.kinds > 1, 1 - cells.kinds, owner).astype(np.int32)
    parts = [(gaussians_of(cells, boxes, shapes, OPACITY * (owner >= 0)), owner)]
    parts += _extras(plan, blocks, scene, (texels, light), exposure)
    return BuiltPlace(
        join([part for part, _ in parts]),
        torch.from_numpy(np.concatenate([whose for _, whose in parts])),
        tuple(blocks.names),
        torch.from_numpy(blocks.solids),
        torch.from_numpy(bodies[np.asarray(blocks.solid)]),
        _starts(plan, blocks),
    )


def _coarse(plan: RoomLayout, spacing: float) -> float:
    """The spacing of texels: wider in places above 60 square metres of floor."""
    floor = sum(room.size[0] * room.size[1] for room in plan.rooms)
    return spacing * max(math.sqrt(floor / 60), 1.0)


def _kinds(cells: Grid, blocks: Blocks, bodies: np.ndarray) -> np.ndarray:
    """Of cells: 0 never visible, 1 visible, 1 + k beneath the fixed object k: int32 [N]."""
    objects = np.asarray(blocks.objects, np.int32)
    air = np.array([[*low, *high] for low, high in blocks.air])
    fixed = bodies == 0
    for number in set(objects[bodies > 0]):
        fixed[objects == number] = False
    kind, fronts = np.empty(len(cells.points), np.int32), cells.points + _SURE * cells.normals
    given = fronts, cells.blocks, _opaque(blocks), objects, fixed, air, kind
    over_views(len(kind), lambda first, last: kernels.kinds(first, last, *given))
    return kind


def _opaque(blocks: Blocks) -> np.ndarray:
    """The boxes [K, 6] that hide what lies in them; leaves and flames lie far away."""
    boxes = blocks.boxes
    boxes[[not shape.drawn for shape in blocks.shapes]] = 1e6
    return boxes


def _extras(plan, blocks: Blocks, scene: LitBoxes, lit: tuple[Grid, np.ndarray], exposure: float):
    """Leaves, flames and views from windows, each with its objects."""
    parts, boxes = [], scene.boxes
    for k, shape in enumerate(blocks.shapes):
        low, high = boxes[k, :3], boxes[k, 3:]
        if shape.drawn:
            continue
        if blocks.looks[k].material == "flame":
            part = flame(low, high)
        else:
            leaves = leaves_in(low, high, plan.seed + k)
            places, turns, _ = leaves
            normals = turns[:, :, 2] * np.where(turns[:, 2:, 2] < 0, -1.0, 1.0)
            falls = sampled(*lit, boxes, places, normals, np.full(len(places), k))
            tone = np.random.default_rng(plan.seed + k).uniform(0.65, 1.3, (len(places), 1))
            part = foliage(leaves, filmed(np.clip(np.array(blocks.looks[k].colour) * tone, 0, 1), falls, exposure))
        parts.append((part, np.full(len(part), blocks.objects[k], np.int32)))
    for number, part in enumerate(outside(plan, style_of(plan.style).outside, scene.daylight), len(plan.doors) + 1):
        parts.append((part, np.full(len(part), number, np.int32)))
    return parts


def _fine(boxes, objects, texels: Grid, kinds: np.ndarray, used: np.ndarray, count: int) -> Grid:
    """The grid of the picture, finer on things."""
    share = np.where(objects > 0, THINGS_M, 1.0)
    area = (texels.areas / share[texels.blocks] ** 2 * (kinds > 0)).sum()
    spacing = math.sqrt(area / (PER_CELL * count)) * share
    return grid(boxes, np.maximum(spacing, FINEST_M), used)


def _picture(plan, blocks, scene, shapes, fine, kinds, lit, close) -> tuple[np.ndarray, float]:
    """Colours [M, 3] of the cells of a fine grid as a camera shows them, and its exposure."""
    own = _own(plan, blocks, scene.boxes, fine)
    points, normals = fine.points.copy(), fine.normals
    bent = np.flatnonzero((shapes > 0)[:, [0, 1, 4]].any(1)[fine.blocks])
    points[bent], normals[bent] = bend(
        points[bent], fine.sides[bent], scene.boxes[fine.blocks[bent]], shapes[fine.blocks[bent]]
    )
    (texels, light), (near, open_) = lit, close
    falls = sampled(texels, light, scene.boxes, points, normals, fine.blocks)
    falls *= sampled(near, open_, scene.boxes, points, normals, fine.blocks)
    rows = np.flatnonzero(kinds == 1)
    sun = np.zeros((len(points), 3))
    sun[rows] = scene.sun(points[rows] + 0.003 * normals[rows], normals[rows])
    kernels.smooth(fine.starts, fine.counts, kinds == 1, sun, 2)
    falls += sun
    glows = scene.glow.sum(1)[fine.blocks] > 0
    seen = (kinds == 1) & ~glows
    weight = fine.areas[seen]
    middle = (
        math.exp((np.log(np.maximum(falls[seen].mean(1), 1e-4)) * weight).sum() / weight.sum()) if seen.any() else 1.0
    )
    exposure = scene.daylight.exposure / middle
    shown = filmed(own, falls, exposure)
    shown[glows] = own[glows]
    hidden = kinds > 1
    if hidden.any():
        faces = fine.faces
        many = np.maximum(np.bincount(faces[hidden], minlength=len(fine.starts)), 1)
        mean = (
            np.stack([np.bincount(faces[hidden], shown[hidden, c], len(fine.starts)) for c in range(3)], 1)
            / many[:, None]
        )
        shown[hidden] = mean[faces[hidden]] + HIDDEN * (shown[hidden] - mean[faces[hidden]])
    return shown, exposure


def _own(plan: RoomLayout, blocks: Blocks, boxes: np.ndarray, fine: Grid) -> np.ndarray:
    """The colours of the materials [M, 3]."""
    own = np.empty((len(fine.points), 3))
    for face in np.flatnonzero(fine.counts[:, 0] > 0):
        k, axis = face // 6, face % 6 // 2
        rows = slice(fine.starts[face], fine.starts[face] + fine.counts[face].prod())
        a, b = AXES[axis]
        thing, look = blocks.objects[k], blocks.looks[k]
        base = boxes[k, :3] if thing else np.zeros(3)
        u, v = fine.points[rows, a] - base[a], fine.points[rows, b] - base[b]
        size = boxes[k, 3 + np.array([a, b])] - boxes[k, [a, b]]
        along = size[1] > size[0] if thing or axis == 2 else False
        if along and look.material not in (
            "books",
            "art",
            "paper",
            "tiles",
            "brick",
            "subway",
        ):  # planks and fibres run along
            u, v, size = v, u, size[::-1]
        seed = int(plan.seed + 31 * axis + (97 * k if thing else 0))
        step = float(fine.steps[face].max())
        own[rows] = texture_colours(look.material, look.colour, (u, v), (size[0], size[1]), step, seed)
    return own


def _edges(fine: Grid, kinds: np.ndarray, boxes: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Where cells lie at the end of a side, or of what is visible of it, with air beyond it, at once or after something thin:
    uint8 [M], bits 1, 2, 4, 8 for the low and high row and column."""
    edges = np.zeros(len(kinds), np.uint8)
    numbers_of_all, across = np.arange(len(kinds)), fine.counts[fine.faces, 1]
    rows = numbers_of_all - fine.starts[fine.faces]
    place = np.stack([rows // across, rows % across], 1)
    for axis in (0, 1):
        along = AXES[fine.sides // 2, axis]
        for high in (0, 1):
            last = place[:, axis] == high * (fine.counts[fine.faces, axis] - 1)
            beside = numbers_of_all + (2 * high - 1) * (across if axis == 0 else 1)
            hidden = kinds[np.where(last, 0, beside)] == 0  # within another box, such as a board
            ends = np.flatnonzero((last | hidden) & (kinds == 1))
            kind = shapes[fine.blocks[ends]]
            ends = ends[
                (kind[:, 4] == 0) & ((kind[:, 1] == 0) | (fine.sides[ends] > 3) | (along[ends] == 2))
            ]  # others are round
            for off in BEYOND_M:
                beyond = fine.points[ends] - _SURE * fine.normals[ends]
                step = fine.steps[fine.faces[ends], axis] / 2
                beyond[np.arange(len(ends)), along[ends]] += (2 * high - 1) * (step + off)
                inside = np.empty(len(ends), np.bool_)
                kernels.in_any(0, len(ends), beyond, boxes, 0.0, inside)
                edges[ends[~inside]] |= 1 << (2 * axis + high)
    return edges


def _round(boxes: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """The longest cell on each block that is so round that longer ones would stand out from it [K], metres."""
    half = (boxes[:, 3:] - boxes[:, :3]) / 2
    tube = np.where(shapes[:, 1] > 0, 0.5 * half[:, :2].min(1), np.inf)
    return np.maximum(np.minimum(tube, np.where(shapes[:, 4] > 0, 0.45 * half.min(1), np.inf)), 0.012)


def _weights(blocks: Blocks, objects: np.ndarray) -> np.ndarray:
    """How much an error matters on each side [6 K]: things more, ceilings less."""
    weights = np.repeat(np.where(objects > 0, 2.0, 1.0), 6).reshape(-1, 6)
    weights[objects == 0, 4] *= 0.4
    return weights.ravel()


def _starts(plan: RoomLayout, blocks: Blocks) -> torch.Tensor:
    """The starts: that of the layout, or in each room the free place with the longest view along its longer side."""
    if plan.start is not None:
        x, y, degrees = plan.start
        room = next(r for r in plan.rooms if all(r.low[k] <= plan.start[k] <= r.high[k] for k in range(2)))
        return planar_pose(*(torch.tensor([v]) for v in (x, y, room.at[2], math.radians(degrees))))
    solids, poses = blocks.solids, []
    for room in plan.rooms:
        low, high = np.array(room.low), np.array(room.high)
        x, y = np.meshgrid(*(np.linspace(low[k] + 0.35, max(high[k] - 0.35, low[k] + 0.36), 40) for k in range(2)))
        places = np.stack([x.ravel(), y.ravel()], 1)
        off = np.maximum(np.maximum(solids[None, :, :2] - places[:, None], places[:, None] - solids[None, :, 3:5]), 0)
        meets = (solids[:, 2] < low[2] + 1.8) & (solids[:, 5] > low[2] + 0.05)
        room_there = np.where(meets, np.hypot(off[..., 0], off[..., 1]), 9.0).min(1)
        middle = (low + high)[:2] / 2
        long = int(high[1] - low[1] > high[0] - low[0])
        fits = np.minimum(room_there, 0.6) * 4 - np.abs(places[:, 1 - long] - middle[1 - long] - 0.4)
        best = places[np.argmax(fits - 1.0 * (places[:, long] - low[long]))]
        heading = math.atan2(middle[1] - best[1], middle[0] - best[0])
        poses.append(planar_pose(*(torch.tensor([float(v)]) for v in (*best, low[2], heading))))
    return torch.cat(poses)
