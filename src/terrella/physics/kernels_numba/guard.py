"""A guard's step for the rows of a batch: the violation of each law and the projections; see physics/judge.py."""

import math

import numpy as np

from . import columns as c
from .bodies import RolloutRow, compiled, contacts, load, measure, norm, plus, vector
from .motion_laws import fall, free_fall, keep_bodies, keep_momentum, keep_support, momentum, permanence, support
from .state_laws import continuity, energy, keep_continuity, keep_energy, keep_limits, limits, non_penetration, push_out

LAWS = 8  # in the order in which a guard corrects them


@compiled
def violation(law, s, row, fresh):
    if law == 0:
        return permanence(s, row, fresh)
    if law == 1:
        return free_fall(s, row, fresh)
    if law == 2:
        return momentum(s, row, fresh)
    if law == 3:
        return support(s, row, fresh)
    if law == 4:
        return limits(s, row, fresh)
    if law == 5:
        return energy(s, row, fresh)
    if law == 6:
        return continuity(s, row, fresh)
    return non_penetration(s, row, fresh)


@compiled
def project(law, s, row):
    if law == 0:
        keep_bodies(s, row)
    elif law == 1:
        fall(s, row)
    elif law == 2:
        keep_momentum(s, row)
    elif law == 3:
        keep_support(s, row)
    elif law == 4:
        keep_limits(s, row)
    elif law == 5:
        keep_energy(s, row)
    elif law == 6:
        keep_continuity(s, row)
    else:
        push_out(s, row)
    measure(s, row, 2)
    contacts(s, row, 1)


@compiled
def judge(s, row, tolerance, fresh, ratios):
    """Writes the violations in tolerances; whether one is above 1."""
    worst = 0.0
    for law in range(LAWS):
        if tolerance[law] > 0:
            ratio = violation(law, s, row, fresh) / tolerance[law]
            ratios[law] = ratio if ratio == ratio else math.inf
            worst = max(worst, ratios[law])
    return worst > 1


@compiled
def way_of(s, row):
    """The way of all bodies in the last step, m; a jump counts as far as the larger speed reaches."""
    total = 0.0
    for n in range(len(s.body)):
        one, other = row.at[1, n], row.at[2, n]
        reach = max(norm(vector(one, c.V)), norm(vector(other, c.V))) * s.facts[c.DT]
        total += min(norm(plus(vector(other, c.P), vector(one, c.P), -1.0)), reach)
    return total


@compiled
def write(s, row, before, flat):
    """The channels with the corrected bodies in them; whether anything changed. before [N, columns]: the bodies as predicted."""
    changed = False
    for k in range(len(flat)):
        changed |= flat[k] != row.flat[2, k]
        flat[k] = row.flat[2, k]
    for n in range(len(s.body)):
        for k in range(c.P, c.RADIUS):
            changed |= before[n, k] != row.at[2, n, k]
    if not changed:
        return False
    for n in range(len(s.body)):
        body, one = s.body[n], row.at[2, n]
        for j in range(3):
            axis, spin = s.axes[0, j], s.axes[1, j]
            if axis >= 0:
                flat[int(body[c.AT_P]) + j] = one[c.P + axis]
                if body[c.AT_V] >= 0:
                    flat[int(body[c.AT_V]) + j] = one[c.V + axis]
            if spin >= 0 and body[c.AT_S] >= 0:
                flat[int(body[c.AT_S]) + j] = one[c.S + spin]
        if body[c.AT_Q] >= 0:
            for k in range(4):
                flat[int(body[c.AT_Q]) + k] = one[c.Q + k]
        if body[c.AT_HERE] >= 0:
            k = int(body[c.AT_HERE])
            held = flat[k] if flat[k] != 0 else row.flat[1, k]
            flat[k] = held if one[c.HERE] > 0 else 0.0
    return True


@compiled
def correct(s, row, tolerance, rounds, fresh, ratios):
    """Projects the last instant onto the laws that it breaks, in turn, until none is broken or `rounds` are over."""
    breaks = np.empty(LAWS, np.bool_)
    for _ in range(rounds):
        for law in range(LAWS):
            breaks[law] = ratios[law] > 1
        for law in range(LAWS):
            if breaks[law]:
                project(law, s, row)
        if not judge(s, row, tolerance, fresh, ratios):
            break


@compiled
def guard_rows(s, tolerance, rounds, held, seen, fresh, allowed, ratios, way, changed, first, last):
    """Corrects `seen` [B, K] in place where `allowed` [B]. tolerance [8], 0 for laws that are not asked; held [B, 2, K]; ratios
    [B, 2, 8] and way [B, 2]: before and after; changed bool [B]."""
    bodies, walls, width = len(s.body), len(s.wall), seen.shape[1]
    row = RolloutRow(
        np.zeros((3, bodies, c.INSTANT)),
        np.empty((3, bodies, walls)),
        np.empty((3, bodies, bodies)),
        np.empty((3, width)),
    )
    before = np.empty((bodies, c.INSTANT))
    for b in range(first, last):
        for k in range(width):
            row.flat[0, k], row.flat[1, k], row.flat[2, k] = held[b, 0, k], held[b, 1, k], seen[b, k]
        load(s, row)
        for i in range(3):
            measure(s, row, i)
        for k in range(2):
            contacts(s, row, k)
        wrong = judge(s, row, tolerance, fresh[b], ratios[b, 0])
        way[b, 0] = way_of(s, row)
        for law in range(LAWS):
            ratios[b, 1, law] = ratios[b, 0, law]
        if wrong and allowed[b]:
            for n in range(bodies):
                for k in range(c.INSTANT):
                    before[n, k] = row.at[2, n, k]
            correct(s, row, tolerance, rounds, fresh[b], ratios[b, 1])
            changed[b] = write(s, row, before, seen[b])
        way[b, 1] = way_of(s, row)
