"""Planner: a policy that imagines what its actions would lead to, in any World, and takes those that cost least."""

from __future__ import annotations

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
from .problem import PlanningProblem, by_episode, later
from .searches import SearchConfig, SearchResult, WarmStart, search

_OBSERVE, _PRIOR, _SEARCH, _PROPOSE = range(4)  # what an episode's seed is spent on, at each step


@dataclass(frozen=True)
class Decision:
    """What a plan was worth when it was made: its cost, the steps imagined for it, the time it took (of a batch: its share),
    how many moves the world knew, and plans that were considered, as actions [M, H, *action.shape]: the one that was chosen, then
    the median and the worst of the last round. state [1] and goal are those that it was made for."""

    cost: float
    steps: int
    ms: float
    known: int
    considered: torch.Tensor
    state: State | None = None
    goal: Observation = field(default_factory=dict)


@dataclass(frozen=True)
class PlannerMemory:
    """The planner's memory of one episode: its seed and step, the state [1] expected now, what is still to be done [n, D] of the
    plan, the belief [H, D, K] and plan [H, D] to begin with next, the goal [1, ...], and the last decision."""

    seed: int
    goal: Observation
    step: int = 0
    prior: State | None = None
    queue: torch.Tensor | None = None
    belief: torch.Tensor | None = None
    plan: torch.Tensor | None = None
    decision: Decision | None = None


