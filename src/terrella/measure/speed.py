"""Costs as a probe: milliseconds, joules and bytes of one imagined and rendered step of a single rollout, and their growth."""

import math
from collections.abc import Sequence
from functools import partial

import torch

from ..core.policy import Replay
from ..core.world import World
from .clips import Clip
from .costs import WARM, WATTS_OF_A_CORE, growth, timed_play
from .endurance import recorded_actions
from .exam import Exam, ExamResults, Probe
from .rollouts import Results, Tick, fold_context
from .scorecard import PREDICTED, ProbeReport, Row
from .statistics import Figure
from .work_units import Unit

LEAD = (
    "One imagined and rendered step of a single rollout: its time, its energy, and the memory that the rollout adds. It depends on "
    "the machine and its load."
)


def speed(
    world: World, clips: Sequence[Clip], rng: torch.Generator, steps: int = 400, tick: Tick = lambda done: None
) -> Results:
    """The results of `timed_play` after the context of the first clip, under recorded actions; and `threads` of torch."""
    state = fold_context(world, clips[:1], rng)
    policy = Replay(recorded_actions(world, clips, 1, steps + WARM, rng))
    timed = timed_play(world, state, policy, rng, steps, tick=tick)
    return {**timed, "threads": torch.tensor([torch.get_num_threads()])}


def _units(exam: Exam) -> list[Unit]:
    clips, steps = next(iter(exam.places.values())), exam.config.speed_steps
    units = []
    for arm, world in exam.arms.items() if steps else ():
        run = partial(speed, world, clips, exam.rng(5), steps)
        units.append(Unit(f"speed|{arm}|0", f"{arm}: speed", {(arm, "alone"): float(steps + WARM)}, run))
    return units


def rows_of(timed: Results, arm: str, place: str, dt_s: float) -> list[Row]:
    """The median time, its 95th percentile and its growth from the first to the last tenth; joules; the memory of the rollout at
    its end, and by how much that grows in a minute of play."""
    took = timed["ms"]
    steps, tenth = len(took), max(1, len(took) // 10)
    first, last = float(took[:tenth].median()), float(took[-tenth:].median())
    median, late = took.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
    threads = f"{int(timed['threads'][0])} threads"
    energy = f"estimated: {WATTS_OF_A_CORE:g} W per busy core" if timed["estimated"][0] else "RAPL, the whole processor"
    figures = [
        ("median", median, "ms", threads),
        ("95th percentile", late, "ms", threads),
        ("growth", 100 * (last / first - 1), "%", threads),
        ("energy of a frame", float(timed["joules"][0]), "J", energy),
        ("memory of a session", float(timed["memory"][1, -1]) / 2**10, "KiB", ""),
        ("memory added per minute of play", growth(timed["memory"]) * 60 / dt_s / 2**10, "KiB", ""),
    ]
    return [
        Row("speed", "", what, unit, place, arm, PREDICTED, steps, Figure(value, math.nan, math.nan, 1), -1, note=note)
        for what, value, unit, note in figures
    ]


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    place = next(iter(exam.places))
    timed = {arm: results.of("speed", arm) for arm in exam.arms}
    return ProbeReport([row for arm, one in timed.items() if one for row in rows_of(one, arm, place, exam.dt_s)])


SPEED = Probe("speed", "What does it cost?", LEAD, lambda exam, world: "", _report, units=_units, any_world=True)
