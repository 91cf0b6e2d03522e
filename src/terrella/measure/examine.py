"""The whole examination in one call: every probe on every arm, with results stored as they come."""

import time
from collections.abc import Sequence
from pathlib import Path

import torch

from .clips import check_clips
from .closure import MEMORY
from .endurance import ENDURANCE, STILLNESS
from .error_series import drift_probe
from .exam import LONG, Exam, ExamResults, Probe, dreams
from .outcomes import OUTCOMES
from .overlap import OVERLAP
from .page import page
from .pixels import PIXELS
from .pixels import series as pixel_series
from .poses import POSES
from .poses import series as pose_series
from .risk import CALIBRATION
from .scorecard import Missing, PlaceSummary, Scorecard
from .speed import SPEED
from .states import STATES
from .states import series as state_series
from .trust import TRUST
from .verdict import to_json
from .work_units import Calls, Clock, Forecast, Progress, Store, prices_of, run_all, writing

DRIFT = drift_probe((pixel_series, state_series, pose_series))
PROBES: tuple[Probe, ...] = (
    PIXELS,
    OVERLAP,
    STATES,
    POSES,
    DRIFT,
    CALIBRATION,
    TRUST,
    OUTCOMES,
    MEMORY,
    STILLNESS,
    ENDURANCE,
    SPEED,
)


@torch.inference_mode()
def examine(
    exam: Exam,
    folder: Path | None = None,
    identity: str = "",
    progress: Progress = lambda share, words, left_s: None,
    clock: Clock = time.monotonic,
    probes: Sequence[Probe] = PROBES,
) -> Scorecard:
    """The scorecard of all arms. The same seed gives the same card, except for speeds.

    folder: results are stored there, so that an interrupted examination resumes. identity: what else must be the same for that
    (the files of world and recording). Probes that do not apply to an arm are listed with what it lacks.
    """
    config, first = exam.config, next(iter(exam.arms.values()))
    for place, clips in exam.places.items():
        check_clips(place, clips, max(config.horizons))
    for place, clips in exam.sets.get(LONG, {}).items():
        check_clips(place, clips, 1)
    store = Store(folder, exam.fingerprint(identity))
    progress(0.0, "timing the worlds", 0.0)
    prices = _prices(exam, clock)
    units = dreams(exam, probes) + [unit for probe in probes for unit in probe.units(exam)]
    results = ExamResults(run_all(units, store, prices, clock, progress))
    card = Scorecard({arm: world.spec.name for arm, world in exam.arms.items()}, first.spec.dt_s, _places(exam))
    for probe in probes:
        for arm, world in exam.arms.items():
            applies = probe.any_world or world.spec.observes
            if why := probe.missing(exam, world) if applies else "needs a world that observes something":
                card.missing.append(Missing(probe.name, arm, why))
        report = probe.report(exam, results)
        card.rows.extend(report.rows)
        card.curves.extend(report.curves)
        card.pictures.extend(report.pictures)
        card.films.extend(report.films)
    return card


@torch.inference_mode()
def most_clips_within(
    exam: Exam, seconds: float, sizes: Sequence[int], clock: Clock = time.monotonic, probes: Sequence[Probe] = PROBES
) -> int:
    """The largest number of clips, of `sizes`, with which the examination is forecast to take at most `seconds`; 0 if all take
    longer."""
    forecast = Forecast(_prices(exam, clock))
    for size in sorted(sizes, reverse=True):
        some = exam.of(size)
        units = dreams(some, probes) + [unit for probe in probes for unit in probe.units(some)]
        if sum(map(forecast.seconds, units)) <= seconds:
            return size
    return 0


def _prices(exam: Exam, clock: Clock) -> Calls:
    """Seconds per call, by arm and verb."""
    config, some = exam.config, next(iter(exam.places.values()))
    prices: dict[tuple[str, str], float] = {("recording", "compare"): 3e-3}
    for arm, world in {**exam.arms, **exam.closing}.items():
        prices |= prices_of(arm, world, some[: min(config.batch, world.spec.max_batch or config.batch)], clock)
    return prices


def write_report(card: Scorecard, folder: str | Path, title: str) -> tuple[Path, Path]:
    """Writes scorecard.json and scorecard.html (one self-contained page) into `folder`; returns both paths."""
    data, shown = Path(folder) / "scorecard.json", Path(folder) / "scorecard.html"
    with writing(Path(folder)):
        Path(folder).mkdir(parents=True, exist_ok=True)
        data.write_text(to_json(card) + "\n", encoding="utf-8")
        shown.write_text(page(card, title, PROBES), encoding="utf-8")
    return data, shown


def _places(exam: Exam) -> list[PlaceSummary]:
    places = []
    for name, clips in exam.places.items():
        moving = sum(clip.moves() for clip in clips) / len(clips)
        places.append(PlaceSummary(name, len(clips), moving, clips[0].context, clips[0].horizon))
    return places
