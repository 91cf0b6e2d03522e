"""A floor plan that was drawn: rooms that touch get doors, outer walls windows, and things stay in their rooms."""

from __future__ import annotations

import pytest

from terrella.core.errors import ContractError
from terrella.space.layout.blocks import blocks_of
from terrella.space.layout.drawn_plan import layout_of_plan
from terrella.space.layout.room_layout import room_at
from terrella.workflows.build_space import build_plan
from terrella.worlds.splat_folder import load_source

TWO = {"rooms": [{"kind": "kitchen", "box": [0, 0, 4, 4]}, {"kind": "bedroom", "box": [4, 1, 8, 5]}]}


def planned(**more):
    return layout_of_plan({**TWO, "words": "scandinavian at sunset", **more})


def test_rooms_that_touch_are_joined_and_outer_walls_get_windows():
    plan = planned().layout
    [door] = plan.doors
    assert (plan.style, plan.time) == ("scandinavian", "sunset")
    assert (door.room, door.wall) == ("kitchen", "east") and door.at == pytest.approx(
        2.5 - 0.06
    )  # where both walls run
    assert all(room_at(plan, (*at, 1.0)) for at in ((2, 2), (6, 3)))
    walls = {(one.room, one.wall) for one in plan.windows}
    assert len(walls) == 4 and not walls & {("kitchen", "east"), ("bedroom", "west")}
    assert blocks_of(plan).names.count("door") == 1


def test_words_give_looks_and_what_has_no_effect_is_named():
    parsed = layout_of_plan({**TWO, "words": "brick walls, a purple kitchen, wobbly, with a sofa"})
    assert parsed.unknown == ("wobbly", "sofa")
    assert [room.walls for room in parsed.layout.rooms] == ["purple", "brick"]


def test_drawn_openings_replace_those_of_rooms():
    things = [
        {"label": "door", "at": [4.1, 3.6]},
        {"label": "window", "at": [2, 0.2]},
        {"label": "door", "at": [-0.1, 1]},
    ]
    plan = planned(things=things).layout
    assert [(one.room, one.wall) for one in plan.windows] == [("kitchen", "south")]
    assert len(plan.doors) == 2 and {one.wall for one in plan.doors} <= {"east", "west"}
    with pytest.raises(ContractError, match="no wall is near"):
        planned(things=[{"label": "door", "at": [2, 2]}])


def test_things_stay_in_their_rooms_and_turn_their_backs_to_walls():
    things = [
        {"label": "sofa", "at": [3.8, 0.6], "facing": "south"},  # at the east wall
        {"label": "picture", "at": [2.0, 3.7]},
        {"label": "pendant", "at": [1.5, 1.5]},
        {"label": "couch", "at": [6.0, 1.2]},
    ]
    plan = planned(things=things).layout
    sofa, picture, pendant, couch = plan.things
    assert sofa.facing in ("west", "north") and couch.label == "sofa" and couch.facing == "north"
    assert picture.facing == "south" and picture.at[2] == 1.25 and pendant.at[2] > 1.5
    assert len(blocks_of(plan).names) == 4 + 1 + len(plan.windows)  # all lie within their rooms


def test_a_thing_belongs_to_the_room_that_it_is_drawn_in_and_keeps_its_back_to_the_wall_behind():
    things = [
        {"label": "picture", "at": [4.1, 3.0]},  # on the bedroom's side of the wall between
        {"label": "bed", "at": [7.0, 3.9], "facing": "south"},  # nearer to the east, drawn with its head to the north
    ]
    picture, bed, *others = planned(things=things, furnish=True).layout.things
    assert picture.facing == "east" and 4 < picture.at[0] < 4.2
    assert bed.facing == "south" and bed.at[1] == pytest.approx(4.94 - 2.1 / 2)
    assert others and all(one.at[0] < 4 for one in others)  # a picture in a kitchen furnishes no bedroom
    (one, *counters) = planned(things=[{"label": "picture", "at": [3.9, 3.0]}], furnish=True).layout.things
    assert one.facing == "west" and any(other.at[0] > 4 for other in counters)


