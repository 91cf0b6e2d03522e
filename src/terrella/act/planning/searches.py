"""Searches for cheap plans: CEM, iCEM, MPPI, random shooting, gradient descent, and a beam search over discrete actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch

from ...core import chance
from ...core.errors import PlanningError
from ...core.spec import cuts_plans, measured_trust
from ...core.state import State
from ...core.world import World
from .moves import ContinuousMoves, coloured
from .problem import PlanningProblem, check_finite_costs

_MAX_ROUNDS = 10_000  # of a search with a time budget
_LEARNING_RATE = 0.1  # of Adam, in codes
_TREE_STREAM, _WHITE = 1 << 20, 0.0

Kind = Literal["cem", "icem", "mppi", "gradient", "tree", "random"]


@dataclass(frozen=True)
class SearchConfig:
    """How a planner searches for plans, and how much of a plan it executes."""

    # The search method. icem: CEM with coloured noise and kept elites (Pinneri et al. 2020). cem: the cross-entropy method of
    # Rubinstein (1999), as in PETS. mppi: Williams et al. (2017), over elites as in TD-MPC2. gradient: Adam on the actions, in
    # differentiable worlds. tree: beam search, for discrete actions. random: random shooting.
    search: Kind = "icem"
    samples: int = 0
    """Candidate plans per round. 0 means 64, or 32 to walk to a place. A tree expands samples x iterations moves per depth."""
    iterations: int = 0  # Rounds per decision. 0 means 5, or 1 to walk to a place.
    horizon: int = 0  # Moves per plan. 0 means 12, or 4 to walk to a place.
    block: int = 0  # Environment steps for which each move is held. 0 means 1 step, or 0.115 s to walk to a place.
    replan: int = 0
    """Moves that are executed before the next plan is made. 0 means 1, or the whole plan with the cost `last`."""
    # Milliseconds per decision, in place of `iterations`; at least one round is done. Results then depend on the speed of the
    # machine: the same seed need not give the same plan.
    budget_ms: float | None = None
    # A plan is cut short at the step where half of the candidates exceed this value of the world's channel `invented`, or of
    # `uncertainty` where it has no such channel. Without it, `terrella plan` and the policy `plan` use the threshold that the world
    # declares, if any; in a latent world they cut no plan.
    trust: float | None = None
    elites: int = 0
    """Best candidates of a round, to which the sampling distribution is fitted. 0 means an eighth of the samples."""
    spread: float = 0.5  # Initial standard deviation of an action axis, as a share of half its range.
    momentum: float = 0.1  # Weight of the old sampling distribution when it is fitted to the elites.
    colour: float = 2.0  # Exponent of the power spectrum of icem's noise: 0 is white, 2 is red.
    keep: float = 0.3  # Share of icem's elites that are tried again in the next round.
    decay: float = 1.25  # Factor by which icem's samples shrink per round.
    temperature: float = 0.5  # Temperature of mppi, as a share of the range of the elites' costs.

    def __post_init__(self):
        counts = (self.samples, self.iterations, self.horizon, self.block, self.replan, self.elites)
        if min(counts) < 0 or self.samples == 1:
            raise PlanningError("samples must be 2 or more; iterations, horizon, block and replan 1 or more.")
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

    def within(self, steps: int) -> SearchConfig:
        """The same, without zeros, with plans of at most `steps` environment steps; at least one move."""
        horizon = max(1, min(self.horizon, steps // self.block))
        return replace(self, horizon=horizon, replan=min(self.replan, horizon))

    @property
    def elite_count(self) -> int:
        return min(self.elites or max(2, self.samples // 8), self.samples)


def within_measured_trust(world: World, search: SearchConfig) -> SearchConfig:
    """The search, without zeros, with plans no longer than the measured trust horizon of the world's card; as it is where there
    is none, in a latent world, or where `trust` is set."""
    steps = measured_trust(world.spec) if cuts_plans(world.spec) else None
    return search if steps is None or search.trust is not None else search.within(steps)


@dataclass(frozen=True)
class WarmStart:
    """What a search starts from; None for nothing."""

    belief: torch.Tensor | None = None  # [B, H, D, K], of the decision before, shifted
    plan: torch.Tensor | None = None  # [B, H, D], the best of the decision before, shifted
    proposed: torch.Tensor | None = None  # [B, M, H, D], of a policy

    def plans(self) -> list[torch.Tensor]:
        """Plans to evaluate in the first round, [B, M, H, D] each."""
        return [each for each in (None if self.plan is None else self.plan[:, None], self.proposed) if each is not None]


@dataclass(frozen=True)
class SearchResult:
    """The best plans, and what the next decision may start from."""

    plan: torch.Tensor  # [B, H, D]
    cost: torch.Tensor  # [B]
    belief: torch.Tensor  # [B, H, D, K]
    considered: torch.Tensor  # [B, M, H, D]: the best, the median and the worst plan of the last round, if it has three


def search(problem: PlanningProblem, config: SearchConfig, start: WarmStart | None = None) -> SearchResult:
    """The best plan of each episode. PlanningError if all candidates of an episode have infinite cost, or the search does not
    suit the actions."""
    return _SEARCHES[config.search](problem, config.filled(), start or WarmStart())


def _rounds(config: SearchConfig) -> Iterator[int]:
    if config.budget_ms is None:
        yield from range(config.iterations)
        return
    end = time.perf_counter() + config.budget_ms / 1e3
    for number in range(_MAX_ROUNDS):
        if number and time.perf_counter() >= end:
            return
        yield number


def _search_by_sampling(problem: PlanningProblem, config: SearchConfig, start: WarmStart) -> SearchResult:
    """CEM, iCEM and MPPI. iCEM returns the best plan of all rounds, the others the last mean if its cost is finite."""
    moves, seeds, icem = problem.moves, torch.tensor(problem.seeds), config.search == "icem"
    belief = _initial(problem, config) if start.belief is None else moves.widen(start.belief, config.spread)
    best = _Best()
    elites = codes = torch.zeros(problem.batch, 0, problem.horizon, moves.size)
    for number in _rounds(config):
        fewer = max(2 * config.elite_count, int(config.samples * config.decay**-number)) if icem else config.samples
        count = min(config.samples, fewer)
        noise = coloured(seeds, count, problem.horizon, moves.size, config.colour if icem else _WHITE, number)
        kept = [elites[:, : max(1, int(config.keep * config.elite_count))], moves.mode(belief)[:, None]]
        given = start.plans() if not number else kept if icem else []
        most = max(count, sum(each.shape[1] for each in given))
        codes = torch.cat([*given, moves.sample(belief, noise)], 1)[:, :most]
        costs = problem.evaluate(codes)
        check_finite_costs(costs, problem)
        order = costs.argsort(dim=1, stable=True)
        codes, costs = _picked(codes, order), costs.gather(1, order)
        elites = codes[:, : config.elite_count]
        best.update(codes[:, 0], costs[:, 0], problem.shortened)
        weights = _weights(costs[:, : config.elite_count], config.temperature if config.search == "mppi" else None)
        belief = config.momentum * belief + (1 - config.momentum) * moves.fit(elites, weights)
    if not icem:
        mean = moves.mode(belief)
        cost = problem.evaluate(mean[:, None], fixed_horizon=True)[:, 0]
        best = _Best(*best.where(torch.isfinite(cost), mean, cost))
    return SearchResult(best.codes, best.costs, belief, _some(codes))


def _search_at_random(problem: PlanningProblem, config: SearchConfig, start: WarmStart) -> SearchResult:
    """The best of uniformly drawn plans, and of those of the warm start."""
    moves, seeds, best = problem.moves, torch.tensor(problem.seeds), _Best()
    codes = torch.zeros(0)
    for number in _rounds(config):
        noise = coloured(seeds, config.samples, problem.horizon, moves.size, _WHITE, number)
        codes = torch.cat([*(start.plans() if not number else []), moves.uniform(noise)], 1)
        costs = problem.evaluate(codes)
        order = costs.argsort(dim=1, stable=True)
        codes = _picked(codes, order)
        best.update(codes[:, 0], costs.gather(1, order)[:, 0], problem.shortened)
    check_finite_costs(best.costs[:, None], problem)
    return SearchResult(best.codes, best.costs, _initial(problem, config), _some(codes))


def _search_by_gradient(problem: PlanningProblem, config: SearchConfig, start: WarmStart) -> SearchResult:
    """Adam (Kingma & Ba 2015) on all candidates at once, within the limits; the best plan of all rounds."""
    moves, spec, best = problem.moves, problem.world.spec, _Best()
    if not isinstance(moves, ContinuousMoves):
        raise PlanningError(f"the actions of {spec.name} are discrete and have no gradient; use icem, cem or tree.")
    if not spec.differentiable:
        raise PlanningError(f"no gradients flow through {spec.name} (Spec.differentiable); use icem, cem or mppi.")
    noise = coloured(torch.tensor(problem.seeds), config.samples, problem.horizon, moves.size, config.colour, 0)
    codes = torch.cat([*start.plans(), moves.sample(_initial(problem, config), noise)], 1)[:, : config.samples]
    with torch.inference_mode(False), torch.enable_grad():
        problem.state, codes = _without_inference(problem.state), codes.clone().requires_grad_()
        first, second, taken = torch.zeros_like(codes), torch.zeros_like(codes), 0
        costs = torch.zeros(0)
        for _ in _rounds(config):
            costs = problem.evaluate(codes)
            check_finite_costs(costs, problem)
            least, which = costs.detach().min(1)
            best.update(_picked(codes.detach(), which[:, None])[:, 0].clone(), least, problem.shortened)
            (slope,) = torch.autograd.grad(costs[torch.isfinite(costs)].sum(), codes)
            slope, taken = torch.nan_to_num(slope, 0.0, 0.0, 0.0), taken + 1
            first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope.square()
            descent = first / (1 - 0.9**taken) / ((second / (1 - 0.999**taken)).sqrt() + 1e-8)
            codes = (codes.detach() - _LEARNING_RATE * descent).clamp(-1, 1).requires_grad_()
    order = costs.detach().argsort(dim=1, stable=True)
    return SearchResult(best.codes, best.costs, _initial(problem, config), _some(_picked(codes.detach(), order)))


def _search_tree(problem: PlanningProblem, config: SearchConfig, start: WarmStart) -> SearchResult:
    """Beam search: each depth tries every move from the cheapest states; equal states are merged, the seed breaks ties."""
    branches = problem.moves.all()
    width = max(1, config.samples * config.iterations // len(branches))
    state, paths = problem.state, torch.zeros(problem.batch, 1, 0, problem.moves.size)
    total = alive = None
    result = _Best()
    for depth in range(problem.horizon):
        beam, grown = paths.shape[1], paths.shape[1] * len(branches)
        tried = torch.cat(
            [
                paths.repeat_interleave(len(branches), 1),
                branches.repeat(beam, 1)[None, :, None].expand(problem.batch, -1, -1, -1),
            ],
            2,
        )
        before = None if total is None else total.repeat_interleave(len(branches), 1)
        going = None if alive is None else alive.repeat_interleave(len(branches), 1)
        state, step, going, trusted = problem.move(state.fork(len(branches)), tried[:, :, -1], going, grown)
        costs = problem.cost.accumulate(before, step)
        costs = torch.where(torch.isfinite(costs), costs, torch.inf)
        check_finite_costs(costs, problem)
        if trusted is not None and depth:
            problem.shorten(depth, trusted)
        tie = chance.uniform(torch.tensor(problem.seeds), (grown,), _TREE_STREAM + depth)
        order = _order(state, costs, tie, width)
        rows = (order + torch.arange(problem.batch)[:, None] * grown).flatten()
        state, total = state.at(rows.to(state.device)), costs.gather(1, order)
        alive = None if going is None else going.gather(1, order)
        paths = _picked(tried, order)
        repeated = paths[:, 0, -1:].expand(-1, problem.horizon - depth - 1, -1)
        plan = torch.cat([paths[:, 0], repeated], 1)  # the last move fills the horizon
        result = result if depth else _Best(plan, total[:, 0])
        result = _Best(*result.where(problem.trusted_moves > depth, plan, total[:, 0]))
        if not bool((problem.trusted_moves > depth + 1).any()):
            break
    if start.plan is not None:  # the previous plan stays unless a better one was found
        before = _Best(start.plan, problem.evaluate(start.plan[:, None], fixed_horizon=True)[:, 0])
        before.update(result.codes, result.costs)
        result = before
    considered = _some(paths) if paths.shape[2] == problem.horizon else result.codes[:, None]
    return SearchResult(result.codes, result.costs, _initial(problem, config), considered)


def _order(state: State, costs: torch.Tensor, tie: torch.Tensor, width: int) -> torch.Tensor:
    """Indices [B, <= width] of the candidates to expand, cheapest first: one of equal states, then duplicates as padding."""
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
    """A hash [B] of each state: a fixed pseudo-random projection of all of its tensors."""
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

    def update(self, codes: torch.Tensor, costs: torch.Tensor, reset: torch.Tensor | None = None) -> None:
        """Keeps the cheaper plan; where `reset` [B], the new one in any case."""
        if not len(self.costs):
            self.codes, self.costs = codes, costs
            return
        cheaper = costs < self.costs
        self.codes, self.costs = self.where(cheaper if reset is None else cheaper | reset, codes, costs)

    def where(self, which: torch.Tensor, codes: torch.Tensor, costs: torch.Tensor):
        return torch.where(which[:, None, None], codes, self.codes), torch.where(which, costs, self.costs)


def _weights(costs: torch.Tensor, temperature: float | None) -> torch.Tensor:
    """Weights of the elites from their costs [B, E], ascending; 0 for costs that are not finite."""
    valid = torch.isfinite(costs)
    if temperature is None:
        return valid.float() / valid.sum(1, keepdim=True)
    regret = torch.where(valid, costs - costs[:, :1], torch.inf)
    span = torch.where(valid, regret, 0.0).amax(1, keepdim=True).clamp_min(1e-12)
    return torch.softmax(-regret / (temperature * span), 1)


def _some(codes: torch.Tensor) -> torch.Tensor:
    """The best, the median and the worst of plans [B, N, H, D] in order of cost."""
    return codes[:, sorted({0, codes.shape[1] // 2, codes.shape[1] - 1})]


def _initial(problem: PlanningProblem, config: SearchConfig) -> torch.Tensor:
    return problem.moves.initial(problem.batch, problem.horizon, config.spread)


def _picked(codes: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    """Plans [B, M, H, D] at indices [B, N]."""
    return codes.gather(1, order[..., None, None].expand(-1, -1, *codes.shape[2:]))


def _without_inference(state: State) -> State:
    """The state as tensors that gradients may flow through."""
    if not any(tensor.is_inference() for tensor in state.values()):
        return state
    return State({name: tensor.clone() for name, tensor in state.items()}, state.arenas)


_SEARCHES: dict[str, Callable[[PlanningProblem, SearchConfig, WarmStart], SearchResult]] = {
    "cem": _search_by_sampling,
    "icem": _search_by_sampling,
    "mppi": _search_by_sampling,
    "gradient": _search_by_gradient,
    "tree": _search_tree,
    "random": _search_at_random,
}
