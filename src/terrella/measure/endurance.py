"""Endurance: rollouts of a thousand steps, played or idle; do sharpness and colours stay as in the real game?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from ..core.policy import Idle, Policy, Replay
from ..core.spec import can_idle
from ..core.world import World, without_end
from .album import Album, appearance
from .clips import Clip
from .exam import Exam, ExamResults, Probe
from .rollouts import Results, Tick, fold_context, rows_at
from .scorecard import COPY_LAST, IDLE, PREDICTED, Curve, Picture, ProbeReport, Row
from .statistics import Band, Figure, ratio_band, ratio_interval
from .work_units import UNSEEN, Unit

STRIDE = 5  # every fifth frame is measured
NAMES = ("sharpness", *(f"{what} of {colour}" for what in ("mean", "spread") for colour in ("red", "green", "blue")))
_DRAWN = ("sharpness", "mean of green", "spread of green")
LEAD = (
    "Long rollouts under recorded actions, in tenths. Each frame is compared with the recorded frame nearest to the world's own "
    "pose, since a dull corner is dull in the game too; without poses, with the mean of the recordings. The table gives the tenth "
    "that deviates most from 1, and the deviations of real stretches. They go on after ends that the world predicts."
)


STILL_LEAD = (
    "Rollouts without actions: sharpness and mean of each colour relative to the last true frame, all rollouts together, in the "
    "tenth that deviates most; with poses, relative to the frame in which the camera came to rest. Copying the last frame gives 1. "
    "Only what moves by itself may change them: within 10% for sharpness and 3% for colours the picture holds. They go on after "
    "ends that the world predicts, such as a fall."
)
GLIDES = 0.005  # deviation from the last pose, metres or quaternion, above which the camera still moves
SHARP_WITHIN, COLOUR_WITHIN = 0.1, 0.03
FLOOR = 0.5  # of 255; lower values count as this


@dataclass(frozen=True)
class _Looks:
    """Appearance [n, lanes, 7] of frames and of their real counterparts; known [n, lanes]: whether there is one."""

    mine: torch.Tensor
    real: torch.Tensor
    known: torch.Tensor

    def sums(self, first: int, stop: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Sums over rows first..stop of each lane: two [lanes, 7]."""
        known = self.known[first:stop, :, None]
        return (self.mine[first:stop] * known).sum(0), (self.real[first:stop] * known).sum(0)


