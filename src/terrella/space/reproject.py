"""Carries posed RGB-D keyframes into another view: depth by a z-buffered forward splat, then colour by bilinear sampling backward.
Keyframes that see another surface at a pixel are masked there."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do
from .camera import (
    FAR_M,
    NEAR_M,
    OUTSIDE,
    SAME,
    Intrinsics,
    cells_outside,
    grid_intrinsics,
    pixel_intrinsics,
    pixels_at,
    project,
    rotation,
    unproject,
)
from .kernels_numba.carried import carry, fetch, splat
from .kernels_numba.planes import fill
from .views import arrays, each_view

BEFORE_FAR_M = FAR_M * (1 - 1e-6)  # depths from FAR_M on are holes


def splat_inverse(
    points: torch.Tensor,
    pose: torch.Tensor,
    camera: Intrinsics,
    size: Sequence[int],
    turn: torch.Tensor | None = None,
) -> torch.Tensor:
    """World points [B, K, N, 3] -> 1 / depth of the nearest of each of K sets for each pixel of the view from `pose` [B, 7], whose
    rotations are `turn` [B, 3, 3]: [B, K, H, W], 0 in holes."""
    (batch, keys, count), (height, width) = points.shape[:3], size
    at, depth = project(points.flatten(1, 2), pose, pixel_intrinsics(camera, size), turn)
    pixel, inside = pixels_at(at, size)
    aside = constant(cells_outside, depth.device, keys * count, height * width + OUTSIDE)
    pixel = torch.where(inside & (depth.clamp(0.05, BEFORE_FAR_M) == depth), pixel, aside).view(-1, count)
    canvas = depth.new_zeros(batch * keys, height * width + OUTSIDE)
    canvas.scatter_reduce_(1, pixel, depth.reciprocal().view(-1, count), "amax")
    return canvas[:, :-OUTSIDE].view(batch, keys, height, width)


def least_around(plane: torch.Tensor) -> torch.Tensor:
    """The minimum over each pixel of [B, H, W] and its eight neighbours (much faster than max_pool2d)."""
    padded = F.pad(plane, (1, 1, 1, 1), value=torch.inf)
    lines = torch.minimum(torch.minimum(padded[:, :-2], padded[:, 2:]), padded[:, 1:-1])
    return torch.minimum(torch.minimum(lines[..., :-2], lines[..., 2:]), lines[..., 1:-1])


def fill_holes(depth: torch.Tensor, levels: int = 5) -> torch.Tensor:
    """Depth [B, H, W] with holes (FAR_M) filled by pull-push of 1/depth, after closing single-pixel gaps in near surfaces."""
    if not kernels_do(depth) or depth.dtype != torch.float32 or depth.requires_grad:
        return fill_holes_slowly(depth, levels)
    filled = torch.empty_like(depth, memory_format=torch.contiguous_format)
    each_view(fill, arrays(depth, least_around(depth), filled), FAR_M, levels)
    return filled


def fill_holes_slowly(depth: torch.Tensor, levels: int) -> torch.Tensor:
    """The same as `fill_holes`, in plain tensor algebra, also for GPUs and gradients."""
    return filled_inverse(depth.reciprocal() * (depth < FAR_M), levels).reciprocal()


def filled_inverse(inverse: torch.Tensor, levels: int = 5) -> torch.Tensor:
    """1 / depth [B, H, W] with holes (0) filled as `fill_holes` does, of at most FAR_M."""
    inverse = inverse[:, None]
    near = F.max_pool2d(inverse, 3, 1, 1)
    ratio = near / inverse.clamp_min(1 / FAR_M)
    count = F.avg_pool2d((ratio < 1.15).float(), 3, 1, 1)
    inverse = torch.where((ratio > 1.3) & (count > 0.55), near, inverse)
    seen = inverse > 0
    stack = [torch.cat([inverse * seen, seen], 1)]
    for _ in range(levels):
        stack.append(F.avg_pool2d(stack[-1], 2, ceil_mode=True))
    sums, weights = torch.cat([both.flatten(2) for both in stack], 2).split(1, 1)  # of all levels at once
    means, known = sums / weights.clamp_min(1e-6), weights > 1e-6
    sizes = [both.shape[-2:] for both in stack]
    means, known = (part.split([height * width for height, width in sizes], 2) for part in (means, known))
    filled = means[-1].unflatten(2, sizes[-1])
    for mean, valid, size in zip(means[-2::-1], known[-2::-1], sizes[-2::-1]):
        coarse = F.interpolate(filled, size=size, mode="bilinear", align_corners=False)
        filled = torch.where(valid.unflatten(2, size), mean.unflatten(2, size), coarse)
    return filled[:, 0].clamp_min(1 / FAR_M)


def warp(
    rgb: torch.Tensor,
    depth: torch.Tensor,
    pose: torch.Tensor,
    target_depth: torch.Tensor,
    target_pose: torch.Tensor,
    camera: Intrinsics,
    turn: torch.Tensor | None = None,
    target_turn: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Colour of K keyframes for every pixel of a target view.

    rgb [B, K, 3 (or any planes), H, W] in [0, 1]; depth [B, K, h, w]; pose [B, K, 7]; target_depth [B, H', W']; target_pose [B,
    7]; turn [B, K, 3, 3] and target_turn [B, 3, 3]: the rotations of the poses, where they are at hand. Returns colour
    [B, K, 3, H', W'], agreement [B, K, H', W'] (1 where the keyframe saw the same surface, 0 where not) and closeness [B, K, H',
    W']: the distance in the target over that in the keyframe."""
    turn = rotation(pose) if turn is None else turn
    target_turn = rotation(target_pose) if target_turn is None else target_turn
    places, agreement, near = sight(depth, pose, turn, target_depth, (target_pose, target_turn), camera)
    return colours_at(rgb, places), agreement, target_depth[:, None] / near


