"""Posed RGB-D keyframes as spatial memory: what is known of a new view, and from which keyframes.

`look` asks the memory for a view: the keyframes' coarse patches say roughly which surfaces the view sees; each keyframe
then votes for the surfaces that it saw itself (occlusion included), and those that add most are taken greedily; their
fine patches give the view's depth, and their colours are warped into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from .camera import Intrinsics, project, rays, rotation
from .floorplan import wall_segments
from .patches import FAR_M, SAME, cast_all, patches
from .reproject import fill_holes, warp

COARSE, FINE = 8, 2  # strides of the patches for finding keyframes and for the view's depth
_GRID = 4  # a keyframe votes on every 4th pixel of a half-size view
ANYWAY = 0.02  # of its strongest vote counts for a keyframe, so that more than nothing is picked where all is covered
_FRUSTUM = (4, 6, 8)  # without depth, on points at this many distances, in this many rows and columns


@dataclass(frozen=True)
class Keyframes:
    """K keyframes: rgb uint8 [K, 3, H, W], depth float32 [K, h, w] metres, pose [K, 7], its rotation `turn` [K, 3, 3],
    patches [K, n, 9] (the fine ones, n = 0 where they are yet to be made) and the walls that it saw [K, n, 4]
    (floorplan.py)."""

    rgb: torch.Tensor
    depth: torch.Tensor
    pose: torch.Tensor
    turn: torch.Tensor
    coarse: torch.Tensor
    fine: torch.Tensor
    walls: torch.Tensor

    @staticmethod
    def of(
        rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, fine: bool = True
    ) -> Keyframes:
        depth = depth.float()
        coarse, walls = patches(depth, pose, camera, COARSE), wall_segments(depth, pose, camera)
        made = patches(depth, pose, camera, FINE) if fine else depth.new_zeros(len(depth), 0, 9)
        return Keyframes(rgb, depth, pose, rotation(pose), coarse, made, walls)

    @staticmethod
    def joined(parts: Sequence[Keyframes]) -> Keyframes:
        """Keyframes with pictures of one size, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return Keyframes(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Keyframes)))

    def __len__(self) -> int:
        return len(self.pose)

    def at(self, index) -> Keyframes:
        if isinstance(index, list):
            rows = torch.tensor(index, dtype=torch.int64, device=self.pose.device)
            return Keyframes(*(getattr(self, field.name).index_select(0, rows) for field in fields(self)))
        return Keyframes(*(getattr(self, field.name)[index] for field in fields(self)))

    def unfolded(self, camera: Intrinsics) -> Keyframes:
        """The same, as a memory keeps them, ready to be looked at: with fine patches and pictures of double size."""
        return replace(self, rgb=doubled(self.rgb), fine=patches(self.depth, self.pose, camera, FINE))


