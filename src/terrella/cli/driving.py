"""Who drives on the page when a person lets it: an agent by its name, or the one that suits the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from .. import library
from ..act.explorer import Explorer
from ..act.planning import Planner, Revealed, imagined, negative_reward, paced, tells_apart
from ..core.errors import PlanningError
from ..core.state import State
from ..core.world import Observation, World, make_rng
from ..serve.agent import Agent, Agents, Futures

_REPLAN_S = 0.06  # of world time, in which a plan is acted on before the next is made
_SHOWN = ("pose", "keyframes")  # beside what a planner's world observes: what ways are found by


@dataclass(frozen=True)
class Driving:
    """played: the world on the page; learned: the one to plan in where that is another (--compare); name: the agent's, "" for the
    one that suits; budget_ms: what a decision may take."""

    played: World
    learned: World | None = None
    name: str = ""
    budget_ms: float = 30.0

    def agents(self) -> Agents:
        return Agents(self.make)

    def make(self, goal: Observation) -> Agent:
        """The agent that drives, to a goal or, with {}, as its name says."""
        if self.name == "":
            return self._planning(always=False) or Agent("the explorer", Explorer(self.played.spec))
        if self.name == "plan":
            found = self._planning(always=True)
            if found is None:
                raise PlanningError(f"{self.played.spec.name} cannot be planned in for reward; set a goal.")
            return found
        policy = library.load_policy(self.name, self.played.spec, self.world)
        if not isinstance(policy, Planner):
            return Agent(self.name, policy)
        return Agent(self.name, policy, self.see, futures=self._futures(policy))

    # -- where it plans -----------------------------------------------------------------------------------------------

    @cached_property
    def world(self) -> World | None:
        """In which futures are imagined: the world that is played itself, from where it stands, or the one beside it. None for a
        game that can neither be copied nor was learned."""
        if self.learned is not None:
            return self.learned
        return Revealed(self.played, here=True) if self.played.spec.forkable else None

    def see(self, state: State) -> Observation:
        """What a planner is shown of a state of the world that is played."""
        if self.learned is None and self.world is not None:
            spec = self.world.spec
            return self.world.render(state, [*spec.observes, *(name for name in _SHOWN if name in spec.channels)])
        spec, shown = self.played.spec, (self.learned or self.played).spec
        names = dict.fromkeys((*shown.observes, *shown.may_observe, *_SHOWN))
        return self.played.render(state, [name for name in names if name in spec.channels])

    # -- agents -------------------------------------------------------------------------------------------------------

    def _planning(self, always: bool) -> Agent | None:
        """A planner for reward; unless `always`, None where that takes too long here, or where all plans bring the same."""
        world = self.world
        if world is None or "reward" not in world.spec.channels:
            return None
        cost, state = negative_reward(world.spec), self._first(world)
        config, fits = paced(world, cost, state, self.budget_ms)
        if not always and not (fits and tells_apart(world, cost, state)):
            return None
        moves = max(1, round(_REPLAN_S / (world.spec.dt_s * config.block)))
        planner = Planner(world, cost, config, replan=min(moves, config.horizon))
        return Agent("a planner, for reward", planner, self.see, futures=self._futures(planner))

    def _futures(self, planner: Planner) -> Callable[[Any], Futures] | None:
        """How a planner's memory becomes pictures, where its world shows any."""
        if "rgb" not in planner.world.spec.channels:
            return None
        world, cost, block = planner.world, planner.cost, planner.config.block
        return lambda memory: imagined(world, cost, memory[0], block)

    def _first(self, world: World) -> State:
        """A state in which episodes begin, to time the world with."""
        return world.start(1, make_rng(0))
