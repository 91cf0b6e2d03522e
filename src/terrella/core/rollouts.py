"""rollout: steps a world under a policy or given actions, and collects its observations."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from .policy import Policy, Replay, act
from .spec import shape_of
from .state import State
from .world import Leaping, World


def advance(world: World, state: State, actions: torch.Tensor, rng: torch.Generator) -> State:
    """The state after actions [B, T, *action.shape], by leaps where the world has them; only its channel `latent` is defined."""
    at, steps = 0, actions.shape[1]
    while at < steps:
        if world.spec.leap and steps - at >= world.spec.leap and isinstance(world, Leaping):
            state = world.leap(state, actions[:, at : at + world.spec.leap], rng)
            at += world.spec.leap
        else:
            state = world.imagine(state, actions[:, at], rng)
            at += 1
    return state


@dataclass(frozen=True)
class Rollout:
    """T steps of B episodes; action t leads from observation t to observation t + 1."""

    observations: dict[str, torch.Tensor]  # name -> [T + 1, B, ...]
    actions: torch.Tensor  # [T, B, *action.shape]
    final: State  # after the last action


def rollout(
    world: World,
    state: State,
    policy: Policy | torch.Tensor,
    rng: torch.Generator,
    channels: Sequence[str],
    steps: int | None = None,
    gradients: bool = False,
) -> Rollout:
    """Steps `state` under a policy for `steps` steps, or through given actions [T, B, *action.shape].

    Only `channels` are rendered, for the policy and for the result. Episodes go on after `done`: mask with the channel
    `done` where that matters. `gradients=True` keeps the graph, as far as the world is differentiable.
    ChannelError for unknown channels; ContractError where the policy gives an action of another shape.
    """
    world.spec.check_channels(channels)
    if isinstance(policy, Policy):
        if steps is None:
            raise ValueError("a rollout under a policy needs `steps`")
    elif steps is not None:
        raise ValueError("a rollout under given actions has as many steps as actions; leave `steps` out")
    else:
        policy = Replay(policy)
        steps = len(policy.actions)
    seen, taken = [], []
    with nullcontext() if gradients else torch.no_grad():
        seen.append(world.render(state, channels))
        memory = policy.begin(state.batch, rng)
        for _ in range(steps):
            action, memory = act(policy, seen[-1], memory, state.batch, world.spec, rng)
            state = world.imagine(state, action, rng)
            taken.append(action)
            seen.append(world.render(state, channels))
        observations = {name: torch.stack([frame[name] for frame in seen]) for name in channels}
    none = torch.zeros((0, state.batch, *shape_of(world.spec.action)))
    return Rollout(observations, torch.stack(taken) if taken else none, state)
