"""Splats: Gaussians as ellipses in the image, and the gradients backward (raster/rasterise.py). EWA splatting (Zwicker et al.
2001) as in 3D Gaussian Splatting (Kerbl et al. 2023). Camera x forward, y left, z up.

A splat is a row of float32: column, row (pixels), A, B, C (the exponent at an offset (x, y) is A x^2 + B x y + C y^2), opacity, the
largest exponent that is still drawn, red, green, blue, depth, half extents along columns and rows, 3 unused."""

import math

import numba
import numpy as np

from .harmonics import basis, slopes

SPLAT = 16  # numbers of a splat
BLUR = np.float32(0.3)  # pixels^2 that each splat is widened by
FAINTEST = np.float32(1 / 255)  # opacity below which nothing is drawn
_WIDE = np.float32(1.3)  # share of the half image beyond which the lens is held linear
_ONE, _TWO, _HALF = np.float32(1), np.float32(2), np.float32(0.5)
_PI = np.float32(math.pi)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def turned(q, n):
    """The rotation matrix, row by row, of the quaternion q[n], and its length."""
    w, x, y, z = q[n, 0], q[n, 1], q[n, 2], q[n, 3]
    length = math.sqrt(w * w + x * x + y * y + z * z) + np.float32(1e-12)
    w, x, y, z = w / length, x / length, y / length, z / length
    return (
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y), length,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def seen_at(d, e, h, lens, panorama):
    """Of a point d ahead, e to the left and h above: its column, row and depth, and how column and row change with d, e and h.
    lens: fx, fy, cx, cy in pixels, width, height."""
    if panorama:
        flat2 = d * d + e * e
        flat, r2 = math.sqrt(flat2), flat2 + h * h
        wide, tall = lens[4] / (_TWO * _PI), lens[5] / _PI
        u = lens[4] * _HALF - wide * math.atan2(e, d)
        v = lens[5] * _HALF - tall * math.atan2(h, flat)
        s = tall * h / (flat * r2)
        return u, v, math.sqrt(r2), wide * e / flat2, -wide * d / flat2, np.float32(0), s * d, s * e, -tall * flat / r2
    near = _ONE / d
    a, b = e * near, h * near
    u, v = lens[2] - lens[0] * a, lens[3] - lens[1] * b
    most_a = _WIDE * max(lens[2], lens[4] - lens[2]) / lens[0]
    most_b = _WIDE * max(lens[3], lens[5] - lens[3]) / lens[1]
    a, b = min(max(a, -most_a), most_a), min(max(b, -most_b), most_b)
    zero = np.float32(0)
    return u, v, d, lens[0] * a * near, -lens[0] * near, zero, lens[1] * b * near, zero, -lens[1] * near


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _out_of_sight(d, e, h, reach, lens, panorama, near):
    if panorama:
        return d * d + e * e + h * h < near * near or d * d + e * e < np.float32(1e-6) * h * h
    if d < near:
        return True
    across = max(lens[2], lens[4] - lens[2]) / lens[0]
    upward = max(lens[3], lens[5] - lens[3]) / lens[1]
    slack = np.float32(1.02)
    return (
        abs(e) - across * slack * d > reach * math.sqrt(_ONE + across * across) + np.float32(2) / lens[0] * d
        or abs(h) - upward * slack * d > reach * math.sqrt(_ONE + upward * upward) + np.float32(2) / lens[1] * d
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def project(first, last, means, quats, scales, opacities, sh, place, rot, lens, panorama, near, splats, which, depths):
    """Writes the visible splats of the Gaussians `first` to `last` from row `first` on, and their indices; returns their number.
    means [N, 3], quats [N, 4] wxyz, scales [N, 3] metres, opacities [N], sh [N, K, 3]; place [3] and rot [3, 3] of the camera."""
    count, many = first, sh.shape[1]
    y = np.empty(16, np.float32)
    for n in range(first, last):
        o = opacities[n]
        if not o > FAINTEST:
            continue
        x0, x1, x2 = means[n, 0] - place[0], means[n, 1] - place[1], means[n, 2] - place[2]
        d = rot[0, 0] * x0 + rot[1, 0] * x1 + rot[2, 0] * x2
        e = rot[0, 1] * x0 + rot[1, 1] * x1 + rot[2, 1] * x2
        h = rot[0, 2] * x0 + rot[1, 2] * x1 + rot[2, 2] * x2
        s0, s1, s2 = scales[n, 0], scales[n, 1], scales[n, 2]
        reach = np.float32(3.34) * max(s0, max(s1, s2))
        if _out_of_sight(d, e, h, reach, lens, panorama, near):
            continue
        u, v, z, j0, j1, j2, k0, k1, k2 = seen_at(d, e, h, lens, panorama)
        r0, r1, r2, r3, r4, r5, r6, r7, r8, _ = turned(quats, n)
        a0 = j0 * rot[0, 0] + j1 * rot[0, 1] + j2 * rot[0, 2]
        a1 = j0 * rot[1, 0] + j1 * rot[1, 1] + j2 * rot[1, 2]
        a2 = j0 * rot[2, 0] + j1 * rot[2, 1] + j2 * rot[2, 2]
        b0 = k0 * rot[0, 0] + k1 * rot[0, 1] + k2 * rot[0, 2]
        b1 = k0 * rot[1, 0] + k1 * rot[1, 1] + k2 * rot[1, 2]
        b2 = k0 * rot[2, 0] + k1 * rot[2, 1] + k2 * rot[2, 2]
        m0, m1, m2 = (
            (a0 * r0 + a1 * r3 + a2 * r6) * s0,
            (a0 * r1 + a1 * r4 + a2 * r7) * s1,
            (a0 * r2 + a1 * r5 + a2 * r8) * s2,
        )
        n0, n1, n2 = (
            (b0 * r0 + b1 * r3 + b2 * r6) * s0,
            (b0 * r1 + b1 * r4 + b2 * r7) * s1,
            (b0 * r2 + b1 * r5 + b2 * r8) * s2,
        )
        p = m0 * m0 + m1 * m1 + m2 * m2 + BLUR
        q = m0 * n0 + m1 * n1 + m2 * n2
        r = n0 * n0 + n1 * n1 + n2 * n2 + BLUR
        most = math.log(o / FAINTEST)
        ex, ey = math.sqrt(_TWO * most * p), math.sqrt(_TWO * most * r)
        if v + ey < 0 or v - ey > lens[5] or (not panorama and (u + ex < 0 or u - ex > lens[4])) or not p * r > q * q:
            continue
        inverse = _ONE / (p * r - q * q)
        splats[count, 0], splats[count, 1] = u, v
        splats[count, 2], splats[count, 3], splats[count, 4] = _HALF * r * inverse, -q * inverse, _HALF * p * inverse
        splats[count, 5], splats[count, 6] = o, most
        far = _ONE / max(math.sqrt(x0 * x0 + x1 * x1 + x2 * x2), np.float32(1e-12))
        basis(x0 * far, x1 * far, x2 * far, many, y)
        for c in range(3):
            colour = _HALF
            for k in range(many):
                colour += y[k] * sh[n, k, c]
            splats[count, 7 + c] = max(colour, np.float32(0))
        splats[count, 10], splats[count, 11], splats[count, 12] = z, ex, ey
        which[count], depths[count] = n, z
        count += 1
    return count - first


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _bent(d, e, h, lens, panorama, g):
    """What gradients g[0:6] of the six slopes of `seen_at` are for the point itself."""
    if panorama:
        flat2 = d * d + e * e
        flat, r2 = math.sqrt(flat2), flat2 + h * h
        wide, tall = lens[4] / (_TWO * _PI), lens[5] / _PI
        f4, r4 = flat2 * flat2, r2 * r2
        gd = wide * (g[0] * -_TWO * e * d / f4 - g[1] * (_ONE / flat2 - _TWO * d * d / f4))
        gl = wide * (g[0] * (_ONE / flat2 - _TWO * e * e / f4) + g[1] * _TWO * d * e / f4)
        s = tall * h / (flat * r2)
        both = g[3] * d + g[4] * e
        steep = -s * (_ONE / flat2 + _TWO / r2)
        gd += g[3] * s + both * steep * d + g[5] * tall * d * (_TWO * flat / r4 - _ONE / (flat * r2))
        gl += g[4] * s + both * steep * e + g[5] * tall * e * (_TWO * flat / r4 - _ONE / (flat * r2))
        gh = both * tall * (_ONE / (flat * r2) - _TWO * h * h / (flat * r4)) + g[5] * tall * _TWO * flat * h / r4
        return gd, gl, gh
    near = _ONE / d
    a, b = e * near, h * near
    most_a = _WIDE * max(lens[2], lens[4] - lens[2]) / lens[0]
    most_b = _WIDE * max(lens[3], lens[5] - lens[3]) / lens[1]
    gd = (lens[0] * g[1] + lens[1] * g[5]) * near * near
    gl = gh = np.float32(0)
    if abs(a) < most_a:
        gl = g[0] * lens[0] * near * near
        gd -= _TWO * g[0] * lens[0] * a * near * near
    else:
        gd -= g[0] * lens[0] * min(max(a, -most_a), most_a) * near * near
    if abs(b) < most_b:
        gh = g[3] * lens[1] * near * near
        gd -= _TWO * g[3] * lens[1] * b * near * near
    else:
        gd -= g[3] * lens[1] * min(max(b, -most_b), most_b) * near * near
    return gd, gl, gh


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _directed(n, y, steep, gc, many, x0, x1, x2, sh, g_sh):
    """Adds the gradients gc[0:3] of a colour to its harmonics g_sh[n]; what they are for the Gaussian's offset (x0, x1, x2)."""
    length = max(math.sqrt(x0 * x0 + x1 * x1 + x2 * x2), np.float32(1e-12))
    d0, d1, d2 = x0 / length, x1 / length, x2 / length
    basis(d0, d1, d2, many, y)
    for k in range(many):
        for c in range(3):
            g_sh[n, k, c] += y[k] * gc[c]
    if many == 1:
        return np.float32(0), np.float32(0), np.float32(0)
    slopes(d0, d1, d2, many, steep)
    g0 = g1 = g2 = np.float32(0)
    for k in range(1, many):
        both = gc[0] * sh[n, k, 0] + gc[1] * sh[n, k, 1] + gc[2] * sh[n, k, 2]
        g0 += both * steep[k, 0]
        g1 += both * steep[k, 1]
        g2 += both * steep[k, 2]
    along = g0 * d0 + g1 * d1 + g2 * d2
    return (g0 - along * d0) / length, (g1 - along * d1) / length, (g2 - along * d2) / length


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _summed(grads, i, g):
    """The gradients g[0:10] of splat i over all threads."""
    for c in range(10):
        g[c] = 0
        for t in range(len(grads)):
            g[c] += grads[t, i, c]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def project_back(first, last, grads, splats, which, means, quats, scales, sh, place, rot, lens, panorama, g_means, g_quats,
                 g_scales, g_opacities, g_sh):  # fmt: skip
    """Adds to the gradients of the Gaussians what those of their splats `first` to `last` say: grads [threads, V, 10], of
    column, row, A, B, C, opacity, red, green, blue, depth."""
    many = sh.shape[1]
    y, steep = np.empty(16, np.float32), np.empty((16, 3), np.float32)
    g, gj, gc = np.empty(10, np.float32), np.empty(6, np.float32), np.empty(3, np.float32)
    for i in range(first, last):
        _summed(grads, i, g)
        n = which[i]
        x0, x1, x2 = means[n, 0] - place[0], means[n, 1] - place[1], means[n, 2] - place[2]
        d = rot[0, 0] * x0 + rot[1, 0] * x1 + rot[2, 0] * x2
        e = rot[0, 1] * x0 + rot[1, 1] * x1 + rot[2, 1] * x2
        h = rot[0, 2] * x0 + rot[1, 2] * x1 + rot[2, 2] * x2
        u, v, z, j0, j1, j2, k0, k1, k2 = seen_at(d, e, h, lens, panorama)
        # of the covariance [[p, q], [q, r]], through its inverse [[2A, B], [B, 2C]]
        a, b, c2 = _TWO * splats[i, 2], splats[i, 3], _TWO * splats[i, 4]
        ga, gb, gcc = _HALF * g[2], _HALF * g[3], _HALF * g[4]
        t0, t1, t2, t3 = a * ga + b * gb, a * gb + b * gcc, b * ga + c2 * gb, b * gb + c2 * gcc
        gp, gq, gr = -(t0 * a + t1 * b), -(t0 * b + t1 * c2), -(t2 * b + t3 * c2)
        r0, r1, r2, r3, r4, r5, r6, r7, r8, length = turned(quats, n)
        a0 = j0 * rot[0, 0] + j1 * rot[0, 1] + j2 * rot[0, 2]
        a1 = j0 * rot[1, 0] + j1 * rot[1, 1] + j2 * rot[1, 2]
        a2 = j0 * rot[2, 0] + j1 * rot[2, 1] + j2 * rot[2, 2]
        b0 = k0 * rot[0, 0] + k1 * rot[0, 1] + k2 * rot[0, 2]
        b1 = k0 * rot[1, 0] + k1 * rot[1, 1] + k2 * rot[1, 2]
        b2 = k0 * rot[2, 0] + k1 * rot[2, 1] + k2 * rot[2, 2]
        m0, m1, m2 = a0 * r0 + a1 * r3 + a2 * r6, a0 * r1 + a1 * r4 + a2 * r7, a0 * r2 + a1 * r5 + a2 * r8
        n0, n1, n2 = b0 * r0 + b1 * r3 + b2 * r6, b0 * r1 + b1 * r4 + b2 * r7, b0 * r2 + b1 * r5 + b2 * r8
        s0, s1, s2 = scales[n, 0], scales[n, 1], scales[n, 2]
        # of M diag(s), whose rows are m and n: 2 [[gp, gq], [gq, gr]] M diag(s)
        e0, e1, e2 = _TWO * (gp * m0 + gq * n0) * s0, _TWO * (gp * m1 + gq * n1) * s1, _TWO * (gp * m2 + gq * n2) * s2
        f0, f1, f2 = _TWO * (gq * m0 + gr * n0) * s0, _TWO * (gq * m1 + gr * n1) * s1, _TWO * (gq * m2 + gr * n2) * s2
        g_scales[n, 0] += e0 * m0 + f0 * n0
        g_scales[n, 1] += e1 * m1 + f1 * n1
        g_scales[n, 2] += e2 * m2 + f2 * n2
        e0, e1, e2, f0, f1, f2 = e0 * s0, e1 * s1, e2 * s2, f0 * s0, f1 * s1, f2 * s2
        _turned_back(n, quats, length, a0 * e0 + b0 * f0, a0 * e1 + b0 * f1, a0 * e2 + b0 * f2, a1 * e0 + b1 * f0,
                     a1 * e1 + b1 * f1, a1 * e2 + b1 * f2, a2 * e0 + b2 * f0, a2 * e1 + b2 * f1, a2 * e2 + b2 * f2,
                     g_quats)  # fmt: skip
        a0, a1, a2 = e0 * r0 + e1 * r1 + e2 * r2, e0 * r3 + e1 * r4 + e2 * r5, e0 * r6 + e1 * r7 + e2 * r8
        b0, b1, b2 = f0 * r0 + f1 * r1 + f2 * r2, f0 * r3 + f1 * r4 + f2 * r5, f0 * r6 + f1 * r7 + f2 * r8
        for c in range(3):
            gj[c] = a0 * rot[0, c] + a1 * rot[1, c] + a2 * rot[2, c]
            gj[3 + c] = b0 * rot[0, c] + b1 * rot[1, c] + b2 * rot[2, c]
            gc[c] = g[6 + c] if splats[i, 7 + c] > 0 else np.float32(0)
        gd, gl, gh = _bent(d, e, h, lens, panorama, gj)
        if panorama:
            u0, u1, u2, v0, v1, v2 = j0, j1, j2, k0, k1, k2
            gd, gl, gh = gd + g[9] * d / z, gl + g[9] * e / z, gh + g[9] * h / z
        else:  # not held linear
            u0, u1, u2 = lens[0] * e / (d * d), -lens[0] / d, np.float32(0)
            v0, v1, v2 = lens[1] * h / (d * d), np.float32(0), -lens[1] / d
            gd += g[9]
        gd, gl, gh = gd + g[0] * u0 + g[1] * v0, gl + g[0] * u1 + g[1] * v1, gh + g[0] * u2 + g[1] * v2
        c0, c1, c2 = _directed(n, y, steep, gc, many, x0, x1, x2, sh, g_sh)
        g_means[n, 0] += rot[0, 0] * gd + rot[0, 1] * gl + rot[0, 2] * gh + c0
        g_means[n, 1] += rot[1, 0] * gd + rot[1, 1] * gl + rot[1, 2] * gh + c1
        g_means[n, 2] += rot[2, 0] * gd + rot[2, 1] * gl + rot[2, 2] * gh + c2
        g_opacities[n] += g[5]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _turned_back(n, quats, length, d0, d1, d2, d3, d4, d5, d6, d7, d8, g_quats):
    """Adds to g_quats[n] what the gradients of a rotation matrix, row by row, are for its quaternion."""
    w, x, y, z = quats[n, 0] / length, quats[n, 1] / length, quats[n, 2] / length, quats[n, 3] / length
    gw = _TWO * (x * (d7 - d5) + y * (d2 - d6) + z * (d3 - d1))
    gx = _TWO * (y * (d1 + d3) + z * (d2 + d6) + w * (d7 - d5) - _TWO * x * (d4 + d8))
    gy = _TWO * (x * (d1 + d3) + z * (d5 + d7) + w * (d2 - d6) - _TWO * y * (d0 + d8))
    gz = _TWO * (x * (d2 + d6) + y * (d5 + d7) + w * (d3 - d1) - _TWO * z * (d0 + d4))
    along = w * gw + x * gx + y * gy + z * gz
    g_quats[n, 0] += (gw - along * w) / length
    g_quats[n, 1] += (gx - along * x) / length
    g_quats[n, 2] += (gy - along * y) / length
    g_quats[n, 3] += (gz - along * z) / length
