"""The laws of free and of touching bodies over the last step of one rollout, each as in physics/laws: its violation, and the
projection of the last instant.

A rollout is `row` and its system `s`; see bodies.py. fresh: an episode that has one step only."""

import math

import numpy as np

from . import columns as c
from .bodies import clear, compiled, dot, meets_body, meets_wall, most, norm, plus, put, stays, times, touches, vector

MERGED, SUBSTEPS, FAST = 0.1, 4, 5.0  # as in the laws


@compiled
def change_of(s, row, n):
    """(way, change of velocity) of a body in the last step."""
    before, after = row.at[1, n], row.at[2, n]
    return plus(vector(after, c.P), vector(before, c.P), -1.0), plus(vector(after, c.V), vector(before, c.V), -1.0)


# -- permanence -------------------------------------------------------------------------------------------------------


@compiled
def outside(s, place):
    for k in range(3):
        if place[k] < s.facts[c.LOW + k] or place[k] > s.facts[c.HIGH + k]:
            return s.facts[c.BOUNDED] > 0
    return False


@compiled
def permanence(s, row, fresh):
    wrong, count = 0.0, len(s.body)
    for n in range(count):
        one, here = row.at[2, n], row.at[2, n, c.HERE] > 0
        wrong += here != (row.at[1 if fresh else 0, n, c.HERE] > 0)
        wrong += here and outside(s, vector(one, c.P))
        for m in range(n + 1, count):
            other = row.at[2, m]
            apart = norm(plus(vector(one, c.P), vector(other, c.P), -1.0))
            wrong += here and other[c.HERE] > 0 and apart < MERGED * (one[c.SIZE] + other[c.SIZE])
    return wrong


@compiled
def copy(before, after):
    for k in range(c.P, c.HERE):
        after[k] = before[k]


@compiled
def keep_bodies(s, row):
    for n in range(len(s.body)):
        before, after = row.at[1, n], row.at[2, n]
        if before[c.HERE] > 0 and not after[c.HERE] > 0:
            place = plus(vector(before, c.P), vector(before, c.V), s.facts[c.DT])
            copy(before, after)
            put(after, c.P, place)
        if outside(s, vector(after, c.P)):
            copy(before, after)
        after[c.HERE] = before[c.HERE]


# -- free fall --------------------------------------------------------------------------------------------------------


@compiled
def ballistic(s, row, n, fresh):
    if not clear(s, row, 1, n, fresh):
        return False
    return s.body[n, c.AT_V] >= 0 or (not fresh and clear(s, row, 0, n, fresh))


@compiled
def hangs(s, row, n):
    """The rod that alone holds a body, which touches nothing; else -1."""
    for r in range(len(s.rod)):
        if s.rod[r, 0] == n and s.rod[r, 5] > 0:
            free = not touches(row, 1, n) and stays(row, 1, n) and s.body[n, c.DRIVEN] == 0
            return r if free else -1
    return -1


@compiled
def slope(arm, speed, gravity):
    pull = (dot(speed, speed) + dot(arm, gravity)) / dot(arm, arm)
    return plus(gravity, arm, -pull)


@compiled
def swung(s, row, n, r):
    """(position, velocity) of a body on a rod after the step, by the classical Runge-Kutta method."""
    pivot, gravity, h = vector(s.rod[r], 1), vector(s.facts, c.GRAVITY), s.facts[c.DT] / SUBSTEPS
    arm, v = plus(vector(row.at[1, n], c.P), pivot, -1.0), vector(row.at[1, n], c.V)
    for _ in range(SUBSTEPS):
        a = slope(arm, v, gravity)
        v2 = plus(v, a, 0.5 * h)
        a2 = slope(plus(arm, v, 0.5 * h), v2, gravity)
        v3 = plus(v, a2, 0.5 * h)
        a3 = slope(plus(arm, v2, 0.5 * h), v3, gravity)
        v4 = plus(v, a3, h)
        a4 = slope(plus(arm, v3, h), v4, gravity)
        arm = plus(plus(plus(plus(arm, v, h / 6), v2, h / 3), v3, h / 3), v4, h / 6)
        v = plus(plus(plus(plus(v, a, h / 6), a2, h / 3), a3, h / 3), a4, h / 6)
    return plus(pivot, arm, 1.0), v


