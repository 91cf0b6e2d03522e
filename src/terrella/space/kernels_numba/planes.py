"""Planes: values between pixels, and holes filled from coarser averages (reproject.py)."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def between(plane, i, j, a, b):
    """The plane [h, w] a share `a` of the way from column i to the next and `b` from row j."""
    above = plane[j, i] * (1 - a) + plane[j, i + 1] * a
    below = plane[j + 1, i] * (1 - a) + plane[j + 1, i + 1] * a
    return above * (1 - b) + below * b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill(depth, near, filled, far, levels):
    """The kernel of reproject.fill_holes_slowly for one view: depth [H, W], `far` in holes, and the least around each pixel, near
    [H, W]; fills `filled` [H, W]."""
    height, width = depth.shape
    values, weights = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    holes = False
    for v in range(height):
        for u in range(width):
            here, least = depth[v, u], near[v, u]
            if here > least * 1.3:  # a leak, where most around belong to the nearer surface
                count = 0
                for j in range(max(v - 1, 0), min(v + 2, height)):
                    for i in range(max(u - 1, 0), min(u + 2, width)):
                        count += depth[j, i] < near[j, i] * 1.15
                if count >= 5:
                    here = least
            filled[v, u] = here
            if here < far:
                values[v, u], weights[v, u] = 1 / here, 1
            else:
                holes = True
    if not holes:
        return
    stack = [(values, weights)]
    while len(stack) <= levels and weights.min() <= 1e-6:
        values, weights = halved(values), halved(weights)
        stack.append((values, weights))
    coarse = values / np.maximum(weights, np.float32(1e-6))
    for level in range(len(stack) - 2, -1, -1):
        values, weights = stack[level]
        fine = np.empty_like(values)
        down, across = coarse.shape[0] / values.shape[0], coarse.shape[1] / values.shape[1]
        for v in range(values.shape[0]):
            for u in range(values.shape[1]):
                if weights[v, u] > 1e-6:
                    fine[v, u] = values[v, u] / weights[v, u]
                    continue
                a, b = max((u + 0.5) * across - 0.5, 0.0), max((v + 0.5) * down - 0.5, 0.0)
                i, j = int(a), int(b)
                right, below = min(i + 1, coarse.shape[1] - 1), min(j + 1, coarse.shape[0] - 1)
                top = coarse[j, i] * (1 - a + i) + coarse[j, right] * (a - i)
                bottom = coarse[below, i] * (1 - a + i) + coarse[below, right] * (a - i)
                fine[v, u] = top * (1 - b + j) + bottom * (b - j)
        coarse = fine
    for v in range(height):
        for u in range(width):
            if filled[v, u] >= far:
                filled[v, u] = 1 / max(coarse[v, u], 1 / far)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def halved(plane):
    """The means [ceil(h / 2), ceil(w / 2)] of the squares of two pixels of a plane [h, w]."""
    height, width = plane.shape
    small = np.empty(((height + 1) // 2, (width + 1) // 2), np.float32)
    for v in range(small.shape[0]):
        for u in range(small.shape[1]):
            below, right = min(2 * v + 1, height - 1), min(2 * u + 1, width - 1)  # at an odd edge one counts twice
            above = plane[2 * v, 2 * u] + plane[2 * v, right]
            small[v, u] = np.float32(0.25) * (above + plane[below, 2 * u] + plane[below, right])
    return small
