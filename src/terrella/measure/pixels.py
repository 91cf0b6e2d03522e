"""Pixels, of every camera: PSNR, SSIM, sharpness, change per step, and Frechet distance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from ..core.world import Observation, World
from .clips import Clip
from .encoder import MIN_SIDE, frame_features
from .error_series import Series, report
from .exam import CLIPS, ENDINGS, LONG, Exam, ExamResults, Probe, batches
from .fidelity import blurred, changes, gradient_energy, pooled, psnr, squared_error, ssim
from .frechet import frechet_interval
from .rollouts import Results, StepMetric, Tick, rows_at
from .scorecard import (
    CHANGE,
    COPY_LAST,
    POOLED,
    PREDICTED,
    TRUE,
    Curve,
    DreamFilm,
    Picture,
    ProbeReport,
    Row,
    place_label,
)
from .statistics import Figure, mean_interval, ratio_band, ratio_interval
from .work_units import Unit

LEAD = (
    "The distance of each predicted frame to the recorded one. The grey line repeats the last context frame; shades are 95% "
    "intervals. Mean PSNR favours copying where many frames do not change, since an identical frame counts as 60 dB: pooled PSNR "
    "is that of the errors of all clips together, over all frames, over frames that change, and over pixels that change. "
    "Sharpness is gradient energy, predicted over recorded: below 1 is blurred, above 1 too rough. Change per step is the number "
    "of pixels that change from step to step over the last eight steps, predicted over recorded: below 1 things stop or vanish, "
    "which PSNR hardly penalises. The Frechet distance compares the sets of pictures; 0 is equal, and blur does not help."
)
_MIN_SSIM = 11  # pixels, the window of SSIM
_CHANGE_STEPS = 8  # over which changes are counted
_FILMS, _FILM_SIDE = 3, 256  # clips of which the liveliest is the film; pixels a side, beyond which frames are thinned


def series(
    exam: Exam, results: ExamResults, of: str, place: str, clips: Sequence[Clip], dreamt: Results
) -> list[Series]:
    """PSNR of every camera: the mean over frames, and that of the pooled errors."""
    truth = results.of("truth", of, place)
    made = []
    for name in [key.removesuffix("/psnr") for key in dreamt if key.endswith("/psnr")]:
        values = dreamt[f"{name}/psnr"]
        steps, (height, width) = values.shape[1], clips[0].channels[name].shape[1:3]
        made.append(Series(name, "PSNR", "dB", 1, values, truth[f"{name}/copied"][:, :steps]))
        if f"{name}/pooled" in dreamt:
            changed = truth[f"{name}/changed"][:, :steps]
            moving, whole = (changed > 0).double(), torch.full_like(changed, height * width)
            mine, copied = dreamt[f"{name}/pooled"].unbind(-1), truth[f"{name}/copied_pooled"][:, :steps].unbind(-1)
            made += [
                Series(name, POOLED, "dB", 1, mine[0], copied[0], whole),
                Series(
                    name, f"{POOLED}, frames that change", "dB", 1, mine[0] * moving, copied[0] * moving, whole * moving
                ),
                Series(name, f"{POOLED}, pixels that change", "dB", 1, mine[1], copied[1], changed),
            ]
    return made


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    if of == ENDINGS:
        return []
    horizons = exam.config.horizons if of == CLIPS else ()
    strips, films = max(0, exam.config.strips - first), max(0, _FILMS - first)
    return [StepMetric((name,), _FrameMetrics(name, horizons, strips, films)) for name in exam.shared(world, "rgb")]


@dataclass
class _FrameMetrics:
    """Metrics of the frames of one camera in a rollout."""

    name: str
    horizons: tuple[int, ...]
    strips: int  # frames to keep at each horizon
    films: int  # frames to keep at each step
    before: torch.Tensor | None = None  # the frames of the step before

    def __call__(self, seen: Observation, clips: Sequence[Clip], row: int, step: int) -> Results:
        name, mine, truth = self.name, seen[self.name], rows_at(clips, self.name, row)
        kept = {f"{name}/psnr": psnr(mine, truth), f"{name}/energy": gradient_energy(mine)}
        if self.horizons:
            last = rows_at(clips, name, clips[0].context - 1)
            kept[f"{name}/pooled"] = pooled(squared_error(mine, truth), changes(last, truth))
            kept[f"{name}/change"] = _count(changes(last if step == 1 or self.before is None else self.before, mine))
            self.before = mine
            kept[f"{name}/film"] = _smaller(mine[: self.films])
        if step in self.horizons:
            if min(mine.shape[1:3]) >= _MIN_SSIM:
                kept[f"{name}/ssim"] = ssim(mine, truth)
            if min(mine.shape[1:3]) >= MIN_SIDE:
                kept[f"{name}/features"] = frame_features(mine)
            kept[f"{name}/frames"] = mine[: self.strips]
        return kept


def _smaller(frames: torch.Tensor) -> torch.Tensor:
    """Frames [B, H, W, 3] with at most _FILM_SIDE pixels a side."""
    step = -(-max(frames.shape[1:3]) // _FILM_SIDE)
    return frames[:, ::step, ::step]


def _film(exam: Exam, place: str, clips: Sequence[Clip], name: str, dreams: torch.Tensor) -> DreamFilm | None:
    """Of the predicted `dreams` [B, T, H, W, 3] of the first clips, the one in which most happens; None without any, and of
    single frames."""
    if not len(dreams) or dreams.shape[1] < 2:
        return None
    films = []
    for clip, dream in zip(clips, dreams):
        rows = range(clip.context, clip.context + len(dream))
        truth = _smaller(torch.from_numpy(np.stack([np.asarray(clip.channels[name][row]) for row in rows]))).numpy()
        films.append(
            (float(np.abs(np.diff(truth.astype(np.float32), axis=0)).mean()), len(films), truth, dream.numpy())
        )
    _, number, truth, dream = max(films, key=lambda film: film[0])
    return DreamFilm(f"{place_label(place)}, clip {number + 1}", truth, dream, exam.dt_s)


def _count(changed: torch.Tensor) -> torch.Tensor:
    return changed.sum((-2, -1)).double()


def _units(exam: Exam) -> list[Unit]:
    """Metrics of the recording alone, by place: the error of the last context frame against those that follow."""
    world, units = next(iter(exam.arms.values())), []
    names = exam.shared(world, "rgb")
    for of in (CLIPS, LONG) if names else ():
        for place, clips in exam.sets.get(of, {}).items():
            for number, (_, some) in enumerate(batches(exam, world, clips)):
                steps = clips[0].horizon if of == LONG else max(exam.config.horizons)
                run = partial(_truth, exam, names, some, steps, exam.config.horizons if of == CLIPS else ())
                calls = {("recording", "compare"): float(steps * len(some))}
                units.append(Unit(f"truth|{of}|{place}|{number}", f"recordings, {place_label(place)}", calls, run))
    return units


def _truth(exam: Exam, names: Sequence[str], clips: Sequence[Clip], steps: int, horizons, tick: Tick) -> Results:
    kept: dict[str, list[torch.Tensor]] = {}
    context = clips[0].context
    for name in names:
        last = before = rows_at(clips, name, context - 1)
        looks = min(last.shape[1:3]) >= MIN_SIDE
        alone = {f"{name}/first": gradient_energy(last)} | ({f"{name}/last": frame_features(last)} if looks else {})
        for step in range(1, steps + 1):
            frames = rows_at(clips, name, context - 1 + step)
            here = {f"{name}/copied": psnr(last, frames), f"{name}/energy": gradient_energy(frames)}
            if horizons:
                changed = changes(last, frames)
                here[f"{name}/changed"], here[f"{name}/change"] = _count(changed), _count(changes(before, frames))
                before = frames
                here[f"{name}/copied_pooled"] = pooled(squared_error(last, frames), changed)
            if step in horizons:
                if min(last.shape[1:3]) >= _MIN_SSIM:
                    here[f"{name}/copied_ssim"] = ssim(last, frames)
                if looks:
                    here |= {
                        f"{name}/features": frame_features(frames),
                        f"{name}/blurred": frame_features(blurred(frames)),
                    }
            for key, value in here.items():
                kept.setdefault(key, []).append(value)
            tick(len(clips) / len(names))
        kept |= {key: [value] for key, value in alone.items()}
    return {key: torch.stack(values, 1) for key, values in kept.items()}


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole = report(exam, results, "pixels", series)
    for place, clips in exam.places.items():
        truth, strips = results.of("truth", CLIPS, place), [{} for _ in clips[: exam.config.strips]]
        for name in [key.removesuffix("/copied") for key in truth if key.endswith("/copied")]:
            shown = [clip.context - 1 + step for clip in clips[:1] for step in (0, *exam.config.horizons)]
            for strip, clip in zip(strips, clips):
                strip[f"truth, {name}"] = np.stack([np.asarray(clip.channels[name][row]) for row in shown])
            for arm in exam.arms:
                for motion in (PREDICTED, TRUE):
                    dreamt = results.dreamt(CLIPS, arm, place, motion)
                    if f"{name}/psnr" in dreamt:
                        where = "pixels", name, place, arm, motion
                        whole.rows += _rows(exam, where, dreamt, truth)
                        whole.curves.append(_sharpness(exam, where, dreamt, truth))
                        if motion == PREDICTED and not whole.films and f"{name}/film" in dreamt:
                            film = _film(exam, place, clips, name, dreamt[f"{name}/film"])
                            whole.films += [film] if film else []
                        for strip, frames in zip(strips, dreamt[f"{name}/frames"]):
                            now = strip[f"truth, {name}"][:1]
                            strip[f"{arm}, {motion} motion, {name}"] = np.concatenate([now, frames.numpy()])
        columns = ["now", *(f"{step} step{'s'[: step > 1]}, {step * exam.dt_s:.2f} s" for step in exam.config.horizons)]
        shown = {f"{place_label(place)}, clip {number}": strip for number, strip in enumerate(strips, 1) if strip}
        whole.pictures += [Picture("pixels", title, columns, strip) for title, strip in shown.items()]
    return whole


def _rows(exam: Exam, where, dreamt: Results, truth: Results) -> list[Row]:
    (probe, name, place, arm, motion), config = where, exam.config
    rows, mine, real = [], dreamt[f"{name}/energy"], truth[f"{name}/energy"]
    for number, step in enumerate(config.horizons):
        if f"{name}/ssim" in dreamt:
            baselines = {COPY_LAST: mean_interval(truth[f"{name}/copied_ssim"][:, number], exam.rng())}
            figure = mean_interval(dreamt[f"{name}/ssim"][:, number], exam.rng())
            rows.append(Row(probe, name, "SSIM", "", place, arm, motion, step, figure, 1, baselines))
        baselines = {COPY_LAST: ratio_interval(truth[f"{name}/first"].flatten(), real[:, step - 1], exam.rng())}
        sharp = ratio_interval(mine[:, step - 1], real[:, step - 1], exam.rng())
        rows.append(Row(probe, name, "sharpness", "\u00d7", place, arm, motion, step, sharp, 0, baselines))
        late = slice(max(0, step - _CHANGE_STEPS), step)
        mine_change, change = (some[f"{name}/change"][:, late].sum(1) for some in (dreamt, truth))
        if change.any():
            figure = ratio_interval(mine_change, change, exam.rng())
            baselines = {COPY_LAST: Figure(0.0, 0.0, 0.0, len(change))}
            rows.append(Row(probe, name, CHANGE, "\u00d7", place, arm, motion, step, figure, 0, baselines))
        if f"{name}/features" in dreamt:
            looks = truth[f"{name}/features"][:, number]
            others = {COPY_LAST: truth[f"{name}/last"][:, 0], "blurred by 1 pixel": truth[f"{name}/blurred"][:, number]}
            baselines = {words: frechet_interval(looks, features) for words, features in others.items()}
            figure = frechet_interval(looks, dreamt[f"{name}/features"][:, number])
            rows.append(Row(probe, name, "Frechet distance", "", place, arm, motion, step, figure, -1, baselines))
    first, last = config.drop
    if last <= max(config.horizons):
        falls = (some[:, first - 1] - some[:, last - 1] for some in (dreamt[f"{name}/psnr"], truth[f"{name}/copied"]))
        loss, copied = (mean_interval(fall, exam.rng()) for fall in falls)
        what = f"PSNR lost from {first} to {last} steps"
        rows.append(Row(probe, name, what, "dB", place, arm, motion, last, loss, -1, {COPY_LAST: copied}))
    return rows


def _sharpness(exam: Exam, where, dreamt: Results, truth: Results) -> Curve:
    probe, name, place, arm, motion = where
    band = ratio_band(dreamt[f"{name}/energy"], truth[f"{name}/energy"], exam.rng())
    steps = range(1, len(band.value) + 1)
    return Curve(probe, name, "sharpness", "\u00d7", place, arm, motion, steps, band, guides=(0.7, 1.0, 1.3))


def _missing(exam: Exam, world: World) -> str:
    return "" if exam.shared(world, "rgb") else "needs rgb, of the world and of the recording"


PIXELS = Probe("pixels", "Likeness over time", LEAD, _missing, _report, _watch, _units)
