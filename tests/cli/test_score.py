"""`terrella score` from outside, with a world that repeats what it was shown."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella import library
from terrella.cli import main
from terrella.core import Spec, State, make_rng
from terrella.data import Layout, Recorder


class Still:
    """Shows for ever what it observed last."""

    def __init__(self):
        channels = {"rgb": spaces.Box(0, 255, (24, 32, 3), np.uint8)}
        self.spec = Spec("still", spaces.MultiBinary(2), channels, ("rgb",), 0.1)

    def start(self, batch, rng):
        return State({"rgb": torch.zeros(batch, 24, 32, 3, dtype=torch.uint8)})

    def observe(self, observation, prior, rng):
        return State({"rgb": observation["rgb"]})

    def imagine(self, state, action, rng):
        self.spec.check_action(action, state.batch)
        return state

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: state[name] for name in channels}


@pytest.fixture
def recording(tmp_path):
    """Three episodes of a bar that moves across the picture."""
    with Recorder(tmp_path / "set", Layout.of_channels(10.0, ("left", "right"), rgb=(48, 64))) as recorder:
        for episode in range(3):
            for step in range(40):
                picture = np.full((48, 64, 3), 40, np.uint8)
                picture[:, (step + 20 * episode) % 60 : (step + 20 * episode) % 60 + 4] = 200
                recorder.add({"rgb": picture}, np.array([0, 1]) if step < 39 else None, 0.0, False)
            recorder.end_episode()
    return tmp_path / "set"


def arguments(recording, out) -> list[str]:
    options = {"data": recording, "out": out, "clips": 4, "long-steps": 0}
    flags = [str(part) for name, value in options.items() for part in (f"--{name}", value)]
    return ["score", "still", *flags, "--horizons", "1", "4"]


def test_score_writes_json_and_a_page(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    assert main([*arguments(recording, tmp_path / "out"), "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert card["worlds"] == {"history": "still"}, "it has no memory to leave out"
    assert {row["horizon"] for row in card["fidelity"]} == {1, 4}
    assert all(abs(row["gain"]["value"]) < 1e-6 for row in card["fidelity"]), "it copies the last frame, no better"
    assert json.loads((tmp_path / "out" / "scorecard.json").read_text())["worlds"] == card["worlds"]
    assert "<svg" in (tmp_path / "out" / "scorecard.html").read_text()


def test_score_says_what_it_found(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    assert main(arguments(recording, tmp_path / "out")) == 0
    assert "scorecard.html" in capsys.readouterr().out


def test_drift_is_measured_as_far_as_it_is_asked_for(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    assert main([*arguments(recording, tmp_path / "out"), "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["drifts"] == [] and "no clip of 256 steps fits" in shown.err
    assert main([*arguments(recording, tmp_path / "out"), "--drift", "20", "--json"]) == 0
    drifts = json.loads(capsys.readouterr().out)["drifts"]
    assert [(row["arm"], row["steps"]) for row in drifts] == [("copy last", 20), ("history", 20)]
    assert drifts[0]["psnr"]["value"] == drifts[1]["psnr"]["value"], "it stands still as well"
    assert main([*arguments(recording, tmp_path / "out"), "--drift", "60"]) == 2
    assert "no window of 70 rows" in capsys.readouterr().err


def test_a_recording_made_afterwards_is_used_whole(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    count = []
    for fresh in ([], ["--fresh"]):
        assert main([*arguments(recording, tmp_path / "out"), "--clips", "9", *fresh, "--json"]) == 0
        count.append(json.loads(capsys.readouterr().out)["places"][0]["clips"])
    assert count[1] > count[0]


def test_score_of_a_recording_without_held_out_episodes_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    with Recorder(tmp_path / "set", Layout.of_channels(10.0, ("left", "right"), rgb=(48, 64))) as recorder:
        for step in range(10):
            recorder.add({"rgb": np.zeros((48, 64, 3), np.uint8)}, np.zeros(2) if step < 9 else None)
    assert main(arguments(tmp_path / "set", tmp_path / "out")) == 2
    assert "record longer episodes" in capsys.readouterr().err


def test_the_still_world_is_a_world():
    world = Still()
    state = world.imagine(world.start(1, make_rng(0)), torch.zeros(1, 2), make_rng(0))
    assert world.render(state, ("rgb",))["rgb"].shape == (1, 24, 32, 3)
