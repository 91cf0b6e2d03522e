"""SkillMemory: what a SkillActor remembers of an episode."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.state import State
from .search import Groups, SkillPlan


@dataclass(frozen=True)
class SkillMemory:
    """What one episode is about."""

    goal: str
    groups: Groups  # what `plan` plans
    plan: SkillPlan | None  # None before the first observation
    at: int  # the step of the plan that is carried out
    steps: int  # actions since it began
    fast: State  # the memory of the policy
    plans: int = 0
    looks_done: int = 0  # observations in a row at which the instruction looks done
    events: tuple[str, ...] = ()  # what was planned, done and planned anew, for people

    @property
    def text(self) -> str:
        """The instruction that is carried out; the last one once all are done."""
        if self.plan is None:
            return self.goal
        return self.plan.steps[min(self.at, len(self.plan.steps) - 1)].text

    @property
    def finished(self) -> bool:
        """Whether all instructions are done."""
        return self.plan is not None and self.at == len(self.plan.steps)
