"""Posed RGB-D keyframes as spatial memory: what is known of a new view, and from which keyframes.

`retrieve` chooses keyframes greedily by their votes for the surfaces in the view, which coarse patches give. `look` renders the
depth of the view from fine patches, and warps colours into it. There are two sets of keyframes: `shared` by all views, with fine
patches, and `own`, of which each view uses some."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import torch

from ..core.backend import constant, kernels_do, where
from .camera import FAR_M, NEAR_M, SAME, Intrinsics, pixel_intrinsics, pixels_at, project, rotation, unproject
from .floorplan import WALLS, wall_segments
from .kernels_numba import recall as kernels
from .kernels_numba.surfaces import surfaces
from .patches import COARSE_CASTS, FINE_CASTS, SLANT, cast_inverse, patch_count, patches, patches_slowly
from .reproject import (
    MovingFrames,
    agreement_of,
    carried_from,
    carry_things,
    carry_unknown,
    colours_at,
    fill_holes,
    filled_inverse,
    places_in,
    planes_at,
    sight,
    splat_frames,
    unknown_alone,
)
from .views import arrays, over_views

COARSE, FINE = 8, 2  # strides of the patches for finding keyframes and for the view's depth
_GRID = 4  # a keyframe votes on every 4th pixel of a half-size view
ANYWAY = 0.02  # of its strongest vote counts for a keyframe, so that more than nothing is picked where all is covered


@dataclass(frozen=True)
class Keyframes:
    """K keyframes: rgb uint8 [K, 3, H, W], depth float32 [K, h, w] metres, pose [K, 7], its rotation `turn` [K, 3, 3], patches
    [K, n, 9] (fine: n = 0 until they are made), and the walls in view [K, n, 4] (floorplan.py)."""

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
    def none(size: tuple[int, int], device=None) -> Keyframes:
        """No keyframes, for pictures of `size`."""
        shapes = {"rgb": (3, *size), "depth": size, "pose": (7,), "turn": (3, 3), "walls": (WALLS, 4)}
        shapes |= {name: (patch_count(size, stride), 9) for name, stride in (("coarse", COARSE), ("fine", FINE))}
        parts = {name: torch.zeros(0, *shape, device=device) for name, shape in shapes.items()}
        return Keyframes(**{**parts, "rgb": parts["rgb"].byte()})

    @staticmethod
    def joined(parts: Sequence[Keyframes]) -> Keyframes:
        """The concatenation of keyframes with pictures of one size."""
        if len(parts) == 1:
            return parts[0]
        return Keyframes(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Keyframes)))

    def to(self, device) -> Keyframes:
        return Keyframes(*(getattr(self, field.name).to(device) for field in fields(Keyframes)))

    def __len__(self) -> int:
        return len(self.pose)

    def at(self, index) -> Keyframes:
        if isinstance(index, list):
            index = torch.tensor(index, dtype=torch.int64, device=self.pose.device)
        return Keyframes(*(getattr(self, field.name)[index] for field in fields(self)))


def doubled(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 [..., 3, H, W] -> [..., 3, 2H, 2W], every pixel four times: a warp then blurs it by half a pixel only."""
    height, width = rgb.shape[-2:]
    whole = rgb[..., None, :, None].expand(*rgb.shape[:-1], 2, width, 2)
    return whole.reshape(*rgb.shape[:-2], 2 * height, 2 * width)


def gathered(chosen: Sequence[Keyframes | None], size: tuple[int, int]) -> tuple[Keyframes, torch.Tensor]:
    """One set of keyframes per view -> all of them, and the picks of each view [B, S] among them (-1: none)."""
    sets = [Keyframes.none(size) if keys is None else keys for keys in chosen]
    picks = torch.full((len(sets), max((len(keys) for keys in sets), default=0)), -1)
    start = 0
    for view, keys in enumerate(sets):
        picks[view, : len(keys)] = torch.arange(start, start + len(keys))
        start += len(keys)
    some = [keys for keys in sets if len(keys)]
    return Keyframes.joined(some) if some else Keyframes.none(size), picks


