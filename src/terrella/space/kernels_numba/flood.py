"""Flood fills of grids of cubic cells; see space/enclosure.py."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def flood(free, start):
    """Which cells are connected, face to face, with the cell `start` [3] through cells `free` bool [X, Y, Z]: bool [X, Y, Z]."""
    _, wide, tall = free.shape
    reached = np.zeros(free.shape, np.bool_)
    queue = np.empty(free.size, np.int32)
    reached[start[0], start[1], start[2]] = True
    queue[0] = (start[0] * wide + start[1]) * tall + start[2]
    first, count = 0, 1
    while first < count:
        at = queue[first]
        first += 1
        for axis in range(3):
            for way in (-1, 1):
                i, j, k = at // (wide * tall), at // tall % wide, at % tall
                if axis == 0:
                    i += way
                elif axis == 1:
                    j += way
                else:
                    k += way
                if i < 0 or j < 0 or k < 0 or i >= free.shape[0] or j >= wide or k >= tall:
                    continue
                if free[i, j, k] and not reached[i, j, k]:
                    reached[i, j, k] = True
                    queue[count] = (i * wide + j) * tall + k
                    count += 1
    return reached


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread(marked, ball):
    """Marks of cells bool [X, Y, Z] and of all cells around them, at the offsets `ball` [K, 3]: bool [X, Y, Z]."""
    whole = marked.copy()
    for i in range(marked.shape[0]):
        for j in range(marked.shape[1]):
            for k in range(marked.shape[2]):
                if not marked[i, j, k]:
                    continue
                for n in range(len(ball)):
                    a, b, c = i + ball[n, 0], j + ball[n, 1], k + ball[n, 2]
                    if (
                        a >= 0
                        and b >= 0
                        and c >= 0
                        and a < marked.shape[0]
                        and b < marked.shape[1]
                        and c < marked.shape[2]
                    ):
                        whole[a, b, c] = True
    return whole


@numba.njit(cache=True, nogil=True, error_model="numpy")
def without_islands(solid, fewest):
    """The cells `solid` bool [X, Y, Z] without groups of fewer than `fewest` that touch each other, at corners too."""
    kept, seen = solid.copy(), np.zeros(solid.shape, np.bool_)
    group = np.empty((solid.size, 3), np.int32)
    for i in range(solid.shape[0]):
        for j in range(solid.shape[1]):
            for k in range(solid.shape[2]):
                if not solid[i, j, k] or seen[i, j, k]:
                    continue
                group[0], seen[i, j, k] = (i, j, k), True
                first, count = 0, 1
                while first < count:
                    a, b, c = group[first]
                    first += 1
                    for d in range(max(a - 1, 0), min(a + 2, solid.shape[0])):
                        for e in range(max(b - 1, 0), min(b + 2, solid.shape[1])):
                            for f in range(max(c - 1, 0), min(c + 2, solid.shape[2])):
                                if solid[d, e, f] and not seen[d, e, f]:
                                    group[count], seen[d, e, f] = (d, e, f), True
                                    count += 1
                for n in range(count if count < fewest else 0):
                    kept[group[n, 0], group[n, 1], group[n, 2]] = False
    return kept


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _highest(column, first, last):
    """The highest solid cell of a column from `first` down to `last`; -1 without one."""
    for k in range(min(first, len(column) - 1), max(last, 0) - 1, -1):
        if column[k]:
            return k
    return -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def floors(solid, feet, up, down, tall, beyond):
    """Where a body on the cell `feet` [3] comes by steps to neighbouring columns, `up` cells up and `down` cells down at most: the
    cell of the floor of each column, int32 [X, Y], -1 where it does not come; and how many columns away the last that has a floor
    of its own is, int32 [X, Y], at most `beyond`: those keep its height. Above floors `tall` cells are free, but for the lowest
    `up`."""
    level = np.full(solid.shape[:2], -1, np.int32)
    away = np.zeros(solid.shape[:2], np.int32)
    waits = np.zeros(solid.shape[:2], np.bool_)  # columns that are in the queue, a ring
    queue = np.zeros((solid.shape[0] * solid.shape[1] + 1, 2), np.int32)
    i, j = feet[0], feet[1]
    k = _highest(solid[i, j], feet[2] + up, feet[2] - down)
    level[i, j], away[i, j] = (k, 0) if k >= 0 else (feet[2], 1)
    queue[0, 0], queue[0, 1], last, first = i, j, 1, 0
    while first != last:
        i, j = queue[first]
        first, waits[i, j] = (first + 1) % len(queue), False
        for axis in range(2):
            for way in (-1, 1):
                a, b = i + way * (1 - axis), j + way * axis
                if a < 0 or b < 0 or a >= solid.shape[0] or b >= solid.shape[1]:
                    continue
                k = _highest(solid[a, b], level[i, j] + up, level[i, j] - down)
                far = 0 if k >= 0 else away[i, j] + 1
                if k < 0:
                    k = level[i, j]
                if far > beyond or (level[a, b] >= 0 and away[a, b] <= far):
                    continue
                if solid[a, b, k + 1 + up : k + 1 + tall].any():
                    continue
                level[a, b], away[a, b] = k, far
                if not waits[a, b]:
                    queue[last, 0], queue[last, 1], waits[a, b] = a, b, True
                    last = (last + 1) % len(queue)
    return level, away
