"""A panorama as two layers of distance: overlapping views of it are lifted, brought into agreement where they overlap, and
blended on the sphere."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..camera import directions, rays
from ..raster import Gaussians, join
from .layers import HIDES, PictureLayers, layers_of, level_points, lowest_level, of_pixels
from .network import Lifter
from .scenes import rotation_of

FOCAL = 0.5  # of the views, in their sides: 90 degrees
PITCHES = (0.0, -0.6, 0.45)  # radians, the range of the lifter's training
HEADINGS = 6  # views at each pitch
ROUNDS = 40  # of the alignment
APART = 0.25  # a difference of logarithms of distance from which views see different surfaces
STIFF = 0.05  # resists a tilt of a view's logarithms, as a share of its weight
SHARP = 3.0  # power of the weights that blend


@dataclass(frozen=True)
class PanoramaLayers:
    """Two layers of an equirectangular picture of H x 2H pixels (the middle looks along x), `height_m` above the floor."""

    rgb: torch.Tensor  # [3, H, W] in 0..1
    distance: torch.Tensor  # [H, W] metres
    behind: torch.Tensor  # [H/2, W/2], distance of the hidden layer
    hides: torch.Tensor  # [H/2, W/2], the probability that it shows from near the camera
    behind_rgb: torch.Tensor  # [3, H/2, W/2]
    error: torch.Tensor  # [H, W], the expected error of the distance, as a share of it
    view: torch.Tensor  # [H, W], the view that weighs most, -1 where none sees
    height_m: float


def view_turns() -> list[torch.Tensor]:
    """Rotations [3, 3], camera to world, of the views."""
    return [
        torch.from_numpy(rotation_of(2 * math.pi * (k + 0.5 * (row % 2)) / HEADINGS, pitch, 0.0)).float()
        for row, pitch in enumerate(PITCHES)
        for k in range(HEADINGS)
    ]


def cut(rgb: torch.Tensor, turn: torch.Tensor, side: int) -> np.ndarray:
    """The view uint8 [side, side, 3] of a panorama [3, H, 2H] in 0..1 with a rotation `turn` [3, 3]."""
    ways = F.normalize(rays((FOCAL, FOCAL, 0.5, 0.5), side, side) @ turn.T, dim=-1)
    u = -torch.atan2(ways[..., 1], ways[..., 0]) / math.pi
    width = rgb.shape[2]
    around = torch.cat([rgb[..., -2:], rgb, rgb[..., :2]], 2)
    where = torch.stack([u * width / (width + 4), -2 * ways[..., 2].asin() / math.pi], -1)
    seen = F.grid_sample(around[None], where[None], mode="bilinear", padding_mode="border", align_corners=False)[0]
    return (255 * seen.permute(1, 2, 0)).round().to(torch.uint8).numpy()


@torch.inference_mode()
def panorama_layers(picture: np.ndarray, lifter: Lifter, height_m: float | None = None) -> PanoramaLayers:
    """The layers of a panorama uint8 [H, 2H, 3]. height_m: of the camera above the floor, if it is known."""
    rgb = torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255
    height, ways, turns = rgb.shape[1], directions(rgb.shape[1]), view_turns()
    views = [layers_of(cut(rgb, turn, height // 2), lifter, FOCAL) for turn in turns]
    grids = [_where(ways, turn) for turn in turns]
    logs = torch.stack([_sampled(one.depth, at) for one, at in zip(views, grids)])
    logs = (logs.clamp_min(1e-3) / torch.stack([(ways @ turn[:, 0]).clamp_min(0.05) for turn in turns])).log()
    errors = torch.stack([_sampled(one.error, at) for one, at in zip(views, grids)])
    weights = torch.stack([(1 - at.abs().amax(-1)).clamp_min(0) for at in grids]) / errors.clamp_min(0.03)
    logs = logs + offsets(logs, weights, torch.stack(grids))
    sharp = weights**SHARP
    total = sharp.sum(0)
    known, best = total > 0, weights.argmax(0)
    log = (sharp * logs).sum(0) / total.clamp_min(1e-12)
    distance = _poles(log.exp(), known, ways)
    half = best[::2, ::2]
    step, hides, *behind = (
        _chosen(torch.stack(parts), half)
        for parts in zip(*(_hidden(one, at[::2, ::2]) for one, at in zip(views, grids)))
    )
    error = errors.gather(0, best[None])[0]
    high = _height(distance, known, ways) or float(np.mean([one.height_m for one in views]))
    scale = 1.0 if height_m is None else height_m / high
    given = scale * distance, scale * distance[::2, ::2] * step.exp(), hides * known[::2, ::2], torch.stack(behind)
    return PanoramaLayers(rgb, *given, error, torch.where(known, best, -1), height_m or high)


def offsets(logs: torch.Tensor, weights: torch.Tensor, grids: torch.Tensor) -> torch.Tensor:
    """What to add to the logarithms of distance [K, H, W] of K views (weights [K, H, W], 0 where one does not see; grids [K, H, W,
    2], places in the views) so that they agree in the overlaps: for each view a constant and a tilt, by least squares, zero on the
    average of the views."""
    count, step = len(logs), (slice(None), slice(None, None, 4), slice(None, None, 4))
    log, weight, at = logs[step].flatten(1), weights[step].flatten(1), grids[step].flatten(1, 2)
    basis = torch.cat([torch.ones_like(at[..., :1]), at], 2)
    theta = torch.zeros(count, 3)
    stiff = STIFF * torch.diag(torch.tensor([0.0, 1.0, 1.0]))
    for _ in range(ROUNDS):
        now = log + (basis * theta[:, None]).sum(2)
        mean = (weight * now).sum(0) / weight.sum(0).clamp_min(1e-9)
        trust = weight * (-((now - mean) / APART).square()).exp()
        other = (trust * now).sum(0) - trust * now  # of the other views alone
        rest = (trust.sum(0) - trust).clamp_min(1e-9)
        both = trust * rest / (trust + rest)
        moments = torch.einsum("kni,knj,kn->kij", basis, basis, both)
        sums = torch.einsum("kni,kn->ki", basis, both * (other / rest - log))
        ridge = both.sum(1)[:, None, None] * stiff + 1e-6 * torch.eye(3)
        theta = 0.5 * theta + 0.5 * torch.linalg.solve(moments + ridge, sums)
        theta[:, 0] -= theta[:, 0].mean()
    return theta[:, :1, None] + grids[..., 0] * theta[:, 1, None, None] + grids[..., 1] * theta[:, 2, None, None]


def panorama_gaussians(layers: PanoramaLayers, two: bool = True) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians of a panorama, and which were seen: bool [N]. Near the poles some stand for several pixels."""
    parts = [_of_panorama(layers.distance, layers.rgb, torch.ones_like(layers.distance, dtype=torch.bool), layers)]
    if two:
        parts.append(_of_panorama(layers.behind, layers.behind_rgb, layers.hides > HIDES, layers))
    gaussians = join(parts)
    return gaussians, torch.arange(len(gaussians)) < len(parts[0])


