"""Drift: over 1,000 steps the expected error grows as the true one does, and never beyond what two random pictures differ by."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from tests.worlds.made import place

import terrella
from terrella.act import Explorer
from terrella.core import make_rng
from terrella.data import ClipCache, Dataset, split
from terrella.learn.objectives.drift import DriftFrames, ceiling_of, drift_frames, drift_horizon, fit_drift, reliability
from terrella.learn.recording import Recording
from terrella.worlds.body import Motion
from terrella.worlds.controls import Controls
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.uncertainty import GONE, UncertaintyConfig, UncertaintyNetwork

BUNDLED = ("doom-maze", "doom-corridor", "islet")


def made_up(rate: float, power: float, ceiling: float, seed: int) -> DriftFrames:
    """Frames of 10 rollouts of 1,000 steps, whose errors saturate with the way, scattered by a third."""
    rng = make_rng(seed)
    step = torch.arange(1, 1001, 10.0).repeat(10)
    gone = torch.zeros(len(step), len(GONE))
    gone[:, 0], gone[:, 1], gone[:, 2] = step, 0.08 * step, 0.02 * step
    base = 0.005 + 0.01 * torch.rand(len(step), generator=rng)
    truth = base + (ceiling - base) * (1 - torch.exp(-((rate * gone[:, 1]) ** power)))
    return DriftFrames(gone, base, truth * (1 + torch.randn(len(step), generator=rng) / 3).clamp_min(0.1), step)


@pytest.mark.parametrize("rate, power, ceiling", [(0.05, 0.6, 0.18), (0.3, 1.0, 0.09), (0.004, 1.4, 0.25)])
def test_the_error_is_expected_in_every_tenth_of_other_rollouts(rate, power, ceiling):
    network = UncertaintyNetwork(UncertaintyConfig())
    network.ceiling.fill_(ceiling)
    fit_drift(network, made_up(rate, power, ceiling, 0))
    frames = made_up(rate, power, ceiling, 1)
    expected = frames.expected + (ceiling - frames.expected) * network.drifts(frames.gone)
    assert float(expected.max()) <= ceiling + 1e-6
    assert all(1 / 1.5 < ratio < 1.5 for ratio in reliability(expected, frames.error)), reliability(
        expected, frames.error
    )
    doubled = frames.error * 2
    assert max(map(abs, (1 - ratio for ratio in reliability(expected, doubled)))) > 0.4, "it would be noticed"


@pytest.mark.slow
def test_a_walk_of_1000_steps_drifts_up_to_the_ceiling_and_invents_no_more_than_before():
    torch.manual_seed(0)
    network = UncertaintyNetwork(UncertaintyConfig())
    network.ceiling.fill_(0.15)
    world, rng = place(Controls.buttons(2)).replaced(uncertainty=network), make_rng(0)
    body: Any = world.body
    assert isinstance(body.motion, Motion)
    state, gone, seen = world.start(1, rng), [], []
    for step in range(1, 1001):
        state = world.imagine(state, torch.tensor([[step // 7 % 2, 1]], dtype=torch.int8), rng)
        gone.append(state["gone"])
        if step in (1, 30):  # frames that nobody reads are not drawn
            seen.append(world.render(state, ("uncertainty", "drifted", "invented")))
    drifts = network.drifts(torch.cat(gone))
    assert (drifts.diff() >= 0).all() and drifts[0] < drifts[-1] <= 1 and state["gone"][0, 0] == 1000
    for shown, share in zip(seen, drifts[[0, 29]]):
        whole, invented = shown["uncertainty"], shown["invented"]
        assert torch.allclose(whole, invented + shown["drifted"]) and float(whole) <= 0.15 + 1e-6
        assert float(shown["drifted"]) == pytest.approx(float((0.15 - invented) * share), abs=1e-6)


@pytest.mark.slow
def test_rollouts_along_a_recording_are_those_of_the_seed(corridor, posed_run):
    world: Any = load_world(posed_run[0] / "world")
    cache = ClipCache.open(Dataset(corridor), (24, 32))
    recording = Recording.of(cache, split(len(cache.episodes))[0], None)
    one, other = (drift_frames(world, recording, 8, 2, seed=3) for _ in range(2))
    assert torch.equal(one.error, other.error) and torch.equal(one.gone, other.gone)
    assert one.gone.shape == (16, len(GONE)) and one.step.unique().tolist() == list(range(1, 9))
    assert 0 < ceiling_of(recording, 0) < 1 and drift_horizon(recording, 60) == 15
    facts = posed_run[1]["uncertainty"]
    assert facts["ceiling"] == pytest.approx(float(world.uncertainty.ceiling), abs=1e-4) and facts["drift_steps"] == 15


@pytest.mark.slow
def test_an_older_world_expects_no_more_than_it_was_calibrated_to(posed_run, tmp_path):
    save_world(load_world(posed_run[0] / "world"), tmp_path / "world")
    path = tmp_path / "world" / "weights.safetensors"
    weights = load_file(path)
    save_file(
        {name: part for name, part in weights.items() if name not in ("uncertainty.ceiling", "uncertainty.drift")}, path
    )
    older: Any = load_world(tmp_path / "world").uncertainty
    assert (
        float(older.ceiling) == float(older.errors[-1]) and float(older.calibrated(torch.tensor(9.0))) <= older.ceiling
    )


@pytest.mark.parametrize("name", BUNDLED)
def test_a_bundled_world_knows_its_ceiling_and_how_it_drifts(name):
    world: Any = terrella.load(name)
    network = world.uncertainty
    far = torch.tensor([[1.0, 0, 0, 0, 0], [1000.0, 70, 20, 0, 0]])
    near, away = network.drifts(far).tolist()
    assert 0.03 < float(network.ceiling) < 0.3 and near < 0.3 < away <= 1
    assert float(network.sure) < float(network.invents) < float(network.ceiling)


@pytest.mark.slow
def test_an_explorer_in_the_maze_is_lost_after_600_steps_but_invents_little():
    world: Any = terrella.load("doom-maze")
    rng = make_rng(0)
    policy, state = Explorer(world.spec), world.start(1, rng)
    memory, seen = policy.begin(1, rng), []
    for step in range(600):
        action, memory = policy.act(world.render(state, world.spec.observes), memory, rng)
        state = world.imagine(state, action, rng)
        if step % 20 == 0:
            seen.append(world.render(state, ("uncertainty", "drifted", "invented", "known")))
    whole, invented, known = (torch.cat([one[name].flatten(1).mean(1) if name == "known" else one[name] for one in seen])
                              for name in ("uncertainty", "invented", "known"))  # fmt: skip
    assert float(whole.max()) <= float(world.uncertainty.ceiling) + 1e-6
    assert (invented[known > 0.95] >= world.uncertainty.invents).float().mean() < 0.1
    assert float(seen[-1]["drifted"]) > 0.5 * float(world.uncertainty.ceiling)
