"""Carried: what the last frames show of another view (reproject.py)."""

import numba
import numpy as np

from ..camera import NEAR_M, SAME
from .planes import between


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reproject(u, v, depth, turn, position, new_turn, new_position, camera):
    """Where the surface that is depth[v, u] deep in the view from turn [3, 3] and position [3] lies in that from
    the new ones: how far ahead, and its image coordinates (in [0, 1] where it is seen; meaningless where it lies behind)."""
    rows, columns = depth.shape
    fx, fy, cx, cy = camera
    side, up, far = -((u + 0.5) / columns - cx) / fx, -((v + 0.5) / rows - cy) / fy, depth[v, u]
    x = far * (turn[0, 0] + side * turn[0, 1] + up * turn[0, 2]) + position[0] - new_position[0]
    y = far * (turn[1, 0] + side * turn[1, 1] + up * turn[1, 2]) + position[1] - new_position[1]
    z = far * (turn[2, 0] + side * turn[2, 1] + up * turn[2, 2]) + position[2] - new_position[2]
    ahead = new_turn[0, 0] * x + new_turn[1, 0] * y + new_turn[2, 0] * z
    a = cx - fx * (new_turn[0, 1] * x + new_turn[1, 1] * y + new_turn[2, 1] * z) / ahead
    b = cy - fy * (new_turn[0, 2] * x + new_turn[1, 2] * y + new_turn[2, 2] * z) / ahead
    return ahead, a, b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def carry(rgb, depth, turn, position, known, seen, target_turn, target_position, carried, camera):
    """The kernel of reproject.carry_unknown_slowly for one view: a frame's rgb uint8 [3, H, W] and depth [h, w] from its turn
    [3, 3] and position [3]; what the view knows [V, U] and sees [V, U] from its own; fills `carried` [4, V, U], which is 0."""
    _, height, width = rgb.shape
    rows, columns = seen.shape
    for v in range(rows):
        for u in range(columns):
            wanted = 1 - known[v, u]
            if wanted <= 0:
                continue
            ahead, a, b = reproject(u, v, seen, target_turn, target_position, turn, position, camera)
            if ahead <= NEAR_M or a < 0 or a > 1 or b < 0 or b > 1:
                continue
            i, j = min(int(a * depth.shape[1]), depth.shape[1] - 1), min(int(b * depth.shape[0]), depth.shape[0] - 1)
            trust = wanted * min(max(1.5 - abs(depth[j, i] - ahead) / ahead / SAME, 0.0), 1.0)
            if trust <= 0:
                continue
            carried[3, v, u] = trust
            a, b = min(max(a * width - 0.5, 0.0), width - 1.0), min(max(b * height - 0.5, 0.0), height - 1.0)
            i, j = min(int(a), width - 2), min(int(b), height - 2)
            a, b = a - i, b - j
            for c in range(3):
                carried[c, v, u] = between(rgb[c], i, j, a, b) / 255


@numba.njit(cache=True, nogil=True, error_model="numpy")
def splat(depth, things, turn, position, target_turn, target_position, flat, canvas, camera):
    """The first half of reproject.carry_things_slowly for one frame: depth and things [H, W] from its turn [3, 3] and position
    [3]. Fills flat [H, W], the depth with that of things averaged, and lowers `canvas` [H, W] to its splat in the target view."""
    height, width = depth.shape
    sums, counts = np.zeros((height + 1, width + 1)), np.zeros((height + 1, width + 1))  # of all above and to the left
    for v in range(height):
        for u in range(width):
            here = things[v, u] > 0.5
            sums[v + 1, u + 1] = sums[v, u + 1] + sums[v + 1, u] - sums[v, u] + (depth[v, u] if here else 0.0)
            counts[v + 1, u + 1] = counts[v, u + 1] + counts[v + 1, u] - counts[v, u] + (1.0 if here else 0.0)
    for v in range(height):
        for u in range(width):
            far = depth[v, u]
            if things[v, u] > 0.5:
                top, bottom, left, right = max(v - 4, 0), min(v + 5, height), max(u - 4, 0), min(u + 5, width)
                far = (sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]) / (
                    counts[bottom, right] - counts[top, right] - counts[bottom, left] + counts[top, left]
                )
            flat[v, u] = far
            ahead, a, b = reproject(u, v, flat, turn, position, target_turn, target_position, camera)
            a, b = a * width, b * height
            if ahead > NEAR_M and 0 <= a < width and 0 <= b < height and ahead < canvas[int(b), int(a)]:
                canvas[int(b), int(a)] = ahead


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fetch(rgb, flat, things, covered, turn, position, seen, target_turn, target_position, carried, camera):
    """The second half of the same: what the frame shows (rgb uint8 [3, H, W], the others [H, W]) of what the target sees [H, W];
    fills carried [6, H, W] = colour, trust, `seen`, things."""
    height, width = flat.shape
    for v in range(height):
        for u in range(width):
            carried[4, v, u] = seen[v, u]
            ahead, a, b = reproject(u, v, seen, target_turn, target_position, turn, position, camera)
            if ahead <= NEAR_M or a < 0 or a > 1 or b < 0 or b > 1:
                continue
            i, j = min(int(a * width), width - 1), min(int(b * height), height - 1)
            trust = min(max(1.5 - abs(flat[j, i] - ahead) / ahead / SAME, 0.0), 1.0)
            if covered[j, i] or trust <= 0:
                continue
            for c in range(3):
                carried[c, v, u] = rgb[c, j, i] / 255
            carried[3, v, u], carried[5, v, u] = trust, things[j, i]
