"""The laws of free and of touching bodies over the last step of one rollout, each as in physics/laws: its violation, and the
projection of the last instant.

A rollout is `r` and its system `s`; see bodies.py. fresh: an episode that has one step only."""

import math

import numpy as np

from . import columns as c
from .bodies import (
    at,
    clear,
    compiled,
    count_of,
    dot,
    meets_body,
    meets_wall,
    most,
    norm,
    plus,
    put,
    rod_at,
    stays,
    times,
    touches,
    vector,
    wall_at,
)

MERGED, SUBSTEPS, FAST = 0.1, 4, 5.0  # as in the laws


@compiled
def change_of(s, r, n):
    """(way, change of velocity) of a body in the last step."""
    before, after = at(s, 1, n), at(s, 2, n)
    return plus(vector(r, after, c.P), vector(r, before, c.P), -1.0), plus(
        vector(r, after, c.V), vector(r, before, c.V), -1.0
    )


# -- permanence -------------------------------------------------------------------------------------------------------


@compiled
def outside(s, place):
    for k in range(3):
        if place[k] < s[0, c.LOW + k] or place[k] > s[0, c.HIGH + k]:
            return s[0, c.BOUNDED] > 0
    return False


@compiled
def permanence(s, r, fresh):
    wrong, count = 0.0, count_of(s)
    for n in range(count):
        one, here = at(s, 2, n), r[at(s, 2, n), c.HERE] > 0
        wrong += here != (r[at(s, 1 if fresh else 0, n), c.HERE] > 0)
        wrong += here and outside(s, vector(r, one, c.P))
        for m in range(n + 1, count):
            other = at(s, 2, m)
            apart = norm(plus(vector(r, one, c.P), vector(r, other, c.P), -1.0))
            wrong += here and r[other, c.HERE] > 0 and apart < MERGED * (r[one, c.SIZE] + r[other, c.SIZE])
    return wrong


@compiled
def copy(r, before, after):
    for k in range(c.P, c.SIZE):
        if k != c.HERE:
            r[after, k] = r[before, k]


@compiled
def keep_bodies(s, r):
    for n in range(count_of(s)):
        before, after = at(s, 1, n), at(s, 2, n)
        if r[before, c.HERE] > 0 and not r[after, c.HERE] > 0:
            place = plus(vector(r, before, c.P), vector(r, before, c.V), s[0, c.DT])
            copy(r, before, after)
            put(r, after, c.P, place)
        if outside(s, vector(r, after, c.P)):
            copy(r, before, after)
        r[after, c.HERE] = r[before, c.HERE]


# -- free fall --------------------------------------------------------------------------------------------------------


@compiled
def ballistic(s, r, n, fresh):
    if not clear(s, r, 1, n, fresh):
        return False
    return s[1 + n, c.AT_V] >= 0 or (not fresh and clear(s, r, 0, n, fresh))


@compiled
def hangs(s, r, n):
    """The row of the rod that alone holds a body, which touches nothing; else -1."""
    for k in range(int(s[0, c.ROD_COUNT])):
        rod = rod_at(s, k)
        if s[rod, c.HELD] == n and s[rod, c.ALONE] > 0:
            free = not touches(s, r, 1, n) and stays(s, r, 1, n) and s[1 + n, c.DRIVEN] == 0
            return rod if free else -1
    return -1


@compiled
def slope(arm, speed, gravity):
    pull = (dot(speed, speed) + dot(arm, gravity)) / dot(arm, arm)
    return plus(gravity, arm, -pull)


@compiled
def swung(s, r, n, rod):
    """(position, velocity) of a body on a rod after the step, by the classical Runge-Kutta method."""
    pivot, gravity, h = vector(s, rod, c.PIVOT), vector(s, 0, c.GRAVITY), s[0, c.DT] / SUBSTEPS
    arm, v = plus(vector(r, at(s, 1, n), c.P), pivot, -1.0), vector(r, at(s, 1, n), c.V)
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
def free_fall(s, r, fresh):
    worst, dt_s = 0.0, s[0, c.DT]
    for n in range(count_of(s)):
        rod = hangs(s, r, n)
        if rod >= 0:
            _, speed = swung(s, r, n, rod)
            worst = most(worst, norm(plus(vector(r, at(s, 2, n), c.V), speed, -1.0)) / dt_s)
        elif ballistic(s, r, n, fresh):
            _, change = change_of(s, r, n)
            worst = most(worst, norm(plus(times(change, 1 / dt_s), vector(s, 0, c.GRAVITY), -1.0)))
    return worst


