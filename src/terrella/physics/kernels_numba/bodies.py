"""Bodies of one rollout at three instants, their distances and contacts; see physics/trajectory.py and physics/gaps.py.

Two matrices hold all, since each array that a kernel passes on costs time. `s`, the system: row 0 has its facts, then come
bodies, walls, rods and limits, one a row. `r`, the rollout: one body at one instant a row (`at`), the last of three instants
being corrected, and a fourth one, the last as predicted; then the channels at the three instants. columns.py names the columns."""

import math

import numba

from . import columns as c

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@compiled
def count_of(s):
    return int(s[0, c.BODY_COUNT])


@compiled
def wall_at(s, w):
    """The row of a wall."""
    return 1 + count_of(s) + w


@compiled
def rod_at(s, k):
    """The row of a rod."""
    return wall_at(s, int(s[0, c.WALL_COUNT])) + k


@compiled
def limit_at(s, k):
    """The row of a limit."""
    return rod_at(s, int(s[0, c.ROD_COUNT])) + k


@compiled
def at(s, i, n):
    """The row of body n at instant i."""
    return i * count_of(s) + n


@compiled
def flat_at(s, i):
    """The row of the channels at instant i."""
    return 4 * count_of(s) + i


@compiled
def others(s, m):
    """The column of the distance to body m."""
    return c.INSTANT + int(s[0, c.WALL_COUNT]) + m


@compiled
def vector(values, row, first):
    return values[row, first], values[row, first + 1], values[row, first + 2]


@compiled
def put(values, row, first, a):
    for k in range(3):
        values[row, first + k] = a[k]


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
    return value if math.isfinite(value) else 0.0


@compiled
def column(values, row, first, k):
    """Column k of the matrix [3, 3] that begins at number `first` of a row."""
    return values[row, first + k], values[row, first + 3 + k], values[row, first + 6 + k]


@compiled
def load(s, r):
    """Bodies from the channels."""
    for n in range(count_of(s)):
        body = 1 + n
        for i in range(3):
            one, flat, here = at(s, i, n), flat_at(s, i), True
            for k in range(c.INSTANT):
                r[one, k] = 0.0
            for j in range(3):
                axis, spin = int(s[0, c.AXES + j]), int(s[0, c.SPIN_AXES + j])
                if axis >= 0:
                    r[one, c.P + axis] = r[flat, int(s[body, c.AT_P]) + j]
                    here &= math.isfinite(r[one, c.P + axis])
                    if s[body, c.AT_V] >= 0:
                        r[one, c.V + axis] = r[flat, int(s[body, c.AT_V]) + j]
                        here &= math.isfinite(r[one, c.V + axis])
                if spin >= 0 and s[body, c.AT_S] >= 0:
                    r[one, c.S + spin] = r[flat, int(s[body, c.AT_S]) + j]
                    here &= math.isfinite(r[one, c.S + spin])
            here &= load_rotation(s, r, body, one, flat)
            r[one, c.RADIUS] = s[body, c.GIVEN_RADIUS]
            if s[body, c.AT_RADIUS] >= 0:
                r[one, c.RADIUS] = r[flat, int(s[body, c.AT_RADIUS])]
                here &= math.isfinite(r[one, c.RADIUS])
            if s[body, c.AT_HERE] >= 0:
                here &= r[flat, int(s[body, c.AT_HERE])] != 0
            r[one, c.HERE] = here
        if s[body, c.AT_V] < 0:
            differences(s, r, n)
        for i in range(3):
            for k in range(c.P, c.MASS):
                r[at(s, i, n), k] = finite(r[at(s, i, n), k])


@compiled
def load_rotation(s, r, body, one, flat):
    """Writes the unit quaternion of a body; whether its numbers are finite. Without, or where they are not, it is upright."""
    length = 0.0
    if s[body, c.AT_Q] >= 0:
        for k in range(4):
            r[one, c.Q + k] = r[flat, int(s[body, c.AT_Q]) + k]
            length += r[one, c.Q + k] ** 2
    known = math.isfinite(length)
    for k in range(4):
        if s[body, c.AT_Q] >= 0 and known:
            r[one, c.Q + k] /= max(math.sqrt(length), 1e-9)
        else:
            r[one, c.Q + k] = 1.0 if k == 0 else 0.0
    return known


