"""The laws of limits, energy, continuity and overlap over the last step of one rollout, as in motion_laws.py."""

import math

import numpy as np

from . import columns as c
from .bodies import (
    at,
    clear,
    column,
    compiled,
    count_of,
    dot,
    flat_at,
    left_alone,
    limit_at,
    measure,
    most,
    norm,
    others,
    plus,
    put,
    rod_at,
    stays,
    times,
    vector,
    wall_at,
)
from .motion_laws import change_of

PUSHES = 3  # as in the law


# -- limits -----------------------------------------------------------------------------------------------------------


@compiled
def limits(s, r, fresh):
    worst = 0.0
    for k in range(int(s[0, c.LIMIT_COUNT])):
        one = limit_at(s, k)
        value, low, high = r[flat_at(s, 2), int(s[one, c.NUMBER])], s[one, c.LEAST], s[one, c.MOST]
        worst = most(worst, most(low - value, value - high) / (high - low))
    for k in range(int(s[0, c.ROD_COUNT])):
        rod = rod_at(s, k)
        length = norm(plus(vector(r, at(s, 2, int(s[rod, c.HELD])), c.P), vector(s, rod, c.PIVOT), -1.0))
        worst = most(worst, abs(length - s[rod, c.LENGTH]) / s[rod, c.LENGTH])
    for n in range(count_of(s)):
        fastest = s[1 + n, c.FASTEST]
        if fastest == fastest and r[at(s, 2, n), c.HERE] > 0:
            worst = most(worst, (norm(vector(r, at(s, 2, n), c.V)) - fastest) / fastest)
    return worst


@compiled
def keep_limits(s, r):
    for k in range(int(s[0, c.ROD_COUNT])):
        rod = rod_at(s, k)
        one, pivot = at(s, 2, int(s[rod, c.HELD])), vector(s, rod, c.PIVOT)
        arm, speed = plus(vector(r, one, c.P), pivot, -1.0), vector(r, one, c.V)
        along = times(arm, 1 / max(norm(arm), 1e-9))
        put(r, one, c.P, plus(pivot, along, s[rod, c.LENGTH]))
        put(r, one, c.V, plus(speed, along, -dot(speed, along)))
    for n in range(count_of(s)):
        fastest, one = s[1 + n, c.FASTEST], at(s, 2, n)
        if fastest == fastest:
            speed = vector(r, one, c.V)
            put(r, one, c.V, times(speed, min(fastest / max(norm(speed), 1e-12), 1.0)))
    for k in range(int(s[0, c.LIMIT_COUNT])):
        one = limit_at(s, k)
        flat, number = flat_at(s, 2), int(s[one, c.NUMBER])
        if r[flat, number] == r[flat, number]:  # not a number stays broken
            r[flat, number] = min(max(r[flat, number], s[one, c.LEAST]), s[one, c.MOST])


# -- energy -----------------------------------------------------------------------------------------------------------


@compiled
def kinetic_of(r, one, turning):
    value = 0.5 * r[one, c.MASS] * dot(vector(r, one, c.V), vector(r, one, c.V))
    if turning:
        for k in range(3):
            value += 0.5 * r[one, c.INERTIA + k] * r[one, c.S + k] ** 2
    return value


@compiled
def energy_at(s, r, i, first):
    """Kinetic and potential energy of the bodies that nothing drives at instant i of a motion that begins at instant `first`, J."""
    total, gravity = 0.0, vector(s, 0, c.GRAVITY)
    for n in range(count_of(s)):
        one = at(s, i, n)
        if r[one, c.HERE] > 0 and s[1 + n, c.DRIVEN] == 0:
            place = vector(r, one, c.P)
            if s[1 + n, c.TIED] > 0 and s[1 + n, c.AT_V] < 0:  # speeds are of the middle of a step: so are heights
                other = at(s, i - 1 if i > first else first + 1, n)
                place = times(plus(place, vector(r, other, c.P), 1.0), 0.5)
            total += kinetic_of(r, one, True) - r[one, c.MASS] * dot(place, gravity)
    return total


