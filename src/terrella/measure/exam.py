"""What is asked of whom: the arms, the clips, the settings; and the dreams of them that several probes read."""

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

CLIPS, LONG, ENDINGS = "clips", "long", "endings"  # sets of clips: of figures, of drift, those that may run into an end
KEPT = 2  # the form in which results are kept; those of another form are measured again


@dataclass(frozen=True)
class ExamConfig:
    """horizons: steps at which figures are given; control_horizons: where true actions are set against another player's and
    against none; batch: clips rolled together; strips: clips of each place whose pictures are kept; drop: PSNR at the
    first horizon less that at the second; true_motion: also along the true poses; closure_deg: how far the camera turns
    before it comes back; closure_walk: steps of the walk there and back, 0 for none; long_steps: of the long rollouts,
    still_steps: of those in which nobody acts, speed_steps: each 0 for none."""

    horizons: tuple[int, ...] = (1, 8, 32, 64, 128)
    control_horizons: tuple[int, ...] = (8, 32)
    drop: tuple[int, int] = (8, 64)
    batch: int = 16
    strips: int = 3
    true_motion: bool = True
    closure_deg: tuple[float, ...] = (90.0, 180.0)
    closure_step_deg: float = 6.0
    closure_walk: int = 100
    closure_clips: int = 24
    long_steps: int = 1000
    still_steps: int = 1000
    long_rollouts: int = 8
    speed_steps: int = 400

    @staticmethod
    def quick(horizons: tuple[int, ...] = (1, 8, 32)) -> ExamConfig:
        """Of which doom-maze is through within a minute on two cores."""
        return ExamConfig(
            horizons=horizons, control_horizons=(min(8, horizons[-1]),), batch=8, strips=1, true_motion=False, closure_deg=(180.0,),
            closure_step_deg=15.0, closure_walk=0, closure_clips=4, long_steps=0, still_steps=100, long_rollouts=4, speed_steps=50,
        )  # fmt: skip


