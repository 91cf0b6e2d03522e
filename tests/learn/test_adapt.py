"""adapt: a latent world goes on learning on another body, and with its old recording beside it forgets less."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.learn.stopping import quiet
from tests.learn.test_train_latent import LIMITS, QUICK, drifting

import terrella
from terrella.cli import main
from terrella.core.errors import DatasetError, TrainingError
from terrella.data import Recorder
from terrella.learn.objectives.latent_prediction import LatentClips
from terrella.learn.objectives.lawful import LawLoss
from terrella.learn.recipes.adapt import AdaptConfig, _fitting, adapt, errors_on
from terrella.learn.recipes.latent import LatentTraining, train_latent
from terrella.learn.rehearsal import joined
from terrella.worlds.folder import load_latent

from ..data.layouts import layout_of

SHORT = AdaptConfig(steps=80, batch=24, learning_rate=1e-3)


def heavier(folder, width=2, episodes=6, length=60, fps=10.0):
    """A heavier mass with less drag."""
    rng, facts = np.random.default_rng(1), {"name": "m", **LIMITS, "dt_s": 1 / fps}
    layout = layout_of(fps, ("force",), vectors={"state": width}, world=facts)
    with Recorder(folder, layout) as recorder:
        for _ in range(episodes):
            at, speed, force = rng.uniform(-0.8, 0.8), 0.0, 0.0
            for row in range(length):
                force = rng.uniform(-1, 1) if row % 4 == 0 else force
                seen = {"state": np.array([at, speed, 0.0][:width], np.float32)}
                recorder.add(seen, None if row == length - 1 else np.array([force], np.float32), float(at > 0.5), False)
                speed = float(np.clip(0.99 * speed + 0.03 * force, -1, 1))
                at = float(np.clip(at + 0.5 * speed, -1, 1))
            recorder.end_episode()
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A world, the recording that it learned, and one of another body."""
    folder = tmp_path_factory.mktemp("adapt")
    old, new = drifting(folder / "old"), heavier(folder / "new")
    train_latent(old, folder / "run", replace(QUICK, latent=None, steps=160), quiet)
    return load_latent(folder / "run" / "world"), old, new


def test_it_learns_the_other_body_and_forgets_less_where_it_rehearses(made, tmp_path):
    world, old, new = made
    with_old = adapt(world, new, tmp_path / "kept", SHORT, quiet, old)
    without = adapt(world, new, tmp_path / "bare", SHORT, quiet)
    errors = with_old["errors"]
    assert errors["new"]["before"]["8"] > 0.9 and errors["new"]["after"]["8"] < 0.6 * errors["new"]["before"]["8"]
    assert without["errors"]["new"]["after"]["8"] < 0.6 * errors["new"]["before"]["8"]
    forgotten = errors_on(load_latent(tmp_path / "bare" / "world"), _fitting(world, old, quiet))
    assert errors["old"]["after"]["8"] < forgotten["8"]
    assert "not measured" in without["verdict"] and "On the old one" in with_old["verdict"]
    assert adapt(world, new, tmp_path / "kept", SHORT, quiet, old)["errors"] == errors  # finished: as it was


