"""Floor plans from depth images: straight walls at the camera's height, and bodies that slide along them. World frame, metres; a
body is an axis-aligned upright box, as in Doom and Quake."""

import math

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do, plus, where
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
    inverse = constant(_doubles, depth.device, 1.0) / F.threshold(row, 0.0, 1e3).clamp(0.05, 1e3)
    runs = straight_runs(inverse, *lens)
    edges = torch.add(
        constant(_ends, depth.device, depth.shape[-1], *lens), runs[..., :2], alpha=-1 / (depth.shape[-1] * lens[0])
    )
    long, middle = runs[..., :2].diff(dim=2)[..., 0], edges.mean(2)
    known = (long >= FEWEST_FAR) | (torch.addcmul(runs[..., 3], runs[..., 2], middle) > 1 / NEARBY_M)
    most, order = (long * known).sort(dim=1, descending=True, stable=True)
    lines = torch.cat([_corners(runs, edges, 1 / (depth.shape[-1] * lens[0])), runs[..., 2:]], 2)
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
    near = F.threshold(inverse, 1 / SEEN_M, 0.0).reciprocal()
    joins = torch.linalg.vector_norm((near[:, None] * beside).diff(dim=2), dim=1) <= GAP_M
    # [K, first, last] of runs from column `first` to column `last`
    values = inverse[:, None] * beside
    sums = values.cumsum(2)
    sums = sums[:, :, None] - (sums - values)[..., None]  # over runs: [K, 2, first, last]
    lines = (constant(_lines, *given) * sums[:, None]).sum(2).flatten(2).mT
    beside, scale = beside.expand(count, -1, -1), 1 / STRAIGHT
    off = torch.baddbmm(inverse[:, None], lines, beside, beta=-scale, alpha=scale).view(count, width, width, width)
    off = torch.linalg.vector_norm(off.masked_fill(constant(_outside, device, width), 0.0), torch.inf, dim=3)
    most = inverse[:, None].expand(-1, width, -1).triu().cummax(2).values
    broken = constant(_after, device, width) > F.pad(joins, (1, 0), value=True)[:, None]
    stop = where((off > most) | broken, columns, width).amin(2)
    lines = lines.view(count, width, width, 2).gather(2, (stop - 1)[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    wide = stop >= long
    # which columns a walk from the left comes to: the first, and those to which another one leads
    leads = torch.where(wide, stop, onward)[..., None] == columns
    begin, stay = constant(_stay, device, width)[None, :1].expand(count, -1, -1), constant(_stay, device, width)
    walk = torch.where(leads, constant(_doubles, device, -1.0), stay)
    taken = wide & (torch.linalg.solve_triangular(walk, begin, upper=True, left=False, unitriangular=True)[:, 0] > 0)
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


def _corners(runs: torch.Tensor, ends: torch.Tensor, column: float) -> torch.Tensor:
    """Both ends [K, n, 2] of runs [K, n, 4], as `columns_left`: their outer columns, `ends` [K, n, 2], or the corner with a
    neighbour that they meet. column: what one looks farther to the left than the next."""
    ends = ends.flatten(1)
    edges = ends[:, 1:-1].unflatten(1, (-1, 2))  # where one ends, and the next begins
    lines = runs[..., 2:].diff(dim=1)
    corner = -(lines[..., 1] / lines[..., 0])
    slope, level = (runs[..., part].unfold(1, 2, 1) for part in (2, 3))
    places = torch.stack([corner[..., None].expand_as(edges), edges])
    ahead = torch.addcmul(level, slope, places).reciprocal()
    apart = torch.hypot(*(part.diff(dim=0)[0] for part in (ahead, ahead * places))).amax(2)
    inside = corner == torch.clamp(corner, edges[..., 1] - column, edges[..., 0] + column)
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
    apart = whole.double().unflatten(2, (2, 2)) - places[:, None, None]
    unit, marks, near = _sides(apart, half_m)
    left = move = wish.double()
    shift = torch.zeros_like(move)
    for bump in range(3):
        speed = (unit @ move[..., None]).view(near.shape[:3])
        share, face = _first_touch(marks, speed, near)
        blocked = share <= 1
        go = where(blocked, (share - short).clamp_min(0), 1.0)
        shift = torch.addcmul(shift, go, move)
        if bump == 2:
            left = left.masked_fill(blocked, 0.0)
            break
        moves = go[..., None, None] * constant(_doubles, walls.device, *_MOVES)
        marks = torch.addcmul(marks, speed[..., None], moves, value=-1)
        normal = unit.gather(1, face[..., None].expand(-1, -1, 2))[:, 0]
        along = torch.addcmul(move, normal, speed.flatten(1).gather(1, face), value=-1)
        move = along * plus(1.0, share, -1).clamp(0, 1)  # nothing, where the whole move was free
        left = torch.where(blocked, move, left)
    return shift.to(wish), left.to(wish)


def _sides(walls: torch.Tensor, half: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Walls [B, S, 2 ends, 2], seen from a body, by their separating axes x, y and across: the axes [B, 3 S, 2]; `marks`
    [B, S, 3, 5] along each, of a wall that is a body's half width larger: both ends, WITHIN_M before and after the body, and the
    middle, nan for no wall; and how near to that middle a box that touches by one axis has to be, seen along another, so that it
    does not only graze the wall [B, S, 3, 3]."""
    turn, plain, mix, box, *columns = (
        constant(_doubles, walls.device, *rows)
        for rows in (_QUARTER, _PLAIN, _MIX, ((half - 1e-9, 0.0), (0.0, half - 1e-9)), *_MARKS)
    )  # a box that moves along a wall that it touches does not run into it, hence 1e-9
    spans = mix @ walls  # middle, and half of the way from end to end
    along = spans[:, :, 1]
    across = (along @ turn) / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    unit = torch.cat([plain.expand(*along.shape[:2], 2, 2), across[..., None, :]], 2)
    seen = unit @ torch.cat([spans, box.expand(*along.shape[:2], 2, 2)], 2).mT  # [B, S, 3 axes, 4]
    middle, reach = seen[..., :1], torch.linalg.vector_norm(seen[..., 1:], 1, dim=-1, keepdim=True)
    marks = torch.addcmul(torch.addcmul(columns[0], middle, columns[1]), reach, columns[2])
    grazing = (unit @ turn @ unit.mT).abs() > 0.02
    near = where(grazing, (reach - WITHIN_M).mT.expand(grazing.shape), torch.inf)
    return unit.flatten(1, 2), marks, near


_QUARTER = (0.0, -1.0), (1.0, 0.0)
_PLAIN = (1.0, 0.0), (0.0, 1.0)
_MIX = (0.5, 0.5), (-0.5, 0.5)
# the marks are the first row, plus the middle by the second and the reach by the third; a body's move shifts those of the wall
_MARKS = ((0.0, 0.0, -WITHIN_M, WITHIN_M, 0.0),), ((1.0, 1.0, 0.0, 0.0, 1.0),), ((-1.0, 1.0, 0.0, 0.0, 0.0),)
_MOVES = _MARKS[1]


def _doubles(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def _first_touch(marks: torch.Tensor, speed: torch.Tensor, near: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The share [B, 1] of a move at which a box first touches a wall (more than 1: none), and the axis [B, 1] by which, of 3 S:
    see kernels_numba/walls.first_touch. speed [B, S, 3]: the move along the axes; marks and near as of `_sides`."""
    # times from end to end along each axis; along one without speed always, or never
    first, last = torch.aminmax(marks[..., :4].unflatten(3, (2, 2)) / speed[..., None, None], dim=-1)
    times, within = first.unbind(-1)
    enter = times.amax(-1, keepdim=True)
    off = torch.addcmul(marks[..., 4], enter, speed, value=-1).abs()
    # by the axis on which the box enters last, before it leaves any, and not from deeper inside
    enters = (times >= torch.maximum(enter, within)) & (times < last[..., 0].amin(-1, keepdim=True))
    reaches = enters & (off[:, :, None] <= near).all(-1)
    return where(reaches, times, 2.0).flatten(1).min(1, keepdim=True)


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
