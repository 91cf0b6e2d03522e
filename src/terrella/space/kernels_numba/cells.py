"""Cuts pictures on surfaces into rectangles of nearly one colour, small where the picture has detail (layout/cells.py).

Rows are copied number by number: Numba takes several times as long to compile whole arrays that are assigned or added.
"""

import heapq

import numba
import numpy as np

GRADED = 2.5  # a cell is at most this many times as long as its neighbour of another colour
CONTRAST = 0.03  # between cells of another colour
GROWTH = 2.0  # and near an edge, of any colour
EDGE_M = 0.012  # cells at an edge with air beyond it are at most this long across it
_KINDS = 1e3  # the error of a cell of two kinds


@numba.njit(cache=True, nogil=True, error_model="numpy")
def noise(u, v, wide, tall, seed, out):
    """Adds smooth noise in 0..1 whose blobs are wide by tall metres at u, v [N] to out [N]."""
    for n in range(len(u)):
        a, b = u[n] / wide, v[n] / tall
        i, j = np.floor(a), np.floor(b)
        s, t = a - i, b - j
        s, t = (3 - 2 * s) * s * s, (3 - 2 * t) * t * t
        i, j = np.int64(i), np.int64(j)
        low = _chance(seed, i, j) * (1 - s) + _chance(seed, i + 1, j) * s
        high = _chance(seed, i, j + 1) * (1 - s) + _chance(seed, i + 1, j + 1) * s
        out[n] = low * (1 - t) + high * t


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _chance(seed, i, j):
    mask = np.int64(0xFFFFFFFF)
    h = (seed * np.int64(2654435761) + i * np.int64(0x9E3779B1) + j * np.int64(0x85EBCA77)) & mask
    h = ((h ^ (h >> 15)) * np.int64(0x2C1B3C6D)) & mask
    h = ((h ^ (h >> 12)) * np.int64(0x297A2D39)) & mask
    return ((h ^ (h >> 15)) & mask) / 4294967295.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _error(n, s, k):
    """The squared error of a rectangle: of n texels, sums s (red, green, blue, squares), and of kinds k (sum, squares)."""
    if n == 0:
        return 0.0
    colour = s[3] - (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]) / n
    return max(colour, 0.0) + _KINDS * max(k[1] - k[0] * k[0] / n, 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _margins(node, start, columns, picture, kinds, rows_of, columns_of):
    """Sums over each row and column of a node [r0, r1, c0, c1]: red, green, blue, squares, kinds, their squares."""
    r0, r1, c0, c1 = node
    rows_of[: r1 - r0] = 0
    columns_of[: c1 - c0] = 0
    for i in range(r0, r1):
        for j in range(c0, c1):
            at = start + i * columns + j
            a, b, c, k = picture[at, 0], picture[at, 1], picture[at, 2], np.float64(kinds[at])
            values = (np.float64(a), np.float64(b), np.float64(c), np.float64(a * a + b * b + c * c), k, k * k)
            for m in range(6):
                rows_of[i - r0, m] += values[m]
                columns_of[j - c0, m] += values[m]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _best_cut(sums, many, other, slim):
    """Where to cut a node of `many` rows of `other` texels: the first row of the second part, and the error that is left."""
    total = np.zeros(6)
    for i in range(many):
        for m in range(6):
            total[m] += sums[i, m]
    left, rest, best, where = np.zeros(6), np.zeros(6), np.inf, many // 2
    for i in range(1, many):
        for m in range(6):
            left[m] += sums[i - 1, m]
        if i < slim or many - i < slim:
            continue
        for m in range(6):
            rest[m] = total[m] - left[m]
        here = _error(i * other, left[:4], left[4:]) + _error((many - i) * other, rest[:4], rest[4:])
        uneven = abs(2 * i - many) / many
        here = here * (1 + 0.2 * uneven) + 1e-9 * uneven
        if here < best:
            best, where = here, i
    return where, best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cut(node, face, starts, counts, steps, longest, picture, kinds, rows_of, columns_of):
    """The two parts [2, 4] of a node: along the axis that leaves the smaller error, unless the node is longer than `longest` metres
    or narrow."""
    r0, r1, c0, c1 = node
    rows, columns = r1 - r0, c1 - c0
    _margins(node, starts[face], counts[face, 1], picture, kinds, rows_of, columns_of)
    i, by_rows = _best_cut(rows_of, rows, columns, 1)
    j, by_columns = _best_cut(columns_of, columns, rows, 1)
    tall, wide = rows * steps[face, 0], columns * steps[face, 1]
    across = by_rows < by_columns if by_rows != by_columns else tall > wide
    if max(tall, wide) > longest[face] or max(tall, wide) > 9 * min(tall, wide):
        across = tall > wide
    if rows == 1 or columns == 1:
        across = columns == 1
    parts = np.empty((2, 4), np.int64)
    for m in range(4):
        parts[0, m] = parts[1, m] = node[m]
    if across:
        parts[0, 1] = parts[1, 0] = r0 + i
    else:
        parts[0, 3] = parts[1, 2] = c0 + j
    return parts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _stats(node, start, columns, picture, kinds):
    """Means of the colour [3], the colour's and the kinds' squared errors, and the kind in the middle."""
    s, k = np.zeros(4), np.zeros(2)
    r0, r1, c0, c1 = node
    for i in range(r0, r1):
        for j in range(c0, c1):
            at = start + i * columns + j
            a, b, c = picture[at, 0], picture[at, 1], picture[at, 2]
            s[0] += a
            s[1] += b
            s[2] += c
            s[3] += a * a + b * b + c * c
            k[0] += kinds[at]
            k[1] += kinds[at] * kinds[at]
    n = (r1 - r0) * (c1 - c0)
    colour = s[3] - (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]) / n
    middle = kinds[start + (r0 + r1) // 2 * columns + (c0 + c1) // 2]
    mean = s[:3]
    for m in range(3):
        mean[m] /= n
    return mean, max(colour, 0.0), max(k[1] - k[0] * k[0] / n, 0.0), middle


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean(out, node, start, columns, picture, kinds):
    """Writes the mean colour [3] of a node."""
    mean, _, _, _ = _stats(node, start, columns, picture, kinds)
    for m in range(3):
        out[m] = mean[m]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distance(one, other):
    """The largest difference of two colours [3]."""
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]), abs(one[2] - other[2]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cut(starts, counts, steps, longest, weights, picture, kinds, most):
    """Cuts faces F of texels (starts [F] the first of each, counts [F, 2], steps [F, 2] metres) with colours picture [M, 3] and
    kinds [M] (0: nothing there) into about `most` cells of one kind, no longer than longest [F] metres, the largest error times
    weights [F] first. Returns rows of face, r0, r1, c0, c1: int64 [n, 5]."""
    size = 2 * most + 8 * len(starts) + 64
    nodes, kept = np.empty((size, 5), np.int64), np.zeros(size, np.bool_)
    wide = max(counts[:, 0].max(), counts[:, 1].max())
    rows_of, columns_of = np.empty((wide, 6)), np.empty((wide, 6))
    heap = [(0.0, 0)]
    heap.pop()
    used = leaves = 0
    for f in range(len(starts)):
        nodes[used, 0], nodes[used, 1], nodes[used, 3] = f, 0, 0
        nodes[used, 2], nodes[used, 4] = counts[f, 0], counts[f, 1]
        used, leaves = _add(used, nodes, starts, counts, steps, longest, weights, picture, kinds, heap, kept, leaves)
    while len(heap) > 0 and used < size - 2:
        key, at = heapq.heappop(heap)
        if (key > -1e8 and leaves >= most) or key >= -1e-9:
            break
        f = nodes[at, 0]
        parts = _cut(nodes[at, 1:], f, starts, counts, steps, longest, picture, kinds, rows_of, columns_of)
        leaves -= kept[at]
        kept[at] = False
        for p in range(2):
            place = at if p == 0 else used
            nodes[place, 0] = f
            for m in range(4):
                nodes[place, 1 + m] = parts[p, m]
            after, leaves = _add(
                place, nodes, starts, counts, steps, longest, weights, picture, kinds, heap, kept, leaves
            )
            used = max(used, after)
    return nodes[:used][kept[:used]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(at, nodes, starts, counts, steps, longest, weights, picture, kinds, heap, kept, leaves):
    """Puts node `at` on the heap by its error, if it can be cut. Nodes of two kinds and those that are too long come first."""
    f = nodes[at, 0]
    _, colour, mixed, kind = _stats(nodes[at, 1:], starts[f], counts[f, 1], picture, kinds)
    rows, columns = nodes[at, 2] - nodes[at, 1], nodes[at, 4] - nodes[at, 3]
    kept[at] = kind > 0 or mixed > 0
    if not kept[at]:
        return at + 1, leaves
    key = colour * weights[f] * steps[f, 0] * steps[f, 1]
    if mixed > 0 or max(rows * steps[f, 0], columns * steps[f, 1]) > longest[f]:
        key += 1e9
    if rows * columns > 1:
        heapq.heappush(heap, (-key, at))
    else:
        kept[at] = kind > 0
    return at + 1, leaves + kept[at]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grade(cells, starts, counts, steps, picture, kinds, edges, most):
    """Cuts cells that are long beside a short neighbour of another colour or at an edge (bits of edges [M]: 1, 2, 4, 8 for the low
    and high row and column), so that they do not blur it. Returns the cells, and bits: 1, 2 where rows or columns grow from an
    edge."""
    owner = np.full(len(picture), -1, np.int64)
    size = max(most, len(cells))
    near = np.zeros(size, np.int64)
    out, means = np.empty((size, 5), np.int64), np.empty((size, 3))
    for n in range(len(cells)):
        for m in range(5):
            out[n, m] = cells[n, m]
        _paint(out[n], n, starts, counts, owner)
        f = out[n, 0]
        _mean(means[n], out[n, 1:], starts[f], counts[f, 1], picture, kinds)
    used = len(cells)
    for inner in (0, 1, 1):  # edges first
        n = 0
        while n < used and used < size:
            f = out[n, 0]
            if inner:
                side, short, grown = _short(out[n], n, starts, counts, owner, out, means, near)
            else:
                side, short = _at_edge(out[n], starts[f], counts[f, 1], steps[f], edges)
                bits = _open(out[n], starts[f], counts[f, 1], edges)
                near[n], grown = (1 if bits & 3 else 0) | (2 if bits & 12 else 0), side >= 0
            if side < 0:
                n += 1
                continue
            first, last = (1, 2) if side < 2 else (3, 4)
            new = out[used]
            for m in range(5):
                new[m] = out[n, m]
            if side % 2 == 0:
                new[last] = out[n, first] + short
                out[n, first] = new[last]
            else:
                new[first] = out[n, last] - short
                out[n, last] = new[first]
            _mean(means[used], new[1:], starts[f], counts[f, 1], picture, kinds)
            _mean(means[n], out[n, 1:], starts[f], counts[f, 1], picture, kinds)
            near[used] = near[n] | (1 if side < 2 else 2) * grown
            _paint(new, used, starts, counts, owner)
            used += 1
    return out[:used], near[:used]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _open(cell, start, columns, edges):
    """Bits of the sides of a cell of which half or more lies at an edge."""
    _, r0, r1, c0, c1 = cell
    bits = 0
    for side in range(4):
        many, total = 0, c1 - c0 if side < 2 else r1 - r0
        for k in range(total):
            i = (r0 if side == 0 else r1 - 1) if side < 2 else r0 + k
            j = c0 + k if side < 2 else (c0 if side == 2 else c1 - 1)
            many += (edges[start + i * columns + j] >> side) & 1
        if 2 * many >= total:
            bits |= 1 << side
    return bits


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _at_edge(cell, start, columns, step, edges):
    """On which side a cell is too long at an edge (-1: none), and the texels to cut off there."""
    bits = _open(cell, start, columns, edges)
    for side in range(4):
        if (bits >> side) & 1:
            long_ = cell[2] - cell[1] if side < 2 else cell[4] - cell[3]
            short = max(int(EDGE_M / step[0 if side < 2 else 1] + 0.5), 1)
            if long_ >= 2 * short:
                return side, short
    return -1, 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint(cell, n, starts, counts, owner):
    for i in range(cell[1], cell[2]):
        for j in range(cell[3], cell[4]):
            owner[starts[cell[0]] + i * counts[cell[0], 1] + j] = n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _short(cell, n, starts, counts, owner, cells, means, near):
    """On which side (low and high rows, low and high columns; -1: none) a cell has a neighbour of another colour beside which it is
    too long; the texels to cut off there; and whether because of an edge."""
    f, r0, r1, c0, c1 = cell
    for side in range(4):
        long_ = r1 - r0 if side < 2 else c1 - c0
        for k in range(c1 - c0 if side < 2 else r1 - r0):
            i = (r0 - 1 if side == 0 else r1) if side < 2 else r0 + k
            j = c0 + k if side < 2 else (c0 - 1 if side == 2 else c1)
            if i < 0 or j < 0 or i >= counts[f, 0] or j >= counts[f, 1]:
                continue
            other = owner[starts[f] + i * counts[f, 1] + j]
            if other < 0 or other == n:
                continue
            theirs = cells[other, 2] - cells[other, 1] if side < 2 else cells[other, 4] - cells[other, 3]
            grown = (near[other] >> (0 if side < 2 else 1)) & 1
            ratio = GROWTH if grown else GRADED
            if long_ <= ratio * theirs + 1 or not (grown or _distance(means[other], means[n]) >= CONTRAST):
                continue
            return side, max(int(ratio * theirs), 1), grown
    return -1, 0, 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shown(cells, starts, counts, picture, kinds, edges, sharper, out, kind, contrast, bits):
    """The mean colours [n, 3] of cells, with their difference to what is around them times 1 + sharper; their kind [n]; that
    difference [n]; and at which sides they have an edge [n]."""
    for n in range(len(cells)):
        f = cells[n, 0]
        rows, columns, start = counts[f, 0], counts[f, 1], starts[f]
        mean, _, _, kind[n] = _stats(cells[n, 1:], start, columns, picture, kinds)
        high, wide = (cells[n, 2] - cells[n, 1] + 1) // 2, (cells[n, 4] - cells[n, 3] + 1) // 2
        total, many = np.zeros(3), 0
        for i in range(max(cells[n, 1] - high, 0), min(cells[n, 2] + high, rows)):
            for j in range(max(cells[n, 3] - wide, 0), min(cells[n, 4] + wide, columns)):
                if kinds[start + i * columns + j] == kind[n]:
                    many += 1
                    for c in range(3):
                        total[c] += picture[start + i * columns + j, c]
        contrast[n] = 0.0
        for c in range(3):
            off = mean[c] - total[c] / many if many else 0.0
            out[n, c], contrast[n] = mean[c] + sharper * off, max(contrast[n], abs(off))
        bits[n] = _open(cells[n], start, columns, edges)
