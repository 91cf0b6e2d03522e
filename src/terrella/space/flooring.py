"""Floors of a grid that go on where they have holes, and end where nothing more is known. World frame, metres, z up."""

import math
from dataclasses import replace

import numpy as np
import torch

from .kernels_numba.flood import floors
from .occupancy import Occupancy, Walker

DROP_M = 0.6  # what lies deeper below the last floor is no floor


def floored(place: Occupancy, inside: torch.Tensor, body: Walker, beyond_m: float) -> Occupancy:
    """The grid with floor where a body that walks from `inside` [3], the place of its eye, finds none: as high as the last floor,
    for up to `beyond_m`; there, and at the end of the grid, an invisible wall stands."""
    cell, feet = place.cell_m, place.cell_of(inside - torch.tensor([0.0, 0.0, body.eye_m]))
    solid, top = place.solid.numpy().copy(), place.top.numpy().copy()
    up, tall = math.floor(body.step_m / cell), math.ceil((body.eye_m + body.head_m) / cell)
    beyond = round(min(beyond_m / cell, max(solid.shape)))
    level, away = floors(solid, feet, up, round(DROP_M / cell), tall, beyond)
    hole = (level >= 0) & (away > 0)
    i, j = np.nonzero(hole)
    solid[i, j, level[i, j]] = True
    top[i, j, level[i, j]] = float(place.origin[2]) + cell * (level[i, j] + 0.5)
    edge = hole & (away >= beyond)
    for side in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        edge[side] |= level[side] >= 0
    for i, j in np.argwhere(edge):
        solid[i, j, level[i, j] :] = True
    return replace(place, solid=torch.from_numpy(solid), top=torch.from_numpy(top))
