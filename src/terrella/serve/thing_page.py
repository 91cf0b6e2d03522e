"""What the page of a place asks for to put things by words, and what it gets."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..core.errors import ServeError
from ..space.edits import FARTHEST_M, Edit
from .place_scene import PlaceScene


@dataclass(frozen=True)
class Spot:
    """A spot in a place. World frame, metres."""

    at: tuple[float, float, float]  # where the ray of the pointer ends
    floor: float  # height of what is below
    ceiling: float | None = None  # height of what is above; None where it is not known
    wall: bool = False  # whether it lies on something upright
    degrees: float = 0.0  # of what is put there: 0 looks south, 90 east


@dataclass(frozen=True)
class PutThings:
    """Things that were put: the merges that add them, what each adds, which stand on a floor, and the words without effect."""

    edits: tuple[Edit, ...]
    scenes: tuple[PlaceScene, ...]
    stands: tuple[bool, ...]
    unknown: tuple[str, ...]


def read_spot(given: Mapping[str, Any]) -> Spot:
    """A spot as the page sends it; ServeError for numbers that are none, or too large."""
    at, rest = given.get("at"), [given.get("floor"), given.get("degrees")]
    numbers = [*(at if isinstance(at, list) else []), *rest]
    ceiling = given.get("ceiling")
    numbers += [] if ceiling is None else [ceiling]
    plain = all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in numbers)
    if len(numbers) < 5 or not plain or max(map(abs, numbers)) > FARTHEST_M:
        raise ServeError("a spot has `at` (x y z), `floor` and `degrees`, finite numbers; reload the page.")
    x, y, z, floor, degrees = (float(v) for v in numbers[:5])
    return Spot((x, y, z), floor, None if ceiling is None else float(ceiling), given.get("wall") is True, degrees)
