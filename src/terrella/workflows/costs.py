"""`bench costs`: what a world costs in milliseconds, joules and bytes, per frame, per imagined second and per minute of play."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch

from .. import library
from ..core.errors import TerrellaError
from ..core.policy import Random
from ..core.world import World, make_rng
from ..learn.recipes.policy import device_of
from ..measure.acceleration import Throughput, measure_throughput
from ..measure.costs import WARM, EnergyMeter, growth, timed_play
from .opening import Device, Fast, load_named
from .progress import Progress, silent
from .results import jsonable, table_lines

SECONDS, HOLD = (
    2.0,
    (3, 40),
)  # to time imagination; steps for which a random action is held, as in `play --policy random`


@dataclass(frozen=True)
class CostsConfig:
    """Settings of `bench costs`."""

    minutes: float = 1.0  # Minutes of play, of the world's own time, over which memory is followed.
    batch: int = 64  # Episodes that are imagined together, without pictures.
    device: Device = "auto"
    fast: Fast = False
    seed: int = 0  # The same seed gives the same actions.


@dataclass(frozen=True)
class Costs:
    """What a world costs on this machine."""

    world: str
    dt_s: float
    steps: int  # of play
    frame_ms: float  # median of a step of one rollout, with its picture
    frame_joules: float
    imagined: tuple[Throughput, ...]  # without pictures: one rollout, and a batch
    session_bytes: int  # of the state and its rows of arenas at the end, without those with which every session begins
    added_bytes: float  # per minute of play, over its last half
    shared_bytes: int  # of rows with which every session begins, held once for all
    threads: int
    energy: str  # how joules were measured

    @property
    def watts(self) -> float:
        """Of play at the world's pace, or at the machine's where that is slower."""
        return self.frame_joules / max(self.dt_s, self.frame_ms / 1e3)

    @property
    def flat(self) -> bool:
        """Whether memory grows by less than 10 KiB per minute."""
        return self.added_bytes < 10 * 2**10

    def to_json(self) -> dict[str, Any]:
        return jsonable({**asdict(self), "watts": self.watts, "flat": self.flat})

    def summary(self) -> str:
        pace, label = 1e3 / self.frame_ms, "estimated" if self.energy.startswith("estimated") else "measured"
        own, shared = bytes_in_words(self.session_bytes), bytes_in_words(self.shared_bytes)
        grows = "flat" if self.flat else f"grows by {bytes_in_words(self.added_bytes)} per minute of play"
        rows = [["a frame, as a person plays", f"{self.frame_ms:.3g} ms", f"{self.frame_joules:.3g} J"]]
        for one in self.imagined:
            what = "of one rollout" if one.batch == 1 else f"of one of {one.batch:,} rollouts"
            rows.append(
                [f"an imagined second {what}, without pictures", f"{1e3 / one.aggregate:.3g} ms", f"{one.joules:.3g} J"]
            )
        return "\n".join(
            [
                f"{self.world}: {pace:.3g} frames/s on this machine, {self.watts:.3g} W while played ({label}); memory {grows}",
                "",
                *table_lines(["", "time", "energy"], rows),
                "",
                f"memory: {own} a session after {self.steps:,} steps, {grows}; besides {shared} with which every session begins",
                f"{self.threads} threads; joules {self.energy}",
            ]
        )


def measure_costs(world: str, config: CostsConfig | None = None, *, progress: Progress = silent) -> Costs:
    """Plays a world as a person would, with random actions, and imagines in it as a planner does: milliseconds, joules, bytes."""
    config = config or CostsConfig()
    if not (0 < config.minutes < math.inf and config.batch >= 1):
        raise TerrellaError("--minutes is a number above 0, and --batch is 1 or more.")
    mine = (
        library.load(world)
        if library.is_truth(world)
        else load_named(world, config.device, fast=config.fast, progress=progress)
    )
    return costs_of(mine, world, config, progress)


@torch.inference_mode()
def costs_of(mine: World, name: str, config: CostsConfig, progress: Progress = silent) -> Costs:
    """The same of a World."""
    spec, rng = mine.spec, make_rng(config.seed)
    steps, done = max(20, round(60 * config.minutes / spec.dt_s)), -WARM

    def tick(count: float) -> None:
        nonlocal done
        done += count
        if done > 0 and done % max(1, steps // 4) == 0:
            progress(f"{name}: {done:,.0f} of {steps:,} steps are played")

    start = mine.start(1, rng)
    played = timed_play(mine, start, Random(spec, HOLD), rng, steps, lambda: mine.start(1, rng), tick)
    sizes = [1] if spec.max_batch == 1 or not spec.forkable else [1, min(config.batch, spec.max_batch or config.batch)]
    imagined = (
        tuple(measure_throughput(mine, size, SECONDS, config.seed) for size in dict.fromkeys(sizes))
        if spec.forkable
        else ()
    )
    return Costs(
        name, spec.dt_s, steps, float(played["ms"].median()), float(played["joules"][0]), imagined,
        int(played["memory"][1, -1]), growth(played["memory"]) * 60 / spec.dt_s, int(played["shared"][0]),
        torch.get_num_threads(), EnergyMeter(device_of(mine).type == "cuda").how,
    )  # fmt: skip


def bytes_in_words(size: float) -> str:
    return f"{size / 2**20:.3g} MiB" if abs(size) >= 2**20 else f"{size / 2**10:.3g} KiB"