def _of_panorama(distance: torch.Tensor, rgb: torch.Tensor, some: torch.Tensor, layers: PanoramaLayers) -> Gaussians:
    height, width = distance.shape
    ways = directions(height)
    narrow = ways[:, 0, :2].norm(dim=1).clamp_min(1 / width)
    every = 2 ** (-narrow.log2()).clamp_min(0).floor()
    kept = torch.arange(width) % every[:, None].long() == 0
    points = distance[..., None] * ways
    right = F.normalize(torch.linalg.cross(ways, torch.tensor([0.0, 0.0, 1.0]).expand_as(ways)), dim=-1)
    down = torch.linalg.cross(ways, right)
    size = distance * (math.pi / height)
    stretch = every[:, None, None]
    return of_pixels(points, distance, size, rgb, some & kept, (right, down), layers.height_m, stretch)


def wraps(picture: np.ndarray) -> bool:
    """Whether a picture uint8 [H, W, 3] of 2 to 1 looks like a panorama: its left and right edges meet, and its halves differ."""
    shown = picture.astype(np.float32)
    if abs(shown.shape[1] / shown.shape[0] - 2) > 0.01:
        return False
    meet = np.abs(shown[:, 0] - shown[:, -1]).mean()
    apart = np.abs(shown - np.roll(shown, shown.shape[1] // 2, 1)).mean()
    beside = np.abs(np.diff(shown, axis=1)).mean()
    return bool(meet < 3 * beside + 1 and meet < 0.5 * apart + 1)


def _where(ways: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    """Places [H, W, 2] in a view, -1 to 1 (right, down), of directions [H, W, 3]; 2 for those that it does not see."""
    local = ways @ turn
    at = -2 * FOCAL * local[..., 1:] / local[..., :1].clamp_min(0.05)
    return torch.where((local[..., :1] > 0.1) & (at.abs().amax(-1, keepdim=True) < 1), at, 2.0)


def _sampled(values: torch.Tensor, at: torch.Tensor, mode: str = "nearest") -> torch.Tensor:
    """Values [h, w] of a view at places [H, W, 2]."""
    return F.grid_sample(values[None, None], at[None], mode=mode, padding_mode="border", align_corners=False)[0, 0]


def _hidden(one: PictureLayers, at: torch.Tensor) -> list[torch.Tensor]:
    """The step to the hidden layer, its probability and its colours at places of a view."""
    step = (one.behind / one.depth[::2, ::2]).log()
    return [_sampled(part, at) for part in (step, one.hides, *one.behind_rgb)]


def _chosen(values: torch.Tensor, best: torch.Tensor) -> torch.Tensor:
    """Of values [K, h, w] those of the view `best` [h, w]."""
    return values.gather(0, best[None])[0]


def _poles(distance: torch.Tensor, known: torch.Tensor, ways: torch.Tensor) -> torch.Tensor:
    """Distances [H, W] with those at the poles, which no view sees: there floor and ceiling go on, level in the middle."""
    height, width = distance.shape
    distance, wide = distance.clone(), width // 12
    for rows in (range(height // 2, height), range(height // 2 - 1, -1, -1)):
        ring = max(k for k, row in enumerate(rows) if bool(known[row].all())) - height // 24
        level = (distance[rows[ring]] * ways[rows[ring], :, 2]).abs()
        around = torch.cat([level[-wide:], level, level[:wide]])
        smooth = F.avg_pool1d(around[None], 2 * wide + 1, 1)[0]
        for k in range(ring, len(rows)):
            share, flat = min((k - ring) / (height // 24), 1.0), (k - ring) / (len(rows) - ring)
            surface = ((1 - flat) * smooth + flat * level.median()) / ways[rows[k], :, 2].abs()
            distance[rows[k]] = (
                torch.where(known[rows[k]], (1 - share) * distance[rows[k]], 0)
                + torch.where(known[rows[k]], share, 1.0) * surface
            )
    return distance


def _height(distance: torch.Tensor, known: torch.Tensor, ways: torch.Tensor) -> float | None:
    """Height of the camera above the floor that fills enough of the panorama."""
    rows = known.all(1)
    return lowest_level(level_points((distance[..., None] * ways)[rows]), int(rows.sum()) * distance.shape[1])
