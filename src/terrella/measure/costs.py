"""Costs of a world: milliseconds, joules and bytes, per interactive frame and per imagined second."""

import time
from collections.abc import Callable
from pathlib import Path

import torch

from ..core import nvml
from ..core.policy import Policy
from ..core.spec import kind_of
from ..core.state import State, memory_of
from ..core.world import World
from .rollouts import Results, Tick

POWERCAP = Path("/sys/class/powercap")
WATTS_OF_A_CORE = 10.0  # assumed without an energy counter
WARM = 10  # steps before the first that is timed
SAMPLES = 20  # of the memory of a rollout


class EnergyMeter:
    """Joules since its construction. Of the processors by RAPL if its counters may be read, else processor seconds times an assumed
    power. cuda: also of the first GPU, by NVML if the driver has it."""

    def __init__(self, cuda: bool = False) -> None:
        self.files = sorted(file for file in POWERCAP.glob("*-rapl:?/energy_uj") if _of_a_processor(file))
        locked = not self.files and any(POWERCAP.glob("*-rapl:?/energy_uj"))
        self._gpu_mj = nvml.energy_mj() if cuda else None
        self._first, self._busy = self._readings(), time.process_time()
        self._first_mj = self._gpu_mj() if self._gpu_mj else 0
        self.estimated = not self.files
        self.how = "RAPL, the whole processor"
        if self.estimated:
            self.how = f"estimated: {WATTS_OF_A_CORE:g} W per busy core"
            self.how += "; RAPL's counters may be read by root alone" if locked else ""
        self.how += "" if not cuda else ", and the GPU by NVML" if self._gpu_mj else ", without the GPU"

    def joules(self) -> float:
        gpu = (self._gpu_mj() - self._first_mj) / 1e3 if self._gpu_mj else 0.0
        if self.estimated:
            return gpu + WATTS_OF_A_CORE * (time.process_time() - self._busy)
        # the value at which each counter wraps around
        most = [int((file.parent / "max_energy_range_uj").read_text()) + 1 for file in self.files]
        return gpu + sum((now - then) % wrap for now, then, wrap in zip(self._readings(), self._first, most)) / 1e6

    def _readings(self) -> list[int]:
        return [int(file.read_text()) for file in self.files]


def timed_play(
    world: World,
    state: State,
    policy: Policy,
    rng: torch.Generator,
    steps: int,
    restart: Callable[[], State] | None = None,
    tick: Tick = lambda done: None,
) -> Results:
    """Plays one rollout as a person sees it, each step with its picture, after ten untimed steps. restart: gives the state after an
    episode's end.

    ms [steps]; joules [1] a step, with `estimated` [1] (bool); memory [2, K]: step, and bytes of the state and its arena rows that
    the first state does not hold; shared [1], the bytes of arena rows that it does."""
    shown = tuple(name for name in world.spec.channels if kind_of(name) == "rgb") or tuple(world.spec.channels)
    ends = restart is not None and "done" in world.spec.channels
    own = {key: size for key, size in memory_of([state]).items() if isinstance(key, tuple)}
    memory, times, held = policy.begin(1, rng), [], []
    meter = EnergyMeter(state.device.type == "cuda")
    for step in range(-WARM, steps):
        if step == 0:
            meter = EnergyMeter(state.device.type == "cuda")
        began = time.perf_counter()
        action, memory = policy.act({}, memory, rng)
        state = world.imagine(state, action, rng)
        seen = world.render(state, (*shown, "done") if ends else shown)
        for tensor in seen.values():
            tensor.cpu()
        times.append((time.perf_counter() - began) * 1e3)
        if step >= 0 and (step + 1) % max(1, steps // SAMPLES) == 0:
            held.append((step + 1, _bytes(state, own)))
        if ends and restart is not None and bool(seen["done"][0]):
            state, memory = restart(), policy.begin(1, rng)
        tick(1)
    return {
        "ms": torch.tensor(times[WARM:], dtype=torch.float64),
        "joules": torch.tensor([meter.joules() / steps], dtype=torch.float64),
        "estimated": torch.tensor([meter.estimated]),
        "memory": torch.tensor(held, dtype=torch.float64).T,
        "shared": torch.tensor([sum(own.values())], dtype=torch.float64),
    }


def growth(memory: torch.Tensor) -> float:
    """Bytes a step by which `memory` [2, K] of `timed_play` grows over its last half, by least squares; 0.0 where it is flat."""
    step, size = memory[:, memory.shape[1] // 2 :]
    step = step - step.mean()
    return float((step * (size - size.mean())).sum() / step.square().sum().clamp_min(1))


def _bytes(state: State, own: dict) -> int:
    return sum(size for key, size in memory_of([state]).items() if key not in own)


def _of_a_processor(file: Path) -> bool:
    """Whether a counter is readable and of one whole processor; that of the machine (psys) would count the same joules twice."""
    try:
        files = {name: (file.parent / name).read_text() for name in (file.name, "max_energy_range_uj", "name")}
        return all(files.values()) and files["name"].startswith("package")
    except OSError:
        return False
