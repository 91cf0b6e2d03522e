"""Floor plans from depth images: straight walls at the camera's height, and bodies that slide along them. World frame, metres; a
body is an axis-aligned upright box, as in Doom and Quake."""

from typing import NamedTuple

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do, where
from .camera import Intrinsics, unproject, yaw
from .kernels_numba.walls import WITHIN_M
from .kernels_numba.walls import slide as slide_kernel
from .kernels_numba.walls import straight_runs as straight_runs_kernel
from .views import arrays, each_view, over_views

Box = tuple[float, float, float, float]  # x0, y0, x1, y1 on the map

WALLS = 16  # walls kept per keyframe at most, those seen by most columns
NOWHERE = 1e6  # coordinate of unused walls
FEWEST = 4  # columns that make a wall
NEARBY_M, FEWEST_FAR = 4.0, 12  # walls farther than this need more columns, because their ends are uncertain
SEEN_M = 50.0  # depth beyond this is unreliable
STRAIGHT = 0.004  # largest relative deviation of 1 / depth along a wall from a straight line
GAP_M = 0.5  # columns farther apart do not join; no body fits through less


def wall_segments(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """Depth [K, h, w] (0: unknown) from level poses [K, 7] -> walls [K, WALLS, 4] = x1, y1, x2, y2.

    On the horizon the inverse depth of a flat wall is linear in the column; runs that meet are extended to their corner. Walls
    farther than SEEN_M, or so far that neighbouring columns are half a metre apart, are left out."""
    width, row = depth.shape[-1], horizon(camera, depth.shape[-2])
    columns = torch.arange(width, dtype=torch.float64, device=depth.device)
    left = -((columns + 0.5) / width - camera[2]) / camera[0]
    inverse = 1 / torch.where(depth[:, row] > 0, depth[:, row], 1e3).double().clamp(0.05, 1e3)
    runs = straight_runs(inverse, left)
    first, stop, slope, level = runs[..., 0].long(), runs[..., 1].long(), runs[..., 2], runs[..., 3]
    sides = _corners(first, stop, slope, level, left)
    sums = F.pad(inverse.cumsum(1), (1, 0))
    long = stop - first
    mean = (sums.gather(1, stop) - sums.gather(1, first)) / long.clamp_min(1)
    known = (long > 0) & ((long >= FEWEST_FAR) | (1 / mean < NEARBY_M))
    most, order = torch.where(known, long, 0).sort(dim=1, descending=True, stable=True)
    sides, slope, level = (part.gather(-1, order.expand(part.shape)) for part in (sides, slope, level))
    ahead = 1 / torch.where(most > 0, slope * sides + level, 1.0)
    heading, position = yaw(pose).double()[:, None], pose[:, :2].double()[..., None]
    cosine, sine, beside = heading.cos(), heading.sin(), ahead * sides
    x = torch.addcmul(torch.addcmul(position[:, 0], ahead, cosine), beside, sine, value=-1)
    y = torch.addcmul(torch.addcmul(position[:, 1], ahead, sine), beside, cosine)
    walls = where(most > 0, torch.stack([x[0], y[0], x[1], y[1]]), NOWHERE).permute(1, 2, 0)[:, :WALLS].float()
    return F.pad(walls, (0, 0, 0, WALLS - walls.shape[1]), value=NOWHERE)


def straight_runs(inverse: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Runs of columns on which inverse depth [K, w] is linear in `left` [w] (float64 both), with neighbours less than GAP_M
    apart and depths below SEEN_M: [K, n, 4] = first, stop, slope, level; zeros after the last."""
    if not kernels_do(inverse):
        return straight_runs_slowly(inverse, left)
    runs = inverse.new_zeros(len(inverse), inverse.shape[1] // FEWEST, 4)
    each_view(straight_runs_kernel, arrays(inverse, runs), *arrays(left), FEWEST, STRAIGHT, GAP_M, 1 / SEEN_M)
    return runs


def straight_runs_slowly(inverse: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """The same as `straight_runs`, in plain tensor algebra, also for GPUs: lines through all runs at once, then the longest from
    every column, and of these a choice from left to right."""
    count, width = inverse.shape
    columns = constant(torch.arange, inverse.device, width)
    near, far = 1 / inverse, left / inverse
    joins = torch.hypot(near.diff(dim=1), far.diff(dim=1)) <= GAP_M
    joins &= (inverse[:, 1:] >= 1 / SEEN_M) & (inverse[:, :-1] >= 1 / SEEN_M)
    # [K, first, last] of runs from column `first` to column `last`; sums over them by differences of sums from the left
    mean, both = _means(torch.stack([inverse, left * inverse]))
    middle, square = _means(torch.stack([left, left.square()]))
    spread = (square - middle.square()).clamp_min(1e-12)
    slope = (both - middle * mean) / spread
    level = mean - slope * middle
    off = (slope[..., None] * left + level[..., None] - inverse[:, None, None]).abs()
    off = (off * constant(_within, inverse.device, width)).amax(-1)
    most = inverse[:, None].expand(-1, width, -1).triu().cummax(2).values
    broken = F.pad((~joins).cumsum(1), (1, 0))
    fits = (off <= STRAIGHT * most) & (broken[:, None] == broken[:, :, None]) & (columns > columns[:, None])
    fits = fits | (columns == columns[:, None])
    alive = fits.long().masked_fill(columns < columns[:, None], 1).cumprod(2)
    stop = (alive * (columns >= columns[:, None])).sum(2) + columns
    last = (stop - 1)[..., None]
    slope, level = (part.gather(2, last)[..., 0] for part in (slope, level))
    long = stop - columns >= FEWEST
    # which columns a walk from the left comes to, by doubling its strides
    onward = F.pad(torch.where(long, stop, columns + 1), (0, 1), value=width)
    visited = F.pad(torch.ones_like(stop[:, :1]), (0, width))
    for _ in range(width.bit_length()):
        visited = visited.scatter_reduce(1, onward, visited, "amax")
        onward = onward.gather(1, onward)
    taken = long & (visited[:, :width] > 0)
    runs = torch.stack([columns.expand(count, -1).double(), stop.double(), slope, level], 2) * taken[..., None]
    order = (~taken).to(torch.uint8).argsort(dim=1, stable=True)[:, : width // FEWEST]
    return runs.gather(1, order[..., None].expand(-1, -1, 4))


def _means(values: torch.Tensor) -> torch.Tensor:
    """Means [..., first, last] of the values [..., w] from one column to another; meaningless where last < first."""
    sums = F.pad(values.cumsum(-1), (1, 0))
    return (sums[..., None, 1:] - sums[..., :-1, None]) / constant(_lengths, values.device, values.shape[-1])


def _lengths(width: int) -> torch.Tensor:
    """[first, last]: columns from one to another, 1 where last < first."""
    columns = torch.arange(width)
    return (columns - columns[:, None] + 1).clamp_min(1)


def _within(width: int) -> torch.Tensor:
    """float64 [first, last, column]: 1 where a column lies between two others, 0 elsewhere."""
    columns = torch.arange(width)
    return ((columns >= columns[:, None])[:, None] & (columns <= columns[:, None])).double()


def _corners(first, stop, slope, level, left) -> torch.Tensor:
    """Both ends [2, K, n] of runs [K, n]: their outer columns, or the corner with a neighbour that they meet."""
    last = len(left) - 1
    begin, end = left[first.clamp_max(last)], left[(stop - 1).clamp_min(0)]
    one, other = slice(None, -1), slice(1, None)
    meet = (stop[:, other] > 0) & (first[:, other] - stop[:, one] <= 2) & (slope[:, one] != slope[:, other])
    corner = (level[:, other] - level[:, one]) / torch.where(meet, slope[:, one] - slope[:, other], 1.0)
    meet &= (corner >= left[(first[:, other] + 1).clamp_max(last)]) & (corner <= left[(stop[:, one] - 2).clamp_min(0)])
    lines = [torch.stack([part[:, one], part[:, other]]) for part in (slope, level)]
    meet &= (_apart(corner, torch.stack([end[:, one], begin[:, other]]), *lines) < GAP_M).all(0)
    begin = torch.cat([begin[:, :1], torch.where(meet, corner, begin[:, other])], 1)
    return torch.stack([begin, torch.cat([torch.where(meet, corner, end[:, one]), end[:, -1:]], 1)])


def _apart(one, other, slope, level) -> torch.Tensor:
    """Metres between two columns of a run."""
    near, far = 1 / (slope * one + level), 1 / (slope * other + level)
    return torch.hypot(near - far, near * one - far * other)


def floor_plan(walls: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """The walls [K, n, 4] of keyframes at `pose` [K, 7], merged into one floor plan: [S, 4]. Each is moved to the mean line of all
    collinear walls, weighted by length and nearness, and its ends to the crossing with another wall within 4 cm."""
    real = walls[..., 0] < NOWHERE
    origin = pose[:, None, :2].expand(-1, walls.shape[1], -1)[real].double()
    start, end = walls[real].double().split(2, -1)
    long = (end - start).norm(dim=1) > 0.02
    if not long.any():
        return torch.zeros(0, 4)
    start, end, origin = start[long], end[long], origin[long]
    weight = (end - start).norm(dim=1) / ((start + end) / 2 - origin).norm(dim=1).clamp_min(0.5) ** 2
    for _ in range(2):
        parts = [_mean_line(start[some], end[some], start, end, weight) for some in torch.arange(len(start)).split(512)]
        start, end = (torch.cat(halves) for halves in zip(*parts))
    parts = [_ended(start[some], end[some], start, end) for some in torch.arange(len(start)).split(512)]
    return torch.cat(parts).float()


def _mean_line(start, end, all_starts, all_ends, weight) -> tuple[torch.Tensor, torch.Tensor]:
    """Walls [n, 2] moved to the weighted mean line of those [N, 2] within 3 cm and 1 degree, at most 6 m away along it."""
    length, along, across, middle = _frame(start, end)
    others_length, others_along, _, others_middle = _frame(all_starts, all_ends)
    apart = others_middle - middle[:, None]
    off = (apart * across[:, None]).sum(-1)
    gap = (apart * along[:, None]).sum(-1).abs() - (length[:, None] + others_length) / 2
    sine, cosine = across @ others_along.T, along @ others_along.T
    share = weight * ((sine.abs() < 0.02) & (off.abs() < 0.03) & (gap < 6.0))
    turn = share * others_length**2  # long walls have more precise directions
    turned = along + across * ((turn * sine * cosine.sign()).sum(1) / turn.sum(1))[:, None]
    turned = turned / turned.norm(dim=1, keepdim=True)
    middle = middle + across * ((share * off).sum(1) / share.sum(1))[:, None]
    return tuple(middle + turned * ((point - middle) * turned).sum(1, keepdim=True) for point in (start, end))


def _ended(start, end, all_starts, all_ends, reach_m: float = 0.04) -> torch.Tensor:
    """Walls [n, 2] with their ends moved to the nearest crossing with a wall [N, 2] within `reach_m`."""
    _, along, _, _ = _frame(start, end)
    others_length, others_along, others_across, _ = _frame(all_starts, all_ends)
    crossing = along @ others_across.T
    ends = []
    for point in (start, end):
        apart = point[:, None] - all_starts
        off, place = (apart * others_across).sum(-1), (apart * others_along).sum(-1)
        meets = (crossing.abs() > 0.3) & (off.abs() < reach_m) & (place > -reach_m) & (place < others_length + reach_m)
        near, other = torch.where(meets, off.abs(), torch.inf).min(1)
        shift = -off.gather(1, other[:, None]) / crossing.gather(1, other[:, None])
        ends.append(torch.where(near[:, None] < reach_m, point + shift * along, point))
    return torch.cat(ends, 1)


def _frame(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Length [n], unit direction [n, 2], unit normal [n, 2] and middle [n, 2] of walls [n, 2]."""
    length = (end - start).norm(dim=1)
    along = (end - start) / length[:, None]
    return length, along, torch.stack([-along[:, 1], along[:, 0]], 1), (start + end) / 2


def slide(
    walls: torch.Tensor, places: torch.Tensor, wish: torch.Tensor, half_m: float, short: float = 0.0,
    own: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """The motion of bodies of half width `half_m` at `places` [B, 2] that try to move by `wish` [B, 2], among shared walls [S, 4]
    and `own` walls [B, n, 4]. At a wall the rest of the motion continues along it, twice at most. A body stops `short` (a share of
    the wish) of a wall. Returns the displacement [B, 2] and the remaining motion, the momentum [B, 2]."""
    own = walls.new_zeros(len(places), 0, 4) if own is None else own
    if not kernels_do(places):
        return slide_slowly(walls, places, wish, half_m, short, own)
    went, left = torch.zeros(2, len(places), 2, dtype=torch.float64)
    parts = [*arrays(walls, own.to(walls), places.double(), wish.double()), half_m, short, went.numpy(), left.numpy()]
    over_views(len(places), lambda first, last: slide_kernel(first, last, *parts))
    return went.to(wish), left.to(wish)


def slide_slowly(walls, places, wish, half_m, short, own) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `slide`, in plain tensor algebra, also for GPUs."""
    whole = torch.cat([walls.expand(len(places), -1, -1), own.to(walls)], 1)
    sides = _sides(F.pad(whole, (0, 0, 0, 1), value=NOWHERE).double(), half_m)
    place, rest = places.double(), wish.double()
    free = torch.ones_like(place[:, :1], dtype=torch.bool)
    for bump in range(3):
        share, along = _first_touch(sides, place, rest)
        blocked = share <= 1
        go = where(blocked, (share - short).clamp_min(0), 1.0)
        place = place + go * rest * free
        free = free & blocked
        if bump < 2:
            onward = (1 - share.clamp_min(0)) * (rest * along).sum(1, keepdim=True) * along
            rest = torch.where(free, onward, rest)
        else:
            rest = rest * ~free
    return (place - places).to(wish), rest.to(wish)


class _Sides(NamedTuple):
    """Walls [B, S] by their separating axes x, y and across: the axes [B, S, 3, 2]; how far along each lie the ends of a wall that
    is a body's half width larger, low and high [B, S, 3]; the sines [B, S, 3, 3] of the angles between axes; real [B, S]."""

    unit: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor
    crossing: torch.Tensor
    real: torch.Tensor


def _sides(walls: torch.Tensor, half: float) -> _Sides:
    """Of walls [B, S, 4]."""
    ends = walls.unflatten(-1, (2, 2))
    along = ends[..., 1, :] - ends[..., 0, :]
    length = along.norm(dim=-1, keepdim=True)
    turn, plain, split = (constant(_doubles, walls.device, *rows) for rows in _AXES)
    unit = torch.cat([plain.expand(*along.shape[:2], 2, 2), ((along @ turn) / length.clamp_min(1e-9))[..., None, :]], 2)
    both = unit @ ends.mT  # [B, S, 3 axes, 2 ends]
    reach = half * unit.abs().sum(-1)
    low, high = torch.aminmax(both, dim=-1)
    crossing = (unit @ split @ unit.mT).abs()
    return _Sides(unit, low - reach, high + reach, crossing, length[..., 0] >= 1e-9)


_QUARTER = (0.0, -1.0), (1.0, 0.0)
_AXES = _QUARTER, ((1.0, 0.0), (0.0, 1.0)), _QUARTER


def _doubles(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _first_touch(sides: _Sides, place: torch.Tensor, move: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The share [B, 1] of the move [B, 2] at which a box at `place` [B, 2] first touches a wall (2: none), and the direction [B, 2]
    in which it can go on: see kernels_numba/walls.first_touch."""
    unit, low, high, crossing, real = sides
    at, speed = (unit @ torch.stack([place, move], -1)[:, None]).unbind(-1)  # [B, S, 3]
    low, high, pace = low - at, high - at, speed.abs()
    still = pace < 1e-12
    ends = torch.stack([low, high]) / speed.masked_fill(still, 1.0)
    least, most = torch.aminmax(ends, dim=0)
    enter, face = least.masked_fill(still, -1e9).max(-1)
    beside = still & (torch.maximum(low, -high) >= -1e-9)
    leave = most.masked_fill(still, 1e9).masked_fill(beside, -1e9).amin(-1)
    went = enter[..., None] * speed
    deep = torch.minimum(went - low, high - went)
    index = face[..., None]
    across = crossing.gather(2, index[..., None].expand(*crossing.shape[:2], 1, 3))[:, :, 0]
    grazes = ((across > 0.02) & (deep < WITHIN_M)).any(-1)
    reaches = (enter < leave) & (enter <= 1) & (enter > -1e9) & (enter * pace.gather(2, index)[..., 0] > -WITHIN_M)
    share, which = where(reaches & real & ~grazes, enter, 2.0).min(1, keepdim=True)
    faced = unit.flatten(1, 2).gather(1, (3 * which + face.gather(1, which))[..., None].expand(-1, -1, 2))[:, 0]
    return share, faced @ constant(_doubles, place.device, *_QUARTER).mT


def horizon(camera: Intrinsics, height: int) -> int:
    """The row of the horizon in an image of `height` rows."""
    return min(int(camera[3] * height), height - 1)


def sees_into(
    box: Box, level: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, deep_m: float = 0.5
) -> torch.Tensor:
    """Whether posed depth images show points in a box on the map, more than `deep_m` metres from its sides: bool [K]. `level`
    [K, w] are their rows of the horizon; pose [K, 7]."""
    x0, y0, x1, y1 = box
    flat = (camera[0], camera[1], camera[2], 0.5)  # of a picture of that row only
    x, y = unproject(level[:, None], pose, flat)[:, 0, :, :2].unbind(-1)
    return ((x > x0 + deep_m) & (x < x1 - deep_m) & (y > y0 + deep_m) & (y < y1 - deep_m)).any(1)
