"""Layouts and words: what is understood, what is refused, that everything fits, and that what is built is lit and hides nothing."""

from __future__ import annotations

import json
import random
from collections import Counter

import numpy as np
import pytest
import torch

from terrella.core.errors import ContractError
from terrella.space.camera import rotation
from terrella.space.edits import apply_edits
from terrella.space.kernels_numba.light import first_box
from terrella.space.layout import build, looks, parse_text, read_layout, text_layout
from terrella.space.layout.blocks import blocks_of
from terrella.space.raster import rasterise

ROOM = {"name": "hall", "at": [0, 0], "size": [6, 4, 3]}
NEXT = {"name": "den", "at": [6.2, 0, 0], "size": [3, 4, 2.6], "walls": "dark red brick"}


def test_words_become_a_plan():
    heard = parse_text("a long room with two pillars and a red door, then a small blurbly kitchen with three chairs")
    assert [room.name for room in heard.layout.rooms] == ["room", "kitchen"] and heard.unknown == ("blurbly",)
    labels = [thing.label for thing in heard.layout.things]
    assert labels.count("pillar") == 2 and labels.count("chair") == 3 and heard.layout.doors[0].look == "red"
    assert heard.layout.rooms[0].size[0] > 1.5 * text_layout.ROOMS["room"]["size"][0]
    blocks_of(heard.layout)


def test_words_say_where():
    plan = parse_text("a room with a window on the left and a sofa at the far wall in the room with brick walls").layout
    assert len(plan.rooms) == 1 and plan.rooms[0].walls == "brick"
    assert plan.windows[0].wall == "north" and plan.things[0].facing == "west"


@pytest.mark.parametrize("text", ["", "xyzzy", "the very of", "!!! ???", "wooden red", "12"])
def test_nothing_understood_is_said(text):
    with pytest.raises(ContractError, match="names a room or a thing"):
        parse_text(text)


@pytest.mark.parametrize("seed", range(40))
def test_any_words_make_a_place_that_can_be_built(seed):
    rng = random.Random(seed)
    some = [
        *text_layout.ROOMS,
        *sorted(text_layout._THINGS),
        *text_layout.SIZES,
        *looks.COLOURS,
        *text_layout.NUMBERS,
        *text_layout.SIDES,
        "with",
        "on",
        "the",
        "floor",
    ]
    heard = parse_text("room " + " ".join(rng.choice(some) for _ in range(30)), seed)
    blocks = blocks_of(heard.layout)
    assert json.loads(json.dumps(heard.document)) == heard.document and read_layout(heard.document) == heard.layout
    assert (blocks.solids[:, 3:] > blocks.solids[:, :3]).all()


def test_the_same_seed_the_same_bytes():
    text = "a study with a desk, a chair, a lamp and three crates"
    one, same, other = (parse_text(text, seed) for seed in (4, 4, 5))
    assert one.document == same.document and one.document["things"] != other.document["things"]
    first, again = build(one.layout, 3000), build(same.layout, 3000)
    assert all(torch.equal(a, b) for a, b in zip(vars(first.gaussians).values(), vars(again.gaussians).values()))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rooms": []}, "at least one room"),
        ({"roms": [ROOM]}, "unknown field 'roms'"),
        ({"rooms": [{**ROOM, "colour": "red"}]}, "unknown field 'colour'"),
        ({"rooms": [{"name": "hall", "at": [0, 0]}]}, "lacks 'size'"),
        ({"rooms": [{**ROOM, "size": [6, -4, 3]}]}, "has the size"),
        ({"rooms": [{**ROOM, "size": [6, float("nan"), 3]}]}, "finite numbers"),
        ({"rooms": [{**ROOM, "walls": "frosted"}]}, "unknown word 'frosted'"),
        ({"rooms": [ROOM, {**NEXT, "at": [5, 0]}]}, "overlap or touch"),
        ({"rooms": [ROOM, ROOM]}, "two rooms"),
        ({"rooms": [{**ROOM, "size": [59, 59, 3]}]}, "square metres"),
        ({"doors": [{"room": "den", "wall": "east"}]}, "there is none"),
        ({"doors": [{"room": "hall", "wall": "up"}]}, "walls are"),
        ({"doors": [{"room": "hall", "wall": "east", "width": 5}]}, "does not fit"),
        ({"doors": [{"room": "hall", "wall": "east"}, {"room": "hall", "wall": "east", "at": 2.5}]}, "overlap"),
        ({"windows": [{"room": "hall", "wall": "east", "sill": 2.5}]}, "does not fit"),
        ({"things": [{"label": "table", "at": [20, 2]}]}, "lies in no room"),
        ({"things": [{"label": "table", "at": [5.9, 2]}]}, "reaches out"),
        ({"things": [{"label": "table", "at": [2, 2], "size": [1, -1, 1]}]}, "has the size"),
        ({"things": [{"label": "chair", "at": [2, 2], "facing": "up"}]}, "directions are"),
        ({"things": 3}, "is a list"),
        ({"stairs": [{"at": [1, 1], "size": [1, 0.5, 2]}]}, "longer"),
        ({"start": [50, 0, 0]}, "in no room"),
    ],
)  # fmt: skip
def test_a_layout_that_cannot_be_is_refused(change, says):
    with pytest.raises(ContractError, match=says):
        blocks_of(read_layout({"rooms": [ROOM], **change}))


