"""The compiled kernel of moves.py; tests hold it against its slow, obvious twin."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def around(plane, row, mean):
    """Means [H, W] of the 5 x 5 pixels around each of a plane [H, W], as far as they lie in it; `row` [H, W] is overwritten."""
    height, width = plane.shape
    for v in range(height):
        for u in range(width):
            total, first, stop = np.float32(0), max(0, u - 2), min(width, u + 3)
            for i in range(first, stop):
                total += plane[v, i]
            row[v, u] = total / np.float32(stop - first)
    for v in range(height):
        first, stop = max(0, v - 2), min(height, v + 3)
        for u in range(width):
            total = np.float32(0)
            for j in range(first, stop):
                total += row[j, u]
            mean[v, u] = total / np.float32(stop - first)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def explained(frames, truth, moves, scales, share, stays):
    """The kernel of moves.explained_slowly: frames uint8 [B, slots, 3, H, W], truth uint8 [B, 3, H, W], moves [M, 2]; fills share
    [B, sources, H, W] and stays [B, H, W]."""
    batch, sources, height, width = share.shape
    sharp, near, never = scales
    differs, row = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    mean, least = np.empty((sources, height, width), np.float32), np.empty((height, width), np.float32)
    for b in range(batch):
        least[:] = np.inf
        for k in range(sources):
            slot = max(0, k - len(moves) + 1)
            x, y = (moves[k, 0], moves[k, 1]) if slot == 0 else (0, 0)
            for v in range(height):
                j = min(max(v - y, 0), height - 1)
                for u in range(width):
                    i = min(max(u - x, 0), width - 1)
                    most, total = 0, 0
                    for c in range(3):
                        off = abs(np.int64(frames[b, slot, c, j, i]) - np.int64(truth[b, c, v, u]))
                        total += off
                        most = max(most, off)
                    differs[v, u] = total / 3
                    share[b, k, v, u] = most
            around(differs, row, mean[k])
            least = np.minimum(least, mean[k])
        stays[b] = share[b, 0]
        for k in range(sources):
            for v in range(height):
                for u in range(width):
                    own = share[b, k, v, u]
                    if own > never:
                        share[b, k, v, u] = 0
                        continue
                    found = math.exp(-(mean[k, v, u] - least[v, u]) / near - max(own - 4, 0) / sharp)
                    share[b, k, v, u] = found / 2 if k and stays[b, v, u] == 0 else found
