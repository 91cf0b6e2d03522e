"""Who acts in a timeline: the person at the page, or an agent that they let drive until they touch the controls."""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections import deque
from collections.abc import Sequence
from typing import Any

import torch

from ..core.errors import ServeError, TerrellaError
from ..core.policy import act
from ..core.spec import Spec
from ..core.state import State
from ..core.world import Observation, World
from .actions import action_of
from .agent import Agent, Agents, Futures, seen_by

NO_GOAL: dict[str, object] = {"at": None, "image": None, "words": None}
_NEARER = 0.97  # of the least distance so far counts as nearer


class Driver:
    """One timeline's. What an agent raises never stops the world: it is told in a sentence, and the person drives."""

    def __init__(self, agents: Agents | None, world: World):
        self.agents, self.world, self.spec = agents, world, world.spec
        self.on = agents is not None and agents.at_once
        self.goal: Observation = {}
        self.mark: dict[str, object] = NO_GOAL
        self.said = ""  # the last thing to know of the agent, in one sentence
        self.away: float | None = None  # from the goal, when it last acted
        self.acted: torch.Tensor | None = None  # its action of the last step; None where the person acted
        self._agent: Agent | None = None
        self._rest = action_of(self.spec)
        self._ms: deque[float] = deque(maxlen=32)
        self._futures: Futures | None = None
        self.forget()

    @property
    def name(self) -> str:
        """Of the agent; "" while nobody knows which it will be."""
        return self._agent.name if self._agent else ""

    def described(self) -> dict[str, object]:
        """For the page (protocol.encode_event): rounded, so that it changes seldom."""
        longest = sorted(self._ms)[int(0.9 * (len(self._ms) - 1))] if self._ms else 0.0
        return {
            "driving": self.on,
            "name": self.name,
            "said": self.said,
            "thinks_ms": float(f"{longest:.1g}"),
            "away": None if self.away is None else float(f"{self.away:.2g}"),
            "unit": self._agent.unit if self._agent else "",
            "considers": bool(self._agent and self._agent.futures),
        }

    # -- what a person says -------------------------------------------------------------------------------------------

    def let(self, on: bool) -> None:
        """The agent drives from now on, or the person does."""
        self.said = ""
        if on and self.agents is None:
            self.said = "there is no agent here to drive."
        elif on != self.on:
            self.on = on
            self.forget()

    def seek(self, goal: Observation, mark: dict[str, object] | None = None, now: bool = True) -> None:
        """Takes a goal, {} for none, and drives to it `now`, or when it is let. mark: how the page shows it."""
        if goal and self.agents is None:
            raise ServeError("there is no agent here that could seek a goal.")
        self.goal, self.mark, self._agent, self.away = goal, NO_GOAL | (mark or {}), None, None
        self._ms.clear()
        self.forget()
        self.said, self.on = "", bool(goal) and now

    def forget(self) -> None:
        """What the agent remembers is of another episode or moment."""
        self._memory: Any = None
        self._begun = False
        self._futures = None
        self._best, self._since = float("inf"), 0

    def consider(self) -> Sequence[tuple[float, torch.Tensor]] | None:
        """A piece of the work of imagining what the agent considers; the futures where that was the last."""
        if self._agent is None or self._agent.futures is None or not self._begun:
            return None
        if self._futures is None:
            self._futures = self._agent.futures(self._memory)
        found = next(self._futures, ())
        self._futures = self._futures if found is None else None
        return found or None

    # -- each step ----------------------------------------------------------------------------------------------------

    def action(
        self, keys: Spec, held: Sequence[str], axes: Sequence[float], state: State, rng: torch.Generator
    ) -> torch.Tensor:
        """The action [1, ...] of this step: the person's where they touch the controls, who then drives; else the agent's while
        it does. keys: the spec whose keys they press."""
        asked, self.acted = action_of(keys, held, axes), None
        if not self.on or self.agents is None:
            return asked
        if any(code in keys.keys for code in held) or not torch.equal(asked, self._rest):
            if not self.agents.at_once:
                self.stop("")
            return asked
        try:
            return self._chosen(self.agents, state, rng)
        except Exception as error:  # a policy is a stranger's code
            reason = str(error)
            if not isinstance(error, TerrellaError):
                traceback.print_exc(file=sys.stderr)
                reason = f"{type(error).__name__}: {error}."
            self._end(f"the agent stopped: {reason} You drive.")
            return asked

    def stop(self, said: str) -> None:
        """The person drives from now on, for this reason."""
        self.on, self.said, self.acted = False, said, None
        self.forget()

    def _end(self, said: str) -> None:
        """The agent is done. With a place and an instruction, too; a picture stays the goal until it is taken away."""
        if self.mark["at"] is not None or self.mark["words"]:
            self.seek({})
        self.stop(said)

    def _chosen(self, agents: Agents, state: State, rng: torch.Generator) -> torch.Tensor:
        if self._agent is None:
            self._agent = agents.make(self.goal)
        agent = self._agent
        if agent.away is not None and self._arrived(agent, agent.away(state)):
            return self._rest
        began = time.perf_counter()
        if not self._begun:
            self._memory, self._begun = agent.policy.begin(1, rng), True
        action, self._memory = act(agent.policy, seen_by(agent, self.world, state), self._memory, 1, self.spec, rng)
        self.acted = self.spec.check_action(action, 1)
        self._ms.append(1e3 * (time.perf_counter() - began))
        return self.acted

    def _arrived(self, agent: Agent, away: float) -> bool:
        """Whether there is no more to do: the goal is reached, or it has not come nearer for long."""
        if not math.isfinite(away):
            self._end(f"{self.spec.name} cannot say how far the goal is from here. You drive.")
            return True
        self.away = away
        told = f"{away:.1f} {agent.unit}" if agent.unit else f"{away:.3f}"
        if away <= agent.near:
            self._end(f"reached: {told} from the goal. You drive.")
            return True
        self._since += 1
        if away < _NEARER * self._best:
            self._best, self._since = away, 0
        elif self._since * self.spec.dt_s > agent.patience_s:
            best = f"{self._best:.1f} {agent.unit}" if agent.unit else f"{self._best:.3f}"
            self._end(f"the goal cannot be reached from here: {best} is the nearest that the agent came. You drive.")
            return True
        return False
