"""One planning problem of several episodes: what candidates cost when a world imagines them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from ...core.errors import PlanningError
from ...core.rollouts import advanced
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .costs import LATENT, Cost
from .moves import Moves

_GOLDEN, _SEEDS = 0x9E3779B97F4A7C15, 2**63
_KNOWN_SHARE = 0.5  # of the candidates that the world must know for a step to count


def by_episode(verb: Callable[[slice, torch.Generator], State], seeds: Sequence[int]) -> State:
    """`verb(entries, rng)` for all episodes at once; where it draws chance, for one after the other, each from the generator of
    its seed: so a batch is planned as its episodes alone would be."""
    rng = make_rng(seeds[0])
    before = rng.get_state()
    together = verb(slice(0, len(seeds)), rng)
    if len(seeds) == 1 or torch.equal(before, rng.get_state()):
        return together
    return State.stack([verb(slice(at, at + 1), make_rng(seed)) for at, seed in enumerate(seeds)])


def later(seed: int, count: int) -> int:
    """Another seed for each count."""
    return (seed + (count + 1) * _GOLDEN) % _SEEDS


@dataclass
class PlanningProblem:
    """B episodes that stand in `state` (batch B), from where plans of `horizon` moves are sought, each held for `block` steps.

    goal:  channel -> [B, ...]; seeds: one an episode. trust: the world's channel `uncertainty` up to which a step counts.
    `known` [B] says how many moves of the horizon count: those before half of the candidates first leave what the world
    knows, and at least one; the same for all of a round, so that no plan gains by flying into the unknown. It only falls; where
    it fell in the last evaluation (`shortened` [B]), earlier costs were of longer plans. `spent` counts the steps that were
    imagined for each episode.
    """

    world: World
    moves: Moves
    cost: Cost
    state: State
    goal: Observation
    seeds: list[int]
    horizon: int
    block: int = 1
    trust: float | None = None
    spent: int = 0

    def __post_init__(self):
        self.known = torch.full((self.batch,), self.horizon)
        self.shortened = torch.zeros(self.batch, dtype=torch.bool)
        more = ("done",) if self.cost.until_done and "done" in self.world.spec.channels else ()
        doubt = ("uncertainty",) if self.trust is not None else ()
        self._channels = tuple(dict.fromkeys((*self.cost.channels, *more, *doubt)))
        leap = self.world.spec.leap
        self._leaps = bool(leap) and self.block % leap == 0 and self.cost.over == "last" and self._channels == (LATENT,)
        self._count = 0

    @property
    def batch(self) -> int:
        return len(self.seeds)

    def evaluate(self, codes: torch.Tensor, settled: bool = False) -> torch.Tensor:
        """Plans [B, N, H, D] -> what each costs, [B, N]; inf where that is no finite number. `settled`: `known` stays."""
        candidates, before = codes.shape[1], self.known
        state = self.state.fork(candidates)
        total = alive = None
        for move in range(int(before.max())):
            state, step, alive, sure = self.move(state, codes[:, :, move], alive, candidates)
            if move and sure is not None and not settled:
                self.shorten(move, sure)
            new = self.cost.added(total, step)
            total = new if total is None else torch.where((move < self.known)[:, None], new, total)
            if not bool((self.known > move + 1).any()):
                break
        self.shortened = self.known < before
        assert total is not None
        return torch.where(torch.isfinite(total), total, torch.inf)

    def shorten(self, move: int, sure: torch.Tensor) -> None:
        """Ends the horizon before a move after which the world knows a share `sure` [B] of the candidates."""
        self.known = torch.where((self.known > move) & (sure < _KNOWN_SHARE), move, self.known)

    def move(
        self, state: State, codes: torch.Tensor, alive: torch.Tensor | None, candidates: int
    ) -> tuple[State, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """One move [B, N, D] of candidates that are stepped together: the state, the move's cost [B, N], who has not ended
        [B, N], and the share [B] of candidates that the world still knows. `alive`: who had not ended before."""
        actions = self.moves.actions(codes).flatten(0, 1).to(state.device)
        total = sure = None
        if self._leaps:
            held = actions[:, None].expand(-1, self.block, *actions.shape[1:])
            self._count, self.spent = self._count + 1, self.spent + candidates * (self.block // self.world.spec.leap)
            state = advanced(self.world, state, held, make_rng(later(self.seeds[0], self._count)))
            flat = self.world.render(state, self._channels)
            seen = {name: tensor.unflatten(0, (-1, candidates)) for name, tensor in flat.items()}
            return state, self.cost.of_step(seen, self.goal).cpu(), alive, None
        for _ in range(self.block):
            state = self._imagined(state, actions, candidates)
            flat = self.world.render(state, self._channels)
            seen = {name: tensor.unflatten(0, (-1, candidates)) for name, tensor in flat.items()}
            step = self.cost.of_step(seen, self.goal).cpu()
            if "done" in seen and self.cost.until_done:
                step = step if alive is None else torch.where(alive, step, 0.0)
                going = ~seen["done"].cpu()
                alive = going if alive is None else alive & going
            if self.trust is not None:
                sure = (seen["uncertainty"].cpu() <= self.trust).float().mean(1)
            total = self.cost.added(total, step)
        assert total is not None
        return state, total, alive, sure

    def _imagined(self, state: State, actions: torch.Tensor, candidates: int) -> State:
        self._count += 1
        self.spent += candidates
        seeds = [later(seed, self._count) for seed in self.seeds]

        def step(entries: slice, rng: torch.Generator) -> State:
            rows = slice(entries.start * candidates, entries.stop * candidates)
            if rows == slice(0, len(actions)):
                return self.world.imagine(state, actions, rng)
            return self.world.imagine(state.at(rows), actions[rows], rng)

        return by_episode(step, seeds)


def check_some(cost: torch.Tensor, task: PlanningProblem) -> None:
    """PlanningError where an episode's candidates [B, N] have no finite cost between them: nothing is chosen by chance."""
    if not bool(torch.isfinite(cost).any(1).all()):
        raise PlanningError(
            f"none of {cost.shape[1]:,} plans in {task.world.spec.name} has a cost that is a finite number "
            f"({', '.join(task.cost.channels)}): the world's predictions are broken here, and no action is chosen by chance."
        )
