"""How large a search can be that has to decide while somebody watches, and whether there is anything to decide by."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from ...core.state import State
from ...core.world import World, make_rng
from .costs import Cost
from .moves import moves_of
from .problem import PlanningProblem
from .searches import SearchConfig

_FEWEST_MOVES, _MOST_MOVES = 4, 16
_FEWEST_SAMPLES = 8
_HOLD_S, _AHEAD_S = (
    0.4,
    2.0,
)  # how long random actions are held, and how far ahead, to see whether a cost tells plans apart


@torch.no_grad()
def search_config_within(
    world: World, cost: Cost, state: State, budget_ms: float, block: int = 1, samples: int = 32
) -> tuple[SearchConfig, bool]:
    """An iCEM search from states like `state` [1] of which a round takes about `budget_ms` here and now, and whether it does: a
    slow world gets the smallest that makes sense. Other rounds follow while there is time; the plan before is gone on with."""
    config = SearchConfig("icem", samples, iterations=1, horizon=_MOST_MOVES, block=block, budget_ms=budget_ms)
    while True:
        step_ms = _step_ms(world, cost, state, config.samples)
        moves = int(budget_ms / (step_ms * block))
        if moves >= _FEWEST_MOVES or config.samples // 2 < _FEWEST_SAMPLES:
            fits = moves >= _FEWEST_MOVES
            return replace(config, horizon=min(max(moves, _FEWEST_MOVES), _MOST_MOVES)), fits
        config = replace(config, samples=config.samples // 2)


def _step_ms(world: World, cost: Cost, state: State, samples: int) -> float:
    """Of the fastest of three steps of that many plans, with what their cost is read off."""
    rng, ahead, fastest = make_rng(0), state.fork(samples), float("inf")
    for _ in range(3):
        action = world.spec.sample_action(samples, rng).to(ahead.device)
        began = time.perf_counter()
        ahead = world.imagine(ahead, action, rng)
        world.render(ahead, cost.channels)
        fastest = min(fastest, 1e3 * (time.perf_counter() - began))
    return max(fastest, 1e-3)


@torch.no_grad()
def cost_discriminates(world: World, cost: Cost, state: State, limit_s: float = 1.0, plans: int = 16) -> bool:
    """Whether random plans from `state` [1] cost different sums, or ends, in the next seconds: where all are worth the same,
    there is nothing to plan for. Gives up, and says no, after `limit_s`."""
    dt_s = world.spec.dt_s
    block = max(1, round(_HOLD_S / dt_s))
    moves = max(2, round(_AHEAD_S / dt_s / block))
    end, rng = time.perf_counter() + limit_s, make_rng(0)
    coded = moves_of(world.spec)
    task = PlanningProblem(world, coded, cost, state, cost.goal_of(0, 1), [0], moves, block)
    codes = coded.uniform(torch.randn(1, plans, moves, coded.size, generator=rng))
    ahead, alive, total = state.fork(plans), None, None
    for move in range(moves):
        ahead, step, alive, _ = task.move(ahead, codes[:, :, move], alive, plans)
        total = cost.added(total, step)
        if float(total.max() - total.min()) > 1e-6:
            return True
        if time.perf_counter() > end:
            return False
    return False
