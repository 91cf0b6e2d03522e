"""Surfaces: depth images lifted to patches, and patches cast into views (patches.py)."""

import math

import numba
import numpy as np

from ..camera import NEAR_M


@numba.njit(cache=True, nogil=True, error_model="numpy")
def lift(depth, turn, position, patch, camera, stride, slant):
    """The kernel of patches.patches_slowly for one image: depth [H, W], turn [3, 3] and position [3] of T_world_cam;
    fills patch [N, 9]."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    rim, first, n = max(1, round(0.75 * stride)), stride // 2, 0
    ramp_u, ramp_v = 1 / (width * fx), 1 / (height * fy)
    longest = (slant * ramp_u) ** 2
    for v in range(first, height, stride):
        up = -((v + 0.5) / height - cy) / fy
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        top, bottom = max(v - rim, 0), min(v + rim, height - 1)
        for u in range(first, width, stride):
            side, here = -((u + 0.5) / width - cx) / fx, depth[v, u]
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            a0, b0 = here - depth[v, left], depth[v, right] - here  # to the right: of both neighbours the nearer one
            a1, b1 = a0 * side - depth[v, left] * ramp_u, b0 * side - depth[v, right] * ramp_u
            a2, b2 = a0 * up, b0 * up
            aa, bb = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
            if u == right or (u != left and aa < bb):
                b0, b1, b2, bb = a0, a1, a2, aa
            c0, d0 = here - depth[above, u], depth[below, u] - here  # and down
            c1, d1 = c0 * side, d0 * side
            c2, d2 = c0 * up - depth[above, u] * ramp_v, d0 * up - depth[below, u] * ramp_v
            cc, dd = c0 * c0 + c1 * c1 + c2 * c2, d0 * d0 + d1 * d1 + d2 * d2
            if v == below or (v != above and cc < dd):
                d0, d1, d2, dd = c0, c1, c2, cc
            reach = 0.0
            if max(bb, dd) <= longest * here * here:
                west, east = max(u - rim, 0), min(u + rim, width - 1)
                twice = 2 / max(here, NEAR_M)
                bend = abs(1 / max(depth[v, west], NEAR_M) + 1 / max(depth[v, east], NEAR_M) - twice)
                bend = max(bend, abs(1 / max(depth[top, u], NEAR_M) + 1 / max(depth[bottom, u], NEAR_M) - twice))
                bend = max(bend, abs(1 / max(depth[top, west], NEAR_M) + 1 / max(depth[bottom, east], NEAR_M) - twice))
                bend = max(bend, abs(1 / max(depth[top, east], NEAR_M) + 1 / max(depth[bottom, west], NEAR_M) - twice))
                reach = 0.75 * stride if bend < 0.025 * twice else 0.5
            b0, b1, b2, d0, d1, d2 = reach * b0, reach * b1, reach * b2, reach * d0, reach * d1, reach * d2
            p1, p2 = here * side, here * up
            for c in range(3):
                x, y, z = turn[c, 0], turn[c, 1], turn[c, 2]
                patch[n, c] = position[c] + x * here + y * p1 + z * p2
                patch[n, 3 + c] = x * b0 + y * b1 + z * b2
                patch[n, 6 + c] = x * d0 + y * d1 + z * d2
            n += 1


@numba.njit(cache=True, fastmath=False, nogil=True, error_model="numpy")
def cover(plane, centre, sides, nearest, block, camera, depth):
    """Lowers the pixels of `block` (first row, stop, first column, stop) of `depth` that a patch covers: its plane's normal and
    distance, its centre and both half sides in the camera's frame; camera = fx, fy, cx, cy in pixels."""
    n0, n1, n2, lift = plane
    c0, c1, c2 = centre
    a0, a1, a2, d0, d1, d2 = sides
    fx, fy, cx, cy = camera
    aa, ad, dd = a0 * a0 + a1 * a1 + a2 * a2, a0 * d0 + a1 * d1 + a2 * d2, d0 * d0 + d1 * d1 + d2 * d2
    determinant = max(aa * dd - ad * ad, 1e-20)
    for v in range(block[0], block[1]):
        up = -(v + 0.5 - cy) / fy
        for u in range(block[2], block[3]):
            if depth[v, u] < nearest:  # no point of the patch is nearer
                continue
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


@numba.njit(cache=True, fastmath=False, nogil=True, error_model="numpy")
def cast_one(patch, turn, position, camera, depth):
    """patch [N, 9], turn [3, 3] and position [3] of T_world_cam, camera intrinsics; lowers `depth` [H, W] to what they show."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    fx, cx, fy, cy = fx * width, cx * width, fy * height, cy * height
    to_right, to_left = (cx - width) / fx if cx < width else -1e9, cx / fx if cx > 0 else 1e9  # the rim of the picture
    to_bottom, to_top = (cy - height) / fy if cy < height else -1e9, cy / fy if cy > 0 else 1e9
    for n in range(len(patch)):
        x, y, z = patch[n, 0] - position[0], patch[n, 1] - position[1], patch[n, 2] - position[2]
        c0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        if c0 <= NEAR_M:
            continue
        c1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        c2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        reach = abs(patch[n, 3]) + abs(patch[n, 4]) + abs(patch[n, 5])  # no corner is farther from the centre
        reach += abs(patch[n, 6]) + abs(patch[n, 7]) + abs(patch[n, 8])
        deepest = c0 + reach
        if c1 + reach <= deepest * to_right or c1 - reach >= deepest * to_left:
            continue
        if c2 + reach <= deepest * to_bottom or c2 - reach >= deepest * to_top:
            continue
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
        left, right, top, bottom, nearest = 1e9, -1e9, 1e9, -1e9, 1e9
        for corner in range(4):
            s = 1.0 if corner & 1 else -1.0
            t = 1.0 if corner & 2 else -1.0
            q0 = max(c0 + s * a0 + t * d0, NEAR_M)
            nearest = min(nearest, q0)
            u = cx - fx * (c1 + s * a1 + t * d1) / q0
            v = cy - fy * (c2 + s * a2 + t * d2) / q0
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if right <= 0 or left >= width or bottom <= 0 or top >= height:
            continue
        first_u, last_u = max(int(math.ceil(left - 0.5)), 0), min(int(math.floor(right - 0.5)), width - 1)
        first_v, last_v = max(int(math.ceil(top - 0.5)), 0), min(int(math.floor(bottom - 0.5)), height - 1)
        if first_u > last_u or first_v > last_v:
            continue
        plane, sides = (n0, n1, n2, lift), (a0, a1, a2, d0, d1, d2)
        block = (first_v, last_v + 1, first_u, last_u + 1)
        cover(plane, (c0, c1, c2), sides, nearest, block, (fx, fy, cx, cy), depth)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def surfaces(first, last, picks, fine, own, own_turns, own_poses, turns, positions, camera, stride, slant, depth):
    """Lowers depth [B, H, W] to what the picked keyframes [B, S] (-1: none) show: those below K by their patches `fine`
    [K, N, 9], the others by the depth images own [A, h, w], from their turn [A, 3, 3] and pose [A, 7]."""
    known = len(fine)
    down, across = own.shape[1], own.shape[2]
    patch = np.empty((len(range(stride // 2, down, stride)) * len(range(stride // 2, across, stride)), 9), np.float32)
    for view in range(first, last):
        for key in picks[view]:
            if key >= known:
                row = key - known
                lift(own[row], own_turns[row], own_poses[row, :3], patch, camera, stride, slant)
                cast_one(patch, turns[view], positions[view], camera, depth[view])
            elif key >= 0:
                cast_one(fine[key], turns[view], positions[view], camera, depth[view])
