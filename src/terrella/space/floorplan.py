"""Floor plans from depth images: straight walls at the camera's height, and bodies that slide along them. World frame, metres; a
body is an axis-aligned upright box, as in Doom and Quake."""

import math
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
    row, lens = depth[:, horizon(camera, depth.shape[-2])], (camera[0], camera[2])
    inverse = row.masked_fill(row <= 0, 1e3).double().clamp(0.05, 1e3).reciprocal()
    runs = straight_runs(inverse, *lens)
    spans = F.pad(inverse.cumsum(1), (1, 0)).gather(1, runs[..., :2].long().flatten(1)).view_as(runs[..., :2])
    long, whole = runs[..., :2].diff(dim=2)[..., 0], spans.diff(dim=2)[..., 0]
    known = (long >= FEWEST_FAR) | (whole * NEARBY_M > long)
    most, order = (long * known).sort(dim=1, descending=True, stable=True)
    lines = torch.cat([_corners(runs, depth.shape[-1], *lens), runs[..., 2:]], 2)
    sides, slope, level = lines.gather(1, order[..., None].expand(-1, -1, 4)).split([2, 1, 1], 2)
    ahead = torch.addcmul(level, slope, sides).reciprocal()
    turn = (yaw(pose)[:, None] + constant(_doubles, depth.device, *_TURNED)).cos().view(-1, 2, 2)
    ends = torch.stack([ahead, ahead * sides], -1).flatten(1, 2)
    ends = torch.baddbmm(pose[:, None, :2].double(), ends, turn).view(*ahead.shape[:2], 4)
    walls = where(most[..., None] > 0, ends, NOWHERE)[:, :WALLS].float()
    missing = WALLS - walls.shape[1]
    return F.pad(walls, (0, 0, 0, missing), value=NOWHERE) if missing > 0 else walls


_TURNED = 0.0, -math.pi / 2, math.pi / 2, 0.0  # the cosines of a heading and these are the matrix of its rotation