def long_rollout(
    world: World,
    clips: Sequence[Clip],
    rng: torch.Generator,
    steps: int = 1000,
    rollouts: int = 8,
    tick: Tick = lambda done: None,
    idle: bool = False,
) -> Results:
    """Rolls out `steps` steps from the contexts of `rollouts` clips, under concatenated recorded actions, or `idle`.

    looks [n, lanes, 7]: appearance of every fifth frame; first [lanes, 7]: of the last true one; poses [n, lanes, 7] if the
    world has them; frames uint8 [K, H, W, 3] of the first rollout: the last true one, at step 1 and at the ends of tenths.
    """
    size = min(rollouts, len(clips), world.spec.max_batch or rollouts)
    order = _stillest(clips) if idle else [clips[pick] for pick in torch.randperm(len(clips), generator=rng).tolist()]
    picked = order[:size]
    policy: Policy = Idle(world.spec) if idle else Replay(recorded_actions(world, clips, size, steps, rng))
    state, last = fold_context(world, picked, rng), rows_at(picked, "rgb", clips[0].context - 1)
    tick(size * clips[0].context)
    posed = "pose" in world.spec.channels and clips[0].pose is not None
    memory: Any = policy.begin(size, rng)
    looks, poses, frames = [], [], [last[0]]
    for step in range(1, steps + 1):
        action, memory = policy.act({}, memory, rng)
        state = world.imagine(without_end(state), action, rng)
        if step == 1 or step % STRIDE == 0:
            seen = {name: tensor.cpu() for name, tensor in world.render(state, ("rgb", "pose")[: 1 + posed]).items()}
            if step % STRIDE == 0:
                looks.append(appearance(seen["rgb"]))
                poses += [seen["pose"]] if posed else []
            if step == 1 or step % max(STRIDE, steps // 10 // STRIDE * STRIDE) == 0:
                frames.append(seen["rgb"][0])
        tick(size)
    results = {"looks": torch.stack(looks), "first": appearance(last), "frames": torch.stack(frames)}
    return results | ({"poses": torch.stack(poses)} if posed else {})


def _stillest(clips: Sequence[Clip]) -> list[Clip]:
    """The clips in order of motion at the end of their context: a running player comes to rest elsewhere."""

    def motion(clip: Clip) -> float:
        last, before = (np.asarray(clip.channels["rgb"][max(0, clip.context - back)], np.float32) for back in (1, 2))
        return float(np.abs(last - before).mean())

    return sorted(clips, key=motion)


def recorded_actions(world: World, clips: Sequence[Clip], batch: int, steps: int, rng: torch.Generator) -> torch.Tensor:
    """Actions [steps, batch, ...]: the concatenated actions of randomly picked clips."""
    lanes = []
    for _ in range(batch):
        parts, length = [], 0
        while length < steps:
            clip = clips[int(torch.randint(len(clips), (1,), generator=rng))]
            parts.append(torch.from_numpy(np.array(clip.action[:-1])))
            length += len(parts[-1])
        lanes.append(torch.cat(parts)[:steps].reshape(steps, *(world.spec.action.shape or ())))
    return torch.stack(lanes, 1)


def rows_of(
    gone: Results, clips: Sequence[Clip], album: Album | None, arm: str, place: str, rng: torch.Generator
) -> ProbeReport:
    """By tenths: ratios of sharpness, and of mean and spread of each colour; the worst of each as a row, all as curves."""
    mine, steps = gone["looks"], len(gone["looks"]) * STRIDE
    span = max(1, len(mine) // 10)
    if "poses" in gone:
        album = album or Album.of_clips(clips)
        dreamt, real = _matched(mine, gone["poses"], album), _real_stretches(clips, album, span)
        against = "the nearest recorded view"
    else:
        real = _real_stretches(clips, None, span)
        dreamt = _Looks(mine, real.real[0, 0].expand_as(mine), torch.ones(mine.shape[:2], dtype=torch.bool))
        against = "the mean of the recordings"
    starts = range(0, len(mine), span)
    buckets = [_bucket(dreamt, first, span, rng) for first in starts]
    low, high = _spread(real, mine.shape[1], rng)
    report, matched = ProbeReport(), float(dreamt.known.double().mean())
    x = [min(first + span, len(mine)) * STRIDE for first in starts]
    for k, name in enumerate(NAMES):
        figures = [bucket[k] for bucket in buckets]
        known = [figure for figure in figures if math.isfinite(figure.value)]
        worst = max(known, key=lambda figure: abs(figure.value - 1), default=figures[0])
        note = f"against {against} ({matched:.0%} of the frames have one)"
        natural = {"real stretches": Figure(1.0, low[k], high[k], len(clips))}
        where = "endurance", "rgb", name, "\u00d7", place, arm, PREDICTED
        report.rows.append(Row(*where, steps, worst, 0, natural, note=note))
        if name in _DRAWN:
            value, low_, high_ = ([getattr(figure, key) for figure in figures] for key in ("value", "low", "high"))
            report.curves.append(Curve(*where, x, Band(value, low_, high_, len(clips)), guides=(0.7, 1.0, 1.3)))
    report.pictures.append(_picture("endurance", arm, gone, x))
    return report


def still_rows(gone: Results, arm: str, place: str, rng: torch.Generator) -> ProbeReport:
    """By tenths of an idle rollout: sharpness and the mean of each colour, relative to the last true frame."""
    report, span, lanes = ProbeReport(), max(1, len(gone["looks"]) // 10), gone["looks"].shape[1]
    looks, first = _at_rest(gone)
    parts = torch.stack([part.mean(0) for part in looks.split(span)], -1).clamp_min(FLOOR)  # [lanes, 7, tenths]
    first = first.clamp_min(FLOOR)[..., None].expand_as(parts)
    x = [min(stop, len(gone["looks"])) * STRIDE for stop in range(span, len(gone["looks"]) + span, span)]
    for k, name in enumerate(NAMES[:4]):
        band = ratio_band(parts[:, k], first[:, k], rng)
        worst = max(range(len(x)), key=lambda tenth: abs(band.value[tenth] - 1))
        where = "stillness", "rgb", name, "\u00d7", place, arm, IDLE
        within = SHARP_WITHIN if name == "sharpness" else COLOUR_WITHIN
        note, copied = f"after {x[worst]:,} steps", {COPY_LAST: Figure(1.0, 1.0, 1.0, lanes)}
        report.rows.append(Row(*where, x[-1], band.at(worst), 0, copied, note=note))
        report.curves += [Curve(*where, x, band, guides=(1 - within, 1.0, 1 + within))] if name in _DRAWN else []
    report.pictures.append(_picture("stillness", arm, gone, x))
    return report


def _at_rest(gone: Results) -> tuple[torch.Tensor, torch.Tensor]:
    """Appearance [n, lanes, 7] of idle rollouts, and the reference [lanes, 7]: the last true frame or, if the world has poses, the
    frame in which the camera came to rest, which also replaces those before it."""
    looks, first = gone["looks"], gone["first"]
    if "poses" not in gone:
        return looks, first
    number = torch.arange(len(looks))[:, None]
    glides = (gone["poses"] - gone["poses"][-1]).abs().amax(-1) > GLIDES
    rest = ((number + 1) * glides).amax(0).clamp_max(len(looks) - 1)
    first = torch.where((rest > 0)[:, None], looks[rest, torch.arange(len(rest))], first)
    return torch.where((number < rest)[..., None], first, looks), first


def _picture(probe: str, arm: str, gone: Results, x: Sequence[int]) -> Picture:
    columns = ["now", "1", *(f"{step:,}" for step in x)][: len(gone["frames"])]
    return Picture(probe, f"{arm}: one rollout, by steps", columns, {arm: gone["frames"].numpy()[: len(columns)]})


def _units(kind: str, exam: Exam) -> list[Unit]:
    units, config, idle = [], exam.config, kind == "stillness"
    clips, steps = next(iter(exam.places.values())), config.still_steps if idle else config.long_steps
    for arm, world in exam.arms.items():
        if not _missing(kind, exam, world):
            lanes = min(config.long_rollouts, len(clips), world.spec.max_batch or config.long_rollouts)
            calls = {(arm, "observe"): lanes * clips[0].context, (arm, "imagine" + UNSEEN): lanes * steps}
            words = f"{arm}: {steps:,} steps {'idle' if idle else 'played'}"
            run = partial(long_rollout, world, clips, exam.rng(4), steps, config.long_rollouts, idle=idle)
            units.append(Unit(f"{kind}|{arm}|0", words, calls, run))
    return units


def _report(kind: str, exam: Exam, results: ExamResults) -> ProbeReport:
    whole = ProbeReport()
    place, clips = next(iter(exam.places.items()))
    for arm in exam.arms:
        if gone := results.of(kind, arm):
            still = still_rows(gone, arm, place, exam.rng()) if kind == "stillness" else None
            one = still or rows_of(gone, clips, exam.album, arm, place, exam.rng())
            whole.rows += one.rows
            whole.curves += one.curves
            whole.pictures += one.pictures
    return whole


def _missing(kind: str, exam: Exam, world: World) -> str:
    idle = kind == "stillness"
    if not (exam.config.still_steps if idle else exam.config.long_steps):
        return "needs long rollouts, which are switched off"
    if idle and not can_idle(world.spec):
        return "needs an action that does nothing"
    return "" if "rgb" in exam.shared(world, "rgb") else "needs rgb"


def _probe(name: str, question: str, lead: str) -> Probe:
    return Probe(name, question, lead, partial(_missing, name), partial(_report, name), units=partial(_units, name))


ENDURANCE = _probe("endurance", "A long rollout", LEAD)
STILLNESS = _probe("stillness", "Does it fade without actions?", STILL_LEAD)


def _matched(mine: torch.Tensor, poses: torch.Tensor, album: Album, not_episode: torch.Tensor | None = None) -> _Looks:
    rows = album.nearest(poses.flatten(0, 1), not_episode)
    return _Looks(mine, album.appearances(rows).view_as(mine), (rows >= 0).view(mine.shape[:2]))


def _real_stretches(clips: Sequence[Clip], album: Album | None, span: int) -> _Looks:
    """The frames of up to 64 clips, as many of each as a tenth has, against the reference of imagined frames."""
    clips = clips[:64]
    rows = range(0, min(len(clips[0].action), span * STRIDE), STRIDE)
    mine = torch.stack(
        [appearance(torch.from_numpy(np.stack([np.asarray(c.channels["rgb"][row]) for c in clips]))) for row in rows]
    )
    if album is None:
        return _Looks(mine, mine.mean((0, 1)).expand_as(mine), torch.ones(mine.shape[:2], dtype=torch.bool))
    poses = np.stack([[np.asarray(clip.pose[row]) for clip in clips if clip.pose is not None] for row in rows])
    own = torch.tensor([clip.episode for clip in clips]).expand(len(rows), -1)
    return _matched(mine, torch.from_numpy(poses), album, own.flatten())


def _bucket(looks: _Looks, first: int, span: int, rng: torch.Generator) -> list[Figure]:
    stop = min(first + span, len(looks.mine))
    known = looks.known[first:stop].any(0)  # lanes without any counterpart are left out
    mine, real = (sums[known] for sums in looks.sums(first, stop))
    return [ratio_interval(mine[:, k], real[:, k], rng) for k in range(len(NAMES))]


def _spread(real: _Looks, rollouts: int, rng: torch.Generator) -> tuple[list[float], list[float]]:
    """2.5% and 97.5% quantiles of the ratios of `rollouts` random stretches, for each of the seven numbers."""
    known = real.known.any(0)
    mine, reference = (sums[known] for sums in real.sums(0, len(real.mine)))
    if not len(mine):
        return [math.nan] * 7, [math.nan] * 7
    lanes = torch.randint(len(mine), (2000, rollouts), generator=rng)
    ratios = mine[lanes].sum(1) / reference[lanes].sum(1)
    low, high = ratios.quantile(torch.tensor([0.025, 0.975], dtype=ratios.dtype), dim=0)
    return low.tolist(), high.tolist()
