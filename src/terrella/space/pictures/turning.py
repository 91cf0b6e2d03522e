"""Whether a camera only turned: pictures from one spot match as by a rotation alone, and show no depth."""

from collections.abc import Sequence

import numpy as np

Pair = tuple[np.ndarray, np.ndarray, float]
"""Matched points of two pictures, [N, 2] each, in pixels from their middles, and the longest side of the pictures in pixels."""

APART = 0.05  # of the longest side, which the points of a pair move at least (median): closer pairs say nothing
FEWEST_PAIRS, MOST_PAIRS = 5, 200
FOCAL = (0.4, 2.5)  # of the longest side


def rotation_error(pairs: Sequence[Pair]) -> float | None:
    """How far matches lie from where a rotation of the camera puts them: the median over pairs of their median distances, as a
    share of the longest side, for the focal length that fits best. None where too few pairs are apart."""
    apart = [(a / size, b / size) for a, b, size in pairs if np.median(np.linalg.norm(a - b, axis=1)) >= APART * size]
    apart = apart[:: max(len(apart) // MOST_PAIRS, 1)]
    if len(apart) < FEWEST_PAIRS:
        return None

    def error(focal: float) -> float:
        return float(np.median([_distance(a, b, focal) for a, b in apart]))

    coarse = np.geomspace(*FOCAL, 16)
    near = coarse[int(np.argmin([error(focal) for focal in coarse]))]
    return min(error(focal) for focal in near * np.linspace(0.94, 1.06, 13))


def _distance(a: np.ndarray, b: np.ndarray, focal: float) -> float:
    """Median distance of points `b` [N, 2] from points `a` turned by the rotation that fits best (Kabsch 1976)."""
    one, two = (np.concatenate([points / focal, np.ones((len(points), 1))], 1) for points in (a, b))
    one, two = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (one, two))
    left, _, right = np.linalg.svd(two.T @ one)
    turned = one @ (left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right).T
    ahead = turned[:, 2:].clip(1e-3)
    return float(np.median(np.linalg.norm(focal * (turned[:, :2] / ahead - two[:, :2] / two[:, 2:]), axis=1)))
