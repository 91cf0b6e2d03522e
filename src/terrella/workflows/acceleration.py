"""`measure_acceleration`: how much faster than time a world imagines, beside a simulator of the same task."""

import statistics
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from .. import library
from ..act.planning import PlaySettings, play
from ..act.policies_by_name import policy_of
from ..core.errors import TerrellaError
from ..core.spec import BUTTONS, CHOICE
from ..core.world import World, make_rng
from ..learn.recipes.policy import device_of
from ..measure.acceleration import Throughput, measure_throughput, usable_horizon
from ..measure.costs import EnergyMeter
from ..measure.statistics import Figure, ratio_interval
from .opening import Device, load_named
from .progress import Progress, silent
from .real_environment import STEPS, check_alike
from .results import jsonable, table_lines

UNMEASURED = "not measured: the world does not observe what the simulator shows"


@dataclass(frozen=True)
class AccelerationConfig:
    """Settings of `measure_acceleration`."""

    beside: str | None = None
    """A simulator of the same task to compare with (mujoco:NAME), with the same actions and control step."""
    agent: str | None = None
    """Folder of a policy that was trained in the world. With --reference, the share of its return is measured."""
    reference: str | None = None  # Folder of a policy that was trained in the simulator --beside.
    batches: tuple[int, ...] = (1, 64, 1024, 4096)  # Batch sizes: episodes that are stepped at once.
    seconds: float = 1.0  # Seconds to time each batch size in each turn.
    turns: int = 3  # Repetitions, alternating between world and simulator; the median is reported.
    episodes: int = 50  # Episodes in the simulator of --agent, of --reference and of random actions.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same actions.


@dataclass(frozen=True)
class AccelerationResult:
    """The throughput of a world, and of a simulator beside it."""

    world: str
    beside: str | None
    control_step_s: float
    threads: int
    energy: str  # How joules were measured.
    throughput: Mapping[str, tuple[Throughput, ...]]  # `world` and `beside` -> the median of each batch size.
    usable_horizon: Figure | None = None
    """Steps for which the world predicts the simulator better than standing still; None where it cannot be measured."""
    return_retained: Figure | None = None  # Return of the agent above random actions, as a share of the reference's.

    def best(self, arm: str) -> Throughput:
        return max(self.throughput[arm], key=lambda one: one.aggregate)

    @property
    def ratio(self) -> float:
        """Imagined seconds of the world per simulated second, each at its best batch size."""
        return self.best("world").aggregate / self.best("beside").aggregate

    def to_json(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"world": self.world, "beside": self.beside, "control_step_s": self.control_step_s}
        facts |= {"threads": self.threads, "joules": self.energy}
        for arm, rows in self.throughput.items():
            facts[f"{arm}_paces"] = [{**asdict(one), "stream": one.stream} for one in rows]
        facts |= {f"{arm}_best": asdict(self.best(arm)) for arm in self.throughput}
        if self.beside is not None:
            horizon = self.usable_horizon
            facts |= {"ratio": self.ratio, "usable_horizon_steps": asdict(horizon) if horizon else UNMEASURED}
        if self.return_retained is not None:
            facts["return_retained"] = asdict(self.return_retained)
        return jsonable(facts)

    def summary(self) -> str:
        heads = ["", "streams", "imagined s / wall s", "of each stream", "J / imagined s"]
        names = {"world": self.world, "beside": str(self.beside)}
        rows = [
            [names[arm], f"{one.batch:,}", f"{one.aggregate:,.0f}", f"{one.stream:,.2f}", f"{one.joules:.3g}"]
            for arm, paces in self.throughput.items()
            for one in paces
        ]
        lines = [*table_lines(heads, rows), ""]
        step = f"{1e3 * self.control_step_s:g} ms"
        lines.append(f"a new random action every {step}; {self.threads} threads; joules {self.energy}")
        if self.beside is not None:
            verdict = f"{self.world} imagines {self.ratio:.2f} times as fast as {self.beside} steps, each at its best."
            lines.insert(0, f"{verdict}\n")
            horizon = f"{self.usable_horizon} steps, beyond which standing still predicts as well"
            lines.append(f"usable horizon: {horizon if self.usable_horizon else UNMEASURED}")
        missing = "not measured; give --agent, --reference and --beside"
        lines.append(f"return retained: {self.return_retained or missing}")
        return "\n".join(lines)


