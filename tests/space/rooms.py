"""A box room that can be computed exactly: the twin that geometry and memory are held against."""

from __future__ import annotations

import torch

from terrella.space.camera import FAR_M, planar_pose, rays, rotation, unproject
from terrella.space.kernels_numba.surfaces import cast_one
from terrella.space.views import arrays, each_view

CAMERA = (0.5, 0.8, 0.5, 0.5)
SIZE = (48, 64)


def pose_at(x: float, y: float, heading: float) -> torch.Tensor:
    return planar_pose(*(torch.tensor([value]) for value in (x, y, 1.3, heading)))


def room_depth(pose: torch.Tensor, size=SIZE, half: float = 4.0, ceiling: float = 4.0) -> torch.Tensor:
    """Exact depth [B, H, W] inside a box room centred on the origin."""
    beam = rays(CAMERA, *size) @ rotation(pose)[:, None].mT
    origin = pose[:, None, None, :3]
    low, high = torch.tensor([-half, -half, 0.0]), torch.tensor([half, half, ceiling])
    to_wall = torch.where(beam > 0, (high - origin) / beam.clamp_min(1e-9), (low - origin) / beam.clamp_max(-1e-9))
    return to_wall.amin(-1)


def painted(pose: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Smooth colours of the surfaces seen, uint8 [B, 3, H, W]."""
    points = unproject(depth, pose, CAMERA)
    return (127 + 120 * torch.sin(1.3 * points)).round().to(torch.uint8).permute(0, 3, 1, 2)


def cast(patch: torch.Tensor, pose: torch.Tensor, camera, size) -> torch.Tensor:
    """Depth [B, H, W] that the views from `pose` [B, 7] see of `patch` [B, N, 9], by the kernel."""
    depth = torch.full((len(pose), *size), FAR_M)
    kernel = lambda patch, turn, at, depth: cast_one(patch, turn, at, camera, depth)  # noqa: E731
    each_view(kernel, arrays(patch, rotation(pose), pose, depth))
    return depth
