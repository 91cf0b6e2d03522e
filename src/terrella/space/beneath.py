"""What closes the hole that a thing leaves when it is taken away: the surfaces on which it stood or hung are continued across its
box from what lies around it. The page does the same (serve/web/place/beneath.js), by means alone, so that both agree."""

import math

import torch

THICK_M = 0.15  # what is thinner is a part of a surface, and leaves a hole on purpose
NEAR_M, FLAT_M = 0.06, 0.03  # a surface lies that near to an end of the box; its Gaussians that near to their median
CELL_M, STRIP_M = 0.15, 0.3  # around the box, cells of this side in a strip of this width ...
COVERED, SIDES = 0.6, 3  # ... of which a surface covers this share, on at least this many of the four sides
LEAST_M, MOST_M, MOST_NEW = 0.01, 0.1, 10_000  # spacing of new Gaussians, and how many a surface gets


def beneath(means: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """For the box between `low` and `high` [3] that was emptied, among Gaussians at `means` [N, 3], all float64: positions [M, 3]
    of new Gaussians, and for each the number [M] of the Gaussian to copy."""
    places, sources = [torch.zeros(0, 3).double()], [torch.zeros(0).long()]
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for end in (low[axis], high[axis]):
            if high[axis] - low[axis] >= THICK_M:
                rows, plane = _surface(means, low, high, axis, end)
                points, copied = _continued(means[rows][:, others], low[others], high[others])
                place = torch.full((len(points), 3), float(plane)).double()
                place[:, others] = points
                places.append(place)
                sources.append(rows[copied])
    return torch.cat(places), torch.cat(sources)


def _surface(means, low, high, axis: int, end) -> tuple[torch.Tensor, float]:
    """The numbers of those that lie in one plane near an end of the box, in and around it; where the plane is."""
    apart = torch.maximum(low - means, means - high)
    apart[:, axis] = (means[:, axis] - end).abs() + STRIP_M - NEAR_M
    rows = (apart <= STRIP_M).all(1).nonzero()[:, 0]
    if not len(rows):
        return rows, 0.0
    plane = means[rows, axis].sort().values[len(rows) // 2]
    return rows[(means[rows, axis] - plane).abs() <= FLAT_M], float(plane)


def _continued(points: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [M, 2] that continue a surface of `points` [K, 2] across a rectangle, and the number of the point to copy for each;
    none where fewer than SIDES sides of it are covered."""
    size = high - low
    sides, area, many = _around(points, low, high)
    if sum(sides) < SIDES:
        return points[:0], torch.zeros(0).long()
    spacing = min(max(math.sqrt(area / many), LEAST_M), MOST_M)
    total = float((size / spacing).ceil().clamp_min(1).prod())
    spacing *= math.sqrt(max(total / MOST_NEW, 1))
    count = (size / spacing).ceil().clamp_min(1).long()
    x, y = (low[k] + size[k] * (torch.arange(int(count[k])) + 0.5) / count[k] for k in range(2))
    new = torch.stack(torch.meshgrid(x.double(), y.double(), indexing="ij"), 2).view(-1, 2)
    open_ = torch.cat([_nearest(part, points)[0] > spacing * spacing for part in new.split(1024)])
    new = new[open_]
    deep = torch.stack([new[:, 0] - low[0], high[0] - new[:, 0], new[:, 1] - low[1], high[1] - new[:, 1]], 1)
    deep = torch.where(torch.tensor(sides), deep, math.inf)
    side = deep.argmin(1, keepdim=True)
    into = deep.gather(1, side)[:, 0] % STRIP_M  # the strip around is repeated inwards
    mirrored, side = new.clone(), side[:, 0]
    for at in range(4):
        edge = low[at // 2] - into if at % 2 == 0 else high[at // 2] + into
        mirrored[:, at // 2] = torch.where(side == at, edge, mirrored[:, at // 2])
    return new, torch.cat([torch.zeros(0).long(), *(_nearest(part, points)[1] for part in mirrored.split(1024))])


def _around(points, low, high) -> tuple[list[bool], float, int]:
    """Which sides of a rectangle are covered; the area of all cells around it with points, and how many points lie there."""
    cells = ((high - low) / CELL_M).round().clamp_min(1)
    outside = torch.where(points < low, ((points - low) / CELL_M).floor(), cells + ((points - high) / CELL_M).floor())
    inside = (points >= low) & (points <= high)
    within = ((points - low) / (high - low).clamp_min(1e-9) * cells).floor().minimum(cells - 1)
    at = torch.where(inside, within, outside)
    sides, area, many = [], 0.0, 0
    for k in range(2):
        for beyond in (points[:, k] < low[k], points[:, k] > high[k]):
            here = at[beyond & inside[:, 1 - k]].long()
            filled = len(here.unique(dim=0))
            sides.append(filled >= COVERED * 2 * float(cells[1 - k]))
            area += filled * CELL_M * float((high[1 - k] - low[1 - k]) / cells[1 - k])
            many += len(here)
    return sides, area, many


def _nearest(some: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared distance to the nearest of `points` [K, 2], and its number, of each of `some` [M, 2]."""
    off = some[:, None] - points
    least = (off[..., 0] * off[..., 0] + off[..., 1] * off[..., 1]).min(1)
    return least.values, least.indices
