"""The plans that a planner considered, imagined once more so that a person can see their outcomes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from ...core.world import World, make_rng
from .costs import Cost
from .planner import PlannerMemory


class ImaginedFuture(NamedTuple):
    """The outcome of a plan: its cost, and pictures uint8 [T, H, W, 3], evenly spread from now to its end."""

    cost: float
    pictures: torch.Tensor


def imagined_futures(
    world: World, cost: Cost, memory: PlannerMemory, block: int = 1, count: int = 6, channel: str = "rgb"
) -> Iterator[list[ImaginedFuture] | None]:
    """The futures of the plans that the last decision considered, the best first. Before them None is yielded after each imagined
    step, so that the caller can do other work in between. Yields nothing without a decision."""
    decision = memory.decision
    if decision is None or decision.state is None:
        return
    plans = decision.considered.repeat_interleave(block, 1)[:, : max(1, decision.trusted_moves) * block]
    total = alive = None
    pictures: list[torch.Tensor] = []
    times = np.linspace(0, plans.shape[1], count).round().astype(int).tolist()
    rng, state = make_rng(memory.seed), decision.state.fork(len(plans))
    read = [*cost.channels, *cost.ends(world.spec)]
    for step in range(plans.shape[1] + 1):
        if step:
            with torch.no_grad():
                state = world.imagine(state, plans[:, step - 1].to(state.device), rng)
                seen = {name: value[None] for name, value in world.render(state, read).items()}
                price = cost.expected(cost.step_cost(seen, decision.goal).cpu(), alive)
                alive = cost.survival(seen, alive)
                total = cost.accumulate(total, price)
                if state.deferred is not None:  # render step by step, not all at the end
                    state.deferred.values()
        if step in times:
            pictures += [world.render(state, (channel,))[channel].cpu()] * times.count(step)
        yield None
    assert total is not None
    yield [ImaginedFuture(float(price), frames) for price, frames in zip(total[0], torch.stack(pictures, 1))]