def doubled(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 [..., 3, H, W] -> [..., 3, 2H, 2W], every pixel four times: a warp then blurs it by half a pixel only."""
    return rgb.repeat_interleave(2, -1).repeat_interleave(2, -2)


@dataclass(frozen=True)
class Glimpse:
    """What memory knows of B views. `slots` colours are sorted at every pixel, the most trusted first.

    rgb [B, slots, 3, H, W] in [0, 1]; trust [B, slots, H, W] in [0, 1], 0 where the slot saw another surface;
    depth [B, H, W] metres, holes filled; known [B, H, W] 1 where a patch was hit and some keyframe agrees.
    """

    rgb: torch.Tensor
    trust: torch.Tensor
    depth: torch.Tensor
    known: torch.Tensor

    def to(self, device) -> Glimpse:
        return Glimpse(*(getattr(self, field.name).to(device) for field in fields(self)))


def merge(glimpse: Glimpse) -> torch.Tensor:
    """The slots' colours averaged by their squared trust: [B, 3, H, W] in [0, 1]."""
    weight = (glimpse.trust + 1e-4) ** 2
    return (glimpse.rgb * weight[:, :, None]).sum(1) / weight.sum(1)[:, None]


def retrieve(
    memories: Sequence[Keyframes], pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], count: int
) -> list[list[int]]:
    """For one view from `pose` [7]: which keyframes of each memory to use, `count` in all, best first.

    Coverage-greedy: a keyframe's vote at a point is how alike its distance is (1 equal, 1/2 at twice or half), 0 where
    it saw something else there; each pick adds what the picks before it lack.
    """
    half = (size[0] // 2, size[1] // 2)
    depth = cast_all([m.coarse.flatten(0, 1) for m in memories], pose, camera, half)
    some = slice(_GRID // 2, None, _GRID)
    there = depth[some, some].flatten()
    beams = rays(camera, *half, pose.device)[some, some].flatten(0, 1)
    points = (there[:, None] * beams) @ rotation(pose).T + pose[:3]
    votes = (
        torch.cat([vote(m, points, there, camera) for m in memories]) if memories else points.new_zeros(0, len(points))
    )
    return _picks(memories, votes, count)


def retrieve_by_overlap(
    memories: Sequence[Keyframes], pose: torch.Tensor, camera: Intrinsics, count: int
) -> list[list[int]]:
    """The same as `retrieve` without depth, as in WorldMem (Xiao et al. 2025): a keyframe votes for the points of the
    view's frustum, at distances of 1 to 8 m, that lie in its own, as `retrieve` does by how alike their distance is; it
    cannot know of walls between."""
    beams = rays(camera, *_FRUSTUM[1:], pose.device).flatten(0, 1)
    distance = torch.logspace(0, 3, _FRUSTUM[0], 2.0, device=pose.device)
    points = (distance[:, None, None] * beams).flatten(0, 1) @ rotation(pose).T + pose[:3]
    there = distance.repeat_interleave(len(beams))
    votes = [points.new_zeros(0, len(points))]
    for memory in memories:
        where, depth = project(points.expand(len(memory), -1, -1), memory.pose, camera)
        inside = (depth > 0.05) & (where > 0).all(-1) & (where < 1).all(-1)
        ratio = there / depth.clamp_min(0.05)
        votes.append(torch.where(inside, torch.minimum(ratio, 1 / ratio), 0.0))
    return _picks(memories, torch.cat(votes), count)


def _picks(memories: Sequence[Keyframes], votes: torch.Tensor, count: int) -> list[list[int]]:
    """Of votes [K, P] of all keyframes on the points of a view: `count` keyframes, each adding what those before lack."""
    picks = pick(votes, count)
    bounds = [0]
    for memory in memories:
        bounds.append(bounds[-1] + len(memory))
    return [[p - low for p in picks if low <= p < high] for low, high in zip(bounds, bounds[1:])]


def pick(votes: torch.Tensor, count: int) -> list[int]:
    """The rows of votes [K, P], at most `count`, of which each adds most to what those before it cover."""
    if votes.device.type != "cpu":
        return pick_slowly(votes, count)
    from .kernels_numba import pick as kernel

    picks = np.zeros(min(count, len(votes)), np.int64)
    return picks[: kernel(votes.contiguous().numpy(), ANYWAY, picks)].tolist()


def pick_slowly(votes: torch.Tensor, count: int) -> list[int]:
    """The same as `pick`, in plain tensor algebra; the way on a GPU."""
    if len(votes):
        votes = torch.cat([votes, ANYWAY * votes.amax(1, keepdim=True)], 1)
    best, picks = torch.zeros(votes.shape[1], device=votes.device), []
    for _ in range(min(count, len(votes))):
        gain = (votes - best).clamp_min(0).sum(1)
        chosen = int(gain.argmax())
        if gain[chosen] <= 0:
            break
        picks.append(chosen)
        best = torch.maximum(best, votes[chosen])
    return picks


def vote(memory: Keyframes, points: torch.Tensor, distance: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """[K, P]: what each keyframe has to say of surface points [P, 3] that lie `distance` [P] deep in the new view."""
    if points.device.type != "cpu":
        return vote_slowly(memory, points, distance, camera)
    from .kernels_numba import vote as kernel

    votes = torch.empty(len(memory), len(points))
    turn, eye = memory.turn.contiguous().numpy(), memory.pose[:, :3].contiguous().numpy()
    depth = memory.depth.contiguous().numpy()
    kernel(points.contiguous().numpy(), distance.contiguous().numpy(), depth, turn, eye, camera, votes.numpy())
    return votes


def vote_slowly(memory: Keyframes, points: torch.Tensor, distance: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """The same as `vote`, in plain tensor algebra; the way on a GPU."""
    height, width = memory.depth.shape[-2:]
    where, depth = project(points.expand(len(memory), -1, -1), memory.pose, camera)
    inside = (depth > 0.05) & (where > 0).all(-1) & (where < 1).all(-1) & (distance < FAR_M)
    column, row = (
        (where[..., 0] * width).long().clamp(0, width - 1),
        (where[..., 1] * height).long().clamp(0, height - 1),
    )
    held = memory.depth.flatten(1).gather(1, row * width + column)
    same = inside & ((held - depth).abs() < SAME * depth)
    ratio = distance / depth.clamp_min(0.05)
    return torch.where(same, torch.minimum(ratio, 1 / ratio.clamp_min(1e-3)), 0.0)


def look(
    chosen: Sequence[Keyframes | None], pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], slots: int
) -> Glimpse:
    """The view from `pose` [B, 7] as the `chosen` keyframes, one set a view (None: none are known), know it."""
    batch, (height, width) = len(pose), size
    depth = torch.full((batch, height, width), FAR_M, device=pose.device)
    for view, keys in enumerate(chosen):
        if keys is not None and len(keys):
            depth[view] = cast_all([keys.fine.flatten(0, 1)], pose[view], camera, size)
    hit = depth < FAR_M
    depth = fill_holes(depth)
    colours = torch.zeros(batch, slots, 3, height, width, device=pose.device)
    trust = torch.zeros(batch, slots, height, width, device=pose.device)
    for view, keys in enumerate(chosen):
        if keys is not None and len(keys):
            recall(keys, depth[view], pose[view], camera, colours[view], trust[view])
    known = hit & (trust[:, 0] > 0)
    return Glimpse(colours, trust, depth, known.float())


def recall(
    keys: Keyframes,
    depth: torch.Tensor,
    pose: torch.Tensor,
    camera: Intrinsics,
    colours: torch.Tensor,
    trust: torch.Tensor,
) -> None:
    """Fills colours [slots, 3, H, W] and trust [slots, H, W] with the most trusted that keyframes know of the surfaces that
    lie `depth` [H, W] deep in the view from `pose` [7]."""
    if pose.device.type != "cpu":
        return recall_slowly(keys, depth, pose, camera, colours, trust)
    from .kernels_numba import recall as kernel

    rgb, held, turns, eyes, seen, turn, eye = (
        part.contiguous().numpy()
        for part in (keys.rgb, keys.depth, keys.turn, keys.pose[:, :3], depth, rotation(pose), pose[:3])
    )
    kernel(rgb, held, turns, eyes, seen, turn, eye, camera, colours.numpy(), trust.numpy())


def recall_slowly(keys, depth, pose, camera, colours, trust) -> None:
    """The same as `recall`, in plain tensor algebra; the way on a GPU."""
    rgb = keys.rgb.float().div(255)[None]
    colour, agreement, closeness = warp(rgb, keys.depth[None], keys.pose[None], depth[None], pose[None], camera)
    likeness = torch.minimum(closeness, 1 / closeness.clamp_min(1e-3)).clamp_min(0.05)
    best, order = (agreement * likeness**2)[0].topk(min(len(trust), len(keys)), dim=0)
    trust[: len(best)] = best
    colours[: len(best)] = colour[0].gather(0, order[:, None].expand(-1, 3, -1, -1))
