"""Throughput of a world with fresh actions at each control step: imagined seconds per wall second, and energy."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..core.spec import BUTTONS, CHOICE
from ..core.state import State
from ..core.world import World, make_rng, without_end
from .costs import EnergyMeter
from .statistics import Figure, last_step_above

LEARNERS = ("observation", "reward", "done")  # channels rendered for a learner at each step


@dataclass(frozen=True)
class Throughput:
    """The throughput at one batch size."""

    batch: int
    aggregate: float  # imagined seconds per wall second, all streams together
    joules: float  # per imagined second

    @property
    def stream(self) -> float:
        return self.aggregate / self.batch


@torch.inference_mode()
def measure_throughput(world: World, batch: int, seconds: float, seed: int = 0) -> Throughput:
    """Steps `batch` streams for about `seconds` of wall time with fresh uniform actions, rendering the channels of a learner."""
    rng, spec = make_rng(seed), world.spec
    shown = [name for name in LEARNERS if name in spec.channels]
    if spec.action_mode in (BUTTONS, CHOICE):
        draw = lambda: spec.sample_action(batch, rng)  # noqa: E731
    else:
        low, high = (torch.as_tensor(limit).float() for limit in spec.action_limits)
        draw = lambda: low + (high - low) * torch.rand(batch, *low.shape, generator=rng)  # noqa: E731
    state = _step(world, world.start(batch, rng), draw(), shown, rng)  # the first step may compile
    fresh, steps, meter, began = state, 0, EnergyMeter(state.device.type == "cuda"), time.perf_counter()
    while (took := time.perf_counter() - began) < seconds or steps < 3:
        state = _step(world, state, draw(), shown, rng)
        steps += 1
        if steps % 50 == 0:
            state = fresh  # so that no episode is stepped after its end
    imagined = batch * steps * spec.dt_s
    return Throughput(batch, imagined / took, meter.joules() / imagined)


def _step(world: World, state: State, action: torch.Tensor, shown: Sequence[str], rng: torch.Generator) -> State:
    state = world.imagine(state, action, rng)
    world.render(state, shown)
    return state


@torch.inference_mode()
def usable_horizon(world: World, real: World, steps: int, episodes: int = 64, seed: int = 0) -> Figure:
    """The steps up to which the world predicts the real one better than holding the first observation does, from the same starts
    under the same random actions, in the channels that it observes. After the real end nothing is gained."""
    rng, names = make_rng(seed), list(world.spec.observes)
    truth = real.start(episodes, rng)
    first = real.render(truth, names)
    state, gains, over = world.observe(first, None, rng), [], torch.zeros(episodes, dtype=torch.bool)
    low, high = (torch.as_tensor(limit).float() for limit in real.spec.action_limits)
    for _ in range(steps):
        action = low + (high - low) * torch.rand(episodes, *low.shape, generator=rng)
        truth, state = real.imagine(truth, action, rng), world.imagine(without_end(state), action, rng)
        seen, dreamt = real.render(truth, names), world.render(state, names)
        unit = {name: seen[name].float().std(0).clamp_min(1e-3) for name in names}
        error, held = (
            sum(((seen[name] - other[name]).float() / unit[name]).square().flatten(1).mean(1) for name in names)
            for other in (dreamt, first)
        )
        gains.append(torch.as_tensor(held - error).masked_fill(over, 0))
        over |= truth["done"].bool().cpu() if "done" in truth else over
    return last_step_above(torch.stack(gains, 1), torch.zeros(episodes), rng)
