"""The collider of a scene of triangles as axis-aligned boxes: the scene's own boxes, and small ones around all other triangles."""

from itertools import product

import numpy as np

from .pieces import pieces

CELL_M, MOST_PIECES, MOST = 0.1, 400_000, 20_000
_SAME_M = 1e-3
_WIDEST = 1 << 18  # cells along an axis


def solids_of(corners: np.ndarray, things: np.ndarray) -> np.ndarray | None:
    """Boxes float32 [S, 6], low and high corners, of triangles [F, 3, 3] (metres) of the objects `things` [F]: whole objects that
    are boxes without others in them, else the triangles in each cell of CELL_M. None for more than MOST boxes."""
    order = np.argsort(things, kind="stable")
    ends = np.flatnonzero(np.diff(things[order], prepend=-1, append=-1))
    groups = [order[a:b] for a, b in zip(ends, ends[1:])]
    spans = np.array([[*corners[rows].min((0, 1)), *corners[rows].max((0, 1))] for rows in groups])
    whole = [k for k, rows in enumerate(groups) if len(rows) == 12 and _is_box(corners[rows], spans[k])]
    whole = [k for k in whole if not _holds(spans[k], np.delete(spans, k, 0))]
    others = np.ones(len(corners), np.bool_)
    for k in whole:
        others[groups[k]] = False
    boxes = [spans[whole]] if whole else []
    if others.any():
        boxes.append(_cells(corners[others].astype(np.float64)))
    merged = np.concatenate(boxes)
    return merged.astype(np.float32) if len(merged) <= MOST else None


def _is_box(corners: np.ndarray, span: np.ndarray) -> bool:
    """Whether 12 triangles [12, 3, 3] that face outwards form the box `span` [6]."""
    low, size = span[:3], span[3:] - span[:3]
    share = (corners - low) / np.maximum(size, 1e-9)
    volume = np.einsum("ij,ij->", share[:, 0], np.cross(share[:, 1], share[:, 2])) / 6
    return bool(np.minimum(np.abs(share), np.abs(share - 1)).max() < 1e-3 and abs(volume - 1) < 0.01)


def _holds(span: np.ndarray, others: np.ndarray) -> bool:
    return bool(((others[:, :3] > span[:3] - _SAME_M) & (others[:, 3:] < span[3:] + _SAME_M)).all(1).any())


def _cells(corners: np.ndarray) -> np.ndarray:
    """Boxes [K, 6] around the triangles in each cell, separate for normals along x, y and z, so that walls get flat boxes."""
    small, _ = pieces(corners, MOST_PIECES, CELL_M)
    low, high = small.min(1), small.max(1)
    cell = max(CELL_M, (high - low).max(), (high.max(0) - low.min(0)).max() / _WIDEST)
    axis = np.abs(np.cross(small[:, 1] - small[:, 0], small[:, 2] - small[:, 0])).argmax(1)
    origin = low.min(0)
    first = np.floor((low - origin) / cell).astype(np.int64)
    keys, parts = [], []
    for off in product((0, 1), repeat=3):
        at = first + np.array(off)
        inside = np.concatenate([np.maximum(low, origin + at * cell), np.minimum(high, origin + (at + 1) * cell)], 1)
        kept = ((at == first) | (origin + at * cell < high)).all(1) & (inside[:, :3] <= inside[:, 3:]).all(1)
        keys.append(((at[kept] @ np.array([1 << 42, 1 << 21, 1])) << 2) | axis[kept])
        parts.append(inside[kept])
    boxes, key = np.concatenate(parts), np.concatenate(keys)
    order = np.argsort(key, kind="stable")
    merged = _joined(boxes[order], np.diff(key[order], prepend=-1) != 0)
    for along in (0, 1, 2):
        merged = _merged(merged, along)
    return merged


def _merged(boxes: np.ndarray, along: int) -> np.ndarray:
    """Merges adjacent boxes along an axis that have the same extent along the others."""
    rest = [k for k in range(6) if k % 3 != along]
    wide = np.round(boxes[:, rest] / _SAME_M).astype(np.int64)
    order = np.lexsort((boxes[:, along], *wide.T))
    boxes, wide = boxes[order], wide[order]
    apart = np.ones(len(boxes), np.bool_)
    apart[1:] = (wide[1:] != wide[:-1]).any(1) | (boxes[1:, along] > boxes[:-1, 3 + along] + _SAME_M)
    return _joined(boxes, apart)


def _joined(boxes: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The bounding box of each run of boxes; `first` [N] marks where one begins."""
    starts = np.flatnonzero(first)
    return np.concatenate([np.minimum.reduceat(boxes[:, :3], starts), np.maximum.reduceat(boxes[:, 3:], starts)], 1)
