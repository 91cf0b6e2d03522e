"""`terrella plan` from outside: figures beside a floor, the same twice, a film to look at, and one sentence for bad goals."""

from __future__ import annotations

import json

import pytest
from tests.cli.tiny import NAME

from terrella.cli import main

BLIND = NAME.replace("Tiny-v0", "Blind-v0")
QUICK = ["--episodes", "4", "--steps", "24", "--samples", "6", "--iterations", "2", "--horizon", "4", "--json"]


def planned(capsys, *words):
    assert main(["plan", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_goal_is_reached_beside_a_floor_and_the_same_seed_does_the_same(capsys, tmp_path):
    words = [BLIND, "--goal", "observation=20", "--within", "0.001", "--search", "tree", "--curve", *QUICK]
    one, other = (planned(capsys, *words, "--out", str(tmp_path / name)) for name in "ab")
    assert one["planner"]["success"]["value"] == 1
    assert one["planner"]["steps"]["value"] < one["random"]["steps"]["value"]
    for arm in ("planner", "random"):
        assert one[arm]["success"] == other[arm]["success"] and one[arm]["steps"] == other[arm]["steps"]
    assert [point["imagined"] for point in one["curve"]] == sorted(point["imagined"] for point in one["curve"])
    whole = json.loads((tmp_path / "a" / "plan.json").read_text())
    assert len(whole["played"]) == 4 and max(whole["divergence"]["observation"]) < 1e-5 and not whole["film"]
    assert "Does thinking longer help?" in (tmp_path / "a" / "plan.html").read_text()


def test_reality_and_dream_are_filmed(capsys, tmp_path):
    found = planned(capsys, NAME, "--goal", "reward", *QUICK, "--out", str(tmp_path))
    assert (
        "success" not in found["planner"] and found["planner"]["return"]["value"] >= found["random"]["return"]["value"]
    )
    assert (tmp_path / "plan.mp4").stat().st_size > 500
    assert (
        max(json.loads((tmp_path / "plan.json").read_text())["divergence"]["rgb"]) < 1e-5
    )  # it plans in the game itself


@pytest.mark.parametrize(
    "words, said",
    [
        (["--goal", "1,2,3"], "3 numbers"),
        (["--goal", "99"], "can never be reached"),
        (["--goal", "colour=1"], "cannot render 'colour'"),
        (["--goal", "no-such.png"], "no pictures"),
        (["--goal", "somewhere nice"], "is no goal"),
        (["--goal", "5", "--within", "0"], "--within"),
        (["--goal", "5", "--within", "3"], "already solved"),
        (["--success", "won"], "no channel 'won'"),
        (["--search", "gradient"], "no gradient"),
        (["--real", "gym:CartPole-v1"], "they differ"),
        (["--trust", "0.1"], "uncertainty"),
        (["--samples", "1"], "samples are 2 or more"),
    ],
)
def test_what_cannot_be_planned_is_said_in_a_sentence(capsys, tmp_path, words, said):
    assert main(["plan", BLIND, *QUICK[:4], "--out", str(tmp_path / "new"), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error
    assert not (tmp_path / "new").exists()


def test_a_goal_that_is_never_reached_is_said_with_the_nearest_and_the_best_cost(capsys, tmp_path):
    words = [BLIND, "--goal", "24", "--within", "0.001", *QUICK[:-1], "--out", str(tmp_path)]
    assert main(["plan", *words]) == 0
    said = capsys.readouterr().out
    assert "never reached" in said and "the best plan in the world cost" in said
