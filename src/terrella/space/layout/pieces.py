"""Triangles cut into small pieces."""

import numpy as np


def pieces(corners: np.ndarray, count: int, finest_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Splits triangles, the longest edges first, until there are `count`, or no edge is longer than `finest_m`. corners [F, 3, k]:
    a point (metres) and values to be interpolated. Returns the corners of the pieces, and the triangle of each."""
    corners, face = corners.copy(), np.arange(len(corners))
    while len(corners) < count:
        edges = np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[:, :, :3], axis=2)
        longest = edges.max(1)
        if longest.max() <= finest_m:
            break
        rows = np.flatnonzero(longest > max(0.7 * longest.max(), finest_m))
        rows = rows[np.argsort(-longest[rows], kind="stable")[: count - len(corners)]]
        at = edges[rows].argmax(1)
        a, b, c = (corners[rows, (at + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners[rows] = np.stack([a, middle, c], 1)
        corners = np.concatenate([corners, np.stack([middle, b, c], 1)])
        face = np.concatenate([face, face[rows]])
    return corners, face