@pytest.mark.exact
def test_what_cannot_adapt_is_refused_in_a_sentence(made, tmp_path):
    world, old, new = made
    with pytest.raises(DatasetError, match="are not those of doom-maze"):
        adapt(terrella.load("doom-maze"), new, tmp_path / "run", SHORT, quiet)
    for wrong in (AdaptConfig(minutes=0), AdaptConfig(batch=0), AdaptConfig(batch=-2), AdaptConfig(learning_rate=-1.0)):
        with pytest.raises(TrainingError, match="--minutes and --learning-rate are more than 0"):
            adapt(world, new, tmp_path / "run", wrong, quiet)
    with pytest.raises(DatasetError, match=r"state of 2; .* state of 3"):
        adapt(world, heavier(tmp_path / "wide", width=3), tmp_path / "run", SHORT, quiet)
    with pytest.raises(DatasetError, match="20 steps a second, and latent 10"):
        adapt(world, heavier(tmp_path / "fast", fps=20.0), tmp_path / "run", SHORT, quiet)
    alone = heavier(tmp_path / "alone", episodes=1, length=100)
    for data, keep in ((alone, None), (new, alone)):
        with pytest.raises(DatasetError, match="alone has one episode"):
            adapt(world, data, tmp_path / "run", SHORT, quiet, keep)
    brief = heavier(tmp_path / "brief", episodes=30, length=8)
    with pytest.raises(DatasetError, match=r"no episode of .*brief that is trained on has 15 rows; record longer ones"):
        adapt(world, new, tmp_path / "run", SHORT, quiet, brief)
    with pytest.raises(DatasetError, match="longer"):
        adapt(world, heavier(tmp_path / "short", episodes=30, length=5), tmp_path / "run", SHORT, quiet)
    adapt(world, new, tmp_path / "run", replace(SHORT, steps=2), quiet)
    with pytest.raises(TrainingError, match="another --out"):
        adapt(world, new, tmp_path / "run", SHORT, quiet)


def test_laws_are_a_part_of_the_loss_where_the_recording_describes_its_bodies(made, tmp_path, monkeypatch):
    config = terrella.CollectConfig(tmp_path / "balls", frames=400, pictures="none")
    terrella.collect("physics:parabola", config)
    few = LatentTraining(steps=2, batch=8, rollout=4, leap=0, strip_every_s=1e9)
    train_latent(tmp_path / "balls", tmp_path / "run", few, quiet)
    world = load_latent(tmp_path / "run" / "world")
    recording = _fitting(world, tmp_path / "balls", quiet)
    laws = LawLoss.of(recording, world.network, 4)
    assert laws is not None and LawLoss.of(_fitting(made[0], made[1], quiet), made[0].network, 4) is None
    rows = recording.rows_within(0, 4)[::7, None] + np.arange(5)
    arrays = [recording.cache.arrays[recording.cache.keys[name]] for name, _ in laws.vectors]
    parts = [torch.from_numpy(np.array(array[rows], np.float32)).flatten(2) for array in arrays]
    truth = torch.cat(parts, 2)
    assert float(laws(truth)) == 0
    broken = (truth + 0.3 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    loss = laws(broken)
    loss.backward()
    assert loss > 0.1 and broken.grad is not None and broken.grad.isfinite().all() and broken.grad.abs().sum() > 0
    seen = []
    monkeypatch.setattr(LawLoss, "__call__", lambda laws, numbers: seen.append(len(numbers)) or 0 * numbers.sum() + 1)
    adapt(world, tmp_path / "balls", tmp_path / "adapted", AdaptConfig(steps=2, batch=8), quiet)
    adapt(world, tmp_path / "balls", tmp_path / "kept", AdaptConfig(steps=2, batch=8), quiet, tmp_path / "balls")
    assert seen == [8, 8, 4, 4]  # not on the half that is kept
    assert json.loads((tmp_path / "adapted" / "log.jsonl").read_text().splitlines()[-1])["laws"] > 0


def test_batches_are_joined_row_by_row():
    one, other = (LatentClips(None, *(torch.full((2, 3, 1), value) for _ in range(4))) for value in (0.0, 1.0))
    both = joined(one, other)
    assert both.rgb is None and both.numbers[:, 0, 0].tolist() == [0, 0, 1, 1]


@pytest.mark.exact
def test_the_command_says_what_was_gained_and_what_was_forgotten(made, tmp_path, capsys):
    _, old, new = made
    run, out = str(old.parent / "run"), str(tmp_path / "out")
    assert (
        main(["adapt", run, "--from", str(new), "--keep", str(old), "--out", out, "--steps", "4", "--batch", "8"]) == 0
    )
    said = capsys.readouterr().out
    assert f"next: terrella train policy --out {out}-policy --in {out}" in said  # without pictures it cannot be played
    assert said.startswith("After 16 steps its error on the new recording is") and "On the old one it is" in said
    assert main(["adapt", "doom-maze", "--from", str(new), "--out", out]) == 2
    assert "are not those of doom-maze" in capsys.readouterr().err
