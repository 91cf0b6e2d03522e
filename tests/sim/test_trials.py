"""Real episodes teach a simulator: identification finds what differs, and a residual puts its steps right."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from terrella.core import check_world, make_rng, rollout
from terrella.core.errors import TerrellaError
from terrella.core.policy import Random
from terrella.library import load

pytestmark = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(
        "terrella.workflows.transfer_arms.FITTED", 600
    )  # errors of 0.14 and 0.16 of the targets' squares


@pytest.fixture(scope="module")
def pair():
    """The arm, and six episodes of one with weaker motors and an action that comes late."""
    from terrella.sim.randomised import Distribution, Randomised
    from terrella.sim.trials import collect

    sim = load("mujoco:arm", cameras=(), threads=1)
    real = Randomised(sim, {"gain": Distribution("constant", (0.8,)), "delay": Distribution("constant", (1.0,))})
    return sim, collect(real, Random(sim.spec, (1, 9)), 6, 3)


@pytest.mark.slow
def test_identification_finds_what_differs(pair):
    from terrella.sim.identification import identify
    from terrella.sim.randomised import Distribution, Randomised

    sim, trials = pair
    ranges = {"gain": Distribution("uniform", (0.6, 1.2)), "delay": Distribution("choice", (0.0, 1.0, 2.0))}
    found = identify(Randomised(sim, ranges), trials[:3], 0)
    assert found.values["gain"] == pytest.approx(0.8, abs=0.02) and found.values["delay"] == 1
    assert found.error < 0.1 * found.nominal
    low, high = found.around(ranges)["gain"].limits
    assert 0.6 <= low < 0.8 < high <= 1.2


@pytest.mark.slow
def test_a_residual_of_few_episodes_puts_others_right(pair, tmp_path):
    from terrella.sim.corrected import residual_targets
    from terrella.workflows.transfer_arms import fit_residual

    sim, trials = pair
    model = fit_residual(sim, trials[:5], tmp_path / "run", 0)
    inputs, targets = residual_targets(sim, trials[5:])
    left = (model.residual.correction(inputs) - targets).square().mean(0)
    assert (left < 0.25 * targets.square().mean(0)).all()
    check_world(model)


@pytest.mark.slow
def test_play_is_learned_from_few_episodes(tmp_path):
    from terrella.sim.corrected import residual_targets
    from terrella.sim.randomised import Distribution, Randomised
    from terrella.sim.trials import collect
    from terrella.workflows.transfer_arms import fit_residual

    sim = load("mujoco:arm", cameras=(), threads=1)
    real = Randomised(sim, {"backlash": Distribution("constant", (0.1,))})
    trials = collect(real, Random(sim.spec, (1, 9)), 8, 3)
    model = fit_residual(sim, trials[:6], tmp_path / "run", 0)
    inputs, targets = residual_targets(sim, trials[6:])
    left = (model.residual.correction(inputs) - targets).square().mean(0)
    assert (left < 0.3 * targets.square().mean(0)).all()  # without the bank of play operators 0.57 to 0.85


def test_without_a_residual_a_corrected_world_is_the_world(pair):
    from terrella.sim.corrected import Corrected, Residual

    sim, trials = pair
    model, actions = Corrected(sim, Residual(2, 2)), trials.actions[:2, :20].transpose(0, 1)
    one, other = (
        rollout(world, world.start(2, make_rng(1)), actions, make_rng(2), ("qpos", "success")).observations
        for world in (sim, model)
    )
    assert all(torch.allclose(one[name], other[name], atol=1e-5) for name in ("qpos", "success"))


def test_joints_that_are_no_numbers_are_refused():
    from terrella.sim.trials import fitted_simulator

    with pytest.raises(TerrellaError, match="free joint"):
        fitted_simulator(load("mujoco:ant", cameras=()))


def test_the_simulator_inside_all_wrappers_is_seen_and_no_other_attribute(pair):
    from terrella.sim.corrected import Corrected, Residual
    from terrella.sim.randomised import Distribution, Randomised
    from terrella.sim.trials import fitted_simulator

    sim, _ = pair
    wrapped = Randomised(Corrected(sim, Residual(2, 2)), {"delay": Distribution("constant", (1.0,))})
    assert fitted_simulator(wrapped) is sim
    other = SimpleNamespace(world=sim, spec=sim.spec)
    with pytest.raises(TerrellaError, match="is not a MuJoCo simulator"):
        fitted_simulator(other)