@compiled
def fall(s, r):
    dt_s, gravity = s[0, c.DT], vector(s, 0, c.GRAVITY)
    for n in range(count_of(s)):
        before, after, rod = at(s, 1, n), at(s, 2, n), hangs(s, r, n)
        if rod >= 0:
            place, speed = swung(s, r, n, rod)
            put(r, after, c.P, place)
            put(r, after, c.V, speed)
        elif ballistic(s, r, n, False):
            speed = vector(r, before, c.V)
            put(r, after, c.P, plus(plus(vector(r, before, c.P), speed, dt_s), gravity, 0.5 * dt_s * dt_s))
            put(r, after, c.V, plus(speed, gravity, dt_s))


# -- momentum ---------------------------------------------------------------------------------------------------------


@compiled
def closed_groups(s, r):
    """(bool [N, N]: bodies that touch each other in a chain; bool [N]: more than one in the group, and nothing else touches it)."""
    count = count_of(s)
    group, closed = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    for n in range(count):
        for m in range(count):
            group[n, m] = n == m or meets_body(s, r, 1, n, m)
    for k in range(count):
        for n in range(count):
            for m in range(count):
                group[n, m] = group[n, m] or (group[n, k] and group[k, m])
    for n in range(count):
        members, free = 0, True
        for m in range(count):
            if group[n, m]:
                members += 1
                held = s[1 + m, c.DRIVEN] > 0 or s[1 + m, c.TIED] > 0 or not stays(s, r, 1, m)
                free = free and not held and r[at(s, 2, m), c.WALLS] == 0
        closed[n] = free and members > 1
    return group, closed


@compiled
def partner(s, group, n):
    """The other one of two smooth spheres in a system that keeps its energy, else -1."""
    if s[0, c.DISSIPATES] > 0 or s[0, c.TRACKED] > 0:
        return -1
    other, members = -1, 0
    for m in range(len(group)):
        if group[n, m]:
            if s[1 + m, c.REACH_M] > 0 or s[1 + m, c.AT_S] >= 0:
                return -1
            members += 1
            other = m if m != n else other
    return other if members == 2 else -1


@compiled
def impact(s, r, n, m):
    """(position, velocity) of body n after the step by flight and one impact with m along the line of centres at most."""
    dt_s, one, other = s[0, c.DT], at(s, 1, n), at(s, 1, m)
    place, speed, fallen = vector(r, one, c.P), vector(r, one, c.V), times(vector(s, 0, c.GRAVITY), dt_s)
    apart, closing = plus(vector(r, other, c.P), place, -1.0), plus(vector(r, other, c.V), speed, -1.0)
    reach = r[one, c.RADIUS] + r[other, c.RADIUS]
    fast, near = dot(closing, closing), dot(apart, closing)
    root = near * near - fast * (dot(apart, apart) - reach * reach)
    until = (-near - math.sqrt(max(root, 0.0))) / max(fast, 1e-12)
    hits = near < 0 and root > 0 and until <= dt_s
    until = max(until, 0.0) if hits else dt_s
    normal = plus(apart, closing, until)
    normal = times(normal, 1 / max(norm(normal), 1e-12))
    share = 2 * r[other, c.MASS] / max(r[one, c.MASS] + r[other, c.MASS], 1e-12)
    kick = times(normal, share * dot(closing, normal) if hits else 0.0)
    flown = plus(place, plus(speed, fallen, 0.5), dt_s)
    return plus(flown, kick, dt_s - until), plus(plus(speed, fallen, 1.0), kick, 1.0)


@compiled
def excess_of(s, r, group, n):
    """The change of the velocity of a body's group that gravity does not explain."""
    total, masses = (0.0, 0.0, 0.0), 0.0
    for m in range(len(group)):
        if group[n, m]:
            _, change = change_of(s, r, m)
            mass = r[at(s, 2, m), c.MASS]
            masses += mass
            total = plus(total, plus(change, vector(s, 0, c.GRAVITY), -s[0, c.DT]), mass)
    return times(total, 1 / max(masses, 1e-12))


@compiled
def momentum(s, r, fresh):
    worst, alone = 0.0, True
    for n in range(count_of(s)):
        alone = alone and r[at(s, 2, n), c.BODIES] == 0
    if alone:
        return 0.0
    group, closed = closed_groups(s, r)
    for n in range(len(group)):
        if closed[n]:
            worst = most(worst, norm(excess_of(s, r, group, n)))
            m = partner(s, group, n)
            if m >= 0:
                worst = most(worst, norm(plus(vector(r, at(s, 2, n), c.V), impact(s, r, n, m)[1], -1.0)))
    return worst


