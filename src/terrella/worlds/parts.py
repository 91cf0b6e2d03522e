"""What the parts of a learned world say to one another: channels, walls, evidence. An absent part is a null object, and falsy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import torch
from gymnasium import spaces

from ..core.errors import ObservationError

# Streams of chance (core/chance.py); CHANGES one a vital.
NOISE, STARTS, LOOKS, MOVES, GOES, CHANGES = 1, 2, 11, 12, 13, 20


@dataclass(frozen=True)
class Channels:
    """What a part adds to the Spec: the channels that it shows, their units, and which of them are evidence, needed or at
    hand."""

    shows: Mapping[str, spaces.Space] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    observes: tuple[str, ...] = ()
    may_observe: tuple[str, ...] = ()


class Absent:
    """What all null objects are: parts that show nothing and add nothing to a state."""

    kind, config = "none", None

    def __bool__(self) -> bool:
        return False

    def to(self, device) -> Self:
        return self

    def channels(self, *given) -> Channels:
        return Channels()

    def nothing(self, *given) -> dict[str, Any]:
        return {}


class Walls(NamedTuple):
    """Walls as x1, y1, x2, y2 in metres (space/floorplan.py): `shared` [S, 4] stop every body, `own` [B, N, 4] one each."""

    shared: torch.Tensor
    own: torch.Tensor


@dataclass(frozen=True)
class Evidence:
    """What an observation says of a scene, checked: the pose [B, 7] of a world that has one; `seen`, the tensors of the picture
    (none where a pose alone is known); lone [B], which pictures are of elsewhere, where pictures came alone."""

    batch: int
    device: torch.device
    pose: torch.Tensor | None = None
    seen: Mapping[str, torch.Tensor] = field(default_factory=dict)
    lone: torch.Tensor | None = None


def picture_of(observation: Mapping[str, torch.Tensor], size: tuple[int, int], device) -> torch.Tensor:
    """The rgb of an observation as uint8 [B, 3, H, W]; ObservationError where it is none of this size."""
    rgb = torch.as_tensor(observation["rgb"])
    if rgb.ndim != 4 or rgb.shape[1:] != (*size, 3) or rgb.dtype != torch.uint8:
        raise ObservationError(
            f"rgb is uint8 [B, {size[0]}, {size[1]}, 3], 0 to 255; got {rgb.dtype} {tuple(rgb.shape)}."
        )
    return rgb.to(device).permute(0, 3, 1, 2).contiguous()


def check_prior(held: int, batch: int) -> None:
    """ObservationError unless a prior of `held` episodes takes evidence of `batch`."""
    if held != batch:
        raise ObservationError(f"the prior holds {held} episodes, the evidence is of {batch}.")
