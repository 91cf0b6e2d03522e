"""Searches for good plans: CEM, iCEM, MPPI, random shooting, gradient descent, and a beam over choices."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch

from ...core import chance
from ...core.errors import PlanningError
from ...core.state import State
from .moves import ContinuousMoves, coloured
from .problem import PlanningProblem, check_some

_MOST_ROUNDS = 10_000  # of a search by the clock
_RATE = 0.1  # of Adam, in codes
_TREE, _WHITE = 1 << 20, 0.0

Kind = Literal["cem", "icem", "mppi", "gradient", "tree", "random"]


@dataclass(frozen=True)
class SearchConfig:
    """How a planner searches for plans, and how much of a plan it executes. A count of 0 takes its default (see `filled`)."""

    search: Kind = "icem"
    """icem: CEM with coloured noise and kept elites (Pinneri et al. 2020); cem (Rubinstein 1999, as in PETS); mppi (Williams et
    al. 2017, over elites as in TD-MPC2); gradient: Adam on the actions of a differentiable world; tree: beam search over
    discrete actions; random: random shooting."""
    samples: int = 0
    """Candidate plans per round; 0: 64, or 32 to walk to a place. A tree tries samples x iterations moves at each depth."""
    iterations: int = 0
    """Rounds per decision; 0: 5, or 1 to walk to a place."""
    horizon: int = 0
    """Moves per plan; 0: 12, or 4 to walk to a place."""
    block: int = 0
    """Environment steps for which each move is held; 0: 1, or those of 0.115 s to walk to a place."""
    replan: int = 0
    """Moves that are executed before the next plan is made; 0: 1, or the whole plan if only the end of the horizon counts."""
    budget_ms: float | None = None
    """Search for this many milliseconds per decision, at least one round, in place of `iterations`. The same seed may then give
    another plan on a slower machine."""
    trust: float | None = None
    """A plan is cut where half of the candidates pass this value of the world's channel `uncertainty`; None: never."""
    elites: int = 0
    """The best candidates of a round, to which the next round is fitted; 0: an eighth of the samples."""
    spread: float = 0.5
    """Initial standard deviation of an action axis, as a share of half its range."""
    momentum: float = 0.1
    """Share of the sampling distribution that is kept from round to round."""
    colour: float = 2.0
    """Exponent of icem's coloured noise."""
    keep: float = 0.3
    """Share of icem's elites that are tried again in the next round."""
    decay: float = 1.25
    """Factor by which icem's samples shrink per round."""
    temperature: float = 0.5
    """Of mppi's weights, as a share of the range of the elites' costs."""

    def __post_init__(self):
        counts = (self.samples, self.iterations, self.horizon, self.block, self.replan, self.elites)
        if min(counts) < 0 or self.samples == 1:
            raise PlanningError("samples are 2 or more; iterations, horizon, block and replan 1 or more.")
        if self.budget_ms is not None and not self.budget_ms > 0:
            raise PlanningError(f"a budget is a time above 0 ms; got {self.budget_ms:g}.")

    def filled(
        self, samples: int = 64, iterations: int = 5, horizon: int = 12, block: int = 1, replan: int = 1
    ) -> SearchConfig:
        """The same with these values in place of zeros."""
        return replace(
            self,
            samples=self.samples or samples,
            iterations=self.iterations or iterations,
            horizon=self.horizon or horizon,
            block=self.block or block,
            replan=self.replan or replan,
        )

    @property
    def best(self) -> int:
        """How many elites."""
        return min(self.elites or max(2, self.samples // 8), self.samples)


@dataclass(frozen=True)
class WarmStart:
    """What a search may begin with: the belief [B, H, D, K] and the best plan [B, H, D] of the decision before, moved on, and
    plans [B, M, H, D] that a policy proposes. None for none."""

    belief: torch.Tensor | None = None
    plan: torch.Tensor | None = None
    proposed: torch.Tensor | None = None


@dataclass(frozen=True)
class SearchResult:
    """plan [B, H, D] and its cost [B]; the belief that the next decision may begin with, and plans of the last round
    [B, M, H, D] for people to see: its best, its median and its worst, as far as there are so many."""

    plan: torch.Tensor
    cost: torch.Tensor
    belief: torch.Tensor
    considered: torch.Tensor


def search(task: PlanningProblem, config: SearchConfig, hints: WarmStart | None = None) -> SearchResult:
    """The best plan found. PlanningError where no candidate of an episode has a finite cost, or the search does not suit."""
    return _SEARCHES[config.search](task, config.filled(), hints or WarmStart())


def _rounds(config: SearchConfig) -> Iterator[int]:
    if config.budget_ms is None:
        yield from range(config.iterations)
        return
    end = time.perf_counter() + config.budget_ms / 1e3
    for number in range(_MOST_ROUNDS):
        if number and time.perf_counter() >= end:
            return
        yield number


def _sampled(task: PlanningProblem, config: SearchConfig, hints: WarmStart) -> SearchResult:
    """CEM, iCEM and MPPI. The plan is iCEM's best of all, and of the others the last mean, if that has a cost."""
    moves, seeds, icem = task.moves, torch.tensor(task.seeds), config.search == "icem"
    prior = moves.first(task.batch, task.horizon, config.spread)
    belief = prior if hints.belief is None else moves.reopened(hints.belief, config.spread)
    first = [each for each in (_single(hints.plan), hints.proposed) if each is not None]
    best = _Best()
    elites = codes = torch.zeros(task.batch, 0, task.horizon, moves.size)
    for number in _rounds(config):
        fewer = max(2 * config.best, int(config.samples * config.decay**-number)) if icem else config.samples
        count = min(config.samples, fewer)
        noise = coloured(seeds, count, task.horizon, moves.size, config.colour if icem else _WHITE, number)
        kept = [elites[:, : max(1, int(config.keep * config.best))], moves.best_of(belief)[:, None]]
        given = first if not number else kept if icem else []
        codes = torch.cat([*given, moves.draw(belief, noise)], 1)[:, : max(count, sum(each.shape[1] for each in given))]
        costs = task.evaluate(codes)
        check_some(costs, task)
        order = costs.argsort(dim=1, stable=True)
        codes, costs = _picked(codes, order), costs.gather(1, order)
        elites = codes[:, : config.best]
        best.look(codes[:, 0], costs[:, 0], task.shortened)
        weights = _weights(costs[:, : config.best], config.temperature if config.search == "mppi" else None)
        belief = config.momentum * belief + (1 - config.momentum) * moves.fitted(elites, weights)
    if not icem:
        mean = moves.best_of(belief)
        cost = task.evaluate(mean[:, None], settled=True)[:, 0]
        best = _Best(*best.where(torch.isfinite(cost), mean, cost))
    return SearchResult(best.codes, best.costs, belief, _some(codes))


def _random(task: PlanningProblem, config: SearchConfig, hints: WarmStart) -> SearchResult:
    """The best of evenly drawn plans, and of those that were given."""
    moves, seeds, best = task.moves, torch.tensor(task.seeds), _Best()
    first = [each for each in (_single(hints.plan), hints.proposed) if each is not None]
    codes = torch.zeros(0)
    for number in _rounds(config):
        noise = coloured(seeds, config.samples, task.horizon, moves.size, _WHITE, number)
        codes = torch.cat([*(first if not number else []), moves.uniform(noise)], 1)
        costs = task.evaluate(codes)
        order = costs.argsort(dim=1, stable=True)
        codes = _picked(codes, order)
        best.look(codes[:, 0], costs.gather(1, order)[:, 0], task.shortened)
    check_some(best.costs[:, None], task)
    return SearchResult(best.codes, best.costs, _prior(task, config), _some(codes))


def _gradient(task: PlanningProblem, config: SearchConfig, hints: WarmStart) -> SearchResult:
    """Adam (Kingma & Ba 2015) on all candidates at once, kept within the limits; the best that was ever evaluated."""
    moves, spec, best = task.moves, task.world.spec, _Best()
    if not isinstance(moves, ContinuousMoves):
        raise PlanningError(f"the actions of {spec.name} are choices, which have no gradient; use icem, cem or tree.")
    if not spec.differentiable:
        raise PlanningError(f"no gradients flow through {spec.name} (Spec.differentiable); use icem, cem or mppi.")
    noise = coloured(
        torch.tensor(task.seeds), config.samples, task.horizon, moves.size, config.colour, 0
    )  # one start each
    given = [each for each in (_single(hints.plan), hints.proposed) if each is not None]
    codes = torch.cat([*given, moves.draw(_prior(task, config), noise)], 1)[:, : config.samples]
    with torch.inference_mode(False), torch.enable_grad():
        task.state, codes = _plain(task.state), codes.clone().requires_grad_()
        first, second, taken = torch.zeros_like(codes), torch.zeros_like(codes), 0
        costs = torch.zeros(0)
        for _ in _rounds(config):
            costs = task.evaluate(codes)
            check_some(costs, task)
            least, which = costs.detach().min(1)
            best.look(_picked(codes.detach(), which[:, None])[:, 0].clone(), least, task.shortened)
            (slope,) = torch.autograd.grad(costs[torch.isfinite(costs)].sum(), codes)
            slope, taken = torch.nan_to_num(slope, 0.0, 0.0, 0.0), taken + 1
            first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope.square()
            descent = first / (1 - 0.9**taken) / ((second / (1 - 0.999**taken)).sqrt() + 1e-8)
            codes = (codes.detach() - _RATE * descent).clamp(-1, 1).requires_grad_()
    order = costs.detach().argsort(dim=1, stable=True)
    return SearchResult(best.codes, best.costs, _prior(task, config), _some(_picked(codes.detach(), order)))


def _tree(task: PlanningProblem, config: SearchConfig, hints: WarmStart) -> SearchResult:
    """A beam: each depth tries every move from the cheapest states so far, equals counted once, ties broken by the seed."""
    every = task.moves.all()
    width = max(1, config.samples * config.iterations // len(every))
    state, paths = task.state, torch.zeros(task.batch, 1, 0, task.moves.size)
    total = alive = None
    result = _Best()
    for depth in range(task.horizon):
        beam, grown = paths.shape[1], paths.shape[1] * len(every)
        tried = torch.cat(
            [
                paths.repeat_interleave(len(every), 1),
                every.repeat(beam, 1)[None, :, None].expand(task.batch, -1, -1, -1),
            ],
            2,
        )
        before = None if total is None else total.repeat_interleave(len(every), 1)
        going = None if alive is None else alive.repeat_interleave(len(every), 1)
        state, step, going, sure = task.move(state.fork(len(every)), tried[:, :, -1], going, grown)
        costs = task.cost.added(before, step)
        costs = torch.where(torch.isfinite(costs), costs, torch.inf)
        check_some(costs, task)
        if sure is not None and depth:
            task.shorten(depth, sure)
        tie = chance.uniform(torch.tensor(task.seeds), (grown,), _TREE + depth)
        order = _order(state, costs, tie, width)
        rows = (order + torch.arange(task.batch)[:, None] * grown).flatten()
        state, total = state.at(rows.to(state.device)), costs.gather(1, order)
        alive = None if going is None else going.gather(1, order)
        paths = _picked(tried, order)
        rest = torch.cat(
            [paths[:, 0], paths[:, 0, -1:].expand(-1, task.horizon - depth - 1, -1)], 1
        )  # what is left repeats
        result = _Best(*(result if depth else _Best(rest, total[:, 0])).where(task.known > depth, rest, total[:, 0]))
        if not bool((task.known > depth + 1).any()):
            break
    if hints.plan is not None:  # what was meant before stays, unless there is better
        before = _Best(hints.plan, task.evaluate(hints.plan[:, None], settled=True)[:, 0])
        before.look(result.codes, result.costs)
        result = before
    whole = paths.shape[2] == task.horizon
    return SearchResult(
        result.codes, result.costs, _prior(task, config), _some(paths) if whole else result.codes[:, None]
    )


def _order(state: State, costs: torch.Tensor, tie: torch.Tensor, width: int) -> torch.Tensor:
    """The candidates [B, <= width] to go on from, the cheapest first: of equal states one; padded with what is left over."""
    batch, count = costs.shape
    marks = _fingerprints(state).view(batch, count)
    rows = []
    for entry in range(batch):
        by_tie = tie[entry].argsort(stable=True)
        order = by_tie[costs[entry][by_tie].argsort(stable=True)]
        _, kind = torch.unique(marks[entry][order], return_inverse=True)
        first = torch.full((int(kind.max()) + 1,), count).scatter_reduce(0, kind, torch.arange(count), "amin")
        leads = torch.zeros(count, dtype=torch.bool).index_fill(0, first, True)
        rows.append(torch.cat([order[leads], order[~leads]])[:width])
    return torch.stack(rows)


def _fingerprints(state: State) -> torch.Tensor:
    """A number [B] by which equal states are known: a fixed random projection of all that is in them."""
    total = torch.zeros(state.batch, dtype=torch.float64)
    for number, name in enumerate(sorted(state)):
        flat = state[name].detach().cpu().double().reshape(state.batch, -1)
        along = torch.arange(1, flat.shape[1] + 1, dtype=torch.float64)
        total += (torch.nan_to_num(flat) * torch.frac(along * 0.7548776662466927 + number * 0.5698402909980532)).sum(1)
    return total


class _Best:
    """The cheapest plan of each episode so far."""

    def __init__(self, codes: torch.Tensor | None = None, costs: torch.Tensor | None = None):
        self.codes, self.costs = torch.zeros(0) if codes is None else codes, torch.zeros(0) if costs is None else costs

    def look(self, codes: torch.Tensor, costs: torch.Tensor, anew: torch.Tensor | None = None) -> None:
        """Keeps what is cheaper; where `anew`, what was before no longer compares."""
        if not len(self.costs):
            self.codes, self.costs = codes, costs
            return
        cheaper = costs < self.costs
        self.codes, self.costs = self.where(cheaper if anew is None else cheaper | anew, codes, costs)

    def where(self, which: torch.Tensor, codes: torch.Tensor, costs: torch.Tensor):
        return torch.where(which[:, None, None], codes, self.codes), torch.where(which, costs, self.costs)


def _weights(costs: torch.Tensor, temperature: float | None) -> torch.Tensor:
    """Of the elites' costs [B, E], ascending; those that are no number weigh nothing."""
    sound = torch.isfinite(costs)
    if temperature is None:
        return sound.float() / sound.sum(1, keepdim=True)
    away = torch.where(sound, costs - costs[:, :1], torch.inf)
    reach = torch.where(sound, away, 0.0).amax(1, keepdim=True).clamp_min(1e-12)
    return torch.softmax(-away / (temperature * reach), 1)


def _some(codes: torch.Tensor) -> torch.Tensor:
    """Of plans [B, N, H, D], the best first, the best, the median and the worst."""
    return codes[:, sorted({0, codes.shape[1] // 2, codes.shape[1] - 1})]


def _single(plan: torch.Tensor | None) -> torch.Tensor | None:
    return None if plan is None else plan[:, None]


def _prior(task: PlanningProblem, config: SearchConfig) -> torch.Tensor:
    return task.moves.first(task.batch, task.horizon, config.spread)


def _picked(codes: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    """The plans [B, M, H, D] in the order [B, N] of their numbers."""
    return codes.gather(1, order[..., None, None].expand(-1, -1, *codes.shape[2:]))


def _plain(state: State) -> State:
    """The state, out of inference mode."""
    if not any(tensor.is_inference() for tensor in state.values()):
        return state
    return State({name: tensor.clone() for name, tensor in state.items()}, state.arenas)


_SEARCHES: dict[str, Callable[[PlanningProblem, SearchConfig, WarmStart], SearchResult]] = {
    "cem": _sampled,
    "icem": _sampled,
    "mppi": _sampled,
    "gradient": _gradient,
    "tree": _tree,
    "random": _random,
}