def test_a_door_between_rooms_comes_where_nothing_stands():
    middle, things = 2.5, [{"label": "wardrobe", "at": [3.7, 3.3], "facing": "west"}]
    plan = planned(things=things).layout
    [door], [wardrobe] = plan.doors, plan.things
    assert 1.06 + door.width / 2 < 0.06 + door.at < wardrobe.at[1] - wardrobe.size[0] / 2 - door.width / 2 < middle
    (door,) = planned(things=[{"label": "picture", "at": [4.1, 2.9]}]).layout.doors
    assert 0.06 + door.at < 2.9 - 0.45 - door.width / 2
    (door,) = planned(things=[{"label": "rug", "at": [3.7, 2.6]}]).layout.doors
    assert door.at + 0.06 == pytest.approx(middle)


def test_empty_rooms_are_furnished_if_asked():
    things = [{"label": "bed", "at": [6, 4.2]}]
    plan = planned(things=things, furnish=True).layout
    kitchen = [one.label for one in plan.things if one.at[0] < 4]
    assert "counter" in kitchen and [one.label for one in plan.things if one.at[0] > 4] == ["bed"]
    assert not [one for one in planned(things=things).layout.things if one.at[0] < 4]
    (door,) = plan.doors
    middle = 0.06 + door.at
    assert not any(3.2 < one.at[0] < 4 and abs(one.at[1] - middle) < 0.4 for one in plan.things)
    for y in (1.0, 2.0, 3.0):  # nor before a door that leads outside
        plan = planned(things=[{"label": "door", "at": [0, y]}], furnish=True).layout
        assert not any(
            one.at[0] - one.size[one.facing in ("east", "west")] / 2 < 0.9
            and abs(one.at[1] - y) < one.size[one.facing not in ("east", "west")] / 2 + 0.4
            for one in plan.things
            if one.at[2] < 1
        )


@pytest.mark.parametrize(
    ("plan", "sentence"),
    [
        ({"rooms": []}, "draw a room first"),
        ({"rooms": [{"kind": "igloo", "box": [0, 0, 3, 3]}]}, "no kind of room"),
        ({"rooms": [{"kind": "kitchen", "box": [0, 0, 1, 3]}]}, "1.0 by 3.0 m"),
        ({"rooms": [{"kind": "kitchen", "box": [0, 0, 3]}]}, "4 finite numbers"),
        ({"rooms": [{"kind": "kitchen", "box": [0, 0, 4, 4]}, {"kind": "hall", "box": [3, 3, 8, 8]}]}, "overlap"),
        ({"rooms": [{"kind": "kitchen", "box": [0, 0, 3, 3]}] * 13}, "at most 12 rooms"),
        ({"rooms": [{"kind": "hall", "box": [0, 0, 90, 90]}]}, "60"),
        ({"rooms": "x"}, "list of objects"),
        ({**TWO, "things": [{"label": "zeppelin", "at": [1, 1]}]}, "no kind of furniture"),
        ({**TWO, "things": [{"label": "chair", "at": [30, 1]}]}, "lies in no room"),
        ({**TWO, "things": [{"label": "chair", "at": [None, 1]}]}, "finite numbers"),
    ],
)
def test_a_plan_that_cannot_be_built_says_why(plan, sentence):
    with pytest.raises(ContractError, match=sentence):
        layout_of_plan(plan)


@pytest.mark.slow
def test_a_plan_becomes_a_place(tmp_path):
    stages = []
    result = build_plan({**TWO, "words": "rustic", "furnish": True}, tmp_path / "w", progress=stages.append)
    assert len(load_source(tmp_path / "w").gaussians) > 50_000 and "2 rooms" in result.summary() and len(stages) >= 4
