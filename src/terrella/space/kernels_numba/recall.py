"""Recall: which keyframes know a view, and what they show in it (keyframes.py)."""

import numba
import numpy as np

from ..camera import FAR_M, NEAR_M, SAME
from .surfaces import cast_one

LOT = 16  # of an episode's slots, in whose order keyframes that are trusted alike show


@numba.njit(cache=True, nogil=True, error_model="numpy")
def vote(points, distance, depth, turn, position, camera, votes):
    """What a keyframe says of surface points [P, 3] that lie `distance` [P] deep in a new view, from its depth [h, w], turn
    [3, 3] and position: fills votes [P] (keyframes.vote_slowly)."""
    height, width = depth.shape
    fx, fy, cx, cy = camera
    for p in range(len(points)):
        votes[p] = 0.0
        x, y, z = points[p, 0] - position[0], points[p, 1] - position[1], points[p, 2] - position[2]
        ahead = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
        if ahead <= NEAR_M or distance[p] >= FAR_M:
            continue
        u = cx - fx * (turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z) / ahead
        v = cy - fy * (turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z) / ahead
        if u <= 0 or u >= 1 or v <= 0 or v >= 1:
            continue
        if abs(depth[int(v * height), int(u * width)] - ahead) < SAME * ahead:
            ratio = distance[p] / ahead
            votes[p] = min(ratio, 1 / max(ratio, 1e-3))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pick(votes, anyway, picks):
    """The kernel of keyframes.pick_slowly for one view: votes [K, P]; fills picks [n] and returns how many there are."""
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
def choose(first, last, shared, own, rows, turns, positions, camera, size, step, anyway, picks):
    """The kernel of keyframes.retrieve_slowly: shared and own = coarse patches [K, N, 9], depth [K, h, w], turn [K, 3, 3] and
    pose [K, 7] of keyframes; rows [B, n], those of `own` that a view may use (0: none); fills picks [B, count], -1 before."""
    coarse, depths, key_turns, poses = shared
    own_coarse, own_depths, own_turns, own_poses = own
    known, (height, width), (fx, fy, cx, cy) = len(coarse), size, camera
    down, across = len(range(step // 2, height, step)), len(range(step // 2, width, step))
    points, distance = np.empty((down * across, 3), np.float32), np.empty(down * across, np.float32)
    seen = np.empty((height, width), np.float32)
    keys = np.empty(known + rows.shape[1], np.int64)
    votes = np.empty((len(keys), len(points)), np.float32)
    for k in range(known):
        keys[k] = k
    for view in range(first, last):
        turn, position = turns[view], positions[view]
        seen[:] = FAR_M
        count = known
        for row in rows[view]:
            if row > 0:
                keys[count] = known + row
                count += 1
        for key in keys[:count]:
            cast_one(coarse[key] if key < known else own_coarse[key - known], turn, position, camera, seen)
        for j in range(down):
            for i in range(across):
                v, u, p = step // 2 + j * step, step // 2 + i * step, j * across + i
                far, side, up = seen[v, u], -((u + 0.5) / width - cx) / fx, -((v + 0.5) / height - cy) / fy
                distance[p] = far
                for c in range(3):
                    points[p, c] = position[c] + far * (turn[c, 0] + side * turn[c, 1] + up * turn[c, 2])
        for n in range(count):
            key = keys[n]
            if key < known:
                vote(points, distance, depths[key], key_turns[key], poses[key, :3], camera, votes[n])
            else:
                row = key - known
                vote(points, distance, own_depths[row], own_turns[row], own_poses[row, :3], camera, votes[n])
        chosen = pick(votes[:count], anyway, picks[view])
        for n in range(1, chosen):  # shared ones first, then own ones, LOT of their slots after the other
            at, mine = n, picks[view, n]
            while at > 0 and max(picks[view, at - 1] - known, -1) // LOT > max(mine - known, -1) // LOT:
                picks[view, at] = picks[view, at - 1]
                at -= 1
            picks[view, at] = mine
        for n in range(chosen):
            picks[view, n] = keys[picks[view, n]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def covered(first, last, coarse, depth, turns, poses, rows, dreamt, camera, every, share):
    """The kernel of memory.covered_slowly: coarse patches [A, N, 9], depth [A, h, w], turn [A, 3, 3] and pose [A, 7] of keyframes;
    rows [V, n], dreamt bool [V, n]; fills share [V, n]."""
    count, points = rows.shape[1], np.ascontiguousarray(coarse[0, ::every, :3])
    distance, votes, best = np.empty(len(points), np.float32), np.empty(len(points), np.float32), points[:, 0].copy()
    for view in range(first, last):
        for n in range(count):
            mine = rows[view, n]
            best[:] = 0
            for p in range(len(points)):
                distance[p] = 0
                for c in range(3):
                    points[p, c] = coarse[mine, p * every, c]
                    distance[p] += (points[p, c] - poses[mine, c]) * turns[mine, c, 0]
            for other in range(count):
                if other != n and (dreamt[view, n] or not dreamt[view, other]):
                    row = rows[view, other]
                    vote(points, distance, depth[row], turns[row], poses[row, :3], camera, votes)
                    best = np.maximum(best, votes)
            share[view, n] = best.mean()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def recall(first, last, picks, shared, own, seen, turns, positions, camera, colours, trust):
    """The kernel of keyframes.look_slowly: picks [B, S] (-1: none) among shared and own = rgb uint8 [K, 3, H, W] (`own`:
    doubled), depth [K, h, w], turn [K, 3, 3], pose [K, 7]; depth in the views [B, V, U], their turns and positions; fills colours
    [B, slots, 3, V, U] and trust [B, slots, V, U], which are 0."""
    rgb, depth, key_turns, poses = shared
    own_rgb, own_depth, own_turns, own_poses = own
    known, most = len(rgb), picks.shape[1]
    _, slots, rows, columns = trust.shape
    fx, fy, cx, cy = np.float32(camera[0]), np.float32(camera[1]), np.float32(camera[2]), np.float32(camera[3])
    sure, across, down = np.zeros(most, np.float32), np.zeros(most, np.float32), np.zeros(most, np.float32)
    beam, at = np.zeros((most, 3), np.float32), np.zeros((most, 3), np.float32)
    step = np.zeros((most, 3, 3), np.float32)
    which, mine = np.zeros(most, np.int64), np.zeros(most, np.bool_)
    for view in range(first, last):
        keys = 0
        for key in picks[view]:
            if key >= 0:
                mine[keys], which[keys] = key >= known, key - known if key >= known else key
                its_turns, its_poses = (own_turns, own_poses) if mine[keys] else (key_turns, poses)
                frame = its_turns[which[keys]], its_poses[which[keys]]
                relative(*frame, turns[view], positions[view], step[keys], at[keys])
                keys += 1
        for v in range(rows):
            up = -((v + np.float32(0.5)) / np.float32(rows) - cy) / fy
            for k in range(keys):
                for c in range(3):
                    beam[k, c] = step[k, c, 0] + up * step[k, c, 2]
            for u in range(columns):
                side, far = -((u + np.float32(0.5)) / np.float32(columns) - cx) / fx, seen[view, v, u]
                for k in range(keys):
                    ahead = far * (beam[k, 0] + side * step[k, 0, 1]) + at[k, 0]
                    near = max(ahead, np.float32(1e-4))
                    a = cx - fx * (far * (beam[k, 1] + side * step[k, 1, 1]) + at[k, 1]) / near
                    b = cy - fy * (far * (beam[k, 2] + side * step[k, 2, 1]) + at[k, 2]) / near
                    sure[k], across[k], down[k] = 0.0, a, b
                    if ahead > NEAR_M and 0 <= a <= 1 and 0 <= b <= 1:
                        held = at_pixel(own_depth, which[k], a, b) if mine[k] else at_pixel(depth, which[k], a, b)
                        agreement = min(max(1.5 - abs(held - ahead) / ahead / SAME, 0.0), 1.0)
                        likeness = max(min(far / ahead, ahead / far), 0.05)
                        sure[k] = agreement * likeness * likeness
                for slot in range(min(slots, keys)):
                    best = 0
                    for k in range(1, keys):
                        if sure[k] > sure[best]:
                            best = k
                    trust[view, slot, v, u] = sure[best]
                    sure[best] = -1.0
                    picture = own_rgb[which[best]] if mine[best] else rgb[which[best]]
                    between_at(picture, int(mine[best]), across[best], down[best], colours[view, slot, :, v, u])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relative(turn, pose, new_turn, new_position, step, at):
    """From the camera frame of a view into that of a keyframe: fills the rotation step [3, 3] and the offset at [3]."""
    for c in range(3):
        at[c] = 0
        for d in range(3):
            at[c] += turn[d, c] * (new_position[d] - pose[d])
            step[c, d] = turn[0, c] * new_turn[0, d] + turn[1, c] * new_turn[1, d] + turn[2, c] * new_turn[2, d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def at_pixel(depth, key, a, b):
    """The value of the image `key` of depth [K, h, w] at image coordinates a, b in [0, 1]."""
    height, width = depth.shape[1], depth.shape[2]
    return depth[key, min(int(b * height), height - 1), min(int(a * width), width - 1)]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def between_at(planes, twice, a, b, shown):
    """Bytes [3, h, w], with `twice` = 1 every pixel taken four times (keyframes.doubled), at image coordinates a, b, that lie in
    [0, 1] or are moved there, bilinear: fills shown [3] in [0, 1]."""
    height, width = planes.shape[1] << twice, planes.shape[2] << twice
    half, one = np.float32(0.5), np.float32(1)
    a = min(max(a * np.float32(width) - half, np.float32(0)), np.float32(width - 1))
    b = min(max(b * np.float32(height) - half, np.float32(0)), np.float32(height - 1))
    i, j = min(int(a), width - 2), min(int(b), height - 2)
    a, b = a - np.float32(i), b - np.float32(j)
    left, right, top, bottom = i >> twice, (i + 1) >> twice, j >> twice, (j + 1) >> twice
    for c in range(3):
        above = planes[c, top, left] * (one - a) + planes[c, top, right] * a
        below = planes[c, bottom, left] * (one - a) + planes[c, bottom, right] * a
        shown[c] = (above * (one - b) + below * b) / np.float32(255)
