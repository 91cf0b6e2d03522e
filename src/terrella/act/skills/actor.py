"""SkillActor: a planner of skills that thinks when one ends, and a fast policy that acts at every step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import torch

from ...core.instruction import bytes_to_text, text_to_bytes
from ...core.spec import TEXT as TEXT_SPACE
from ...core.spec import Spec
from ...core.state import State
from ...core.world import Observation
from ..imitation import ImitationActor
from ..imitation_network import TEXT
from .library import SkillLibrary
from .search import Groups, SkillPlan, SkillSearch, undone

PATIENCE = 2.0  # times the usual longest duration, after which an instruction that is not done is planned anew
MOST_PLANS = 8  # of an episode; the last one is kept to
SURPRISE = 2.0  # spreads by which a forecast may differ from what came


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
    events: tuple[str, ...] = ()  # what was planned, done and planned anew, for people

    @property
    def text(self) -> str:
        """The instruction that is carried out; the last one once all are done."""
        if self.plan is None:
            return self.goal
        return self.plan.steps[min(self.at, len(self.plan.steps) - 1)].text


@final
class SkillActor:
    """A Policy that reaches goals in words by the skills of a library, however unlikely its best plan is. goal: for all episodes;
    None: the text that it is shown. ActionError or ChannelError if the library is for others, PlanningError for unknown words."""

    def __init__(self, library: SkillLibrary, spec: Spec, goal: str | None = None):
        shown = spec if goal is None else replace(spec, channels={**spec.channels, TEXT: TEXT_SPACE})
        self.policy, self.library, self.goal = ImitationActor(library.network, shown), library, goal
        self.search, self.spec = SkillSearch(library, least=0.0), spec
        self._blank: State | None = None

    @property
    def sees(self) -> tuple[str, ...]:
        return tuple(name for name in self.policy.sees if self.goal is None or name != TEXT)

    def unknown(self, text: str) -> tuple[str, ...]:
        """The words of a goal that it does not know."""
        return self.policy.unknown(text)

    def begin(self, batch: int, rng: torch.Generator) -> list[SkillMemory]:
        self._blank = self.policy.begin(1, rng)
        return [SkillMemory("", (), None, 0, 0, self._blank) for _ in range(batch)]

    @torch.no_grad()
    def act(
        self, observation: Observation, memory: Sequence[SkillMemory], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[SkillMemory]]:
        seen = {name: observation[name] for name in self.sees if name != TEXT}
        goals = [self.goal] * len(memory)
        if self.goal is None:
            goals = [bytes_to_text(row.numpy()) for row in observation[TEXT].cpu()]
        fast, texts = State.stack([one.fast for one in memory]), [one.text for one in memory]
        hidden = fast["features"][:, 0].to(self.library.network.mean.device) if self.library.network.memory else None
        done = self.library.outlook(seen, texts, hidden).done.cpu() > self.library.threshold
        memory = [
            self._thought(one, str(goal), bool(over), {name: value[row : row + 1] for name, value in seen.items()})
            for row, (one, goal, over) in enumerate(zip(memory, goals, done.tolist()))
        ]
        texts = torch.stack([torch.tensor(text_to_bytes(one.text)) for one in memory])
        action, fast = self.policy.act({**seen, TEXT: texts}, State.stack([one.fast for one in memory]), rng)
        return action, [replace(one, fast=fast.at(row), steps=one.steps + 1) for row, one in enumerate(memory)]

    def _thought(self, one: SkillMemory, goal: str, done: bool, seen: Observation) -> SkillMemory:
        """The memory before the next action: with a plan, and the instruction that is due."""
        if goal != one.goal:
            return self._begun(replace(one, goal=goal, groups=self.search.instructions_of(goal), plan=None), seen, goal)
        if one.plan is None or one.at == len(one.plan.steps):
            return one
        step, left = one.plan.steps[one.at], len(one.plan.steps) - one.at
        if done and one.steps >= max(1, step.skill.least_steps):
            one = self._next(one, f"{step.text}: done after {one.steps} steps")
            if left == 1:
                return one
            due = one.plan.steps[one.at] if one.plan else step
            now = self.search.now(due.text, seen)
            if left > 2 and now.probability < due.probability - SURPRISE * due.spread - 0.05:
                why = f"'{due.text}' has {now.probability:.0%} here, {due.probability:.0%} was expected"
                return self._begun(one, seen, why)
        elif one.steps > PATIENCE * step.skill.most_steps and one.plans < MOST_PLANS:
            return self._begun(one, seen, f"'{step.text}' is not done after {one.steps} steps")
        return one

    def _next(self, one: SkillMemory, event: str) -> SkillMemory:
        assert self._blank is not None
        return replace(one, at=one.at + 1, steps=0, fast=self._blank, events=(*one.events, event))

    def _begun(self, one: SkillMemory, seen: Observation, why: str) -> SkillMemory:
        """A new plan for what is left to do."""
        assert self._blank is not None
        groups = one.groups if one.plan is None else undone(one.plan, one.at, one.groups)
        plan = self.search.plan(groups, seen)
        events = (*one.events, f"{why}: {plan}, {plan.probability:.0%} in all")
        return replace(
            one, groups=groups, plan=plan, at=0, steps=0, fast=self._blank, plans=one.plans + 1, events=events
        )
