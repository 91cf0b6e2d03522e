"""One planning problem of several episodes: the costs of candidate plans, as a world imagines them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from ...core.errors import PlanningError
from ...core.rollouts import advance
from ...core.spec import trust_channel
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .costs import LATENT, Cost
from .moves import Moves

_GOLDEN, _SEEDS = 0x9E3779B97F4A7C15, 2**63
_TRUSTED_SHARE = 0.5  # of the candidates that must be within `trust` for a move to count


class EpisodeSeeds:
    """Runs a verb of a world on a batch of episodes so that each draws as it would alone, from a generator of its own seed.

    A verb that draws nothing, as its first run shows, runs once on the whole batch; one that draws runs episode by episode.
    """

    def __init__(self) -> None:
        self._draws: dict[str, bool] = {}

    def run(self, name: str, verb: Callable[[slice, torch.Generator], State], seeds: Sequence[int]) -> State:
        """verb(entries, rng) on all episodes."""
        count, singles = len(seeds), list[State]()
        if count == 1:
            return verb(slice(0, 1), make_rng(seeds[0]))
        if name not in self._draws:
            singles.append(self._call(name, verb, slice(0, 1), seeds[0]))
        if not self._draws[name]:
            whole = self._call(name, verb, slice(0, count), seeds[0])
            if not self._draws[name]:
                return whole
        singles += [verb(slice(at, at + 1), make_rng(seeds[at])) for at in range(len(singles), count)]
        return State.stack(singles)

    def _call(self, name: str, verb: Callable[[slice, torch.Generator], State], entries: slice, seed: int) -> State:
        rng = make_rng(seed)
        before = rng.get_state()
        state = verb(entries, rng)
        self._draws[name] = not torch.equal(before, rng.get_state())
        return state


def later(seed: int, count: int) -> int:
    """Another seed for each count."""
    return (seed + (count + 1) * _GOLDEN) % _SEEDS


@dataclass
class PlanningProblem:
    """B episodes in `state` (batch B), for which plans of `horizon` moves are sought, each move held for `block` steps.

    `trusted_moves` [B]: the moves of the horizon that count. The horizon ends where half of the candidates of a round exceed
    `trust`, but not before the first move; it is the same for all candidates, so that no plan gains by leaving the known. It
    only shrinks. Where it shrank in the last evaluation (`shortened` [B]), earlier costs do not compare.
    """

    world: World
    moves: Moves
    cost: Cost
    state: State
    goal: Observation  # channel -> [B, ...]
    seeds: list[int]  # one an episode
    horizon: int  # moves
    block: int = 1  # steps
    trust: float | None = None  # largest value of the world's `trust_channel` that counts as known
    episode_seeds: EpisodeSeeds = field(default_factory=EpisodeSeeds)
    imagined_steps: int = 0  # so far, of each episode

    def __post_init__(self):
        self.trusted_moves = torch.full((self.batch,), self.horizon)
        self.shortened = torch.zeros(self.batch, dtype=torch.bool)
        ends = self.cost.ends(self.world.spec)
        uncertainty = (trust_channel(self.world.spec),) if self.trust is not None else ()
        self._channels = tuple(dict.fromkeys((*self.cost.channels, *ends, *uncertainty)))
        leap = self.world.spec.leap
        self._leaps = bool(leap) and self.block % leap == 0 and self.cost.over == "last" and self._channels == (LATENT,)
        self._count = 0

    @property
    def batch(self) -> int:
        return len(self.seeds)

    def evaluate(self, codes: torch.Tensor, fixed_horizon: bool = False) -> torch.Tensor:
        """The costs [B, N] of plans [B, N, H, D]; inf for one that is not finite. fixed_horizon: `trusted_moves` stays."""
        candidates, before = codes.shape[1], self.trusted_moves
        state = self.state.fork(candidates)
        total = alive = None
        for move in range(int(before.max())):
            state, step, alive, trusted = self.move(state, codes[:, :, move], alive, candidates)
            if move and trusted is not None and not fixed_horizon:
                self.shorten(move, trusted)
            new = self.cost.accumulate(total, step)
            total = new if total is None else torch.where((move < self.trusted_moves)[:, None], new, total)
            if not bool((self.trusted_moves > move + 1).any()):
                break
        self.shortened = self.trusted_moves < before
        assert total is not None
        return torch.where(torch.isfinite(total), total, torch.inf)

    def shorten(self, move: int, trusted: torch.Tensor) -> None:
        """Ends the horizon before `move` where too small a share `trusted` [B] of the candidates is known after it."""
        ends = (self.trusted_moves > move) & (trusted < _TRUSTED_SHARE)
        self.trusted_moves = torch.where(ends, move, self.trusted_moves)

    def move(
        self, state: State, codes: torch.Tensor, alive: torch.Tensor | None, candidates: int
    ) -> tuple[State, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """One move [B, N, D] of all candidates: the state, the move's cost [B, N], the probability [B, N] that they have not ended,
        and the share [B] within `trust`. `alive`: that probability before the move."""
        actions = self.moves.actions(codes).flatten(0, 1).to(state.device)
        total = trusted = None
        if self._leaps:
            held, leaps = (
                actions[:, None].expand(-1, self.block, *actions.shape[1:]),
                self.block // self.world.spec.leap,
            )
            self._count, self.imagined_steps = self._count + 1, self.imagined_steps + candidates * leaps
            state = advance(self.world, state, held, make_rng(later(self.seeds[0], self._count)))
            return state, self.cost.step_cost(self._render(state, candidates), self.goal).cpu(), alive, None
        for _ in range(self.block):
            state = self._imagine(state, actions, candidates)
            seen = self._render(state, candidates)
            step = self.cost.expected(self.cost.step_cost(seen, self.goal).cpu(), alive)
            alive = self.cost.survival(seen, alive)
            if self.trust is not None:
                trusted = (seen[trust_channel(self.world.spec)].cpu() <= self.trust).float().mean(1)
            total = self.cost.accumulate(total, step)
        assert total is not None
        return state, total, alive, trusted

    def _render(self, state: State, candidates: int) -> Observation:
        """channel -> [B, N, ...]."""
        flat = self.world.render(state, self._channels)
        return {name: tensor.unflatten(0, (-1, candidates)) for name, tensor in flat.items()}

    def _imagine(self, state: State, actions: torch.Tensor, candidates: int) -> State:
        self._count += 1
        self.imagined_steps += candidates

        def step(entries: slice, rng: torch.Generator) -> State:
            rows = slice(entries.start * candidates, entries.stop * candidates)
            if rows == slice(0, len(actions)):
                return self.world.imagine(state, actions, rng)
            return self.world.imagine(state.at(rows), actions[rows], rng)

        return self.episode_seeds.run("imagine", step, [later(seed, self._count) for seed in self.seeds])


def check_finite_costs(cost: torch.Tensor, problem: PlanningProblem) -> None:
    """PlanningError where no candidate of an episode [B, N] has a finite cost: an action is never chosen at random."""
    if not bool(torch.isfinite(cost).any(1).all()):
        raise PlanningError(
            f"none of {cost.shape[1]:,} plans in {problem.world.spec.name} has a finite cost "
            f"({', '.join(problem.cost.channels)}): the world's predictions are broken here, so no action is chosen."
        )
