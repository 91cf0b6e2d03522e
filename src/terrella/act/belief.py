"""BeliefPolicy: a policy that acts on a world's state, folded from the observations of an environment."""

from pathlib import Path
from typing import final

import torch

from ..core.errors import ChannelError, PlanningError
from ..core.policy import Policy
from ..core.spec import Spec
from ..core.state import State
from ..core.world import Observation, World
from . import imitation
from .actor import Actor
from .goal_network import KIND, GoalActor
from .imitation import ImitationActor
from .lerobot_policy import LEROBOT, LerobotPolicy, kind_of_policy
from .planning import Cost, GoalBeliefPolicy
from .skills.actor import SkillActor
from .skills.library import KIND as SKILLS
from .skills.library import SkillLibrary


@final
class BeliefPolicy:
    """The world folds observations into its state, and the policy is shown channels rendered from that. Its memory is the state."""

    def __init__(self, world: World, actor: Actor):
        self.world, self.actor = world, actor
        self.sees = (*world.spec.observes, *world.spec.may_observe)

    def begin(self, batch: int, rng: torch.Generator) -> None:
        return None

    def act(self, observation: Observation, memory: State | None, rng: torch.Generator) -> tuple[torch.Tensor, State]:
        evidence = {name: observation[name] for name in self.sees if name in observation}
        state = self.world.observe(evidence, memory, rng)
        action, _ = self.actor.act(self.world.render(state, self.actor.sees), None, rng)
        return action, self.world.imagine(state, action, rng)


def load_learned_policy(folder: str | Path, spec: Spec, world: World | None = None, cost: Cost | None = None) -> Policy:
    """The learned policy of a folder, ours or LeRobot's, for the actions of `spec`. One that sees channels which only `world` has
    acts through the world; a goal-conditioned one acts towards the goal of `cost`. ActionError, ChannelError or PlanningError if
    it does not fit."""
    kind = kind_of_policy(folder)
    if kind == LEROBOT:
        return LerobotPolicy.load(folder, spec)
    if kind == imitation.KIND:
        return ImitationActor.load(folder, spec)
    if kind == SKILLS:
        return SkillActor(SkillLibrary.load(folder), spec)
    if kind == KIND:
        if world is None or cost is None:
            raise PlanningError(
                f"{folder} is a goal-conditioned policy: it needs the world that it was learned in, and a goal."
            )
        return GoalBeliefPolicy(world, GoalActor.load(folder, world.spec), cost)
    try:
        return Actor.load(folder, spec)
    except ChannelError:
        if world is None:
            raise
    missing = [name for name in world.spec.observes if name not in spec.channels]
    if missing:
        raise ChannelError(f"{world.spec.name} observes {', '.join(missing)}, which {spec.name} lacks.")
    return BeliefPolicy(world, Actor.load(folder, world.spec))
