"""train latent on toy recordings: it goes on exactly, does not collapse, and foretells better than its baselines."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tests.learn.stopping import goes_on_exactly, quiet

import terrella
from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, TrainingError
from terrella.core.rollouts import advance
from terrella.data import Recorder
from terrella.learn.latent_validation import (
    ARMS,
    calibrate,
    effective_rank,
    encode_rows,
    linear_probe,
    open_loop,
    state_at,
    verdict,
)
from terrella.learn.objectives.latent_prediction import sigreg
from terrella.learn.recipes import latent
from terrella.learn.recipes.latent import LatentTraining, train_latent
from terrella.learn.recording import Recording
from terrella.worlds.latent import LatentWorld

from ..data.layouts import layout_of

QUICK = LatentTraining(steps=150, batch=32, latent=8, rollout=4, strip_every_s=1e9)
LIMITS = {
    "action_low": [-1.0],
    "action_high": [1.0],
    "action_space": "Box(-1, 1)",
    "keys": {"KeyA": [-1.0]},
    "dt_s": 0.1,
}


def drifting(folder, pictures=None, acted=True, vectors=True, episodes=6, length=60, still=False):
    """A mass that a force pushes to and fro; a picture is a bar where it is. It ends at the right wall, which pays."""
    rng = np.random.default_rng(0)
    told = ({"state": 2} if vectors else {}) | ({"contact": 1} if still else {})
    layout = layout_of(10.0, ("force",), rgb=pictures, vectors=told, world={"name": "drift", **LIMITS})
    layout = type(layout)(**{**vars(layout), "pictures": "png"})
    with Recorder(folder, layout) as recorder:
        for _ in range(episodes):
            at, speed = rng.uniform(-0.8, 0.8), 0.0
            force = 0.0
            for row in range(length):
                force = rng.uniform(-1, 1) if row % 4 == 0 else force
                seen = {"state": np.array([at, speed], np.float32)} if vectors else {}
                if still:
                    seen["contact"] = np.zeros(1, np.float32)
                if pictures:
                    seen["rgb"] = picture(at, *pictures)
                last = row == length - 1
                recorder.add(seen, None if last else np.array([force], np.float32), float(at > 0.5), False)
                speed = float(np.clip(0.9 * speed + 0.1 * force, -1, 1))
                at = float(np.clip(at + 0.5 * speed, -1, 1))
            recorder.end_episode()
    return folder


def picture(at: float, height: int, width: int) -> np.ndarray:
    seen = np.full((height, width, 3), 40, np.uint8)
    middle = int((at + 1) / 2 * (width - 1))
    seen[:, max(0, middle - 3) : middle + 4] = (220, 180, 60)
    return seen


@pytest.fixture(scope="module")
def vectors(tmp_path_factory):
    return drifting(tmp_path_factory.mktemp("latent") / "vectors")


@pytest.fixture(scope="module")
def run(vectors, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    facts = train_latent(vectors, out, QUICK, quiet)
    return out, facts


def test_episodes_too_short_to_validate_are_refused_before_training(tmp_path):
    drifting(tmp_path / "data", episodes=12, length=7)
    with pytest.raises(DatasetError, match="too few stretches of .* rows for validation; record longer"):
        train_latent(tmp_path / "data", tmp_path / "run", QUICK, quiet)
    assert not (tmp_path / "run" / "world").exists()


@pytest.mark.slow
def test_a_leap_foretells_what_five_steps_do(vectors, tmp_path):
    train_latent(vectors, tmp_path, replace(QUICK, rollout=5), quiet)
    world = terrella.load(tmp_path)
    assert isinstance(world, LatentWorld) and world.spec.leap == 5
    data = Recording.open(vectors, (64, 64), quiet, needs=("action",))
    rows = data.rows_within(2, 5, acted=True)
    state = state_at(world, data, rows, 2)
    acts = torch.stack([data.recorded_actions(world.spec, rows + step) for step in range(5)], 1)
    ended = advance(world, state, acts, make_rng(0))["window"][:, -1]
    truth = encode_rows(world, data, rows + 5)
    error, still = ((found - truth).square().mean() for found in (ended, state["window"][:, -1]))
    assert error < 0.6 * still


def test_it_foretells_and_does_not_collapse(run):
    out, facts = run
    assert facts == {**facts, **json.loads((out / "validation.json").read_text())}
    for channel in ("latent", "state"):
        errors = facts["errors"][channel]
        for step in ("8", "16"):
            assert errors["true actions"][step] < 0.8 * errors["copy-last"][step], (channel, step, errors)
            assert errors["true actions"][step] < 0.8 * errors["another's actions"][step], (channel, step, errors)
    assert facts["effective_rank"] > 2 and facts["probe_r2"]["state"] > 0.8


def test_the_world_of_the_run_is_opened_by_name_and_keeps_the_contract(run):
    world = terrella.load(run[0])
    assert (
        world.spec.keys == {"KeyA": [-1.0]} and world.spec.observes == ("state",) and "rgb" not in world.spec.channels
    )
    assert "gradients_reach_the_action" in check_world(world, steps=3)
    assert world.spec.card["validation"] == json.loads((run[0] / "validation.json").read_text())


@pytest.mark.slow
def test_a_number_that_never_changes_does_not_spoil_the_verdict(tmp_path):
    data = drifting(tmp_path / "data", still=True)
    facts = train_latent(data, tmp_path / "run", replace(QUICK, latent=None), quiet)
    errors = facts["errors"]["latent"]
    assert facts["latent"] == 3 and errors["true actions"]["8"] < 0.6 * errors["copy-last"]["8"]
    assert facts["verdict"].startswith("Better than copy-last after 16 steps")


def test_a_few_numbers_are_the_latent_themselves(vectors, tmp_path):
    """No encoder, no collapse to prevent: what is decoded is what was predicted."""
    facts = train_latent(vectors, tmp_path, replace(QUICK, latent=None), quiet)
    world, seen = terrella.load(tmp_path), {"state": torch.tensor([[0.3, -0.1], [-0.6, 0.2]])}
    errors = facts["errors"]["state"]
    assert facts["latent"] == 2 and errors["true actions"]["8"] < 0.5 * errors["copy-last"]["8"]
    shown = world.render(world.observe(seen, None, make_rng(0)), ("state",))["state"]
    assert torch.allclose(shown, seen["state"], atol=1e-5)
    assert "gradients_reach_the_action" in check_world(world, steps=3)


def test_who_sees_no_pictures_learns_to_draw_none(tmp_path):
    data = drifting(tmp_path / "data", pictures=(32, 32), episodes=4, length=30)
    config = LatentTraining(steps=4, batch=4, rollout=2, pictures=False, strip_every_s=1e9)
    train_latent(data, tmp_path / "run", config, quiet)
    assert "rgb" not in terrella.load(tmp_path / "run").spec.channels


def test_its_uncertainty_grows_with_what_was_not_seen(run):
    world, rng = terrella.load(run[0]), terrella.make_rng(0)
    state = world.observe({"state": torch.zeros(1, 2)}, None, rng)
    levels = [0.0]
    for _ in range(12):
        state = world.imagine(state, torch.ones(1, 1), rng)
        levels.append(float(world.render(state, ("uncertainty",))["uncertainty"]))
    assert levels == sorted(levels) and levels[-1] > levels[1] >= 0


def test_its_uncertainty_is_calibrated_as_far_as_the_episodes_reach(run, vectors):
    """At spreads beyond the last knot the error is extrapolated."""
    world, data = terrella.load(run[0]), Recording.open(vectors, (64, 64), quiet, needs=("action",))
    assert isinstance(world, LatentWorld)
    rolled, last_knot = open_loop(world, data, (32,)), {}
    for longest in (4, 512):
        calibrate(world, data, longest)
        last_knot[longest] = float(world.network.spread[-1])
    assert 2 * last_knot[4] < last_knot[512] and last_knot[512] > float(rolled.spread[32].mean())


@pytest.mark.exact
def test_a_stopped_run_goes_on_exactly(vectors, tmp_path):
    config = LatentTraining(steps=24, batch=8, latent=8, rollout=3, strip_every_s=1e9)
    goes_on_exactly(
        lambda out: train_latent(vectors, out, config, quiet), tmp_path / "a", tmp_path / "b", {"latent": 9}
    )


@pytest.mark.exact
def test_a_kill_while_validating_leaves_the_trained_world(vectors, tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    config = replace(QUICK, steps=6)
    with monkeypatch.context() as patch:
        patch.setattr(latent, "calibrate", killed)
        with pytest.raises(KeyboardInterrupt):
            train_latent(vectors, tmp_path, config, quiet)
    world = terrella.load(tmp_path)
    assert world.spec.card["steps"] == 6 and "validation" not in world.spec.card
    facts = train_latent(vectors, tmp_path, config, quiet)
    validation: Any = terrella.load(tmp_path).spec.card["validation"]
    assert facts["step"] == 6 and validation["errors"] == facts["errors"]


def test_a_finished_run_says_again_what_it_found(run, vectors):
    assert train_latent(vectors, run[0], QUICK, quiet) == run[1]


@pytest.mark.exact
def test_pictures_of_an_odd_size_are_seen_and_decoded(tmp_path):
    data = drifting(tmp_path / "data", pictures=(37, 90), episodes=4, length=30)
    config = LatentTraining(steps=8, batch=4, latent=8, rollout=2, strip_every_s=1e9)
    facts = train_latent(data, tmp_path / "run", config, quiet)
    world, rng = terrella.load(tmp_path / "run"), terrella.make_rng(0)
    assert world.spec.observes == ("rgb",) and world.spec.may_observe == ("state",)
    assert world.render(world.start(2, rng), ("rgb",))["rgb"].shape == (2, 32, 64, 3)
    assert "state" in facts["errors"] and list((tmp_path / "run").glob("strip-*.png"))
    bare = LatentTraining(**{**vars(config), "vectors": False})
    train_latent(data, tmp_path / "bare", bare, quiet)
    spec = terrella.load(tmp_path / "bare").spec
    assert spec.observes == ("rgb",) and spec.may_observe == () and "state" in spec.channels


def test_what_cannot_be_learned_is_refused_in_a_sentence(vectors, tmp_path):
    def refused(error, match, data=vectors, **settings):
        with pytest.raises(error, match=match):
            train_latent(data, tmp_path / "run", LatentTraining(**settings), quiet)

    refused(TrainingError, "multiples of 16", size=(30, 40))
    refused(TrainingError, "leaves nothing to see", pictures=False, vectors=False)
    refused(TrainingError, "--batch", batch=1)
    refused(TrainingError, "1 to 16 pictures", frames=0)
    refused(DatasetError, "no pictures and no state vectors", vectors=False)
    refused(DatasetError, "--rollout 64", rollout=64)
    refused(DatasetError, "rows of a clip", history=16, data=drifting(tmp_path / "short", episodes=12, length=8))


def test_a_recording_without_actions_is_refused(tmp_path):
    layout = layout_of(10.0, ("force",), vectors={"state": 2})
    kept = {name: sensor for name, sensor in layout.sensors.items() if name != "action"}
    with Recorder(tmp_path / "data", type(layout)(**{**vars(layout), "sensors": kept})) as recorder:
        for _ in range(80):
            recorder.add({"state": np.zeros(2, np.float32)}, None, 0.0, False)
        recorder.end_episode()
    with pytest.raises(DatasetError, match="action"):
        train_latent(tmp_path / "data", tmp_path / "run", QUICK, quiet)


def test_sigreg_knows_a_normal_from_a_collapse():
    rng = terrella.make_rng(0)
    normal = torch.randn(512, 8, generator=rng)
    directions = torch.nn.functional.normalize(torch.randn(8, 64, generator=rng), dim=0)
    flat = normal * torch.tensor([1.0] * 4 + [0.01] * 4)
    found = [float(sigreg(part, directions)) for part in (normal, flat, 0.01 * normal)]
    assert found[0] < 1.5 and found[0] < found[1] / 3 and found[1] < found[2]


def test_sigreg_is_the_integral_that_it_stands_for():
    """Against a fine grid over both halves, direction by direction."""
    rng = terrella.make_rng(1)
    latents = torch.rand(40, 3, generator=rng, dtype=torch.float64)
    directions = torch.eye(3, dtype=torch.float64)
    grid = torch.linspace(-3, 3, 2001, dtype=torch.float64)
    slow = []
    for axis in range(3):
        seen = torch.exp(1j * latents[:, axis, None] * grid).mean(0)
        away = (seen - (-grid.square() / 2).exp()).abs().square() * (-grid.square() / 2).exp()
        slow.append(40 * float(torch.trapezoid(away, grid)))
    assert float(sigreg(latents, directions)) == pytest.approx(np.mean(slow), rel=0.01)


def test_figures_of_latents_whose_answers_are_known():
    rng = terrella.make_rng(0)
    latents = torch.randn(2000, 6, generator=rng)
    assert effective_rank(latents) > 5.9 and effective_rank(latents[:, :2] @ torch.randn(2, 6, generator=rng)) < 2.01
    assert effective_rank(latents[:, :1]) == pytest.approx(1)
    told = latents @ torch.randn(6, 2, generator=rng)
    assert linear_probe(latents[:1000], told[:1000], latents[1000:], told[1000:]) > 0.99
    noise = torch.randn(2000, 2, generator=rng)
    assert linear_probe(latents[:1000], noise[:1000], latents[1000:], noise[1000:]) < 0.1


def test_the_verdict_says_how_far_to_plan_and_what_is_lost():
    def arms(true, other, still):
        return {
            ARMS[0]: {"1": true, "8": 2 * true},
            ARMS[1]: {"1": other, "8": 2 * other},
            ARMS[2]: {"1": still, "8": still},
        }

    assert verdict(arms(0.1, 0.3, 0.4), {"place": 0.9, "speed": 0.2}) == (
        "Better than copy-last after 8 steps; what it predicts depends on the actions after 8. Its latents do not hold speed."
    )
    assert "after 1 step;" in verdict(arms(0.3, 0.6, 0.4), {})
    assert "hardly depends on the actions" in verdict(arms(0.1, 0.1, 0.4), {})
    assert "do not plan in it" in verdict(arms(0.5, 0.6, 0.4), {})
    assert "after 8 steps; it has one action" in verdict(arms(0.1, 0.1, 0.4), {}, acts=False)


def test_where_no_recorded_episode_ended_none_ends_in_a_rollout(vectors, tmp_path):
    train_latent(vectors, tmp_path / "run", replace(QUICK, steps=1), quiet)
    world = terrella.load(tmp_path / "run")
    state = world.imagine(world.start(8, make_rng(0)), torch.zeros(8, 1), make_rng(1))
    assert float(world.render(state, ["done_probability"])["done_probability"].max()) < 1e-6


def test_fewer_clips_than_a_batch_are_one_batch(tmp_path):
    few = drifting(tmp_path / "few", episodes=9, length=12)
    assert train_latent(few, tmp_path / "run", replace(QUICK, steps=2, batch=128), quiet)["step"] == 2


def test_it_learns_the_vectors_that_are_asked_for(tmp_path):
    folder = drifting(tmp_path / "drift")
    config = replace(QUICK, steps=3, latent=None, channels=("state",), history=1, hidden=16, members=2)
    train_latent(folder, tmp_path / "run", config, quiet)
    world = terrella.load(tmp_path / "run")
    assert world.spec.observes == ("state",) and world.spec.channels["latent"].shape == (2,)
    with pytest.raises(DatasetError, match="no vector speed; it has state"):
        train_latent(folder, tmp_path / "other", replace(config, channels=("speed",)), quiet)
