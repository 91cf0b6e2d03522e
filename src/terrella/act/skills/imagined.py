"""Plans of skills, rolled out in a world: the fast policy carries each out there, and the one that ends most often is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from ...core.policy import Policy, observed_channels
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .memory import SkillMemory
from .search import SkillPlan

ALTERNATIVES = 4  # plans that are rolled out, the likeliest ones


@dataclass(frozen=True)
class PlanRollouts:
    """Judges plans by `draws` rollouts each in a world that observes where the episode is."""

    world: World
    actor: Policy  # a SkillActor for the channels of the world
    draws: int
    seed: int = 0

    def best(self, plans: Sequence[SkillPlan], memory: SkillMemory, seen: Observation) -> SkillPlan:
        """The plan that ends most often, of those the likeliest; `memory` as it would be with each."""
        judged = [self._judged(plan, replace(memory, plan=plan), seen) for plan in plans]
        return max(judged, key=lambda plan: (plan.imagined or 0.0, plan.probability))

    @torch.no_grad()
    def _judged(self, plan: SkillPlan, memory: SkillMemory, seen: Observation) -> SkillPlan:
        rng, sees = make_rng(self.seed), observed_channels(self.actor, self.world.spec)
        observed = {name: seen[name] for name in self.world.spec.observes}
        state = State.stack([self.world.observe(observed, None, rng)] * self.draws)
        _, memories = self.actor.begin(1, rng), [memory] * self.draws
        finished = torch.zeros(self.draws, dtype=torch.bool)
        for _ in range(sum(step.skill.most_steps for step in plan.steps) + 1):
            action, memories = self.actor.act(self.world.render(state, sees), memories, rng)
            finished |= torch.tensor([one.finished for one in memories])
            if finished.all():
                break
            state = self.world.imagine(state, action, rng)
        return replace(plan, imagined=float(finished.float().mean()))