@compiled
def differences(s, r, n):
    """Velocities from positions: the mean of a step, and what gravity adds from its middle to its end unless it rests."""
    gravity, dt_s, weight = vector(s, 0, c.GRAVITY), s[0, c.DT], s[0, c.WEIGHT]
    ways = (
        plus(vector(r, at(s, 1, n), c.P), vector(r, at(s, 0, n), c.P), -1.0),
        plus(vector(r, at(s, 2, n), c.P), vector(r, at(s, 1, n), c.P), -1.0),
    )
    rests = True
    for way in ways:
        rests &= abs(dot(way, gravity)) < 0.25 * weight * weight * dt_s * dt_s
    flies = not rests and s[1 + n, c.DRIVEN] == 0 and s[1 + n, c.TIED] == 0
    gained = times(gravity, 0.5 * dt_s if flies else 0.0)
    for i in range(3):
        mean = times(ways[max(i - 1, 0)], 1 / dt_s)
        put(r, at(s, i, n), c.V, plus(mean, gained, -1.0 if i == 0 else 1.0))


@compiled
def measure(s, r, i):
    """Sizes, masses and distances at instant i."""
    for n in range(count_of(s)):
        one, body = at(s, i, n), 1 + n
        radius = r[one, c.RADIUS]
        r[one, c.SIZE] = max(radius + s[body, c.THIN], 1e-6)
        solid = s[body, c.DENSITY] == s[body, c.DENSITY]
        r[one, c.MASS] = s[body, c.DENSITY] * 4 / 3 * math.pi * radius**3 if solid else s[body, c.GIVEN_MASS]
        for k in range(3):
            given = s[body, c.GIVEN_INERTIA + k]
            r[one, c.INERTIA + k] = given if given == given else 0.4 * r[one, c.MASS] * r[one, c.SIZE] ** 2
        if s[body, c.REACH_M] > 0:
            turn(r, one)
    for n in range(count_of(s)):
        for w in range(int(s[0, c.WALL_COUNT])):
            r[at(s, i, n), c.INSTANT + w] = wall_gap(s, r, at(s, i, n), n, w)
        r[at(s, i, n), others(s, n)] = math.inf
        for m in range(n + 1, count_of(s)):
            both = r[at(s, i, n), c.HERE] > 0 and r[at(s, i, m), c.HERE] > 0
            r[at(s, i, n), others(s, m)] = body_gap(s, r, at(s, i, n), at(s, i, m), n, m) if both else math.inf
            r[at(s, i, m), others(s, n)] = r[at(s, i, n), others(s, m)]