class Planner:
    """Plans in `world` from what it observes, and acts.

    cost:     what futures cost (costs.py). config: how to search, and how much of a plan to execute (searches.py).
    proposal: a policy for the same actions whose `proposals` plans, rolled out in the world, are tried as well; the channels
              that it sees are `sees`, by default its own or all that a recording of the world would hold; the goal is among
              them, as `goal.` and its channel.

    The memory is a list of one PlannerMemory an episode. The same seed gives the same actions; a batch gives those of its episodes
    alone, but for what the world's own arithmetic rounds (and unless a budget in milliseconds is set).
    Raises PlanningError, ObservationError or ChannelError; it never acts by chance.
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
                f"{spec.name} cannot be planned in: it holds {spec.max_batch or 'no'} futures at once, and states of it "
                f"{'can' if spec.forkable else 'cannot'} be returned to. Learn a world of it first."
            )
        if config.trust is not None and "uncertainty" not in spec.channels:
            raise PlanningError(
                f"{spec.name} has no channel 'uncertainty' that could end the horizon; leave `trust` out."
            )
        if config.replan > config.horizon:
            raise PlanningError(f"a plan of {config.horizon} moves is made anew after 1 to {config.horizon} of them.")
        spec.check_channels(cost.channels)
        self.world, self.cost, self.config, self.moves = world, cost, config, moves_of(spec)
        self._proposal, self._proposals = proposal, proposals
        named = getattr(proposal, "sees", spec.recorded) if sees is None else sees
        self._sees = tuple(name for name in named if name in spec.channels)

    @property
    def sees(self) -> tuple[str, ...]:
        """What it is to be shown: the evidence that its world takes."""
        return (*self.world.spec.observes, *self.world.spec.may_observe)

    def begin(self, batch: int, rng: torch.Generator) -> list[PlannerMemory]:
        seeds = chance.seeds(batch, rng, "cpu").bitwise_and(2**63 - 1).tolist()
        return [PlannerMemory(seed, self.cost.goal_of(entry, batch)) for entry, seed in enumerate(seeds)]

    @torch.no_grad()
    def act(
        self, observation: Observation, memory: list[PlannerMemory], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[PlannerMemory]]:
        """The first actions of the best plans. `rng` is not used: each episode has a seed of its own since it began."""
        state, memory = self._observed(observation, memory), list(memory)
        new = [entry for entry, thought in enumerate(memory) if thought.queue is None]
        old = [entry for entry, thought in enumerate(memory) if thought.queue is not None and not len(thought.queue)]
        for entries in filter(None, (new, old)):  # the old ones have a plan to go on from
            for entry, thought in zip(entries, self._planned(state.at(entries), [memory[at] for at in entries])):
                memory[entry] = thought
        codes = torch.stack([thought.queue[0] for thought in memory if thought.queue is not None])
        actions = self.moves.actions(codes).to(state.device)
        seeds = [later(thought.seed, 4 * thought.step + _PRIOR) for thought in memory]
        after = by_episode(lambda part, chance: self.world.imagine(state.at(part), actions[part], chance), seeds)
        return actions, [
            replace(thought, step=thought.step + 1, prior=after.at(entry), queue=_rest(thought.queue))
            for entry, thought in enumerate(memory)
        ]

    def _observed(self, observation: Observation, memory: Sequence[PlannerMemory]) -> State:
        """What is seen, folded into what was expected; where nothing was yet, into nothing."""
        spec = self.world.spec
        missing = [name for name in spec.observes if name not in observation]
        if missing:
            raise ObservationError(
                f"{spec.name} plans from {', '.join(spec.observes)}, and {', '.join(missing)} is not there to be seen."
            )
        evidence = {name: observation[name] for name in (*spec.observes, *spec.may_observe) if name in observation}
        for name, value in evidence.items():
            if tuple(value.shape) != (len(memory), *(spec.channels[name].shape or ())):
                raise ObservationError(
                    f"{spec.name} sees '{name}' of shape {spec.channels[name].shape}; it was shown {tuple(value.shape[1:])}."
                )
        new = [entry for entry, thought in enumerate(memory) if thought.prior is None]
        old = [entry for entry, thought in enumerate(memory) if thought.prior is not None]
        parts = [
            self._folded({name: value[entries] for name, value in evidence.items()}, [memory[at] for at in entries])
            for entries in filter(None, (new, old))
        ]
        return State.stack(parts).at([(new + old).index(entry) for entry in range(len(memory))])

    def _folded(self, shown: Observation, thoughts: Sequence[PlannerMemory]) -> State:
        """For episodes that all expect something, or all expect nothing yet."""
        priors = [thought.prior for thought in thoughts if thought.prior is not None]
        prior = State.stack(priors) if priors else None

        def fold(part: slice, rng: torch.Generator) -> State:
            seen = {name: value[part] for name, value in shown.items()}
            return self.world.observe(seen, None if prior is None else prior.at(part), rng)

        return by_episode(fold, [later(thought.seed, 4 * thought.step + _OBSERVE) for thought in thoughts])

    def _planned(self, state: State, thoughts: list[PlannerMemory]) -> list[PlannerMemory]:
        began, config = time.perf_counter(), self.config
        names = thoughts[0].goal
        goal = {name: torch.cat([thought.goal[name] for thought in thoughts]) for name in names}
        seeds = [later(thought.seed, 4 * thought.step + _SEARCH) for thought in thoughts]
        task = PlanningProblem(
            self.world, self.moves, self.cost, state, goal, seeds, config.horizon, config.block, config.trust
        )
        proposed = None if self._proposal is None else self._proposals_of(state, thoughts)
        found = search(task, config, WarmStart(_stacked(thoughts, "belief"), _stacked(thoughts, "plan"), proposed))
        ms = 1e3 * (time.perf_counter() - began) / len(thoughts)
        return [self._thought(thought, task, found, entry, ms) for entry, thought in enumerate(thoughts)]

    def _thought(
        self, thought: PlannerMemory, task: PlanningProblem, found: SearchResult, entry: int, ms: float
    ) -> PlannerMemory:
        plan, known = found.plan[entry], int(task.known[entry])
        done = min(self.config.replan, known)
        fresh = self.moves.first(1, self.config.horizon, self.config.spread)[0]
        considered = self.moves.actions(torch.cat([plan[None], found.considered[entry, 1:]]))
        decision = Decision(
            float(found.cost[entry]), task.spent, ms, known, considered, task.state.at(entry), thought.goal
        )
        return replace(
            thought,
            queue=plan[:done].repeat_interleave(self.config.block, 0),
            belief=shifted(found.belief[entry], done, fresh),
            plan=shifted(plan, done, plan[-1:].expand(done, -1)),
            decision=decision,
        )

    def _proposals_of(self, state: State, thoughts: Sequence[PlannerMemory]) -> torch.Tensor:
        """The policy's plans [B, M, H, D]: its action at the beginning of each move, held for a block as all moves are."""
        found = []
        for entry, thought in enumerate(thoughts):
            rng = make_rng(later(thought.seed, 4 * thought.step + _PROPOSE))
            ahead, taken = state.at(entry).fork(self._proposals), []
            goal = {
                f"goal.{name}": value.expand(self._proposals, *value.shape[1:]) for name, value in thought.goal.items()
            }
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
                raise PlanningError(f"the proposing policy is for other actions: {error}") from error
            found.append(self.moves.codes(torch.stack(taken, 1)))
        return torch.stack(found)


def _rest(queue: torch.Tensor | None) -> torch.Tensor | None:
    return None if queue is None else queue[1:]


def _stacked(thoughts: Sequence[PlannerMemory], name: str) -> torch.Tensor | None:
    """What all these episodes begin with; None where they have nothing yet."""
    found = [getattr(thought, name) for thought in thoughts]
    return None if found[0] is None else torch.stack(found)
