"""Laws of the learned policy: what it draws, what is saved, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces

from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig, ActorNetwork, symexp, symlog
from terrella.act.belief import load_learned_policy
from terrella.core.errors import ActionError, ChannelError, CheckpointError
from terrella.core.policy import Policy, act
from terrella.core.spec import DONE, REWARD, Spec
from terrella.core.state import State
from terrella.core.world import make_rng

SPACES = {
    "one choice": spaces.Discrete(4, start=-1),
    "several choices": spaces.MultiDiscrete([2, 5]),
    "buttons": spaces.MultiBinary(3),
    "axes": spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 5.0], np.float32)),
}
CHANNELS = {
    "state": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    "speed": spaces.Box(-1, 1, (), np.float32),
    "rgb": spaces.Box(0, 255, (16, 24, 3), np.uint8),
    "map": spaces.Box(0, 1, (4, 4), np.float32),
    "reward": REWARD,
    "done": DONE,
}


def spec_of(action: spaces.Space) -> Spec:
    return Spec("toy", action, CHANNELS, (), 0.1)


def seen(batch: int, rng: torch.Generator) -> dict[str, torch.Tensor]:
    return {
        "state": torch.randn(batch, 3, generator=rng),
        "speed": torch.randn(batch, generator=rng),
        "rgb": torch.randint(256, (batch, 16, 24, 3), generator=rng, dtype=torch.uint8),
    }


def actor_for(action: spaces.Space, sees: tuple[str, ...] = ("state", "speed"), greedy: bool = False) -> Actor:
    torch.manual_seed(0)
    network = ActorNetwork(ActorConfig.of(spec_of(action), sees, hidden=16))
    with torch.no_grad():
        network.think[-1].weight.mul_(100)
    return Actor(network.requires_grad_(False), spec_of(action), greedy)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("sees", [("state", "speed"), ("rgb", "state")])
def test_it_is_a_policy_whose_actions_a_world_takes(name: str, sees: tuple[str, ...]) -> None:
    actor, rng = actor_for(SPACES[name], sees), make_rng(1)
    assert isinstance(actor, Policy)
    observation = seen(64, rng)
    action, memory = act(actor, observation, actor.begin(64, rng), 64, actor.spec, rng)
    actor.spec.check_action(action, 64)
    assert memory is None and len(torch.unique(action, dim=0)) > 1


@pytest.mark.parametrize("name", SPACES)
def test_a_batch_acts_as_its_episodes_do_one_by_one(name: str) -> None:
    actor = actor_for(SPACES[name])
    observation = seen(5, make_rng(2))
    whole, _ = actor.act(observation, None, make_rng(3))
    rng = make_rng(3)
    ones = [actor.act({at: value[n : n + 1] for at, value in observation.items()}, None, rng)[0] for n in range(5)]
    torch.testing.assert_close(whole, torch.cat(ones))


@pytest.mark.parametrize("name", SPACES)
def test_draws_come_as_often_as_they_are_likely(name: str) -> None:
    actor = actor_for(SPACES[name])
    one = {at: value.expand(4096, *value.shape[1:]) for at, value in seen(1, make_rng(4)).items()}
    distribution = actor.network(one)
    drawn = distribution.sample(make_rng(5))
    surprise, entropy = -distribution.log_prob(drawn), distribution.entropy(drawn)
    if name == "axes":  # the entropy is that of what tanh leaves of the draw
        surprise = surprise + (1 - torch.tanh(drawn).square()).log().sum(1)
    assert abs(float(surprise.mean() - entropy.mean())) < 0.1
    best = distribution.log_prob(distribution.mode())
    assert (best >= distribution.log_prob(drawn) - 1e-5).all()


def test_axes_have_gradients_from_the_action_to_the_network() -> None:
    actor = actor_for(SPACES["axes"])
    actor.network.requires_grad_(True)
    action, _ = actor.act(seen(4, make_rng(6)), None, make_rng(7))
    action.sum().backward()
    assert all(weight.grad is not None and weight.grad.abs().sum() > 0 for weight in actor.network.think.parameters())


def test_symlog_and_back() -> None:
    x = torch.tensor([-1e5, -3.0, -0.1, 0.0, 0.1, 3.0, 1e5], dtype=torch.float64)
    torch.testing.assert_close(symexp(symlog(x)), x)


@pytest.mark.parametrize("name", SPACES)
def test_what_is_saved_is_what_is_loaded(name: str, tmp_path) -> None:
    actor = actor_for(SPACES[name], ("state", "rgb"), greedy=True)
    actor.network.eyes.fit_normalization(seen(32, make_rng(8)))
    actor.card["what"] = "a toy"
    actor.save(tmp_path / "run" / "policy")
    again = Actor.load(tmp_path / "run", actor.spec)
    observation = seen(8, make_rng(9))
    assert torch.equal(actor.act(observation, None, make_rng(0))[0], again.act(observation, None, make_rng(0))[0])
    assert again.card == actor.card and again.sees == actor.sees
    assert not list(tmp_path.rglob("*.pkl")) and not list(tmp_path.rglob("*.partial"))


def test_what_does_not_fit_is_refused_in_a_sentence(tmp_path) -> None:
    actor = actor_for(SPACES["one choice"])
    actor.save(tmp_path / "policy")
    with pytest.raises(ActionError, match="is for other actions"):
        Actor.load(tmp_path / "policy", spec_of(spaces.Discrete(5, start=-1)))
    blind = Spec("blind", SPACES["one choice"], {"state": CHANNELS["state"]}, (), 0.1)
    with pytest.raises(ChannelError, match="sees 'speed', which blind lacks"):
        Actor.load(tmp_path / "policy", blind)
    other = Spec("wide", SPACES["one choice"], {**CHANNELS, "state": spaces.Box(0, 1, (4,))}, (), 0.1)
    with pytest.raises(ChannelError, match=r"of shape \(3,\), and wide shows \(4,\)"):
        Actor.load(tmp_path / "policy", other)
    with pytest.raises(ChannelError, match="lacks"):
        actor.act({"state": torch.zeros(1, 3)}, None, make_rng(0))
    with pytest.raises(ChannelError, match="map is neither"):
        ActorConfig.of(spec_of(SPACES["buttons"]), ("map",))
    with pytest.raises(ActionError, match="without limits"):
        ActorConfig.of(spec_of(spaces.Box(-np.inf, np.inf, (1,))), ("state",))


def test_what_is_no_policy_is_refused_in_a_sentence(tmp_path) -> None:
    spec = spec_of(SPACES["buttons"])
    with pytest.raises(CheckpointError, match=r"holds no policy\.json"):
        Actor.load(tmp_path, spec)
    actor_for(SPACES["buttons"]).save(tmp_path)
    (tmp_path / "weights.safetensors").write_bytes(b"short")
    with pytest.raises(CheckpointError, match="damaged"):
        Actor.load(tmp_path, spec)
    (tmp_path / "policy.json").write_text('{"kind": "planner", "version": 1}')
    with pytest.raises(CheckpointError, match="kind 'planner'"):
        Actor.load(tmp_path, spec)
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot be written"):
        actor_for(SPACES["buttons"]).save(tmp_path / "file" / "policy")


def test_a_policy_of_what_a_world_makes_of_things_acts_through_that_world(tmp_path) -> None:
    class Doubling:
        """A world that sees `state`, and shows its double, which the policy sees."""

        spec = Spec(
            "doubling", SPACES["axes"], {"state": CHANNELS["state"], "latent": CHANNELS["state"]}, ("state",), 0.1
        )

        def observe(self, observation, prior, rng):
            steps = torch.zeros(len(observation["state"])) if prior is None else prior["steps"]
            return State({"at": observation["state"], "steps": steps})

        def imagine(self, state, action, rng):
            return state.replace(steps=state["steps"] + 1)

        def render(self, state, channels):
            return {name: state["at"] * (2 if name == "latent" else 1) for name in channels}

    world, rng = Doubling(), make_rng(0)
    torch.manual_seed(0)
    actor = Actor(ActorNetwork(ActorConfig.of(world.spec, ("latent",), hidden=8)).requires_grad_(False), world.spec)
    actor.save(tmp_path)
    real = Spec("real", SPACES["axes"], CHANNELS, (), 0.1)
    policy = load_learned_policy(tmp_path, real, world)
    seen = {"state": torch.randn(3, 3)}
    memory = policy.begin(3, rng)
    for step in (1, 2):
        action, memory = act(policy, seen, memory, 3, real, rng)
        assert memory["steps"].tolist() == [step] * 3
    assert torch.equal(action, actor.act({"latent": 2 * seen["state"]}, None, rng)[0])
    with pytest.raises(ChannelError, match="sees 'latent', which real lacks"):
        load_learned_policy(tmp_path, real)
