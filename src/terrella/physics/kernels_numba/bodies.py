"""Bodies of one rollout at three instants, their distances and contacts; see physics/trajectory.py and physics/gaps.py.

A rollout is `row`: `at` [3, N, columns.INSTANT], `walls` and `others`, distances [3, N, W] and [3, N, N], the channels
`flat` [3, K].
A system is `s`: `body` [N, columns], `wall` [W, columns], `rod` [R, columns], `limit` [L, columns], `facts`, and `axes`."""

import math
from typing import NamedTuple

import numba
import numpy as np

from . import columns as c

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


class Solid(NamedTuple):
    """A PhysicalSystem as arrays."""

    body: np.ndarray
    wall: np.ndarray
    rod: np.ndarray  # body, pivot x y z, length, whether it alone holds a body whose velocity is in a channel
    limit: np.ndarray  # number of the channels, low, high
    facts: np.ndarray
    axes: np.ndarray  # int64 [2, 3]: of positions and of spins, -1 past the last


class RolloutRow(NamedTuple):
    """Three instants of one rollout; the last one is corrected."""

    at: np.ndarray
    walls: np.ndarray
    others: np.ndarray
    flat: np.ndarray


@compiled
def vector(values, first):
    return values[first], values[first + 1], values[first + 2]


@compiled
def put(values, first, a):
    for k in range(3):
        values[first + k] = a[k]


@compiled
def plus(a, b, times):
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


