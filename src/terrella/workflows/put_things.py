"""Puts furniture that words name into a place: each thing is a small place in FOLDER/things, merged by one edit."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ..core.errors import TerrellaError
from ..serve.thing_page import PutThings, Spot
from ..space.edits import Edit
from ..space.layout.one_thing import BuiltThing, build_thing, parse_things
from ..space.layout.placing import FurnitureRequest
from ..worlds.additions import INVENTED
from ..worlds.splat import SolidBoxes, SplatConfig, SplatWorld
from ..worlds.splat_folder import load_source, merge_edit, save_splat
from .splat_places import page_scene

THINGS = "things"  # the folder in a place where its things lie
APART_M = 0.12  # between things of one row
ROOM_HEIGHT_M = 2.5  # where no ceiling is known
MOST_WORDS = 400  # letters


def put_things(folder: Path, words: str, spot: Spot) -> PutThings:
    """Builds the furniture that `words` name and saves it in the place's folder. Returns the merges that put it at a spot, not yet
    among the place's edits, and the words without effect. TerrellaError if the words name nothing to put."""
    if len(words) > MOST_WORDS:
        raise TerrellaError(f"that is a text of {len(words):,} letters; name the things in {MOST_WORDS} or fewer.")
    requests, unknown, style = parse_things(words)
    about = _atmosphere(folder)
    things = [(one, *_saved(folder, one, style or about["style"], about["time"])) for one in requests]
    row = [(thing, home) for one, thing, home in things for _ in range(one.count)]
    width = sum(thing["size"][0] for thing, _ in row) + APART_M * (len(row) - 1)
    edits: list[Edit] = []
    for thing, home in row:
        middle = sum(merged["size"][0] + APART_M for merged, _ in row[: len(edits)]) + thing["size"][0] / 2
        edits.append(merge_edit(folder, home, _foot(thing, spot, middle - width / 2), spot.degrees))
    scenes = [page_scene(load_source(home, None), walked=False) for _, home in row]
    stands = tuple(thing["stands"] not in ("hung", "ceiling") for thing, _ in row)
    return PutThings(tuple(edits), tuple(scenes), stands, unknown)


def _atmosphere(folder: Path) -> dict[str, str]:
    """The style and the time of day of a place that was built; the usual ones of others."""
    try:
        layout = json.loads((folder / "layout.json").read_text())
    except (OSError, ValueError):
        layout = {}
    return {"style": str(layout.get("style", "plain")), "time": str(layout.get("time", "day"))}


def _saved(folder: Path, request: FurnitureRequest, style: str, time: str) -> tuple[Mapping[str, Any], Path]:
    """What a thing's card says of it, and the folder of its place, which is built unless it lies there already."""
    key = json.dumps([request.label, request.look, request.scale, style, time])
    home = folder / THINGS / f"{request.label}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"
    if not (home / "world.json").exists():
        words = {"label": request.label, "look": request.look, "scale": list(request.scale), "style": style}
        save_splat(_world_of(build_thing(request, style, time), words), home)
    return load_source(home).card, home


def relit_things(folder: Path, edits: Sequence[Edit], time: str) -> list[Edit]:
    """The edits of the place in `folder` with the furniture that was put there lit at another time of day. Furniture whose card
    has no request stays as it is."""

    def relit(edit: Edit) -> Edit:
        place = Path(edit["place"]) if edit["do"] == "merge" else None
        words = load_source(folder / place).card.get("request") if place and place.parent == Path(THINGS) else None
        if words is None:
            return edit
        request = FurnitureRequest(words["label"], 1, words["look"], tuple(words["scale"]))
        _, home = _saved(folder, request, words["style"], time)
        return {**edit, **merge_edit(folder, home, edit["by"], edit["degrees"])}

    return [relit(edit) for edit in edits]


def _world_of(thing: BuiltThing, request: Mapping[str, Any]) -> SplatWorld:
    """A thing as a place. request: label, look, scale and style, of which it is built again by another light."""
    card = {
        "objects": [thing.name],
        "size": list(thing.size),
        "stands": thing.stands,
        "hangs_m": thing.hangs_m,
        "request": request,
    }
    many = len(thing.gaussians)
    return SplatWorld(
        thing.name, thing.gaussians, torch.full((many,), INVENTED, dtype=torch.uint8), torch.tensor([[0.0, -2, 1.65, 1, 0, 0, 0]]),
        SplatConfig(), card, torch.ones(many, dtype=torch.int32), SolidBoxes.of(thing.solids),
    )  # fmt: skip


def _foot(thing: Mapping[str, Any], spot: Spot, aside: float) -> Sequence[float]:
    """Where a thing's foot comes to lie: at the spot, `aside` metres to its right; against a wall its back touches it."""
    (_, deep, high), turn = thing["size"], math.radians(spot.degrees)
    front, right = (math.sin(turn), -math.cos(turn)), (math.cos(turn), math.sin(turn))
    ahead = deep / 2 if spot.wall else 0.0
    x, y = (spot.at[k] + ahead * front[k] + aside * right[k] for k in range(2))
    known = not spot.wall or spot.floor <= spot.at[2]  # what is above the pointer is no floor
    z = spot.floor if known else spot.at[2]
    if thing["stands"] == "hung":
        z = spot.at[2] - high / 2 if spot.wall else z + thing["hangs_m"]
    elif thing["stands"] == "ceiling":
        z = (z + ROOM_HEIGHT_M if spot.ceiling is None else spot.ceiling) - high
    return [round(v, 3) for v in (x, y, max(z, spot.floor) if known else z)]
