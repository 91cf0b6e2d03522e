"""The largest search that fits a time budget, and whether a cost tells plans apart at all."""

import time
from dataclasses import replace

import torch

from ...core.state import State
from ...core.world import World, make_rng
from .costs import Cost
from .moves import moves_of
from .problem import PlanningProblem
from .searches import SearchConfig

_MIN_MOVES, _MAX_MOVES = 4, 16
_MIN_SAMPLES = 8
_HOLD_S, _AHEAD_S = 0.4, 2.0  # random plans that are compared: how long each move is held, and their length


@torch.no_grad()
def search_config_within(
    world: World, cost: Cost, state: State, budget_ms: float, block: int = 1, samples: int = 32
) -> tuple[SearchConfig, bool]:
    """An iCEM search from states like `state` [1], a round of which takes about `budget_ms` on this machine, and whether it does:
    a slow world gets the smallest search that makes sense. More rounds follow while there is time; each search is warm-started."""
    config = SearchConfig("icem", samples, iterations=1, horizon=_MAX_MOVES, block=block, budget_ms=budget_ms)
    while True:
        step_ms = _step_ms(world, cost, state, config.samples)
        moves = int(budget_ms / (step_ms * block))
        if moves >= _MIN_MOVES or config.samples // 2 < _MIN_SAMPLES:
            return replace(config, horizon=min(max(moves, _MIN_MOVES), _MAX_MOVES)), moves >= _MIN_MOVES
        config = replace(config, samples=config.samples // 2)


def _step_ms(world: World, cost: Cost, state: State, samples: int) -> float:
    """Milliseconds of the fastest of three steps of that many plans, with the channels that a search renders."""
    rng, ahead, fastest = make_rng(0), state.fork(samples), float("inf")
    for _ in range(3):
        action = world.spec.sample_action(samples, rng).to(ahead.device)
        began = time.perf_counter()
        ahead = world.imagine(ahead, action, rng)
        world.render(ahead, (*cost.channels, *cost.ends(world.spec)))
        fastest = min(fastest, 1e3 * (time.perf_counter() - began))
    return max(fastest, 1e-3)


@torch.no_grad()
def cost_discriminates(world: World, cost: Cost, state: State, limit_s: float = 1.0, plans: int = 16) -> bool:
    """Whether random plans from `state` [1] differ in cost within the next seconds; if not, there is nothing to plan for. False
    after `limit_s`."""
    dt_s = world.spec.dt_s
    block = max(1, round(_HOLD_S / dt_s))
    moves = max(2, round(_AHEAD_S / dt_s / block))
    end, rng = time.perf_counter() + limit_s, make_rng(0)
    coding = moves_of(world.spec)
    problem = PlanningProblem(world, coding, cost, state, cost.goal_of(0, 1), [0], moves, block)
    codes = coding.uniform(torch.randn(1, plans, moves, coding.size, generator=rng))
    ahead, alive, total = state.fork(plans), None, None
    for move in range(moves):
        ahead, step, alive, _ = problem.move(ahead, codes[:, :, move], alive, plans)
        total = cost.accumulate(total, step)
        if float(total.max() - total.min()) > 1e-6:
            return True
        if time.perf_counter() > end:
            return False
    return False
