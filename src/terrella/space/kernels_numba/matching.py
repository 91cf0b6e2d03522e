"""Kernels of matching.py and mosaic.py: pixels that a displacement explains, the scroll of a picture, and the mosaic."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def around(plane, rows, mean):
    """Means [H, W] over the 5 x 5 neighbours of each pixel of a plane [H, W], edges cut off; overwrites `rows` [H, W + 4]."""
    height, width = plane.shape
    for v in range(height):
        first, stop = max(0, v - 2), min(height, v + 3)
        rows[v] = 0
        for j in range(first, stop):
            for u in range(width):
                rows[v, u + 2] += plane[j, u]
        for u in range(width):
            total = rows[v, u] + rows[v, u + 1] + rows[v, u + 2] + rows[v, u + 3] + rows[v, u + 4]
            mean[v, u] = total / np.float32((min(width, u + 3) - max(0, u - 2)) * (stop - first))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def half_pixel_bounds(frame, bounds):
    """The kernel of matching.half_pixel_bounds_slowly: frame uint8 [3, H, W]; fills bounds uint8 [2, 3, H, W]."""
    _, height, width = frame.shape
    above, row = np.empty((height, width), np.int32), np.empty(width, np.int32)
    for which in range(2):
        for c in range(3):
            for v in range(height):
                one, here, other = frame[c, max(v - 1, 0)], frame[c, v], frame[c, min(v + 1, height - 1)]
                for u in range(width):
                    own, a, b = np.int32(here[u]) * 16, np.int32(one[u]) * 16, np.int32(other[u]) * 16
                    near = min(a, b) if which == 0 else max(a, b)
                    half = (own + near) // 2
                    above[v, u] = min(own, half) if which == 0 else max(own, half)
            for v in range(height):
                row[:] = above[v]
                for u in range(width):
                    a, b = row[max(u - 1, 0)], row[min(u + 1, width - 1)]
                    near = min(a, b) if which == 0 else max(a, b)
                    half = (row[u] + near) // 2
                    bounds[which, c, v, u] = (min(row[u], half) if which == 0 else max(row[u], half)) // 16


@numba.njit(cache=True, nogil=True, error_model="numpy")
def differences(low, high, truth, x, y, most, mean):
    """The largest and the mean difference [H, W] between the colours of `truth` uint8 [3, H, W] and the range `low` to `high`
    uint8 [3, H, W] displaced by x, y."""
    _, height, width = truth.shape
    first, stop = min(max(0, x), width), max(min(width, width + x), 0)
    for v in range(height):
        j = min(max(v - y, 0), height - 1)
        most[v], mean[v] = 0, 0
        for c in range(3):
            least, largest, here = low[c, j], high[c, j], truth[c, v]
            for u in range(first):
                off = np.float32(max(np.int32(least[0]) - here[u], np.int32(here[u]) - largest[0], 0))
                most[v, u], mean[v, u] = max(most[v, u], off), mean[v, u] + off
            for u in range(first, stop):
                off = np.float32(max(np.int32(least[u - x]) - here[u], np.int32(here[u]) - largest[u - x], 0))
                most[v, u], mean[v, u] = max(most[v, u], off), mean[v, u] + off
            for u in range(stop, width):
                off = np.float32(max(np.int32(least[width - 1]) - here[u], np.int32(here[u]) - largest[width - 1], 0))
                most[v, u], mean[v, u] = max(most[v, u], off), mean[v, u] + off
        mean[v] *= np.float32(1 / 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def source_shares(frames, bounds, truth, share, stays, moves, scales):
    """The kernel of matching.source_shares_slowly: frames uint8 [slots, 3, H, W], bounds uint8 [2, 3, H, W] of the first of them,
    truth uint8 [3, H, W], moves [M, 2]; fills share [sources, H, W] and stays [H, W]."""
    sources, height, width = share.shape
    sharp, near, never = np.float32(scales[0]), np.float32(scales[1]), np.float32(scales[2])
    differs, rows = np.empty((height, width), np.float32), np.empty((height, width + 4), np.float32)
    mean, least = np.empty((sources, height, width), np.float32), np.empty((height, width), np.float32)
    least[:] = np.inf
    for k in range(sources):
        slot = max(0, k - len(moves) + 1)
        x, y = (moves[k, 0], moves[k, 1]) if slot == 0 else (0, 0)
        if 0 < k < len(moves):
            differences(bounds[0], bounds[1], truth, x, y, share[k], differs)
        else:
            differences(frames[slot], frames[slot], truth, x, y, share[k], differs)
        around(differs, rows, mean[k])
        for v in range(height):
            for u in range(width):
                least[v, u] = min(least[v, u], mean[k, v, u])
    stays[:] = share[0]
    for k in range(sources):
        for v in range(height):
            for u in range(width):
                own, worse = share[k, v, u], mean[k, v, u] - least[v, u]
                if own > never or worse > 8 * near:
                    share[k, v, u] = 0
                    continue
                share[k, v, u] = np.exp(-worse / near - max(own - np.float32(4), np.float32(0)) / sharp)


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
def majority_colours(frames, share, painted, drawn, moves, limits):
    """The kernel of matching.majority_colours_slowly: frames uint8 [slots, 3, H, W], share [sources + 1, H, W], painted and drawn
    uint8 [3, H, W]; fills drawn. Sources of the same colour are merged."""
    last, height, width = share.shape[0] - 1, share.shape[1], share.shape[2]
    same, few, equal, stress = np.int32(limits[0]), np.float32(limits[1]), np.int32(limits[2]), np.float32(limits[3])
    colour, weight = np.empty((last + 1, 3), np.int32), np.empty(last + 1, np.float32)
    for v in range(height):
        for u in range(width):
            count = 0
            for k in range(last + 1):
                if share[k, v, u] < few and k:
                    continue
                slot = max(0, k - len(moves) + 1)
                x, y = (moves[k, 0], moves[k, 1]) if slot == 0 else (0, 0)
                j, i = min(max(v - y, 0), height - 1), min(max(u - x, 0), width - 1)
                at = 0
                for c in range(3):
                    colour[count, c] = painted[c, v, u] if k == last else frames[slot, c, j, i]
                while at < count and not (
                    colour[at, 0] == colour[count, 0]
                    and colour[at, 1] == colour[count, 1]
                    and colour[at, 2] == colour[count, 2]
                ):
                    at += 1
                weight[at] = share[k, v, u] + (weight[at] if at < count else np.float32(0))
                count += at == count
            best, most = 0, np.float32(-1)
            for a in range(count):
                total, stays = np.float32(0), False
                for b in range(count):
                    off = max(
                        abs(colour[a, 0] - colour[b, 0]),
                        abs(colour[a, 1] - colour[b, 1]),
                        abs(colour[a, 2] - colour[b, 2]),
                    )
                    if off <= same:
                        total += weight[b]
                    if b == 0:
                        stays = off <= equal
                total *= stress if stays else np.float32(1)
                if total > most * np.float32(1.001):
                    best, most = a, total
            for c in range(3):
                drawn[c, v, u] = colour[best, c]


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