@compiled
def energy(s, r, fresh):
    first = 1 if fresh else 0
    largest, lift = 0.0, 0.0
    for i in range(first, 3):
        kinetic, lift = 0.0, 0.0
        for n in range(count_of(s)):
            one = at(s, i, n)
            if r[one, c.HERE] > 0 and s[1 + n, c.DRIVEN] == 0:
                kinetic += kinetic_of(r, one, False)
                lift += r[one, c.MASS] * r[one, c.SIZE] * s[0, c.WEIGHT]
        largest = most(largest, kinetic)
    base, above = energy_at(s, r, first, first), 0.0
    for i in range(first + 1, 3):
        now = energy_at(s, r, i, first)
        if not left_alone(s, r, i - 1):
            base = now
        above = now - base
        if s[0, c.DISSIPATES] > 0:
            base = min(base, now)
        else:
            above = abs(above)
    return most(0.0, above / max(largest + lift, 1e-9))


@compiled
def keep_energy(s, r):
    before, now = energy_at(s, r, 1, 0), energy_at(s, r, 2, 0)
    if s[0, c.DISSIPATES] > 0:
        before = min(before, energy_at(s, r, 0, 0))
    excess = now - before
    if not (excess > 0 or s[0, c.DISSIPATES] == 0) or not left_alone(s, r, 1):
        return
    gravity, kinetic, rises = vector(s, 0, c.GRAVITY), 0.0, 0.0
    for n in range(count_of(s)):
        if r[at(s, 2, n), c.HERE] > 0 and s[1 + n, c.DRIVEN] == 0:
            kinetic += kinetic_of(r, at(s, 2, n), True)
            rises += rise_of(s, r, n)
    factor = math.sqrt(max(kinetic - excess, 0.0) / max(kinetic, 1e-12)) if kinetic > 1e-9 else 1.0
    share = min(max(excess - kinetic, 0.0) / max(rises, 1e-12), 1.0)
    for n in range(count_of(s)):
        if s[1 + n, c.DRIVEN] == 0:
            one = at(s, 2, n)
            if r[one, c.HERE] > 0:
                sunk = share * rise_of(s, r, n) / max(r[one, c.MASS], 1e-12) / max(dot(gravity, gravity), 1e-12)
                put(r, one, c.P, plus(vector(r, one, c.P), gravity, sunk))
            put(r, one, c.V, times(vector(r, one, c.V), factor))
            put(r, one, c.S, times(vector(r, one, c.S), factor))


@compiled
def rise_of(s, r, n):
    """By how much the potential energy of a body rose in the step, J; 0 on a rod."""
    way, _ = change_of(s, r, n)
    return max(-dot(way, vector(s, 0, c.GRAVITY)), 0.0) * r[at(s, 2, n), c.MASS] if s[1 + n, c.TIED] == 0 else 0.0


# -- continuity -------------------------------------------------------------------------------------------------------


@compiled
def gentle(s, r, n, fresh):
    _, change = change_of(s, r, n)
    slight = norm(change) < s[0, c.WEIGHT] * s[0, c.DT] and s[1 + n, c.TIED] == 0
    return slight or clear(s, r, 1, n, fresh)


@compiled
def mean_way(s, r, n):
    return times(plus(vector(r, at(s, 2, n), c.V), vector(r, at(s, 1, n), c.V), 1.0), 0.5 * s[0, c.DT])


@compiled
def fastest_way(s, r, n):
    return s[0, c.DT] * most(norm(vector(r, at(s, 2, n), c.V)), norm(vector(r, at(s, 1, n), c.V)))


