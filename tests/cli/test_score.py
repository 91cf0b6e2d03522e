"""`terrella score` from outside, with a world that repeats what it was shown."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella import library
from terrella.cli import main
from terrella.core import Spec, State, make_rng
from terrella.core.policy import Random
from terrella.data import Layout, Recorder, RecordOptions, record
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld
from terrella.workflows.score import arms_of

from ..data.layouts import layout_of


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


class Map(Still):
    """A world that knows its places from the start, as a place of Gaussians does: it observes its pose alone."""

    def __init__(self):
        super().__init__()
        shapes = {"pose": (7,), "known": (24, 32), "places": (4, 4)}
        channels = {name: spaces.Box(-np.inf, np.inf, shape, np.float32) for name, shape in shapes.items()}
        self.spec = replace(self.spec, channels={**self.spec.channels, **channels}, observes=("pose",))


def test_a_world_that_keeps_nothing_of_what_it_sees_has_no_memory_to_leave_out(monkeypatch):
    def load(name, **options):
        assert options.get("memory", True) and "memory_mb" not in options
        return Map()

    monkeypatch.setattr(library, "load", load)
    for quick in (True, False):
        arms, closing = arms_of("map", "cpu", fast=False, quick=quick)
        assert list(arms) == ["world"] and not closing


@pytest.fixture
def recording(tmp_path):
    """Three episodes of a bar that moves across the picture."""
    with Recorder(tmp_path / "set", layout_of(10.0, ("left", "right"), rgb=(48, 64))) as recorder:
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
    assert card["worlds"] == {"world": "still"}, "it has no memory to leave out"
    likeness = [row for row in card["rows"] if row["what"] == "PSNR"]
    assert {row["horizon"] for row in likeness} == {1, 4}
    assert all(abs(row["gain"]["value"]) < 1e-6 for row in likeness), "it copies the last frame, no better"
    assert "not clearly better than copying the last frame" in card["verdict"][0]
    assert json.loads((tmp_path / "out" / "scorecard.json").read_text())["worlds"] == card["worlds"]
    assert "<svg" in (tmp_path / "out" / "scorecard.html").read_text()


def test_score_says_first_whether_the_world_is_better_than_a_copy(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    assert main(arguments(recording, tmp_path / "out")) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(
        "still is not clearly better than copying the last frame at any step up to 4; it stays sharp, moves too little."
    )
    assert "scorecard.html" in shown and "copy last" in shown
    assert "not applicable: pose needs pose" in shown and not (tmp_path / "out" / "parts").exists()


def test_drift_is_measured_as_far_as_it_is_asked_for(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    assert main([*arguments(recording, tmp_path / "out"), "--json"]) == 0
    shown = capsys.readouterr()
    drifts = [row for row in json.loads(shown.out)["rows"] if row["probe"] == "drift"]
    assert not drifts and "no clip of 256 steps fits" in shown.err
    assert main([*arguments(recording, tmp_path / "out"), "--drift", "20", "--json"]) == 0
    drifts = [row for row in json.loads(capsys.readouterr().out)["rows"] if row["probe"] == "drift"]
    assert {(row["arm"], row["horizon"]) for row in drifts} == {("copy last", 20), ("world", 20)}
    figures = {(row["what"], row["figure"]["value"]) for row in drifts}
    assert len(figures) == 2, "it stands still as well"
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
    with Recorder(tmp_path / "set", layout_of(10.0, ("left", "right"), rgb=(48, 64))) as recorder:
        for step in range(10):
            recorder.add({"rgb": np.zeros((48, 64, 3), np.uint8)}, np.zeros(2) if step < 9 else None)
    assert main(arguments(tmp_path / "set", tmp_path / "out")) == 2
    said = capsys.readouterr().err
    assert "none was kept out of training" in said and "--fresh" in said and len(said.splitlines()) <= 2
    assert main([*arguments(tmp_path / "set", tmp_path / "out"), "--fresh"]) == 2
    assert "record longer episodes" in capsys.readouterr().err
    assert main([*arguments(tmp_path / "set", tmp_path / "out"), "--seed", "-1"]) == 2
    assert "--seed is 0 or more; got -1." in capsys.readouterr().err


@pytest.mark.parametrize("names", (("a", "b", "c", "d", "e", "f"), ("fire",)))
def test_a_recording_of_another_game_is_refused_in_one_sentence(names, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Still())
    with Recorder(tmp_path / "set", layout_of(10.0, names, rgb=(48, 64))) as recorder:
        for step in range(60):
            recorder.add({"rgb": np.zeros((48, 64, 3), np.uint8)}, np.zeros(len(names)) if step < 59 else None)
            if step == 29:
                recorder.end_episode()
    assert main(arguments(tmp_path / "set", tmp_path / "out")) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "are not those of still" in said and "recordings of its own game" in said and names[0] in said


def cart(folder, episodes: int = 6, length: int = 60):
    """CartPole under a player who leans against the pole, without pictures; ends where it falls."""
    world, rng = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)), make_rng(0)
    with Recorder(folder, Layout.of(world.spec)) as recorder:
        for _ in range(episodes):
            state = world.start(1, rng)
            for step in range(length):
                seen = {name: tensor[0].numpy() for name, tensor in world.render(state, ("observation",)).items()}
                action = int(seen["observation"][2] + 0.3 * seen["observation"][3] > 0)
                after = world.imagine(state, torch.tensor([action]), rng)
                paid = {name: after[name][0].item() for name in ("reward", "done")}
                recorder.add(seen, None if step == length - 1 else np.array([action]), **paid)
                state = after
            recorder.end_episode()
    return folder


class Cart:
    """CartPole as a learned world would hold it: goes on from what it observed. flaw: "numb" to the actions."""

    def __init__(self, flaw: str = ""):
        whole = GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)).spec
        channels = {name: whole.channels[name] for name in ("observation", "reward", "done")}
        self.flaw, self.spec = flaw, Spec("cart", whole.action, channels, ("observation",), whole.dt_s)

    def start(self, batch, rng):
        return State({"observation": torch.zeros(batch, 4)})

    def observe(self, observation, prior, rng):
        return State({"observation": observation["observation"].float()})

    def imagine(self, state, action, rng):
        x, speed, angle, turn = state["observation"].double().unbind(-1)
        force = torch.zeros(len(x)) if self.flaw else 20.0 * action.double() - 10
        push = (force + 0.05 * turn**2 * angle.sin()) / 1.1
        spin = (9.8 * angle.sin() - angle.cos() * push) / (0.5 * (4 / 3 - 0.1 * angle.cos() ** 2 / 1.1))
        pull = push - 0.05 * spin * angle.cos() / 1.1
        after = torch.stack([x + 0.02 * speed, speed + 0.02 * pull, angle + 0.02 * turn, turn + 0.02 * spin], -1)
        return State({"observation": after.float()})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        angle = state["observation"][:, 2]
        told = {"observation": state["observation"], "reward": torch.ones(len(angle)), "done": angle.abs() > 0.2095}
        return {name: told[name] for name in channels}


@pytest.mark.parametrize("flaw", ("", "numb"))
def test_a_world_of_numbers_alone_gets_a_card(flaw, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(library, "load", lambda name, **options: Cart(flaw))
    given = ["score", "cart", "--data", str(cart(tmp_path / "set")), "--out", str(tmp_path / "out"), "--fresh"]
    assert main([*given, "--clips", "12", "--horizons", "1", "8", "16", "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    row = {row["what"]: row for row in card["rows"] if row["horizon"] == 16}
    if flaw:
        assert row["RMSE"]["figure"]["value"] > 0.5
    else:
        assert "cart is better than copying the last observation at every step up to 16" in card["verdict"][0]
        assert row["RMSE"]["figure"]["value"] < 0.01 and row["R\u00b2"]["figure"]["value"] > 0.99
        assert row["RMSE"]["baselines"]["copy last"]["value"] > 10 * row["RMSE"]["figure"]["value"]
        assert row["steps better than copy-last"]["figure"]["value"] == 16
    gone = {one["probe"]: one["why"] for one in card["missing"]}
    assert gone["pixels"].startswith("needs rgb") and gone["memory"] == "needs rgb" and "state" not in gone
    assert "Not applicable" in (tmp_path / "out" / "scorecard.html").read_text()


def test_a_simulator_that_takes_no_evidence_gets_a_card(tmp_path, capsys):
    given = [
        "score",
        "gym:CartPole-v1",
        "--data",
        str(cart(tmp_path / "set")),
        "--out",
        str(tmp_path / "out"),
        "--fresh",
    ]
    assert main([*given, "--quick", "--horizons", "1", "8", "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert {row["probe"] for row in card["rows"]} >= {"speed"}
    assert "needs a world that observes something" in card["verdict"][0]


def test_a_recording_without_pictures_is_refused_by_a_world_of_pictures(tmp_path, monkeypatch, capsys):
    class Chooser(Still):
        def __init__(self):
            super().__init__()
            self.spec = replace(self.spec, action=spaces.Discrete(2))

    monkeypatch.setattr(library, "load", lambda name, **options: Chooser())
    assert main(arguments(cart(tmp_path / "set"), tmp_path / "out")) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "holds no pictures, which still observes" in said


def test_a_score_that_was_stopped_goes_on_to_the_same_card(recording, tmp_path, monkeypatch, capsys):
    calls = []

    class Counted(Still):
        def imagine(self, state, action, rng):
            calls.append(1)
            if len(calls) == stop:
                raise KeyboardInterrupt
            return super().imagine(state, action, rng)

    monkeypatch.setattr(library, "load", lambda name, **options: Counted())
    stop, asked = -1, ["--quick", "--drift", "20", "--json"]
    assert main([*arguments(recording, tmp_path / "whole"), *asked]) == 0
    whole, count = json.loads(capsys.readouterr().out), len(calls)
    stop, calls = count * 3 // 4, []
    assert main([*arguments(recording, tmp_path / "broken"), *asked]) == 130
    assert list((tmp_path / "broken" / "parts").rglob("*.safetensors")), "what was measured is kept"
    stop, calls = -1, []
    capsys.readouterr()
    assert main([*arguments(recording, tmp_path / "broken"), *asked]) == 0
    again = json.loads(capsys.readouterr().out)
    assert len(calls) < count, "and not measured again"
    for card in (whole, again):
        card["files"] = card["rows"] = [row for row in card["rows"] if row["probe"] != "speed"]
    assert again == whole


def test_the_still_world_is_a_world():
    world = Still()
    state = world.imagine(world.start(1, make_rng(0)), torch.zeros(1, 2), make_rng(0))
    assert world.render(state, ("rgb",))["rgb"].shape == (1, 24, 32, 3)


class Rig:
    """A robot on two axes with two cameras of different sizes and a pose; its pictures show where it looks."""

    def __init__(self):
        limit, pose = spaces.Box(-1, 1, (2,), np.float32), spaces.Box(-np.inf, np.inf, (7,), np.float32)
        sizes = {"rgb": (24, 32, 3), "rgb.wrist": (16, 16, 3)}
        pictures = {name: spaces.Box(0, 255, size, np.uint8) for name, size in sizes.items()}
        channels = {**pictures, "pose": pose}
        self.spec = Spec("rig", limit, channels, tuple(channels), 0.1, action_names=("forward", "turn"))

    def start(self, batch, rng):
        return State({"at": torch.zeros(batch), "yaw": torch.zeros(batch)})

    def observe(self, observation, prior, rng):
        pose = observation["pose"]
        return State({"at": pose[:, 0].clone(), "yaw": 2 * torch.atan2(pose[:, 6], pose[:, 3])})

    def imagine(self, state, action, rng):
        action = self.spec.check_action(action, state.batch)
        return State({"at": state["at"] + 0.05 * action[:, 0], "yaw": state["yaw"] + 0.1 * action[:, 1]})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: self._seen(state, name) for name in channels}

    def _seen(self, state, name):
        half, none = state["yaw"] / 2, torch.zeros(state.batch)
        if name == "pose":
            return torch.stack([state["at"], none, none, half.cos(), none, none, half.sin()], 1)
        height, width, _ = self.spec.channels[name].shape
        down, across = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
        turned = across + state["yaw"][:, None, None] + (0.5 if name == "rgb.wrist" else 0.0)
        waves = torch.sin(3 * turned) * torch.cos(2 * down + state["at"][:, None, None])
        return (127 + 100 * waves)[..., None].expand(-1, -1, -1, 3).round().to(torch.uint8)


def test_two_cameras_axes_and_poses_are_scored_from_what_was_recorded(tmp_path, monkeypatch, capsys):
    rig = Rig()
    record(
        rig,
        Random(rig.spec, (3, 9)),
        tmp_path / "set",
        200,
        make_rng(0),
        options=RecordOptions(max_episode_steps=50, pictures="png"),
    )
    monkeypatch.setattr(library, "load", lambda name, **options: Rig())
    given = ["score", "rig", "--data", str(tmp_path / "set"), "--out", str(tmp_path / "out"), "--fresh", "--quick"]
    assert main([*given, "--horizons", "1", "8", "16", "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    found = {row["channel"]: row for row in card["rows"] if (row["what"], row["horizon"]) == ("PSNR", 16)}
    assert found["rgb"]["figure"]["value"] > 40 and found["rgb.wrist"]["figure"]["value"] > 40
    assert found["rgb.wrist"]["baselines"]["copy last"]["value"] < 40
    assert any(row["probe"] == "pose" and row["what"] == "distance" for row in card["rows"])
    assert any(row["probe"] == "memory" and "yaw" in row["what"] for row in card["rows"]), "it takes poses"
    assert "rig is better than copying the last frame at every step up to 16; it obeys, remembers" in card["verdict"][0]
