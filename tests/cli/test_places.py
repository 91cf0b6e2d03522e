"""The rest of the house takes places of Gaussians as it takes any world: recorded, scored, planned in, judged in."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image

import terrella
from terrella.cli import main

pytestmark = pytest.mark.slow  # a sweep: `make test-all` runs it

LAYOUT = {"rooms": [{"name": "hall", "at": [0, 0], "size": [6, 4, 3]}], "start": [1, 2, 0],
          "things": [{"label": "crate", "at": [3, 2]}]}  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    path = tmp_path_factory.mktemp("place")
    (path / "layout.json").write_text(json.dumps(LAYOUT))
    small = ["--gaussians", "1500", "--size", "24", "32"]
    assert main(["space", "build", str(path / "layout.json"), "--out", str(path / "w"), *small]) == 0
    return path / "w"


def test_it_is_recorded_and_scored(place, tmp_path, capsys):
    assert main(["record", "world", str(place), "--out", str(tmp_path / "rec"), "--frames", "40"]) == 0
    capsys.readouterr()
    asked = [
        "--data",
        str(tmp_path / "rec"),
        "--out",
        str(tmp_path / "score"),
        "--fresh",
        "--clips",
        "1",
        "--horizons",
        "1",
    ]
    assert main(["score", str(place), *asked, "--long-steps", "0", "--drift", "0", "--json"]) == 0
    card = json.loads("{" + capsys.readouterr().out.partition("{")[2])
    assert {row["probe"] for row in card["rows"]} >= {"pixels", "pose"} and card["missing"]


def test_one_plans_in_it_and_policies_are_judged(place, tmp_path, capsys):
    world = terrella.load(place)
    elsewhere = {"pose": torch.tensor([[4.5, 1.0, 1.65, 0.0, 0.0, 0.0, 1.0]])}  # and looking back
    rgb = world.render(world.observe(elsewhere, None, terrella.make_rng(0)), ("rgb",))["rgb"][0].numpy()
    Image.fromarray(np.asarray(rgb)).save(tmp_path / "goal.png")
    short = ["--steps", "4", "--episodes", "1", "--samples", "4", "--horizon", "3", "--iterations", "1"]
    for goal in ("pose=2,2,_,_,_,_,_", str(tmp_path / "goal.png")):
        out = tmp_path / goal[:4].replace("/", "")
        assert main(["plan", str(place), "--goal", goal, "--out", str(out), *short]) == 0
    judged = ["--in", str(place), "--episodes", "1", "--steps", "3", "--goal", "pose=2,2,_,_,_,_,_"]
    assert main(["evaluate", "idle", *judged, "--out", str(tmp_path / "ev")]) == 0


def test_it_is_an_environment(place):
    env = terrella.as_env(terrella.load(place), num_envs=2, seed=0, max_steps=2)
    env.reset()
    assert env.step(env.action_space.sample())[0].shape == (2, 24, 32, 3)
