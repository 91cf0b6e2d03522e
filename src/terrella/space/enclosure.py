"""The collider of a place of which only Gaussians are known, closed: a flood fill from a point in free space tells inside from
outside, so that small holes hold and nobody leaves over an edge where the place ends. World frame, metres, z up."""

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from .carving import carved
from .flooring import floored, standing
from .kernels_numba.flood import flood, spread, without_islands
from .occupancy import Occupancy, Walker
from .raster import Gaussians

ColliderKind = Literal["open", "indoor", "outdoor", "object"]
ColliderChoice = Literal["auto", "open", "indoor", "outdoor", "object"]
GAP_CELLS = 2  # cells from any obstacle that the flood keeps: narrower gaps than twice this and a cell are closed
BEYOND_M = 1.0  # how far a floor goes on where it has holes or ends
ISLAND = 12  # cells of a group below which it is taken for haze, as fits have it
CEILED = 0.6  # share of the directions above the horizon that end within the place: from there it is indoors
SMALL_M = 4.0  # an outdoor place that is smaller is an object


def enclosed(gaussians: Gaussians, eyes: torch.Tensor, kind: ColliderKind, body: Walker) -> Occupancy:
    """The grid that Gaussians fill without what lies before surfaces seen from `eyes` [E, 3], points in free space, and with all
    cells solid that no flood from the first reaches.

    open:    what the Gaussians fill, and no more.
    indoor:  floors go on where they have holes, up to BEYOND_M; farther on, where the place ends, an invisible wall stands. A body
             below the first of the eyes is free, and small groups of cells that touch nothing else are no obstacles.
    outdoor: the same, but floors go on to the end of the grid.
    object:  the flood begins outside, so that the object is solid; it stands on a level floor.
    """
    place, seed = Occupancy.of(gaussians), eyes[0]
    if kind == "open" or not bool(place.solid.any()):
        return place
    if kind == "object":
        solid, top, cell = place.solid.numpy().copy(), place.top.numpy().copy(), place.cell_m
        ground = int(np.argmax(solid.any((0, 1))))
        solid[:, :, : ground + 1], top[:, :, ground] = True, float(place.origin[2]) + cell * (ground + 1)
        reached = flood(~solid, np.array([0, 0, solid.shape[2] - 1]))
        return _closed(place, ~reached, top)
    place = carved(_cleared(place, seed, body), gaussians, eyes, body)
    place = replace(place, solid=torch.from_numpy(without_islands(place.solid.numpy(), ISLAND)))
    place = floored(place, seed, body, math.inf if kind == "outdoor" else BEYOND_M)
    solid, top = place.solid.numpy(), place.top.numpy()
    start = place.cell_of(seed)
    wide = ~spread(solid, _ball(GAP_CELLS))
    if not wide.any():
        return _closed(place, solid, top)
    cells = np.argwhere(wide)
    reached = spread(flood(wide, cells[np.argmin(((cells - start) ** 2).sum(1))]), _ball(GAP_CELLS)) & ~solid
    return _closed(place, ~reached, top)


def _cleared(place: Occupancy, seed: torch.Tensor, body: Walker) -> Occupancy:
    """The grid with a body free that stands below the point `seed` [3], for one begins there: whatever is solid, as haze is in
    fits, from a step above its feet to its head."""
    eye = standing(place, seed, body)
    x, y, z = (
        side + place.cell_m * (torch.arange(count) + 0.5) - at
        for side, count, at in zip(place.origin, place.solid.shape, eye)
    )
    near = (x[:, None].square() + y.square()).sqrt() < body.radius_m + 0.75 * place.cell_m
    tall = (z > body.step_m - body.eye_m) & (z < body.head_m + 0.5 * place.cell_m)
    return replace(place, solid=place.solid & ~(near[..., None] & tall))


def _closed(place: Occupancy, solid: np.ndarray, top: np.ndarray) -> Occupancy:
    """A grid with these solid cells; the surface of those that were not solid before lies in their middle, unless `top` says."""
    middle = float(place.origin[2]) + place.cell_m * (np.arange(solid.shape[2]) + 0.5)
    measured = place.solid.numpy() | (top != place.top.numpy())
    return replace(
        place, solid=torch.from_numpy(solid), top=torch.from_numpy(np.where(measured, top, middle).astype(np.float32))
    )


def _ball(cells: int) -> np.ndarray:
    """The offsets of all cells within a ball, int64 [K, 3]."""
    offsets = np.mgrid[-cells : cells + 1, -cells : cells + 1, -cells : cells + 1].reshape(3, -1).T
    return offsets[(offsets**2).sum(1) <= cells**2 + 1]


def kind_of_place(place: Occupancy, seed: torch.Tensor) -> ColliderKind:
    """What the place around a point [3] looks like: most ways upward end indoors; an outdoor place below SMALL_M is an object."""
    count = 200
    height = (torch.arange(count) + 0.5) / count
    turn = math.pi * (3 - math.sqrt(5)) * torch.arange(count)
    flat = (1 - height.square()).sqrt()
    ways = torch.stack([flat * turn.cos(), flat * turn.sin(), height], 1)
    far = place.cell_m * float(torch.tensor(place.solid.shape).float().norm())
    points = seed + torch.arange(2 * place.cell_m, far, 0.5 * place.cell_m)[:, None, None] * ways
    ends = place.holds(points).any(0).float().mean()
    if float(ends) >= CEILED:
        return "indoor"
    return "object" if place.cell_m * max(place.solid.shape) < SMALL_M + 1 else "outdoor"


def in_free_space(place: Occupancy, point: torch.Tensor) -> bool:
    """Whether a point [3] lies within the grid and in no solid cell."""
    low, high = place.bounds
    return bool(point.isfinite().all() and ((point > low) & (point < high)).all() and not place.holds(point))
