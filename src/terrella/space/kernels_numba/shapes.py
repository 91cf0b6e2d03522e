"""Rays among solid shapes: boxes turned about z, upright cylinders and ellipsoids with textures, lamps, a sun and shadows.

shapes float32 [P, 20]: kind, centre [3], half sizes [3], cosine and sine of the yaw, colour [3], texture, metres that the texture
covers, its offset [2], glow, clear (light passes), group, 0. bounds float32 [G, 6]: a sphere around each group (centre, radius),
and its first and last shape. lamps float32 [L, 7]: place, power [3], radius. sky float32 [4, 3]: light from above and from below,
direction to the sun, colour of the sun. A camera is float32 [16]: place, rotation [3, 3], fx, fy, cx, cy in pixels."""

import numba
import numpy as np

BOX, CYLINDER, ELLIPSOID = 0, 1, 2
FAR = 1e9
_jit = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_jit
def _meet(shapes, k, x, y, z, dx, dy, dz, least, most):
    """How far along a ray it enters a shape (FAR: not from `least` to `most`), and the normal there, in the shape's frame."""
    c, s = shapes[k, 7], shapes[k, 8]
    px, py, pz = x - shapes[k, 1], y - shapes[k, 2], z - shapes[k, 3]
    ox, oy, oz = (c * px + s * py) / shapes[k, 4], (c * py - s * px) / shapes[k, 5], pz / shapes[k, 6]
    rx, ry, rz = (c * dx + s * dy) / shapes[k, 4], (c * dy - s * dx) / shapes[k, 5], dz / shapes[k, 6]
    kind, nx, ny, nz, near = int(shapes[k, 0]), 0.0, 0.0, 0.0, FAR
    if kind == BOX:
        ix = 1 / rx if rx != 0 else 1e30
        iy = 1 / ry if ry != 0 else 1e30
        iz = 1 / rz if rz != 0 else 1e30
        ax, ay, az = -abs(ix) - ox * ix, -abs(iy) - oy * iy, -abs(iz) - oz * iz
        out = min(abs(ix) - ox * ix, abs(iy) - oy * iy, abs(iz) - oz * iz)
        near = max(ax, ay, az)
        if near > out:
            return FAR, 0.0, 0.0, 0.0
        if near == ax:
            nx = -1.0 if rx > 0 else 1.0
        elif near == ay:
            ny = -1.0 if ry > 0 else 1.0
        else:
            nz = -1.0 if rz > 0 else 1.0
    else:
        flat = 0.0 if kind == CYLINDER else 1.0
        a = rx * rx + ry * ry + flat * rz * rz
        b = ox * rx + oy * ry + flat * oz * rz
        root = b * b - a * (ox * ox + oy * oy + flat * oz * oz - 1)
        if root < 0:
            return FAR, 0.0, 0.0, 0.0
        if a < 1e-9:  # along the axis of a cylinder
            near, out = (-FAR, FAR) if ox * ox + oy * oy < 1 else (FAR, -FAR)
        else:
            near, out = (-b - np.sqrt(root)) / a, (-b + np.sqrt(root)) / a
        nx, ny, nz = ox + near * rx, oy + near * ry, flat * (oz + near * rz)
        if kind == CYLINDER:
            iz = 1 / rz if rz != 0 else 1e30
            cap = -abs(iz) - oz * iz
            if max(near, cap) > min(out, abs(iz) - oz * iz):
                return FAR, 0.0, 0.0, 0.0
            if cap > near:
                near, nx, ny, nz = cap, 0.0, 0.0, (-1.0 if rz > 0 else 1.0)
    if near <= least or near >= most:
        return FAR, 0.0, 0.0, 0.0
    return near, nx, ny, nz


