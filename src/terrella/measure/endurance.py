"""Endurance: a thousand dreamt steps; do sharpness and colours stay those of the real game?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..core.world import World, make_rng
from .album import Album, look
from .clips import Clip
from .roll import fold_context
from .statistics import Figure, ratio_interval

_STRIDE = 5  # every fifth frame is looked at


@dataclass(frozen=True)
class Bucket:
    """Steps first..last of all stories against the real frames: ratios of gradient energy, and of the mean and the
    standard deviation of red, green and blue. matched: the share of the dreamt frames that had a real counterpart."""

    first: int
    last: int
    matched: float
    sharpness: Figure
    colour_mean: tuple[Figure, ...]
    colour_std: tuple[Figure, ...]


@dataclass(frozen=True)
class Endurance:
    """reference: what each dreamt frame is held against. natural: how far real stretches, as long and as many as a
    bucket, stray from the reference by themselves: (2.5%, 97.5%) ratios of sharpness, and of whichever colour
    statistic strays most; a bar tighter than that cannot be read. `picture`: the first story's frames at step 1 and at
    the end of each bucket."""

    arm: str
    steps: int
    stories: int
    reference: str
    buckets: list[Bucket]
    natural: tuple[float, float]
    natural_colour: tuple[float, float]
    picture: np.ndarray = field(repr=False, compare=False)


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
    arm: str = "",
    steps: int = 1000,
    stories: int = 8,
    bucket: int = 100,
    album: Album | None = None,
) -> Endurance:
    """Dreams `steps` steps from `stories` clips' contexts, with the hands of recorded players played on end.

    Each dreamt frame is held against the real frame of `album` (the clips' own frames where none is given) seen from
    nearest to where the world says that it is, for a dull corner is dull in the game too. A world that shows no pose
    is held against the mean of all the clips' frames.
    """
    size = min(stories, len(clips), world.spec.max_batch or stories)
    own = make_rng(int(torch.randint(2**31 - 1, (1,), generator=rng).item()))
    picked = torch.randperm(len(clips), generator=rng)[:size].tolist()
    actions = recorded_hands(world, clips, size, steps, rng)
    state = fold_context(world, [clips[pick] for pick in picked], own)
    posed = "pose" in world.spec.channels and clips[0].pose is not None
    looks, poses, picture = [], [], []
    for step, action in enumerate(actions, start=1):
        state = world.imagine(state, action, own)
        if step == 1 or step % _STRIDE == 0:
            seen = world.render(state, ("rgb", "pose") if posed else ("rgb",))
            frames = seen["rgb"].cpu()
            if step % _STRIDE == 0:
                looks.append(look(frames))
                poses.append(seen["pose"].cpu() if posed else None)
            if step == 1 or step % bucket == 0:
                picture.append(frames[0])
    mine = torch.stack(looks)
    span = max(1, bucket // _STRIDE)
    if posed:
        album = album or Album.of_clips(clips)
        dreamt, real = _matched(mine, torch.stack(poses), album), _real_stretches(clips, album, span)
        reference = "the nearest real view"
    else:
        real = _real_stretches(clips, None, span)
        mean = real.real[0, 0]
        dreamt = _Looks(mine, mean.expand_as(mine), torch.ones(mine.shape[:2], dtype=torch.bool))
        reference = "the mean of the recordings"
    buckets = [_bucket(dreamt, first, span, rng) for first in range(0, len(mine), span)]
    low, high = _spread(real, size, rng)
    strays = (low[0], high[0]), (min(low[1:]), max(high[1:]))
    return Endurance(arm, steps, size, reference, buckets, *strays, torch.stack(picture).numpy())


def recorded_hands(world: World, clips: Sequence[Clip], batch: int, steps: int, rng: torch.Generator) -> torch.Tensor:
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


def _matched(mine: torch.Tensor, poses: torch.Tensor, album: Album, not_episode: torch.Tensor | None = None) -> _Looks:
    rows = album.nearest(poses.flatten(0, 1), not_episode)
    return _Looks(mine, album.looks(rows).view_as(mine), (rows >= 0).view(mine.shape[:2]))


def _real_stretches(clips: Sequence[Clip], album: Album | None, span: int) -> _Looks:
    """Up to 64 clips' own frames, as many of each as a bucket has, against what dreamt frames would be held against."""
    clips = clips[:64]
    rows = range(0, min(len(clips[0].rgb), span * _STRIDE), _STRIDE)
    mine = torch.stack([look(torch.from_numpy(np.stack([np.asarray(c.rgb[row]) for c in clips]))) for row in rows])
    if album is None:
        return _Looks(mine, mine.mean((0, 1)).expand_as(mine), torch.ones(mine.shape[:2], dtype=torch.bool))
    poses = np.stack([[np.asarray(clip.pose[row]) for clip in clips if clip.pose is not None] for row in rows])
    own = torch.tensor([clip.episode for clip in clips]).expand(len(rows), -1)
    return _matched(mine, torch.from_numpy(poses), album, own.flatten())


def _bucket(looks: _Looks, first: int, span: int, rng: torch.Generator) -> Bucket:
    stop = min(first + span, len(looks.mine))
    told = looks.known[first:stop].any(0)  # a story without any counterpart says nothing
    mine, real = (sums[told] for sums in looks.sums(first, stop))
    ratios = [ratio_interval(mine[:, k], real[:, k], rng) for k in range(7)]
    matched = float(looks.known[first:stop].double().mean())
    return Bucket(first * _STRIDE + 1, stop * _STRIDE, matched, ratios[0], tuple(ratios[1:4]), tuple(ratios[4:7]))


def _spread(real: _Looks, stories: int, rng: torch.Generator) -> tuple[list[float], list[float]]:
    """2.5% and 97.5% of the ratios of `stories` stretches drawn at random, for each of the seven looks."""
    told = real.known.any(0)
    mine, reference = (sums[told] for sums in real.sums(0, len(real.mine)))
    if not len(mine):
        return [math.nan] * 7, [math.nan] * 7
    lanes = torch.randint(len(mine), (2000, stories), generator=rng)
    ratios = mine[lanes].sum(1) / reference[lanes].sum(1)
    low, high = ratios.quantile(torch.tensor([0.025, 0.975], dtype=ratios.dtype), dim=0)
    return low.tolist(), high.tolist()