@compiled
def turn(r, one):
    """Writes the rotation matrix of the quaternion."""
    w, x, y, z = r[one, c.Q], r[one, c.Q + 1], r[one, c.Q + 2], r[one, c.Q + 3]
    r[one, c.TURN], r[one, c.TURN + 1], r[one, c.TURN + 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    r[one, c.TURN + 3], r[one, c.TURN + 4], r[one, c.TURN + 5] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    r[one, c.TURN + 6], r[one, c.TURN + 7], r[one, c.TURN + 8] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@compiled
def width(box, axis):
    """Half the width along a unit axis of a box: the array, row and first column of its rotation, then of its half extents."""
    turns, row, first, halves, mine, start = box
    total = 0.0
    for k in range(3):
        if halves[mine, start + k] > 0:
            total += abs(dot(column(turns, row, first, k), axis)) * halves[mine, start + k]
    return total


@compiled
def wall_gap(s, r, one, n, w):
    wall, body = wall_at(s, w), 1 + n
    place, reach = vector(r, one, c.P), s[body, c.REACH_M]
    if s[wall, c.PLANE] > 0:
        normal = vector(s, wall, c.NORMAL)
        gap = dot(place, normal) - s[wall, c.HEIGHT] - r[one, c.RADIUS]
        return gap - width((r, one, c.TURN, s, body, c.HALF), normal) if reach > 0 else gap
    apart = plus(vector(s, wall, c.CENTRE), place, -1.0)
    gap = point_gap(times(apart, -1.0), (s, wall, c.FIXED, s, wall, c.EXTENT)) - reach
    if reach > 0 and gap < reach:
        gap = separation(apart, (r, one, c.TURN, s, body, c.HALF), (s, wall, c.FIXED, s, wall, c.EXTENT))
    return gap - r[one, c.RADIUS]


@compiled
def body_gap(s, r, one, other, n, m):
    mine, theirs = 1 + n, 1 + m
    apart = plus(vector(r, other, c.P), vector(r, one, c.P), -1.0)
    reach = s[mine, c.REACH_M] + s[theirs, c.REACH_M]
    gap = norm(apart) - reach
    if gap < reach:  # spheres, without half extents, are exact already
        if s[theirs, c.REACH_M] == 0:
            gap = point_gap(apart, (r, one, c.TURN, s, mine, c.HALF))
        elif s[mine, c.REACH_M] == 0:
            gap = point_gap(times(apart, -1.0), (r, other, c.TURN, s, theirs, c.HALF))
        else:
            gap = separation(apart, (r, one, c.TURN, s, mine, c.HALF), (r, other, c.TURN, s, theirs, c.HALF))
    return gap - r[one, c.RADIUS] - r[other, c.RADIUS]


@compiled
def point_gap(apart, box):
    """The distance of a point from a box around the origin, below 0 inside."""
    turns, row, first, halves, mine, start = box
    outside, inside = 0.0, -math.inf
    for k in range(3):
        local = abs(dot(column(turns, row, first, k), apart)) - halves[mine, start + k]
        outside += max(local, 0.0) ** 2
        inside = max(inside, local)
    return math.sqrt(outside) + min(inside, 0.0)


@compiled
def nearest(apart, box):
    """The vector from the nearest point of a box at `apart` to the origin."""
    turns, row, first, halves, mine, start = box
    left = (0.0, 0.0, 0.0)
    for k in range(3):
        axis, half = column(turns, row, first, k), halves[mine, start + k]
        local = -dot(axis, apart)
        left = plus(left, axis, local - min(max(local, -half), half))
    return left


@compiled
def gap_along(axis, apart, one, other):
    length = norm(axis)
    if not length > 1e-6:
        return -math.inf
    unit = times(axis, 1 / length)
    return abs(dot(apart, unit)) - width(one, unit) - width(other, unit)


@compiled
def separation(apart, one, other):
    """The largest gap over the separating axes of two boxes."""
    best = max(
        gap_along(nearest(apart, other), apart, one, other),
        gap_along(nearest(times(apart, -1.0), one), apart, one, other),
    )
    for j in range(3):
        b = column(other[0], other[1], other[2], j)
        best = max(best, gap_along(column(one[0], one[1], one[2], j), apart, one, other))
        best = max(best, gap_along(b, apart, one, other))
        for i in range(3):
            a = column(one[0], one[1], one[2], i)
            cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
            best = max(best, gap_along(cross, apart, one, other))
    return best


@compiled
def contacts(s, r, k):
    """Writes what each body may have touched in the step from instant k."""
    for n in range(count_of(s)):
        one, other = at(s, k, n), at(s, k + 1, n)
        speed = max(norm(vector(r, one, c.V)), norm(vector(r, other, c.V)))
        skin = s[0, c.SKIN] * max(r[one, c.SIZE], r[other, c.SIZE])
        r[other, c.WAY] = s[0, c.REACH] * s[0, c.DT] * speed + 0.5 * s[0, c.WEIGHT] * s[0, c.DT] ** 2 + skin
    for n in range(count_of(s)):
        one = at(s, k + 1, n)
        r[one, c.WALLS], r[one, c.BODIES] = 0, 0
        for w in range(int(s[0, c.WALL_COUNT])):
            r[one, c.WALLS] += meets_wall(s, r, k, n, w)
        for m in range(count_of(s)):
            r[one, c.BODIES] += meets_body(s, r, k, n, m)


@compiled
def meets_wall(s, r, k, n, w):
    before, after = r[at(s, k, n), c.INSTANT + w], r[at(s, k + 1, n), c.INSTANT + w]
    return before + after < r[at(s, k + 1, n), c.WAY] or min(before, after) < 0


@compiled
def meets_body(s, r, k, n, m):
    before, after = r[at(s, k, n), others(s, m)], r[at(s, k + 1, n), others(s, m)]
    return before + after < r[at(s, k + 1, n), c.WAY] + r[at(s, k + 1, m), c.WAY] or min(before, after) < 0


@compiled
def touches(s, r, k, n):
    """Whether a body may have touched something in the step from instant k."""
    return r[at(s, k + 1, n), c.WALLS] + r[at(s, k + 1, n), c.BODIES] > 0


@compiled
def stays(s, r, k, n):
    """Whether a body is there before and after the step."""
    return r[at(s, k, n), c.HERE] > 0 and r[at(s, k + 1, n), c.HERE] > 0


@compiled
def clear(s, r, k, n, fresh):
    """Whether nothing but gravity acts on a body in the step from instant k. fresh: the last step alone counts."""
    if s[1 + n, c.DRIVEN] > 0 or s[1 + n, c.TIED] > 0 or not stays(s, r, k, n):
        return False
    beside = s[0, c.TRACKED] > 0 and not fresh and touches(s, r, 1 - k, n)
    return not touches(s, r, k, n) and not beside


@compiled
def left_alone(s, r, k):
    """Whether no driven body may have touched another one within the step."""
    for n in range(count_of(s)):
        for m in range(count_of(s)):
            if s[1 + n, c.DRIVEN] > 0 and s[1 + m, c.DRIVEN] == 0 and meets_body(s, r, k, n, m):
                return False
    return True
