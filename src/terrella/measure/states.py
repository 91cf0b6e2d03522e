"""State vectors: normalised error, R2, and the steps for which they are predicted better than by copying."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..core.spec import kind_of
from ..core.world import World
from .clips import Clip
from .error_series import Series, report
from .exam import CLIPS, ENDINGS, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric
from .scorecard import ProbeReport, Row
from .statistics import Figure, last_step_above, ratio_interval

LEAD = (
    "RMS error of each predicted vector, each number in units of its standard deviation in these recordings. R\u00b2 is the share "
    "of the variance that is predicted: 1 is all, 0 is no better than the mean."
)
NOT_VECTORS = (
    "rgb", "depth", "pose", "reward", "done", "uncertainty", "drifted", "invented", "known", "keyframes", "text",
    "instruction",
)  # fmt: skip


def vectors(exam: Exam, world: World) -> list[str]:
    """The channels of numbers, of one axis at most, that both the world and the recording have."""
    clip = next(iter(exam.places.values()))[0]
    names = []
    for name, space in world.spec.channels.items():
        plain = kind_of(name) not in NOT_VECTORS and np.dtype(space.dtype).kind == "f"
        if plain and len(space.shape or ()) <= 1 and name in clip.channels:
            if int(np.prod(space.shape or (1,))) == int(np.prod(clip.channels[name].shape[1:])):
                names.append(name)
    return names


@dataclass(frozen=True)
class _Vector:
    """A recorded channel of all clips in standard deviations, without constant numbers."""

    values: torch.Tensor  # [n, T, D]
    unit: torch.Tensor  # standard deviation of each number
    varies: torch.Tensor  # bool of each number
    context: int

    @staticmethod
    def of(clips: Sequence[Clip], name: str) -> _Vector:
        whole = torch.stack([torch.from_numpy(np.array(clip.channels[name], np.float64)) for clip in clips])
        whole = whole.reshape(*whole.shape[:2], -1)
        unit = whole.flatten(0, 1).std(0, correction=0)
        varies = unit > 1e-6 * whole.abs().amax((0, 1)).clamp_min(1e-6)
        return _Vector((whole / unit)[..., varies], unit, varies, clips[0].context)

    def errors(self, given: torch.Tensor) -> torch.Tensor:
        """Predictions [n, T, ...] minus the truth after the context: [n, T, D]."""
        mine = (given.double().reshape(*given.shape[:2], -1) / self.unit)[..., self.varies]
        return mine - self.values[:, self.context : self.context + mine.shape[1]]

    def copy_errors(self, steps: int) -> torch.Tensor:
        """The last context row minus the truth: [n, steps, D]."""
        return self.values[:, self.context - 1 : self.context] - self.values[:, self.context : self.context + steps]


def series(
    exam: Exam, results: ExamResults, of: str, place: str, clips: Sequence[Clip], dreamt: Results
) -> list[Series]:
    """Normalised RMSE of every predicted vector."""
    made = []
    for name in [key.removesuffix("/vector") for key in dreamt if key.endswith("/vector")]:
        vector, given = _Vector.of(clips, name), dreamt[f"{name}/vector"]
        if vector.varies.any():
            parts = [
                part.square().mean(-1).sqrt() for part in (vector.errors(given), vector.copy_errors(given.shape[1]))
            ]
            made.append(Series(name, "RMSE", "\u03c3", -1, *parts))
    return made


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    if of == ENDINGS:
        return []
    names = vectors(exam, world)
    metric = StepMetric(tuple(names), lambda seen, *_: {f"{name}/vector": seen[name] for name in names})
    return [metric] if names else []


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole = report(exam, results, "state", series)
    for place, clips, arm, motion, dreamt in results.dreams(exam, CLIPS):
        for made in series(exam, results, CLIPS, place, clips, dreamt):
            where = "state", made.channel
            steps = made.values.shape[1]
            usable = last_step_above(made.gain, torch.zeros(len(clips)), exam.rng())
            words = "steps better than copy-last"
            whole.rows.append(Row(*where, words, "steps", place, arm, motion, steps, usable, 1))
            vector = _Vector.of(clips, made.channel)
            errors = vector.errors(dreamt[f"{made.channel}/vector"])
            for step in exam.config.horizons:
                share = _explained(exam, vector, errors, step)
                whole.rows.append(Row(*where, "R\u00b2", "", place, arm, motion, step, share, 1))
    return whole


def _explained(exam: Exam, vector: _Vector, errors: torch.Tensor, step: int) -> Figure:
    """1 - squared error / squared deviation from the mean of that step, both summed over clips."""
    truth = vector.values[:, vector.context - 1 + step]
    left = ratio_interval(errors[:, step - 1].square().sum(1), (truth - truth.mean(0)).square().sum(1), exam.rng())
    return Figure(1 - left.value, 1 - left.high, 1 - left.low, left.count)


def _missing(exam: Exam, world: World) -> str:
    return "" if vectors(exam, world) else "needs a vector of numbers, of the world and of the recording"


STATES = Probe("state", "State vectors", LEAD, _missing, _report, _watch)
