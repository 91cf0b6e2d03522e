"""The laws of limits, energy, continuity and overlap over the last step of one rollout, as in motion_laws.py."""

import math

import numpy as np

from . import columns as c
from .bodies import clear, column, compiled, dot, left_alone, measure, most, norm, plus, put, stays, times, vector
from .motion_laws import change_of

PUSHES = 3  # as in the law


# -- limits -----------------------------------------------------------------------------------------------------------


@compiled
def limits(s, row, fresh):
    worst = 0.0
    for one in s.limit:
        value = row.flat[2, int(one[0])]
        worst = most(worst, most(one[1] - value, value - one[2]) / (one[2] - one[1]))
    for rod in s.rod:
        length = norm(plus(vector(row.at[2, int(rod[0])], c.P), vector(rod, 1), -1.0))
        worst = most(worst, abs(length - rod[4]) / rod[4])
    for n in range(len(s.body)):
        fastest = s.body[n, c.FASTEST]
        if fastest == fastest and row.at[2, n, c.HERE] > 0:
            worst = most(worst, (norm(vector(row.at[2, n], c.V)) - fastest) / fastest)
    return worst


@compiled
def keep_limits(s, row):
    for rod in s.rod:
        one, pivot = row.at[2, int(rod[0])], vector(rod, 1)
        arm, speed = plus(vector(one, c.P), pivot, -1.0), vector(one, c.V)
        along = times(arm, 1 / max(norm(arm), 1e-9))
        put(one, c.P, plus(pivot, along, rod[4]))
        put(one, c.V, plus(speed, along, -dot(speed, along)))
    for n in range(len(s.body)):
        fastest, one = s.body[n, c.FASTEST], row.at[2, n]
        if fastest == fastest:
            speed = vector(one, c.V)
            put(one, c.V, times(speed, min(fastest / max(norm(speed), 1e-12), 1.0)))
    for one in s.limit:
        row.flat[2, int(one[0])] = min(max(row.flat[2, int(one[0])], one[1]), one[2])


# -- energy -----------------------------------------------------------------------------------------------------------


@compiled
def kinetic_of(one, turning):
    value = 0.5 * one[c.MASS] * dot(vector(one, c.V), vector(one, c.V))
    if turning:
        for k in range(3):
            value += 0.5 * one[c.INERTIA + k] * one[c.S + k] ** 2
    return value


@compiled
def energy_at(s, row, i, first):
    """Kinetic and potential energy of the bodies that nothing drives at instant i of a motion that begins at instant `first`, J."""
    total, gravity = 0.0, vector(s.facts, c.GRAVITY)
    for n in range(len(s.body)):
        one = row.at[i, n]
        if one[c.HERE] > 0 and s.body[n, c.DRIVEN] == 0:
            place = vector(one, c.P)
            if (
                s.body[n, c.TIED] > 0 and s.body[n, c.AT_V] < 0
            ):  # speeds are of the middle of a step, and so are heights
                other = row.at[i - 1 if i > first else first + 1, n]
                place = times(plus(place, vector(other, c.P), 1.0), 0.5)
            total += kinetic_of(one, True) - one[c.MASS] * dot(place, gravity)
    return total


@compiled
def energy(s, row, fresh):
    first = 1 if fresh else 0
    largest, lift = 0.0, 0.0
    for i in range(first, 3):
        kinetic, lift = 0.0, 0.0
        for n in range(len(s.body)):
            one = row.at[i, n]
            if one[c.HERE] > 0 and s.body[n, c.DRIVEN] == 0:
                kinetic += kinetic_of(one, False)
                lift += one[c.MASS] * one[c.SIZE] * s.facts[c.WEIGHT]
        largest = most(largest, kinetic)
    base, above = energy_at(s, row, first, first), 0.0
    for i in range(first + 1, 3):
        now = energy_at(s, row, i, first)
        if not left_alone(s, row, i - 1):
            base = now
        above = now - base
        if s.facts[c.DISSIPATES] > 0:
            base = min(base, now)
        else:
            above = abs(above)
    return most(0.0, above / max(largest + lift, 1e-9))


@compiled
def keep_energy(s, row):
    before, now = energy_at(s, row, 1, 0), energy_at(s, row, 2, 0)
    if s.facts[c.DISSIPATES] > 0:
        before = min(before, energy_at(s, row, 0, 0))
    excess = now - before
    if not (excess > 0 or s.facts[c.DISSIPATES] == 0) or not left_alone(s, row, 1):
        return
    gravity, kinetic, rises = vector(s.facts, c.GRAVITY), 0.0, 0.0
    for n in range(len(s.body)):
        if row.at[2, n, c.HERE] > 0 and s.body[n, c.DRIVEN] == 0:
            kinetic += kinetic_of(row.at[2, n], True)
            rises += rise_of(s, row, n)
    factor = math.sqrt(max(kinetic - excess, 0.0) / max(kinetic, 1e-12)) if kinetic > 1e-9 else 1.0
    share = min(max(excess - kinetic, 0.0) / max(rises, 1e-12), 1.0)
    for n in range(len(s.body)):
        if s.body[n, c.DRIVEN] == 0:
            one = row.at[2, n]
            if one[c.HERE] > 0:
                sunk = share * rise_of(s, row, n) / max(one[c.MASS], 1e-12) / max(dot(gravity, gravity), 1e-12)
                put(one, c.P, plus(vector(one, c.P), gravity, sunk))
            put(one, c.V, times(vector(one, c.V), factor))
            put(one, c.S, times(vector(one, c.S), factor))


