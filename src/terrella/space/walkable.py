"""The cells that a walker can reach: a flood fill over floors, stopped by walls, edges and high steps."""

from typing import Protocol

import numpy as np
import torch

from .occupancy import Walker

CELL_M = 0.4  # distance of neighbouring places
_WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1))
_PARTS = 4  # the path between neighbours is checked in this many parts


class Collider(Protocol):
    """The part of Solids and Occupancy that is needed here."""

    def blocked(self, place: torch.Tensor, body: Walker) -> torch.Tensor: ...
    def surface(self, place: torch.Tensor, body: Walker) -> torch.Tensor: ...


def walkable(collider: Collider, starts: torch.Tensor, body: Walker, most: int) -> torch.Tensor:
    """Places of the eye [N, 3] that a walker can reach from `starts` [S, 3], nearest first, at most `most`. Each is CELL_M from a
    neighbour with a straight free path. Of floors above each other, the one that is reached first."""
    origin = starts[0, :2]
    cells = ((starts[:, :2] - origin) / CELL_M).round().long()
    frontier, heights = _stood(collider, torch.cat([origin + cells * CELL_M, starts[:, 2:]], 1), cells, body)
    seen = {tuple(cell) for cell in frontier.tolist()}
    rings = [_first(frontier, heights)]
    while len(frontier := rings[-1][0]) and sum(len(cell) for cell, _ in rings) < most:
        heights, ways = rings[-1][1], torch.tensor(_WAYS)
        cells = (frontier[:, None] + ways).flatten(0, 1)
        begun = heights.repeat_interleave(len(_WAYS))
        fresh = torch.tensor([tuple(cell) not in seen for cell in cells.tolist()])
        cells, begun, back = cells[fresh], begun[fresh], ways.repeat(len(frontier), 1)[fresh]
        reached, heights = _reached(collider, origin, cells, begun, back, body)
        rings.append(_first(reached, heights))
        seen |= {tuple(cell) for cell in rings[-1][0].tolist()}
    cells, heights = (torch.cat(parts) for parts in zip(*rings))
    return torch.cat([origin + cells * CELL_M, heights[:, None]], 1)[:most]


def _stood(
    collider: Collider, place: torch.Tensor, cells: torch.Tensor, body: Walker
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of places [n, 3], those with a floor and no obstacle: their cells, and the height of the eye there."""
    level = collider.surface(place, body)
    eye = torch.cat([place[:, :2], (level + body.eye_m)[:, None]], 1)
    free = (
        ~level.isnan() & (level >= place[:, 2] - body.eye_m - body.step_m) & ~collider.blocked(eye.nan_to_num(), body)
    )
    return cells[free], eye[free, 2]


def _reached(
    collider: Collider, origin: torch.Tensor, cells: torch.Tensor, height: torch.Tensor, way: torch.Tensor, body: Walker
) -> tuple[torch.Tensor, torch.Tensor]:
    """The cells [n, 2] that can be entered by a step `way` [n, 2] from eyes at `height` [n]."""
    for part in range(1, _PARTS + 1):
        at = origin + (cells - way * (1 - part / _PARTS)) * CELL_M
        kept, height = _stood(collider, torch.cat([at, height[:, None]], 1), torch.arange(len(cells)), body)
        cells, way = cells[kept], way[kept]
    return cells, height


def _first(cells: torch.Tensor, heights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each cell once."""
    row = {tuple(cell): at for at, cell in reversed(list(enumerate(cells.tolist())))}
    keep = torch.tensor(sorted(row.values()), dtype=torch.long)
    return cells[keep], heights[keep]


def spread_out(places: torch.Tensor, count: int, rng: np.random.Generator) -> torch.Tensor:
    """`count` of places [N, 3] that lie far apart, from the first on; equally far ones by chance."""
    chosen = places[:1]
    for _ in range(min(count, len(places)) - 1):
        far = torch.cdist(places, chosen).amin(1) + 1e-3 * torch.from_numpy(rng.random(len(places))).float()
        chosen = torch.cat([chosen, places[far.argmax()][None]])
    return chosen
