"""rollout: the same as calling the verbs by hand, under given actions or a policy."""

from __future__ import annotations

import pytest
import torch

from terrella.core import make_rng, rollout
from terrella.core.errors import ChannelError
from terrella.core.policy import Idle, Reactive
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld

CHANNELS = ("observation", "reward", "done")


@pytest.fixture(scope="module")
def pendulum():
    return GymnasiumWorld("Pendulum-v1", GymnasiumConfig(rgb=False))


def test_given_actions_lead_from_each_observation_to_the_next(pendulum):
    rng = make_rng(0)
    start = pendulum.start(2, rng)
    actions = torch.stack([pendulum.spec.sample_action(2, rng) for _ in range(5)])
    rolled = rollout(pendulum, start, actions, make_rng(1), CHANNELS)
    assert rolled.observations["observation"].shape == (6, 2, 3) and rolled.observations["reward"].shape == (6, 2)
    assert torch.equal(rolled.actions, actions)
    state, by_hand = start, make_rng(1)
    for step in range(5):
        assert torch.equal(rolled.observations["observation"][step], state["observation"])
        state = pendulum.imagine(state, actions[step], by_hand)
    assert rolled.final == state


def test_a_policy_sees_the_observation_that_it_acts_on(pendulum):
    seen = []

    def policy(observation, rng):
        seen.append(observation["observation"])
        return -observation["observation"][:, 2:].clamp(-1, 1)

    start = pendulum.start(3, make_rng(0))
    rolled = rollout(pendulum, start, Reactive(policy), make_rng(1), ("observation",), steps=4)
    assert rolled.actions.shape == (4, 3, 1)
    assert torch.equal(torch.stack(seen), rolled.observations["observation"][:-1])
    again = rollout(pendulum, pendulum.start(3, make_rng(0)), rolled.actions, make_rng(1), ("observation",))
    assert torch.equal(again.observations["observation"], rolled.observations["observation"])


def test_no_steps_are_a_rollout_too(pendulum):
    start = pendulum.start(2, make_rng(0))
    rolled = rollout(pendulum, start, torch.zeros(0, 2, 1), make_rng(1), CHANNELS)
    assert rolled.final == start and rolled.actions.shape == (0, 2, 1) and rolled.observations["done"].shape == (1, 2)


def test_what_cannot_be_rolled_out_is_refused(pendulum):
    start = pendulum.start(1, make_rng(0))
    with pytest.raises(ChannelError):
        rollout(pendulum, start, torch.zeros(1, 1, 1), make_rng(1), ("depth",))
    with pytest.raises(ValueError, match="steps"):
        rollout(pendulum, start, Idle(pendulum.spec), make_rng(1), CHANNELS)
    with pytest.raises(ValueError, match="steps"):
        rollout(pendulum, start, torch.zeros(1, 1, 1), make_rng(1), CHANNELS, steps=1)