@_jit
def _misses(bounds, g, x, y, z, dx, dy, dz, square, reach):
    """Whether a ray (`square`: its direction's square, `reach`: its length in metres) passes a group's sphere."""
    px, py, pz, radius = bounds[g, 0] - x, bounds[g, 1] - y, bounds[g, 2] - z, bounds[g, 3]
    apart, along = px * px + py * py + pz * pz, px * dx + py * dy + pz * dz
    if apart > (reach + radius) * (reach + radius):
        return True
    apart -= radius * radius
    return apart > 0 and (along < 0 or along * along < apart * square)


@_jit
def trace(shapes, bounds, x, y, z, dx, dy, dz, least, most):
    """The first shape that a ray enters between `least` and `most` (-1: none), how far, and the world normal."""
    best, which, nx, ny, nz = most, -1, 0.0, 0.0, 0.0
    square = dx * dx + dy * dy + dz * dz
    size = np.sqrt(square)
    for g in range(len(bounds)):
        if _misses(bounds, g, x, y, z, dx, dy, dz, square, best * size):
            continue
        for k in range(int(bounds[g, 4]), int(bounds[g, 5])):
            far, a, b, d = _meet(shapes, k, x, y, z, dx, dy, dz, least, best)
            if far < best:
                best, which, nx, ny, nz = far, k, a, b, d
    if which >= 0:
        nx, ny, nz = nx / shapes[which, 4], ny / shapes[which, 5], nz / shapes[which, 6]
        size = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / size, ny / size, nz / size
        nx, ny = shapes[which, 7] * nx - shapes[which, 8] * ny, shapes[which, 8] * nx + shapes[which, 7] * ny
    return which, best, nx, ny, nz


@_jit
def blocked(shapes, bounds, x, y, z, dx, dy, dz, most, clear):
    """Whether a shape lies on a ray within `most`; with `clear`, windows do not count."""
    square = dx * dx + dy * dy + dz * dz
    reach = most * np.sqrt(square)
    for g in range(len(bounds)):
        if _misses(bounds, g, x, y, z, dx, dy, dz, square, reach):
            continue
        for k in range(int(bounds[g, 4]), int(bounds[g, 5])):
            if clear and shapes[k, 17] > 0:
                continue
            if _meet(shapes, k, x, y, z, dx, dy, dz, 1e-4, most)[0] < most:
                return True
    return False


@_jit
def inside_any(shapes, x, y, z, margin):
    """Whether a point lies in a shape made larger by `margin` metres."""
    for k in range(len(shapes)):
        c, s = shapes[k, 7], shapes[k, 8]
        px, py, pz = x - shapes[k, 1], y - shapes[k, 2], z - shapes[k, 3]
        ox, oy = c * px + s * py, c * py - s * px
        if abs(ox) < shapes[k, 4] + margin and abs(oy) < shapes[k, 5] + margin and abs(pz) < shapes[k, 6] + margin:
            return True
    return False


@_jit
def _texel(at, count):
    """Mirrored repeat."""
    at = at % (2 * count)
    return 2 * count - 1 - at if at >= count else at


@_jit
def albedo(shapes, atlas, k, px, py, pz, nx, ny, nz, colour):
    """The colour [3] of shape k at a point with a normal, into `colour`."""
    c, s = shapes[k, 7], shapes[k, 8]
    qx, qy, qz = px - shapes[k, 1], py - shapes[k, 2], pz - shapes[k, 3]
    u, v, w = c * qx + s * qy, c * qy - s * qx, qz
    mx, my = c * nx + s * ny, c * ny - s * nx
    if shapes[k, 0] != BOX and abs(nz) < 0.9:
        u, v = np.arctan2(v / shapes[k, 5], u / shapes[k, 4]) * max(shapes[k, 4], shapes[k, 5]), w
    elif abs(mx) > max(abs(my), abs(nz)):
        u, v = v, w
    elif abs(my) > abs(nz):
        v = w
    side, texture = atlas.shape[1], int(shapes[k, 12])
    u, v = (u / shapes[k, 13] + shapes[k, 14]) * side, (v / shapes[k, 13] + shapes[k, 15]) * side
    i, j = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - i, v - j
    i0, i1, j0, j1 = _texel(i, side), _texel(i + 1, side), _texel(j, side), _texel(j + 1, side)
    for ch in range(3):
        low = atlas[texture, j0, i0, ch] * (1 - fu) + atlas[texture, j0, i1, ch] * fu
        high = atlas[texture, j1, i0, ch] * (1 - fu) + atlas[texture, j1, i1, ch] * fu
        colour[ch] = shapes[k, 9 + ch] * (low * (1 - fv) + high * fv)


