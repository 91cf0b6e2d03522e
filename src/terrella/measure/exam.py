"""The examination: arms, clips and settings, and the rollouts (dreams) that several probes share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch

from ..core.errors import ObservationError
from ..core.spec import can_idle
from ..core.world import World, make_rng
from .album import Album
from .clips import Clip
from .rollouts import Results, StepMetric, dream, fold_context, poses_at
from .scorecard import IDLE, OTHERS, PREDICTED, TRUE, ProbeReport, place_label
from .work_units import Unit

CLIPS, LONG, ENDINGS = "clips", "long", "endings"  # sets of clips: for figures, for drift, with ends of episodes
STORE_VERSION = 5  # of stored results; those of another version are measured again


@dataclass(frozen=True)
class ExamConfig:
    """The settings of an examination."""

    horizons: tuple[int, ...] = (1, 8, 32, 64, 128)  # steps at which figures are given
    control_horizons: tuple[int, ...] = (8, 32)  # steps at which true actions are compared with other actions and none
    drop: tuple[int, int] = (8, 64)  # steps between which the loss of PSNR is given
    batch: int = 16  # clips rolled out together
    strips: int = 3  # clips of each place whose pictures are kept
    true_motion: bool = True  # also along the true poses
    closure_deg: tuple[float, ...] = (90.0, 180.0)  # angles of the turns there and back
    closure_step_deg: float = 6.0  # angle of a step
    closure_walk: int = 100  # steps of the walk there and back; 0 for none
    closure_clips: int = 24  # clips of the closure probe
    long_steps: int = 1000  # of long rollouts; 0 for none
    still_steps: int = 1000  # of rollouts without actions; 0 for none
    long_rollouts: int = 8  # rollouts of either kind
    speed_steps: int = 400  # steps that are timed; 0 for none

    @staticmethod
    def quick(horizons: tuple[int, ...] = (1, 8, 32)) -> ExamConfig:
        """Takes doom-maze less than a minute on two cores."""
        return ExamConfig(
            horizons=horizons, control_horizons=(min(8, horizons[-1]),), batch=8, strips=1, true_motion=False, closure_deg=(180.0,),
            closure_step_deg=15.0, closure_walk=0, closure_clips=4, long_steps=0, still_steps=100, long_rollouts=4, speed_steps=50,
        )  # fmt: skip


@dataclass(frozen=True)
class Exam:
    """Worlds and the clips on which they are examined."""

    arms: Mapping[str, World]  # by name; the verdict is on the first
    sets: Mapping[str, Mapping[str, Sequence[Clip]]]  # CLIPS, LONG or ENDINGS -> place -> clips
    config: ExamConfig
    seed: int = 0
    going: Mapping[str, Sequence[np.ndarray]] = field(
        default_factory=dict
    )  # ENDINGS: bool [T] a clip, rows before the end
    album: Album | None = None  # real frames by place
    closing: Mapping[str, World] = field(default_factory=dict)  # more arms, for the closure probe alone
    _cache: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def places(self) -> Mapping[str, Sequence[Clip]]:
        return self.sets[CLIPS]

    @property
    def dt_s(self) -> float:
        return next(iter(self.arms.values())).spec.dt_s

    def of(self, clips: int) -> Exam:
        """The same examination on at most `clips` clips of each set and place."""
        sets = {kind: {place: some[:clips] for place, some in places.items()} for kind, places in self.sets.items()}
        going = {place: some[:clips] for place, some in self.going.items()}
        return replace(self, sets=sets, going=going, _cache={})

    def rng(self, number: int = 0) -> torch.Generator:
        """The generator for one purpose, independent of other draws."""
        return make_rng(self.seed + number)

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """The value of `make()`, computed once."""
        if name not in self._cache:
            self._cache[name] = make()
        return self._cache[name]

    def shared(self, world: World, *names: str) -> list[str]:
        """Channels of these kinds that the world and all clips have at the same shape, the main one first; none for a world that
        observes nothing."""
        if not world.spec.observes:
            return []
        clip = next(iter(self.places.values()))[0]
        both = [name for kind in names for name in world.spec.kinds(kind) if name in clip.channels]
        return [name for name in both if tuple(world.spec.channels[name].shape or ()) == clip.channels[name].shape[1:]]

    def follows_poses(self, world: World) -> bool:
        """Whether the world renders the view from a given pose."""
        clips, rng = next(iter(self.places.values()))[:1], self.rng()

        def works() -> bool:
            if "pose" not in world.spec.observes or clips[0].pose is None:
                return False
            try:
                world.observe({"pose": poses_at(clips, clips[0].context)}, fold_context(world, clips, rng), rng)
            except ObservationError:
                return False
            return True

        return self.once(f"poses {id(world)}", works)

    def fingerprint(self, identity: str = "") -> str:
        """The inputs on which stored results depend; of each clip its actions and the last context row."""

        def seen(clip: Clip) -> tuple:
            last = {name: _sum(array[clip.context - 1]) for name, array in clip.channels.items()}
            return int(clip.episode), int(clip.start), clip.context, clip.horizon, _sum(clip.action), last

        drawn = {}
        for kind, places in self.sets.items():
            drawn |= {f"{kind} {place}": list(map(seen, some)) for place, some in places.items()}
        arms = {arm: repr(world.spec) for arm, world in {**self.arms, **self.closing}.items()}
        return json.dumps([STORE_VERSION, identity, self.seed, asdict(self.config), arms, drawn])


@dataclass(frozen=True)
class ExamResults:
    """Results of units by kind, with the batches of clips joined."""

    results: Mapping[str, Results]

    def of(self, *kind: str) -> Results:
        """Empty if there are none of that kind."""
        return self.results.get("|".join(kind), {})

    def dreamt(self, of: str, arm: str, place: str, motion: str) -> Results:
        return self.of("dream", of, arm, place, motion)

    def dreams(
        self, exam: Exam, of: str, motions: Sequence[str] = (PREDICTED, TRUE)
    ) -> Iterator[tuple[str, Sequence[Clip], str, str, Results]]:
        """Place, clips, arm, motion and results of all rollouts of a set of clips."""
        for place, clips in exam.sets.get(of, {}).items():
            for arm, motion in product(exam.arms, motions):
                if dreamt := self.dreamt(of, arm, place, motion):
                    yield place, clips, arm, motion, dreamt


@dataclass(frozen=True)
class Probe:
    """A question to every arm that observes something."""

    name: str
    question: str  # heading of its section
    lead: str  # text below the heading
    missing: Callable[[Exam, World], str]  # what it needs and the world lacks ("needs pose"); "" if it applies
    report: Callable[[Exam, ExamResults], ProbeReport]
    # (exam, world, set of clips, number of the first clip) -> metrics of the shared rollouts
    watch: Callable[[Exam, World, str, int], list[StepMetric]] = lambda exam, world, of, first: []
    units: Callable[[Exam], list[Unit]] = lambda exam: []  # work besides the shared rollouts
    any_world: bool = False  # also for worlds that observe nothing


def batches(exam: Exam, world: World, clips: Sequence[Clip]) -> list[tuple[int, Sequence[Clip]]]:
    """(number of the first clip, clips) of batches as large as the settings and the world allow."""
    size = min(exam.config.batch, world.spec.max_batch or exam.config.batch)
    return [(first, clips[first : first + size]) for first in range(0, len(clips), size)]


def motions_of(exam: Exam, world: World, of: str, clips: Sequence[Clip]) -> dict[str, int]:
    """The kinds of rollouts of a set of clips, and their steps."""
    if not world.spec.observes:
        return {}
    config = exam.config
    steps = clips[0].horizon if of != CLIPS else max(config.horizons)
    motions = {PREDICTED: steps}
    if of == ENDINGS:
        return motions
    if config.true_motion and exam.follows_poses(world):
        motions[TRUE] = steps
    control = [step for step in config.control_horizons if step <= steps]
    if of == CLIPS and control:
        motions |= {OTHERS: max(control)} if len(clips) > 1 else {}
        motions |= {IDLE: max(control)} if can_idle(world.spec) else {}
    return motions


def dreams(exam: Exam, probes: Sequence[Probe]) -> list[Unit]:
    """The shared rollouts, in batches; all arms have the same clips, random numbers and "other" actions."""
    sets = ((of, place, clips) for of, places in exam.sets.items() for place, clips in places.items())
    return [
        unit
        for of, place, clips in sets
        for arm, world in exam.arms.items()
        for motion, steps in motions_of(exam, world, of, clips).items()
        for unit in _dreams(exam, (of, arm, place, motion), world, clips, steps, probes)
    ]


def _dreams(exam: Exam, names: tuple[str, ...], world: World, clips: Sequence[Clip], steps: int, probes) -> list[Unit]:
    of, arm, place, motion = names
    order = torch.randperm(len(clips), generator=exam.rng(1)).tolist()
    turn = {pick: order[(at + 1) % len(order)] for at, pick in enumerate(order)}
    units, verb = [], "pose" if motion == TRUE else "imagine"
    under = motion + " motion" if motion in (PREDICTED, TRUE) else motion
    words = f"{arm}, {place_label(place)}, {under}, {steps} steps"
    for number, (first, some) in enumerate(batches(exam, world, clips)):
        watches = [watch for probe in probes for watch in probe.watch(exam, world, of, first)]
        others = [clips[turn[first + at]] for at in range(len(some))]
        calls = {(arm, "observe"): len(some) * some[0].context, (arm, verb): len(some) * steps}
        run = partial(dream, world, some, motion, steps, exam.rng(1000 + first), watches, others)
        units += [Unit(f"dream|{'|'.join(names)}|{number}", words, calls, run)] if watches else []
    return units


def _sum(values: np.ndarray) -> float:
    return float(np.asarray(values, np.float64).sum())