@compiled
def free_fall(s, row, fresh):
    worst, dt_s = 0.0, s.facts[c.DT]
    for n in range(len(s.body)):
        r = hangs(s, row, n)
        if r >= 0:
            _, speed = swung(s, row, n, r)
            worst = most(worst, norm(plus(vector(row.at[2, n], c.V), speed, -1.0)) / dt_s)
        elif ballistic(s, row, n, fresh):
            _, change = change_of(s, row, n)
            worst = most(worst, norm(plus(times(change, 1 / dt_s), vector(s.facts, c.GRAVITY), -1.0)))
    return worst


@compiled
def fall(s, row):
    dt_s, gravity = s.facts[c.DT], vector(s.facts, c.GRAVITY)
    for n in range(len(s.body)):
        before, after, r = row.at[1, n], row.at[2, n], hangs(s, row, n)
        if r >= 0:
            place, speed = swung(s, row, n, r)
            put(after, c.P, place)
            put(after, c.V, speed)
        elif ballistic(s, row, n, False):
            speed = vector(before, c.V)
            put(after, c.P, plus(plus(vector(before, c.P), speed, dt_s), gravity, 0.5 * dt_s * dt_s))
            put(after, c.V, plus(speed, gravity, dt_s))


# -- momentum ---------------------------------------------------------------------------------------------------------


@compiled
def closed_groups(s, row):
    """(bool [N, N]: bodies that touch each other in a chain; bool [N]: more than one in the group, and nothing else touches it)."""
    count = len(s.body)
    group, closed = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    for n in range(count):
        for m in range(count):
            group[n, m] = n == m or meets_body(row, 1, n, m)
    for k in range(count):
        for n in range(count):
            for m in range(count):
                group[n, m] = group[n, m] or (group[n, k] and group[k, m])
    for n in range(count):
        members, free = 0, True
        for m in range(count):
            if group[n, m]:
                members += 1
                held = s.body[m, c.DRIVEN] > 0 or s.body[m, c.TIED] > 0 or not stays(row, 1, m)
                free = free and not held and row.at[2, m, c.WALLS] == 0
        closed[n] = free and members > 1
    return group, closed


@compiled
def partner(s, group, n):
    """The other one of two smooth spheres in a system that keeps its energy, else -1."""
    if s.facts[c.DISSIPATES] > 0 or s.facts[c.TRACKED] > 0:
        return -1
    other, members = -1, 0
    for m in range(len(group)):
        if group[n, m]:
            if s.body[m, c.REACH_M] > 0 or s.body[m, c.AT_S] >= 0:
                return -1
            members += 1
            other = m if m != n else other
    return other if members == 2 else -1


@compiled
def impact(s, row, n, m):
    """(position, velocity) of body n after the step by flight and one impact with m along the line of centres at most."""
    dt_s, one, other = s.facts[c.DT], row.at[1, n], row.at[1, m]
    place, speed, fallen = vector(one, c.P), vector(one, c.V), times(vector(s.facts, c.GRAVITY), dt_s)
    apart, closing = plus(vector(other, c.P), place, -1.0), plus(vector(other, c.V), speed, -1.0)
    reach = one[c.RADIUS] + other[c.RADIUS]
    fast, near = dot(closing, closing), dot(apart, closing)
    root = near * near - fast * (dot(apart, apart) - reach * reach)
    until = (-near - math.sqrt(max(root, 0.0))) / max(fast, 1e-12)
    hits = near < 0 and root > 0 and until <= dt_s
    until = max(until, 0.0) if hits else dt_s
    normal = plus(apart, closing, until)
    normal = times(normal, 1 / max(norm(normal), 1e-12))
    share = 2 * other[c.MASS] / max(one[c.MASS] + other[c.MASS], 1e-12)
    kick = times(normal, share * dot(closing, normal) if hits else 0.0)
    flown = plus(place, plus(speed, fallen, 0.5), dt_s)
    return plus(flown, kick, dt_s - until), plus(plus(speed, fallen, 1.0), kick, 1.0)


@compiled
def excess_of(s, row, group, n):
    """The change of the velocity of a body's group that gravity does not explain."""
    total, masses = (0.0, 0.0, 0.0), 0.0
    for m in range(len(group)):
        if group[n, m]:
            _, change = change_of(s, row, m)
            mass = row.at[2, m, c.MASS]
            masses += mass
            total = plus(total, plus(change, vector(s.facts, c.GRAVITY), -s.facts[c.DT]), mass)
    return times(total, 1 / max(masses, 1e-12))


@compiled
def momentum(s, row, fresh):
    worst, alone = 0.0, True
    for n in range(len(s.body)):
        alone = alone and row.at[2, n, c.BODIES] == 0
    if alone:
        return 0.0
    group, closed = closed_groups(s, row)
    for n in range(len(group)):
        if closed[n]:
            worst = most(worst, norm(excess_of(s, row, group, n)))
            m = partner(s, group, n)
            if m >= 0:
                worst = most(worst, norm(plus(vector(row.at[2, n], c.V), impact(s, row, n, m)[1], -1.0)))
    return worst


