"""A piece of furniture by itself, from words: "a red chair". It is built in a plain room at a time of day, without that room."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from ...core.errors import ContractError
from ..raster import Gaussians
from ..raster.gaussians import join, plain_sh
from .bake import build
from .blocks import blocks_of
from .furniture import KINDS, kind_of
from .placing import FurnitureRequest
from .room_layout import read_layout
from .text_layout import furniture_in

MOST_AT_ONCE = 12
ROOM_M, CLEAR_M = 4.0, 1.5  # the least side of the plain room, and what is free around the thing
LARGEST_M = 12.0  # side of a thing
HEIGHT_M = 2.7  # of the plain room, where the thing is not higher
GAUSSIANS = 30_000  # of the thing and of the room, which is left out
LOOKS = {"floor": "#b9b4aa paint", "walls": "#e6e3dc paint", "ceiling": "white paint"}  # of the plain room
SPECK = [
    -0.001,
    -0.001,
    0.0,
    0.001,
    0.001,
    0.001,
]  # the box of what walkers pass through: a place keeps its boxes with it
SHADE, SHADE_M = 0.4, 0.003  # opacity of the shadow beneath a thing, and its height above the floor


@dataclass(frozen=True)
class BuiltThing:
    """A thing whose foot lies around the origin, its front to the south. Metres."""

    name: str  # its words: "red chair"
    stands: str  # wall, middle, corner, any, hung or ceiling (furniture.py)
    size: tuple[float, float, float]  # width, depth and height
    hangs_m: float  # height above the floor, of what hangs on a wall
    gaussians: Gaussians
    solids: torch.Tensor  # float32 [S, 6], boxes that stop walkers


def parse_things(text: str) -> tuple[list[FurnitureRequest], tuple[str, ...], str]:
    """The furniture that a text names, the words without effect, and the style, "" for none. ContractError if it names none, or too
    much."""
    things, unknown, style = furniture_in(text)
    many = sum(one.count for one in things)
    if not many:
        raise ContractError(
            f"nothing in '{text:.80}' is a thing to put somewhere; try \"a red chair\". Things: {', '.join(sorted(KINDS))}."
        )
    if many > MOST_AT_ONCE:
        raise ContractError(f"at most {MOST_AT_ONCE} things are put at once; '{text:.80}' names {many}.")
    return things, unknown, style


def build_thing(request: FurnitureRequest, style: str = "plain", time: str = "day") -> BuiltThing:
    """Builds one thing of a request in a style (styles.py), lit at a time of day (daylight.py). The same request gives the same
    bytes. ContractError for one that is too large."""
    kind, name = kind_of(request.label), " ".join(filter(None, (request.look, request.label)))
    across, deep, high = (max(round(a * b, 3), 0.01) for a, b in zip(kind.size, request.scale))
    high = min(high, HEIGHT_M) if request.label == "pillar" else high
    if max(across, deep, high) > LARGEST_M:
        raise ContractError(f"the {name} would be {across:g} by {deep:g} by {high:g} m; {LARGEST_M:g} m is the most.")
    side = max(ROOM_M, across + 2 * CLEAR_M, deep + 2 * CLEAR_M)
    roof = high if request.label == "pillar" else max(HEIGHT_M, high + 0.4)
    foot = {"hung": min(kind.hangs_m, roof - high), "ceiling": roof - high}.get(kind.stands, 0.0)
    north = (side - deep) / 2 if kind.stands == "hung" else 0.0
    thing = {"label": request.label, "at": [0, north, foot], "size": [across, deep, high]}
    room = {"name": "plain", "at": [-side / 2, -side / 2, 0], "size": [side, side, roof], **LOOKS}
    plan = read_layout({
        "rooms": [room], "things": [thing | ({"look": request.look} if request.look else {})], "name": name,
        "start": [0, 0.5 - side / 2, 90], "style": style, "time": time,
    })  # fmt: skip
    place, blocks, origin = build(plan, GAUSSIANS), blocks_of(plan), torch.tensor([0.0, north, foot])
    gaussians = place.gaussians.at(place.objects == 1)
    gaussians = replace(gaussians, means=gaussians.means - origin)
    if kind.stands not in ("hung", "ceiling") and not kind.soft:
        gaussians = join([gaussians, _shadow(across, deep, gaussians.sh.shape[1])])
    mine = np.asarray(blocks.objects) == 1
    solids = torch.from_numpy(blocks.boxes[mine & np.asarray(blocks.solid)]).float() - origin.repeat(2)
    solids = solids if len(solids) else torch.tensor([SPECK])
    return BuiltThing(name, kind.stands, (across, deep, high), kind.hangs_m, gaussians, solids)


def _shadow(across: float, deep: float, terms: int) -> Gaussians:
    """A soft dark spot on the floor beneath a thing, as no light reaches it from above."""
    black = torch.zeros(1, terms, 3)
    black[:, :1] = plain_sh(torch.zeros(1, 3))
    return Gaussians(
        torch.tensor([[0.0, 0.0, SHADE_M]]), torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[0.36 * across, 0.36 * deep, 0.001]]), torch.tensor([SHADE]), black,
    )  # fmt: skip
