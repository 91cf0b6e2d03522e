"""Light among upright boxes: what rays meet, and what shines on what (layout/bake.py)."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_box(x, y, z, dx, dy, dz, boxes, far):
    """The first of boxes [K, 6] (low and high corners) that a ray meets, -1 for none nearer than `far`; how far; on which side
    (0 to 5: the low and the high end of each axis). Boxes in which the ray begins are passed."""
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    best, side, which = far, 0, -1
    for k in range(len(boxes)):
        a, b = (boxes[k, 0] - x) * ix, (boxes[k, 3] - x) * ix
        near, out, axis = min(a, b), max(a, b), 0
        a, b = (boxes[k, 1] - y) * iy, (boxes[k, 4] - y) * iy
        if min(a, b) > near:
            near, axis = min(a, b), 1
        out = min(out, max(a, b))
        a, b = (boxes[k, 2] - z) * iz, (boxes[k, 5] - z) * iz
        if min(a, b) > near:
            near, axis = min(a, b), 2
        out = min(out, max(a, b))
        if near <= out and near > 0 and near < best:
            best, which = near, k
            ahead = dx if axis == 0 else (dy if axis == 1 else dz)
            side = 2 * axis + (1 if ahead < 0 else 0)
    return which, best, side


@numba.njit(cache=True, nogil=True, error_model="numpy")
def meet(first, last, points, sides, ways, boxes, starts, counts, hits):
    """Which texel of a light map each ray meets: from points [T, 3] on sides [T], along ways [R, 3] (hemispheres about z, turned by
    each point's number), boxes [K, 6]; starts [6 K], the first texel of each side, and counts [6 K, 2]; hits int32 [T, R]."""
    for t in range(first, last):
        axis, sign = sides[t] // 2, 1.0 if sides[t] % 2 else -1.0
        spin = (t * 0.6180339887498949) % 1.0 * 2 * np.pi
        c, s = np.cos(spin), np.sin(spin)
        for r in range(len(ways)):
            u, v, w = c * ways[r, 0] - s * ways[r, 1], s * ways[r, 0] + c * ways[r, 1], sign * ways[r, 2]
            if axis == 0:
                dx, dy, dz = w, u, v
            elif axis == 1:
                dx, dy, dz = u, w, v
            else:
                dx, dy, dz = u, v, w
            x, y, z = points[t]
            k, far, side = first_box(x, y, z, dx, dy, dz, boxes, 1e9)
            hits[t, r] = -1
            if k >= 0:
                p = (x + far * dx, y + far * dy, z + far * dz)
                a0, b0 = 0 if side >= 2 else 1, 2 if side < 4 else 1
                many, wide = counts[6 * k + side], boxes[k]
                i = min(int((p[a0] - wide[a0]) / max(wide[3 + a0] - wide[a0], 1e-9) * many[0]), many[0] - 1)
                j = min(int((p[b0] - wide[b0]) / max(wide[3 + b0] - wide[b0], 1e-9) * many[1]), many[1] - 1)
                hits[t, r] = starts[6 * k + side] + max(i, 0) * many[1] + max(j, 0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shine(first, last, points, normals, lamps, power, lamp_normals, boxes, light):
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
            k, _, _ = first_box(points[t, 0], points[t, 1], points[t, 2], dx, dy, dz, boxes, far - 0.01)
            if k < 0:
                share = here * facing / (np.pi * max(far * far, 0.02))
                for c in range(3):
                    light[t, c] += share * power[m, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sunlit(first, last, points, normals, sun, boxes, clear, lit):
    """How much sun [T] falls on points: its cosine where the first box towards it is `clear` [K]."""
    for t in range(first, last):
        here = normals[t, 0] * sun[0] + normals[t, 1] * sun[1] + normals[t, 2] * sun[2]
        lit[t] = 0.0
        if here > 0:
            k, _, _ = first_box(points[t, 0], points[t, 1], points[t, 2], sun[0], sun[1], sun[2], boxes, 1e9)
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
