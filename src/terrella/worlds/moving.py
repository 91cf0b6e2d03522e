"""What moves: the last two frames brought into a view by their own depth, and what of a frame stands still.

A memory of places holds what stands still; monsters, shots and doors are known from the last frames alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ..space.camera import Intrinsics, project, rotation, unproject
from ..space.patches import FAR_M, SAME
from ..space.reproject import fill_holes, least_around, splat_depth

PLANES = 6  # that `carry_frames` adds to the last frame's colour and trust


class Frame(NamedTuple):
    """B frames as they were seen: rgb uint8 [B, 3, H, W]; depth [B, H, W] metres; things [B, H, W] in 0..1, where something
    is that may move or vanish; pose [B, 7]; covered bool [B, H, W], where a card was painted (worlds/cast.py), which hides what
    is there."""

    rgb: torch.Tensor
    depth: torch.Tensor
    things: torch.Tensor
    pose: torch.Tensor
    covered: torch.Tensor


def covering(instances: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """The pixels bool [B, H, W] that cards cover: those of `instances` [B, H, W], and what of `things` [B, H, W] is around
    them, for a rim is theirs in part."""
    bare = (instances == 0).float()
    return (bare == 0) | ((least_around(bare) == 0) & (things > 0.5))


def still(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] as a keyframe keeps it: 0, which says nothing, where `things` are."""
    return torch.where(things > 0.5, 0.0, depth)


def carry_frames(last: Frame, earlier: Frame, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """The last two frames as they would look from `pose` [B, 7], had nothing moved but the eye: [B, 4 + PLANES, H, W] =
    colour in [0, 1] and trust of the last; its depth in metres and its things; colour and trust of the one before."""
    both = Frame(*map(torch.cat, zip(last, earlier)))
    now, before = _carried(both, torch.cat([pose, pose]), camera).chunk(2)
    return torch.cat([now, before[:, :4]], 1)


def _carried(frame: Frame, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """[B, 6, H, W] = colour, trust, depth in metres and things; all but the depth are 0 where the frame did not see.

    Pixels are moved whole: what is carried again at every step stays sharp.
    """
    learns = any(part.requires_grad for part in (*frame, pose))
    if frame.depth.device.type != "cpu" or frame.rgb.dtype != torch.uint8 or learns:
        return carried_slowly(frame, pose, camera)
    from ..space.kernels_numba import fetch, splat

    rgb, depth, things, covered = _arrays(frame.rgb, frame.depth, frame.things, frame.covered)
    turn, estimator, new_turn, new_eye = _arrays(rotation(frame.pose), frame.pose[:, :3], rotation(pose), pose[:, :3])
    flat, canvas = np.empty_like(depth), np.full_like(depth, FAR_M)
    for n in range(len(depth)):
        splat(depth[n], things[n], turn[n], estimator[n], new_turn[n], new_eye[n], camera, flat[n], canvas[n])
    (seen,) = _arrays(_filled(torch.from_numpy(canvas)))
    found = np.zeros((len(depth), 6, *depth.shape[1:]), np.float32)
    for n in range(len(depth)):
        shown = rgb[n], flat[n], things[n], covered[n], turn[n], estimator[n]
        fetch(*shown, seen[n], new_turn[n], new_eye[n], camera, found[n])
    return torch.from_numpy(found)


def _arrays(*parts: torch.Tensor) -> list[np.ndarray]:
    return [part.detach().contiguous().numpy() for part in parts]


def carried_slowly(frame: Frame, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """The same as `_carried`, in plain tensor algebra; the way on a GPU and for gradients."""
    height, width = frame.depth.shape[-2:]
    flat = _flattened(frame.depth, frame.things)
    points = unproject(flat, frame.pose, camera).flatten(1, 2)
    depth = _filled(splat_depth(points, pose, camera, (height, width)))
    where, ahead = project(unproject(depth, pose, camera).flatten(1, 2), frame.pose, camera)
    grid, ahead = (where * 2 - 1).view(-1, height, width, 2), ahead.view(-1, height, width)
    others = torch.stack([frame.things, flat, frame.covered.float()], 1)
    planes = torch.cat([frame.rgb.float() / 255, others], 1)
    found = F.grid_sample(planes, grid, mode="nearest", padding_mode="border", align_corners=False)
    inside = (grid.abs().amax(-1) <= 1) & (ahead > 0.05) & (found[:, 5] < 0.5)
    error = (found[:, 4] - ahead).abs() / ahead.clamp_min(0.05)
    trust = torch.where(inside, (1.5 - error / SAME).clamp(0, 1), 0.0)[:, None]
    found = found * (trust > 0)
    return torch.cat([found[:, :3], trust, depth[:, None], found[:, 3:4]], 1)


def _filled(depth: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] with FAR_M in holes -> the same without."""
    for fill in (least_around, fill_holes):  # the first closes the gaps of a surface that comes nearer
        depth = torch.where(depth < FAR_M, depth, fill(depth))
    return depth


def _flattened(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] with that of things averaged over their surroundings: a figure whose pixels lie at depths of their own
    would fall to pieces."""
    there = (things > 0.5).float()
    summed = F.avg_pool2d(torch.stack([depth * there, there], 1), 9, 1, 4)
    return torch.where(there > 0, summed[:, 0] / summed[:, 1].clamp_min(1e-6), depth)
