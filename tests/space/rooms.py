"""A box room that can be computed exactly: the twin that geometry and memory are held against."""

from __future__ import annotations

import torch

from terrella.space.camera import FAR_M, NEAR_M, Intrinsics, planar_pose, rays, rotation, unproject
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


def cast_slowly(
    patch: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], chunk: int = 512
) -> torch.Tensor:
    """Depth [B, H, W] of `patch` [B, N, 9] from `pose` [B, 7], FAR_M where there is none: tries every patch at every pixel."""
    turn = rotation(pose)
    centre = torch.einsum("bji,bnj->bni", turn, patch[..., :3] - pose[:, None, :3])
    across, down = (torch.einsum("bji,bnj->bni", turn, patch[..., k : k + 3]) for k in (3, 6))
    normal = torch.cross(down, across, dim=-1)
    facing = (normal * centre).sum(-1) < 0
    valid = facing & (centre[..., 0] > NEAR_M)
    beam = rays(camera, size[0], size[1], patch.device).flatten(0, 1)
    nearest = torch.full((len(pose), len(beam)), FAR_M, device=patch.device)
    aa, ad, dd = ((p * q).sum(-1)[:, None] for p, q in ((across, across), (across, down), (down, down)))
    determinant = (aa * dd - ad * ad).clamp_min(1e-20)
    for first in range(0, patch.shape[1], chunk):
        some = slice(first, first + chunk)
        slope = torch.einsum("bni,pi->bpn", normal[:, some], beam)
        depth = (normal * centre).sum(-1)[:, None, some] / torch.where(slope.abs() < 1e-12, -1e-12, slope)
        offset = depth[..., None] * beam[None, :, None] - centre[:, None, some]
        oa, od = (offset * across[:, None, some]).sum(-1), (offset * down[:, None, some]).sum(-1)
        s = (oa * dd[..., some] - od * ad[..., some]) / determinant[..., some]
        t = (od * aa[..., some] - oa * ad[..., some]) / determinant[..., some]
        hit = valid[:, None, some] & (depth > NEAR_M) & (s.abs() <= 1) & (t.abs() <= 1)
        nearest = torch.minimum(nearest, torch.where(hit, depth, FAR_M).amin(-1))
    return nearest.view(-1, *size)
