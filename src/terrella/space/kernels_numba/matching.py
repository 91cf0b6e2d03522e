"""Kernels of matching.py and mosaic.py: the scroll of a picture, and the mosaic."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge_shares(before, after, shares, moves, same, textured):
    """The kernel of matching.edge_shares_slowly: before, after uint8 [3, H, W], moves [M, 2]; fills shares [M]."""
    _, height, width = after.shape
    count = 0
    shares[:] = 0
    for v in range(1, height, 2):
        for u in range(1, width, 2):
            edge = 0
            for c in range(3):
                own = np.int32(after[c, v, u])
                edge = max(edge, abs(own - np.int32(after[c, v - 1, u])), abs(own - np.int32(after[c, v, u - 1])))
            if edge <= textured:
                continue
            count += 1
            for k in range(len(moves)):
                j, i = v - moves[k, 1], u - moves[k, 0]
                if j < 1 or i < 1 or j >= height or i >= width:
                    continue
                off = 0
                for c in range(3):
                    off = max(off, abs(np.int32(before[c, j, i]) - np.int32(after[c, v, u])))
                    off = max(off, abs(np.int32(before[c, j - 1, i]) - np.int32(after[c, v - 1, u])))
                    off = max(off, abs(np.int32(before[c, j, i - 1]) - np.int32(after[c, v, u - 1])))
                if off <= same:
                    shares[k] += 1
    for k in range(len(moves)):
        shares[k] /= max(count, 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def update_mosaic(mosaic, frame, move, after, over, same, most):
    """The kernel of mosaic.update_mosaic_slowly: mosaic and after uint8 [4, H', W'], frame uint8 [3, H, W], move [2], over
    bool [H, W]; fills after."""
    _, tall, wide = mosaic.shape
    _, height, width = frame.shape
    x, y = move[0], move[1]
    for c in range(4):
        for v in range(tall):
            j = v - y
            if j < 0 or j >= tall:
                after[c, v] = 0
                continue
            first, stop = max(0, x), min(wide, wide + x)
            after[c, v, :first] = 0
            after[c, v, first:stop] = mosaic[c, j, first - x : stop - x]
            after[c, v, stop:] = 0
    top, left = (tall - height) // 2, (wide - width) // 2
    for v in range(height):
        for u in range(width):
            if over[v, u]:
                continue
            votes, off = after[3, top + v, left + u], 0
            for c in range(3):
                off = max(off, abs(np.int32(after[c, top + v, left + u]) - np.int32(frame[c, v, u])))
            if votes > 0 and off <= same:
                after[3, top + v, left + u] = min(votes + 1, most)
            elif votes > 1:
                after[3, top + v, left + u] = votes - 1
            else:
                for c in range(3):
                    after[c, top + v, left + u] = frame[c, v, u]
                after[3, top + v, left + u] = 1
