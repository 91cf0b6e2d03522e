"""The floor plan that depth images draw: straight walls at eye height, and how a body slides along them.

World frame, metres; a body is an upright box with sides along x and y, as in Doom and Quake.
"""

from __future__ import annotations

from itertools import islice

import numpy as np
import torch

from .camera import Intrinsics, unproject, yaw

Box = tuple[float, float, float, float]  # x0, y0, x1, y1 on the map

WALLS = 16  # of a keyframe that are kept at most, those seen by most columns
NOWHERE = 1e6  # where the unused ones are
FEWEST = 4  # columns that make a wall; of a far one more are needed, for its ends are uncertain
NEARBY_M, FEWEST_FAR = 4.0, 12
SEEN_M = 50.0  # beyond it depth says "nothing there" as often as "a wall"
STRAIGHT = 0.004  # 1 / depth along a wall is a straight line, up to this share
GAP_M = 0.5  # columns farther apart do not join: no body fits through less


def wall_segments(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """Depth [K, h, w] (0: nothing known) from level poses [K, 7] -> walls [K, WALLS, 4] = x1, y1, x2, y2.

    On the horizon the inverse depth of a flat wall is linear in the column; each run of columns on one line is a wall,
    and where two runs meet they are drawn to their corner. What is farther than SEEN_M, or so far that neighbouring columns
    lie half a metre apart (32 m for a wall seen head-on by 128 columns over 90 degrees), is left for a nearer look.
    """
    from .kernels_numba import straight_runs

    there, depth, pose = depth.device, depth.cpu(), pose.cpu()
    width, row = depth.shape[-1], horizon(camera, depth.shape[-2])
    left = -((np.arange(width) + 0.5) / width - camera[2]) / camera[0]
    walls = np.full((len(depth), WALLS, 4), NOWHERE, np.float32)
    heading = yaw(pose).double().numpy()
    cosine, sine, eye = np.cos(heading), np.sin(heading), pose[:, :2].double().numpy()
    level = torch.where(depth[:, row] > 0, depth[:, row], 1e3).double()
    for key, inverse in enumerate(1 / level.clamp(0.05, 1e3).numpy()):
        found = straight_runs(inverse, left, FEWEST, STRAIGHT, GAP_M, 1 / SEEN_M)
        runs = _corners([(int(first), int(stop), *line) for first, stop, *line in found], left)
        runs.sort(key=lambda run: run[0] - run[1])
        known = (run for run in runs if run[1] - run[0] >= FEWEST_FAR or 1 / inverse[run[0] : run[1]].mean() < NEARBY_M)
        for slot, (_, _, slope, level, *ends) in enumerate(islice(known, WALLS)):
            for end, side in enumerate(ends):
                ahead = 1 / (slope * side + level)
                x, y = ahead * cosine[key] - ahead * side * sine[key], ahead * sine[key] + ahead * side * cosine[key]
                walls[key, slot, 2 * end : 2 * end + 2] = eye[key] + (x, y)
    return torch.from_numpy(walls).to(there)


def _corners(runs: list[tuple], left: np.ndarray) -> list[tuple]:
    """The runs with both their ends: their outer columns, or the corner with the neighbour that they run into."""
    ends = [[float(left[first]), float(left[stop - 1])] for first, stop, *_ in runs]
    for number, (one, other) in enumerate(zip(runs, runs[1:])):
        if other[0] - one[1] > 2 or one[2] == other[2]:
            continue
        corner = (other[3] - one[3]) / (one[2] - other[2])
        near = left[min(other[0] + 1, len(left) - 1)] <= corner <= left[one[1] - 2]
        if near and all(
            _apart(corner, float(left[column]), run) < GAP_M for run, column in ((one, one[1] - 1), (other, other[0]))
        ):
            ends[number][1] = ends[number + 1][0] = corner
    return [(*run, *pair) for run, pair in zip(runs, ends)]


def _apart(one: float, other: float, run: tuple) -> float:
    """Metres between two columns of a run."""
    near, far = 1 / (run[2] * one + run[3]), 1 / (run[2] * other + run[3])
    return float(np.hypot(near - far, near * one - far * other))


def floor_plan(walls: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """The walls [K, n, 4] that keyframes at `pose` [K, 7] saw, brought into agreement: [S, 4].

    Each is laid on the mean line of all that lie on one line with it, the longer and nearer ones counting more, and ends
    where that crosses another wall, if it ended within 4 cm of it. From millimetres off, walls come to tenths of one.
    """
    real = walls[..., 0] < NOWHERE
    eye = pose[:, None, :2].expand(-1, walls.shape[1], -1)[real].double()
    start, end = walls[real].double().split(2, -1)
    long = (end - start).norm(dim=1) > 0.02
    if not long.any():
        return torch.zeros(0, 4)
    start, end, eye = start[long], end[long], eye[long]
    away = ((start + end) / 2 - eye).norm(dim=1).clamp_min(0.5)
    weight = (end - start).norm(dim=1) / away**2
    for _ in range(2):
        parts = [_mean_line(start[some], end[some], start, end, weight) for some in torch.arange(len(start)).split(512)]
        start, end = (torch.cat(halves) for halves in zip(*parts))
    parts = [_ended(start[some], end[some], start, end) for some in torch.arange(len(start)).split(512)]
    return torch.cat(parts).float()


def _mean_line(start, end, all_starts, all_ends, weight) -> tuple[torch.Tensor, torch.Tensor]:
    """Walls [n, 2] each laid on the weighted mean line of those [N, 2] that are within 3 cm and 1 degree of its own, and
    not more than 6 m away along it."""
    length, along, across, middle = _frame(start, end)
    others_length, others_along, _, others_middle = _frame(all_starts, all_ends)
    apart = others_middle - middle[:, None]
    off = (apart * across[:, None]).sum(-1)
    gap = (apart * along[:, None]).sum(-1).abs() - (length[:, None] + others_length) / 2
    sine, cosine = across @ others_along.T, along @ others_along.T
    share = weight * ((sine.abs() < 0.02) & (off.abs() < 0.03) & (gap < 6.0))
    turn = share * others_length**2  # a long wall knows its direction better
    turned = along + across * ((turn * sine * cosine.sign()).sum(1) / turn.sum(1))[:, None]
    turned = turned / turned.norm(dim=1, keepdim=True)
    middle = middle + across * ((share * off).sum(1) / share.sum(1))[:, None]
    return tuple(middle + turned * ((point - middle) * turned).sum(1, keepdim=True) for point in (start, end))


def _ended(start, end, all_starts, all_ends, reach_m: float = 0.04) -> torch.Tensor:
    """Walls [n, 2] with their ends moved to the nearest crossing with one of the walls [N, 2] not more than 4 cm off."""
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
    """Of walls [n, 2]: length [n], unit direction [n, 2], unit normal [n, 2] and middle [n, 2]."""
    length = (end - start).norm(dim=1)
    along = (end - start) / length[:, None]
    return length, along, torch.stack([-along[:, 1], along[:, 0]], 1), (start + end) / 2


def slide(
    walls: torch.Tensor,
    places: torch.Tensor,
    wish: torch.Tensor,
    half_m: float,
    short: float = 0.0,
    own: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How bodies of half width `half_m` at `places` [N, 2] move when they wish to by `wish` [N, 2], among walls [S, 4] that
    stop all of them and `own` [N, W, 4] that stop one each (those that are NOWHERE stop none).

    At a wall the rest of the wish goes on along it, twice at most; `short` is the share of the wish by which a body
    stops short of the wall. Returns the displacement [N, 2] and what is left of the wish, the momentum [N, 2].
    """
    from .kernels_numba import slide as kernel

    own = walls.new_zeros(len(places), 0, 4) if own is None else own
    parts = [tensor.detach().cpu().double().contiguous().numpy() for tensor in (walls, own, places, wish)]
    moved, left = np.zeros_like(parts[2]), np.zeros_like(parts[2])
    kernel(*parts, half_m, short, moved, left)
    return torch.from_numpy(moved).to(wish), torch.from_numpy(left).to(wish)


def horizon(camera: Intrinsics, height: int) -> int:
    """The row of an image of `height` rows that looks level."""
    return min(int(camera[3] * height), height - 1)


def sees_into(
    box: Box, level: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, deep_m: float = 0.5
) -> torch.Tensor:
    """Whether posed depth images, of which `level` [K, w] is the row of the horizon, show what lies in the box on the map
    and more than `deep_m` metres from its sides: bool [K]; pose [K, 7]."""
    x0, y0, x1, y1 = box
    flat = (camera[0], camera[1], camera[2], 0.5)  # of a picture of that row alone
    x, y = unproject(level[:, None], pose, flat)[:, 0, :, :2].unbind(-1)
    inside = (x > x0 + deep_m) & (x < x1 - deep_m) & (y > y0 + deep_m) & (y < y1 - deep_m)
    return inside.any(1)
