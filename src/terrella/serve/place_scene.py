"""The content of the page of a place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from ..space.edits import Edit
from ..space.occupancy import Occupancy, Walker
from ..space.raster import Gaussians
from ..space.solids import Solids


@dataclass(frozen=True)
class PlaceScene:
    """The content of the page of a place."""

    name: str
    gaussians: Gaussians  # N, before all edits
    seen: torch.Tensor  # bool [N], which of them were observed
    objects: torch.Tensor  # int32 [N], the object that each belongs to (0: none; -k: hidden beneath k)
    starts: torch.Tensor  # float32 [S, 7], poses
    collider: Occupancy | Solids  # what stops a walker
    body: Walker
    pace: Sequence[float]  # as in SplatConfig
    keep: Sequence[float]  # as in SplatConfig
    dt_s: float  # duration of a step
    names: Sequence[str] = ()  # of the objects 1, 2, ...
    other: Callable[[Edit], PlaceScene] | None = None  # opens the place that an edit merges
    note: str = ""  # a sentence that the page shows when it opens
    closed: bool = False  # the collider says more than what the Gaussians fill (space/enclosure.py)
    collider_after: Callable[[Sequence[Edit]], Occupancy | Solids] | None = None  # what stops a walker after edits
