"""Agents that may drive in place of the person at the page: policies with a name, a goal, and the futures that they consider."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..core.policy import Policy
from ..core.state import State
from ..core.world import Observation, World

# The predicted outcome of plans: for each its cost, and pictures uint8 [T, H, W, 3], evenly spread in time. It is computed in
# pieces, so that the stream of frames goes on between them: None while it is not finished.
Futures = Iterator[Sequence[tuple[float, torch.Tensor]] | None]


@dataclass(frozen=True)
class Agent:
    """A policy that may drive."""

    name: str  # for people
    policy: Policy
    see: Callable[[State], Observation] | None = (
        None  # its observation of a state; default: the channels of a recording
    )
    away: Callable[[State], float] | None = (
        None  # the distance of a state from the goal, in `unit`; None without a goal
    )
    near: float = 0.0  # the distance at which the goal counts as reached
    unit: str = ""
    futures: Callable[[Any], Futures] | None = None  # from the policy's memory, the futures that it considered last
    patience_s: float = 12.0  # it gives up if it has come no nearer to its goal in this time of the world


@dataclass(frozen=True)
class Agents:
    """Makes the agents of a page, and says which goals they take."""

    make: Callable[
        [Observation], Agent
    ]  # for a goal, channel -> [1, ...], {} for none; TerrellaError if none can seek it
    places: bool = False  # whether goals may be places: {"pose": x, y, and NaN for the rest}
    pictures: bool = False  # whether goals may be pictures, alone or with the other channels of their moment
    words: Callable[[str], Observation] | None = None  # from an instruction to a goal, or TerrellaError
    at_once: bool = False  # drives from the beginning, and whenever the person lets go; else the person must turn it on


def agents_of(policy: Policy | Agents | None) -> Agents | None:
    """Agents of a lone policy, which drives from the beginning, whenever nobody touches the controls."""
    if policy is None or isinstance(policy, Agents):
        return policy
    return Agents(lambda goal: Agent(type(policy).__name__.lower(), policy), at_once=True)


def seen_by(agent: Agent, world: World, state: State) -> Observation:
    return agent.see(state) if agent.see else world.render(state, world.spec.recorded)
