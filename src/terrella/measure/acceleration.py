"""Throughput of a world with fresh actions at each control step: imagined seconds per wall second, and energy."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ..core.state import State
from ..core.world import World, make_rng
from .statistics import Figure, last_step_above

POWERCAP = Path("/sys/class/powercap")
WATTS_OF_A_CORE = 10.0  # assumed without an energy counter
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


class EnergyMeter:
    """Joules since its construction: from RAPL if the machine has it, else processor seconds times an assumed power."""

    def __init__(self) -> None:
        self.files = sorted(file for file in POWERCAP.glob("*-rapl:?/energy_uj") if _of_a_processor(file))
        self._first, self._busy = self._readings(), time.process_time()

    @property
    def how(self) -> str:
        return "RAPL, the whole processor" if self.files else f"estimated: {WATTS_OF_A_CORE:g} W per busy core"

    def joules(self) -> float:
        if not self.files:
            return WATTS_OF_A_CORE * (time.process_time() - self._busy)
        # the value at which each counter wraps around
        most = [int((file.parent / "max_energy_range_uj").read_text()) + 1 for file in self.files]
        return sum((now - then) % wrap for now, then, wrap in zip(self._readings(), self._first, most)) / 1e6

    def _readings(self) -> list[int]:
        return [int(file.read_text()) for file in self.files]


@torch.inference_mode()
def measure_throughput(world: World, batch: int, seconds: float, seed: int = 0) -> Throughput:
    """Steps `batch` streams for about `seconds` of wall time with fresh uniform actions, rendering the channels of a learner."""
    rng, spec = make_rng(seed), world.spec
    shown = [name for name in LEARNERS if name in spec.channels]
    low, high = (torch.as_tensor(limit).float() for limit in spec.action_limits)
    state = _step(world, world.start(batch, rng), low, high, shown, rng)  # the first step may compile
    fresh, steps, meter, began = state, 0, EnergyMeter(), time.perf_counter()
    while (took := time.perf_counter() - began) < seconds or steps < 3:
        state = _step(world, state, low, high, shown, rng)
        steps += 1
        if steps % 50 == 0:
            state = fresh  # so that no episode is stepped after its end
    imagined = batch * steps * spec.dt_s
    return Throughput(batch, imagined / took, meter.joules() / imagined)


def _step(
    world: World, state: State, low: torch.Tensor, high: torch.Tensor, shown: Sequence[str], rng: torch.Generator
) -> State:
    action = low + (high - low) * torch.rand(state.batch, *low.shape, generator=rng)
    state = world.imagine(state, action, rng)
    world.render(state, shown)
    return state


@torch.inference_mode()
def usable_horizon(world: World, real: World, steps: int, episodes: int = 64, seed: int = 0) -> Figure:
    """The steps up to which the world predicts the real one better than holding the first observation does, from the same starts
    under the same random actions, in the channels that it observes."""
    rng, names = make_rng(seed), list(world.spec.observes)
    truth = real.start(episodes, rng)
    first = real.render(truth, names)
    state, gains = world.observe(first, None, rng), []
    low, high = (torch.as_tensor(limit).float() for limit in real.spec.action_limits)
    for _ in range(steps):
        action = low + (high - low) * torch.rand(episodes, *low.shape, generator=rng)
        truth, state = real.imagine(truth, action, rng), world.imagine(state, action, rng)
        seen, dreamt = real.render(truth, names), world.render(state, names)
        unit = {name: seen[name].float().std(0).clamp_min(1e-3) for name in names}
        error, held = (
            sum(((seen[name] - other[name]).float() / unit[name]).square().flatten(1).mean(1) for name in names)
            for other in (dreamt, first)
        )
        gains.append(torch.as_tensor(held - error))
    return last_step_above(torch.stack(gains, 1), torch.zeros(episodes), rng)


def _of_a_processor(file: Path) -> bool:
    """Whether a counter is readable and of one whole processor; that of the machine (psys) would count the same joules twice."""
    try:
        files = {name: (file.parent / name).read_text() for name in (file.name, "max_energy_range_uj", "name")}
        return all(files.values()) and files["name"].startswith("package")
    except OSError:
        return False
