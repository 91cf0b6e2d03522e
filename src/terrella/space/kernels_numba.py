"""The compiled kernels of this room; each has a slow, obvious twin beside its caller that tests compare it with."""

from __future__ import annotations

import math

import numba

NEAR_M = 0.05


@numba.njit(cache=True, fastmath=False, nogil=True, error_model="numpy")
def cast_one(patch, turn, eye, camera, depth):
    """patch [N, 9], turn [3, 3] and eye [3] of T_world_cam, camera intrinsics; fills `depth` [H, W] in place."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    fx, cx, fy, cy = fx * width, cx * width, fy * height, cy * height
    depth[:] = 100.0
    for n in range(len(patch)):
        x, y, z = patch[n, 0] - eye[0], patch[n, 1] - eye[1], patch[n, 2] - eye[2]
        c0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        if c0 <= NEAR_M:
            continue
        c1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        c2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        x, y, z = patch[n, 3], patch[n, 4], patch[n, 5]
        a0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        a1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        a2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        x, y, z = patch[n, 6], patch[n, 7], patch[n, 8]
        d0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        d1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        d2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        n0, n1, n2 = d1 * a2 - d2 * a1, d2 * a0 - d0 * a2, d0 * a1 - d1 * a0
        lift = n0 * c0 + n1 * c1 + n2 * c2
        if lift >= 0:  # it shows its back
            continue
        left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
        for corner in range(4):
            s = 1.0 if corner & 1 else -1.0
            t = 1.0 if corner & 2 else -1.0
            q0 = max(c0 + s * a0 + t * d0, NEAR_M)
            u = cx - fx * (c1 + s * a1 + t * d1) / q0
            v = cy - fy * (c2 + s * a2 + t * d2) / q0
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if right <= 0 or left >= width or bottom <= 0 or top >= height:
            continue
        first_u, last_u = max(int(math.ceil(left - 0.5)), 0), min(int(math.floor(right - 0.5)), width - 1)
        first_v, last_v = max(int(math.ceil(top - 0.5)), 0), min(int(math.floor(bottom - 0.5)), height - 1)
        if first_u > last_u or first_v > last_v:
            continue
        aa, ad, dd = a0 * a0 + a1 * a1 + a2 * a2, a0 * d0 + a1 * d1 + a2 * d2, d0 * d0 + d1 * d1 + d2 * d2
        determinant = max(aa * dd - ad * ad, 1e-20)
        for v in range(first_v, last_v + 1):
            up = -(v + 0.5 - cy) / fy
            for u in range(first_u, last_u + 1):
                side = -(u + 0.5 - cx) / fx
                slope = n0 + n1 * side + n2 * up
                if abs(slope) < 1e-12:
                    slope = -1e-12
                along = lift / slope
                if along <= NEAR_M or along >= depth[v, u]:
                    continue
                o0, o1, o2 = along - c0, along * side - c1, along * up - c2
                oa, od = o0 * a0 + o1 * a1 + o2 * a2, o0 * d0 + o1 * d1 + o2 * d2
                if abs(oa * dd - od * ad) <= determinant and abs(od * aa - oa * ad) <= determinant:
                    depth[v, u] = along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def feel(segments, places, heading, free):
    """segments [S, 4], places [N, 2], heading [D, 2]; lowers `free` [N, D], which starts at the reach, in place."""
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        reach = free[n, 0]
        for s in range(len(segments)):
            ax, ay, bx, by = segments[s, 0] - x, segments[s, 1] - y, segments[s, 2] - x, segments[s, 3] - y
            if min(ax, bx) > reach or max(ax, bx) < -reach or min(ay, by) > reach or max(ay, by) < -reach:
                continue
            ex, ey = bx - ax, by - ay
            for d in range(len(heading)):
                hx, hy = heading[d, 0], heading[d, 1]
                across = hx * ey - hy * ex
                if abs(across) < 1e-9:
                    continue
                along = (ax * ey - ay * ex) / across
                share = (ax * hy - ay * hx) / across
                if 0 <= along < free[n, d] and -0.02 <= share <= 1.02:
                    free[n, d] = along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def vote(points, distance, depth, turn, eye, camera, votes):
    """The kernel of keyframes.vote_slowly: points [P, 3] and distance [P]; keyframes' depth [K, h, w], turn [K, 3, 3]
    and eye [K, 3] of T_world_cam; fills votes [K, P]."""
    keys, height, width = depth.shape
    fx, fy, cx, cy = camera
    for k in range(keys):
        for p in range(len(points)):
            votes[k, p] = 0.0
            x, y, z = points[p, 0] - eye[k, 0], points[p, 1] - eye[k, 1], points[p, 2] - eye[k, 2]
            ahead = turn[k, 0, 0] * x + turn[k, 1, 0] * y + turn[k, 2, 0] * z
            if ahead <= NEAR_M or distance[p] >= 100.0:
                continue
            u = cx - fx * (turn[k, 0, 1] * x + turn[k, 1, 1] * y + turn[k, 2, 1] * z) / ahead
            v = cy - fy * (turn[k, 0, 2] * x + turn[k, 1, 2] * y + turn[k, 2, 2] * z) / ahead
            if u <= 0 or u >= 1 or v <= 0 or v >= 1:
                continue
            if abs(depth[k, int(v * height), int(u * width)] - ahead) < 0.06 * ahead:
                ratio = distance[p] / ahead
                votes[k, p] = min(ratio, 1 / max(ratio, 1e-3))
