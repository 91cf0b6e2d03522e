"""Edits of a place: each is a line of JSON, so that a place is its source and its edits: replayable, diffable, undone line by line.

    {"select": {"box": [x0, y0, z0, x1, y1, z1]}, "do": "move", "by": [dx, dy, dz]}

select: box; sphere [x, y, z, radius]; plane [a, b, c, d], where a x + b y + c z > d; all true. do: move or duplicate (by, metres);
turn (degrees about the vertical through the middle); scale (factor, about the middle); recolour (colour, 0 to 1); delete.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from ..core.errors import ContractError
from .raster import Gaussians, join
from .raster.gaussians import plain_sh
from .raster.move import turned

SELECTIONS = {"box": 6, "sphere": 4, "plane": 4, "all": 1}  # and how many numbers each takes
DEEDS = {
    "move": ("by", 3), "duplicate": ("by", 3), "turn": ("degrees", 1), "scale": ("factor", 1), "recolour": ("colour", 3),
    "delete": ("", 0),
}  # fmt: skip
Edit = Mapping[str, Any]


def edited(gaussians: Gaussians, edits: Sequence[Edit]) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians after the edits, and which of the first ones each still is: int64 [N], -1 for those that an edit made or
    changed. ContractError for what is no edit."""
    origin = torch.arange(len(gaussians))
    for edit in edits:
        chosen = selected(gaussians, edit)
        done = _done(gaussians.at(chosen), edit)
        if edit["do"] == "duplicate":
            chosen = torch.zeros_like(chosen)  # what was duplicated stays, too
        gaussians = join([gaussians.at(~chosen), done])
        origin = torch.cat([origin[~chosen], origin.new_full((len(done),), -1)])
    return gaussians, origin


def selected(gaussians: Gaussians, edit: Edit) -> torch.Tensor:
    """Which Gaussians an edit is about: bool [N]; ContractError where it is about none, or not understood."""
    chosen = edit.get("select")
    if not isinstance(chosen, Mapping) or len(chosen) != 1 or next(iter(chosen)) not in SELECTIONS:
        raise ContractError(f"an edit selects one of {', '.join(SELECTIONS)}; got {chosen!r}.")
    kind, given = next(iter(chosen.items()))
    numbers, means = _numbers(given, SELECTIONS[kind], kind), gaussians.means
    if kind == "all":
        inside = torch.ones(len(means), dtype=torch.bool)
    elif kind == "box":
        low, high = numbers[:3].minimum(numbers[3:]), numbers[:3].maximum(numbers[3:])
        inside = ((means >= low) & (means <= high)).all(1)
    elif kind == "sphere":
        inside = (means - numbers[:3]).norm(dim=1) <= numbers[3]
    else:
        inside = means @ numbers[:3] > numbers[3]
    if not inside.any():
        raise ContractError(f"nothing lies in the {kind} {given}; choose another place.")
    return inside


def _done(some: Gaussians, edit: Edit) -> Gaussians:
    deed = edit.get("do")
    if deed not in DEEDS:
        raise ContractError(f"an edit does one of {', '.join(DEEDS)}; got {deed!r}.")
    name, count = DEEDS[deed]
    numbers, still = _numbers(edit.get(name), count, name), torch.eye(3)
    middle = (some.means.amin(0) + some.means.amax(0)) / 2
    if deed in ("move", "duplicate"):
        return replace(some, means=some.means + numbers)
    if deed == "turn":
        c, s = math.cos(math.radians(float(numbers))), math.sin(math.radians(float(numbers)))
        rot = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return turned(some, rot, 1.0, middle - rot @ middle)
    if deed == "scale":
        if not float(numbers) > 0:
            raise ContractError("a place is scaled by a factor above 0.")
        return turned(some, still, float(numbers), middle * (1 - float(numbers)))
    if deed == "recolour":
        return replace(some, sh=torch.cat([plain_sh(numbers.expand(len(some), 3)), 0 * some.sh[:, 1:]], 1))
    return some.at(torch.zeros(len(some), dtype=torch.bool))


def _numbers(given: Any, count: int, name: str) -> torch.Tensor:
    """float32 [count] that are finite."""
    listed = [given] if isinstance(given, int | float) else given
    fits = isinstance(listed, Sequence) and not isinstance(listed, str) and len(listed) == count
    if count and not (fits and all(isinstance(one, int | float) and math.isfinite(one) for one in listed)):
        raise ContractError(f"'{name}' takes {count} finite numbers; got {given!r}.")
    return torch.tensor(listed if count else [], dtype=torch.float32)