@compiled
def continuity(s, r, fresh):
    worst = 0.0
    for n in range(count_of(s)):
        if not stays(s, r, 1, n):
            continue
        way, _ = change_of(s, r, n)
        if s[1 + n, c.AT_V] < 0 and s[1 + n, c.FASTEST] == s[1 + n, c.FASTEST]:
            worst = most(worst, norm(way) - s[1 + n, c.FASTEST] * s[0, c.DT])
        elif s[1 + n, c.AT_V] < 0:
            past = plus(vector(r, at(s, 1, n), c.P), vector(r, at(s, 0, n), c.P), -1.0)
            worst = most(worst, 0.0 if fresh else norm(plus(way, past, -1.0)))
        elif gentle(s, r, n, fresh):
            worst = most(worst, norm(plus(way, mean_way(s, r, n), -1.0)))
        else:
            worst = most(worst, norm(way) - fastest_way(s, r, n))
    return worst


@compiled
def keep_continuity(s, r):
    for n in range(count_of(s)):
        way, _ = change_of(s, r, n)
        measured = s[1 + n, c.AT_V] >= 0
        if measured and gentle(s, r, n, False):
            way = mean_way(s, r, n)
        else:
            reach = fastest_way(s, r, n) if measured else norm(way)
            if not measured and s[1 + n, c.FASTEST] == s[1 + n, c.FASTEST]:
                reach = s[0, c.DT] * s[1 + n, c.FASTEST]
            way = times(way, min(reach / max(norm(way), 1e-12), 1.0))
        put(r, at(s, 2, n), c.P, plus(vector(r, at(s, 1, n), c.P), way, 1.0))


# -- non-penetration --------------------------------------------------------------------------------------------------


@compiled
def non_penetration(s, r, fresh):
    worst = 0.0
    for n in range(count_of(s)):
        if r[at(s, 2, n), c.HERE] > 0:
            for w in range(int(s[0, c.WALL_COUNT])):
                worst = most(worst, -r[at(s, 2, n), c.INSTANT + w])
        for m in range(n + 1, count_of(s)):
            worst = max(worst, -r[at(s, 2, n), others(s, m)])
    return worst


@compiled
def out_of(s, w, place):
    """The unit vector away from a wall."""
    wall = wall_at(s, w)
    if s[wall, c.PLANE] > 0:
        return vector(s, wall, c.NORMAL)
    away, apart = (0.0, 0.0, 0.0), plus(place, vector(s, wall, c.CENTRE), -1.0)
    face, least = away, math.inf
    for k in range(3):
        axis = column(s, wall, c.FIXED, k)
        local, half = dot(axis, apart), s[wall, c.EXTENT + k]
        away = plus(away, axis, local - min(max(local, -half), half))
        if half - abs(local) < least:
            least, face = half - abs(local), times(axis, -1.0 if local < 0 else 1.0)
    length = norm(away)
    return face if length < 1e-9 else times(away, 1 / length)


@compiled
def push_out(s, r):
    count = count_of(s)
    by = np.zeros((count, 3))
    for push in range(PUSHES):
        if push:
            measure(s, r, 2)
        for n in range(count):
            one = at(s, 2, n)
            for w in range(int(s[0, c.WALL_COUNT])):
                depth = max(-r[at(s, 2, n), c.INSTANT + w], 0.0)
                if depth > 0:
                    put(r, one, c.P, plus(vector(r, one, c.P), out_of(s, w, vector(r, one, c.P)), depth))
        for n in range(count):
            put(by, n, 0, (0.0, 0.0, 0.0))
            for m in range(count):
                overlap = -r[at(s, 2, n), others(s, m)]
                if overlap > 0:
                    apart = plus(vector(r, at(s, 2, n), c.P), vector(r, at(s, 2, m), c.P), -1.0)
                    mine = 1e9 if s[1 + n, c.DRIVEN] > 0 else r[at(s, 2, n), c.MASS]
                    theirs = 1e9 if s[1 + m, c.DRIVEN] > 0 else r[at(s, 2, m), c.MASS]
                    push_by = overlap * theirs / (theirs + mine) / max(norm(apart), 1e-9)
                    put(by, n, 0, plus(vector(by, n, 0), apart, push_by))
        for n in range(count):
            put(r, at(s, 2, n), c.P, plus(vector(r, at(s, 2, n), c.P), vector(by, n, 0), 1.0))