@compiled
def keep_momentum(s, row):
    group, closed = closed_groups(s, row)
    excess = np.zeros((len(group), 3))
    for n in range(len(group)):
        if closed[n]:
            put(excess[n], 0, excess_of(s, row, group, n))
    for n in range(len(group)):
        if closed[n]:
            put(row.at[2, n], c.V, plus(vector(row.at[2, n], c.V), vector(excess[n], 0), -1.0))
            m = partner(s, group, n)
            if m >= 0:
                place, speed = impact(s, row, n, m)
                put(row.at[2, n], c.P, place)
                put(row.at[2, n], c.V, speed)


# -- support and friction ---------------------------------------------------------------------------------------------


@compiled
def floor_of(s, row, n):
    """The plane that a body may have touched, and nothing else; else -1."""
    free = s.body[n, c.DRIVEN] == 0 and s.body[n, c.TIED] == 0 and stays(row, 1, n)
    if not free or row.at[2, n, c.WALLS] != 1 or row.at[2, n, c.BODIES] > 0:
        return -1
    for w in range(len(s.wall)):
        if meets_wall(row, 1, n, w):
            return w if s.wall[w, c.PLANE] > 0 else -1
    return -1


@compiled
def floor_force(s, row, n, w):
    """(the force of a plane by mass along its normal, and sideways; the normal)."""
    normal = vector(s.wall[w], c.NORMAL)
    _, change = change_of(s, row, n)
    force = plus(times(change, 1 / s.facts[c.DT]), vector(s.facts, c.GRAVITY), -1.0)
    along = dot(force, normal)
    return along, plus(force, normal, -along), normal


@compiled
def bounce(s, row, n, w):
    """(whether the body hits the plane by its flight; height above contact and speed that a bounce with its restitution gives)."""
    normal, dt_s, before = vector(s.wall[w], c.NORMAL), s.facts[c.DT], row.at[1, n]
    gap, known = max(row.walls[1, n, w], 0.0), s.body[n, c.RESTITUTION]
    speed, pull = dot(vector(before, c.V), normal), -dot(vector(s.facts, c.GRAVITY), normal)
    if pull > 1e-9:
        until = (speed + math.sqrt(max(speed * speed + 2 * pull * gap, 0.0))) / pull
    else:
        until = gap / max(-speed, 1e-9)
    arrives, left = pull * until - speed, max(dt_s - until, 0.0)
    leaves = arrives * (known if known == known else 0.0)
    hits = arrives > FAST * max(s.facts[c.WEIGHT] * dt_s, 0.02) and until <= dt_s and known == known
    return hits, leaves * left - 0.5 * pull * left * left, leaves - pull * left


@compiled
def support(s, row, fresh):
    worst = 0.0
    for n in range(len(s.body)):
        w = floor_of(s, row, n)
        if w < 0:
            continue
        along, sideways, normal = floor_force(s, row, n, w)
        cone = s.body[n, c.FRICTION] if s.body[n, c.FRICTION] == s.body[n, c.FRICTION] else 1e9
        worst = most(worst, most(max(-along, 0.0), norm(sideways) - cone * max(along, 0.0)))
        hits, _, speed = bounce(s, row, n, w)
        if hits:
            worst = most(worst, abs(dot(vector(row.at[2, n], c.V), normal) - speed) / s.facts[c.DT])
    return worst


@compiled
def keep_support(s, row):
    dt_s = s.facts[c.DT]
    for n in range(len(s.body)):
        w, after = floor_of(s, row, n), row.at[2, n]
        if w < 0:
            continue
        along, sideways, normal = floor_force(s, row, n, w)
        cone = s.body[n, c.FRICTION] if s.body[n, c.FRICTION] == s.body[n, c.FRICTION] else 1e9
        push = max(along, 0.0)
        force = plus(times(normal, push), sideways, min(cone * push / max(norm(sideways), 1e-12), 1.0))
        velocity = plus(vector(row.at[1, n], c.V), plus(force, vector(s.facts, c.GRAVITY), 1.0), dt_s)
        hits, height, speed = bounce(s, row, n, w)
        if hits:
            velocity = plus(velocity, normal, speed - dot(velocity, normal))
            put(after, c.P, plus(vector(after, c.P), normal, height - row.walls[2, n, w]))
        put(after, c.V, velocity)