@_jit
def _chance(seed):
    """A number in 0..1 of a state [1] uint32 (xorshift)."""
    a = seed[0]
    a ^= np.uint32(a << np.uint32(13))
    a ^= a >> np.uint32(17)
    a ^= np.uint32(a << np.uint32(5))
    seed[0] = a
    return float(a >> np.uint32(8)) / 16777216.0


@_jit
def gather(shapes, bounds, lamps, sky, p, n, rays, seed, light):
    """The light [3] that falls on a point p [3] with a normal n [3]: from the sky where `rays` rays see no near shape (what is near
    gives its own colour), from lamps and from the sun, with soft shadows."""
    x, y, z = p[0] + 2e-3 * n[0], p[1] + 2e-3 * n[1], p[2] + 2e-3 * n[2]
    light[:] = 0.0
    for _ in range(rays):
        a, b = 2 * np.pi * _chance(seed), 2 * _chance(seed) - 1
        r = np.sqrt(max(1 - b * b, 0.0))
        dx, dy, dz = n[0] + r * np.cos(a), n[1] + r * np.sin(a), n[2] + b
        k, far, _, _, _ = trace(shapes, bounds, x, y, z, dx, dy, dz, 1e-4, 1.5)
        size = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-9
        up, open_ = 0.5 + 0.5 * dz / size, 1.0 if k < 0 else min(far * size / 1.5, 1.0) ** 2
        for ch in range(3):
            bounce = 0.0 if k < 0 else 0.3 * shapes[k, 9 + ch] + shapes[k, 16]
            light[ch] += ((sky[0, ch] * up + sky[1, ch] * (1 - up)) * max(open_, 0.15 + 0.5 * bounce)) / rays
    for m in range(len(lamps)):
        dx = lamps[m, 0] - x + lamps[m, 6] * (2 * _chance(seed) - 1)
        dy = lamps[m, 1] - y + lamps[m, 6] * (2 * _chance(seed) - 1)
        dz = lamps[m, 2] - z
        square = dx * dx + dy * dy + dz * dz
        here = (n[0] * dx + n[1] * dy + n[2] * dz) / np.sqrt(square)
        if here > 0 and not blocked(shapes, bounds, x, y, z, dx, dy, dz, 0.97, False):
            for ch in range(3):
                light[ch] += here * lamps[m, 3 + ch] / (square + 0.3)
    here = n[0] * sky[2, 0] + n[1] * sky[2, 1] + n[2] * sky[2, 2]
    if sky[3].max() > 0 and here > 0:
        if not blocked(shapes, bounds, x, y, z, sky[2, 0], sky[2, 1], sky[2, 2], 60.0, True):
            for ch in range(3):
                light[ch] += here * sky[3, ch]


@_jit
def _ray(camera, column, row):
    """Through a point of the picture (pixels), its forward part 1."""
    left, up = (camera[14] - column) / camera[12], (camera[15] - row) / camera[13]
    return (
        camera[3] + camera[4] * left + camera[5] * up,
        camera[6] + camera[7] * left + camera[8] * up,
        camera[9] + camera[10] * left + camera[11] * up,
    )


@_jit
def surfaces(shapes, bounds, camera, depth, which, normal):
    """The first surface of each pixel: depth [H, W] along the optical axis (0: none), shape [H, W] (-1: none), normal [H, W, 3]."""
    height, width = depth.shape
    x, y, z = camera[0], camera[1], camera[2]
    for i in range(height):
        for j in range(width):
            dx, dy, dz = _ray(camera, j + 0.5, i + 0.5)
            k, far, nx, ny, nz = trace(shapes, bounds, x, y, z, dx, dy, dz, 1e-3, FAR)
            depth[i, j], which[i, j] = far if k >= 0 else 0.0, k
            normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = nx, ny, nz


