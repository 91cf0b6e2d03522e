"""Edits of a place, one line of JSON each:

    {"select": {"box": [x0, y0, z0, x1, y1, z1]}, "do": "move", "by": [dx, dy, dz]}

select: box; sphere [x, y, z, radius]; brush, the numbers of many spheres; plane [a, b, c, d], where a x + b y + c z > d; object,
its number; all true. do: move or duplicate (by, metres); turn (degrees about the vertical through the middle); scale (factor,
about the middle); recolour (colour, 0 to 1); delete. One edit selects nothing and adds another place, turned about the vertical
through its origin, then moved; its objects are numbered after the first's:

    {"do": "merge", "place": "../other", "sha256": "...", "by": [dx, dy, dz], "degrees": 90}

The page has the same edits (serve/web/place/edits.js). Both compute in double precision and store in single, so that they agree.

Gaussians of the object -k are the surfaces beneath the object k: they are transparent until an edit moves, turns, scales or deletes
a part of k. Where nothing lies beneath what is moved or deleted, the surfaces around it are continued (beneath.py)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch

from ..core.errors import ContractError
from .beneath import beneath
from .raster import Gaussians, join
from .raster.gaussians import plain_sh
from .raster.move import transform

SELECTIONS = {"box": 6, "sphere": 4, "brush": 4, "plane": 4, "object": 1, "all": 0}  # and how many numbers each takes
ACTIONS = {
    "move": ("by", 3), "duplicate": ("by", 3), "turn": ("degrees", 1), "scale": ("factor", 1), "recolour": ("colour", 3),
    "delete": ("", 0),
}  # fmt: skip
REVEALED = 0.99  # opacity of a surface that an edit reveals
MOVING = ("move", "turn", "scale", "delete")  # these reveal what lies beneath an object
MOST_DABS = 10_000  # spheres of a brush
MOST_GAUSSIANS = 20_000_000  # of a place that was edited
FARTHEST_M = 10_000.0  # from the origin: farther away single precision does not hold a millimetre
Edit = Mapping[str, Any]


class Contents(Protocol):
    """What a merge takes of another place: Gaussians, and objects int32 [N]."""

    @property
    def gaussians(self) -> Gaussians: ...
    @property
    def objects(self) -> torch.Tensor: ...


@dataclass(frozen=True)
class Edited:
    """The Gaussians after edits; origin int64 [N]: the index of each among the first ones and those of all merges, -1 if made or
    changed by an edit; objects int32 [N]: the object of each, 0 for none, -k beneath k (a duplicate is a new object); raised: what
    each merge added to the numbers of its objects."""

    gaussians: Gaussians
    origin: torch.Tensor
    objects: torch.Tensor
    raised: tuple[int, ...] = ()


def apply_edits(
    gaussians: Gaussians,
    edits: Sequence[Edit],
    objects: torch.Tensor | None = None,
    other: Callable[[Edit], Contents] | None = None,
) -> Edited:
    """Applies edits in order. objects int32 [N]; `other` opens the place of a merge. ContractError for a wrong edit, with its
    number where there are several."""
    objects = torch.zeros(len(gaussians), dtype=torch.int32) if objects is None else objects
    now, known = Edited(gaussians, torch.arange(len(gaussians)), objects), len(gaussians)
    for number, edit in enumerate(edits, 1):
        try:
            now, known = _edited(now, known, edit, other)
        except ContractError as error:
            raise ContractError(f"edit {number} of {len(edits)}: {error}" if len(edits) > 1 else str(error)) from error
    return now


def _edited(now: Edited, known: int, edit: Edit, other: Callable[[Edit], Contents] | None) -> tuple[Edited, int]:
    """What an edit makes of a place. known: how many Gaussians the first place and all that was merged into it had."""
    gaussians, objects, raised, closed = now.gaussians, now.objects, now.raised, []
    if edit.get("do") == "merge":
        if other is None:
            raise ContractError("a merge needs the other place; give `other`, which opens it.")
        came, chosen = other(edit), torch.zeros(len(gaussians), dtype=torch.bool)
        done, fresh = _placed(came.gaussians, edit), known + torch.arange(len(came.gaussians))
        raised = (*raised, int(objects.max()) if len(objects) else 0)
        belong = (came.objects + raised[-1] * came.objects.sign()).int()
        known += len(done)
    else:
        chosen = select(gaussians, edit, objects)
        if edit.get("do") in MOVING:
            gaussians, objects = _revealed(gaussians, objects, objects[chosen])
            closed = _closed(gaussians, objects, chosen, edit)
        done, belong = _done(gaussians.at(chosen), edit), objects[chosen]
        fresh = torch.full((len(done),), -1)
    if edit["do"] == "duplicate":
        belong = torch.full_like(belong, int(objects.max()) + 1)
        chosen = torch.zeros_like(chosen)  # what was duplicated stays, too
    if not (done.means.isfinite().all() and done.scales.isfinite().all()):
        raise ContractError(f"'{edit['do']}' leads out of all numbers; take smaller ones.")
    if len(gaussians) + len(done) > MOST_GAUSSIANS:
        raise ContractError(f"a place has at most {MOST_GAUSSIANS:,} Gaussians; add less.")
    new = sum(len(part) for part in closed)
    origin = torch.cat([now.origin[~chosen], fresh, torch.full((new,), -1)])
    objects = torch.cat([objects[~chosen], belong[: len(done)], torch.zeros(new, dtype=torch.int32)])
    return Edited(join([gaussians.at(~chosen), done, *closed]), origin, objects, raised), known


def _closed(gaussians: Gaussians, objects: torch.Tensor, chosen: torch.Tensor, edit: Edit) -> list[Gaussians]:
    """Copies of what lies around, which close the hole that the chosen leave in the surfaces beside them (beneath.py)."""
    if next(iter(edit["select"])) in ("all", "plane"):
        return []
    taken, stay = gaussians.means[chosen].double(), (~chosen & (objects >= 0)).nonzero()[:, 0]
    places, sources = beneath(gaussians.means[stay].double(), taken.amin(0), taken.amax(0))
    return [replace(gaussians.at(stay[sources]), means=places.float())]


def _revealed(gaussians: Gaussians, objects: torch.Tensor, touched: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
    """With the surfaces beneath the objects `touched` (numbers) opaque, as parts of no object."""
    beneath = (objects < 0) & torch.isin(-objects, touched)
    opacities = torch.where(beneath, REVEALED, gaussians.opacities)
    return replace(gaussians, opacities=opacities), torch.where(beneath, 0, objects)


def merges_of(edits: Sequence[Edit]) -> list[Edit]:
    """The edits that merge another place."""
    return [edit for edit in edits if edit.get("do") == "merge"]


def merged_boxes(boxes: torch.Tensor, edit: Edit) -> torch.Tensor | None:
    """Upright boxes [K, 6] (low and high corners) of a merged place; None if it was not turned by a multiple of 90 degrees."""
    quarters = edit["degrees"] / 90
    if quarters != round(quarters):
        return None
    for _ in range(round(quarters) % 4):
        x0, y0, z0, x1, y1, z1 = boxes.unbind(1)
        boxes = torch.stack([-y1, x0, z0, -y0, x1, z1], 1)
    return boxes + _numbers(edit["by"], 3, "by").repeat(2)


def _placed(some: Gaussians, edit: Edit) -> Gaussians:
    """The Gaussians of a merged place."""
    by, degrees = _numbers(edit.get("by"), 3, "by"), _numbers(edit.get("degrees"), 1, "degrees")
    placed = _turned(some, float(degrees), torch.zeros(3).double(), by.double())
    if (placed.means.abs() > FARTHEST_M).any(1).float().mean() > 0.001:
        raise ContractError(
            f"what is merged reaches farther than {FARTHEST_M / 1000:g} km; scale it first, or delete what lies far away."
        )
    return placed


def select(gaussians: Gaussians, edit: Edit, objects: torch.Tensor) -> torch.Tensor:
    """The Gaussians that an edit selects: bool [N]. ContractError if there is none, or the selection is not valid."""
    chosen = edit.get("select")
    if not isinstance(chosen, Mapping) or len(chosen) != 1 or next(iter(chosen)) not in SELECTIONS:
        raise ContractError(f"an edit selects one of {', '.join(SELECTIONS)}; got {chosen!r}.")
    kind, given = next(iter(chosen.items()))
    count = SELECTIONS[kind]
    if kind == "brush" and isinstance(given, Sequence) and 4 <= len(given) <= 4 * MOST_DABS:
        count = len(given) // 4 * 4
    numbers, means = _numbers(given, count, kind).double(), gaussians.means.double()
    if kind == "all":
        inside = torch.ones(len(means), dtype=torch.bool)
    elif kind == "box":
        low, high = numbers[:3].minimum(numbers[3:]), numbers[:3].maximum(numbers[3:])
        inside = ((means >= low) & (means <= high)).all(1)
    elif kind in ("sphere", "brush"):
        inside = torch.zeros(len(means), dtype=torch.bool)
        for dab in numbers.view(-1, 4):
            inside |= (means - dab[:3]).square().sum(1) <= dab[3] * dab[3]
    elif kind == "object":
        inside = (objects == int(numbers[0])) & (objects > 0)
    else:
        inside = means @ numbers[:3] > numbers[3]
    if not inside.any():
        shown = given if kind != "brush" else f"of {count // 4} spheres"
        raise ContractError(f"nothing lies in the {kind} {shown}; choose another place.")
    return inside


def _done(some: Gaussians, edit: Edit) -> Gaussians:
    action = edit.get("do")
    if not isinstance(action, str) or action not in ACTIONS:
        raise ContractError(f"an edit does one of {', '.join(ACTIONS)}; got {action!r}.")
    name, count = ACTIONS[action]
    numbers, means = _numbers(edit.get(name), count, name), some.means.double()
    middle = (means.amin(0) + means.amax(0)) / 2
    if action in ("move", "duplicate"):
        return replace(some, means=(means + numbers.double()).float())
    if action == "turn":
        return _turned(some, float(numbers), middle, middle)
    if action == "scale":
        if not float(numbers) > 0:
            raise ContractError("a place is scaled by a factor above 0.")
        grown = transform(some, torch.eye(3), float(numbers))
        return replace(grown, means=((means - middle) * float(numbers) + middle).float())
    if action == "recolour":
        if numbers.min() < 0 or numbers.max() > 1:
            raise ContractError("a colour is red, green and blue from 0 to 1.")
        return replace(some, sh=torch.cat([plain_sh(numbers.expand(len(some), 3)), 0 * some.sh[:, 1:]], 1))
    return some.at(torch.zeros(len(some), dtype=torch.bool))


def _turned(some: Gaussians, degrees: float, middle: torch.Tensor, to: torch.Tensor) -> Gaussians:
    """Turned about the vertical through `middle`, which comes to lie at `to`, both float64 [3]."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, y, z = (some.means.double() - middle).unbind(1)
    around = torch.stack([c * x - s * y, s * x + c * y, z], 1) + to
    rot = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return replace(transform(some, rot), means=around.float())


def _numbers(given: Any, count: int, name: str) -> torch.Tensor:
    """`count` finite numbers: float32 [count]."""
    listed = [given] if isinstance(given, int | float) else given
    fits = isinstance(listed, Sequence) and not isinstance(listed, str) and len(listed) == count
    if count and not (fits and all(_plain(one) for one in listed)):
        raise ContractError(f"'{name}' takes {count} finite numbers; got {given!r:.80}.")
    return torch.tensor(listed if count else [], dtype=torch.float32)


def _plain(number: Any) -> bool:
    """Whether it is a number within the range of float32."""
    return isinstance(number, int | float) and not isinstance(number, bool) and abs(number) < 1e30
