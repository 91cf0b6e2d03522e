"""Inverse dynamics: actions are named from what they did, with a confidence that can be believed, and policies learn from them."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.learn.test_imitation import NAME, teacher

import terrella
from terrella.act.imitation_network import REACH, SHIFTS, displacements
from terrella.act.policies_by_name import NoisyPolicy
from terrella.cli import main
from terrella.core.errors import CheckpointError
from terrella.core.policy import Random, Reactive
from terrella.core.world import make_rng
from terrella.data import ClipCache, Dataset, record
from terrella.learn.calibration import Isotonic, calibration_error
from terrella.learn.recipes.inverse import InverseTraining
from terrella.sim.gymnasium import GymnasiumWorld
from terrella.workflows.inverse import InverseConfig, train_inverse

QUICK = ["--steps", "120", "--batch", "64", "--hidden", "32", "--learning-rate", "0.005", "--sees", "grid"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inverse") / "recording"
    world = GymnasiumWorld("TerrellaFetch-v0")
    record(
        world, terrella.load_policy(f"{teacher.__code__.co_filename}:teacher@0.2", world.spec), folder, 600, make_rng(0)
    )
    return folder


def test_confidence_is_the_share_that_is_right():
    rng = np.random.default_rng(0)
    scores = rng.random(4000)
    right = rng.random(4000) < scores**2  # as confident as wrong
    calibration = Isotonic.fit(scores[:2000], right[:2000])
    assert (np.diff(calibration(np.linspace(0, 1, 50))) >= 0).all()
    before, after = (calibration_error(one, right[2000:]) for one in (scores[2000:], calibration(scores[2000:])))
    assert before > 0.12 and after < 0.05
    assert 0 < calibration(np.array([0.0]))[0] < calibration(np.array([1.0]))[0] < 1
    ties = Isotonic.fit(np.array([0, 0, 1, 1, 1]), np.array([0, 1, 0, 1, 1]))  # equal scores are one step
    assert ties(np.array([0, 1])).tolist() == pytest.approx([2 / 4, 3 / 5])
    assert calibration_error(np.full(4, 0.5), np.array([0, 1, 0, 1])) == 0


def test_a_few_labelled_episodes_label_the_rest(recording, tmp_path, capsys):
    words = ["train", "inverse", str(recording), "--out", str(tmp_path / "run"), "--labelled", "0.2", *QUICK]
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["true_accuracy"] > 0.9 > facts["usual_accuracy"] and facts["labels"] > 200
    assert "--method imitation" in facts["next"]
    before, after = (ClipCache.open(Dataset(folder), (64, 64)) for folder in (recording, facts["recording"]))
    sure = after.arrays["observation.action_confidence"][:, 0]
    valid, same = np.asarray(before.action_valid), (before.action == after.action)[:, 0]
    assert after.action_valid.tolist() == valid.tolist() and before.tasks == after.tasks
    assert sure.min() > 0 and (sure[valid & ~same] < 1).all() and sure[valid & same].mean() > sure[valid & ~same].mean()
    assert after.world["action_names"] == before.world["action_names"]
    assert main([*words, "--json"]) == 0  # the finished run labels again
    assert json.loads(capsys.readouterr().out)["true_accuracy"] == facts["true_accuracy"]


def test_clips_without_actions_are_labelled_by_another_recording(recording, tmp_path, capsys):
    world = GymnasiumWorld("TerrellaFetch-v0")
    record(world, NoisyPolicy(Reactive(teacher), 0.5, world.spec), tmp_path / "clips", 100, make_rng(1))
    words = [
        "train",
        "inverse",
        str(tmp_path / "clips"),
        "--labels",
        str(recording),
        "--out",
        str(tmp_path / "run"),
        *QUICK,
    ]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["true_accuracy"] > 0.6
    about = tmp_path / "clips" / "meta" / "terrella.json"
    about.write_text(about.read_text().replace(NAME.rpartition(":")[2], "Other-v0"))
    assert main([*words[: -len(QUICK) - 1], str(tmp_path / "other"), *QUICK]) == 2
    said = capsys.readouterr().err
    assert "is of gym:Other-v0, and the labels" in said and "label clips of the same environment." in said
    assert not (tmp_path / "other").exists(), "before anything is learned"
    about.write_text(
        about.read_text().replace("Other-v0", NAME.rpartition(":")[2]).replace("Discrete(3)", "Discrete(4)")
    )
    assert main([*words[: -len(QUICK) - 1], str(tmp_path / "other"), *QUICK]) == 2
    assert "has actions in Discrete(4), and the labels" in capsys.readouterr().err


def test_policies_of_few_many_and_true_labels_are_compared(recording, tmp_path, capsys):
    words = [
        "train",
        "inverse",
        str(recording),
        "--out",
        str(tmp_path / "run"),
        "--labelled",
        "0.1",
        *QUICK,
        "--compare",
    ]
    assert main([*words, "--real", NAME, "--policy-steps", "40", "--episodes", "10"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("The model names ") and "of what the true ones gain over random actions" in text
    assert all(f"\n{arm}" in text for arm in ("labelled only", "pseudo-labelled", "all labelled", "random"))
    few = [*words[:5], "--out", str(tmp_path / "x")]
    for further, sentence in (
        (["--compare"], "--compare plays policies in an environment: name it"),
        (["--labels", str(recording), "--labelled", "0.1"], "leave --labelled out"),
        (["--real", NAME, "--episodes", "3"], "--episodes, --real: only --compare has a use for that"),
    ):
        assert main([*few, *further]) == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_labels_that_are_no_better_than_the_most_frequent_action_are_not_written(recording, tmp_path, capsys):
    words = ["train", "inverse", str(recording), "--out", str(tmp_path / "run"), "--labelled", "0.2", *QUICK]
    words[-1] = "wind"  # says nothing of the action
    assert main(words) == 0
    text = capsys.readouterr().out
    assert text.startswith("The labels are no better than always the most frequent action") and "next:" not in text
    assert not (tmp_path / "run" / "recording").exists()


class Slide(gymnasium.Env):
    """A thing whose speed is the action."""

    action_space = spaces.Box(-2, 2, (1,), np.float32)
    observation_space = spaces.Box(-100, 100, (2,), np.float32)
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = 0.0, 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.at, self.steps = self.at + float(action[0]), self.steps + 1
        return np.array([self.at, action[0]], np.float32), 0.0, False, self.steps >= 40, {}


def test_labels_of_axes_are_near_the_truth(tmp_path):
    world = GymnasiumWorld(Slide)
    record(world, Random(world.spec), tmp_path / "recording", 600, make_rng(0))
    training = InverseTraining(steps=250, hidden=64, before=0, after=1, learning_rate=3e-3)
    result = train_inverse(tmp_path / "recording", InverseConfig(tmp_path / "run", training, labelled=0.5))
    assert result.facts["true_accuracy"] > 0.9 > 2 * result.facts["usual_accuracy"]
    before, after = (
        ClipCache.open(Dataset(folder), (64, 64)) for folder in (tmp_path / "recording", result.facts["recording"])
    )
    valid = np.asarray(before.action_valid)
    assert np.abs(after.action[valid] - before.action[valid]).mean() < 0.5 and np.abs(after.action).max() <= 2.0


class Turning(gymnasium.Env):
    """A camera that turns to the left, not, or to the right, before a wall that differs in every episode."""

    action_space = spaces.Discrete(3)
    observation_space = spaces.Box(0, 255, (16, 24, 3), np.uint8)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def __init__(self, render_mode: str = "rgb_array"):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.wall = self.np_random.integers(0, 255, (4, 25, 3), np.uint8).repeat(4, 0).repeat(4, 1)
        self.at = self.steps = 0
        return self.render(), {}

    def render(self):
        return np.roll(self.wall, self.at, 1)[:, :24]

    def step(self, action):
        self.at, self.steps = self.at + 3 * (int(action) - 1), self.steps + 1
        return self.render(), 0.0, False, self.steps >= 20, {}


def test_turns_are_named_from_a_hundred_labels(tmp_path):
    world = GymnasiumWorld(Turning)
    record(world, Random(world.spec), tmp_path / "recording", 400, make_rng(0))
    training = InverseTraining(picture_size=(16, 24), steps=50, batch=32, hidden=32, learning_rate=3e-3)
    result = train_inverse(tmp_path / "recording", InverseConfig(tmp_path / "run", training, labelled=0.2))
    assert result.facts["true_accuracy"] > 0.8
    with pytest.raises(CheckpointError, match="does not act"):
        terrella.load_policy(tmp_path / "run" / "inverse", world.spec)


@pytest.mark.parametrize("size", [(16, 24), (32, 48)])
def test_a_displacement_is_seen_as_what_it_is(size):
    factor = size[0] // 16  # of what is looked at
    noise = torch.rand(1, 3, 16 + 8, 24 + 20, generator=make_rng(0))
    wall = noise.repeat_interleave(factor, 2).repeat_interleave(factor, 3)
    for down, across in ((0, 0), (2, -5), (-1, 7)):
        before, after = (
            wall[..., (4 + y) * factor :, (10 + x) * factor :][..., : size[0], : size[1]]
            for y, x in ((0, 0), (down, across))
        )
        shifts = displacements(after, before)
        likeliest = [SHIFTS[each] for each in shifts.argmax(1).flatten().tolist()]
        assert likeliest.count((REACH[0] + down, REACH[1] + across)) >= 12  # of 16 parts; others lie at the edge


def test_pictures_of_any_size_have_displacements():
    for size in ((1, 1), (5, 7), (2, 100), (20, 2000)):
        one = torch.rand(1, 3, *size, generator=make_rng(0))
        assert bool(displacements(one, one).isfinite().all())
