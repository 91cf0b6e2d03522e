"""Flat Gaussians on the sides of boxes: many and small where colours change, few and large where they do not."""

from dataclasses import dataclass

import numpy as np
import torch

from ..kernels_numba import cells as kernels
from ..raster import Gaussians
from ..raster.gaussians import plain_sh
from .grids import AXES, Grid
from .shapes import bend

OVERLAP, SMOOTH = (
    0.6,
    0.28,
)  # standard deviation of a Gaussian as a share of its cell; more where its neighbours are of its colour
PLAIN = 0.03  # difference to the neighbours above which there is none more
# The share for cells with edges on both sides, and on or near one; and their shift away from it: an edge has half of the opacity
AT_EDGE, NEAR_EDGE, INWARDS = 0.43, 0.57, 0.15
THIN_M = 0.0015
SHARPER = 0.45  # Gaussians blur: the difference of a cell to what is around it is raised by this share
LONGEST_M, GRADING = 0.13, 0.22  # a cell's longest edge; the share of cells kept for grading


@dataclass(frozen=True)
class Cells:
    """N rectangles on the sides of boxes."""

    faces: np.ndarray  # [N]
    middles: np.ndarray  # [N, 2], metres from the low corner of the side, along both its axes
    sizes: np.ndarray  # [N, 2], metres
    colours: np.ndarray  # [N, 3]
    kinds: np.ndarray  # [N]
    spreads: np.ndarray  # [N, 2], standard deviation of the Gaussian as a share of the cell


def cells_of(
    fine: Grid,
    picture: np.ndarray,
    kinds: np.ndarray,
    edges: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    count: int,
) -> Cells:
    """About `count` cells of a picture [M, 3] on a fine grid, with kinds [M] (0: nothing there) and edges [M]; limits: weights [F]
    of the sides' errors, and the longest cell of each block [K] in metres."""
    weights, most = limits
    faces = np.flatnonzero(fine.counts[:, 0] > 0)
    area = float(fine.areas[kinds > 0].sum())
    longest = np.minimum(max(LONGEST_M, 2.2 * (area / count) ** 0.5), most[faces // 6])
    starts, counts, steps = fine.starts[faces], fine.counts[faces], fine.steps[faces]
    picture, kinds = np.ascontiguousarray(picture, np.float32), kinds.astype(np.int32)
    rows = kernels.cut(starts, counts, steps, longest, weights[faces], picture, kinds, int(count * (1 - GRADING)))
    rows, near = kernels.grade(rows, starts, counts, steps, picture, kinds, edges, int(1.6 * count))
    n = len(rows)
    colours, kind, contrast, bits = np.empty((n, 3)), np.empty(n, np.int64), np.empty(n), np.empty(n, np.int64)
    kernels.shown(rows, starts, counts, picture, kinds, edges, SHARPER, colours, kind, contrast, bits)
    step = steps[rows[:, 0]]
    middles = np.stack([rows[:, 1] + rows[:, 2], rows[:, 3] + rows[:, 4]], 1) * step / 2
    sizes = np.stack([rows[:, 2] - rows[:, 1], rows[:, 4] - rows[:, 3]], 1) * step
    spread = OVERLAP + SMOOTH * np.clip(1 - contrast / PLAIN, 0, 1)
    low, high = np.stack([bits & 1, bits & 4], 1) > 0, np.stack([bits & 2, bits & 8], 1) > 0
    spread = np.where(
        np.isfinite(most[faces[rows[:, 0]] // 6]), OVERLAP, spread
    )  # on round things long ones would stand out
    growing = np.where((np.stack([near & 1, near & 2], 1) > 0) | low | high, NEAR_EDGE, spread[:, None])
    spreads = np.where(low & high, AT_EDGE, growing)
    middles += INWARDS * sizes * (low * 1 - high)
    kept = kind > 0
    return Cells(
        faces[rows[kept, 0]], middles[kept], sizes[kept], np.clip(colours[kept], 0, 1), kind[kept], spreads[kept]
    )


def gaussians_of(cells: Cells, boxes: np.ndarray, shapes: np.ndarray, opacity: np.ndarray) -> Gaussians:
    """Flat Gaussians of cells on boxes [K, 6] of shapes [K, 5]."""
    block, side = cells.faces // 6, cells.faces % 6
    rows, axes = np.arange(len(block)), AXES[side // 2]

    def place(off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = np.empty((len(block), 3))
        at[rows, side // 2] = np.where(side % 2, boxes[block, 3 + side // 2], boxes[block, side // 2])
        at[rows[:, None], axes] = boxes[block[:, None], axes] + cells.middles + off * cells.sizes
        return bend(at, side, boxes[block], shapes[block])

    means, outward = place(np.zeros(2))
    first = place(np.array([0.5, 0]))[0] - place(np.array([-0.5, 0]))[0]
    second = place(np.array([0, 0.5]))[0] - place(np.array([0, -0.5]))[0]
    normals = np.cross(first, second)
    long_, area = np.linalg.norm(first, axis=1), np.linalg.norm(normals, axis=1)
    other = area / np.maximum(long_, 1e-9)  # across the first edge, where a cell is slanted
    flip = np.sign((normals * outward).sum(1, keepdims=True))
    normals = flip * normals / np.maximum(area[:, None], 1e-12)
    x = first / np.maximum(long_, 1e-9)[:, None]
    turn = np.stack([x, np.cross(normals, x), normals], 2)  # columns
    scales = np.concatenate([cells.spreads * np.stack([long_, other], 1), np.full((len(block), 1), THIN_M)], 1)
    to = lambda part: torch.from_numpy(np.ascontiguousarray(part, np.float32))  # noqa: E731
    return Gaussians(
        to(means - THIN_M * normals), to(quaternions(turn)), to(scales), to(opacity), plain_sh(to(cells.colours))
    )


def quaternions(turn: np.ndarray) -> np.ndarray:
    """Quaternions w, x, y, z [N, 4] of rotation matrices [N, 3, 3]."""
    m = turn
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack([trace, *(2 * m[:, k, k] - trace for k in range(3))], 1) + 1  # 4 w^2, 4 x^2, ...
    best = squares.argmax(1)
    out = np.empty((len(m), 4))
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    choices = ((squares[:, 0], a, b, c), (a, squares[:, 1], d, e), (b, d, squares[:, 2], f), (c, e, f, squares[:, 3]))
    for k, parts in enumerate(choices):
        rows = best == k
        out[rows] = np.stack(parts, 1)[rows]
    return out / np.linalg.norm(out, axis=1, keepdims=True)