@_jit
def lit(shapes, bounds, lamps, sky, camera, depth, which, normal, rays, light):
    """The light [h, w, 3] on the surface of every second pixel, smoothed over the same surface."""
    height, width = light.shape[0], light.shape[1]
    which, depth, normal = which[::2, ::2], depth[::2, ::2], normal[::2, ::2]
    raw, seed = np.zeros_like(light), np.ones(1, np.uint32)
    p, one = np.empty(3, np.float32), np.empty(3, np.float32)
    for i in range(height):
        for j in range(width):
            if which[i, j] < 0:
                continue
            seed[0] = np.uint32(1 + 7919 * (i % 4) + 104729 * (j % 4))
            for _ in range(3):
                _chance(seed)
            dx, dy, dz = _ray(camera, 2 * j + 0.5, 2 * i + 0.5)
            far = depth[i, j]
            p[0], p[1], p[2] = camera[0] + far * dx, camera[1] + far * dy, camera[2] + far * dz
            gather(shapes, bounds, lamps, sky, p, normal[i, j], rays, seed, one)
            raw[i, j] = one
    for i in range(height):
        for j in range(width):
            total, k = 0.0, which[i, j]
            light[i, j] = 0.0
            for a in range(max(i - 2, 0), min(i + 2, height)):
                for b in range(max(j - 2, 0), min(j + 2, width)):
                    same = normal[i, j, 0] * normal[a, b, 0] + normal[i, j, 1] * normal[a, b, 1]
                    if which[a, b] == k and same + normal[i, j, 2] * normal[a, b, 2] > 0.8:
                        light[i, j] += raw[a, b]
                        total += 1
            light[i, j] /= max(total, 1.0)