def test_doors_join_rooms_or_are_shut(tmp_path):
    path = tmp_path / "layout.json"
    path.write_text(
        json.dumps(
            {"rooms": [ROOM, NEXT], "doors": [{"room": "hall", "wall": "east"}, {"room": "hall", "wall": "west"}]}
        )
    )
    solids = blocks_of(read_layout(path)).solids.astype(np.float64)
    through = lambda y, ahead: first_box(3.0, y, 1.5, ahead, 0.0, 0.0, solids, 1e9)[1]  # noqa: E731
    assert abs(through(2.0, 1.0) - 6.2) < 1e-5 and through(2.0, -1.0) < 3 and abs(through(1.0, 1.0) - 3.0) < 1e-5


def test_rays_meet_the_side_that_they_should():
    boxes = np.array([[1.0, -1, -1, 2, 1, 1], [-3, -1, -1, -2, 1, 1]])
    assert first_box(0.0, 0, 0, 1.0, 0, 0, boxes, 1e9) == (0, 1.0, 0)
    assert first_box(0.0, 0, 0, -1.0, 0, 0, boxes, 1e9) == (1, 2.0, 1)
    assert first_box(0.0, 0, 0, 0, 1.0, 0, boxes, 1e9)[0] == -1
    assert first_box(1.5, 0, 5.0, 0, 0, -1.0, boxes, 1e9) == (0, 4.0, 5)


def test_what_is_built_is_whole_and_lit():
    heard = parse_text("a room with two windows, a table, and a bookshelf")
    place = build(heard.layout, 20_000)
    assert 12_000 < len(place.gaussians) < 40_000 and place.objects.max() == len(place.names) == 4
    pose = place.starts.clone()
    pose[:, 2] += 1.6
    seen = rasterise(place.gaussians, pose, None, (64, 128))
    assert (
        seen.alpha[:, 2:-2].min() > 0.85 and seen.alpha.mean() > 0.98
    )  # no hole anywhere around but at the panorama's poles
    grey = seen.rgb.mean((0, 1))
    assert 0.3 < grey.mean() < 0.8 and grey.std() > 0.05
    low, high = (torch.tensor(v) for v in (heard.layout.rooms[0].low, heard.layout.rooms[0].high))
    within = ((place.gaussians.means > low - 0.2) & (place.gaussians.means < high + 0.2)).all(1)
    windows = torch.tensor([number for number, name in enumerate(place.names, 1) if name == "window"])
    assert torch.isin(place.objects[~within], windows).all() and not within.all()  # the view outside


def kinds(text: str) -> tuple[Counter, tuple[str, ...]]:
    """How many things, doors, windows and rooms a text gives, and its words without effect."""
    parsed = parse_text(text)
    plan = parsed.layout
    many = {"window": len(plan.windows), "door": len(plan.doors), "room": len(plan.rooms)}
    return Counter(thing.label for thing in plan.things) + Counter(many), parsed.unknown


