"""Risk-coverage: does the uncertainty of a world predict the errors of its frames?

The risk at coverage c is the mean error of the share c of most certain frames (El-Yaniv and Wiener 2010); the area under that
curve (AURC, Geifman et al. 2019) is the mean error in a random order, and least in the order of the errors (oracle).
"""

from collections.abc import Sequence

import torch

from ..core.world import World
from .clips import Clip
from .exam import CLIPS, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric, rows_at
from .scorecard import PREDICTED, TRUE, Curve, ProbeReport, Row
from .statistics import Band, figure_of

RESAMPLES = 400
POINTS, BINS = 50, 8
LEAD = (
    "The world predicts the error of each of its frames. If the least certain frames are left out, how large is the mean absolute "
    "error of the rest (in % of full brightness)? AURC is the area under that curve; a random order gives the mean error, an "
    "oracle orders by the errors. The calibration error is the mean difference of expected and measured errors in eight bins."
)
_ORDERS = ("by its own order", "by an oracle", "by chance")


def risk_coverage_report(
    place: str, arm: str, motion: str, error: torch.Tensor, uncertainty: torch.Tensor, rng: torch.Generator
) -> ProbeReport:
    """From errors (mean absolute, intensities 0 to 1) and uncertainties [n, T] of the frames of n clips; in %, with intervals over
    clips. `order quality`: the share of the gap between random order and oracle that the order closes."""
    clips, steps = error.shape
    wrong, expected = 100 * error.flatten().double(), 100 * uncertainty.flatten().double()
    clip = torch.arange(clips).repeat_interleave(steps)
    picks = torch.randint(clips, (RESAMPLES, clips), generator=rng)
    weights = torch.zeros(RESAMPLES + 1, clips, dtype=torch.float64)
    weights[0] = 1  # the clips as they are
    weights[1:].scatter_add_(1, picks, torch.ones(RESAMPLES, clips, dtype=torch.float64))
    orders = [by.argsort(stable=True) for by in (expected, wrong)]
    areas, least = (_area(weights[:, clip[order]], wrong[order]) for order in orders)
    shares = weights / weights.sum(1, keepdim=True) / steps
    chance, mean_expected = shares[:, clip] @ wrong, shares[:, clip] @ expected
    off = torch.zeros(len(weights), dtype=torch.float64)
    for part in orders[0].tensor_split(BINS):
        off += (shares[:, clip[part]] @ (wrong[part] - expected[part])).abs()
    where, report = ("calibration", "rgb"), ProbeReport()
    reference = {
        "by chance": figure_of(chance[0], chance[1:], clips),
        "by an oracle": figure_of(least[0], least[1:], clips),
    }
    closed = 100 * (chance - areas) / (chance - least).clamp_min(1e-12)
    for what, values, better, baselines in (
        ("AURC", areas, -1, reference),
        ("order quality", closed, 1, {}),
        ("error expected", mean_expected, 0, {"error found": figure_of(chance[0], chance[1:], clips)}),
        ("calibration error", off, -1, {}),
    ):
        figure = figure_of(values[0], values[1:], clips)
        report.rows.append(Row(*where, what, "%", place, arm, motion, steps, figure, better, baselines))
    at = [max(1, round(len(wrong) * (k + 1) / POINTS)) - 1 for k in range(POINTS)]
    x = [100 * (k + 1) / len(wrong) for k in at]
    count = torch.arange(1, len(wrong) + 1)
    running = [(wrong[order].cumsum(0) / count)[at].tolist() for order in orders] + [[float(chance[0])] * POINTS]
    for name, y in zip(_ORDERS, running):
        band = Band(y, y, y, clips)
        report.curves.append(Curve(*where, "mean error of the surest", "%", place, f"{arm}, {name}", motion, x, band))
    return report


def _frame_errors(seen, clips: Sequence[Clip], row: int, step: int) -> Results:
    error = (seen["rgb"].float() - rows_at(clips, "rgb", row).float()).abs().mean((1, 2, 3)) / 255
    return {"error": error, "uncertainty": seen["uncertainty"]}


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    applies = of == CLIPS and not _missing(exam, world)
    return [StepMetric(("rgb", "uncertainty"), _frame_errors)] if applies else []


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    """Each place by itself, and all together."""
    whole = ProbeReport()
    for arm in exam.arms:
        for motion in (PREDICTED, TRUE):
            parts = {place: results.dreamt(CLIPS, arm, place, motion) for place in exam.places}
            known = {place: (part["error"], part["uncertainty"]) for place, part in parts.items() if "error" in part}
            if len(known) > 1:
                error, uncertainty = zip(*known.values())
                known["all"] = torch.cat(error), torch.cat(uncertainty)
            for place, (error, uncertainty) in known.items():
                one = risk_coverage_report(place, arm, motion, error, uncertainty, exam.rng())
                whole.rows += one.rows
                whole.curves += one.curves if motion == PREDICTED else []
    return whole


def _missing(exam: Exam, world: World) -> str:
    if "uncertainty" not in world.spec.channels:
        return "needs uncertainty, a channel of the world"
    if "picture" not in world.spec.units.get("uncertainty", "picture"):
        return "needs an uncertainty of pictures"
    return "" if "rgb" in exam.shared(world, "rgb") else "needs rgb"


CALIBRATION = Probe("calibration", "Is its uncertainty calibrated?", LEAD, _missing, _report, _watch)


def _area(weights: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """The area under the risk-coverage curve [R] of errors [N] in order, with weights [R, N]."""
    covered = weights.cumsum(1)
    running = (weights * error).cumsum(1) / covered.clamp_min(1e-12)
    return (weights * running).sum(1) / covered[:, -1]
