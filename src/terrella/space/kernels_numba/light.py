"""Light among upright boxes: what rays meet, and what shines on what (layout/light.py)."""

import math

import numba
import numpy as np

CHUNK = 8  # boxes that share a bounding box


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_box(x, y, z, dx, dy, dz, boxes, far):
    """The first of boxes [K, 6] (low and high corners) that a ray meets, -1 for none nearer than `far`; how far; on which side
    (0 to 5: the low and the high end of each axis). Boxes in which the ray begins are passed."""
    return _first(x, y, z, dx, dy, dz, boxes, boxes[:0], far)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first(x, y, z, dx, dy, dz, boxes, bounds, far):
    """As `first_box`; bounds [K / CHUNK, 6] hold CHUNK boxes each, or are empty."""
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    best, side, which, step = far, 0, -1, len(boxes) if len(bounds) == 0 else CHUNK
    for begin in range(0, len(boxes), max(step, 1)):
        if len(bounds) > 0:
            b = bounds[begin // CHUNK]
            p, q = (b[0] - x) * ix, (b[3] - x) * ix
            near, out = min(p, q), max(p, q)
            p, q = (b[1] - y) * iy, (b[4] - y) * iy
            near, out = max(near, min(p, q)), min(out, max(p, q))
            p, q = (b[2] - z) * iz, (b[5] - z) * iz
            near, out = max(near, min(p, q)), min(out, max(p, q))
            if near > out or out < 0 or near > best:
                continue
        for k in range(begin, min(begin + step, len(boxes))):
            p, q = (boxes[k, 0] - x) * ix, (boxes[k, 3] - x) * ix
            near, out, axis = min(p, q), max(p, q), 0
            p, q = (boxes[k, 1] - y) * iy, (boxes[k, 4] - y) * iy
            if min(p, q) > near:
                near, axis = min(p, q), 1
            out = min(out, max(p, q))
            p, q = (boxes[k, 2] - z) * iz, (boxes[k, 5] - z) * iz
            if min(p, q) > near:
                near, axis = min(p, q), 2
            out = min(out, max(p, q))
            if near <= out and near > 0 and near < best:
                best, which = near, k
                ahead = dx if axis == 0 else (dy if axis == 1 else dz)
                side = 2 * axis + (1 if ahead < 0 else 0)
    return which, best, side


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _turned(way, spin, axis, sign):
    """A direction of the hemisphere about z, turned by an angle and towards the side of a box."""
    c, s = np.cos(spin), np.sin(spin)
    u, v, w = c * way[0] - s * way[1], s * way[0] + c * way[1], sign * way[2]
    if axis == 0:
        return w, u, v
    if axis == 1:
        return u, w, v
    return u, v, w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def meet(first, last, points, sides, ways, boxes, bounds, starts, counts, hits):
    """Which texel of a light map each ray meets: from points [T, 3] on sides [T], along ways [R, 3] (hemispheres about z, turned by
    each point's number), boxes [K, 6]; starts [6 K], the first texel of each side, and counts [6 K, 2]; hits int32 [T, R]."""
    for t in range(first, last):
        axis, sign = sides[t] // 2, 1.0 if sides[t] % 2 else -1.0
        spin = (t * 0.6180339887498949) % 1.0 * 2 * np.pi
        for r in range(len(ways)):
            dx, dy, dz = _turned(ways[r], spin, axis, sign)
            x, y, z = points[t]
            k, far, side = _first(x, y, z, dx, dy, dz, boxes, bounds, 1e9)
            hits[t, r] = -1
            if k >= 0:
                p = (x + far * dx, y + far * dy, z + far * dz)
                a0, b0 = 0 if side >= 2 else 1, 2 if side < 4 else 1
                many, wide = counts[6 * k + side], boxes[k]
                i = min(int((p[a0] - wide[a0]) / max(wide[3 + a0] - wide[a0], 1e-9) * many[0]), many[0] - 1)
                j = min(int((p[b0] - wide[b0]) / max(wide[3 + b0] - wide[b0], 1e-9) * many[1]), many[1] - 1)
                hits[t, r] = starts[6 * k + side] + max(i, 0) * many[1] + max(j, 0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather(hits, thrown, light):
    """Means of thrown [T + 1, 3], the last for rays that meet nothing, over the rays hits [T, R]: light [T, 3]."""
    for t in range(len(hits)):
        a = b = c = np.float32(0)
        for r in range(hits.shape[1]):
            h = hits[t, r]
            a += thrown[h, 0]
            b += thrown[h, 1]
            c += thrown[h, 2]
        light[t, 0], light[t, 1], light[t, 2] = a / hits.shape[1], b / hits.shape[1], c / hits.shape[1]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shut(first, last, points, sides, ways, boxes, bounds, reach, closed):
    """How much is near points [T, 3] on sides [T], 0 to 1 (ambient occlusion): the mean over ways of 1 - distance / reach."""
    for t in range(first, last):
        axis, sign = sides[t] // 2, 1.0 if sides[t] % 2 else -1.0
        spin, total = (t * 0.6180339887498949) % 1.0 * 2 * np.pi, 0.0
        for r in range(len(ways)):
            dx, dy, dz = _turned(ways[r], spin, axis, sign)
            k, far, _ = _first(points[t, 0], points[t, 1], points[t, 2], dx, dy, dz, boxes, bounds, reach)
            total += 1 - far / reach if k >= 0 else 0.0
        closed[t] = total / len(ways)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shine(first, last, points, normals, lamps, power, lamp_normals, boxes, bounds, light):
    """Adds to light [T, 3] what lamps [L, 3] of power [L, 3] (radiance times area) send to points [T, 3] unhindered."""
    for t in range(first, last):
        for m in range(len(lamps)):
            dx, dy, dz = lamps[m, 0] - points[t, 0], lamps[m, 1] - points[t, 1], lamps[m, 2] - points[t, 2]
            far = np.sqrt(dx * dx + dy * dy + dz * dz)
            if far < 1e-3:
                continue
            dx, dy, dz = dx / far, dy / far, dz / far
            here = normals[t, 0] * dx + normals[t, 1] * dy + normals[t, 2] * dz
            facing = -(lamp_normals[m, 0] * dx + lamp_normals[m, 1] * dy + lamp_normals[m, 2] * dz)
            if here <= 0 or facing <= 0:
                continue
            k, _, _ = _first(points[t, 0], points[t, 1], points[t, 2], dx, dy, dz, boxes, bounds, far - 0.01)
            if k < 0:
                share = here * facing / (np.pi * max(far * far, 0.03))
                for c in range(3):
                    light[t, c] += share * power[m, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sunlit(first, last, points, normals, sun, wide, boxes, bounds, clear, lit):
    """How much sun [T] falls on points: its cosine where the first box towards it is `clear` [K]. The sun is a disc of `wide`
    radians, of which each point sees one place."""
    for t in range(first, last):
        here = normals[t, 0] * sun[0] + normals[t, 1] * sun[1] + normals[t, 2] * sun[2]
        lit[t] = 0.0
        if here > 0:
            turn, off = 2.399963229728653 * t, wide * math.sqrt((t * 0.6180339887498949) % 1.0)
            a, b = off * math.cos(turn), off * math.sin(turn)
            dx, dy, dz = sun[0] - a * sun[1], sun[1] + a * sun[0], sun[2] + b
            k, _, _ = _first(points[t, 0], points[t, 1], points[t, 2], dx, dy, dz, boxes, bounds, 1e9)
            if k >= 0 and clear[k]:
                lit[t] = here


@numba.njit(cache=True, nogil=True, error_model="numpy")
def in_any(first, last, points, boxes, margin, inside):
    """Whether points [N, 3] lie in one of boxes [K, 6] made larger by `margin` on all sides."""
    for n in range(first, last):
        inside[n] = False
        for k in range(len(boxes)):
            b = boxes[k]
            if (
                b[0] - margin < points[n, 0] < b[3] + margin
                and b[1] - margin < points[n, 1] < b[4] + margin
                and b[2] - margin < points[n, 2] < b[5] + margin
            ):
                inside[n] = True
                break


@numba.njit(cache=True, nogil=True, error_model="numpy")
def smooth(starts, counts, known, values, rounds):
    """Values [T, 3] of known texels, each the mean over the known around it on its side, `rounds` times."""
    for f in range(len(starts)):
        rows, columns, s = counts[f, 0], counts[f, 1], starts[f]
        for _ in range(rounds):
            old = values[s : s + rows * columns].copy()
            for i in range(rows):
                for j in range(columns):
                    if known[s + i * columns + j]:
                        _mean(old, known[s:], rows, columns, i, j, values[s + i * columns + j])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean(values, known, rows, columns, i, j, out):
    """Writes the mean of the known values around a texel; returns how many these are."""
    a = b = c = 0.0
    n = 0
    for p in range(max(i - 1, 0), min(i + 2, rows)):
        for q in range(max(j - 1, 0), min(j + 2, columns)):
            at = p * columns + q
            if known[at]:
                a += values[at, 0]
                b += values[at, 1]
                c += values[at, 2]
                n += 1
    if n:
        out[0], out[1], out[2] = a / n, b / n, c / n
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def carry(starts, counts, known, values):
    """Carries the values [T, 3] of known texels on to all others of the same side; of a side without any, to none. Afterwards
    `known` says which have one."""
    for f in range(len(starts)):
        rows, columns, s = counts[f, 0], counts[f, 1], starts[f]
        last, here = -1, 0
        for t in range(s, s + rows * columns):
            here += known[t]
        while here != last and 0 < here < rows * columns:
            last, before = here, known[s : s + rows * columns].copy()
            for i in range(rows):
                for j in range(columns):
                    at = i * columns + j
                    if not before[at] and _mean(values[s:], before, rows, columns, i, j, values[s + at]):
                        known[s + at] = True
                        here += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sample(first, last, points, normals, owners, boxes, starts, counts, values, out):
    """Values [T, C] of texels at points [N, 3] of blocks owners [N]: between the texels of each side, and between the sides in
    proportion to the squares of the normal [N, 3] (an ambient cube). out [N, C]."""
    for n in range(first, last):
        k = owners[n]
        for c in range(values.shape[1]):
            out[n, c] = 0.0
        weight = 0.0
        for axis in range(3):
            share = normals[n, axis] * normals[n, axis]
            face = 6 * k + 2 * axis + (1 if normals[n, axis] > 0 else 0)
            a, b = 0 if axis else 1, 2 if axis < 2 else 1
            rows, columns = counts[face, 0], counts[face, 1]
            if share < 1e-3 or rows == 0:
                continue
            weight += share
            u = (points[n, a] - boxes[k, a]) / max(boxes[k, 3 + a] - boxes[k, a], 1e-9) * rows - 0.5
            v = (points[n, b] - boxes[k, b]) / max(boxes[k, 3 + b] - boxes[k, b], 1e-9) * columns - 0.5
            i, j = int(np.floor(u)), int(np.floor(v))
            for p in (i, i + 1):
                for q in (j, j + 1):
                    w = share * (1 - abs(u - p)) * (1 - abs(v - q))
                    at = starts[face] + min(max(p, 0), rows - 1) * columns + min(max(q, 0), columns - 1)
                    for c in range(values.shape[1]):
                        out[n, c] += w * values[at, c]
        for c in range(values.shape[1]):
            out[n, c] /= max(weight, 1e-9)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def kinds(first, last, fronts, owners, boxes, objects, fixed, air, kind):
    """What the surface behind each of fronts [N, 3] is, on blocks owners [N]: 0 never visible, 1 visible, 1 + k beneath the fixed
    object k. objects [K] are those of the boxes (0: the building), fixed [K] says which cannot be pushed."""
    for n in range(first, last):
        x, y, z = fronts[n]
        own = objects[owners[n]]
        free, whose = own > 0 and not fixed[owners[n]], 0
        for k in range(len(air)):
            free = free or (_inside(air[k], x, y, z))
        for k in range(len(boxes)):
            if not free:
                break
            if _inside(boxes[k], x, y, z):
                if objects[k] == own or (objects[k] == 0 and fixed[owners[n]]):
                    free = False
                elif own == 0 and fixed[k]:
                    whose = objects[k]
        kind[n] = 1 + whose if free else 0


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _inside(b, x, y, z):
    return b[0] < x and x < b[3] and b[1] < y and y < b[4] and b[2] < z and z < b[5]