@pytest.mark.parametrize(
    ("text", "counts", "unknown"),
    [
        ("a hall with pillars and big windows", {"pillar": 4, "window": 3, "door": 0}, ()),
        ("a room with two doors", {"door": 2}, ()),
        ("a study without windows or doors and a lamp", {"window": 0, "door": 0, "lamp": 1}, ()),
        ("a room with no window", {"window": 0}, ()),
        ("a hall with a row of pillars", {"pillar": 4}, ("row",)),
        ("a hall with walls made of red brick and a table of marble", {"table": 1}, ()),
        ("a pair of chairs in a study", {"chair": 2, "room": 1}, ()),
        ("a kitchen with a dozen stools", {"stool": 12}, ()),
        ("a room with thirteen boxes", {"box": 13}, ()),
        ("three bedrooms with a window", {"room": 3, "window": 3, "door": 2}, ()),
        ("two pillars in a hall", {"room": 1, "pillar": 2}, ()),
        ("a hall and a kitchen. in the hall a table", {"room": 2, "table": 1}, ()),
        ("a room with a table and a lamp on the table", {"table": 1, "lamp": 1}, ("on",)),
        ("a room with a red gizmo and a table", {"table": 1}, ("gizmo", "red")),
        ("a hall with tall pillars", {"pillar": 4}, ("tall",)),
        ("a room with long stairs", {}, ("long",)),
        ("a room with windows on every wall", {"window": 3}, ("every",)),
        ("a room that is big", {"room": 1}, ("big",)),
        ("a room with a window in the corner", {"window": 1}, ("corner",)),
    ],
)
def test_every_word_has_an_effect_or_is_named(text, counts, unknown):
    has, without_effect = kinds(text)
    assert {label: has[label] for label in counts} == counts and without_effect == unknown


def test_sizes_of_openings_and_surfaces_are_seen():
    windows = {word: parse_text(f"a hall with a {word} window").layout.windows[0] for word in ("blue", "big", "small")}
    assert windows["big"].width > 1.5 * windows["blue"].width > 2 * windows["small"].width
    assert windows["big"].height > 1.3 * windows["blue"].height > 1.5 * windows["small"].height
    doors = {word: parse_text(f"a hall with a {word} door").layout.doors[0] for word in ("red", "wide", "tall")}
    assert doors["wide"].width > 1.4 * doors["red"].width and doors["tall"].height > 1.3 * doors["red"].height
    rooms = [
        parse_text(f"a room with {words}").layout.rooms[0] for words in ("a lamp", "a tall ceiling", "a wide floor")
    ]
    assert rooms[1].size[2] > 1.3 * rooms[0].size[2] and rooms[2].size[1] > 1.4 * rooms[0].size[1]
    assert parse_text("a room with a wide picture").layout.things[0].size[0] > 1.3  # type: ignore[index]


def test_looks_may_follow_their_noun():
    plan = parse_text("a hall with walls of dark red brick, a floor of stone and pillars made of marble").layout
    assert (plan.rooms[0].walls, plan.rooms[0].floor) == ("dark red brick", "stone")
    assert {thing.look for thing in plan.things} == {"marble"} and len(plan.things) == 4
    assert parse_text("a room with a pillar and a red door").layout.things[0].look is None


def test_what_is_too_much_is_named():
    parsed = parse_text("a hall with 100 chairs and thirty rooms")
    assert dict(part.split()[::-1] for part in parsed.left_out)["chair"] >= "76"
    assert "thirty" in parsed.unknown
    assert parse_text("40 rooms").unknown == ("40 rooms",) and len(parse_text("40 rooms").layout.rooms) == 12