@compiled
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def norm(a):
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@compiled
def times(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@compiled
def most(one, other):
    """The larger one; NaN where one of them is."""
    return other if other > one or other != other else one


@compiled
def finite(value):
    if value != value:
        return 0.0
    return min(max(value, -1.7976931348623157e308), 1.7976931348623157e308)


@compiled
def column(values, first, k):
    """Column k of the matrix [3, 3] that begins at number `first`."""
    return values[first + k], values[first + 3 + k], values[first + 6 + k]


@compiled
def load(s, row):
    """Bodies from the channels."""
    for n in range(len(s.body)):
        body = s.body[n]
        for i in range(3):
            one, flat, here = row.at[i, n], row.flat[i], True
            for k in range(c.INSTANT):
                one[k] = 0.0
            for j in range(3):
                axis, spin = s.axes[0, j], s.axes[1, j]
                if axis >= 0:
                    one[c.P + axis] = flat[int(body[c.AT_P]) + j]
                    here &= math.isfinite(one[c.P + axis])
                    if body[c.AT_V] >= 0:
                        one[c.V + axis] = flat[int(body[c.AT_V]) + j]
                if spin >= 0 and body[c.AT_S] >= 0:
                    one[c.S + spin] = finite(flat[int(body[c.AT_S]) + j])
            one[c.Q] = 1.0
            if body[c.AT_Q] >= 0:
                length = 0.0
                for k in range(4):
                    one[c.Q + k] = flat[int(body[c.AT_Q]) + k]
                    length += one[c.Q + k] ** 2
                for k in range(4):
                    one[c.Q + k] /= max(math.sqrt(length), 1e-9)
            if body[c.AT_HERE] >= 0:
                here &= flat[int(body[c.AT_HERE])] != 0
            one[c.HERE] = here
            one[c.RADIUS] = body[c.GIVEN_RADIUS] if body[c.AT_RADIUS] < 0 else flat[int(body[c.AT_RADIUS])]
        if body[c.AT_V] < 0:
            differences(s, row, n)
        for i in range(3):
            for k in range(c.P, c.Q):
                row.at[i, n, k] = finite(row.at[i, n, k])


@compiled
def differences(s, row, n):
    """Velocities from positions: the mean of a step, and what gravity adds from its middle to its end unless it rests."""
    gravity, dt_s, weight = vector(s.facts, c.GRAVITY), s.facts[c.DT], s.facts[c.WEIGHT]
    ways = (
        plus(vector(row.at[1, n], c.P), vector(row.at[0, n], c.P), -1.0),
        plus(vector(row.at[2, n], c.P), vector(row.at[1, n], c.P), -1.0),
    )
    rests = True
    for way in ways:
        rests &= abs(dot(way, gravity)) < 0.25 * weight * weight * dt_s * dt_s
    flies = not rests and s.body[n, c.DRIVEN] == 0 and s.body[n, c.TIED] == 0
    gained = times(gravity, 0.5 * dt_s if flies else 0.0)
    for i in range(3):
        mean = times(ways[max(i - 1, 0)], 1 / dt_s)
        put(row.at[i, n], c.V, plus(mean, gained, -1.0 if i == 0 else 1.0))


@compiled
def measure(s, row, i):
    """Sizes, masses and distances at instant i."""
    for n in range(len(s.body)):
        one, body = row.at[i, n], s.body[n]
        radius = one[c.RADIUS]
        one[c.SIZE] = max(radius + body[c.THIN], 1e-6)
        solid = body[c.DENSITY] == body[c.DENSITY]
        one[c.MASS] = body[c.DENSITY] * 4 / 3 * math.pi * radius**3 if solid else body[c.GIVEN_MASS]
        for k in range(3):
            given = body[c.GIVEN_INERTIA + k]
            one[c.INERTIA + k] = given if given == given else 0.4 * one[c.MASS] * one[c.SIZE] ** 2
        if body[c.REACH_M] > 0:
            turned(one)
    for n in range(len(s.body)):
        for w in range(len(s.wall)):
            row.walls[i, n, w] = wall_gap(s, row.at[i, n], n, w)
        row.others[i, n, n] = math.inf
        for m in range(n + 1, len(s.body)):
            both = row.at[i, n, c.HERE] > 0 and row.at[i, m, c.HERE] > 0
            row.others[i, n, m] = body_gap(s, row.at[i, n], row.at[i, m], n, m) if both else math.inf
            row.others[i, m, n] = row.others[i, n, m]


@compiled
def turned(one):
    """Writes the rotation matrix of the quaternion."""
    w, x, y, z = one[c.Q], one[c.Q + 1], one[c.Q + 2], one[c.Q + 3]
    one[c.TURN], one[c.TURN + 1], one[c.TURN + 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    one[c.TURN + 3], one[c.TURN + 4], one[c.TURN + 5] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    one[c.TURN + 6], one[c.TURN + 7], one[c.TURN + 8] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@compiled
def width(matrix, first, half, at, axis):
    """Half the width along a unit axis of a box with half extents half[at:at + 3] and axes in a matrix."""
    total = 0.0
    for k in range(3):
        if half[at + k] > 0:
            total += abs(dot(column(matrix, first, k), axis)) * half[at + k]
    return total


@compiled
def wall_gap(s, one, n, w):
    wall, body = s.wall[w], s.body[n]
    place, reach = vector(one, c.P), body[c.REACH_M]
    if wall[c.PLANE] > 0:
        normal = vector(wall, c.NORMAL)
        gap = dot(place, normal) - wall[c.HEIGHT] - one[c.RADIUS]
        return gap - width(one, c.TURN, body, c.HALF, normal) if reach > 0 else gap
    apart = plus(vector(wall, c.CENTRE), place, -1.0)
    gap = point_gap(times(apart, -1.0), wall, c.FIXED, wall, c.EXTENT) - reach
    if reach > 0 and gap < reach:
        gap = separation(apart, (one, c.TURN, body, c.HALF), (wall, c.FIXED, wall, c.EXTENT))
    return gap - one[c.RADIUS]


@compiled
def body_gap(s, one, other, n, m):
    mine, theirs = s.body[n], s.body[m]
    apart = plus(vector(other, c.P), vector(one, c.P), -1.0)
    reach = mine[c.REACH_M] + theirs[c.REACH_M]
    gap = norm(apart) - reach
    if gap < reach:  # spheres, without half extents, are exact already
        if theirs[c.REACH_M] == 0:
            gap = point_gap(apart, one, c.TURN, mine, c.HALF)
        elif mine[c.REACH_M] == 0:
            gap = point_gap(times(apart, -1.0), other, c.TURN, theirs, c.HALF)
        else:
            gap = separation(apart, (one, c.TURN, mine, c.HALF), (other, c.TURN, theirs, c.HALF))
    return gap - one[c.RADIUS] - other[c.RADIUS]


@compiled
def point_gap(apart, matrix, first, half, at):
    """The distance of a point from a box around the origin, below 0 inside."""
    outside, inside = 0.0, -math.inf
    for k in range(3):
        local = abs(dot(column(matrix, first, k), apart)) - half[at + k]
        outside += max(local, 0.0) ** 2
        inside = max(inside, local)
    return math.sqrt(outside) + min(inside, 0.0)


@compiled
def nearest(apart, box):
    """The vector from the nearest point of a box at `apart` to the origin."""
    matrix, first, half, at = box
    left = (0.0, 0.0, 0.0)
    for k in range(3):
        axis = column(matrix, first, k)
        local = -dot(axis, apart)
        left = plus(left, axis, local - min(max(local, -half[at + k]), half[at + k]))
    return left


@compiled
def gap_along(axis, apart, one, other):
    length = norm(axis)
    if not length > 1e-6:
        return -math.inf
    unit = times(axis, 1 / length)
    return (
        abs(dot(apart, unit))
        - width(one[0], one[1], one[2], one[3], unit)
        - width(other[0], other[1], other[2], other[3], unit)
    )


@compiled
def separation(apart, one, other):
    """The largest gap over the separating axes of two boxes (matrix, its first number, half extents, their first number)."""
    best = max(
        gap_along(nearest(apart, other), apart, one, other),
        gap_along(nearest(times(apart, -1.0), one), apart, one, other),
    )
    for j in range(3):
        b = column(other[0], other[1], j)
        best = max(best, gap_along(column(one[0], one[1], j), apart, one, other))
        best = max(best, gap_along(b, apart, one, other))
        for i in range(3):
            a = column(one[0], one[1], i)
            cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
            best = max(best, gap_along(cross, apart, one, other))
    return best


@compiled
def contacts(s, row, k):
    """Writes what each body may have touched in the step from instant k."""
    facts = s.facts
    for n in range(len(s.body)):
        one, other = row.at[k, n], row.at[k + 1, n]
        speed = max(norm(vector(one, c.V)), norm(vector(other, c.V)))
        skin = facts[c.SKIN] * max(one[c.SIZE], other[c.SIZE])
        other[c.WAY] = facts[c.REACH] * facts[c.DT] * speed + 0.5 * facts[c.WEIGHT] * facts[c.DT] ** 2 + skin
    for n in range(len(s.body)):
        one = row.at[k + 1, n]
        one[c.WALLS], one[c.BODIES] = 0, 0
        for w in range(len(s.wall)):
            one[c.WALLS] += meets_wall(row, k, n, w)
        for m in range(len(s.body)):
            one[c.BODIES] += meets_body(row, k, n, m)


@compiled
def meets_wall(row, k, n, w):
    before, after = row.walls[k, n, w], row.walls[k + 1, n, w]
    return before + after < row.at[k + 1, n, c.WAY] or min(before, after) < 0


@compiled
def meets_body(row, k, n, m):
    before, after = row.others[k, n, m], row.others[k + 1, n, m]
    return before + after < row.at[k + 1, n, c.WAY] + row.at[k + 1, m, c.WAY] or min(before, after) < 0


@compiled
def touches(row, k, n):
    """Whether a body may have touched something in the step from instant k."""
    return row.at[k + 1, n, c.WALLS] + row.at[k + 1, n, c.BODIES] > 0


@compiled
def stays(row, k, n):
    """Whether a body is there before and after the step."""
    return row.at[k, n, c.HERE] > 0 and row.at[k + 1, n, c.HERE] > 0


@compiled
def clear(s, row, k, n, fresh):
    """Whether nothing but gravity acts on a body in the step from instant k. fresh: the last step alone counts."""
    if s.body[n, c.DRIVEN] > 0 or s.body[n, c.TIED] > 0 or not stays(row, k, n):
        return False
    beside = s.facts[c.TRACKED] > 0 and not fresh and touches(row, 1 - k, n)
    return not touches(row, k, n) and not beside


@compiled
def left_alone(s, row, k):
    """Whether no driven body may have touched another one within the step."""
    for n in range(len(s.body)):
        for m in range(len(s.body)):
            if s.body[n, c.DRIVEN] > 0 and s.body[m, c.DRIVEN] == 0 and meets_body(row, k, n, m):
                return False
    return True
