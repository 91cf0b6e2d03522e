"""Where a body can walk to: a flood over floors from where it starts, in cells, stopped by walls, edges and steps too high."""

from __future__ import annotations

from typing import Protocol

import torch

from .occupancy import Walker

CELL_M = 0.4  # between two places; walls stand further apart from whoever is beside them
_WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1))
_PARTS = 4  # of the way from one place to the next, each looked at


class Collider(Protocol):
    """What Solids and Occupancy have in common."""

    def blocked(self, place: torch.Tensor, body: Walker) -> torch.Tensor: ...
    def surface(self, place: torch.Tensor, body: Walker) -> torch.Tensor: ...


def walkable(collider: Collider, starts: torch.Tensor, body: Walker, most: int) -> torch.Tensor:
    """Places [N, 3] of the eye, metres, at most `most`, the nearest to `starts` [S, 3] first: each CELL_M from a neighbour, from
    which one can walk straight there. Where floors lie above each other, the one that is come to first."""
    origin = starts[0, :2]
    cells = ((starts[:, :2] - origin) / CELL_M).round().long()
    frontier, heights = _stood(collider, torch.cat([origin + cells * CELL_M, starts[:, 2:]], 1), cells, body)
    seen = {tuple(cell) for cell in frontier.tolist()}
    found = [_first(frontier, heights)]
    while len(frontier := found[-1][0]) and sum(len(cell) for cell, _ in found) < most:
        heights, ways = found[-1][1], torch.tensor(_WAYS)
        cells = (frontier[:, None] + ways).flatten(0, 1)
        begun = heights.repeat_interleave(len(_WAYS))
        fresh = torch.tensor([tuple(cell) not in seen for cell in cells.tolist()])
        cells, begun, back = cells[fresh], begun[fresh], ways.repeat(len(frontier), 1)[fresh]
        reached, heights = _reached(collider, origin, cells, begun, back, body)
        found.append(_first(reached, heights))
        seen |= {tuple(cell) for cell in found[-1][0].tolist()}
    cells, heights = (torch.cat(parts) for parts in zip(*found))
    return torch.cat([origin + cells * CELL_M, heights[:, None]], 1)[:most]


def _stood(
    collider: Collider, place: torch.Tensor, cells: torch.Tensor, body: Walker
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of places [n, 3] those where one stands on something and in nothing: their cells, and how high the eye is there."""
    level = collider.surface(place, body)
    eye = torch.cat([place[:, :2], (level + body.eye_m)[:, None]], 1)
    free = (
        ~level.isnan() & (level >= place[:, 2] - body.eye_m - body.step_m) & ~collider.blocked(eye.nan_to_num(), body)
    )
    return cells[free], eye[free, 2]


def _reached(
    collider: Collider, origin: torch.Tensor, cells: torch.Tensor, height: torch.Tensor, way: torch.Tensor, body: Walker
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which cells [n, 2] are come to by a step `way` [n, 2] from eyes as high as `height` [n]."""
    for part in range(1, _PARTS + 1):
        there = origin + (cells - way * (1 - part / _PARTS)) * CELL_M
        kept, height = _stood(collider, torch.cat([there, height[:, None]], 1), torch.arange(len(cells)), body)
        cells, way = cells[kept], way[kept]
    return cells, height


def _first(cells: torch.Tensor, heights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each cell once."""
    row = {tuple(cell): at for at, cell in reversed(list(enumerate(cells.tolist())))}
    keep = torch.tensor(sorted(row.values()), dtype=torch.long)
    return cells[keep], heights[keep]
