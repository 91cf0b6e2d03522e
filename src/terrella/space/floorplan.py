"""Floor plans from depth images: straight walls at the camera's height, and bodies that slide along them. World frame, metres; a
body is an axis-aligned upright box, as in Doom and Quake."""

import torch
import torch.nn.functional as F

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
    x = position[:, 0] + ahead * heading.cos() - ahead * sides * heading.sin()
    y = position[:, 1] + ahead * heading.sin() + ahead * sides * heading.cos()
    walls = torch.where(most > 0, torch.stack([x[0], y[0], x[1], y[1]]), NOWHERE).permute(1, 2, 0)[:, :WALLS].float()
    return F.pad(walls, (0, 0, 0, WALLS - walls.shape[1]), value=NOWHERE)


def straight_runs(inverse: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Runs of columns on which inverse depth [K, w] is linear in `left` [w] (float64 both), with neighbours less than GAP_M
    apart and depths below SEEN_M: [K, n, 4] = first, stop, slope, level; zeros after the last."""
    if inverse.device.type != "cpu":
        return straight_runs_slowly(inverse, left)
    runs = inverse.new_zeros(len(inverse), inverse.shape[1] // FEWEST, 4)
    each_view(straight_runs_kernel, arrays(inverse, runs), *arrays(left), FEWEST, STRAIGHT, GAP_M, 1 / SEEN_M)
    return runs


def straight_runs_slowly(inverse: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """The same as `straight_runs`: the longest run from every column, then a choice of runs from left to right."""
    count, width = inverse.shape
    near, far = 1 / inverse, left / inverse
    joins = (near.diff(dim=1).square() + far.diff(dim=1).square()).sqrt() <= GAP_M
    joins &= (inverse[:, 1:] >= 1 / SEEN_M) & (inverse[:, :-1] >= 1 / SEEN_M)
    alive = torch.ones(count, width, dtype=torch.bool, device=inverse.device)
    stop = torch.arange(1, width + 1, device=inverse.device).repeat(count, 1)
    slope, level = torch.zeros_like(inverse), torch.zeros_like(inverse)
    for length in range(2, width + 1):
        x, y, starts = left.unfold(0, length, 1), inverse.unfold(1, length, 1), width - length + 1
        middle, mean = x.mean(1, keepdim=True), y.mean(2, keepdim=True)
        steep = ((x - middle) * (y - mean)).sum(2) / (x - middle).square().sum(1)
        off = (steep[..., None] * (x - middle) + mean - y).abs().amax(2)
        fits = alive[:, :starts] & joins[:, length - 2 :] & (off <= STRAIGHT * y.amax(2))
        alive = F.pad(fits, (0, width - starts))
        stop = stop + alive
        slope = torch.where(alive, F.pad(steep, (0, width - starts)), slope)
        level = torch.where(alive, F.pad(mean[..., 0] - steep * middle[:, 0], (0, width - starts)), level)
    columns, turn = torch.arange(width, device=inverse.device), torch.zeros_like(stop[:, 0])
    taken = torch.zeros_like(alive)
    for column in range(width):
        taken[:, column] = (turn == column) & (stop[:, column] - column >= FEWEST)
        turn = torch.where(taken[:, column], stop[:, column], torch.maximum(turn, columns[column] + 1))
    runs = torch.stack([columns.expand(count, -1).double(), stop.double(), slope, level], 2) * taken[..., None]
    order = (~taken).to(torch.uint8).argsort(dim=1, stable=True)[:, : width // FEWEST]
    return runs.gather(1, order[..., None].expand(-1, -1, 4))


def _corners(first, stop, slope, level, left) -> torch.Tensor:
    """Both ends [2, K, n] of runs [K, n]: their outer columns, or the corner with a neighbour that they meet."""
    last = len(left) - 1
    begin, end = left[first.clamp_max(last)], left[(stop - 1).clamp_min(0)]
    one, other = slice(None, -1), slice(1, None)
    meet = (stop[:, other] > 0) & (first[:, other] - stop[:, one] <= 2) & (slope[:, one] != slope[:, other])
    corner = (level[:, other] - level[:, one]) / torch.where(meet, slope[:, one] - slope[:, other], 1.0)
    meet &= (corner >= left[(first[:, other] + 1).clamp_max(last)]) & (corner <= left[(stop[:, one] - 2).clamp_min(0)])
    meet &= _apart(corner, end[:, one], slope[:, one], level[:, one]) < GAP_M
    meet &= _apart(corner, begin[:, other], slope[:, other], level[:, other]) < GAP_M
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
    if places.device.type != "cpu":
        return slide_slowly(walls, places, wish, half_m, short, own)
    went, left = torch.zeros(2, len(places), 2, dtype=torch.float64)
    parts = [*arrays(walls, own.to(walls), places.double(), wish.double()), half_m, short, went.numpy(), left.numpy()]
    over_views(len(places), lambda first, last: slide_kernel(first, last, *parts))
    return went.to(wish), left.to(wish)


def slide_slowly(walls, places, wish, half_m, short, own) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `slide`, in plain tensor algebra, also for GPUs."""
    whole = torch.cat([walls.expand(len(places), -1, -1), own.to(walls)], 1).double()
    whole = F.pad(whole, (0, 0, 0, 1), value=NOWHERE)
    place, rest = places.double(), wish.double()
    free = torch.ones(len(places), 1, dtype=torch.bool, device=places.device)
    for bump in range(3):
        share, along = _first_touch(whole - place.repeat(1, 2)[:, None], rest, half_m)
        open_way, share = share[:, None] > 1, share[:, None]
        go = torch.where(open_way, 1.0, (share - short).clamp_min(0))
        place = torch.where(free, place + go * rest, place)
        onward = (1 - share.clamp_min(0)) * (rest * along).sum(1, keepdim=True) * along * float(bump < 2)
        rest, free = torch.where(free & ~open_way, onward, rest), free & ~open_way
    return (place - places.double()).to(wish), rest.to(wish)


def _first_touch(walls: torch.Tensor, move: torch.Tensor, half: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The share [B] of the move [B, 2] at which a box around the origin first touches a wall [B, S, 4] (2: none), and the
    direction [B, 2] in which it can go on: see kernels_numba/walls.first_touch."""
    a, b = walls.split(2, -1)
    length = (b - a).norm(dim=-1, keepdim=True)
    across = torch.stack([b[..., 1] - a[..., 1], a[..., 0] - b[..., 0]], -1) / length.clamp_min(1e-9)
    unit = torch.stack(
        [across.new_tensor([1.0, 0]).expand_as(across), across.new_tensor([0, 1.0]).expand_as(across), across], 2
    )
    one, other = (unit @ a[..., None])[..., 0], (unit @ b[..., None])[..., 0]  # [B, S, 3 axes]
    reach = half * unit.abs().sum(-1)
    low, high = torch.minimum(one, other) - reach, torch.maximum(one, other) + reach
    speed = (unit @ move[:, None, :, None])[..., 0]
    moves = speed.abs() >= 1e-12
    ends = torch.stack([low, high]) / torch.where(moves, speed, 1.0)
    enter, face = torch.where(moves, ends.amin(0), -1e9).max(-1)
    leave = torch.where(moves, ends.amax(0), torch.where((low >= -1e-9) | (high <= 1e-9), -1e9, 1e9)).amin(-1)
    faced = unit.gather(2, face[..., None, None].expand(*face.shape, 1, 2))[:, :, 0]
    pace = speed.gather(2, face[..., None])[..., 0].abs()
    deep = torch.minimum(enter[..., None] * speed - low, high - enter[..., None] * speed)
    crossing = (unit[..., 0] * faced[..., None, 1] - unit[..., 1] * faced[..., None, 0]).abs()
    grazes = ((crossing > 0.02) & (deep < WITHIN_M)).any(-1)
    meets = (enter < leave) & (enter <= 1) & (enter > -1e9) & (enter * pace > -WITHIN_M)
    meets &= ~grazes & (length[..., 0] >= 1e-9)
    share, which = torch.where(meets, enter, 2.0).min(1)
    met = faced.gather(1, which[:, None, None].expand(-1, 1, 2))[:, 0]
    return share, torch.stack([-met[:, 1], met[:, 0]], 1)


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
