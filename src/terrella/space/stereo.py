"""Depth of posed pictures by plane sweep (Collins 1996): the depth at which small windows of neighbouring, locally normalised
pictures agree best. Depths that no other picture confirms are left out."""

from dataclasses import replace

import torch
import torch.nn.functional as F

from .camera import FAR_M, project, rotation, unproject
from .fitting import PosedViews

DEPTHS, NEIGHBOURS, WINDOW = 64, 4, 5
LONGEST = 128  # pixels of the pictures that are compared
AGREE, SURE = 0.05, 0.5  # the largest relative difference of two depths; the smallest correlation of an accepted depth
_SMOOTH = 1e-4  # windows below this variance (of 1) are too plain to compare


def with_depth(views: PosedViews, points: torch.Tensor | None = None) -> PosedViews:
    """The same views with depth [T, h, w], FAR_M where unknown. `points` [N, 3]: known points of the scene."""
    shape = [max(round(side * min(LONGEST / max(views.size), 1)), 8) for side in views.size]
    grey = F.interpolate(views.rgb.float().mean(1, keepdim=True) / 255, shape, mode="area")
    known = _normal(grey)
    near, far = _range(views, points)
    levels = 1 / torch.linspace(1 / near, 1 / far, DEPTHS)
    others = _neighbours(views.pose, (near * far) ** 0.5)
    depths = torch.stack([_swept(known, views, row, others[row], levels) for row in range(len(views))])
    return replace(views, depth=_agreed(depths, views, others))


def _range(views: PosedViews, points: torch.Tensor | None) -> tuple[float, float]:
    """The nearest and the farthest depth to try: from the points, or else from the spread of the cameras."""
    pose = views.pose
    if points is not None and len(points) >= 16:
        some = points[:: max(len(points) // 2000, 1)]
        at, depth = project(some.expand(len(pose), -1, 3), pose, views.camera)
        seen = depth[((at - 0.5).abs() < 0.5).all(-1) & (depth > 0)]
        if len(seen) >= 16:
            near, far = torch.quantile(seen[:: max(len(seen) // 1_000_000, 1)], torch.tensor([0.01, 0.99])).tolist()
            return 0.6 * near, 1.6 * far
    spread = float((pose[:, :3] - pose[:, :3].median(0).values).norm(dim=1).quantile(0.9))
    return max(0.1 * spread, 0.02), max(6 * spread, 0.2)


def _neighbours(pose: torch.Tensor, depth: float) -> torch.Tensor:
    """The pictures to compare each with, [T, k]: those with a similar direction and a baseline of about a seventh of the depth."""
    apart = torch.cdist(pose[:, :3], pose[:, :3])
    ahead = rotation(pose)[..., 0]
    angle = (ahead @ ahead.T).clamp(-1, 1).acos()
    badness = (apart / (0.15 * depth)).clamp_min(1e-6).log().square() + (angle / 0.35).square()
    badness.fill_diagonal_(torch.inf)
    return badness.argsort(1)[:, : min(NEIGHBOURS, len(pose) - 1)]


def _swept(
    known: torch.Tensor, views: PosedViews, row: int, others: torch.Tensor, levels: torch.Tensor
) -> torch.Tensor:
    """Depth of one picture [h, w], 0 where no two neighbours agree well enough. known [T, 2, h, w]: see `_normal`."""
    shape, count = known.shape[-2:], len(levels)
    here, contrast = known[row].split(1)
    world = unproject(levels.view(-1, 1, 1).expand(count, *shape), views.pose[row].expand(count, 7), views.camera)
    scores = []
    for other in others:
        at, depth = _projected(world.view(-1, 3), views, int(other))
        inside = ((at.abs() < 1).all(-1) & (depth > 0)).view(count, *shape)
        shifted = F.grid_sample(known[other][None, :1], at.view(1, -1, shape[1], 2), align_corners=False)
        apart = (shifted.view(count, 1, *shape) - here).abs().clamp_max(2)
        scores.append(torch.where(inside, 1 - _pooled(apart)[:, 0], -1.0))
    best = (
        torch.stack(scores).sort(0, descending=True).values[:2].mean(0)
    )  # the surface may be hidden in some neighbours
    top, which = best.max(0)
    middle = which.clamp(1, count - 2)
    a, b, c = (best.gather(0, (middle + step)[None])[0] for step in (-1, 0, 1))
    shift = (0.5 * (a - c) / (a - 2 * b + c).clamp_max(-1e-6)).clamp(
        -0.5, 0.5
    )  # vertex of a parabola through the best three
    ends = 1 / levels[[0, -1]]
    depth = 1 / (ends[0] + (ends[1] - ends[0]) * (middle + shift) / (count - 1))
    return torch.where((top > SURE) & (contrast[0] > _SMOOTH) & (which == middle), depth, 0.0)


def _projected(world: torch.Tensor, views: PosedViews, other: int) -> tuple[torch.Tensor, torch.Tensor]:
    at, depth = project(world, views.pose[other], views.camera)
    return 2 * at - 1, depth


def _pooled(part: torch.Tensor) -> torch.Tensor:
    """Window means of [n, 1, h, w]."""
    for size in ((WINDOW, 1), (1, WINDOW)):
        part = F.avg_pool2d(part, size, 1, (size[0] // 2, size[1] // 2), count_include_pad=False)
    return part


def _normal(grey: torch.Tensor) -> torch.Tensor:
    """Pictures [T, 1, h, w] normalised by the mean and deviation of the window around each pixel, and variance: [T, 2, h, w]."""
    mean = _pooled(grey)
    variance = (_pooled(grey * grey) - mean * mean).clamp_min(0)
    return torch.cat([(grey - mean) / (variance + _SMOOTH).sqrt(), variance], 1)


def _agreed(depths: torch.Tensor, views: PosedViews, others: torch.Tensor) -> torch.Tensor:
    """The depths that those of another picture confirm, FAR_M for the rest."""
    kept = []
    for row, depth in enumerate(depths):
        world = unproject(depth, views.pose[row], views.camera).view(-1, 3)
        confirmed = torch.zeros(depth.numel(), dtype=torch.bool)
        for other in others[row]:
            at, far = _projected(world, views, int(other))
            seen = F.grid_sample(depths[other][None, None], at.view(1, 1, -1, 2), mode="nearest", align_corners=False)
            confirmed |= ((seen.flatten() / far - 1).abs() < AGREE) & (at.abs() < 1).all(-1)
        kept.append(torch.where(confirmed.view_as(depth) & (depth > 0), depth, FAR_M))
    return torch.stack(kept)