@dataclass(frozen=True)
class Exam:
    """arms: the worlds by name, the first is the one that is asked about; sets: CLIPS, LONG and ENDINGS by place; going: of
    ENDINGS, bool [T] a clip, rows whose action was played; album: real frames by place; closing: more arms, of which only
    memory is asked; seed: of everything that is drawn."""

    arms: Mapping[str, World]
    sets: Mapping[str, Mapping[str, Sequence[Clip]]]
    config: ExamConfig
    seed: int = 0
    going: Mapping[str, Sequence[np.ndarray]] = field(default_factory=dict)
    album: Album | None = None
    closing: Mapping[str, World] = field(default_factory=dict)
    _known: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def places(self) -> Mapping[str, Sequence[Clip]]:
        return self.sets[CLIPS]

    @property
    def dt_s(self) -> float:
        return next(iter(self.arms.values())).spec.dt_s

    def of(self, clips: int) -> Exam:
        """The same on no more than so many clips of each set and place."""
        sets = {kind: {place: some[:clips] for place, some in places.items()} for kind, places in self.sets.items()}
        going = {place: some[:clips] for place, some in self.going.items()}
        return replace(self, sets=sets, going=going, _known={})

    def rng(self, number: int = 0) -> torch.Generator:
        """Chance for one purpose: always the same, whatever was drawn before."""
        return make_rng(self.seed + number)

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` gives, made once."""
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]

    def shared(self, world: World, *names: str) -> list[str]:
        """Channels of these kinds that the world shows and every clip holds at the world's shape, the main one first; none
        where the world takes no evidence."""
        if not world.spec.observes:
            return []
        clip = next(iter(self.places.values()))[0]
        both = [name for kind in names for name in world.spec.kinds(kind) if name in clip.channels]
        return [name for name in both if tuple(world.spec.channels[name].shape or ()) == clip.channels[name].shape[1:]]

    def follows_poses(self, world: World) -> bool:
        """Whether the world draws what is seen from a pose that it is given."""
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
        """What must be the same for kept results to count; of every clip its actions and the last row that a world is shown."""

        def seen(clip: Clip) -> tuple:
            last = {name: _sum(array[clip.context - 1]) for name, array in clip.channels.items()}
            return int(clip.episode), int(clip.start), clip.context, clip.horizon, _sum(clip.action), last

        drawn = {
            f"{kind} {place}": list(map(seen, some))
            for kind, places in self.sets.items()
            for place, some in places.items()
        }
        arms = {arm: repr(world.spec) for arm, world in {**self.arms, **self.closing}.items()}
        return json.dumps([KEPT, identity, self.seed, asdict(self.config), arms, drawn])


@dataclass(frozen=True)
class ExamResults:
    """Results of units by kind, batches of clips as one."""

    results: Mapping[str, Results]

    def of(self, *kind: str) -> Results:
        """Empty where nothing of that kind was done."""
        return self.results.get("|".join(kind), {})

    def dreamt(self, of: str, arm: str, place: str, motion: str) -> Results:
        return self.of("dream", of, arm, place, motion)

    def dreams(
        self, exam: Exam, of: str, motions: Sequence[str] = (PREDICTED, TRUE)
    ) -> Iterator[tuple[str, Sequence[Clip], str, str, Results]]:
        """Place, clips, arm, motion and results of all that was dreamt of a set of clips."""
        for place, clips in exam.sets.get(of, {}).items():
            for arm, motion in product(exam.arms, motions):
                if dreamt := self.dreamt(of, arm, place, motion):
                    yield place, clips, arm, motion, dreamt


@dataclass(frozen=True)
class Probe:
    """A question to every arm that takes evidence, and where `any_world` to the others too. name and `question` head its
    section, `lead` is the text below; missing(exam, world): what it needs and lacks ("needs pose"), "" where it can be
    asked; watch(exam, world, of): what it keeps of the dreams that the probes share; units: work of its own; report:
    figures of what was found."""

    name: str
    question: str
    lead: str
    missing: Callable[[Exam, World], str]
    report: Callable[[Exam, ExamResults], ProbeReport]
    watch: Callable[[Exam, World, str, int], list[StepMetric]] = lambda exam, world, of, first: []
    units: Callable[[Exam], list[Unit]] = lambda exam: []
    any_world: bool = False


def batches(exam: Exam, world: World, clips: Sequence[Clip]) -> list[tuple[int, Sequence[Clip]]]:
    """(number of the first clip, clips) of as many clips at once as is asked for and the world takes."""
    size = min(exam.config.batch, world.spec.max_batch or exam.config.batch)
    return [(first, clips[first : first + size]) for first in range(0, len(clips), size)]


def motions_of(exam: Exam, world: World, of: str, clips: Sequence[Clip]) -> dict[str, int]:
    """What is dreamt of a set of clips, and for how many steps."""
    if not world.spec.observes:
        return {}
    config = exam.config
    steps = clips[0].horizon if of != CLIPS else max(config.horizons)
    found = {PREDICTED: steps}
    if of == ENDINGS:
        return found
    if config.true_motion and exam.follows_poses(world):
        found[TRUE] = steps
    control = [step for step in config.control_horizons if step <= steps]
    if of == CLIPS and control:
        found |= {OTHERS: max(control)} if len(clips) > 1 else {}
        found |= {IDLE: max(control)} if can_idle(world.spec) else {}
    return found


def dreams(exam: Exam, probes: Sequence[Probe]) -> list[Unit]:
    """The dreams that the probes watch, in batches; arms see the same clips, random numbers and "other" actions."""
    asked = ((of, place, clips) for of, places in exam.sets.items() for place, clips in places.items())
    return [
        unit
        for of, place, clips in asked
        for arm, world in exam.arms.items()
        for motion, steps in motions_of(exam, world, of, clips).items()
        for unit in _dreams(exam, (of, arm, place, motion), world, clips, steps, probes)
    ]


def _dreams(exam: Exam, names: tuple[str, ...], world: World, clips: Sequence[Clip], steps: int, probes) -> list[Unit]:
    of, arm, place, motion = names
    order = torch.randperm(len(clips), generator=exam.rng(1)).tolist()
    turn = {pick: order[(at + 1) % len(order)] for at, pick in enumerate(order)}
    units, verb = [], "pose" if motion == TRUE else "imagine"
    words = (
        f"{arm}, {place_label(place)}, {motion + ' motion' if motion in (PREDICTED, TRUE) else motion}, {steps} steps"
    )
    for number, (first, some) in enumerate(batches(exam, world, clips)):
        watches = [watch for probe in probes for watch in probe.watch(exam, world, of, first)]
        others = [clips[turn[first + at]] for at in range(len(some))]
        calls = {(arm, "observe"): len(some) * some[0].context, (arm, verb): len(some) * steps}
        run = partial(dream, world, some, motion, steps, exam.rng(1000 + first), watches, others)
        units += [Unit(f"dream|{'|'.join(names)}|{number}", words, calls, run)] if watches else []
    return units


def _sum(values: np.ndarray) -> float:
    return float(np.asarray(values, np.float64).sum())
