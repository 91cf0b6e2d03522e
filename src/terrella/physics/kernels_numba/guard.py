"""A guard's step for the rows of a batch: the violation of each law and the projections; see physics/judge.py."""

import math

import numpy as np

from . import columns as c
from .bodies import at, compiled, contacts, count_of, flat_at, load, measure, norm, others, plus, vector
from .motion_laws import fall, free_fall, keep_bodies, keep_momentum, keep_support, momentum, permanence, support
from .state_laws import continuity, energy, keep_continuity, keep_energy, keep_limits, limits, non_penetration, push_out

LAWS = 8  # in the order in which a guard corrects them


@compiled
def violation(law, s, r, fresh):
    if law == 0:
        return permanence(s, r, fresh)
    if law == 1:
        return free_fall(s, r, fresh)
    if law == 2:
        return momentum(s, r, fresh)
    if law == 3:
        return support(s, r, fresh)
    if law == 4:
        return limits(s, r, fresh)
    if law == 5:
        return energy(s, r, fresh)
    if law == 6:
        return continuity(s, r, fresh)
    return non_penetration(s, r, fresh)


@compiled
def project(law, s, r):
    if law == 0:
        keep_bodies(s, r)
    elif law == 1:
        fall(s, r)
    elif law == 2:
        keep_momentum(s, r)
    elif law == 3:
        keep_support(s, r)
    elif law == 4:
        keep_limits(s, r)
    elif law == 5:
        keep_energy(s, r)
    elif law == 6:
        keep_continuity(s, r)
    else:
        push_out(s, r)
    measure(s, r, 2)
    contacts(s, r, 1)


@compiled
def ratio_of(law, s, r, tolerance, fresh):
    ratio = violation(law, s, r, fresh) / tolerance[law] if tolerance[law] > 0 else 0.0
    return ratio if ratio == ratio else math.inf


@compiled
def judge(s, r, tolerance, fresh, ratios):
    """Writes the violations in tolerances; whether one is above 1."""
    worst = 0.0
    for law in range(LAWS):
        ratios[law] = ratio_of(law, s, r, tolerance, fresh)
        worst = max(worst, ratios[law])
    return worst > 1


@compiled
def way_of(s, r):
    """The way of all bodies in the last step, m; a jump counts as far as the larger speed reaches."""
    total = 0.0
    for n in range(count_of(s)):
        one, other = at(s, 1, n), at(s, 2, n)
        reach = max(norm(vector(r, one, c.V)), norm(vector(r, other, c.V))) * s[0, c.DT]
        total += min(norm(plus(vector(r, other, c.P), vector(r, one, c.P), -1.0)), reach)
    return total


@compiled
def write(s, r, seen, b):
    """The channels with the corrected bodies in them; whether anything changed."""
    changed, flat = False, flat_at(s, 2)
    for k in range(seen.shape[1]):
        changed |= seen[b, k] != r[flat, k] and (seen[b, k] == seen[b, k] or r[flat, k] == r[flat, k])
    for n in range(count_of(s)):
        for k in range(c.P, c.SIZE):
            changed |= r[at(s, 3, n), k] != r[at(s, 2, n), k]
    if not changed:
        return False
    for n in range(count_of(s)):
        body, one = 1 + n, at(s, 2, n)
        if r[one, c.HERE] > 0:
            write_body(s, r, body, one, flat)
        if s[body, c.AT_HERE] >= 0:
            k = int(s[body, c.AT_HERE])
            held = r[flat, k] if r[flat, k] != 0 else r[flat_at(s, 1), k]
            r[flat, k] = held if r[one, c.HERE] > 0 else 0.0
    for k in range(seen.shape[1]):
        seen[b, k] = r[flat, k]
    return True


@compiled
def write_body(s, r, body, one, flat):
    for j in range(3):
        axis, spin = int(s[0, c.AXES + j]), int(s[0, c.SPIN_AXES + j])
        if axis >= 0:
            r[flat, int(s[body, c.AT_P]) + j] = r[one, c.P + axis]
            if s[body, c.AT_V] >= 0:
                r[flat, int(s[body, c.AT_V]) + j] = r[one, c.V + axis]
        if spin >= 0 and s[body, c.AT_S] >= 0:
            r[flat, int(s[body, c.AT_S]) + j] = r[one, c.S + spin]
    if s[body, c.AT_Q] >= 0:
        for k in range(4):
            r[flat, int(s[body, c.AT_Q]) + k] = r[one, c.Q + k]
    if s[body, c.AT_RADIUS] >= 0:
        r[flat, int(s[body, c.AT_RADIUS])] = r[one, c.RADIUS]


@compiled
def correct(s, r, tolerance, rounds, fresh, ratios):
    """Projects the last instant onto the laws that it breaks, in turn, until none is broken or `rounds` are over. A law that an
    earlier projection mended is left out."""
    for _ in range(rounds):
        for law in range(LAWS):
            if ratios[law] > 1 and ratio_of(law, s, r, tolerance, fresh) > 1:
                project(law, s, r)
        if not judge(s, r, tolerance, fresh, ratios):
            break


@compiled
def guard_rows(s, tolerance, rounds, held, seen, fresh, allowed, ratios, way, changed, first, last):
    """Corrects `seen` [B, K] in place where `allowed` [B]. tolerance [8], 0 for laws that are not asked; held [B, 2, K]; ratios
    [B, 2, 8] and way [B, 2]: before and after; changed bool [B]."""
    bodies, width = count_of(s), seen.shape[1]
    r = np.zeros((4 * bodies + 3, max(others(s, bodies), width)))
    for b in range(first, last):
        for k in range(width):
            r[flat_at(s, 0), k], r[flat_at(s, 1), k], r[flat_at(s, 2), k] = held[b, 0, k], held[b, 1, k], seen[b, k]
        load(s, r)
        for i in range(3):
            measure(s, r, i)
        for k in range(2):
            contacts(s, r, k)
        wrong = judge(s, r, tolerance, fresh[b], ratios[b, 0])
        way[b, 0] = way_of(s, r)
        for law in range(LAWS):
            ratios[b, 1, law] = ratios[b, 0, law]
        if wrong and allowed[b]:
            for n in range(bodies):
                for k in range(c.INSTANT):
                    r[at(s, 3, n), k] = r[at(s, 2, n), k]
            correct(s, r, tolerance, rounds, fresh[b], ratios[b, 1])
            changed[b] = write(s, r, seen, b)
        way[b, 1] = way_of(s, r)
