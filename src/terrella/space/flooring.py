"""Floors of a grid that go on where they have holes, and end where nothing more is known. World frame, metres, z up."""

import math
from dataclasses import replace

import numpy as np
import torch

from .kernels_numba.flood import floors
from .occupancy import Occupancy, Walker

DROP_M = 1.2  # what lies deeper below the last floor is no floor; one comes down from tables


def standing(place: Occupancy, eye: torch.Tensor, body: Walker) -> torch.Tensor:
    """The eye [3] of a body that stands on the floor under the point `eye` [3], at any height above it."""
    near = place.surface(eye[None], body)
    if bool((near - (eye[2] - body.eye_m)).abs() < DROP_M):
        return eye
    below = place.surface(eye[None], replace(body, eye_m=0.2, step_m=0.0))
    return eye if bool(below.isnan()) else torch.cat([eye[:2], below + body.eye_m])


def floored(place: Occupancy, inside: torch.Tensor, body: Walker, beyond_m: float) -> Occupancy:
    """The grid with floor where a body that walks from below the point `inside` [3] finds none: as high as the last floor, for up
    to `beyond_m`; there, and at the end of the grid, an invisible wall stands."""
    eye = standing(place, inside, body)
    cell, feet = place.cell_m, place.cell_of(eye - torch.tensor([0.0, 0.0, body.eye_m]))
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
