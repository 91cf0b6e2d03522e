"""BestOf: acts on the best of several plans of a policy, by what a world imagines of them (inference-time scaling)."""

from typing import Any, final

import torch

from ..core.errors import PlanningError
from ..core.policy import Policy, act, observed_channels
from ..core.state import State
from ..core.world import Observation, World
from . import imitation
from .actor import KIND as ACTOR
from .actor import Actor
from .imitation import ImitationActor
from .lerobot_policy import kind_of_policy
from .planning import SuccessCriterion
from .planning.costs import ENDS, survival_after

HORIZON, REPLAN = 24, 4  # steps of a plan, and of these executed before the next
_LEFT, _QUEUE, _POLICY = "best.left", "best.queue", "best.policy."


@final
class BestOf:
    """The world folds what it observes into its state. From there `count` plans of the policy are imagined, one of its usual
    actions and others that it draws; the one that succeeds first is taken, else the one that comes nearest to the goal or, without
    a goal, the one of the highest return. PlanningError for a world that cannot imagine them from one state."""

    def __init__(self, world: World, usual: Policy, drawing: Policy, count: int, criterion: SuccessCriterion):
        spec = world.spec
        if count < 1 or not spec.forkable or (spec.max_batch or count) < count:
            raise PlanningError(
                f"{spec.name} cannot imagine {count} plans from one state; give a count of 1 or more that it holds, or learn a "
                "world of it first."
            )
        if not spec.observes:
            raise PlanningError(f"{spec.name} observes nothing, so no plan can begin where the episode is.")
        if not criterion.defined and "reward" not in spec.channels:
            raise PlanningError(f"{spec.name} has no reward: say with --goal or --success which plan is the best.")
        self.world, self.usual, self.drawing, self.count, self.criterion = world, usual, drawing, count, criterion
        self.sees = (*spec.observes, *spec.may_observe)
        self._shown = observed_channels(usual, spec)

    def begin(self, batch: int, rng: torch.Generator) -> State:
        inner = self.usual.begin(batch, rng)
        plain = {f"{_POLICY}{name}": value for name, value in inner.items()} if isinstance(inner, State) else {}
        return State({_LEFT: torch.zeros(batch, dtype=torch.int64), **plain})

    @torch.no_grad()
    def act(self, observation: Observation, memory: State, rng: torch.Generator) -> tuple[torch.Tensor, State]:
        own = {name: value for name, value in memory.items() if name.startswith("best.")}
        before = {name: value for name, value in memory.items() if name not in own}
        evidence = {name: observation[name] for name in self.sees if name in observation}
        state = self.world.observe(evidence, State(before, memory.arenas) if before else None, rng)
        if _QUEUE not in own or bool((own[_LEFT] == 0).any()):  # all episodes of a batch plan together
            queue, inner = self._best(state, _inner(own), rng)
            own = {_LEFT: torch.full((state.batch,), queue.shape[1]), _QUEUE: queue}
            own |= {f"{_POLICY}{name}": value for name, value in inner.items()} if inner is not None else {}
        at = own[_QUEUE].shape[1] - int(own[_LEFT][0])
        action = own[_QUEUE][:, at]
        after = self.world.imagine(state, action.to(state.device), rng)
        return action, State({**after, **own, _LEFT: own[_LEFT] - 1}, after.arenas)

    def _best(self, state: State, inner: State | None, rng: torch.Generator) -> tuple[torch.Tensor, State | None]:
        """The first REPLAN actions [B, REPLAN, *action.shape] of the best plans, and the policy's memory after them."""
        arms = [(self.usual, 1), (self.drawing, self.count - 1)]
        plans = [self._imagined(policy, state, inner, count, rng) for policy, count in arms if count]
        scores = torch.cat([score for score, _, _ in plans], 1)
        best = scores.argmax(1)
        rows = torch.arange(len(best))
        actions = torch.cat([taken for _, taken, _ in plans], 1)[rows, best]
        if inner is None:
            return actions, None
        names = list(inner)
        kept = {name: torch.cat([memory[name] for _, _, memory in plans], 1)[rows, best] for name in names}
        return actions, State(kept)

    def _imagined(
        self, policy: Policy, state: State, inner: State | None, count: int, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Of `count` plans: scores [B, count], first actions [B, count, REPLAN, ...], and the policy's memory after them."""
        world, criterion, batch = self.world, self.criterion, state.batch * count
        outcome = [name for name in ("reward", *ENDS) if name in world.spec.channels]
        channels = tuple(dict.fromkeys((*self._shown, *criterion.channels, *outcome)))
        ahead, memory, taken, kept = (
            state.fork(count),
            None if inner is None else inner.fork(count),
            [],
            _tensors_of(inner),
        )
        seen = world.render(ahead, channels)
        score, going = (
            torch.full((batch,), -torch.inf if criterion.defined else 0.0),
            torch.ones(batch, dtype=torch.bool),
        )
        alive = torch.ones(batch)  # the probability that the episode goes on
        for step in range(HORIZON):
            action, memory = act(policy, seen, memory, batch, world.spec, rng)
            if step < REPLAN:
                taken.append(action)
                kept = _tensors_of(memory)
            ahead = world.imagine(ahead, action.to(ahead.device), rng)
            seen = world.render(ahead, channels)
            score = torch.where(going, self._score(score, seen, step, alive), score)
            over = criterion.succeeded(world, seen).cpu() if criterion.defined else torch.zeros_like(going)
            left = survival_after(seen, alive)
            alive = alive if left is None else left
            going = going & ~over & (alive > 0)
        shape = state.batch, count
        memories = {name: value.unflatten(0, shape) for name, value in kept.items()}
        return score.view(shape), torch.stack(taken, 1).unflatten(0, shape), memories

    def _score(self, score: torch.Tensor, seen: Observation, step: int, alive: torch.Tensor) -> torch.Tensor:
        """[N], after a step that is reached with probability `alive`: success counts from 1 to 2, the sooner the more; else minus
        the least distance to the goal, or the expected return so far."""
        criterion = self.criterion
        if not criterion.defined:
            return score + alive * seen["reward"].cpu().float()
        away = criterion.distance(self.world, seen).nan_to_num(1.0)
        reached = criterion.succeeded(self.world, seen).cpu()
        return torch.where(reached, 2 - step / HORIZON, torch.maximum(score, -away))


def _tensors_of(memory: Any) -> dict[str, torch.Tensor]:
    """The tensors of a policy's memory; {} for a policy without."""
    return dict(memory.items()) if isinstance(memory, State) else {}


def _inner(own: dict[str, torch.Tensor]) -> State | None:
    """The policy's memory."""
    plain = {name.removeprefix(_POLICY): value for name, value in own.items() if name.startswith(_POLICY)}
    return State(plain) if plain else None


def best_of(folder: str, count: int, world: World, criterion: SuccessCriterion) -> BestOf:
    """The best of `count` plans of the policy in a folder. PlanningError for a kind of policy that draws nothing."""
    kind = kind_of_policy(folder)
    if kind == imitation.KIND:
        usual = ImitationActor.load(folder, world.spec)
        return BestOf(world, usual, ImitationActor(usual.network, world.spec, std=0.0), count, criterion)
    if kind == ACTOR:
        usual = Actor.load(folder, world.spec)
        return BestOf(world, usual, Actor(usual.network, world.spec, greedy=False), count, criterion)
    raise PlanningError(f"{folder} is a policy of kind '{kind}': --best-of takes policies by `train policy`.")
