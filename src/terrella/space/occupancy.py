"""An occupancy grid of a place, computed from its Gaussians, and how walkers move in it. World frame, metres, z up. A walker is an
upright cylinder; its place is the position of its eye."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from .camera import rotation
from .raster import Gaussians

MOST_CELLS = 24_000_000
LEFT_OUT = (0.001, 0.005, 0.02)  # shares of the points at each end of an axis that may lie beyond the grid
SOLID = 0.3  # Gaussians above this opacity are obstacles
_SAMPLES = 32  # sample points of a Gaussian
_FEWEST = 6  # samples that make a cell solid; those of a Gaussian wider than a cell count once per cell that it covers
_PARTS = 6  # a move is checked in this many parts
_DEEPEST_M = 8.0  # deeper floors below the feet are ignored


@dataclass(frozen=True)
class Walker:
    """The size of a body that walks, in metres."""

    radius_m: float = 0.25
    eye_m: float = 1.6  # height of the eye above the feet
    step_m: float = 0.45  # it steps onto what is at most this high
    head_m: float = 0.15  # headroom above the eye


@dataclass(frozen=True)
class Occupancy:
    """A grid of cubic cells."""

    origin: torch.Tensor  # float32 [3], its low corner
    cell_m: float
    solid: torch.Tensor  # bool [X, Y, Z]
    top: torch.Tensor  # float32 [X, Y, Z], height of the surface in a solid cell

    @staticmethod
    def of(gaussians: Gaussians, cell_m: float = 0.1) -> Occupancy:
        """The cells that opaque Gaussians fill. In a very large place cells are wider than `cell_m`."""
        some = gaussians.at(gaussians.opacities > SOLID)
        if not len(some):
            return Occupancy(torch.zeros(3), cell_m, torch.zeros(1, 1, 1, dtype=torch.bool), torch.zeros(1, 1, 1))
        noise = samples()
        turn = rotation(torch.cat([torch.zeros_like(some.means), some.quats], 1))
        points = some.means[:, None] + (noise[None] * some.scales[:, None].clamp_max(1.0)) @ turn.mT
        low, high, cell_m = extent(some.means, cell_m)
        size = ((high - low) / cell_m).ceil().long().clamp_min(1)
        points = points.flatten(0, 1)
        at = ((points - low) / cell_m).floor().long()
        inside = ((at >= 0) & (at < size)).all(1)
        at, points = at[inside], points[inside]
        flat = (at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2]
        total = int(size.prod())
        broad = (
            (2.4 * some.scales.sort(1).values[:, 1:].clamp_max(1.0) / cell_m).clamp_min(1).prod(1)
        )  # cubes that it covers
        weight = broad.repeat_interleave(_SAMPLES)[inside]
        count = torch.zeros(total).index_add_(0, flat, weight)
        top = torch.zeros(total).index_add_(0, flat, weight * points[:, 2]) / count.clamp_min(1e-3)
        shape = tuple(size.tolist())
        return Occupancy(low, cell_m, (count >= _FEWEST).view(shape), top.view(shape))

    @property
    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Its low and high corners, each [3]."""
        return self.origin, self.origin + self.cell_m * torch.tensor(self.solid.shape)

    def blocked(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Whether walkers at `place` [B, 3] overlap a solid cell: bool [B]. Cells as low as a step do not count."""
        angle = torch.arange(8) * (math.pi / 4)
        radius = max(
            body.radius_m - 0.25 * self.cell_m, 0.5 * body.radius_m
        )  # surfaces lie within cells: no body is deeper than 10 cm
        ring = torch.cat([torch.stack([angle.cos(), angle.sin()], 1) * radius, torch.zeros(1, 2)])
        low, high = -body.eye_m + body.step_m, body.head_m
        levels = torch.linspace(low, high, max(2, math.ceil((high - low) / self.cell_m) + 1))
        offset = torch.cat(
            [ring[:, None].expand(-1, len(levels), 2), levels[None, :, None].expand(len(ring), -1, 1)], 2
        )
        return self.holds(place[:, None] + offset.flatten(0, 1).to(place)).any(1)

    def holds(self, points: torch.Tensor) -> torch.Tensor:
        """Whether points [..., 3] lie in a solid cell: bool [...]."""
        cells, inside = self.cells(points)
        return self.solid[cells] & inside

    def floor(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Height of the floor under walkers [B]; without one, the feet."""
        level = self.surface(place, body)
        return torch.where(level.isnan(), place[:, 2] - body.eye_m, level)

    def surface(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Height of the highest surface up to a step above the feet [B], averaged over the neighbouring cells; nan without one."""
        feet = place[:, 2] - body.eye_m
        deep = math.ceil((_DEEPEST_M + body.step_m) / self.cell_m)
        down = body.step_m - torch.arange(deep) * self.cell_m
        near = torch.tensor([-1.0, 0.0, 1.0]) * self.cell_m
        offset = torch.stack(torch.meshgrid(near, near, down, indexing="ij"), -1).to(place)  # [3, 3, deep, 3]
        below = torch.stack([place[:, 0], place[:, 1], feet], 1)
        cells, inside = self.cells(below[:, None, None, None] + offset)
        solid = self.solid[cells] & inside
        first = solid.int().argmax(3, keepdim=True)
        tops = self.top[cells].gather(3, first)[..., 0]
        level = torch.where(solid.any(3), tops, torch.nan).flatten(1)
        middle = level.nanmedian(1, keepdim=True).values
        return torch.where((level - middle).abs() < self.cell_m, level, torch.nan).nanmean(1)

    def walk(self, place: torch.Tensor, wish: torch.Tensor, body: Walker) -> torch.Tensor:
        """Where walkers at `place` [B, 3] end up that try to move by `wish` [B, 3], sliding along walls: [B, 3]. Those that
        overlap a solid cell may leave it."""
        stuck = self.blocked(place, body)
        return slide(lambda at: (self.blocked(at, body) & ~stuck).float(), place, wish)

    def cell_of(self, point: torch.Tensor) -> np.ndarray:
        """The indices [3] of the cell in which a point [3] lies, or of the nearest."""
        return torch.stack(self.cells(point)[0]).numpy()

    def cells(self, points: torch.Tensor) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
        """Indices of the cells of points [..., 3], and whether they are in the grid."""
        at = ((points - self.origin) / self.cell_m).floor().long()
        size = torch.tensor(self.solid.shape)
        return at.clamp_min(0).minimum(size - 1).unbind(-1), ((at >= 0) & (at < size)).all(-1)


def extent(means: torch.Tensor, cell_m: float = 0.1) -> tuple[torch.Tensor, torch.Tensor, float]:
    """The corners [3] of a grid around points [N, 3], and its cell size: `cell_m`, or larger to keep within MOST_CELLS. Where cells
    would be larger, more of the outermost points are left out."""
    step = max(len(means) // 1_000_000, 1)
    ends = torch.tensor([[share, 1 - share] for share in LEFT_OUT])
    low, high = torch.quantile(means[::step], ends.flatten(), dim=0).view(-1, 2, 3).unbind(1)
    sides = [(float((two - one + 1).prod()) / MOST_CELLS) ** (1 / 3) for one, two in zip(low, high)]
    at = next((k for k, side in enumerate(sides) if side <= cell_m), len(sides) - 1)
    return low[at] - 0.5, high[at] + 0.5, max(cell_m, sides[at])


def slide(depth: Callable[[torch.Tensor], torch.Tensor], place: torch.Tensor, wish: torch.Tensor) -> torch.Tensor:
    """Places [B, 3] moved by `wish` [B, 3] in short steps that never increase the penetration `depth` [B]: each step as a whole, or
    along one axis after the other."""
    here = depth(place)
    for _ in range(_PARTS):
        step = wish / _PARTS
        for axes in ((1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)):
            target = place + step * step.new_tensor(axes)
            deep = depth(target)
            free = deep <= here
            place, here = torch.where(free[:, None], target, place), torch.where(free, deep, here)
            step = torch.where(free[:, None], step * (1 - step.new_tensor(axes)), step)
    return place


def samples() -> torch.Tensor:
    """Sample points [n, 3] of a Gaussian, in standard deviations."""
    noise = torch.randn(_SAMPLES, 3, generator=torch.Generator().manual_seed(0))
    return noise * (1.2 / noise.norm(dim=1, keepdim=True).clamp_min(1.2))
