"""What moves: the last two frames brought into a view by their own depth, and what of a frame stands still.

A memory of places holds what stands still; monsters, shots and doors are known from the last frames alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..space.camera import Intrinsics, project, unproject
from ..space.patches import FAR_M
from ..space.reproject import fill_holes, splat_depth

SAME = 0.06  # depths that differ by less than this share are of one surface
PLANES = 6  # that `carry_frames` adds to the last frame's colour and trust


@dataclass(frozen=True)
class Frame:
    """B frames as they were seen: rgb uint8 [B, 3, H, W]; depth [B, H, W] metres; things [B, H, W] in 0..1, where something
    is that may move or vanish; pose [B, 7]; covered bool [B, H, W], where a card was painted (worlds/cast.py), which hides what
    is there."""

    rgb: torch.Tensor
    depth: torch.Tensor
    things: torch.Tensor
    pose: torch.Tensor
    covered: torch.Tensor | None = None


def covering(instances: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """The pixels bool [B, H, W] that cards cover: those of `instances` [B, H, W], and what of `things` [B, H, W] is around
    them, for a rim is theirs in part."""
    there = (instances > 0).float()
    return (there > 0) | ((F.max_pool2d(there[:, None], 3, 1, 1)[:, 0] > 0) & (things > 0.5))


def still(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] as a keyframe keeps it: 0, which says nothing, where `things` are."""
    return torch.where(things > 0.5, 0.0, depth)


def carry_frames(last: Frame, earlier: Frame, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """The last two frames as they would look from `pose` [B, 7], had nothing moved but the eye: [B, 4 + PLANES, H, W] =
    colour in [0, 1] and trust of the last; its depth in metres and its things; colour and trust of the one before."""
    colour, things, trust, depth = _carried(last, pose, camera)
    colour_2, _, trust_2, _ = _carried(earlier, pose, camera)
    return torch.cat([colour, trust, depth[:, None], things, colour_2, trust_2], 1)


def _carried(frame: Frame, pose: torch.Tensor, camera: Intrinsics):
    """Colour [B, 3, H, W] and things [B, 1, H, W] (0 where the frame did not see), trust [B, 1, H, W], depth [B, H, W].

    Pixels are moved whole: what is carried again at every step stays sharp.
    """
    height, width = frame.depth.shape[-2:]
    flat = _flattened(frame.depth, frame.things)
    points = unproject(flat, frame.pose, camera).flatten(1, 2)
    depth = splat_depth(points, pose, camera, (height, width))
    for fill in (_nearest_around, fill_holes):
        depth = torch.where(depth < FAR_M, depth, fill(depth))
    where, ahead = project(unproject(depth, pose, camera).flatten(1, 2), frame.pose, camera)
    grid, ahead = (where * 2 - 1).view(-1, height, width, 2), ahead.view(-1, height, width)
    hidden = torch.zeros_like(flat) if frame.covered is None else frame.covered.float()
    planes = torch.cat([frame.rgb.float() / 255, frame.things[:, None], flat[:, None], hidden[:, None]], 1)
    found = F.grid_sample(planes, grid, mode="nearest", padding_mode="border", align_corners=False)
    inside = (grid.abs().amax(-1) <= 1) & (ahead > 0.05) & (found[:, 5] < 0.5)
    error = (found[:, 4] - ahead).abs() / ahead.clamp_min(0.05)
    trust = torch.where(inside, (1.5 - error / SAME).clamp(0, 1), 0.0)[:, None]
    found = found * (trust > 0)
    return found[:, :3], found[:, 3:4], trust, depth


def _flattened(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] with that of things averaged over their surroundings: a figure whose pixels lie at depths of their own
    would fall to pieces."""
    there = (things > 0.5).float()
    summed = F.avg_pool2d(torch.stack([depth * there, there], 1), 9, 1, 4)
    return torch.where(there > 0, summed[:, 0] / summed[:, 1].clamp_min(1e-6), depth)


def _nearest_around(depth: torch.Tensor) -> torch.Tensor:
    """The least of each pixel's surroundings: closes the gaps of a surface that comes nearer."""
    return -F.max_pool2d(-depth[:, None], 3, 1, 1)[:, 0]
