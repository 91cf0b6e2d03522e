"""Grids of cells on the sides of boxes."""

from dataclasses import dataclass

import numpy as np

AXES = np.array(((1, 2), (0, 2), (0, 1)))  # the two axes along a side, for each axis across it


@dataclass
class Grid:
    """Cells on the sides of K boxes. Sides that were left out have no cells."""

    points: np.ndarray  # [N, 3], middles of the cells
    sides: np.ndarray  # [N], the side 0..5 of the box
    blocks: np.ndarray  # [N], the box
    areas: np.ndarray  # [N], square metres
    starts: np.ndarray  # [6 K], the first cell of each side
    counts: np.ndarray  # [6 K, 2], cells along both axes of each side
    steps: np.ndarray  # [6 K, 2], metres

    @property
    def normals(self) -> np.ndarray:
        normals = np.zeros_like(self.points)
        normals[np.arange(len(normals)), self.sides // 2] = np.where(self.sides % 2, 1.0, -1.0)
        return normals

    @property
    def faces(self) -> np.ndarray:
        """The number of each cell's side: [N]."""
        return 6 * self.blocks + self.sides


def grid(boxes: np.ndarray, spacing: np.ndarray, used: np.ndarray | None = None) -> Grid:
    """Cells of about `spacing` [K] metres on the sides of boxes [K, 6], all or those in `used` bool [6 K]."""
    points, faces, areas = [], [], []
    starts, counts = np.zeros(6 * len(boxes), np.int64), np.zeros((6 * len(boxes), 2), np.int64)
    steps, total = np.ones((6 * len(boxes), 2)), 0
    for face in range(6 * len(boxes)):
        box, side = boxes[face // 6], face % 6
        starts[face] = total
        if used is not None and not used[face]:
            continue
        axis, (a, b) = side // 2, AXES[side // 2]
        size = box[[3 + a, 3 + b]] - box[[a, b]]
        many = np.maximum(np.ceil(size / spacing[face // 6] - 1e-6).astype(int), 1)
        steps[face], counts[face] = size / many, many
        place = np.empty((many[0], many[1], 3))
        place[..., axis] = box[3 + axis] if side % 2 else box[axis]
        place[..., a] = (box[a] + steps[face, 0] * (np.arange(many[0]) + 0.5))[:, None]
        place[..., b] = (box[b] + steps[face, 1] * (np.arange(many[1]) + 0.5))[None]
        points.append(place.reshape(-1, 3))
        faces.append(np.full(len(points[-1]), face))
        areas.append(np.full(len(points[-1]), steps[face].prod()))
        total += len(points[-1])
    face_of = np.concatenate(faces)
    return Grid(np.concatenate(points), face_of % 6, face_of // 6, np.concatenate(areas), starts, counts, steps)


def bounds_of(boxes: np.ndarray, chunk: int) -> np.ndarray:
    """Boxes [K / chunk, 6] around each `chunk` of boxes [K, 6]."""
    parts = [boxes[at : at + chunk] for at in range(0, len(boxes), chunk)]
    return np.array([[*part[:, :3].min(0), *part[:, 3:].max(0)] for part in parts]).reshape(-1, 6)
