"""SkillActor: a planner of skills that thinks when one ends, and a fast policy that acts at every step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import final

import torch

from ...core.instruction import bytes_to_text, text_to_bytes
from ...core.spec import TEXT as TEXT_SPACE
from ...core.spec import Spec
from ...core.state import State
from ...core.world import Observation
from ..imitation import ImitationActor
from ..imitation_network import TEXT
from .imagined import ALTERNATIVES, PlanRollouts
from .library import SkillLibrary
from .memory import SkillMemory
from .observed_goal import ObservedGoal
from .search import Groups, SkillSearch, undone

PATIENCE = 2.0  # times the usual longest duration, after which an instruction that is not done is planned anew
MOST_PLANS = 8  # of an episode; the last one is kept to
SURPRISE = 2.0  # spreads by which a forecast may differ from what came


@final
class SkillActor:
    """A Policy that reaches goals by the skills of a library, however unlikely its best plan is. goal: in words or an observation,
    for all episodes; None: the text that it is shown. rollouts: choose among plans in a world. ActionError or ChannelError if the
    library is for others, PlanningError for unknown words."""

    def __init__(
        self,
        library: SkillLibrary,
        spec: Spec,
        goal: str | ObservedGoal | None = None,
        rollouts: PlanRollouts | None = None,
    ):
        shown = spec if goal is None else replace(spec, channels={**spec.channels, TEXT: TEXT_SPACE})
        self.policy, self.library, self.goal = ImitationActor(library.network, shown), library, goal
        self.search, self.spec, self.rollouts = SkillSearch(library, least=0.0), spec, rollouts
        self._blank: State | None = None

    @property
    def sees(self) -> tuple[str, ...]:
        further = self.rollouts.world.spec.observes if self.rollouts else ()
        names = dict.fromkeys((*self.policy.sees, *further))
        return tuple(name for name in names if self.goal is None or name != TEXT)

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
        waypoints = fast["waypoints"].to(self.library.network.mean.device) if self.library.network.waypoints else None
        done = self.library.outlook(seen, texts, hidden, waypoints).done.cpu() > self.library.threshold
        memory = [replace(one, looks_done=(one.looks_done + 1) * over) for one, over in zip(memory, done.tolist())]
        each = [{name: value[row : row + 1] for name, value in seen.items()} for row in range(len(memory))]
        memory = [self._checked(self._thought(one, str(goal), now), now) for one, goal, now in zip(memory, goals, each)]
        texts = torch.stack([torch.tensor(text_to_bytes(one.text)) for one in memory])
        action, fast = self.policy.act({**seen, TEXT: texts}, State.stack([one.fast for one in memory]), rng)
        return action, [replace(one, fast=fast.at(row), steps=one.steps + 1) for row, one in enumerate(memory)]

    def _thought(self, one: SkillMemory, goal: str, seen: Observation) -> SkillMemory:
        """The memory before the next action: with a plan, and the instruction that is due."""
        if goal != one.goal:
            return self._begun(replace(one, goal=goal, groups=self._groups(goal, seen), plan=None), seen, goal)
        if one.plan is None or one.at == len(one.plan.steps):
            return one
        step, left = one.plan.steps[one.at], len(one.plan.steps) - one.at
        if one.looks_done >= self.library.hold and one.steps >= max(1, step.skill.least_steps):
            one = self._next(one, f"{step.text}: done after {one.steps} steps")
            if left == 1:
                return one
            due = one.plan.steps[one.at] if one.plan else step
            now = self.search.now(due.text, seen)
            if left > 2 and one.plans < MOST_PLANS and now.probability < due.probability - SURPRISE * due.spread - 0.05:
                why = f"'{due.text}' has {now.probability:.0%} here, {due.probability:.0%} was expected"
                return self._begun(one, seen, why)
        elif one.steps > PATIENCE * step.skill.most_steps and one.plans < MOST_PLANS:
            return self._begun(one, seen, f"'{step.text}' is not done after {one.steps} steps")
        return one

    def _checked(self, one: SkillMemory, seen: Observation) -> SkillMemory:
        """With an observation as the goal the plan is over once that is reached, and not before."""
        if not isinstance(self.goal, ObservedGoal) or one.plan is None:
            return one
        away, over = float(self.goal.distance(seen)[0]), len(one.plan.steps)
        if away <= self.goal.within:
            return one if one.finished else replace(one, at=over, events=(*one.events, f"reached, {away:.2f} away"))
        if not one.finished:
            return one
        if one.plans == MOST_PLANS:  # the last skill goes on
            return replace(one, at=over - 1, events=one.events[:-1])
        again = replace(one, groups=self._groups(one.goal, seen), plan=None)
        return self._begun(again, seen, f"still {away:.2f} away")

    def _groups(self, goal: str, seen: Observation) -> Groups:
        return (
            self.search.towards(self.goal, seen)
            if isinstance(self.goal, ObservedGoal)
            else self.search.instructions_of(goal)
        )

    def _next(self, one: SkillMemory, event: str) -> SkillMemory:
        assert self._blank is not None
        return replace(one, at=one.at + 1, steps=0, looks_done=0, fast=self._blank, events=(*one.events, event))

    def _begun(self, one: SkillMemory, seen: Observation, why: str) -> SkillMemory:
        """A new plan for what is left to do."""
        assert self._blank is not None
        groups = one.groups if one.plan is None else undone(one.plan, one.at, one.groups)
        plans = self.search.plans(groups, seen, ALTERNATIVES if self.rollouts else 1)
        plan = plans[0]
        if self.rollouts:
            fresh = replace(one, groups=groups, at=0, steps=0, fast=self._blank, plans=MOST_PLANS)
            plan = self.rollouts.best(plans, fresh, seen)
        shown = f"{plan}, {plan.probability:.0%} in all"
        shown += "" if plan.imagined is None else f", {plan.imagined:.0%} of its rollouts end"
        events = (*one.events, f"{why}: {shown}")
        return replace(
            one,
            groups=groups,
            plan=plan,
            at=0,
            steps=0,
            looks_done=0,
            fast=self._blank,
            plans=one.plans + 1,
            events=events,
        )