def measure_acceleration(
    world: str, config: AccelerationConfig | None = None, *, progress: Progress = silent
) -> AccelerationResult:
    """Times a world with a new random action at each control step, beside a simulator of the same task in the same run: imagined
    seconds per second, joules, the usable horizon, and the return that a policy trained in the world retains."""
    config = config or AccelerationConfig()
    if not config.batches or min(*config.batches, config.turns, config.episodes) < 1 or not config.seconds > 0:
        raise TerrellaError("--batches, --turns and --episodes are 1 or more, and --seconds is above 0.")
    if (config.agent is None) != (config.reference is None) or (config.agent and not config.beside):
        raise TerrellaError("the return retained needs all three: --agent, --reference and --beside.")
    mine = _without_pictures(world) if library.is_truth(world) else load_named(world, config.device, progress=progress)
    real = None if config.beside is None else _without_pictures(config.beside)
    arms = {"world": mine, **({"beside": real} if real else {})}
    for one in arms.values():
        limited = one.spec.action_mode not in (BUTTONS, CHOICE) and np.isfinite(one.spec.action_limits).all()
        if not (limited and one.spec.forkable):
            raise TerrellaError(
                f"{one.spec.name} is no world of many streams with axes that have limits; give another."
            )
    if real is not None:
        check_alike(mine.spec, real.spec)
    retained = None
    throughput = _timed(arms, config, progress)
    horizon = None if real is None else _usable_horizon(mine, real, config.seed)
    if real is not None and config.agent and config.reference:
        retained = return_retained(real, config.agent, config.reference, config.episodes, config.seed)
    energy = EnergyMeter(device_of(mine).type == "cuda").how
    threads = torch.get_num_threads()
    return AccelerationResult(
        world, config.beside, mine.spec.dt_s, threads, energy, throughput, horizon, retained
    )  # fmt: skip


def _timed(
    arms: Mapping[str, World], config: AccelerationConfig, progress: Progress
) -> dict[str, tuple[Throughput, ...]]:
    timed: dict[str, dict[int, list[Throughput]]] = {arm: {batch: [] for batch in config.batches} for arm in arms}
    for turn in range(config.turns):
        for batch in config.batches:
            for arm, one in arms.items():
                timed[arm][batch].append(measure_throughput(one, batch, config.seconds, config.seed + turn))
        progress(f"turn {turn + 1} of {config.turns} is timed")
    return {arm: tuple(_median(rows) for rows in by_batch.values()) for arm, by_batch in timed.items()}


def return_retained(real: World, agent: str, reference: str, episodes: int, seed: int) -> Figure:
    """The return of the agent above random actions, as a share of the reference's, from the same starts."""

    def returns(name: str) -> torch.Tensor:
        policy, steps = policy_of(name, real.spec, real), real.spec.max_episode_steps or STEPS
        played = play(real, policy, episodes, PlaySettings(steps), seed)
        return torch.tensor([one.reward for one in played.episodes])

    floor = returns("random")
    return ratio_interval(returns(agent) - floor, returns(reference) - floor, make_rng(seed))


def _without_pictures(name: str) -> World:
    if not name.startswith("mujoco:"):
        return library.load(name)
    return library.load(name, cameras=(), threads=torch.get_num_threads())


def _median(rows: list[Throughput]) -> Throughput:
    middle = statistics.median
    return Throughput(rows[0].batch, middle(one.aggregate for one in rows), middle(one.joules for one in rows))


def _usable_horizon(mine: World, real: World, seed: int) -> Figure | None:
    if not mine.spec.observes or any(name not in real.spec.channels for name in mine.spec.observes):
        return None
    return usable_horizon(mine, real, real.spec.max_episode_steps or STEPS, seed=seed)
