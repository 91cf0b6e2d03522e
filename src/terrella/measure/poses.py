"""Pose: the drift of the world's camera poses from the truth, in metres, radians, and relative to the path length."""

from collections.abc import Sequence

import numpy as np
import torch

from ..core.world import World
from .clips import Clip
from .error_series import Series, report
from .exam import CLIPS, ENDINGS, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric, rows_at
from .scorecard import COPY_LAST, PREDICTED, ProbeReport, Row
from .statistics import mean_interval, median_interval

LEAD = (
    "The camera pose predicted under the true actions against the true pose; copy-last keeps the last one. The table adds the "
    "distance as a share of the length of the true path."
)

WALKED_M = 0.5  # least path length for the relative distance


def series(
    exam: Exam, results: ExamResults, of: str, place: str, clips: Sequence[Clip], dreamt: Results
) -> list[Series]:
    """Distance and angle between the predicted and the true pose."""
    made, context = [], clips[0].context
    for name in [key.removesuffix("/where") for key in dreamt if key.endswith("/where")]:
        given = dreamt[f"{name}/where"].double()
        truth = torch.stack([rows_at(clips, name, context + step) for step in range(given.shape[1])], 1).double()
        last = rows_at(clips, name, context - 1).double()[:, None]
        far = [(some[..., :3] - truth[..., :3]).norm(dim=-1) for some in (given, last)]
        cosines = [(some[..., 3:] * truth[..., 3:]).sum(-1).abs().clamp(max=1) for some in (given, last)]
        turned = [2 * torch.arccos(half) for half in cosines]
        made += [Series(name, "distance", "m", -1, *far), Series(name, "turn", "rad", -1, *turned)]
    return made


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    names = exam.shared(world, "pose")
    if of == ENDINGS or not names:
        return []
    return [StepMetric(tuple(names), lambda seen, *_: {f"{name}/where": seen[name] for name in names})]


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole = report(exam, results, "pose", series)
    for place, clips, arm, motion, dreamt in results.dreams(exam, CLIPS, (PREDICTED,)):
        for made in series(exam, results, CLIPS, place, clips, dreamt):
            walked = torch.from_numpy(np.stack([clip.walked_m(made.channel) for clip in clips]))
            for step in exam.config.horizons if made.unit == "m" else ():
                went = walked[:, step - 1] > WALKED_M
                if went.any():
                    way = walked[went, step - 1]
                    shares = [100 * some[went, step - 1] / way for some in (made.values, made.copied)]
                    for what, figure in (("mean", mean_interval), ("median", median_interval)):
                        where = "pose", made.channel, f"distance over the way gone, {what}", "%", place, arm
                        mine, copied = (figure(share, exam.rng()) for share in shares)
                        whole.rows.append(Row(*where, motion, step, mine, -1, {COPY_LAST: copied}))
    return whole


def _missing(exam: Exam, world: World) -> str:
    return "" if exam.shared(world, "pose") else "needs pose, of the world and of the recording"


POSES = Probe("pose", "Position", LEAD, _missing, _report, _watch)