@compiled
def rise_of(s, row, n):
    """By how much the potential energy of a body rose in the step, J; 0 on a rod."""
    way, _ = change_of(s, row, n)
    return max(-dot(way, vector(s.facts, c.GRAVITY)), 0.0) * row.at[2, n, c.MASS] if s.body[n, c.TIED] == 0 else 0.0


# -- continuity -------------------------------------------------------------------------------------------------------


@compiled
def gentle(s, row, n, fresh):
    _, change = change_of(s, row, n)
    slight = norm(change) < s.facts[c.WEIGHT] * s.facts[c.DT] and s.body[n, c.TIED] == 0
    return slight or clear(s, row, 1, n, fresh)


@compiled
def mean_way(s, row, n):
    return times(plus(vector(row.at[2, n], c.V), vector(row.at[1, n], c.V), 1.0), 0.5 * s.facts[c.DT])


@compiled
def fastest_way(s, row, n):
    return s.facts[c.DT] * most(norm(vector(row.at[2, n], c.V)), norm(vector(row.at[1, n], c.V)))


@compiled
def continuity(s, row, fresh):
    worst = 0.0
    for n in range(len(s.body)):
        if not stays(row, 1, n):
            continue
        way, _ = change_of(s, row, n)
        if s.body[n, c.AT_V] < 0 and s.body[n, c.FASTEST] == s.body[n, c.FASTEST]:
            worst = most(worst, norm(way) - s.body[n, c.FASTEST] * s.facts[c.DT])
        elif s.body[n, c.AT_V] < 0:
            past = plus(vector(row.at[1, n], c.P), vector(row.at[0, n], c.P), -1.0)
            worst = most(worst, 0.0 if fresh else norm(plus(way, past, -1.0)))
        elif gentle(s, row, n, fresh):
            worst = most(worst, norm(plus(way, mean_way(s, row, n), -1.0)))
        else:
            worst = most(worst, norm(way) - fastest_way(s, row, n))
    return worst


@compiled
def keep_continuity(s, row):
    for n in range(len(s.body)):
        way, _ = change_of(s, row, n)
        measured = s.body[n, c.AT_V] >= 0
        if measured and gentle(s, row, n, False):
            way = mean_way(s, row, n)
        else:
            reach = fastest_way(s, row, n) if measured else norm(way)
            if not measured and s.body[n, c.FASTEST] == s.body[n, c.FASTEST]:
                reach = s.facts[c.DT] * s.body[n, c.FASTEST]
            way = times(way, min(reach / max(norm(way), 1e-12), 1.0))
        put(row.at[2, n], c.P, plus(vector(row.at[1, n], c.P), way, 1.0))


# -- non-penetration --------------------------------------------------------------------------------------------------


@compiled
def non_penetration(s, row, fresh):
    worst = 0.0
    for n in range(len(s.body)):
        if row.at[2, n, c.HERE] > 0:
            for w in range(len(s.wall)):
                worst = most(worst, -row.walls[2, n, w])
        for m in range(n + 1, len(s.body)):
            worst = max(worst, -row.others[2, n, m])
    return worst


@compiled
def out_of(s, w, place):
    """The unit vector away from a wall."""
    wall = s.wall[w]
    if wall[c.PLANE] > 0:
        return vector(wall, c.NORMAL)
    away, apart = (0.0, 0.0, 0.0), plus(place, vector(wall, c.CENTRE), -1.0)
    face, least = away, math.inf
    for k in range(3):
        axis = column(wall, c.FIXED, k)
        local, half = dot(axis, apart), wall[c.EXTENT + k]
        away = plus(away, axis, local - min(max(local, -half), half))
        if half - abs(local) < least:
            least, face = half - abs(local), times(axis, -1.0 if local < 0 else 1.0)
    length = norm(away)
    return face if length < 1e-9 else times(away, 1 / length)


@compiled
def push_out(s, row):
    count = len(s.body)
    by = np.zeros((count, 3))
    for push in range(PUSHES):
        if push:
            measure(s, row, 2)
        for n in range(count):
            one = row.at[2, n]
            for w in range(len(s.wall)):
                depth = max(-row.walls[2, n, w], 0.0)
                if depth > 0:
                    put(one, c.P, plus(vector(one, c.P), out_of(s, w, vector(one, c.P)), depth))
        for n in range(count):
            put(by[n], 0, (0.0, 0.0, 0.0))
            for m in range(count):
                overlap = -row.others[2, n, m]
                if overlap > 0:
                    apart = plus(vector(row.at[2, n], c.P), vector(row.at[2, m], c.P), -1.0)
                    mine = 1e9 if s.body[n, c.DRIVEN] > 0 else row.at[2, n, c.MASS]
                    theirs = 1e9 if s.body[m, c.DRIVEN] > 0 else row.at[2, m, c.MASS]
                    push_by = overlap * theirs / (theirs + mine) / max(norm(apart), 1e-9)
                    put(by[n], 0, plus(vector(by[n], 0), apart, push_by))
        for n in range(count):
            put(row.at[2, n], c.P, plus(vector(row.at[2, n], c.P), vector(by[n], 0), 1.0))
