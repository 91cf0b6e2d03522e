"""Keys: what actions are called gives them keys, and what people say of them is understood or refused in a sentence."""

from __future__ import annotations

import pytest
from gymnasium import spaces

from terrella.core import Spec
from terrella.core.errors import TerrellaError
from terrella.core.keys import code_of, default_keys, parse_keys, with_controls
from terrella.core.spec import can_idle, neutral_action

ATARI = ("NOOP", "FIRE", "UP", "RIGHT", "LEFT", "DOWN", "UPRIGHT", "RIGHTFIRE")


def keys(*names: str) -> dict[str, float]:
    return {key: value[0] for key, value in default_keys(spaces.Discrete(len(names)), names).items()}


def test_arrows_and_letters_reach_what_moves_and_acts():
    pong = keys("NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE")
    assert pong["ArrowUp"] == pong["KeyW"] == 2 and pong["ArrowDown"] == 3 and pong["Space"] == 1
    four = keys("NOOP", "UP", "RIGHT", "LEFT", "DOWN")
    assert [four[f"Arrow{way}"] for way in ("Up", "Right", "Left", "Down")] == [1, 2, 3, 4]
    many = keys(*ATARI)
    assert many["ArrowUp+ArrowRight"] == 6 and many["ArrowRight+Space"] == 7 and 0 not in many.values()


def test_turning_is_on_the_arrows_and_strafing_on_the_letters():
    found = keys("turn_left", "turn_right", "move_forward", "move_left", "move_right", "pickup")
    assert (found["ArrowLeft"], found["ArrowRight"], found["ArrowUp"], found["KeyA"], found["KeyD"]) == (0, 1, 2, 3, 4)
    assert found["KeyP"] == 5


def test_every_choice_has_a_key_though_none_has_a_name():
    assert default_keys(spaces.Discrete(2)) == {"ArrowLeft": [0.0], "ArrowRight": [1.0]}
    many = default_keys(spaces.Discrete(17, start=1))
    assert sorted(value[0] for value in many.values()) == list(range(1, 18))
    buttons = default_keys(spaces.MultiBinary(3), ("jump", "left", "right"))
    assert buttons["Space"] == [1, 0, 0] and buttons["ArrowRight"] == [0, 0, 1]


def test_the_environments_own_table_is_understood():
    table = {"w": 1, (ord("d"),): 2, "wd": 3, None: 0, (1073741904,): 4, ("nonsense",): 5}
    found = parse_keys(table, spaces.Discrete(6))
    assert found == {"KeyW": [1.0], "KeyD": [2.0], "KeyD+KeyW": [3.0], "ArrowLeft": [4.0]}
    assert (
        code_of("space") == code_of(32) == "Space" and code_of("ShiftLeft") == "ShiftLeft" and code_of("7") == "Digit7"
    )


def spec(action: spaces.Space, *names: str) -> Spec:
    return Spec("toy", action, {}, (), 0.1, action_names=names)


def test_what_a_person_says_wins():
    turns = spec(spaces.Discrete(3), "left", "right", "onward")
    assert not can_idle(turns)
    told = with_controls(turns, ["a=left", "up+space=2"], idle="onward")
    assert told.keys == {"KeyA": [0.0], "ArrowUp+Space": [2.0]} and neutral_action(told) == 2 and can_idle(told)
    named = with_controls(spec(spaces.Discrete(3)), action_names=["stay", "up", "down"])
    assert named.keys["ArrowDown"] == [2.0] and neutral_action(named) == 0 and can_idle(named)
    car = with_controls(spec(spaces.Box(-1, 1, (2,)), "steer", "gas"), ["w=gas", "a=-1,0.5"])
    assert car.keys == {"KeyW": [0.0, 1.0], "KeyA": [-1.0, 0.5]}


@pytest.mark.parametrize(
    "said, answer",
    [
        ({"keys": ["a:left"]}, "KEY=ACTION"),
        ({"keys": ["a=jump"]}, "its actions are left, right"),
        ({"keys": ["hyper=left"]}, "is not a key"),
        ({"idle": "7"}, "is no action of toy"),
        ({"action_names": ["one"]}, "has 2 actions; 1 names"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(said, answer):
    with pytest.raises(TerrellaError, match=answer):
        with_controls(spec(spaces.Discrete(2), "left", "right"), **said)


def test_each_of_several_choices_has_a_cluster_of_keys():
    found = default_keys(spaces.MultiDiscrete([3, 3, 2]))
    assert found["ArrowLeft"] == found["KeyA"] == [1, 0, 0] and found["ArrowRight"] == [2, 0, 0]
    assert found["ArrowUp"] == [0, 1, 0] and found["ArrowDown"] == [0, 2, 0] and found["Space"] == [0, 0, 1]
    pad = default_keys(spaces.MultiDiscrete([5, 2, 2]))
    assert [pad[f"Arrow{way}"][0] for way in ("Up", "Right", "Down", "Left")] == [1, 2, 3, 4]
    assert pad["Space"] == [0, 1, 0] and pad["KeyE"] == [0, 0, 1]
    named = default_keys(spaces.MultiDiscrete([3, 3, 2, 2]), ("turn", "forward", "throw", "jump"))
    assert named["ArrowUp"] == [0, 1, 0, 0] and named["KeyT"] == [0, 0, 1, 0] and named["Space"] == [0, 0, 0, 1]


def test_choices_rest_where_they_are_told_to_and_very_many_are_two_ends():
    found = default_keys(spaces.MultiDiscrete([3, 3, 25]), rest=(1, 1, 12))
    assert found["ArrowLeft"] == [0, 1, 12] and found["ArrowUp"] == [1, 2, 12] and found["ArrowDown"] == [1, 0, 12]
    assert found["KeyA"] == [1, 1, 0] and found["KeyD"] == [1, 1, 24]
    many = default_keys(spaces.MultiDiscrete([9] * 8, start=[1] * 8))
    assert all(len(action) == 8 and max(action) > 1 for action in many.values())


def test_several_choices_are_told_by_name_and_value():
    several = spec(spaces.MultiDiscrete([3, 2]), "move", "fire")
    told = with_controls(several, ["w=move:1", "f=fire"])
    assert told.keys == {"KeyW": [1, 0], "KeyF": [0, 1]}
    centred = with_controls(with_controls(spec(spaces.MultiDiscrete([3, 3])), action_names=["a", "b"]), idle="1,1")
    assert centred.keys["ArrowLeft"] == [0, 1] and neutral_action(centred).tolist() == [1, 1]
    with pytest.raises(TerrellaError, match="is no action of toy"):
        with_controls(several, ["w=move:7"])


def test_several_choices_of_any_number_of_values_and_any_name_have_keys():
    for sizes, names in (([4, 2], ("speed", "fire")), ([1, 4, 6], ("turn", "move", "y")), ([3], ("forward",))):
        assert default_keys(spaces.MultiDiscrete(sizes), names)
