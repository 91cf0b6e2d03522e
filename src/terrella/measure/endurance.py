"""Endurance: a thousand dreamt steps; do sharpness and colours stay those of the real game?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from ..core.policy import Replay
from ..core.world import World
from .album import Album, look
from .clips import Clip
from .exam import Exam, Found, Probe
from .roll import Results, Tick, fold_context
from .scorecard import PREDICTED, Curve, Picture, Report, Row
from .statistics import Band, Figure, ratio_interval
from .work import UNSEEN, Unit

STRIDE = 5  # every fifth frame is looked at
NAMES = ("sharpness", *(f"{what} of {colour}" for what in ("mean", "spread") for colour in ("red", "green", "blue")))
_DRAWN = ("sharpness", "mean of green", "spread of green")
LEAD = (
    "Rollouts on end, by stretches, under the actions of recorded players. Each frame is held against the recorded one from "
    "nearest to where the world says that it is, for a dull corner is dull in the game too; without poses against the mean of "
    "the recordings. The table gives the stretch that strays most from 1, and how far real stretches stray by themselves."
)


@dataclass(frozen=True)
class _Looks:
    """Looks [n, lanes, 7] of frames and of their real counterparts; known [n, lanes] where there is one."""

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
) -> Results:
    """Goes on for `steps` steps from the contexts of `rollouts` clips, with the actions of recorded players on end.

    looks [n, lanes, 7] of every fifth frame; poses [n, lanes, 7] where the world shows them; frames uint8 [K, H, W, 3] of the
    first rollout at step 1 and at the ends of tenths.
    """
    size = min(rollouts, len(clips), world.spec.max_batch or rollouts)
    picked = torch.randperm(len(clips), generator=rng)[:size].tolist()
    policy = Replay(recorded_actions(world, clips, size, steps, rng))
    state = fold_context(world, [clips[pick] for pick in picked], rng)
    tick(size * clips[0].context)
    posed = "pose" in world.spec.channels and clips[0].pose is not None
    memory, looks, poses, frames = policy.begin(size, rng), [], [], []
    for step in range(1, steps + 1):
        action, memory = policy.act({}, memory, rng)
        state = world.imagine(state, action, rng)
        if step == 1 or step % STRIDE == 0:
            seen = {name: tensor.cpu() for name, tensor in world.render(state, ("rgb", "pose")[: 1 + posed]).items()}
            if step % STRIDE == 0:
                looks.append(look(seen["rgb"]))
                poses += [seen["pose"]] if posed else []
            if step == 1 or step % max(STRIDE, steps // 10 // STRIDE * STRIDE) == 0:
                frames.append(seen["rgb"][0])
        tick(size)
    return {"looks": torch.stack(looks), "frames": torch.stack(frames)} | (
        {"poses": torch.stack(poses)} if posed else {}
    )


def recorded_actions(world: World, clips: Sequence[Clip], batch: int, steps: int, rng: torch.Generator) -> torch.Tensor:
    """Actions [steps, batch, ...] made of the action runs of clips picked at random, one after the other."""
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
) -> Report:
    """By stretches of a tenth: ratios of sharpness, and of the mean and the spread of each colour; the worst of each as a
    row, all as curves."""
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
    found, matched = Report(), float(dreamt.known.double().mean())
    x = [min(first + span, len(mine)) * STRIDE for first in starts]
    for k, name in enumerate(NAMES):
        figures = [bucket[k] for bucket in buckets]
        known = [figure for figure in figures if math.isfinite(figure.value)]
        worst = max(known, key=lambda figure: abs(figure.value - 1), default=figures[0])
        note = f"against {against} ({matched:.0%} of the frames have one)"
        natural = {"real stretches": Figure(1.0, low[k], high[k], len(clips))}
        where = "endurance", "rgb", name, "\u00d7", place, arm, PREDICTED
        found.rows.append(Row(*where, steps, worst, 0, natural, note=note))
        if name in _DRAWN:
            value, low_, high_ = ([getattr(figure, key) for figure in figures] for key in ("value", "low", "high"))
            band = Band(value, low_, high_, len(clips))
            found.curves.append(Curve(*where, x, band, guides=(0.7, 1.0, 1.3)))
    columns = ["1", *(str(step) for step in x)][: len(gone["frames"])]
    frames = gone["frames"].numpy()[: len(columns)]
    found.pictures.append(Picture("endurance", f"{arm}: one rollout, by steps", columns, {arm: frames}))
    return found


def _units(exam: Exam) -> list[Unit]:
    units, config = [], exam.config
    place, clips = next(iter(exam.places.items()))
    for arm, world in exam.arms.items():
        if config.long_steps and not _missing(exam, world):
            lanes = min(config.long_rollouts, len(clips), world.spec.max_batch or config.long_rollouts)
            calls = {(arm, "observe"): lanes * clips[0].context, (arm, "imagine" + UNSEEN): lanes * config.long_steps}
            words = f"{arm}: {config.long_steps:,} steps on end"
            run = partial(long_rollout, world, clips, exam.rng(4), config.long_steps, config.long_rollouts)
            units.append(Unit(f"endurance|{arm}|0", words, calls, run))
    return units


def _report(exam: Exam, found: Found) -> Report:
    whole = Report()
    place, clips = next(iter(exam.places.items()))
    for arm in exam.arms:
        if gone := found.of("endurance", arm):
            one = rows_of(gone, clips, exam.album, arm, place, exam.rng())
            whole.rows += one.rows
            whole.curves += one.curves
            whole.pictures += one.pictures
    return whole


def _missing(exam: Exam, world: World) -> str:
    if not exam.config.long_steps:
        return "needs long rollouts, which were not asked for"
    return "" if "rgb" in exam.shared(world, "rgb") else "needs rgb"


ENDURANCE = Probe("endurance", "A long rollout", LEAD, _missing, _report, units=_units)


def _matched(mine: torch.Tensor, poses: torch.Tensor, album: Album, not_episode: torch.Tensor | None = None) -> _Looks:
    rows = album.nearest(poses.flatten(0, 1), not_episode)
    return _Looks(mine, album.looks(rows).view_as(mine), (rows >= 0).view(mine.shape[:2]))


def _real_stretches(clips: Sequence[Clip], album: Album | None, span: int) -> _Looks:
    """Up to 64 clips' own frames, as many of each as a bucket has, against what dreamt frames would be held against."""
    clips = clips[:64]
    rows = range(0, min(len(clips[0].action), span * STRIDE), STRIDE)
    mine = torch.stack(
        [look(torch.from_numpy(np.stack([np.asarray(c.channels["rgb"][row]) for c in clips]))) for row in rows]
    )
    if album is None:
        return _Looks(mine, mine.mean((0, 1)).expand_as(mine), torch.ones(mine.shape[:2], dtype=torch.bool))
    poses = np.stack([[np.asarray(clip.pose[row]) for clip in clips if clip.pose is not None] for row in rows])
    own = torch.tensor([clip.episode for clip in clips]).expand(len(rows), -1)
    return _matched(mine, torch.from_numpy(poses), album, own.flatten())


def _bucket(looks: _Looks, first: int, span: int, rng: torch.Generator) -> list[Figure]:
    stop = min(first + span, len(looks.mine))
    known = looks.known[first:stop].any(0)  # a rollout without any counterpart says nothing
    mine, real = (sums[known] for sums in looks.sums(first, stop))
    return [ratio_interval(mine[:, k], real[:, k], rng) for k in range(len(NAMES))]


def _spread(real: _Looks, rollouts: int, rng: torch.Generator) -> tuple[list[float], list[float]]:
    """2.5% and 97.5% of the ratios of `rollouts` stretches drawn at random, for each of the seven looks."""
    known = real.known.any(0)
    mine, reference = (sums[known] for sums in real.sums(0, len(real.mine)))
    if not len(mine):
        return [math.nan] * 7, [math.nan] * 7
    lanes = torch.randint(len(mine), (2000, rollouts), generator=rng)
    ratios = mine[lanes].sum(1) / reference[lanes].sum(1)
    low, high = ratios.quantile(torch.tensor([0.025, 0.975], dtype=ratios.dtype), dim=0)
    return low.tolist(), high.tolist()