@compiled
def keep_momentum(s, r):
    group, closed = closed_groups(s, r)
    excess = np.zeros((len(group), 3))
    for n in range(len(group)):
        if closed[n]:
            put(excess, n, 0, excess_of(s, r, group, n))
    for n in range(len(group)):
        if closed[n]:
            put(r, at(s, 2, n), c.V, plus(vector(r, at(s, 2, n), c.V), vector(excess, n, 0), -1.0))
            m = partner(s, group, n)
            if m >= 0:
                place, speed = impact(s, r, n, m)
                put(r, at(s, 2, n), c.P, place)
                put(r, at(s, 2, n), c.V, speed)


# -- support and friction ---------------------------------------------------------------------------------------------


@compiled
def floor_of(s, r, n):
    """The plane that a body may have touched, and nothing else; else -1."""
    free = s[1 + n, c.DRIVEN] == 0 and s[1 + n, c.TIED] == 0 and stays(s, r, 1, n)
    if not free or r[at(s, 2, n), c.WALLS] != 1 or r[at(s, 2, n), c.BODIES] > 0:
        return -1
    for w in range(int(s[0, c.WALL_COUNT])):
        if meets_wall(s, r, 1, n, w):
            return w if s[wall_at(s, w), c.PLANE] > 0 else -1
    return -1


@compiled
def floor_force(s, r, n, w):
    """(the force of a plane by mass along its normal, and sideways; the normal)."""
    normal = vector(s, wall_at(s, w), c.NORMAL)
    _, change = change_of(s, r, n)
    force = plus(times(change, 1 / s[0, c.DT]), vector(s, 0, c.GRAVITY), -1.0)
    along = dot(force, normal)
    return along, plus(force, normal, -along), normal


@compiled
def bounce(s, r, n, w):
    """(whether the body hits the plane by its flight; height above contact and speed that a bounce with its restitution gives)."""
    normal, dt_s, before = vector(s, wall_at(s, w), c.NORMAL), s[0, c.DT], at(s, 1, n)
    gap, known = max(r[at(s, 1, n), c.INSTANT + w], 0.0), s[1 + n, c.RESTITUTION]
    speed, pull = dot(vector(r, before, c.V), normal), -dot(vector(s, 0, c.GRAVITY), normal)
    if pull > 1e-9:
        until = (speed + math.sqrt(max(speed * speed + 2 * pull * gap, 0.0))) / pull
    else:
        until = gap / max(-speed, 1e-9)
    arrives, left = pull * until - speed, max(dt_s - until, 0.0)
    leaves = arrives * (known if known == known else 0.0)
    hits = arrives > FAST * max(s[0, c.WEIGHT] * dt_s, 0.02) and until <= dt_s and known == known
    return hits, leaves * left - 0.5 * pull * left * left, leaves - pull * left


@compiled
def support(s, r, fresh):
    worst = 0.0
    for n in range(count_of(s)):
        w = floor_of(s, r, n)
        if w < 0:
            continue
        along, sideways, normal = floor_force(s, r, n, w)
        cone = s[1 + n, c.FRICTION] if s[1 + n, c.FRICTION] == s[1 + n, c.FRICTION] else 1e9
        worst = most(worst, most(max(-along, 0.0), norm(sideways) - cone * max(along, 0.0)))
        hits, _, speed = bounce(s, r, n, w)
        if hits:
            worst = most(worst, abs(dot(vector(r, at(s, 2, n), c.V), normal) - speed) / s[0, c.DT])
    return worst


@compiled
def keep_support(s, r):
    dt_s = s[0, c.DT]
    for n in range(count_of(s)):
        w, after = floor_of(s, r, n), at(s, 2, n)
        if w < 0:
            continue
        along, sideways, normal = floor_force(s, r, n, w)
        cone = s[1 + n, c.FRICTION] if s[1 + n, c.FRICTION] == s[1 + n, c.FRICTION] else 1e9
        push = max(along, 0.0)
        force = plus(times(normal, push), sideways, min(cone * push / max(norm(sideways), 1e-12), 1.0))
        velocity = plus(vector(r, at(s, 1, n), c.V), plus(force, vector(s, 0, c.GRAVITY), 1.0), dt_s)
        hits, height, speed = bounce(s, r, n, w)
        if hits:
            velocity = plus(velocity, normal, speed - dot(velocity, normal))
            put(r, after, c.P, plus(vector(r, after, c.P), normal, height - r[at(s, 2, n), c.INSTANT + w]))
        put(r, after, c.V, velocity)