# rgb uint8 [B, 3, H, W], depth [B, h, w] metres, pose [B, 7]
RgbdFrame = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
LastFrames = RgbdFrame | MovingFrames | None


@dataclass(frozen=True)
class Glimpse:
    """What is known of B views: colours [B, slots, 3, H, W] in [0, 1] and their trust [B, slots, H, W], best first; depth of the
    nearest known surface [B, H, W], FAR_M where nothing is known; known [B, H, W]: 1 where a keyframe agrees with that depth."""

    rgb: torch.Tensor
    trust: torch.Tensor
    depth: torch.Tensor
    known: torch.Tensor

    def each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Glimpse:
        """With each of its tensors changed."""
        return Glimpse(*(change(getattr(self, field.name)) for field in fields(self)))

    def to(self, device) -> Glimpse:
        return self.each(lambda part: part.to(device))

    @cached_property
    def merged(self) -> torch.Tensor:
        """The colours averaged with the squared trust of the slots: [B, 3, H, W] in [0, 1]."""
        weight = (self.trust + 1e-4).square()
        return (self.rgb * weight[:, :, None]).sum(1) / weight.sum(1)[:, None]


# -- which keyframes --------------------------------------------------------------------------------------------------


def retrieve(
    shared: Keyframes, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], count: int,
    own: Keyframes | None = None, rows: torch.Tensor | None = None,
) -> torch.Tensor:  # fmt: skip
    """The keyframes for views of `size` from `pose` [B, 7], the best first: int64 [B, count], numbers of shared ones, then
    len(shared) + those of own ones, of which a view may use its `rows` [B, n] (0: none); -1: no more.

    A keyframe's vote at a point is the ratio of the distances (1 if equal, 1/2 at twice or half), 0 if it sees something else
    there. Each pick adds most to the votes of the picks before it."""
    if own is None or rows is None:
        own, rows = Keyframes.none(size, pose.device), torch.zeros(len(pose), 0, dtype=torch.int64, device=pose.device)
    if not kernels_do(pose):
        return retrieve_slowly(shared, pose, camera, size, count, own, rows)
    picks = torch.full((len(pose), count), -1)
    lots = (tuple(arrays(keys.coarse, keys.depth, keys.turn, keys.pose)) for keys in (shared, own))
    parts = [*lots, *arrays(rows, rotation(pose), pose[:, :3]), camera, (size[0] // 2, size[1] // 2), _GRID, ANYWAY]
    parts.append(picks.numpy())
    over_views(len(pose), lambda first, last: kernels.choose(first, last, *parts))
    return picks


def retrieve_slowly(shared, pose, camera, size, count, own, rows) -> torch.Tensor:
    """The same as `retrieve`, in plain tensor algebra, also for GPUs."""
    batch, (height, width) = len(pose), (size[0] // 2, size[1] // 2)
    off = _GRID // 2 + 0.5 - _GRID / 2  # of the points from the middle of their squares, pixels
    grid = len(range(_GRID // 2, height, _GRID)), len(range(_GRID // 2, width, _GRID))
    scale = grid[1] * _GRID / width, grid[0] * _GRID / height
    middle = (camera[2] - off / width) / scale[0], (camera[3] - off / height) / scale[1]
    thinned = camera[0] / scale[0], camera[1] / scale[1], *middle
    coarse = torch.cat([shared.coarse.flatten(0, 1).expand(batch, -1, -1), own.coarse[rows].flatten(1, 2)], 1)
    turn = rotation(pose)
    depths = cast_inverse(coarse, pose, thinned, grid, COARSE_CASTS, turn).reciprocal().clamp_max(FAR_M)
    points, depths = unproject(depths, pose, thinned, turn).flatten(1, 2), depths.flatten(1)
    votes = vote_slowly(shared, own, rows, points, depths, camera)
    if not votes.shape[1]:
        return pick_slowly(votes, count)
    picks = pick_slowly(votes, count)  # never row 0 of own ones, which is all zeros
    order = constant(_lots, pose.device, len(shared), rows.shape[1])[picks].argsort(dim=1, stable=True)
    known = constant(torch.arange, pose.device, len(shared)).expand(batch, -1)
    none = constant(torch.tensor, pose.device, (-1,)).expand(batch, -1)
    numbers = torch.cat([known, len(shared) + rows, none], 1)
    picks = picks.gather(1, order)
    return numbers[constant(torch.arange, pose.device, batch)[:, None], picks]  # the pick -1 is the last number


def _lots(shared: int, own: int) -> torch.Tensor:
    """In which order keyframes that are trusted alike show: shared ones first, then own ones, LOT of their slots after the other;
    last the pick -1, none."""
    return torch.cat([torch.full((shared,), -1), torch.arange(own) // kernels.LOT, torch.tensor([own])])


def vote_slowly(
    shared: Keyframes | None,
    own: Keyframes,
    rows: torch.Tensor,
    points: torch.Tensor,
    distance: torch.Tensor | None,
    camera: Intrinsics,
) -> torch.Tensor:
    """Votes [B, n, P] of shared keyframes and of the `rows` [B, k] of own ones, for points [B, P, 3] that lie `distance` [B, P]
    deep in a view; without it the points are of the own keyframes, as many of each, and as deep as they lie in these."""
    batch, size = len(points), (own if shared is None else shared).depth.shape[-2:]
    poses, turns = own.pose[rows], own.turn[rows]
    if shared is not None:
        poses = torch.cat([shared.pose.expand(batch, -1, -1), poses], 1)
        turns = torch.cat([shared.turn.expand(batch, -1, -1, -1), turns], 1)
    at, ahead = project(points[:, None], poses, pixel_intrinsics(camera, size), turns)
    pixel, inside = pixels_at(at, size)
    pixel, mine = pixel.split([pixel.shape[1] - rows.shape[1], rows.shape[1]], 1)
    held = own.depth.flatten()[torch.add(mine, rows[..., None], alpha=size[0] * size[1])]
    if shared is not None:
        held = torch.cat([shared.depth.flatten(1).expand(batch, -1, -1).gather(2, pixel), held], 1)
    if distance is None:
        distance = ahead.unflatten(2, (rows.shape[1], -1)).diagonal(dim1=1, dim2=2).mT.flatten(1)
    seen = inside & (distance < FAR_M)[:, None]
    ratio, near, distance = held / ahead, ahead.clamp_min(NEAR_M), distance[:, None]
    same = seen & (ratio.clamp(1 - SAME, 1 + SAME) == ratio)
    return torch.minimum(distance, near) / torch.maximum(distance, near) * same


def pick_slowly(votes: torch.Tensor, count: int) -> torch.Tensor:
    """Greedy choice by votes [B, K, P], each keyframe by what it adds to those before it: int64 [B, count], -1: no more."""
    if not votes.shape[1]:
        return torch.full((len(votes), count), -1, device=votes.device)
    votes = torch.cat([votes, ANYWAY * votes.amax(2, keepdim=True)], 2)
    best, picks = votes, []  # the best votes of each with those before it
    sums = [constant(_nothing, votes.device).expand(len(votes), -1)]
    for number in range(count):
        most, chosen = best.sum(2, dtype=torch.float64).max(1, keepdim=True)
        sums.append(most)
        picks.append(chosen)
        if number + 1 < count:
            best = torch.maximum(best, best.gather(1, chosen[..., None].expand(-1, -1, best.shape[2])))
    return torch.cat(picks, 1).masked_fill(torch.cat(sums, 1).diff(dim=1) <= 0, -1)


def _nothing() -> torch.Tensor:
    return torch.zeros(1, dtype=torch.float64)


# -- what they show ---------------------------------------------------------------------------------------------------


def look(
    shared: Keyframes, picks: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], slots: int,
    own: Keyframes | None = None,
) -> Glimpse:  # fmt: skip
    """The views of `size` from `pose` [B, 7], from the picked keyframes [B, S] (see `retrieve`)."""
    return look_and_carry(shared, picks, pose, camera, size, slots, own)[0]


def look_and_carry(
    shared: Keyframes, picks: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], slots: int,
    own: Keyframes | None = None, last: LastFrames = None,
) -> tuple[Glimpse, torch.Tensor | None]:  # fmt: skip
    """`look`; and where that knows nothing, what the `last` frame (rgb, depth, pose) shows, as `carry_unknown` gives it; of K
    moving frames, what `carry_things` gives, [B, K, 6, H, W]."""
    own = Keyframes.none(size, pose.device) if own is None else own
    if not kernels_do(pose):
        return look_slowly(shared, picks, pose, camera, size, slots, own, last)
    glimpse = _look_quickly(shared, picks, pose, camera, size, slots, own)
    return glimpse, _carried(last, glimpse, pose, camera)


def _carried(last: LastFrames, glimpse: Glimpse, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor | None:
    """What `look_and_carry` gives beside the glimpse."""
    if last is None:
        return None
    if not isinstance(last, MovingFrames):
        return carry_unknown(*last, glimpse.known, glimpse.depth, pose, camera)
    batch, keys = last.depth.shape[:2]
    targets = pose[:, None].expand(-1, keys, -1).flatten(0, 1)
    rgb, depth, things, covered, at = (part.flatten(0, 1) for part in last)
    return carry_things(rgb, depth, things, covered, at, targets, camera).unflatten(0, (batch, keys))


def _look_quickly(shared, picks, pose, camera, size, slots, own) -> Glimpse:
    batch, (height, width) = len(pose), size
    depth = torch.full((batch, height, width), FAR_M)
    turns, positions, chosen = arrays(rotation(pose), pose[:, :3], picks)
    mine = arrays(own.depth, own.turn, own.pose)
    cast = [chosen, *arrays(shared.fine), *mine, turns, positions, camera, FINE, SLANT, depth.numpy()]
    over_views(batch, lambda first, last: surfaces(first, last, *cast))
    hit = depth < FAR_M
    depth = fill_holes(depth)
    colours, trust = torch.zeros(batch, slots, 3, height, width), torch.zeros(batch, slots, height, width)
    lots = (tuple(arrays(keys.rgb, keys.depth, keys.turn, keys.pose)) for keys in (shared, own))
    parts = [chosen, *lots, depth.numpy(), turns, positions, camera, colours.numpy(), trust.numpy()]
    over_views(batch, lambda first, last: kernels.recall(first, last, *parts))
    return Glimpse(colours, trust, depth, (hit & (trust[:, 0] > 0)).float())


def look_slowly(
    shared, picks, pose, camera, size, slots, own, last: LastFrames = None
) -> tuple[Glimpse, torch.Tensor | None]:
    """The same as `look_and_carry`, in plain tensor algebra, also for GPUs."""
    batch, valid, mine = len(pose), picks >= 0, picks >= len(shared)
    if not picks.shape[1] or not len(shared) + len(own):
        none = pose.new_zeros(batch, slots, 3, *size)
        nothing = Glimpse(none, none[:, :, 0], pose.new_full((batch, *size), FAR_M), pose.new_zeros(batch, *size))
        return nothing, _carried(last, nothing, pose, camera)
    theirs, ours = picks.clamp(0, max(0, len(shared) - 1)), (picks - len(shared)).clamp_min(0)

    def both(part: str, change: Callable[[torch.Tensor], torch.Tensor] = lambda tensor: tensor) -> torch.Tensor:
        """[B, S, ...]: that part of the picked keyframes, after `change` for own ones."""
        first, second = getattr(shared, part), getattr(own, part)
        if not len(own):
            return first[theirs]
        own_part = change(second[ours])
        return chosen(own_part, first) if len(shared) else own_part

    def chosen(own_part: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
        return torch.where(mine.view(*mine.shape, *[1] * (first.ndim - 1)), own_part, first[theirs])

    key_depth, poses, rgb, keys = both("depth"), both("pose"), both("rgb", doubled) / 255, picks.shape[1]
    moving = last if isinstance(last, MovingFrames) else None
    others = [] if last is None else [last[2][:, None] if moving is None else moving.pose]
    viewers = torch.cat([poses, *others, pose[:, None]], 1)
    turns = rotation(viewers)
    patch, turn = patches_slowly(key_depth, poses, camera, FINE, turns[:, :keys]), turns[:, -1]
    if len(shared):
        patch = chosen(patch, shared.fine)
    patch = patch * valid[..., None, None]
    inverse = cast_inverse(patch.flatten(1, 2), pose, camera, size, FINE_CASTS, turn)
    hit = inverse > 0
    if moving is not None:
        looked = _see_with_moving(key_depth, viewers, turns, inverse, moving, camera)
    else:  # the last frame is one keyframe more, whose colours are taken apart
        key_depth = key_depth if last is None else torch.cat([key_depth, last[1][:, None]], 1)
        depth = filled_inverse(inverse).reciprocal()
        looked = *sight(key_depth, viewers[:, :-1], turns[:, :-1], depth, (pose, turn), camera), depth, None
    places, agreement, near, depth, carried = looked
    depths = depth[:, None], near[:, :keys]
    likeness = torch.minimum(*depths) / torch.maximum(*depths)
    colours, trust = best_slowly(colours_at(rgb, places[:, :keys]), agreement[:, :keys], likeness, valid, slots)
    glimpse = Glimpse(colours, trust, depth, (hit & (trust[:, 0] > 0)).float())
    if last is None or moving is not None:
        return glimpse, carried
    colour, trust = colours_at((last[0] / 255)[:, None], places[:, keys:])[:, 0], agreement[:, keys:]
    return glimpse, unknown_alone(colour, trust, glimpse.known)


def _see_with_moving(
    key_depth: torch.Tensor,
    viewers: torch.Tensor,
    turns: torch.Tensor,
    inverse: torch.Tensor,
    moving: MovingFrames,
    camera: Intrinsics,
) -> tuple[torch.Tensor, ...]:
    """`sight` of S keyframes in the view whose 1 / depth is `inverse` [B, H, W], 0 in holes, and in the same programs of moving
    frames, in views of their own: places [B, S, H, W, 2], agreement, depths ahead; the view's depth; and the frames as
    `carry_things` gives them. viewers [B, S + K + 1, 7]: of keyframes, moving frames and the view; turns: their rotations."""
    batch, keys = key_depth.shape[:2]
    pose, turn = viewers[:, -1], turns[:, -1]
    planes, splat = splat_frames(moving, turns[:, keys:-1], (pose, turn), camera)
    filled = filled_inverse(torch.cat([inverse[:, None], splat], 1).flatten(0, 1)).unflatten(0, (batch, -1))
    splat = torch.where(splat > 0, splat, filled[:, 1:])
    depths = torch.cat([filled[:, :1].expand(-1, keys, -1, -1), splat], 1).reciprocal()
    places, ahead = places_in(unproject(depths, pose, camera, turn), viewers[:, :-1], turns[:, :-1], camera)
    mine = places[:, :keys].contiguous()
    carried = planes_at(planes, places[:, keys:])
    held = torch.cat([planes_at(key_depth[:, :, None], mine), carried[:, :, 4:5]], 1)[:, :, 0]
    agreement, near = agreement_of(held, places, ahead)
    return mine, agreement, near, depths[:, 0], carried_from(carried, agreement[:, keys:], depths[:, keys:])


def best_slowly(colour, agreement, likeness, valid, slots) -> tuple[torch.Tensor, torch.Tensor]:
    """The most trusted colours [B, slots, 3, H, W] and their trust [B, slots, H, W], of what S keyframes show: colour and
    agreement as `warp` gives them, likeness: the smaller distance over the larger, `valid` [B, S]."""
    sure = where(valid[..., None, None], agreement * likeness.clamp_min(0.05).square(), -1.0)
    # of equals the first, as the kernel does
    best, order = (part[:, :slots] for part in sure.sort(dim=1, descending=True, stable=True))
    colours = colour.gather(1, order[:, :, None].expand(-1, -1, 3, -1, -1)) * (best >= 0)[:, :, None]
    trust, missing = best.clamp_min(0), slots - best.shape[1]
    if not missing:
        return colours, trust
    colours = torch.cat([colours, colours.new_zeros(len(colours), missing, *colours.shape[2:])], 1)
    return colours, torch.cat([trust, trust.new_zeros(len(trust), missing, *trust.shape[2:])], 1)
