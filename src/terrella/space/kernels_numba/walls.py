"""Walls: straight runs of columns, and a body that slides along what they draw (floorplan.py)."""

import math

import numba
import numpy as np

WITHIN_M = 0.005  # as well as walls are known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def straight_runs(inverse, runs, left, fewest, straight, gap, least):
    """The kernel of floorplan.straight_runs_slowly for one row: fills runs [n, 4] = first, stop, slope, level of columns whose
    inverse depth [w] is linear in `left` [w], with neighbours less than `gap` metres apart and no inverse depth below `least`."""
    count, first = 0, 0
    while first < len(inverse):
        stop = first + 1
        while stop < len(inverse):
            step = math.hypot(
                1 / inverse[stop] - 1 / inverse[stop - 1],
                left[stop] / inverse[stop] - left[stop - 1] / inverse[stop - 1],
            )
            if step > gap or inverse[stop - 1] < least or inverse[stop] < least:
                break
            x, y = left[first : stop + 1], inverse[first : stop + 1]
            middle, mean = x.mean(), y.mean()
            slope = ((x - middle) * (y - mean)).sum() / ((x - middle) ** 2).sum()
            if np.abs(slope * (x - middle) + mean - y).max() > straight * y.max():
                break
            stop += 1
            if stop - first >= fewest:
                runs[count, 0], runs[count, 1], runs[count, 2] = first, stop, slope
                runs[count, 3] = mean - slope * middle
        if stop - first >= fewest:
            count += 1
            first = stop
        else:
            first += 1
    runs[count:] = 0  # what was begun after the last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def slide(first, last, walls, own, places, wish, half, short, shift, left):
    """The kernel of floorplan.slide: walls [S, 4] of all, own [B, n, 4], places and wish [B, 2]; fills shift and left [B, 2]."""
    close = np.empty((len(walls) + own.shape[1], 4))
    for n in range(first, last):
        x, y, mx, my = places[n, 0], places[n, 1], wish[n, 0], wish[n, 1]
        reach = half + abs(mx) + abs(my)
        near = gather_near(walls, x, y, reach, close, 0)
        near = gather_near(own[n], x, y, reach, close, near)
        for bump in range(3):
            share, along_x, along_y = first_touch(close[:near], x, y, mx, my, half)
            if share > 1:
                x, y = x + mx, y + my
                break
            go = max(share - short, 0.0)
            x, y = x + go * mx, y + go * my
            rest = (1 - max(share, 0.0)) * (mx * along_x + my * along_y) if bump < 2 else 0.0
            mx, my = rest * along_x, rest * along_y
        shift[n, 0], shift[n, 1], left[n, 0], left[n, 1] = x - places[n, 0], y - places[n, 1], mx, my


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather_near(walls, x, y, reach, close, count):
    """Writes those of `walls` [S, 4] that come into the square of half width `reach` around x, y to `close` from row `count` on;
    how many rows that has then."""
    for s in range(len(walls)):
        ax, ay, bx, by = walls[s, 0] - x, walls[s, 1] - y, walls[s, 2] - x, walls[s, 3] - y
        if min(ax, bx) < reach and max(ax, bx) > -reach and min(ay, by) < reach and max(ay, by) > -reach:
            close[count] = walls[s]
            count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_touch(walls, x, y, mx, my, half):
    """The share of the move mx, my at which a box around x, y first touches one of `walls` [S, 4] (2: none), by separating axes,
    and the direction in which it can go on. A wall in which the box already is deeper than WITHIN_M, or that it only grazes, is
    ignored."""
    best, along_x, along_y = 2.0, 0.0, 0.0
    unit = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    low, high, speed = np.empty(3), np.empty(3), np.empty(3)
    for s in range(len(walls)):
        ax, ay, bx, by = walls[s, 0] - x, walls[s, 1] - y, walls[s, 2] - x, walls[s, 3] - y
        length = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
        if length < 1e-9:
            continue
        unit[2, 0], unit[2, 1] = (by - ay) / length, (ax - bx) / length
        enter, leave, face = -1e9, 1e9, -1
        for axis in range(3):
            ux, uy = unit[axis, 0], unit[axis, 1]
            one, other, reach = ux * ax + uy * ay, ux * bx + uy * by, half * (abs(ux) + abs(uy))
            low[axis], high[axis], speed[axis] = min(one, other) - reach, max(one, other) + reach, ux * mx + uy * my
            if abs(speed[axis]) < 1e-12:
                if low[axis] >= -1e-9 or high[axis] <= 1e-9:
                    leave = -1e9
                continue
            ends = low[axis] / speed[axis], high[axis] / speed[axis]
            if min(ends) > enter:
                enter, face = min(ends), axis
            leave = min(leave, max(ends))
        if enter >= min(leave, best) or enter > 1 or face < 0 or enter * abs(speed[face]) <= -WITHIN_M:
            continue
        grazes = False
        for axis in range(3):  # how deep the box is in the wall, seen along the other axes, where it meets it
            across = abs(unit[axis, 0] * unit[face, 1] - unit[axis, 1] * unit[face, 0])
            deep = min(enter * speed[axis] - low[axis], high[axis] - enter * speed[axis])
            grazes = grazes or (across > 0.02 and deep < WITHIN_M)
        if not grazes:
            best, along_x, along_y = enter, -unit[face, 1], unit[face, 0]
    return best, along_x, along_y