@pytest.mark.parametrize("deed", [{"do": "delete"}, {"do": "move", "by": [0, 0, 9]}])
def test_behind_every_object_lies_a_surface(deed):
    place = build(
        parse_text("a room with a pillar, a window, a door, a wardrobe in the corner and a rug").layout, 12_000
    )
    pose = place.starts.clone()
    pose[:, 2] += 1.6
    assert 0.01 < (place.objects < 0).float().mean() < 0.2
    for number, name in enumerate(place.names, 1):
        after = apply_edits(place.gaussians, [{"select": {"object": number}, **deed}], place.objects).gaussians
        assert rasterise(after, pose, None, (64, 128)).alpha[:, 2:-2].min() > 0.85, name
    shown = rasterise(place.gaussians, pose, None, (64, 128))
    assert not (place.objects[shown.ids[shown.ids >= 0].long()] < 0).any()
    recoloured = [{"select": {"object": 1}, "do": "recolour", "colour": [1, 0, 0]}]
    assert (apply_edits(place.gaussians, recoloured, place.objects).objects < 0).sum() == (place.objects < 0).sum()


def test_plain_walls_show_no_weave():
    room = {**ROOM, "walls": "white paint", "lamps": 1}
    place = build(read_layout({"rooms": [room], "windows": []}), 30_000)
    pose = torch.tensor([[1.5, 2.0, 1.5, 0.0, 0.0, 0.0, 1.0]])  # 1.5 m before the western wall
    grey = rasterise(place.gaussians, pose, (0.5, 0.5, 0.5, 0.5), (200, 200)).rgb.mean(1, keepdim=True)
    fine = (grey - torch.nn.functional.avg_pool2d(grey, 15, 1, 7))[..., 40:-40, 40:-40]
    assert 0.3 < grey.mean() < 0.95 and fine.std() < 0.0016  # a regular grid of equal Gaussians: 0.0021


def test_styles_and_times_are_understood_and_change_the_picture():
    plain, dressed = parse_text("a kitchen"), parse_text("a bright scandinavian kitchen at noon")
    assert dressed.unknown == () and (dressed.layout.style, dressed.layout.time) == ("scandinavian", "noon")
    assert not plain.layout.things and {"counter", "table", "chair"} <= {thing.label for thing in dressed.layout.things}
    for text in (
        "a dungeon with torches",
        "a japanese tea room in the evening",
        "a concrete loft with big windows at sunset",
    ):
        assert parse_text(text).unknown == () and parse_text(text).layout.things
    assert not parse_text("an empty japanese tea room").layout.things
    shown = []
    for time in ("noon", "sunset", "night"):
        place = build(
            read_layout({"rooms": [ROOM], "windows": [{"room": "hall", "wall": "south"}], "time": time}), 4000
        )
        shown.append(place.gaussians.colours[place.objects == 0].mean(0))
    assert shown[0].mean() > 1.3 * shown[2].mean() and shown[1][0] / shown[1][2] > 1.1 * shown[0][0] / shown[0][2]


def test_the_floor_is_darker_at_the_foot_of_a_table():
    place = build(
        read_layout({"rooms": [{**ROOM, "floor": "white paint"}], "things": [{"label": "wardrobe", "at": [3, 2]}]}),
        20_000,
    )
    means, grey = place.gaussians.means, place.gaussians.colours.mean(1)
    floor = (means[:, 2].abs() < 0.01) & (place.objects == 0) & ((means[:, 0] - 3).abs() < 0.4)
    behind = means[:, 1] - 2.3  # metres
    foot, away = (floor & (behind > a) & (behind < b) for a, b in ((0.0, 0.06), (0.6, 0.9)))
    assert foot.any() and grey[foot].mean() < 0.85 * grey[away].mean()


def test_what_ends_beneath_a_board_does_not_stick_out_above_it():
    shelf = {"label": "bookshelf", "at": [1.5, 2.7], "facing": "south"}
    place = build(read_layout({"rooms": [{**ROOM, "size": [3, 3, 3]}], "things": [shelf]}), 20_000)
    own = place.gaussians.at((place.objects == 1) & (place.gaussians.opacities > 0.3))
    turn = rotation(torch.cat([torch.zeros_like(own.means), own.quats], 1))
    top = own.means[:, 2] + (turn[:, 2] * 2 * own.scales).norm(dim=1)  # of two standard deviations; it is 2 m high
    assert int((top[own.means[:, 2] < 1.96] > 2.05).sum()) < 30  # 56 before uprights ended at their visible end
