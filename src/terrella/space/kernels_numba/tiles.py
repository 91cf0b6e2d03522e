"""Tiles: splats (splats.py) sorted by depth and assigned to tiles of 16 by 16 pixels, a row of which is one SIMD vector."""

import math

import numba
import numpy as np

TILE = 16
PLANES = 7  # transmittance, red, green, blue, depth, the largest weight and whose it is
OPAQUE = np.float32(0.99)  # no splat hides more
SPENT = np.float32(1e-4)  # transmittance of a tile below which nothing behind is drawn
# exp(-x) for x in 0..0.7, minimax; its 8th power is exp(-8 x)
_E1, _E2, _E3 = np.float32(-0.999994529), np.float32(0.49989709), np.float32(-0.166018131)
_E4, _E5 = np.float32(0.039832286), np.float32(-0.005876452)
_ONE, _EIGHTH, _ZERO = np.float32(1), np.float32(0.125), np.float32(0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def depth_order(keys, order, spare_keys, spare):
    """Sorts rows by `keys`, the bits of positive float32 as uint32 [n]: order [n] int32, the nearest first, equal ones as they were
    (radix sort, 3 times 11 bits). Both are changed; the spare arrays are as long."""
    for turn in range(3):
        shift = np.uint32(11 * turn)
        count = np.zeros(2049, np.int64)
        for i in range(len(keys)):
            count[((keys[i] >> shift) & np.uint32(2047)) + 1] += 1
        for b in range(2048):
            count[b + 1] += count[b]
        for i in range(len(keys)):
            b = (keys[i] >> shift) & np.uint32(2047)
            at = count[b]
            count[b] += 1
            spare_keys[at], spare[at] = keys[i], order[i]
        keys, spare_keys, order, spare = spare_keys, keys, spare, order
    return order


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather(first, last, order, splats, which, sorted_splats, sorted_which):
    """Puts rows into their order."""
    for i in range(first, last):
        k = order[i]
        for c in range(13):
            sorted_splats[i, c] = splats[k, c]
        sorted_which[i] = which[k]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _touches(u, v, a, b, c, most, left, right, top, bottom):
    """Whether the ellipse at (u, v) whose exponent is at most `most` meets the pixels from (left, top) to (right, bottom)."""
    x0, x1, y0, y1 = left - u, right - u, top - v, bottom - v
    inside_x, inside_y = x0 <= 0 and x1 >= 0, y0 <= 0 and y1 >= 0
    if inside_x and inside_y:
        return True
    if not inside_x:
        x = x0 if x0 > 0 else x1
        y = min(max(-b * x / (c + c), y0), y1)
        if (a * x + b * y) * x + c * y * y <= most:
            return True
    if not inside_y:
        y = y0 if y0 > 0 else y1
        x = min(max(-b * y / (a + a), x0), x1)
        if (a * x + b * y) * x + c * y * y <= most:
            return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def bin_splats(first, last, splats, width, height, around, counts, items, fill):
    """Goes through the splats `first` to `last` and the tiles that each touches. Without `fill` counts them in counts [tiles]; with
    it writes their numbers to items, from counts[tile] on, which it moves on. around: width of a picture that closes on itself."""
    across = (width + TILE - 1) // TILE
    half = np.float32(0.5)
    for k in range(first, last):
        u, v, ex, ey = splats[k, 0], splats[k, 1], splats[k, 11], splats[k, 12]
        a, b, c, most = splats[k, 2], splats[k, 3], splats[k, 4], splats[k, 6]
        y0 = max(0, int(math.floor((v - ey - half) / TILE)))
        y1 = min((height - 1) // TILE, int(math.floor((v + ey - half) / TILE)))
        sides = 0 if around == 0 else (1 if ex + ex < around else -1)
        for side in range(-abs(sides), abs(sides) + 1):
            at = u + np.float32(side * around)
            x0 = max(0, int(math.floor((at - ex - half) / TILE)))
            x1 = min(across - 1, int(math.floor((at + ex - half) / TILE)))
            if sides == -1:  # it goes all around
                if side != 0:
                    continue
                x0, x1 = 0, across - 1
            one = (x0 == x1 or y0 == y1) or sides == -1
            for ty in range(y0, y1 + 1):
                for tx in range(x0, x1 + 1):
                    left, top = np.float32(tx * TILE) + half, np.float32(ty * TILE) + half
                    far = np.float32(TILE - 1)
                    if one or _touches(at, v, a, b, c, most, left, left + far, top, top + far):
                        tile = ty * across + tx
                        if fill:
                            items[counts[tile]] = k
                        counts[tile] += 1


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _place(u, tx, around):
    """The column of a splat as seen from a tile that begins at column tx, of a picture that may close on itself."""
    at = u - np.float32(tx) - np.float32(0.5)
    if around > 0:
        middle = at - np.float32(TILE / 2)
        at -= np.float32(around) * np.float32(math.floor(middle / around + np.float32(0.5)))
    return at


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def paint_tiles(first, step, splats, which, starts, items, around, picture, ids, ends):
    """Paints the tiles first, first + step, ...: picture [5, H, W] = red, green, blue, depth, all weighted, and alpha;
    ids [H, W], which Gaussian has the largest weight, -1 for none; ends [tiles], how many splats each went through."""
    _, height, width = picture.shape
    across = (width + TILE - 1) // TILE
    planes, columns = np.empty((TILE, PLANES * TILE), np.float32), np.empty(TILE, np.float32)
    for x in range(TILE):
        columns[x] = x
    for t in range(first, len(starts) - 1, step):
        tx, ty = t % across * TILE, t // across * TILE
        tall, wide = min(TILE, height - ty), min(TILE, width - tx)
        planes[:] = _ZERO
        for y in range(TILE):
            for x in range(TILE):
                planes[y, x] = _ONE
                planes[y, 6 * TILE + x] = -_ONE
        end = starts[t + 1]
        for n in range(starts[t], starts[t + 1]):
            k = items[n]
            u, v = _place(splats[k, 0], tx, around), splats[k, 1] - np.float32(ty) - np.float32(0.5)
            a, b, c, o, most = splats[k, 2], splats[k, 3], splats[k, 4], splats[k, 5], splats[k, 6]
            red, green, blue, z, ey = splats[k, 7], splats[k, 8], splats[k, 9], splats[k, 10], splats[k, 12]
            number = np.float32(k)
            for y in range(max(0, int(math.ceil(v - ey))), min(tall, int(math.floor(v + ey)) + 1)):
                row = planes[y]
                dy = np.float32(y) - v
                base, lean = c * dy * dy, b * dy
                for x in range(TILE):
                    dx = columns[x] - u
                    q = base + dx * (lean + a * dx)
                    s = q * _EIGHTH
                    e = _ONE + s * (_E1 + s * (_E2 + s * (_E3 + s * (_E4 + s * _E5))))
                    e = e * e
                    e = e * e
                    e = e * e
                    w = row[x] * (min(o * e, OPAQUE) if q <= most else _ZERO)
                    row[x] -= w
                    row[TILE + x] += w * red
                    row[2 * TILE + x] += w * green
                    row[3 * TILE + x] += w * blue
                    row[4 * TILE + x] += w * z
                    best = row[5 * TILE + x]
                    row[5 * TILE + x] = max(w, best)
                    row[6 * TILE + x] = number if w > best else row[6 * TILE + x]
            if (n - starts[t]) & 15 == 15 and _spent(planes, tall, wide):
                end = n + 1
                break
        ends[t] = end
        for y in range(tall):
            for x in range(wide):
                for c in range(4):
                    picture[c, ty + y, tx + x] = planes[y, (c + 1) * TILE + x]
                picture[4, ty + y, tx + x] = _ONE - planes[y, x]
                k = int(planes[y, 6 * TILE + x])
                ids[ty + y, tx + x] = which[k] if k >= 0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _spent(planes, tall, wide):
    """Whether so little light is left in all pixels of a tile that what lies behind does not count."""
    for y in range(tall):
        most = _ZERO
        for x in range(wide):
            most = max(most, planes[y, x])
        if most > SPENT:
            return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def paint_back(first, step, splats, starts, items, ends, around, picture, g_picture, grads):
    """The gradients of `paint_tiles`, from front to back: g_picture [5, H, W] -> added to grads [V, 10]: of column, row, A, B, C,
    opacity, red, green, blue, depth."""
    _, height, width = picture.shape
    across = (width + TILE - 1) // TILE
    planes, columns = np.empty((TILE, 6 * TILE), np.float32), np.empty(TILE, np.float32)
    sums = np.empty((8, TILE), np.float32)
    for x in range(TILE):
        columns[x] = x
    for t in range(first, len(starts) - 1, step):
        tx, ty = t % across * TILE, t // across * TILE
        tall, wide = min(TILE, height - ty), min(TILE, width - tx)
        planes[:] = _ZERO
        for y in range(tall):  # transmittance, what is behind, and the four gradients
            for x in range(wide):
                planes[y, x] = _ONE
                behind = g_picture[4, ty + y, tx + x] * (picture[4, ty + y, tx + x] - _ONE)
                for c in range(4):
                    g = g_picture[c, ty + y, tx + x]
                    behind += g * picture[c, ty + y, tx + x]
                    planes[y, (2 + c) * TILE + x] = g
                planes[y, TILE + x] = behind
        for n in range(starts[t], ends[t]):
            k = items[n]
            u, v = _place(splats[k, 0], tx, around), splats[k, 1] - np.float32(ty) - np.float32(0.5)
            a, b, c, o, most = splats[k, 2], splats[k, 3], splats[k, 4], splats[k, 5], splats[k, 6]
            red, green, blue, z, ey = splats[k, 7], splats[k, 8], splats[k, 9], splats[k, 10], splats[k, 12]
            sums[:] = _ZERO
            for y in range(max(0, int(math.ceil(v - ey))), min(tall, int(math.floor(v + ey)) + 1)):
                row = planes[y]
                dy = np.float32(y) - v
                base, lean = c * dy * dy, b * dy
                for x in range(TILE):
                    dx = columns[x] - u
                    q = base + dx * (lean + a * dx)
                    s = q * _EIGHTH
                    e = _ONE + s * (_E1 + s * (_E2 + s * (_E3 + s * (_E4 + s * _E5))))
                    e = (e * e) * (e * e)
                    e = e * e
                    alpha = min(o * e, OPAQUE) if q <= most else _ZERO
                    left = row[x]
                    w = alpha * left
                    g0, g1, g2, g3 = row[2 * TILE + x], row[3 * TILE + x], row[4 * TILE + x], row[5 * TILE + x]
                    own = red * g0 + green * g1 + blue * g2 + z * g3
                    behind = row[TILE + x] - w * own
                    row[TILE + x] = behind
                    row[x] = left - w
                    slope = left * own - behind / (_ONE - alpha)
                    raw = alpha * slope if alpha < OPAQUE else _ZERO
                    sums[0, x] += w * g0
                    sums[1, x] += w * g1
                    sums[2, x] += w * g2
                    sums[3, x] += w * g3
                    sums[4, x] += raw
                    sums[5, x] += raw * dy
                    sums[6, x] += raw * dy * dy
            _gather_sums(grads[k], sums, columns, u, a, b, c, o)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _gather_sums(grads, sums, columns, u, a, b, c, o):
    """Adds to the 10 gradients of a splat what the columns of a tile say: sums [7, 16] = red, green, blue, depth; and how the
    logarithm of its opacity counts, that times the offset in rows, and times its square."""
    none = dy = dy2 = dx = dx2 = dxdy = red = green = blue = z = _ZERO
    for x in range(TILE):
        off = columns[x] - u
        red += sums[0, x]
        green += sums[1, x]
        blue += sums[2, x]
        z += sums[3, x]
        none += sums[4, x]
        dy += sums[5, x]
        dy2 += sums[6, x]
        dx += sums[4, x] * off
        dx2 += sums[4, x] * off * off
        dxdy += sums[5, x] * off
    grads[0] += (a + a) * dx + b * dy
    grads[1] += b * dx + (c + c) * dy
    grads[2] -= dx2
    grads[3] -= dxdy
    grads[4] -= dy2
    grads[5] += none / o
    grads[6] += red
    grads[7] += green
    grads[8] += blue
    grads[9] += z
