"""What a page is handed so that somebody else may drive: policies with a name, what they are to reach, and what they consider."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..core.policy import Policy
from ..core.state import State
from ..core.world import Observation, World

# What plans would lead to: of each its cost, and pictures uint8 [T, H, W, 3], evenly spread in time. In pieces, so that a stream
# can go on between them: None while it is not finished.
Futures = Iterator[Sequence[tuple[float, torch.Tensor]] | None]


@dataclass(frozen=True)
class Agent:
    """A policy that may drive.

    name:    for people.
    see:     what it observes of a state of the played world; None for all that a recording would hold.
    away:    how far a state is from the goal, in `unit`; None where it has no goal. near: where it counts as reached.
    futures: the policy's memory -> the futures that it considered last; None for a policy that considers none.
    patience_s: of the world, within which it must have come nearer to its goal, or it gives up.
    """

    name: str
    policy: Policy
    see: Callable[[State], Observation] | None = None
    away: Callable[[State], float] | None = None
    near: float = 0.0
    unit: str = ""
    futures: Callable[[Any], Futures] | None = None
    patience_s: float = 12.0


@dataclass(frozen=True)
class Agents:
    """make:     the agent for a goal, channel -> [1, ...]; {} for none. TerrellaError for a goal that none can seek.
    places:   it takes goals {"pose": x, y, and NaN for the rest}. pictures: goals that hold a picture, alone or with all
              else that the world showed with it.
    words:    an instruction that somebody types -> a goal; TerrellaError for words that say nothing that can be sought.
    at_once:  it drives from the beginning, and again as soon as a person lets go of the controls; others must be let.
    """

    make: Callable[[Observation], Agent]
    places: bool = False
    pictures: bool = False
    words: Callable[[str], Observation] | None = None
    at_once: bool = False


def agents_of(policy: Policy | Agents | None) -> Agents | None:
    """A lone policy drives from the beginning, whenever nobody touches the controls."""
    if policy is None or isinstance(policy, Agents):
        return policy
    return Agents(lambda goal: Agent(type(policy).__name__.lower(), policy), at_once=True)


def seen_by(agent: Agent, world: World, state: State) -> Observation:
    return agent.see(state) if agent.see else world.render(state, world.spec.recorded)