@_jit
def coloured(shapes, bounds, atlas, camera, depth, which, normal, light, sky, rgb):
    """Radiance [H, W, 3] under the light [h, w, 3] of `lit` at half the size: four samples a pixel, those within a surface by its
    plane."""
    height, width = which.shape
    own = np.empty(3, np.float32)
    x, y, z = camera[0], camera[1], camera[2]
    for i in range(height):
        for j in range(width):
            rgb[i, j], k = 0.0, which[i, j]
            ex, ey, ez = _ray(camera, j + 0.5, i + 0.5)
            nx, ny, nz = normal[i, j, 0], normal[i, j, 1], normal[i, j, 2]
            level = depth[i, j] * (ex * nx + ey * ny + ez * nz)
            within = k >= 0 and 0 < i < height - 1 and 0 < j < width - 1
            if within:
                for a in range(i - 1, i + 2):
                    for b in range(j - 1, j + 2):
                        turn = nx * normal[a, b, 0] + ny * normal[a, b, 1] + nz * normal[a, b, 2]
                        within = within and which[a, b] == k and turn > 0.95
            for part in range(4):
                dx, dy, dz = _ray(camera, j + 0.25 + 0.5 * (part % 2), i + 0.25 + 0.5 * (part // 2))
                if within:
                    far = level / (dx * nx + dy * ny + dz * nz)
                else:
                    k, far, nx, ny, nz = trace(shapes, bounds, x, y, z, dx, dy, dz, 1e-3, FAR)
                if k < 0:
                    rgb[i, j] += 0.25 * sky[0]
                    continue
                albedo(shapes, atlas, k, x + far * dx, y + far * dy, z + far * dz, nx, ny, nz, own)
                a, b = i // 2, j // 2
                for near in range(9):
                    c = min(max(i // 2 + near // 3 - 1, 0), light.shape[0] - 1)
                    d = min(max(j // 2 + near % 3 - 1, 0), light.shape[1] - 1)
                    if which[2 * c, 2 * d] == k and which[2 * a, 2 * b] != k:
                        a, b = c, d
                for ch in range(3):
                    rgb[i, j, ch] += 0.25 * own[ch] * (light[a, b, ch] + shapes[k, 16])


@_jit
def hidden(shapes, bounds, lamps, sky, atlas, camera, places, depth, behind, rgb):
    """What lies behind the first surface of every second pixel and can be seen from one of `places` [V, 3]: its depth [h, w], 0
    where there is nothing, and its radiance [h, w, 3]. depth [H, W]: of the first."""
    height, width = behind.shape
    seed, p, n = np.ones(1, np.uint32), np.empty(3, np.float32), np.empty(3, np.float32)
    light, own = np.empty(3, np.float32), np.empty(3, np.float32)
    x, y, z = camera[0], camera[1], camera[2]
    edge, reach = _to_edges(depth), 0.0
    edge, depth = edge[::2, ::2], depth[::2, ::2]
    for v in range(len(places)):
        dx, dy, dz = places[v, 0] - x, places[v, 1] - y, places[v, 2] - z
        reach = max(reach, np.sqrt(dx * dx + dy * dy + dz * dz))
    for i in range(height):
        for j in range(width):
            behind[i, j], far = 0.0, depth[i, j]
            if far * edge[i, j] > 1.3 * reach * camera[12]:  # parallax cannot reach it
                continue
            dx, dy, dz = _ray(camera, 2 * j + 0.5, 2 * i + 0.5)
            for _ in range(4 if far > 0 else 0):
                k, far, n[0], n[1], n[2] = trace(shapes, bounds, x, y, z, dx, dy, dz, far + 1e-3, FAR)
                if k < 0:
                    break
                p[0], p[1], p[2] = x + far * dx, y + far * dy, z + far * dz
                if far < 1.03 * depth[i, j] or not _in_sight(shapes, bounds, places, p, n):
                    continue
                behind[i, j] = far
                seed[0] = np.uint32(1 + i * width + j)
                gather(shapes, bounds, lamps, sky, p, n, 6, seed, light)
                albedo(shapes, atlas, k, p[0], p[1], p[2], n[0], n[1], n[2], own)
                for ch in range(3):
                    rgb[i, j, ch] = own[ch] * (light[ch] + shapes[k, 16])
                break


@_jit
def _to_edges(depth):
    """How many pixels away the nearest step in depth is: float32 [H, W]."""
    height, width = depth.shape
    far = np.full((height, width), 1e6, np.float32)
    for i in range(height - 1):
        for j in range(width - 1):
            a, b, c = depth[i, j], depth[i + 1, j], depth[i, j + 1]
            if max(a, b) > 1.03 * min(a, b):
                far[i, j], far[i + 1, j] = 0, 0
            if max(a, c) > 1.03 * min(a, c):
                far[i, j], far[i, j + 1] = 0, 0
    for i in range(1, height):
        for j in range(1, width):
            far[i, j] = min(far[i, j], far[i - 1, j] + 1, far[i, j - 1] + 1)
    for i in range(height - 2, -1, -1):
        for j in range(width - 2, -1, -1):
            far[i, j] = min(far[i, j], far[i + 1, j] + 1, far[i, j + 1] + 1)
    for i in range(1, height):  # corners that both passes missed
        for j in range(width - 2, -1, -1):
            far[i, j] = min(far[i, j], far[i - 1, j] + 1, far[i, j + 1] + 1)
    return far


@_jit
def _in_sight(shapes, bounds, places, p, n):
    for v in range(len(places)):
        dx, dy, dz = p[0] - places[v, 0], p[1] - places[v, 1], p[2] - places[v, 2]
        if n[0] * dx + n[1] * dy + n[2] * dz < 0:
            if not blocked(shapes, bounds, places[v, 0], places[v, 1], places[v, 2], dx, dy, dz, 0.998, False):
                return True
    return False
