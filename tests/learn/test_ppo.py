"""PPO learns what pays in a small world, as exactly as it is seeded, and stops before a policy moves far."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig, ActorNetwork
from terrella.act.onnx_file import write_onnx
from terrella.core import Spec, State, make_rng, rollout
from terrella.core.errors import TerrellaError
from terrella.core.spec import REWARD
from terrella.learn.growth import Growth
from terrella.learn.objectives.ppo import CLIP, EPOCHS, MINIBATCHES, AdaptiveRate, clipped_surrogate
from terrella.learn.recipes.policy import Practice, train_policy


class Hold:
    """A point that is paid for lying near 0."""

    spec = Spec(
        name="hold",
        action=spaces.Box(-1, 1, (1,), np.float32),
        channels={"at": spaces.Box(-np.inf, np.inf, (1,), np.float32), "reward": REWARD},
        observes=("at",),
        dt_s=0.1,
    )

    def start(self, batch, rng):
        return self._state(2 * torch.rand(batch, 1, generator=rng) - 1)

    def observe(self, observation, prior, rng):
        return self._state(observation["at"])

    def imagine(self, state, action, rng):
        return self._state(state["at"] + 0.5 * self.spec.check_action(action, state.batch))

    def render(self, state, channels):
        return {name: state[name] for name in channels}

    def _state(self, at):
        return State({"at": at, "reward": 1 - at.abs()[:, 0]})


def paid(policy, world) -> float:
    rng = make_rng(9)
    return float(
        rollout(world, world.start(64, rng), policy, rng, ("at", "reward"), 10).observations["reward"][1:].mean()
    )


def test_it_learns_what_pays_and_goes_on_exactly(tmp_path):
    world, quiet = Hold(), lambda *_: None
    config = Practice(method="ppo", steps=20, batch=64, horizon=8, hidden=32, learning_rate=3e-3)
    facts = train_policy(world, "hold", tmp_path / "run", config, quiet)
    learned = Actor.load(tmp_path / "run", world.spec)
    untaught = Actor(type(learned.network)(learned.network.config), world.spec)
    assert facts["step"] == 20 and paid(learned, world) > 0.8 > paid(untaught, world)
    again = train_policy(world, "hold", tmp_path / "again", config, quiet)
    assert again["practised_steps"] == 20 * 64 * 8
    weights = (Actor.load(tmp_path / name, world.spec).network.state_dict() for name in ("run", "again"))
    assert all(torch.equal(a, b) for a, b in zip(*(one.values() for one in weights)))


def test_the_surrogate_gains_nothing_beyond_the_clip_and_keeps_every_loss():
    ratio, advantage = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1]), torch.tensor([1.0, 1.0, -1.0, -1.0, 2.0])
    expected = torch.tensor([1 + CLIP, 0.5, -1.5, -(1 - CLIP), 2.2])
    torch.testing.assert_close(clipped_surrogate(ratio, advantage), expected)


def test_a_rate_that_moves_the_policy_too_far_is_lowered_and_comes_back():
    adaptive = AdaptiveRate()
    for _ in range(3):
        adaptive.update(minibatches=1)
    assert float(adaptive.share) == pytest.approx(1.5**-3)
    adaptive.update(minibatches=2 * MINIBATCHES)
    assert float(adaptive.share) == pytest.approx(1.5**-3), "some epochs are as they should be"
    for _ in range(100):
        adaptive.update(EPOCHS * MINIBATCHES)
    assert float(adaptive.share) == 1.0


def test_a_rate_far_too_high_does_not_stay_so(tmp_path):
    config = Practice(method="ppo", steps=12, batch=64, horizon=8, hidden=32, learning_rate=0.3)
    train_policy(Hold(), "hold", tmp_path / "run", config, lambda *_: None)
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert log[-1]["rate"] < 0.7


def test_it_is_exported_with_its_normalisation(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime", reason="pip install 'terrella[fast]'")
    pytest.importorskip("onnx", reason="pip install 'terrella[fast]'")
    network = ActorNetwork(ActorConfig.of(Hold.spec, ("at",), hidden=16))
    network.eyes.fit_normalization({"at": 3 + 2 * torch.randn(100, 1, generator=make_rng(0))})
    with torch.no_grad():
        network.think[-1].weight.mul_(100)
    actor = Actor(network.eval(), Hold.spec)
    assert write_onnx(actor, tmp_path / "policy.onnx") == {"at": [-1, 1]}
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    at = torch.linspace(-4, 9, 7)[:, None]
    (action,) = session.run(None, {"at": at.numpy()})
    assert (
        np.allclose(action, actor.act({"at": at}, None, make_rng(0))[0].detach(), atol=1e-4) and np.ptp(action) > 0.01
    )


def test_ranges_grow_while_the_policy_copes_and_wait_where_it_does_not():
    world = Hold()
    world.scale = 1.0
    growth = Growth(world)
    growth.set()
    assert world.scale == 0.0
    for reward in [0.0] * 10 + [1.0] * 60:
        growth.update(torch.full((3,), reward))
    growth.set()
    grown = world.scale
    assert 0.5 < grown <= 1.0
    for _ in range(40):
        growth.update(torch.zeros(3))
    stopped = float(growth.scale)
    growth.update(torch.zeros(3))
    assert float(growth.scale) == stopped


@pytest.mark.slow
def test_a_run_with_growing_ranges_goes_on_exactly(tmp_path):
    class Scaled(Hold):
        scale = 1.0

    config, quiet = (
        Practice(method="ppo", steps=30, batch=16, horizon=4, hidden=16, learning_rate=3e-3),
        lambda *_: None,
    )
    facts = train_policy(Scaled(), "hold", tmp_path / "run", config, quiet, growing=Scaled())
    assert 0 < facts["ranges_grown_to"] <= 1
    with pytest.raises(TerrellaError, match="growing"):
        train_policy(Scaled(), "hold", tmp_path / "run", config, quiet)