def straight_runs(inverse: torch.Tensor, focal: float, middle: float) -> torch.Tensor:
    """Runs of columns on which inverse depth [K, w] (float64) is linear, with neighbours less than GAP_M apart and depths below
    SEEN_M: [K, n, 4] = first, stop, and slope and level over the side of a column (`columns_left`, whose arguments focal and
    middle are); zeros after the last."""
    if not kernels_do(inverse):
        return straight_runs_slowly(inverse, focal, middle)
    left = constant(columns_left, inverse.device, inverse.shape[1], focal, middle)
    runs = inverse.new_zeros(len(inverse), inverse.shape[1] // FEWEST, 4)
    each_view(straight_runs_kernel, arrays(inverse, runs), *arrays(left), FEWEST, STRAIGHT, GAP_M, 1 / SEEN_M)
    return runs


def straight_runs_slowly(inverse: torch.Tensor, focal: float, middle: float) -> torch.Tensor:
    """The same as `straight_runs`, in plain tensor algebra, also for GPUs: lines through all runs at once, then the longest from
    every column, and of these a choice from left to right."""
    (count, width), device = inverse.shape, inverse.device
    columns, onward, long = (constant(torch.arange, device, first, first + width) for first in (0, 1, FEWEST))
    given = device, width, focal, middle
    beside = constant(_beside, *given)
    near = inverse.reciprocal().masked_fill(inverse < 1 / SEEN_M, torch.inf)
    joins = torch.linalg.vector_norm((near[:, None] * beside).diff(dim=2), dim=1) <= GAP_M
    # [K, first, last] of runs from column `first` to column `last`
    values = inverse[:, None] * beside
    sums = values.cumsum(2)
    sums = sums[:, :, None] - (sums - values)[..., None]  # over runs: [K, 2, first, last]
    lines = (constant(_lines, *given) * sums[:, None]).sum(2).flatten(2).mT
    off = torch.baddbmm(inverse[:, None], lines, beside.expand(count, -1, -1), beta=-1).view(count, width, width, width)
    off = torch.linalg.vector_norm(off.masked_fill(constant(_outside, device, width), 0.0), torch.inf, dim=3)
    most = inverse[:, None].expand(-1, width, -1).triu().cummax(2).values
    broken = constant(_after, device, width) > F.pad(joins, (1, 0), value=True)[:, None]
    stop = where((off > STRAIGHT * most) | broken, columns, width).amin(2)
    lines = lines.view(count, width, width, 2).gather(2, (stop - 1)[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    wide = stop >= long
    # which columns a walk from the left comes to: how many ways of steps and stays lead there in 2 ** n moves
    leads = torch.where(wide, stop, onward)[..., None] == columns
    moves = torch.where(leads, constant(_doubles, device, 1.0), constant(_stay, device, width))
    taken = wide & (torch.linalg.matrix_power(moves, 1 << (width - 1).bit_length())[:, 0] > 0)
    order = where(taken, columns, width).argsort(dim=1)
    runs = torch.cat([columns.expand(count, -1)[..., None], stop[..., None], lines], 2) * taken[..., None]
    return runs.gather(1, order[:, : width // FEWEST, None].expand(-1, -1, 4))


def columns_left(width: int, focal: float, middle: float) -> torch.Tensor:
    """How far columns look to the left, per metre ahead: float64 [w]; of a camera whose focal length and principal point are these
    shares of the width."""
    return (middle - (torch.arange(width, dtype=torch.float64) + 0.5) / width) / focal


def _beside(width: int, focal: float, middle: float) -> torch.Tensor:
    """float64 [2, w]: `columns_left` and 1, by which slope and level are multiplied."""
    left = columns_left(width, focal, middle)
    return torch.stack([left, torch.ones_like(left)])


def _lines(width: int, focal: float, middle: float) -> torch.Tensor:
    """float64 [slope or level, 2, first, last]: by which the sums over a run of its values, times `_beside`, are multiplied for the
    line of least squares."""
    left, columns = columns_left(width, focal, middle), torch.arange(width, dtype=torch.float64)
    count, mean = (columns - columns[:, None] + 1).clamp_min(1), (left + left[:, None]) / 2
    sharp = torch.where(count > 1, 12 * (width * focal) ** 2 / (count**3 - count), 0.0)  # 1 / sum of (left - mean)^2
    slope = torch.stack([sharp, -sharp * mean])
    return torch.stack([slope, torch.stack([torch.zeros_like(mean), 1 / count]) - mean * slope])


def _outside(width: int) -> torch.Tensor:
    """bool [first, last, column]: whether a column does not lie between two others."""
    columns = torch.arange(width)
    return (columns < columns[:, None])[:, None] | (columns > columns[:, None])


def _after(width: int) -> torch.Tensor:
    """bool [first, last]: whether a column lies after another."""
    return torch.arange(width) > torch.arange(width)[:, None]


def _stay(width: int) -> torch.Tensor:
    return torch.eye(width, dtype=torch.float64)


def _corners(runs: torch.Tensor, width: int, focal: float, middle: float) -> torch.Tensor:
    """Both ends [K, n, 2] of runs [K, n, 4], as `columns_left`: their outer columns, or the corner with a neighbour that they
    meet."""
    column, ends = -1 / (width * focal), constant(_ends, runs.device, width, focal, middle)
    ends = torch.add(ends, runs[..., :2], alpha=column).flatten(1)
    edges = ends[:, 1:-1].unflatten(1, (-1, 2))  # where one ends, and the next begins
    lines = runs[..., 2:].diff(dim=1)
    corner = -(lines[..., 1] / lines[..., 0])
    slope, level = (runs[..., part].unfold(1, 2, 1) for part in (2, 3))
    places = torch.stack([corner[..., None].expand_as(edges), edges])
    ahead = torch.addcmul(level, slope, places).reciprocal()
    apart = torch.hypot(*(part.diff(dim=0)[0] for part in (ahead, ahead * places))).amax(2)
    inside = corner == torch.clamp(corner, edges[..., 1] + column, edges[..., 0] - column)
    meet = (runs[:, 1:, 0] - runs[:, :-1, 1] <= 2) & inside & (apart < GAP_M)
    met = torch.where(meet[..., None], corner[..., None], edges).flatten(1)
    return torch.cat([ends[:, :1], met, ends[:, -1:]], 1).unflatten(1, (-1, 2))


def _ends(width: int, focal: float, middle: float) -> torch.Tensor:
    """float64 [2]: where column 0 looks, and the column before it."""
    left = columns_left(width, focal, middle)[0]
    return torch.stack([left, left + 1 / (width * focal)])


def floor_plan(walls: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """The walls [K, n, 4] of keyframes at `pose` [K, 7], merged into one floor plan: [S, 4]. Each is moved to the mean line of all
    collinear walls, weighted by length and nearness, and its ends to the crossing with another wall within 4 cm."""
    real = walls[..., 0] < NOWHERE
    origin = pose[:, None, :2].expand(-1, walls.shape[1], -1)[real].double()
    start, end = walls[real].double().split(2, -1)
    long = (end - start).norm(dim=1) > 0.02
    if not long.any():
        return walls.new_zeros(0, 4)
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
    if not whole.shape[1]:
        return wish, wish
    sides = _sides(whole.double(), half_m)
    place, rest, free = places.double(), wish.double(), None
    for bump in range(3):
        share, along = _first_touch(sides, place, rest)
        blocked = share <= 1
        go = where(blocked, (share - short).clamp_min(0), 1.0)
        place = torch.addcmul(place, go if free is None else go * free, rest)
        free = blocked if free is None else free & blocked
        if bump < 2:
            onward = (rest * along).sum(1, keepdim=True) * (1 - share).clamp_max(1) * along
            rest = torch.where(free, onward, rest)
        else:
            rest = rest.masked_fill(free, 0.0)
    return (place - places).to(wish), rest.to(wish)


class _Sides(NamedTuple):
    """Walls [B, S] by their separating axes x, y and across: the axes [B, 3 S, 2]; the direction along each [B, 3 S, 2]; how far
    along each lie the ends of a wall that is a body's half width larger [B, S, 3, 2], nan for no wall, and their middles [B, S, 3];
    how near to these a box that touches by one axis has to be, seen along another, so that it does not only graze the wall
    [B, S, 3, 3]."""

    unit: torch.Tensor
    onward: torch.Tensor
    ends: torch.Tensor
    middle: torch.Tensor
    near: torch.Tensor


def _sides(walls: torch.Tensor, half: float) -> _Sides:
    """Of walls [B, S, 4]."""
    ends = walls.unflatten(-1, (2, 2))
    along = ends[..., 1, :] - ends[..., 0, :]
    length = torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    turn, plain, sides = (constant(_doubles, walls.device, *rows) for rows in (_QUARTER, _PLAIN, ((-1.0, 1.0),)))
    across = (along @ turn) / length.masked_fill(length < 1e-9, torch.nan)
    unit = torch.cat([plain.expand(*along.shape[:2], 2, 2), across[..., None, :]], 2)
    onward = unit @ turn.mT
    both = unit @ ends.mT  # [B, S, 3 axes, 2 ends]
    reach = torch.add(both.diff(dim=-1)[..., 0].abs(), torch.linalg.vector_norm(unit, 1, dim=-1), alpha=2 * half) / 2
    middle = both.mean(-1)
    grazing = (unit @ onward.mT).abs() > 0.02
    near = where(grazing, (reach - WITHIN_M)[:, :, None].expand(grazing.shape), torch.inf)
    # a box that moves along a wall that it touches does not run into it
    ends = torch.addcmul(middle[..., None], (reach - 1e-9)[..., None], sides[0])
    return _Sides(unit.flatten(1, 2), onward.flatten(1, 2), ends, middle, near)


_QUARTER = (0.0, -1.0), (1.0, 0.0)
_PLAIN = (1.0, 0.0), (0.0, 1.0)


def _doubles(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _firsts(count: int) -> torch.Tensor:
    return 3 * torch.arange(count)


def _first_touch(sides: _Sides, place: torch.Tensor, move: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The share [B, 1] of the move [B, 2] at which a box at `place` [B, 2] first touches a wall (more than 1: none), and the
    direction [B, 2] in which it can go on: see kernels_numba/walls.first_touch."""
    unit, onward, ends, middle, near = sides
    at, speed = (unit @ torch.stack([place, move], -1)).view(*middle.shape, 2).unbind(-1)  # [B, S, 3]
    # times from end to end along each axis; along one without speed always, or never
    least, most = torch.aminmax((ends - at[..., None]) / speed[..., None], dim=-1)
    enter, face = least.max(-1)
    index = face[..., None]
    off = torch.addcmul(middle - at, enter[..., None], speed, value=-1).abs()
    clear = (off <= near.gather(2, index[..., None].expand(-1, -1, 1, 3))[:, :, 0]).all(-1)
    reaches = (enter < most.amin(-1)) & (enter * speed.abs().gather(2, index)[..., 0] > -WITHIN_M) & clear
    share, which = where(reaches, enter, 2.0).min(1, keepdim=True)
    faced = (face + constant(_firsts, place.device, face.shape[1])).gather(1, which)
    return share, onward.gather(1, faced[..., None].expand(-1, -1, 2))[:, 0]


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
