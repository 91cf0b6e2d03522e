"""Paint: billboards into frames (billboards.py)."""

import math

import numba
import numpy as np

from .planes import between

TOUCHED = 0.1  # of a pixel that a billboard covers, above which it is the billboard's


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint(picture, sides, far, number, hides, rgb, depth, instances):
    """Paints a picture [4, h, w] into the box `sides` (left, right, top, bottom, in pixels), `far` metres ahead, of rgb [3, H, W],
    depth [H, W] and instances [H, W] where `hides` [H, W] is farther; a pixel is the mean of four places, for soft edges."""
    left, right, top, bottom = sides
    height, width = depth.shape
    _, rows, columns = picture.shape
    tall, wide = rows / max(bottom - top, 1e-6), columns / max(right - left, 1e-6)
    colour = np.zeros(3)
    for v in range(max(0, math.floor(top)), min(height, math.ceil(bottom))):
        for u in range(max(0, math.floor(left)), min(width, math.ceil(right))):
            if hides[v, u] <= far:
                continue
            cover = 0.0
            colour[:] = 0.0
            for part in range(4):
                a = (u + 0.25 + 0.5 * (part & 1) - left) * wide
                b = (v + 0.25 + 0.5 * (part >> 1) - top) * tall
                if a < 0 or a > columns or b < 0 or b > rows:
                    continue
                a, b = min(max(a - 0.5, 0.0), columns - 1.0), min(max(b - 0.5, 0.0), rows - 1.0)
                i, j = min(int(a), columns - 2), min(int(b), rows - 2)
                a, b = a - i, b - j
                if between(picture[3], i, j, a, b) <= 0.5:
                    continue
                cover += 0.25
                for c in range(3):
                    colour[c] += 0.25 * between(picture[c], i, j, a, b)
            for c in range(3):
                rgb[c, v, u] = rgb[c, v, u] * (1 - cover) + colour[c]
            if cover > 0.5:
                depth[v, u] = far
            if cover > TOUCHED:
                instances[v, u] = number


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint_views(first, last, order, present, pictures, sides, far, hides, rgb, depth, instances):
    """`paint` for the billboards of all views that are `present` bool [B, K], in their `order` [B, K], the nearest last."""
    for b in range(first, last):
        for k in order[b]:
            if present[b, k]:
                paint(pictures[b, k], sides[b, k], far[b, k], k + 1, hides[b], rgb[b], depth[b], instances[b])
