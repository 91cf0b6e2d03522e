"""The floor plan that depth images draw: wall segments at eye height, and how far one may walk in each direction."""

from __future__ import annotations

import math

import numpy as np
import torch

from .camera import Intrinsics, unproject

JOIN = (
    1.92  # neighbours this many times farther apart than on a wall seen head-on are not one: a doorway, or too slanted
)


def wall_segments(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int = 2) -> torch.Tensor:
    """Depth [K, h, w] from level poses [K, 7] -> segments [K, n, 4] = x1, y1, x2, y2 in metres, world frame.

    They join the surfaces of neighbouring columns on the horizon; where they are far apart, the segment is a point.
    """
    row = min(int(camera[3] * depth.shape[-2]), depth.shape[-2] - 1)
    level = (camera[0], camera[1], camera[2], 0.5)  # the horizon's row alone is unprojected
    points = unproject(depth[..., row : row + 1, :].float(), pose, level)[..., 0, ::stride, :2]
    start, end = points[..., :-1, :], points[..., 1:, :]
    near = depth[..., row, ::stride].float()
    near = torch.minimum(near[..., :-1], near[..., 1:])
    spacing = stride / (camera[0] * depth.shape[-1])  # of neighbours on a wall seen head-on, at a depth of one
    joined = (end - start).norm(dim=-1, keepdim=True) < JOIN * spacing * near[..., None]
    return torch.cat([start, torch.where(joined, end, start)], -1)


def clearance(segments: torch.Tensor, places: torch.Tensor, directions: int = 32, reach_m: float = 2.0) -> torch.Tensor:
    """Distance in metres from each of `places` [N, 2] to the nearest of `segments` [S, 4] along evenly spaced world
    directions (the first along x, counter-clockwise): [N, directions], at most `reach_m`. Runs on the CPU."""
    from .kernels_numba import feel

    angle = np.arange(directions) * (2 * math.pi / directions)
    heading = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    free = np.full((len(places), directions), reach_m, np.float32)
    feel(segments.cpu().contiguous().numpy(), places.cpu().contiguous().numpy(), heading, free)
    return torch.from_numpy(free).to(places.device)