def sight(
    depth: torch.Tensor,
    pose: torch.Tensor,
    turn: torch.Tensor,
    target_depth: torch.Tensor,
    target: tuple[torch.Tensor, torch.Tensor],
    camera: Intrinsics,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where K keyframes see what the pixels of a target view show: places [B, K, H', W', 2] in their pictures, in [-1, 1], and
    agreement [B, K, H', W'], of arguments as in `warp`, with the target's pose and rotation; and how far ahead it lies of them."""
    keys = depth.shape[1]
    points = unproject(target_depth, target[0], camera, target[1])[:, None].expand(-1, keys, -1, -1, -1)
    places, ahead = places_in(points, pose, turn, camera)
    agreement, near = agreement_of(planes_at(depth[:, :, None], places)[:, :, 0], places, ahead)
    return places, agreement, near


def places_in(
    points: torch.Tensor, pose: torch.Tensor, turn: torch.Tensor, camera: Intrinsics
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where K pictures see points [B, K, H, W, 3], from `pose` [B, K, 7] with the rotations `turn`: places [B, K, H, W, 2] in
    [-1, 1], and how far ahead [B, K, H, W]."""
    places, ahead = project(points.flatten(2, 3), pose, grid_intrinsics(camera), turn)
    return places.view(*points.shape[:-1], 2), ahead.view(points.shape[:-1])


def planes_at(planes: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """The nearest pixels of planes [B, K, n, h, w] to `places` [B, K, H, W, 2] in [-1, 1]: [B, K, n, H, W]."""
    given = planes.flatten(0, 1), places.flatten(0, 1)
    held = F.grid_sample(*given, mode="nearest", padding_mode="border", align_corners=False)
    return held.unflatten(0, places.shape[:2])


def colours_at(rgb: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """The colours [B, K, 3, H', W'] of pictures [B, K, 3 (or any planes), H, W] at `places` [B, K, H', W', 2] in [-1, 1]."""
    colour = F.grid_sample(
        rgb.flatten(0, 1), places.flatten(0, 1), mode="bilinear", padding_mode="border", align_corners=False
    )
    return colour.view(*places.shape[:2], -1, *places.shape[2:4])


def agreement_of(held: torch.Tensor, places: torch.Tensor, ahead: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Whether depths `held` and `ahead` [...] are of the same surface, 0..1; 0 where `places` [..., 2] are not in the picture,
    [-1, 1]. And `ahead`, at least NEAR_M."""
    inside = (torch.linalg.vector_norm(places, torch.inf, dim=-1) <= 1) & (ahead > NEAR_M)
    near, most = ahead.clamp_min(NEAR_M), constant(torch.tensor, held.device, 1.5)
    return torch.addcdiv(most, (held - ahead).abs(), near, value=-1 / SAME).clamp(0, 1) * inside, near


def carry_unknown(
    rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, known: torch.Tensor,
    target_depth: torch.Tensor, target_pose: torch.Tensor, camera: Intrinsics,
) -> torch.Tensor:  # fmt: skip
    """One frame (rgb uint8 [B, 3, H, W], depth [B, h, w], pose [B, 7]) warped into the view with target_depth [B, H', W'] from
    target_pose [B, 7]: colour in [0, 1] and trust [B, 4, H', W'], 0 where `known` [B, H', W'] is 1."""
    if not _kernels_do(rgb, depth, pose, known, target_depth, target_pose):
        return carry_unknown_slowly(rgb, depth, pose, known, target_depth, target_pose, camera)
    carried = torch.zeros(len(rgb), 4, *target_depth.shape[-2:])
    given = rgb, depth, rotation(pose), pose, known, target_depth, rotation(target_pose), target_pose
    each_view(carry, arrays(*given, carried), camera)
    return carried


def carry_unknown_slowly(rgb, depth, pose, known, target_depth, target_pose, camera) -> torch.Tensor:
    """The same as `carry_unknown`, in plain tensor algebra, also for GPUs and gradients."""
    colour, agreement, _ = warp((rgb / 255)[:, None], depth[:, None], pose[:, None], target_depth, target_pose, camera)
    return unknown_alone(colour[:, 0], agreement, known)


def unknown_alone(colour: torch.Tensor, agreement: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Colour [B, 3, H, W] and trust, `agreement` [B, 1, H, W], where nothing is `known` [B, H, W], else 0: [B, 4, H, W]."""
    trust = agreement * (1 - known[:, None])
    return torch.cat([colour * (trust > 0), trust], 1)


def carry_things(
    rgb: torch.Tensor, depth: torch.Tensor, things: torch.Tensor, covered: torch.Tensor, pose: torch.Tensor,
    target_pose: torch.Tensor, camera: Intrinsics,
) -> torch.Tensor:  # fmt: skip
    """Frames (rgb uint8 [B, 3, H, W]; depth in metres, things in 0..1, covered bool [B, H, W]; pose [B, 7]) in the views from
    target_pose [B, 7] by their own depth: [B, 6, H, W] = colour, trust, depth, things; all but depth are 0 where unseen or
    `covered`. Pixels are copied, not interpolated, so that repeated carrying does not blur."""
    given = rgb, depth, things, covered, pose, target_pose
    if not _kernels_do(*given):
        return carry_things_slowly(*given, camera)
    source, target = (rotation(pose), pose), (rotation(target_pose), target_pose)
    flat, canvas = torch.empty(depth.shape), torch.full(depth.shape, FAR_M)
    each_view(splat, arrays(depth, things, *source, *target, flat, canvas), camera)
    seen = canvas
    for way in (least_around, fill_holes):  # the first closes gaps in surfaces that come nearer
        seen = torch.where(seen < FAR_M, seen, way(seen))
    carried = torch.zeros(len(rgb), 6, *depth.shape[1:])
    each_view(fetch, arrays(rgb, flat, things, covered, *source, seen, *target, carried), camera)
    return carried


def carry_things_slowly(rgb, depth, things, covered, pose, target_pose, camera) -> torch.Tensor:
    """The same as `carry_things`, in plain tensor algebra, also for GPUs and gradients."""
    frames = MovingFrames(*(part[:, None] for part in (rgb, depth, things, covered, pose)))
    turn, target = rotation(frames.pose), (target_pose, rotation(target_pose))
    planes, inverse = splat_frames(frames, turn, target, camera)
    seen = torch.where(inverse > 0, inverse, filled_inverse(inverse[:, 0])[:, None]).reciprocal()
    places, ahead = places_in(unproject(seen, target[0], camera, target[1]), frames.pose, turn, camera)
    carried = planes_at(planes, places)
    return carried_from(carried, agreement_of(carried[:, :, 4], places, ahead)[0], seen)[:, 0]


class MovingFrames(NamedTuple):
    """K frames of each view in which something may move, as `carry_things` takes them: [B, K, ...] each."""

    rgb: torch.Tensor
    depth: torch.Tensor
    things: torch.Tensor
    covered: torch.Tensor
    pose: torch.Tensor


def splat_frames(
    frames: MovingFrames, turn: torch.Tensor, target: tuple[torch.Tensor, torch.Tensor], camera: Intrinsics
) -> tuple[torch.Tensor, torch.Tensor]:
    """The planes [B, K, 6, H, W] of frames from which colours are taken, the fifth their depth with things made flat; and 1 / this
    depth [B, K, H, W] in the views from the pose and rotation `target`, 0 in holes. turn: the rotations of the frames."""
    rgb, depth, things, covered, pose = frames
    flat = _flattened(depth.flatten(0, 1), things.flatten(0, 1)).view_as(depth)
    points = unproject(flat, pose, camera, turn).flatten(2, 3)
    seen = splat_inverse(points, target[0], camera, depth.shape[-2:], target[1])
    seen = torch.where(seen > 0, seen, F.max_pool2d(seen, 3, 1, 1))  # closes gaps in surfaces that come nearer
    planes = torch.cat([rgb / 255, *(part[:, :, None] for part in (things, flat, covered))], 2)
    return planes, seen


def carried_from(carried: torch.Tensor, agreement: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Frames as `carry_things` gives them [B, K, 6, H, W]: from their planes in a view, their agreement with it and its depth."""
    trust = (agreement * (carried[:, :, 5] < 0.5))[:, :, None]
    carried = carried * (trust > 0)
    return torch.cat([carried[:, :, :3], trust, seen[:, :, None], carried[:, :, 3:4]], 2)


def _flattened(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] with that of things averaged over 9 x 9 pixels, so that a figure stays in one piece."""
    thing = things > 0.5
    summed = F.avg_pool2d(torch.stack([depth, torch.ones_like(depth)], 1) * thing[:, None], 9, 1, 4)
    return torch.where(thing, summed[:, 0] / summed[:, 1].clamp_min(1e-6), depth)


def _kernels_do(rgb: torch.Tensor, *others: torch.Tensor) -> bool:
    """Whether the compiled kernels can be used: on the CPU, uint8 colours, no gradients."""
    return kernels_do(rgb) and rgb.dtype == torch.uint8 and not any(part.requires_grad for part in others)
