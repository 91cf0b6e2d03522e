"""The compiled kernels of this room; tests hold each against a slow, obvious twin or against plain geometry."""

from __future__ import annotations

import math

import numba
import numpy as np

from .patches import SAME

NEAR_M = 0.05
TOUCHED = 0.1  # of a pixel that a card covers, above which it is the card's
WITHIN_M = 0.005  # as well as walls are known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def lift(depth, turn, eye, camera, stride, slant, patch):
    """The kernel of patches.patches_slowly for one image: depth [H, W], turn [3, 3] and eye [3] of T_world_cam; fills
    patch [N, 9]."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    rim, first, n = max(1, round(0.75 * stride)), stride // 2, 0
    ramp_u, ramp_v = 1 / (width * fx), 1 / (height * fy)
    longest = (slant * ramp_u) ** 2
    for v in range(first, height, stride):
        up = -((v + 0.5) / height - cy) / fy
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        top, bottom = max(v - rim, 0), min(v + rim, height - 1)
        for u in range(first, width, stride):
            side, here = -((u + 0.5) / width - cx) / fx, depth[v, u]
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            a0, b0 = here - depth[v, left], depth[v, right] - here  # to the right: of both neighbours the nearer one
            a1, b1 = a0 * side - depth[v, left] * ramp_u, b0 * side - depth[v, right] * ramp_u
            a2, b2 = a0 * up, b0 * up
            aa, bb = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
            if u == right or (u != left and aa < bb):
                b0, b1, b2, bb = a0, a1, a2, aa
            c0, d0 = here - depth[above, u], depth[below, u] - here  # and down
            c1, d1 = c0 * side, d0 * side
            c2, d2 = c0 * up - depth[above, u] * ramp_v, d0 * up - depth[below, u] * ramp_v
            cc, dd = c0 * c0 + c1 * c1 + c2 * c2, d0 * d0 + d1 * d1 + d2 * d2
            if v == below or (v != above and cc < dd):
                d0, d1, d2, dd = c0, c1, c2, cc
            reach = 0.0
            if max(bb, dd) <= longest * here * here:
                west, east = max(u - rim, 0), min(u + rim, width - 1)
                twice = 2 / max(here, NEAR_M)
                bend = abs(1 / max(depth[v, west], NEAR_M) + 1 / max(depth[v, east], NEAR_M) - twice)
                bend = max(bend, abs(1 / max(depth[top, u], NEAR_M) + 1 / max(depth[bottom, u], NEAR_M) - twice))
                bend = max(bend, abs(1 / max(depth[top, west], NEAR_M) + 1 / max(depth[bottom, east], NEAR_M) - twice))
                bend = max(bend, abs(1 / max(depth[top, east], NEAR_M) + 1 / max(depth[bottom, west], NEAR_M) - twice))
                reach = 0.75 * stride if bend < 0.025 * twice else 0.5
            b0, b1, b2, d0, d1, d2 = reach * b0, reach * b1, reach * b2, reach * d0, reach * d1, reach * d2
            p1, p2 = here * side, here * up
            for c in range(3):
                x, y, z = turn[c, 0], turn[c, 1], turn[c, 2]
                patch[n, c] = eye[c] + x * here + y * p1 + z * p2
                patch[n, 3 + c] = x * b0 + y * b1 + z * b2
                patch[n, 6 + c] = x * d0 + y * d1 + z * d2
            n += 1


@numba.njit(cache=True, fastmath=False, nogil=True, error_model="numpy")
def cast_one(patch, turn, eye, camera, depth):
    """patch [N, 9], turn [3, 3] and eye [3] of T_world_cam, camera intrinsics; lowers `depth` [H, W] to what they show."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    fx, cx, fy, cy = fx * width, cx * width, fy * height, cy * height
    to_right, to_left = (cx - width) / fx if cx < width else -1e9, cx / fx if cx > 0 else 1e9  # the rim of the picture
    to_bottom, to_top = (cy - height) / fy if cy < height else -1e9, cy / fy if cy > 0 else 1e9
    for n in range(len(patch)):
        x, y, z = patch[n, 0] - eye[0], patch[n, 1] - eye[1], patch[n, 2] - eye[2]
        c0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        if c0 <= NEAR_M:
            continue
        c1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        c2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        reach = abs(patch[n, 3]) + abs(patch[n, 4]) + abs(patch[n, 5])  # no corner is farther from the centre
        reach += abs(patch[n, 6]) + abs(patch[n, 7]) + abs(patch[n, 8])
        deepest = c0 + reach
        if c1 + reach <= deepest * to_right or c1 - reach >= deepest * to_left:
            continue
        if c2 + reach <= deepest * to_bottom or c2 - reach >= deepest * to_top:
            continue
        x, y, z = patch[n, 3], patch[n, 4], patch[n, 5]
        a0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        a1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        a2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        x, y, z = patch[n, 6], patch[n, 7], patch[n, 8]
        d0 = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        d1 = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
        d2 = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
        n0, n1, n2 = d1 * a2 - d2 * a1, d2 * a0 - d0 * a2, d0 * a1 - d1 * a0
        lift = n0 * c0 + n1 * c1 + n2 * c2
        if lift >= 0:  # it shows its back
            continue
        left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
        for corner in range(4):
            s = 1.0 if corner & 1 else -1.0
            t = 1.0 if corner & 2 else -1.0
            q0 = max(c0 + s * a0 + t * d0, NEAR_M)
            u = cx - fx * (c1 + s * a1 + t * d1) / q0
            v = cy - fy * (c2 + s * a2 + t * d2) / q0
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if right <= 0 or left >= width or bottom <= 0 or top >= height:
            continue
        first_u, last_u = max(int(math.ceil(left - 0.5)), 0), min(int(math.floor(right - 0.5)), width - 1)
        first_v, last_v = max(int(math.ceil(top - 0.5)), 0), min(int(math.floor(bottom - 0.5)), height - 1)
        if first_u > last_u or first_v > last_v:
            continue
        aa, ad, dd = a0 * a0 + a1 * a1 + a2 * a2, a0 * d0 + a1 * d1 + a2 * d2, d0 * d0 + d1 * d1 + d2 * d2
        determinant = max(aa * dd - ad * ad, 1e-20)
        for v in range(first_v, last_v + 1):
            up = -(v + 0.5 - cy) / fy
            for u in range(first_u, last_u + 1):
                side = -(u + 0.5 - cx) / fx
                slope = n0 + n1 * side + n2 * up
                if abs(slope) < 1e-12:
                    slope = -1e-12
                along = lift / slope
                if along <= NEAR_M or along >= depth[v, u]:
                    continue
                o0, o1, o2 = along - c0, along * side - c1, along * up - c2
                oa, od = o0 * a0 + o1 * a1 + o2 * a2, o0 * d0 + o1 * d1 + o2 * d2
                if abs(oa * dd - od * ad) <= determinant and abs(od * aa - oa * ad) <= determinant:
                    depth[v, u] = along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def recall(rgb, depth, turns, eyes, seen, turn, eye, camera, colours, trust):
    """The kernel of keyframes.recall_slowly: keyframes' rgb uint8 [K, 3, H, W], depth [K, h, w], turns [K, 3, 3] and eyes
    [K, 3]; what the view sees [V, U] from its turn and eye; fills colours [S, 3, V, U] and trust [S, V, U]."""
    keys, _, height, width = rgb.shape
    slots, rows, columns = trust.shape
    fx, fy, cx, cy = camera
    sure, across, down = np.zeros(keys, np.float32), np.zeros(keys, np.float32), np.zeros(keys, np.float32)
    for v in range(rows):
        for u in range(columns):
            side, up, far = -((u + 0.5) / columns - cx) / fx, -((v + 0.5) / rows - cy) / fy, seen[v, u]
            x = eye[0] + far * (turn[0, 0] + side * turn[0, 1] + up * turn[0, 2])
            y = eye[1] + far * (turn[1, 0] + side * turn[1, 1] + up * turn[1, 2])
            z = eye[2] + far * (turn[2, 0] + side * turn[2, 1] + up * turn[2, 2])
            for k in range(keys):
                px, py, pz = x - eyes[k, 0], y - eyes[k, 1], z - eyes[k, 2]
                ahead = turns[k, 0, 0] * px + turns[k, 1, 0] * py + turns[k, 2, 0] * pz
                near = max(ahead, 1e-4)
                a = cx - fx * (turns[k, 0, 1] * px + turns[k, 1, 1] * py + turns[k, 2, 1] * pz) / near
                b = cy - fy * (turns[k, 0, 2] * px + turns[k, 1, 2] * py + turns[k, 2, 2] * pz) / near
                sure[k], across[k], down[k] = 0.0, a, b
                if ahead > NEAR_M and 0 <= a <= 1 and 0 <= b <= 1:
                    held = depth[
                        k,
                        min(int(b * depth.shape[1]), depth.shape[1] - 1),
                        min(int(a * depth.shape[2]), depth.shape[2] - 1),
                    ]
                    agreement = min(max(1.5 - abs(held - ahead) / ahead / SAME, 0.0), 1.0)
                    likeness = max(min(far / ahead, ahead / far), 0.05)
                    sure[k] = agreement * likeness * likeness
            for slot in range(min(slots, keys)):
                best = 0
                for k in range(1, keys):
                    if sure[k] > sure[best]:
                        best = k
                trust[slot, v, u] = sure[best]
                sure[best] = -1.0
                a = min(max(across[best] * width - 0.5, 0.0), width - 1.0)
                b = min(max(down[best] * height - 0.5, 0.0), height - 1.0)
                i, j = min(int(a), width - 2), min(int(b), height - 2)
                a, b = a - i, b - j
                for c in range(3):
                    colours[slot, c, v, u] = between(rgb[best, c], i, j, a, b) / 255


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moved(u, v, depth, turn, eye, new_turn, new_eye, camera):
    """Where the surface that is depth[v, u] deep in the view from turn [3, 3] and eye [3] lies in that from the new ones: how far
    ahead, and its image coordinates (in [0, 1] where it is seen; meaningless behind the eye)."""
    rows, columns = depth.shape
    fx, fy, cx, cy = camera
    side, up, far = -((u + 0.5) / columns - cx) / fx, -((v + 0.5) / rows - cy) / fy, depth[v, u]
    x = far * (turn[0, 0] + side * turn[0, 1] + up * turn[0, 2]) + eye[0] - new_eye[0]
    y = far * (turn[1, 0] + side * turn[1, 1] + up * turn[1, 2]) + eye[1] - new_eye[1]
    z = far * (turn[2, 0] + side * turn[2, 1] + up * turn[2, 2]) + eye[2] - new_eye[2]
    ahead = new_turn[0, 0] * x + new_turn[1, 0] * y + new_turn[2, 0] * z
    a = cx - fx * (new_turn[0, 1] * x + new_turn[1, 1] * y + new_turn[2, 1] * z) / ahead
    b = cy - fy * (new_turn[0, 2] * x + new_turn[1, 2] * y + new_turn[2, 2] * z) / ahead
    return ahead, a, b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def carry(rgb, depth, turn, eye, known, seen, target_turn, target_eye, camera, carried):
    """The kernel of reproject.carry_unknown_slowly for one view: a frame's rgb uint8 [3, H, W] and depth [h, w] from its turn
    [3, 3] and eye [3]; what the view knows [V, U] and sees [V, U] from its own; fills `carried` [4, V, U], which is 0."""
    _, height, width = rgb.shape
    rows, columns = seen.shape
    for v in range(rows):
        for u in range(columns):
            wanted = 1 - known[v, u]
            if wanted <= 0:
                continue
            ahead, a, b = moved(u, v, seen, target_turn, target_eye, turn, eye, camera)
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
def splat(depth, things, turn, eye, target_turn, target_eye, camera, flat, canvas):
    """The first half of worlds/moving.carried_slowly for one frame: depth and things [H, W] from its turn [3, 3] and eye [3];
    fills flat [H, W], the depth with that of things averaged over their surroundings, and lowers `canvas` [H, W] to what is seen
    of it from the target's."""
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
            ahead, a, b = moved(u, v, flat, turn, eye, target_turn, target_eye, camera)
            a, b = a * width, b * height
            if ahead > NEAR_M and 0 <= a < width and 0 <= b < height and ahead < canvas[int(b), int(a)]:
                canvas[int(b), int(a)] = ahead


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fetch(rgb, flat, things, covered, turn, eye, seen, target_turn, target_eye, camera, found):
    """The second half of the same: what the frame shows (rgb uint8 [3, H, W], the others [H, W]) of what the target sees [H, W];
    fills found [6, H, W] = colour, trust, `seen`, things."""
    height, width = flat.shape
    for v in range(height):
        for u in range(width):
            found[4, v, u] = seen[v, u]
            ahead, a, b = moved(u, v, seen, target_turn, target_eye, turn, eye, camera)
            if ahead <= NEAR_M or a < 0 or a > 1 or b < 0 or b > 1:
                continue
            i, j = min(int(a * width), width - 1), min(int(b * height), height - 1)
            trust = min(max(1.5 - abs(flat[j, i] - ahead) / ahead / SAME, 0.0), 1.0)
            if covered[j, i] or trust <= 0:
                continue
            for c in range(3):
                found[c, v, u] = rgb[c, j, i] / 255
            found[3, v, u], found[5, v, u] = trust, things[j, i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint(picture, sides, far, number, hides, rgb, depth, instances):
    """Paints a card's picture [4, h, w] that fills the box `sides` (left, right, top, bottom, in pixels), `far` metres ahead, into
    rgb [3, H, W], depth [H, W] and instances [H, W] where what `hides` it [H, W] is farther. A pixel is the mean of four places
    in it: edges are as soft as a game's."""
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
def between(plane, i, j, a, b):
    """The plane [h, w] a share `a` of the way from column i to the next and `b` from row j."""
    above = plane[j, i] * (1 - a) + plane[j, i + 1] * a
    below = plane[j + 1, i] * (1 - a) + plane[j + 1, i + 1] * a
    return above * (1 - b) + below * b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill(depth, near, far, levels, filled):
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pick(votes, anyway, picks):
    """The kernel of keyframes.pick_slowly: votes [K, P]; fills picks [n] and returns how many there are."""
    keys, points = votes.shape
    best, most = np.zeros(points, np.float32), 0.0  # what is covered so far; the same of the column that counts anyway
    strongest = np.zeros(keys, np.float32)
    for k in range(keys):
        for p in range(points):
            strongest[k] = max(strongest[k], votes[k, p])
    for n in range(len(picks)):
        chosen, gained = 0, 0.0
        for k in range(keys):
            gain = max(anyway * strongest[k] - most, 0.0)
            for p in range(points):
                gain += max(votes[k, p] - best[p], np.float32(0))
            if gain > gained:
                chosen, gained = k, gain
        if gained <= 0:
            return n
        picks[n] = chosen
        most = max(most, anyway * strongest[chosen])
        for p in range(points):
            best[p] = max(best[p], votes[chosen, p])
    return len(picks)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def straight_runs(inverse, left, fewest, straight, gap, least):
    """Runs of columns on which the inverse depth [w] is a line of `left` [w], as far as neighbours are less than `gap`
    metres apart and no inverse depth is below `least`: float64 [n, 4] = first, stop, slope, level."""
    found = np.empty((len(inverse), 4))
    count, first = 0, 0
    while first < len(inverse):
        stop = first + 1
        while stop < len(inverse):
            step = math.hypot(
                1 / inverse[stop] - 1 / inverse[stop - 1],
                left[stop] / inverse[stop] - left[stop - 1] / inverse[stop - 1],
            )
            if step > gap or inverse[stop - 1] < least or inverse[stop] < least:
                break
            x, y = left[first : stop + 1], inverse[first : stop + 1]
            middle, mean = x.mean(), y.mean()
            slope = ((x - middle) * (y - mean)).sum() / ((x - middle) ** 2).sum()
            if np.abs(slope * (x - middle) + mean - y).max() > straight * y.max():
                break
            stop += 1
            if stop - first >= fewest:
                found[count, 0], found[count, 1], found[count, 2] = first, stop, slope
                found[count, 3] = mean - slope * middle
        if stop - first >= fewest:
            count += 1
            first = stop
        else:
            first += 1
    return found[:count]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def slide(walls, own, places, wish, half, short, moved, left):
    """The kernel of floorplan.slide: walls [S, 4], own [N, W, 4], places [N, 2], wish [N, 2]; fills moved [N, 2] and left
    [N, 2]."""
    close = np.empty((len(walls) + own.shape[1], 4))
    for n in range(len(places)):
        x, y, mx, my = places[n, 0], places[n, 1], wish[n, 0], wish[n, 1]
        near = close_by(walls, x, y, half + abs(mx) + abs(my), close, 0)
        near = close_by(own[n], x, y, half + abs(mx) + abs(my), close, near)
        for bump in range(3):
            share, along_x, along_y = first_touch(close[:near], x, y, mx, my, half)
            if share > 1:
                x, y = x + mx, y + my
                break
            go = max(share - short, 0.0)
            x, y = x + go * mx, y + go * my
            rest = (1 - max(share, 0.0)) * (mx * along_x + my * along_y) if bump < 2 else 0.0
            mx, my = rest * along_x, rest * along_y
        moved[n, 0], moved[n, 1], left[n, 0], left[n, 1] = x - places[n, 0], y - places[n, 1], mx, my


@numba.njit(cache=True, nogil=True, error_model="numpy")
def close_by(walls, x, y, reach, close, near):
    """Adds to `close`, of which `near` are filled, those of walls [S, 4] that come within `reach` of x, y; how many it is then."""
    for s in range(len(walls)):
        ax, ay, bx, by = walls[s, 0] - x, walls[s, 1] - y, walls[s, 2] - x, walls[s, 3] - y
        if min(ax, bx) < reach and max(ax, bx) > -reach and min(ay, by) < reach and max(ay, by) > -reach:
            close[near] = walls[s]
            near += 1
    return near


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_touch(walls, x, y, mx, my, half):
    """At which share of the move mx, my a box around x, y first touches one of `walls` [S, 4] (2 where none), and the
    direction along which it may go on. By separating axes. Walls are known to WITHIN_M: one that the box is deeper in does
    not hold it, and one that it would only graze by less does not stop it."""
    best, along_x, along_y = 2.0, 0.0, 0.0
    unit = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    low, high, speed = np.empty(3), np.empty(3), np.empty(3)
    for s in range(len(walls)):
        ax, ay, bx, by = walls[s, 0] - x, walls[s, 1] - y, walls[s, 2] - x, walls[s, 3] - y
        length = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
        if length < 1e-9:
            continue
        unit[2, 0], unit[2, 1] = (by - ay) / length, (ax - bx) / length
        enter, leave, face = -1e9, 1e9, -1
        for axis in range(3):
            ux, uy = unit[axis, 0], unit[axis, 1]
            one, other, reach = ux * ax + uy * ay, ux * bx + uy * by, half * (abs(ux) + abs(uy))
            low[axis], high[axis], speed[axis] = min(one, other) - reach, max(one, other) + reach, ux * mx + uy * my
            if abs(speed[axis]) < 1e-12:
                if low[axis] >= -1e-9 or high[axis] <= 1e-9:
                    leave = -1e9
                continue
            ends = low[axis] / speed[axis], high[axis] / speed[axis]
            if min(ends) > enter:
                enter, face = min(ends), axis
            leave = min(leave, max(ends))
        if enter >= min(leave, best) or enter > 1 or face < 0 or enter * abs(speed[face]) <= -WITHIN_M:
            continue
        grazes = False
        for axis in range(3):  # how deep the box is in the wall, seen along the other axes, where it meets it
            across = abs(unit[axis, 0] * unit[face, 1] - unit[axis, 1] * unit[face, 0])
            deep = min(enter * speed[axis] - low[axis], high[axis] - enter * speed[axis])
            grazes = grazes or (across > 0.02 and deep < WITHIN_M)
        if not grazes:
            best, along_x, along_y = enter, -unit[face, 1], unit[face, 0]
    return best, along_x, along_y


@numba.njit(cache=True, nogil=True, error_model="numpy")
def vote(points, distance, depth, turn, eye, camera, votes):
    """The kernel of keyframes.vote_slowly: points [P, 3] and distance [P]; keyframes' depth [K, h, w], turn [K, 3, 3]
    and eye [K, 3] of T_world_cam; fills votes [K, P]."""
    keys, height, width = depth.shape
    fx, fy, cx, cy = camera
    for k in range(keys):
        for p in range(len(points)):
            votes[k, p] = 0.0
            x, y, z = points[p, 0] - eye[k, 0], points[p, 1] - eye[k, 1], points[p, 2] - eye[k, 2]
            ahead = turn[k, 0, 0] * x + turn[k, 1, 0] * y + turn[k, 2, 0] * z
            if ahead <= NEAR_M or distance[p] >= 100.0:
                continue
            u = cx - fx * (turn[k, 0, 1] * x + turn[k, 1, 1] * y + turn[k, 2, 1] * z) / ahead
            v = cy - fy * (turn[k, 0, 2] * x + turn[k, 1, 2] * y + turn[k, 2, 2] * z) / ahead
            if u <= 0 or u >= 1 or v <= 0 or v >= 1:
                continue
            if abs(depth[k, int(v * height), int(u * width)] - ahead) < SAME * ahead:
                ratio = distance[p] / ahead
                votes[k, p] = min(ratio, 1 / max(ratio, 1e-3))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cast_prisms(lines, solid, first, heights, sky, x, y, eye, yaw, camera, farthest, depth, sector):
    """Fills `depth` [H, W] and `sector` int32 [H, W] of the view from x, y and height `eye` along `yaw` (radians).

    lines [N, 4] = x1, y1, x2, y2, sector by sector: those of sector s are rows first[s] to first[s + 1]; solid [N] where
    nothing is behind; heights [S, 2] = floor, ceiling; sky [S] where the ceiling is the open sky. Depth is along the optical
    axis, in the units of the map, `farthest` at most and for the sky. `sector` is that whose floor, ceiling or edge is seen,
    -1 for a solid wall and the sky.
    """
    rows, columns = depth.shape
    fx, fy, cx, cy = camera
    cosine, sine = math.cos(yaw), math.sin(yaw)
    ahead, right = np.empty((len(lines), 2)), np.empty((len(lines), 2))
    for n in range(len(lines)):
        for end in range(2):
            px, py = lines[n, 2 * end] - x, lines[n, 2 * end + 1] - y
            ahead[n, end], right[n, end] = px * cosine + py * sine, px * sine - py * cosine
    near = np.zeros(len(first) - 1, np.bool_)  # sectors of which a line lies before the eye
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
            count = 0
            for n in range(first[s], first[s + 1]):
                cut = crossing(ahead, right, n, side)
                if cut < np.inf:
                    at = count
                    while at > 0 and cuts[at - 1] > cut:
                        cuts[at] = cuts[at - 1]
                        at -= 1
                    cuts[at] = cut
                    count += 1
            if count == 0:
                continue
            if count % 2 == 1:  # the eye is in this sector
                for at in range(count, 0, -1):
                    cuts[at] = cuts[at - 1]
                cuts[0] = 0.0
                count += 1
            floor, ceiling = heights[s, 0], heights[s, 1]
            for pair in range(0, count, 2):
                enter, leave = cuts[pair], cuts[pair + 1]
                if enter >= wall:
                    break
                for v in range(rows):
                    high = (
                        eye - down[v] * enter
                    )  # where the ray enters: on the edge of a floor or ceiling, or between them
                    if high <= floor or high >= ceiling:
                        hit = enter
                    else:
                        hit = (eye - floor) / down[v] if down[v] > 0 else (eye - ceiling) / down[v]
                    if hit <= leave and hit < depth[v, u]:
                        open_air = sky[s] and eye - down[v] * hit > ceiling - 1e-3
                        depth[v, u], sector[v, u] = hit, -2 if open_air else s
        for v in range(rows):
            if sector[v, u] == -2:
                depth[v, u], sector[v, u] = farthest, -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def crossing(ahead, right, n, side):
    """How far ahead the vertical plane of a column, `side` to the right for each unit ahead, meets line n; inf where not."""
    a, b = right[n, 0] - side * ahead[n, 0], right[n, 1] - side * ahead[n, 1]
    if (a > 0) == (b > 0):
        return np.inf
    along = ahead[n, 0] + a / (a - b) * (ahead[n, 1] - ahead[n, 0])
    return along if along > 0 else np.inf
