"""Ways through a Doom map: free space on a grid, distances to a sector, and the buttons of a player who walks there."""

import heapq
import math

import numpy as np

from .doom_map import Sectors

CELL = 8.0  # map units
CLEAR = 19.0  # distance of the player's centre from walls, map units; the player is 32 wide
ROOMY, DETOUR = 32.0, 2.0  # a cell nearer to a wall than this costs so much more
AHEAD = 96.0  # map units along the way to the point at which the teacher looks
ALIGNED, WALKS = (
    math.radians(6),
    math.radians(30),
)  # errors of heading: below the first it does not turn, below the second it walks


class RoomRoutes:
    """Ways to the sectors of a map. Coordinates in map units, headings in radians."""

    def __init__(self, walls: Sectors):
        self.walls, points = walls, walls.lines.reshape(-1, 2)
        self.low = points.min(0)
        count = np.ceil((points.max(0) - self.low) / CELL).astype(int) + 1
        self.centres = self.low + CELL * np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1)
        flat = self.centres.reshape(-1, 2)
        self.sector = np.array([self.sector_at(x, y) for x, y in flat]).reshape(count)
        self.clear = _distance(flat, walls.lines[walls.solid]).reshape(count)
        self.free = (self.clear >= CLEAR) & (self.sector >= 0)
        self._fields: dict[int, np.ndarray] = {}

    def sector_at(self, x: float, y: float) -> int:
        """The sector around a point; -1 outside the map."""
        first, lines = self.walls.first, self.walls.lines
        x1, y1, x2, y2 = lines.T
        crossed = (y1 > y) != (y2 > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossed &= x < x1 + (y - y1) / (y2 - y1) * (x2 - x1)
        inside = np.add.reduceat(crossed, first[:-1]) % 2 if len(lines) else np.zeros(0)
        return int(np.flatnonzero(inside)[0]) if inside.any() else -1

    def free_points(self, sector: int) -> list[tuple[float, float]]:
        """Points in a sector at which a player can stand."""
        return [tuple(point) for point in self.centres[self.free & (self.sector == sector)].tolist()]

    def buttons(self, x: float, y: float, yaw: float, sector: int) -> list[str]:
        """The buttons of a player at (x, y) who walks to a sector."""
        aim = self._point_ahead(x, y, sector)
        error = math.remainder(math.atan2(aim[1] - y, aim[0] - x) - yaw, math.tau)
        pressed = [] if abs(error) < ALIGNED else ["TURN_LEFT" if error > 0 else "TURN_RIGHT"]
        return pressed + (["MOVE_FORWARD"] if abs(error) < WALKS else [])

    def _point_ahead(self, x: float, y: float, sector: int) -> np.ndarray:
        """The farthest point of the way, up to AHEAD, to which the straight line is free; the next one if none is."""
        field = self._field(sector)
        cell = self._nearest_free(x, y)
        aim, here = self.centres[cell], np.array([x, y])
        for _ in range(int(AHEAD / CELL)):
            around = [(cell[0] + i, cell[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
            best = min((one for one in around if field[one] < field[cell]), key=lambda one: field[one], default=None)
            if best is None:
                break
            cell = best
            if not self._straight(here, self.centres[cell]):
                break
            aim = self.centres[cell]
        return aim

    def _nearest_free(self, x: float, y: float) -> tuple[int, int]:
        away = np.where(self.free, ((self.centres - (x, y)) ** 2).sum(-1), np.inf)
        return tuple(int(each) for each in np.unravel_index(away.argmin(), away.shape))  # pyright: ignore

    def _straight(self, start: np.ndarray, end: np.ndarray) -> bool:
        steps = np.linspace(start, end, max(2, int(np.hypot(*(end - start)) / CELL) + 1))[1:]
        cells = np.rint((steps - self.low) / CELL).astype(int)
        return bool(self.free[cells[:, 0], cells[:, 1]].all())

    def _field(self, sector: int) -> np.ndarray:
        """The length of the way from each cell to a sector, in cells; infinite where there is none (Dijkstra)."""
        if sector not in self._fields:
            field = np.where(self.free & (self.sector == sector) & (self.clear >= ROOMY), 0.0, np.inf)
            queue = [(0.0, *cell) for cell in np.argwhere(field == 0).tolist()]
            while queue:
                cost, i, j = heapq.heappop(queue)
                if cost > field[i, j]:
                    continue
                for a in (i - 1, i, i + 1):
                    for b in (j - 1, j, j + 1):
                        step = math.hypot(a - i, b - j) * (DETOUR if self.clear[a, b] < ROOMY else 1.0)
                        if self.free[a, b] and cost + step < field[a, b]:
                            field[a, b] = cost + step
                            heapq.heappush(queue, (cost + step, a, b))
            self._fields[sector] = field
        return self._fields[sector]


def _distance(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """The distance [N] of points [N, 2] to the nearest of lines [M, 4]."""
    start, along = lines[:, :2], lines[:, 2:] - lines[:, :2]
    from_start = points[:, None] - start
    share = ((from_start * along).sum(-1) / (along**2).sum(-1).clip(1e-9)).clip(0, 1)
    return np.linalg.norm(from_start - share[..., None] * along, axis=-1).min(1)
