"""Carrying what posed RGB-D keyframes saw into another view: a z-buffered splat of depth, then a warp of colour.

Depth is splatted forward (which surface does each pixel of the new view see?), and colour is then fetched backward by
bilinear sampling, so textures come over sharp and without holes. Keyframes that see another surface there are masked.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from .camera import Intrinsics, project, rotation, unproject
from .patches import FAR_M, SAME


def splat_depth(points: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int]) -> torch.Tensor:
    """World points [B, N, 3] -> nearest depth for each pixel of the view from `pose` [B, 7]: [B, H, W], FAR_M in holes."""
    height, width = size
    where, depth = project(points, pose, camera)
    column = (where[..., 0] * width).floor().long()
    row = (where[..., 1] * height).floor().long()
    seen = (depth > 0.05) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = torch.where(seen, row * width + column, height * width)  # the last cell collects what is out of view
    canvas = depth.new_full((len(points), height * width + 1), FAR_M)
    canvas.scatter_reduce_(1, pixel, torch.where(seen, depth, FAR_M), "amin")
    return canvas[:, :-1].view(-1, height, width)


def least_around(plane: torch.Tensor) -> torch.Tensor:
    """The least of each pixel of [B, H, W] and its eight neighbours (a max_pool2d takes many times as long)."""
    padded = F.pad(plane, (1, 1, 1, 1), value=torch.inf)
    lines = torch.minimum(torch.minimum(padded[:, :-2], padded[:, 2:]), padded[:, 1:-1])
    return torch.minimum(torch.minimum(lines[..., :-2], lines[..., 2:]), lines[..., 1:-1])


def fill_holes(depth: torch.Tensor, levels: int = 5) -> torch.Tensor:
    """Depth [B, H, W] with FAR_M in holes -> the same with holes filled from coarser averages (pull-push) of 1/depth.

    Single-pixel leaks (a far surface seen through the gaps of a near, sparsely splatted one) are closed first.
    """
    if depth.device.type != "cpu" or depth.dtype != torch.float32 or depth.requires_grad:
        return fill_holes_slowly(depth, levels)
    from .kernels_numba import fill as kernel

    filled = torch.empty_like(depth, memory_format=torch.contiguous_format)
    for holed, near, whole in zip(depth.contiguous().numpy(), least_around(depth).numpy(), filled.numpy()):
        kernel(holed, near, FAR_M, levels, whole)
    return filled


def fill_holes_slowly(depth: torch.Tensor, levels: int) -> torch.Tensor:
    """The same as `fill_holes`, in plain tensor algebra; the way on a GPU and for gradients."""
    near = least_around(depth)
    count = F.avg_pool2d((depth < near * 1.15)[:, None].float(), 3, 1, 1)[:, 0]
    depth = torch.where((depth > near * 1.3) & (count > 0.55), near, depth)
    inverse, weight = 1 / depth[:, None], (depth[:, None] < FAR_M).float()
    stack = []
    values, weights = inverse * weight, weight
    for _ in range(levels):
        if (weights > 1e-6).all():
            break  # nothing is left to fill from coarser averages
        stack.append((values, weights))
        values, weights = F.avg_pool2d(values, 2, ceil_mode=True), F.avg_pool2d(weights, 2, ceil_mode=True)
    filled = values / weights.clamp_min(1e-6)
    for values, weights in reversed(stack):
        coarse = F.interpolate(filled, size=values.shape[-2:], mode="bilinear", align_corners=False)
        filled = torch.where(weights > 1e-6, values / weights.clamp_min(1e-6), coarse)
    return 1 / filled[:, 0].clamp_min(1 / FAR_M)


def warp(
    rgb: torch.Tensor,
    depth: torch.Tensor,
    pose: torch.Tensor,
    target_depth: torch.Tensor,
    target_pose: torch.Tensor,
    camera: Intrinsics,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Colour of K keyframes fetched for every pixel of a target view.

    rgb [B, K, 3 (or any planes), H, W] in [0, 1]; depth [B, K, h, w]; pose [B, K, 7]; target_depth [B, H', W']; target_pose [B, 7].
    Returns colour [B, K, 3, H', W'], agreement [B, K, H', W'] (1 where the keyframe saw that very surface, 0 where it
    saw another or looked elsewhere), and closeness [B, K, H', W'] (distance in the target over distance in the
    keyframe: above 1 the keyframe was nearer and has more detail).
    """
    batch, keys = rgb.shape[:2]
    height, width = target_depth.shape[-2:]
    points = unproject(target_depth, target_pose, camera).flatten(1, 2)
    where, seen_depth = project(points[:, None].expand(-1, keys, -1, -1), pose, camera)
    grid = (where * 2 - 1).view(batch * keys, height, width, 2)
    seen_depth = seen_depth.view(batch, keys, height, width)
    colour = F.grid_sample(rgb.flatten(0, 1), grid, mode="bilinear", padding_mode="border", align_corners=False)
    held = F.grid_sample(depth.flatten(0, 1)[:, None], grid, mode="nearest", padding_mode="border", align_corners=False)
    held = held.view(batch, keys, height, width)
    inside = (grid.abs().amax(-1) <= 1).view(batch, keys, height, width) & (seen_depth > 0.05)
    error = (held - seen_depth).abs() / seen_depth.clamp_min(0.05)
    agreement = torch.where(inside, (1.5 - error / SAME).clamp(0, 1), 0.0)
    closeness = target_depth[:, None] / seen_depth.clamp_min(0.05)
    return colour.view(batch, keys, -1, height, width), agreement, closeness


def carry_unknown(
    rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, known: torch.Tensor,
    target_depth: torch.Tensor, target_pose: torch.Tensor, camera: Intrinsics,
) -> torch.Tensor:  # fmt: skip
    """One frame (rgb uint8 [B, 3, H, W], depth [B, h, w], pose [B, 7]) warped into the view that sees target_depth
    [B, H', W'] from target_pose [B, 7], where it does not know [B, H', W'] the surface: [B, 4, H', W'] of colour in [0, 1]
    and trust, 0 elsewhere."""
    if rgb.device.type != "cpu" or rgb.dtype != torch.uint8 or depth.requires_grad or target_depth.requires_grad:
        return carry_unknown_slowly(rgb, depth, pose, known, target_depth, target_pose, camera)
    from .kernels_numba import carry as kernel

    carried = torch.zeros(len(rgb), 4, *target_depth.shape[-2:])
    parts = rgb, depth, rotation(pose), pose[:, :3], known, target_depth, rotation(target_pose), target_pose[:, :3]
    ready = [part.detach().contiguous().numpy() for part in parts]
    for view, (colour, held, turn, eye, sure, seen, new_turn, new_eye) in enumerate(zip(*ready)):
        kernel(colour, held, turn, eye, sure, seen, new_turn, new_eye, camera, carried[view].numpy())
    return carried


def carry_unknown_slowly(rgb, depth, pose, known, target_depth, target_pose, camera) -> torch.Tensor:
    """The same as `carry_unknown`, in plain tensor algebra; the way on a GPU and for gradients."""
    colour, agreement, _ = warp(
        rgb.float().div(255)[:, None], depth[:, None], pose[:, None], target_depth, target_pose, camera
    )
    trust = agreement * (1 - known[:, None])
    return torch.cat([colour[:, 0] * (trust > 0), trust], 1)
