"""The compiled kernel of space/floorplan.py: rays against wall segments."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True, error_model="numpy")
def feel(segments, places, heading, free):
    """segments [S, 4], places [N, 2], heading [D, 2]; lowers `free` [N, D], which starts at the reach, in place."""
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        reach = free[n, 0]
        for s in range(len(segments)):
            ax, ay, bx, by = segments[s, 0] - x, segments[s, 1] - y, segments[s, 2] - x, segments[s, 3] - y
            if min(ax, bx) > reach or max(ax, bx) < -reach or min(ay, by) > reach or max(ay, by) < -reach:
                continue
            ex, ey = bx - ax, by - ay
            for d in range(len(heading)):
                hx, hy = heading[d, 0], heading[d, 1]
                across = hx * ey - hy * ex
                if abs(across) < 1e-9:
                    continue
                along = (ax * ey - ay * ex) / across
                share = (ax * hy - ay * hx) / across
                if 0 <= along < free[n, d] and -0.02 <= share <= 1.02:
                    free[n, d] = along
