"""Speed: milliseconds of one imagined and rendered step of a single rollout, and their growth over time."""

import math
import time
from collections.abc import Sequence
from functools import partial

import torch

from ..core.policy import Replay
from ..core.spec import kind_of
from ..core.world import World
from .clips import Clip
from .endurance import recorded_actions
from .exam import Exam, ExamResults, Probe
from .rollouts import Results, Tick, fold_context
from .scorecard import PREDICTED, ProbeReport, Row
from .statistics import Figure
from .work_units import Unit

LEAD = "One imagined and rendered step of a single rollout, in milliseconds. It depends on the machine and its load."
_WARM = 10


def speed(
    world: World, clips: Sequence[Clip], rng: torch.Generator, steps: int = 400, tick: Tick = lambda done: None
) -> Results:
    """ms [steps] after the context of the first clip, under recorded actions, after ten untimed steps; `threads` of torch."""
    state = fold_context(world, clips[:1], rng)
    shown = tuple(name for name in world.spec.channels if kind_of(name) == "rgb") or tuple(world.spec.channels)
    policy = Replay(recorded_actions(world, clips, 1, steps + _WARM, rng))
    memory, times = policy.begin(1, rng), []
    for _ in range(steps + _WARM):
        began = time.perf_counter()
        action, memory = policy.act({}, memory, rng)
        state = world.imagine(state, action, rng)
        for tensor in world.render(state, shown).values():
            tensor.cpu()
        times.append((time.perf_counter() - began) * 1e3)
        tick(1)
    took = torch.tensor(times[_WARM:], dtype=torch.float64)
    return {"ms": took, "threads": torch.tensor([torch.get_num_threads()])}


def _units(exam: Exam) -> list[Unit]:
    clips, steps = next(iter(exam.places.values())), exam.config.speed_steps
    units = []
    for arm, world in exam.arms.items() if steps else ():
        run = partial(speed, world, clips, exam.rng(5), steps)
        units.append(Unit(f"speed|{arm}|0", f"{arm}: speed", {(arm, "alone"): float(steps + _WARM)}, run))
    return units


def rows_of(timed: Results, arm: str, place: str) -> list[Row]:
    """The median, the 95th percentile, and the growth from the first to the last tenth."""
    took = timed["ms"]
    steps, tenth = len(took), max(1, len(took) // 10)
    first, last = float(took[:tenth].median()), float(took[-tenth:].median())
    median, late = took.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
    figures = {"median": (median, "ms"), "95th percentile": (late, "ms"), "growth": (100 * (last / first - 1), "%")}
    note = f"{int(timed['threads'][0])} threads"
    return [
        Row("speed", "", what, unit, place, arm, PREDICTED, steps, Figure(value, math.nan, math.nan, 1), -1, note=note)
        for what, (value, unit) in figures.items()
    ]


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    place = next(iter(exam.places))
    timed = {arm: results.of("speed", arm) for arm in exam.arms}
    return ProbeReport([row for arm, one in timed.items() if one for row in rows_of(one, arm, place)])


SPEED = Probe("speed", "Speed", LEAD, lambda exam, world: "", _report, units=_units, any_world=True)
