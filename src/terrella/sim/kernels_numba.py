"""The compiled kernel of doom_map.py: depth of a map of prisms from a camera."""

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cast_prisms(lines, solid, first, heights, sky, x, y, z, yaw, camera, farthest, depth, sector):
    """Fills `depth` [H, W] and `sector` int32 [H, W] of the view from x, y and height z along `yaw` (radians).

    lines [N, 4] = x1, y1, x2, y2; rows first[s] to first[s + 1] belong to sector s. solid [N]: walls. heights [S, 2]: floor,
    ceiling. sky [S]: the ceiling is open sky. Depth is along the optical axis, in map units, `farthest` at most and for the sky.
    `sector`: that of the floor, ceiling or edge in view, -1 for walls and the sky."""
    rows, columns = depth.shape
    fx, fy, cx, cy = camera
    cosine, sine = math.cos(yaw), math.sin(yaw)
    ahead, right = np.empty((len(lines), 2)), np.empty((len(lines), 2))
    for n in range(len(lines)):
        for end in range(2):
            px, py = lines[n, 2 * end] - x, lines[n, 2 * end + 1] - y
            ahead[n, end], right[n, end] = px * cosine + py * sine, px * sine - py * cosine
    near = np.zeros(len(first) - 1, np.bool_)  # sectors with a line in front of the camera
    for s in range(len(near)):
        for n in range(first[s], first[s + 1]):
            near[s] |= max(ahead[n, 0], ahead[n, 1]) > 0 and min(ahead[n, 0], ahead[n, 1]) < farthest
    down = np.empty(rows)
    for v in range(rows):
        slope = ((v + 0.5) / rows - cy) / fy
        down[v] = slope if abs(slope) > 1e-9 else 1e-9
    cuts = np.empty(len(lines) + 2)
    for u in range(columns):
        side = ((u + 0.5) / columns - cx) / fx
        wall = farthest
        for n in range(len(lines)):
            if solid[n]:
                wall = min(wall, crossing(ahead, right, n, side))
        depth[:, u], sector[:, u] = wall, -1
        for s in range(len(near)):
            if not near[s]:
                continue
            count = sorted_cuts(ahead, right, first[s], first[s + 1], side, cuts)
            floor, ceiling = heights[s, 0], heights[s, 1]
            for pair in range(0, count, 2):
                enter, leave = cuts[pair], cuts[pair + 1]
                if enter >= wall:
                    break
                for v in range(rows):
                    # the ray enters at the edge of a floor or ceiling, or between them
                    high = z - down[v] * enter
                    if high <= floor or high >= ceiling:
                        hit = enter
                    else:
                        hit = (z - floor) / down[v] if down[v] > 0 else (z - ceiling) / down[v]
                    if hit <= leave and hit < depth[v, u]:
                        open_air = sky[s] and z - down[v] * hit > ceiling - 1e-3
                        depth[v, u], sector[v, u] = hit, -2 if open_air else s
        for v in range(rows):
            if sector[v, u] == -2:
                depth[v, u], sector[v, u] = farthest, -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sorted_cuts(ahead, right, low, high, side, cuts):
    """Fills `cuts` with the distances at which a column, `side` to the right per unit ahead, alternately enters and leaves the
    sector of lines low to high; returns their number. A camera inside the sector enters at 0."""
    count = 0
    for n in range(low, high):
        cut = crossing(ahead, right, n, side)
        if cut < np.inf:
            at = count
            while at > 0 and cuts[at - 1] > cut:
                cuts[at] = cuts[at - 1]
                at -= 1
            cuts[at] = cut
            count += 1
    if count % 2 == 1:
        for at in range(count, 0, -1):
            cuts[at] = cuts[at - 1]
        cuts[0] = 0.0
        count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def crossing(ahead, right, n, side):
    """Distance at which a column, `side` to the right per unit ahead, meets line n; inf if it does not."""
    a, b = right[n, 0] - side * ahead[n, 0], right[n, 1] - side * ahead[n, 1]
    if (a > 0) == (b > 0):
        return np.inf
    along = ahead[n, 0] + a / (a - b) * (ahead[n, 1] - ahead[n, 0])
    return along if along > 0 else np.inf
