"""Geometry of a learned dynamics: the dimensions that data fill, how far rollouts leave them, how fast nearby rollouts part.

All of it is of plain tensors and of a step, a function (number of the step t, points [B, M, S]) -> points one step later: M points
of each of B rollouts.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from .statistics import Figure, ratio_interval

Step = Callable[[int, Tensor], Tensor]
NEARBY = 1e-3  # of finite differences, in the unit of the points


def intrinsic_dimension(paths: Tensor, rng: torch.Generator) -> Figure:
    """The dimension of the set on which N paths [N, R, D] run, by the ratio of the distances to the second and the first neighbour
    (TwoNN, Facco et al. 2017). Points of one path lie on a line, so neighbours are the points of other paths at the same step."""
    apart = torch.stack([_to_others(points) for points in paths.unbind(1)], 1)
    first, second = apart.topk(2, 2, largest=False).values.unbind(2)
    known = first > 0
    logs = torch.where(known, (second / first.clamp_min(1e-30)).log(), 0.0)
    return ratio_interval(known.double().sum(1), logs.sum(1), rng)


def distance_to_data(points: Tensor, paths: Tensor) -> Tensor:
    """How far points [..., D] are from data, paths [N, R, D]: the distance to the nearest one over the median of that of the data
    to those of another path. About 1 is within the data."""
    count, rows, _ = paths.shape
    flat, path = paths.flatten(0, 1), torch.arange(count).repeat_interleave(rows)
    own = _apart(flat, flat).masked_fill(path[:, None] == path[None], torch.inf).amin(1)
    return _apart(points.flatten(0, -2), flat).amin(1).view(points.shape[:-1]) / own.median().clamp_min(1e-12)


def lyapunov_exponents(step: Step, start: Tensor, steps: int, count: int, rng: torch.Generator) -> Tensor:
    """The `count` largest local Lyapunov exponents of each rollout [B, count], per step: the mean logarithm by which small
    differences grow over `steps` steps from start [B, S] (Benettin et al. 1980)."""
    at, size = start, start.shape[1]
    ways = torch.linalg.qr(torch.randn(len(start), size, min(count, size), generator=rng, dtype=start.dtype)).Q
    grown = start.new_zeros(len(start), ways.shape[2])
    for number in range(steps):
        rows = step(number, torch.cat([at[:, None], at[:, None] + NEARBY * ways.mT], 1))
        at = rows[:, 0]
        ways, lengths = torch.linalg.qr((rows[:, 1:] - rows[:, :1]).mT / NEARBY)
        grown += lengths.diagonal(dim1=1, dim2=2).abs().clamp_min(1e-12).log()
    return grown / steps


def jacobians(step: Step, number: int, points: Tensor, columns: slice) -> Tensor:
    """The derivatives [B, n, n] of the coordinates `columns` of the points [B, S] after a step by the same ones before it."""
    ways = NEARBY * torch.eye(points.shape[1], dtype=points.dtype)[columns]
    rows = step(number, torch.cat([points[:, None] + ways, points[:, None] - ways], 1))[..., columns]
    ahead, behind = rows.chunk(2, 1)
    return ((ahead - behind) / (2 * NEARBY)).mT


def effective_rank(matrices: Tensor) -> Tensor:
    """The participation ratio of the squared singular values of matrices [..., n, m]: n where all are equal, else less."""
    square = torch.linalg.svdvals(matrices).square()
    return square.sum(-1).square() / square.square().sum(-1).clamp_min(1e-30)


def parting(step: Step, start: Tensor, steps: int, unit: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """How far rollouts part [B, steps] from the same ones with an error added at every step: RMS of the last coordinates, in
    `unit` [D]. draw: an error [B, D] of them."""
    size = len(unit)
    rows, apart = start[:, None].repeat(1, 2, 1), []
    for number in range(steps):
        rows = step(number, rows)
        rows[:, 1, -size:] += draw()
        apart.append(((rows[:, 1] - rows[:, 0])[:, -size:] / unit).square().mean(1).sqrt())
    return torch.stack(apart, 1)


@torch.no_grad()
def linear_regions(network: nn.Sequential, first: Tensor, last: Tensor) -> int:
    """The number of linear regions of a network of nn.Linear and nn.ReLU that the straight line between two inputs [D] crosses,
    exactly: where the sign of a unit changes, another region begins (Montufar et al. 2014). ValueError for other layers."""
    share = torch.tensor([0.0, 1.0], dtype=torch.float64)
    values = torch.stack([first, last]).double()
    for layer in network:
        if isinstance(layer, nn.Linear):
            values = values @ layer.weight.double().T + (0.0 if layer.bias is None else layer.bias.double())
        elif isinstance(layer, nn.ReLU):
            share, values = _with_kinks(share, values)
            values = values.relu()
        else:
            raise ValueError(f"linear regions are of networks of Linear and ReLU; this one has {type(layer).__name__}.")
    return len(share) - 1


def _with_kinks(share: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """(shares [P] of the line, values [P, U] there), with the points at which a unit is 0. Values are linear between points."""
    low, high = values[:-1], values[1:]
    part, unit = ((low < 0) & (high > 0) | (low > 0) & (high < 0)).nonzero(as_tuple=True)
    along = low[part, unit] / (low[part, unit] - high[part, unit])
    kinks = torch.lerp(share[part], share[part + 1], along)
    rows = torch.lerp(low[part], high[part], along[:, None])
    rows[torch.arange(len(part)), unit] = 0.0
    every, order = torch.cat([share, kinks]).sort()
    whole = torch.cat([values, rows])[order]
    new = torch.cat([torch.ones(1, dtype=torch.bool), every.diff() > 1e-12])
    return every[new], whole[new]


def _to_others(points: Tensor) -> Tensor:
    """Distances [N, N] of points [N, D] to each other, infinite to themselves."""
    return _apart(points, points).fill_diagonal_(torch.inf)


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Distances [N, M], exact where points are near."""
    return torch.cdist(a.double(), b.double(), compute_mode="donot_use_mm_for_euclid_dist")
