"""Figures and curves of any error measure, compared with copy-last, other actions and no action; and drift."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from ..core.spec import kind_of
from .clips import Clip
from .exam import CLIPS, LONG, Exam, ExamResults, Probe
from .rollouts import Results
from .scorecard import COPY_LAST, GAIN, IDLE, OTHERS, PREDICTED, TRUE, Curve, ProbeReport, Row
from .statistics import Band, last_step_above, mean_band, mean_interval, ratio_band

FALL_DB = 10 * math.log10(2)  # twice the squared error


@dataclass(frozen=True)
class Series:
    """A measure at every step of n clips."""

    channel: str
    what: str
    unit: str
    better: int  # +1 or -1, as in Row
    values: torch.Tensor  # [n, T], of the predictions
    copied: torch.Tensor  # [n, T], of the last context row, repeated
    counts: torch.Tensor | None = None  # [n, T] pixels, if the others are summed squared errors, for pooled PSNR

    @property
    def gain(self) -> torch.Tensor:
        """[n, T]: the gain over copying."""
        return self.better * (self.values - self.copied)

    def band(self, exam: Exam, values: torch.Tensor) -> Band:
        """The reported figure of `values` at each step."""
        if self.counts is None:
            return mean_band(values, exam.rng())
        return ratio_band(255.0**2 * self.counts[:, : values.shape[1]], values, exam.rng()).in_db()

    def gains(self, exam: Exam) -> Band:
        """The gain over copying, clip by clip, at each step."""
        if self.counts is None:
            return mean_band(self.gain, exam.rng())
        return ratio_band(self.copied, self.values, exam.rng()).in_db()


Where = tuple[str, str, str, str, str]  # probe, channel, what, unit, place
# (exam, results, set of clips, place, clips, results of a rollout) -> series
SeriesOf = Callable[[Exam, ExamResults, str, str, Sequence[Clip], Results], list[Series]]


def report(exam: Exam, results: ExamResults, probe: str, series_of: SeriesOf) -> ProbeReport:
    """Rows at the horizons and curves at every step, of all arms and places."""
    whole = ProbeReport()
    for place, clips in exam.places.items():
        copied: set[str] = set()
        for arm in exam.arms:
            made = {
                motion: _predicted(motion, series_of(exam, results, CLIPS, place, clips, dreamt))
                for motion in (PREDICTED, TRUE, OTHERS, IDLE)
                if (dreamt := results.dreamt(CLIPS, arm, place, motion))
            }
            for motion in (PREDICTED, TRUE):
                for number, series in enumerate(made.get(motion, ())):
                    controls = {name: made[name][number] for name in (OTHERS, IDLE) if name in made}
                    where = probe, series.channel, series.what, series.unit, place
                    whole.rows += _rows(exam, where, arm, motion, series, controls)
                    if series.counts is not None:
                        continue
                    whole.curves.append(_curve(exam, where, arm, motion, series.values))
                    if (name := f"{series.channel} {series.what}") not in copied:
                        copied.add(name)
                        whole.curves.append(_curve(exam, where, COPY_LAST, "", series.copied))
            whole.rows += _control(exam, place, arm, made)
            whole.curves += [_gain(exam, probe, place, arm, made[PREDICTED])] if made.get(PREDICTED) else []
    return whole


def drift(exam: Exam, results: ExamResults, series_of: SeriesOf) -> ProbeReport:
    """The curves of the long clips, and the usable horizon of each.

    PSNR is usable up to the last step before it has fallen by 3.01 dB (twice the squared error) from its own first step, and
    from that of copy-last, one threshold for all; other measures as long as they are better than copy-last.
    """
    whole, still = ProbeReport(), dict[Where, Series]()
    for place, clips, arm, motion, dreamt in results.dreams(exam, LONG):
        for series in _predicted(motion, series_of(exam, results, LONG, place, clips, dreamt)):
            where = "drift", series.channel, series.what, series.unit, place
            _add_usable(exam, whole, where, arm, motion, series.values, series)
            still.setdefault(where, series)
    for where, series in still.items():
        _add_usable(exam, whole, where, COPY_LAST, "", series.copied, series)
    return whole


def _predicted(motion: str, made: list[Series]) -> list[Series]:
    """Without the poses if those were given."""
    return [series for series in made if motion != TRUE or kind_of(series.channel) != "pose"]


def _rows(
    exam: Exam, where: Where, arm: str, motion: str, series: Series, controls: dict[str, Series]
) -> Iterator[Row]:
    """The rows at each horizon with a finite value."""
    mine, gains, others = series.band(exam, series.values), series.gains(exam), {COPY_LAST: series.copied}
    if motion == PREDICTED:
        others |= {name: other.values for name, other in controls.items()}
    bands = {name: series.band(exam, values) for name, values in others.items()}
    for step in exam.config.horizons:
        if math.isfinite(mine.value[step - 1]):
            baselines = {name: band.at(step - 1) for name, band in bands.items() if step <= len(band.value)}
            yield Row(*where, arm, motion, step, mine.at(step - 1), series.better, baselines, gains.at(step - 1))


def _gain(exam: Exam, probe: str, place: str, arm: str, made: list[Series]) -> Curve:
    """The gain of the main measure: of pictures, pooled PSNR."""
    lead = next((series for series in made if series.counts is not None), made[0])
    where = probe, lead.channel, f"{lead.what}{GAIN}", lead.unit, place, arm, PREDICTED
    return Curve(*where, range(1, lead.values.shape[1] + 1), lead.gains(exam), guides=(0.0,))


def _curve(exam: Exam, where: Where, arm: str, motion: str, values: torch.Tensor) -> Curve:
    return Curve(*where, arm, motion, range(1, values.shape[1] + 1), mean_band(values, exam.rng()))


def _control(exam: Exam, place: str, arm: str, made: dict[str, list[Series]]) -> list[Row]:
    """The gain of true actions over those of another clip and over none, clip by clip; of pooled errors, the main one."""
    rows, lead = [], next((series.what for series in made.get(PREDICTED, ()) if series.counts is not None), None)
    for name in (OTHERS, IDLE):
        for mine, theirs in zip(made.get(PREDICTED, ()), made.get(name, ())):
            for step in exam.config.control_horizons if mine.counts is None or mine.what == lead else ():
                if step <= theirs.values.shape[1]:
                    values = mine.values[:, step - 1 : step], theirs.values[:, step - 1 : step]
                    if mine.counts is None:
                        better = mean_interval(mine.better * (values[0] - values[1])[:, 0], exam.rng())
                    else:
                        better = ratio_band(values[1], values[0], exam.rng()).in_db().at(0)
                    what = f"{mine.what}: true actions over {name}"
                    where = "control", mine.channel, what, mine.unit, place, arm, PREDICTED, step
                    rows.append(Row(*where, better, 1))
    return rows


def _add_usable(
    exam: Exam, whole: ProbeReport, where: Where, arm: str, motion: str, values: torch.Tensor, series: Series
) -> None:
    steps, mark = values.shape[1], None
    if series.unit == "dB":
        thresholds = {
            "steps within twice its first error": values[:, 0] - FALL_DB,
            "steps within twice copy-last's first error": series.copied[:, 0] - FALL_DB,
        }
        usable = {what: last_step_above(values, floor, exam.rng()) for what, floor in thresholds.items()}
        mark = next(iter(usable.values())).value
    elif arm == COPY_LAST:
        usable = {}
    else:
        usable = {"steps better than copy-last": last_step_above(series.gain, torch.zeros(len(values)), exam.rng())}
    probe, channel, what, unit, place = where
    for words, figure in usable.items():
        whole.rows.append(Row(probe, channel, f"{what}: {words}", "steps", place, arm, motion, steps, figure, 1))
    curve = _curve(exam, (probe, channel, what, unit, place), arm, motion, values)
    whole.curves.append(Curve(*where, arm, motion, curve.x, curve.band, mark or None))


def drift_probe(series_of: Sequence[SeriesOf]) -> Probe:
    """The drift probe, of all series of the other probes."""

    def missing(exam: Exam, world: object) -> str:
        return "" if exam.sets.get(LONG) else "needs longer clips"

    def drift_report(exam: Exam, results: ExamResults) -> ProbeReport:
        parts = [drift(exam, results, some) for some in series_of]
        return ProbeReport(
            [row for part in parts for row in part.rows], [curve for part in parts for curve in part.curves]
        )

    lead = (
        "The same at every step of longer clips. A dot marks the last step at which the squared error is within twice that of the "
        "first step (the curve has fallen by 3 dB); the table adds the same threshold from the first step of copy-last."
    )
    return Probe("drift", "How far can it be used?", lead, missing, drift_report)
