"""GoalBeliefPolicy: a goal-conditioned policy that acts on a world's latent, without a search."""

from typing import final

import torch

from ...core.errors import PlanningError
from ...core.state import State
from ...core.world import Observation, World
from ..goal_network import GOAL, LATENT, GoalActor
from .costs import Cost

_GOAL, _MEMORY = "policy.goal", "policy.memory"


@final
class GoalBeliefPolicy:
    """The world folds observations into its state, and the policy acts on the latent of that towards the goal of `cost`, a latent
    (see `distance_to`). Its memory is the world's state and the goal. PlanningError for other goals."""

    def __init__(self, world: World, actor: GoalActor, cost: Cost):
        if set(cost.goal) != {LATENT}:
            raise PlanningError(
                f"a goal-conditioned policy needs a goal that {world.spec.name} can observe whole "
                f"({', '.join(world.spec.observes)}), and the goal is {', '.join(cost.goal) or 'the reward'}."
            )
        self.world, self.actor, self.cost = world, actor, cost
        self.sees = (*world.spec.observes, *world.spec.may_observe)

    def begin(self, batch: int, rng: torch.Generator) -> State:
        goal = torch.cat([self.cost.goal_of(entry, batch)[LATENT] for entry in range(batch)])
        return State({_GOAL: goal, _MEMORY: self.actor.begin(batch, rng).to(goal.device)})

    def act(self, observation: Observation, memory: State, rng: torch.Generator) -> tuple[torch.Tensor, State]:
        kept = {name: memory[name] for name in (_GOAL, _MEMORY)}
        before = {name: tensor for name, tensor in memory.items() if name not in kept}
        evidence = {name: observation[name] for name in self.sees if name in observation}
        state = self.world.observe(evidence, State(before, memory.arenas) if before else None, rng)
        seen = {**self.world.render(state, (LATENT,)), GOAL: kept[_GOAL]}
        action, _ = self.actor.act(seen, kept[_MEMORY], rng)
        after = self.world.imagine(state, action, rng)
        return action, State({**after, **kept}, after.arenas)
