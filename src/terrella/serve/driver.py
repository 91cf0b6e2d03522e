"""Who acts in a timeline: the person at the page, or an agent that drives until the person touches the controls."""

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
_NEARER = 0.97  # a distance below this share of the smallest so far counts as progress


class Driver:
    """The driver of one timeline. An exception of an agent never stops the world: the page shows it, and the person drives."""

    def __init__(self, agents: Agents | None, world: World):
        self.agents, self.world, self.spec = agents, world, world.spec
        self.on = agents is not None and agents.at_once
        self.goal: Observation = {}
        self.mark: dict[str, object] = NO_GOAL
        self.notice = ""  # the latest news of the agent, in one sentence
        self.away: float | None = None  # distance from the goal when it last acted
        self.acted: torch.Tensor | None = None  # its action in the last step; None if the person acted
        self._agent: Agent | None = None
        self._rest = action_of(self.spec)
        self._ms: deque[float] = deque(maxlen=32)
        self._futures: Futures | None = None
        self.forget()

    @property
    def name(self) -> str:
        """The name of the agent; "" before it was made."""
        return self._agent.name if self._agent else ""

    def described(self) -> dict[str, object]:
        """For the page (protocol.encode_event), rounded so that it changes seldom."""
        longest = sorted(self._ms)[int(0.9 * (len(self._ms) - 1))] if self._ms else 0.0
        return {
            "driving": self.on,
            "name": self.name,
            "said": self.notice,
            "thinks_ms": float(f"{longest:.1g}"),
            "away": None if self.away is None else float(f"{self.away:.2g}"),
            "unit": self._agent.unit if self._agent else "",
            "considers": bool(self._agent and self._agent.futures),
        }

    # -- commands of the person ---------------------------------------------------------------------------------------

    def let(self, on: bool) -> None:
        """Lets the agent drive from now on, or the person."""
        self.notice = ""
        if on and self.agents is None:
            self.notice = "there is no agent here to drive."
        elif on != self.on:
            self.on = on
            self.forget()

    def seek(self, goal: Observation, mark: dict[str, object] | None = None, now: bool = True) -> None:
        """Takes a goal, {} for none, and drives to it `now`, or once it may drive. mark: the goal as the page shows it."""
        if goal and self.agents is None:
            raise ServeError("there is no agent here that could seek a goal.")
        self.goal, self.mark, self._agent, self.away = goal, NO_GOAL | (mark or {}), None, None
        self._ms.clear()
        self.forget()
        self.notice, self.on = "", bool(goal) and now

    def forget(self) -> None:
        """Clears the agent's memory, which belongs to another episode or moment."""
        self._memory: Any = None
        self._begun = False
        self._futures = None
        self._best, self._since = float("inf"), 0

    def consider(self) -> Sequence[tuple[float, torch.Tensor]] | None:
        """Imagines another piece of the futures that the agent considers; returns them when they are complete."""
        if self._agent is None or self._agent.futures is None or not self._begun:
            return None
        if self._futures is None:
            self._futures = self._agent.futures(self._memory)
        futures = next(self._futures, ())
        self._futures = self._futures if futures is None else None
        return futures or None

    # -- each step ----------------------------------------------------------------------------------------------------

    def action(
        self, keys: Spec, held: Sequence[str], axes: Sequence[float], state: State, rng: torch.Generator
    ) -> torch.Tensor:
        """The action [1, ...] of this step: the person's if they touch the controls, which ends the agent's drive; else the agent's
        while it drives. keys: the spec whose keys the person presses."""
        manual, self.acted = action_of(keys, held, axes), None
        if not self.on or self.agents is None:
            return manual
        if any(code in keys.keys for code in held) or not torch.equal(manual, self._rest):
            if not self.agents.at_once:
                self.stop("")
            return manual
        try:
            return self._chosen(self.agents, state, rng)
        except Exception as error:  # a policy is a stranger's code
            reason = str(error)
            if not isinstance(error, TerrellaError):
                traceback.print_exc(file=sys.stderr)
                reason = f"{type(error).__name__}: {error}."
            self._end(f"the agent stopped: {reason} You drive.")
            return manual

    def stop(self, reason: str) -> None:
        """Lets the person drive from now on."""
        self.on, self.notice, self.acted = False, reason, None
        self.forget()

    def _end(self, reason: str) -> None:
        """Ends the agent's drive. A place or an instruction stops being the goal; a picture stays until it is removed."""
        if self.mark["at"] is not None or self.mark["words"]:
            self.seek({})
        self.stop(reason)

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
        """Whether the drive is over: the goal is reached, or has not come nearer for long."""
        if not math.isfinite(away):
            self._end(f"{self.spec.name} cannot say how far the goal is from here. You drive.")
            return True
        self.away = away
        if away <= agent.near:
            self._end(f"reached: {_distance(away, agent)} from the goal. You drive.")
            return True
        self._since += 1
        if away < _NEARER * self._best:
            self._best, self._since = away, 0
        elif self._since * self.spec.dt_s > agent.patience_s:
            best = _distance(self._best, agent)
            self._end(f"the goal cannot be reached from here: the agent came no nearer than {best}. You drive.")
            return True
        return False


def _distance(away: float, agent: Agent) -> str:
    """A distance from the goal, for people."""
    return f"{away:.1f} {agent.unit}" if agent.unit else f"{away:.3f}"
