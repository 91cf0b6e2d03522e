"""Planner: model-predictive control in any World. It imagines candidate plans, and takes the first actions of the cheapest."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from ...core import chance
from ...core.errors import ActionError, ContractError, ObservationError, PlanningError
from ...core.policy import Policy, act
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .costs import Cost
from .moves import moves_of, shifted
from .problem import EpisodeSeeds, PlanningProblem, later
from .searches import SearchConfig, SearchResult, WarmStart, search

_OBSERVE, _PRIOR, _SEARCH, _PROPOSE = range(4)  # random streams of an episode, at each step


@dataclass(frozen=True)
class Decision:
    """A plan as it was judged when it was made."""

    cost: float
    steps: int  # imagined for it
    ms: float  # of a batch: the episode's share
    trusted_moves: int  # of the horizon, within `trust`
    considered: (
        torch.Tensor
    )  # actions [M, H, *action.shape]: the chosen plan, then the median and the worst of the last round
    state: State | None = None  # [1], in which it was made
    goal: Observation = field(default_factory=dict)


@dataclass(frozen=True)
class PlannerMemory:
    """The planner's memory of one episode."""

    seed: int
    goal: Observation  # channel -> [1, ...]
    step: int = 0
    prior: State | None = None  # [1], expected now
    queue: torch.Tensor | None = None  # [n, D], the rest of the current plan
    belief: torch.Tensor | None = None  # [H, D, K], warm start of the next search
    plan: torch.Tensor | None = None  # [H, D], warm start of the next search
    decision: Decision | None = None  # the last


