"""Patches: a parallelogram in the world for each pixel of posed depth images, rendered into a new view by ray casting.
So slanted and very near surfaces have exact depth without holes. On a CPU, kernels_numba/surfaces.py does both; the slow twins
also run on GPUs."""

import torch

from .camera import FAR_M, NEAR_M, Intrinsics, rays, rotation, unproject
from .kernels_numba.surfaces import lift
from .views import arrays, each_view

SLANT = 6.0  # patches longer than this many times those of a wall seen head-on are no surface


def patches(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int) -> torch.Tensor:
    """Depth [..., H, W] seen from `pose` [..., 7] -> patches [..., N, 9]: centre, half side across, half side down (metres, world
    frame).

    One patch per stride x stride block, N = (H // stride) * (W // stride). Sides overlap their neighbours' by half, and
    cross(down, across) points towards the camera. At a depth edge a patch covers only its own pixel; one that is too slanted to be
    distinguished from a bridge between two surfaces has size 0."""
    if depth.device.type != "cpu":
        return patches_slowly(depth, pose, camera, stride)
    height, width = depth.shape[-2:]
    images, turns, positions = arrays(
        depth.float().reshape(-1, height, width), rotation(pose).reshape(-1, 3, 3), pose[..., :3].reshape(-1, 3)
    )
    made = torch.empty(len(images), patch_count((height, width), stride), 9)
    each_view(lift, [images, turns, positions, made.numpy()], camera, stride, SLANT)
    return made.view(*depth.shape[:-2], patch_count((height, width), stride), 9)


def patch_count(size: tuple[int, int], stride: int) -> int:
    """Patches of a depth image of `size`."""
    return len(range(stride // 2, size[0], stride)) * len(range(stride // 2, size[1], stride))


def patches_slowly(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int) -> torch.Tensor:
    """The same as `patches`, in plain tensor algebra, also for GPUs."""
    points = unproject(depth, pose, camera)
    across, down = _shorter_difference(points, -2), _shorter_difference(points, -3)
    first = stride // 2
    reach = torch.where(_is_flat(depth, stride), 0.75 * stride, 0.5)[..., None]
    head_on = depth[..., None] / (camera[0] * depth.shape[-1])
    longest = torch.maximum(across.norm(dim=-1, keepdim=True), down.norm(dim=-1, keepdim=True))
    reach = torch.where(longest > SLANT * head_on, 0.0, reach)
    whole = torch.cat([points, reach * across, reach * down], -1)
    return whole[..., first::stride, first::stride, :].flatten(-3, -2)


def _shorter_difference(points: torch.Tensor, axis: int) -> torch.Tensor:
    """The shorter of the backward and the forward difference along `axis`, which stays on one surface."""
    step = points.diff(dim=axis)
    before = torch.cat([step.narrow(axis, 0, 1), step], axis)
    after = torch.cat([step, step.narrow(axis, step.shape[axis] - 1, 1)], axis)
    shorter = before.square().sum(-1, keepdim=True) < after.square().sum(-1, keepdim=True)
    return torch.where(shorter, before, after)


def _is_flat(depth: torch.Tensor, stride: int) -> torch.Tensor:
    """True where 1 / depth is a plane out to a patch's rim, as on any flat surface: [..., H, W]."""
    inverse = 1 / depth.clamp_min(NEAR_M)
    rim = max(1, round(0.75 * stride))
    images = inverse.reshape(-1, 1, *depth.shape[-2:])
    padded = torch.nn.functional.pad(images, (rim, rim, rim, rim), mode="replicate")
    bend = torch.zeros_like(images)
    height, width = depth.shape[-2:]
    for v, u in ((0, rim), (rim, 0), (rim, rim), (rim, -rim)):
        ahead = padded[..., rim + v : rim + v + height, rim + u : rim + u + width]
        behind = padded[..., rim - v : rim - v + height, rim - u : rim - u + width]
        bend = torch.maximum(bend, (ahead + behind - 2 * images).abs())
    return (bend < 0.05 * images).view(depth.shape)


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
