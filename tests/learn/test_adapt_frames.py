"""adapt of a world of frames alone: it learns what another camera sees, and says what it forgot."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tests.learn.stopping import quiet

from terrella.core.errors import DatasetError, TrainingError
from terrella.data import Recorder
from terrella.learn.objectives.flow_frames import FlowClips
from terrella.learn.recipes import adapt_frames
from terrella.learn.recipes.adapt import AdaptConfig, adapt
from terrella.learn.recipes.adapt_frames import _fitting, frame_errors
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_config import TrainConfig
from terrella.learn.rehearsal import Rehearsal, joined
from terrella.worlds.folder import load_world

from ..data.layouts import layout_of

SIDE = 32  # 16 would leave one place at a sixteenth of the size, which cannot be normalised
TINY = TrainConfig(
    size=(SIDE, SIDE), channels=(8, 8, 8), steps=4, batch=2, uncertainty_frames=0, frames=2, strip_every_s=1e9
)

FEW = AdaptConfig(steps=4, batch=2)


def bar(folder, dark: bool, episodes=6, length=40, fps=10.0):
    """A bright bar before a dark wall, or a dark one before a bright wall, which actions push."""
    rng, layout = np.random.default_rng(0), layout_of(fps, ("right",), rgb=(SIDE, SIDE))
    with Recorder(folder, layout) as recorder:
        for _ in range(episodes):
            at, push = int(rng.integers(0, 24)), 0.0
            for row in range(length):
                push = float(rng.integers(0, 2)) if row % 3 == 0 else push
                picture = np.full((SIDE, SIDE, 3), 220 if dark else 30, np.uint8)
                picture[:, at : at + 8] = 30 if dark else 220
                recorder.add({"rgb": picture}, None if row == length - 1 else np.array([push > 0]), 0.0, False)
                at = min(24, at + 2) if push else max(0, at - 2)
            recorder.end_episode()
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A world, the recording that it learned, and one of a camera that sees the negative."""
    folder = tmp_path_factory.mktemp("frames")
    old, new = bar(folder / "old", dark=False), bar(folder / "new", dark=True)
    train_video(old, folder / "run", TINY, quiet)
    return load_world(folder / "run" / "world"), old, new


def test_it_goes_on_from_the_world_and_measures_both_recordings(made, tmp_path, monkeypatch):
    monkeypatch.setattr(adapt_frames, "ROLLOUTS", 4)
    world, old, new = made
    before = {name: weight.clone() for name, weight in world.generator.state_dict().items()}
    facts = adapt(world, new, tmp_path / "run", FEW, quiet, old)
    errors, adapted = facts["errors"], load_world(tmp_path / "run" / "world")
    apart = [
        (weight.float() - before[name].float()).abs().max() for name, weight in adapted.generator.state_dict().items()
    ]
    assert 0 < max(map(float, apart)) < 0.3, "a few steps from where the world was"
    assert all(torch.equal(before[name], weight) for name, weight in world.generator.state_dict().items())
    recordings = {name: _fitting(adapted, one, quiet) for name, one in (("new", new), ("old", old))}
    assert {name: frame_errors(adapted, one) for name, one in recordings.items()} == {
        name: one["after"] for name, one in errors.items()
    }
    assert errors["old"]["before"] == frame_errors(world, recordings["old"])
    assert set(errors["new"]["after"]) == {"1", "8", "16"} and "On the old one" in facts["verdict"]
    picture = adapted.render(adapted.start(1, torch.Generator()), ("rgb",))["rgb"].float()
    assert float(picture.mean()) > 128, "episodes begin as the new camera sees them"
    assert adapt(world, new, tmp_path / "run", FEW, quiet, old)["errors"] == errors  # finished: as it was
    with pytest.raises(TrainingError, match="another --out"):
        adapt(world, new, tmp_path / "run", FEW, quiet)


@pytest.mark.slow
def test_it_learns_the_other_camera_and_forgets_less_where_it_rehearses(made, tmp_path):
    _, old, new = made
    train_video(old, tmp_path / "old", replace(TINY, steps=150), quiet)
    world, many = load_world(tmp_path / "old" / "world"), replace(FEW, steps=200)
    alone = adapt(world, new, tmp_path / "alone", many, quiet)["errors"]["new"]
    both = adapt(world, new, tmp_path / "both", many, quiet, old)["errors"]
    after = "1"  # step: after 8 so short a training errs as much as copying does
    assert alone["after"][after] < 0.75 * alone["before"][after]
    assert both["new"]["after"][after] < 0.8 * alone["before"][after], "every second batch is of the old one"
    forgotten = frame_errors(load_world(tmp_path / "alone" / "world"), _fitting(world, old, quiet))[after]
    assert both["old"]["after"][after] < forgotten


def test_what_cannot_adapt_is_refused_in_a_sentence(made, tmp_path):
    world = made[0]
    with pytest.raises(DatasetError, match="20 steps a second, and world 10"):
        adapt(world, bar(tmp_path / "fast", True, fps=20.0), tmp_path / "run", FEW, quiet)
    with pytest.raises(DatasetError, match="no held-out episode of 18 frames"):
        adapt(world, bar(tmp_path / "short", True, episodes=30, length=15), tmp_path / "run", FEW, quiet)


def test_rows_of_two_recordings_take_turns():
    one, other = (FlowClips(torch.full((2, 3), value), torch.full((2, 1), value), None) for value in (0, 1))
    assert joined(one, other, interleaved=True).frames[:, 0].tolist() == [0, 1, 0, 1]


def test_every_second_batch_rehearses():
    def same(value: int) -> Any:
        return SimpleNamespace(batch=lambda now: FlowClips(torch.full((2, 3), value), torch.full((2, 1), value), None))

    rehearsal: Any = Rehearsal(same(0), same(1), interleaved=True, every=2)
    rows = [rehearsal.batch(SimpleNamespace(step=step)).frames[:, 0].tolist() for step in (1, 2, 3)]
    assert rows == [[0, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 0]]