class Planner:
    """Folds what it observes into the state of `world`, searches for the cheapest plan from there, and acts on it.

    cost:     the cost of futures (costs.py). config: how to search, and how much of a plan to execute (searches.py).
    proposal: a policy for the same actions; `proposals` of its plans, rolled out in the world, are evaluated as well. It is
              shown `sees`, by default its own channels or all that a recording would hold, and the goal as `goal.CHANNEL`.

    Its memory is a list of one PlannerMemory an episode. The same seed gives the same actions, and a batch gives those of its
    episodes alone, up to rounding in the world (and unless a time budget is set).
    Raises PlanningError, ObservationError or ChannelError; it never acts at random.
    """

    def __init__(
        self,
        world: World,
        cost: Cost,
        config: SearchConfig | None = None,
        proposal: Policy | None = None,
        proposals: int = 4,
        sees: Sequence[str] | None = None,
    ):
        config, spec = (config or SearchConfig()).filled(), world.spec
        if not spec.forkable or (spec.max_batch is not None and spec.max_batch < config.samples):
            raise PlanningError(
                f"{spec.name} cannot be planned in: it holds {spec.max_batch or 'no'} futures at once, and "
                f"{'can' if spec.forkable else 'cannot'} return to a state. Learn a world of it first."
            )
        if config.trust is not None and "uncertainty" not in spec.channels:
            raise PlanningError(f"{spec.name} has no channel 'uncertainty' to end the horizon by; leave `trust` out.")
        if config.replan > config.horizon:
            raise PlanningError(
                f"replan after 1 to {config.horizon} moves of a plan of {config.horizon}; got {config.replan}."
            )
        spec.check_channels(cost.channels)
        self.world, self.cost, self.config, self.moves = world, cost, config, moves_of(spec)
        self._proposal, self._proposals, self._episode_seeds = proposal, proposals, EpisodeSeeds()
        named = getattr(proposal, "sees", spec.recorded) if sees is None else sees
        self._sees = tuple(name for name in named if name in spec.channels)

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels to show it: the evidence that its world takes."""
        return (*self.world.spec.observes, *self.world.spec.may_observe)

    def begin(self, batch: int, rng: torch.Generator) -> list[PlannerMemory]:
        seeds = chance.seeds(batch, rng, "cpu").bitwise_and(2**63 - 1).tolist()
        return [PlannerMemory(seed, self.cost.goal_of(entry, batch)) for entry, seed in enumerate(seeds)]

    @torch.no_grad()
    def act(
        self, observation: Observation, memory: list[PlannerMemory], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[PlannerMemory]]:
        """The first actions of the best plans. `rng` is not used: each episode draws from the seed that it began with."""
        state, memory = self._observe(observation, memory), list(memory)
        new = [entry for entry, episode in enumerate(memory) if episode.queue is None]
        old = [entry for entry, episode in enumerate(memory) if episode.queue is not None and not len(episode.queue)]
        for entries in filter(None, (new, old)):  # the old ones have a warm start
            for entry, episode in zip(entries, self._plan(state.at(entries), [memory[at] for at in entries])):
                memory[entry] = episode
        codes = torch.stack([episode.queue[0] for episode in memory if episode.queue is not None])
        actions = self.moves.actions(codes).to(state.device)
        seeds = [later(episode.seed, 4 * episode.step + _PRIOR) for episode in memory]
        imagine = lambda part, rng: self.world.imagine(state.at(part), actions[part], rng)  # noqa: E731
        after = self._episode_seeds.run("imagine", imagine, seeds)
        rest = [None if episode.queue is None else episode.queue[1:] for episode in memory]
        return actions, [
            replace(episode, step=episode.step + 1, prior=after.at(entry), queue=rest[entry])
            for entry, episode in enumerate(memory)
        ]

    def _observe(self, observation: Observation, memory: Sequence[PlannerMemory]) -> State:
        """The states after the evidence, given the priors of the episodes that have one."""
        spec = self.world.spec
        missing = [name for name in spec.observes if name not in observation]
        if missing:
            raise ObservationError(
                f"{spec.name} plans from {', '.join(spec.observes)}, and the observation lacks {', '.join(missing)}."
            )
        evidence = {name: observation[name] for name in (*spec.observes, *spec.may_observe) if name in observation}
        for name, value in evidence.items():
            if tuple(value.shape) != (len(memory), *(spec.channels[name].shape or ())):
                raise ObservationError(
                    f"{spec.name} takes '{name}' of shape {spec.channels[name].shape}; got {tuple(value.shape[1:])}."
                )
        new = [entry for entry, episode in enumerate(memory) if episode.prior is None]
        old = [entry for entry, episode in enumerate(memory) if episode.prior is not None]
        parts = []
        for entries in filter(None, (new, old)):
            evident = {name: value[entries] for name, value in evidence.items()}
            parts.append(self._fold(evident, [memory[at] for at in entries]))
        return State.stack(parts).at([(new + old).index(entry) for entry in range(len(memory))])

    def _fold(self, shown: Observation, episodes: Sequence[PlannerMemory]) -> State:
        """The same, for episodes that all have a prior or all have none."""
        priors = [episode.prior for episode in episodes if episode.prior is not None]
        prior = State.stack(priors) if priors else None

        def fold(part: slice, rng: torch.Generator) -> State:
            seen = {name: value[part] for name, value in shown.items()}
            return self.world.observe(seen, None if prior is None else prior.at(part), rng)

        name = "observe" if prior is None else "update"  # one may draw and the other not
        return self._episode_seeds.run(name, fold, [later(one.seed, 4 * one.step + _OBSERVE) for one in episodes])

    def _plan(self, state: State, episodes: list[PlannerMemory]) -> list[PlannerMemory]:
        began, config = time.perf_counter(), self.config
        goal = {name: torch.cat([episode.goal[name] for episode in episodes]) for name in episodes[0].goal}
        seeds = [later(episode.seed, 4 * episode.step + _SEARCH) for episode in episodes]
        problem = PlanningProblem(
            self.world,
            self.moves,
            self.cost,
            state,
            goal,
            seeds,
            config.horizon,
            config.block,
            config.trust,
            self._episode_seeds,
        )
        proposed = None if self._proposal is None else self._proposals_of(state, episodes)
        plans = search(problem, config, WarmStart(_stacked(episodes, "belief"), _stacked(episodes, "plan"), proposed))
        ms = 1e3 * (time.perf_counter() - began) / len(episodes)
        return [self._remember(episode, problem, plans, entry, ms) for entry, episode in enumerate(episodes)]

    def _remember(
        self, episode: PlannerMemory, problem: PlanningProblem, plans: SearchResult, entry: int, ms: float
    ) -> PlannerMemory:
        plan, trusted = plans.plan[entry], int(problem.trusted_moves[entry])
        done = min(self.config.replan, trusted)
        fresh = self.moves.initial(1, self.config.horizon, self.config.spread)[0]
        considered = self.moves.actions(torch.cat([plan[None], plans.considered[entry, 1:]]))
        state = problem.state.at(entry)
        cost, steps = float(plans.cost[entry]), problem.imagined_steps
        decision = Decision(cost, steps, ms, trusted, considered, state, episode.goal)
        return replace(
            episode,
            queue=plan[:done].repeat_interleave(self.config.block, 0),
            belief=shifted(plans.belief[entry], done, fresh),
            plan=shifted(plan, done, plan[-1:].expand(done, -1)),
            decision=decision,
        )

    def _proposals_of(self, state: State, episodes: Sequence[PlannerMemory]) -> torch.Tensor:
        """The policy's plans [B, M, H, D]: its action at the beginning of each move, held for a block."""
        plans = []
        for entry, episode in enumerate(episodes):
            rng = make_rng(later(episode.seed, 4 * episode.step + _PROPOSE))
            ahead, taken = state.at(entry).fork(self._proposals), []
            count, goal = self._proposals, episode.goal
            goal = {f"goal.{name}": value.expand(count, *value.shape[1:]) for name, value in goal.items()}
            try:
                assert self._proposal is not None
                memory: Any = self._proposal.begin(self._proposals, rng)
                for _ in range(self.config.horizon):
                    seen = {**self.world.render(ahead, self._sees), **goal}
                    action, memory = act(self._proposal, seen, memory, self._proposals, self.world.spec, rng)
                    action = self.world.spec.check_action(action, self._proposals)
                    taken.append(action)
                    for _ in range(self.config.block):
                        ahead = self.world.imagine(ahead, action, rng)
            except (ContractError, ActionError) as error:
                raise PlanningError(f"the proposed policy is for other actions: {error}") from error
            plans.append(self.moves.codes(torch.stack(taken, 1)))
        return torch.stack(plans)


def _stacked(episodes: Sequence[PlannerMemory], name: str) -> torch.Tensor | None:
    """A field of all these episodes as one tensor; None if they have none yet."""
    values = [getattr(episode, name) for episode in episodes]
    return None if values[0] is None else torch.stack(values)
