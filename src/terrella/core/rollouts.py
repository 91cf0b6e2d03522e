"""Rolling a world forward under a policy or given actions, and what comes back."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from .policy import Policy, Replay, act
from .spec import shape_of
from .state import State
from .world import Leaping, World


def advanced(world: World, state: State, actions: torch.Tensor, rng: torch.Generator) -> State:
    """The state after actions [B, T, *action.shape], in leaps as far as the world has them: of it the channel `latent` counts."""
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
    """T steps of B episodes: `actions` [T, B, ...] led from observation t to t+1, so `observations` hold T+1 each."""

    observations: dict[str, torch.Tensor]  # name -> [T + 1, B, ...]
    actions: torch.Tensor  # [T, B, *action.shape]
    final: State


def rollout(
    world: World,
    state: State,
    policy: Policy | torch.Tensor,
    rng: torch.Generator,
    channels: Sequence[str],
    steps: int | None = None,
    gradients: bool = False,
) -> Rollout:
    """Moves `state` for `steps` steps under a policy that sees `channels`, or through actions [T, B, ...].

    Nothing but `channels` is rendered: a world that draws on demand draws no picture that nobody asked for. Episodes do not
    stop at `done`: mask by the `done` channel where it matters. With `gradients` they flow, as far as the world lets them.
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
