"""Rolling a world forward under given actions or a policy, and what comes back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from .spec import shape_of
from .state import State
from .world import Observation, World

Policy = Callable[[Observation, torch.Generator], torch.Tensor]


@dataclass(frozen=True)
class Rollout:
    """T steps of B stories: `actions` [T, B, ...] led from observation t to t+1, so `observations` hold T+1 each."""

    observations: dict[str, torch.Tensor]  # name -> [T + 1, B, ...]
    actions: torch.Tensor  # [T, B, *action.shape]
    final: State


def rollout(
    world: World,
    state: State,
    actions: torch.Tensor | Policy,
    rng: torch.Generator,
    channels: Sequence[str],
    steps: int | None = None,
) -> Rollout:
    """Moves `state` through `actions` [T, B, ...], or for `steps` steps under a policy of the observation.

    Stories do not stop at `done`: mask by the `done` channel where it matters.
    """
    world.spec.check_channels(channels)
    policy = actions if callable(actions) else None
    given = None if callable(actions) else torch.as_tensor(actions)
    if (steps is None) == (given is None):
        raise ValueError("a rollout under a policy needs `steps`; one under given actions has as many steps as actions")
    total = len(given) if given is not None else steps or 0
    seen = [world.render(state, channels)]
    taken = []
    for step in range(total):
        action = policy(seen[-1], rng) if policy else given[step]
        state = world.imagine(state, action, rng)
        taken.append(torch.as_tensor(action))
        seen.append(world.render(state, channels))
    observations = {name: torch.stack([frame[name] for frame in seen]) for name in channels}
    none = torch.zeros((0, state.batch, *shape_of(world.spec.action)))
    return Rollout(observations, torch.stack(taken) if taken else none, state)
