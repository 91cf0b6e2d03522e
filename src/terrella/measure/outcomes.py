"""Outcomes: does a dream tell rightly what a game pays, how its player fares, and when the episode ends?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.world import World, make_rng
from .clips import Clip, Where
from .roll import actions_at, fold_context
from .statistics import Figure, mean_interval


@dataclass(frozen=True)
class Fate:
    """One arm after `horizon` steps: mean absolute errors, each beside that of a copy.

    reward: of the sum over the horizon; reward_usual: of a world that always pays the recording's median; reward_auc: how
    well the dreamt sum tells clips that paid more than usual from those that did not (area under the ROC curve, 0.5 is
    chance, NaN where all or none did); paid: clips that did. vitals and vitals_copied: of each vital at the end, dreamt, and
    left as it last was. done_auc: likewise, how well the time that a dream has been over tells clips whose episode ended;
    ended: clips whose episode did.
    """

    place: str
    arm: str
    horizon: int
    seconds: float
    reward: Figure
    reward_usual: Figure
    vitals: dict[str, Figure] = field(default_factory=dict)
    vitals_copied: dict[str, Figure] = field(default_factory=dict)
    reward_auc: float = float("nan")
    paid: int = 0
    done_auc: float = float("nan")
    ended: int = 0


@dataclass(frozen=True)
class Passage:
    """A clip that may run into the end of its episode, from where it stands still: `real` bool [T] marks the rows whose
    action was played."""

    clip: Clip
    real: np.ndarray


def passages(
    cache,
    episodes: Sequence[int],
    context: int,
    horizon: int,
    count: int,
    rng: torch.Generator,
    where: Where | None = None,
) -> list[Passage]:
    """`count` windows of the episodes, of rows that `where` allows, half of them shortly before an end where there are ends;
    DatasetError without any."""
    spans = [cache.episodes[number] for number in episodes]
    whole = [part for first, stop in spans for part in _allowed(cache, first, stop, where)]
    long = [(first, stop) for first, stop in whole if stop - first > context + 1]
    ends = cache.done is not None
    ending = [(first, stop) for first, stop in long if ends and bool(np.asarray(cache.done[first:stop]).any())]
    if not long:
        raise DatasetError(f"no episode is longer than the {context} rows of context; record longer ones.")
    found = []
    for number in range(count):
        pool = ending if ending and number % 2 == 0 else long
        first, stop = pool[_whole(rng, len(pool))]
        last = stop - context - 2  # a window has a step after its context
        least = max(first, last - horizon + 2) if pool is ending else first
        found.append(_passage(cache, least + _whole(rng, last - least + 1), stop, context, horizon))
    return found


def fates(
    arms: Mapping[str, World],
    place: str,
    shown: Sequence[Passage],
    horizons: Sequence[int],
    rng: torch.Generator,
    batch: int = 8,
) -> list[Fate]:
    """Every arm dreams on from each passage's context under its actions, the same for all."""
    context = shown[0].clip.context
    if any(len(passage.real) < context + max(horizons) for passage in shown):
        raise DatasetError(f"these passages are shorter than {max(horizons)} steps; draw longer ones.")
    reward = np.stack([passage.clip.reward * passage.real for passage in shown])
    usual = float(np.median(np.concatenate([passage.clip.reward[passage.real] for passage in shown])))
    done = np.stack([passage.clip.done & passage.real for passage in shown])
    going = np.stack([passage.real for passage in shown])
    rows = []
    for arm, world in arms.items():
        told = [
            _follow(world, shown[at : at + batch], max(horizons), make_rng(at)) for at in range(0, len(shown), batch)
        ]
        dreamt = {name: torch.cat([part[name] for part in told]).double() for name in told[0]}
        for horizon in horizons:
            part = slice(context - 1, context - 1 + horizon)
            true_sum = torch.from_numpy(reward[:, part].sum(1)).double()
            paid = usual * torch.from_numpy(going[:, part].sum(1)).double()
            vitals, copied = {}, {}
            for name in (name for name in dreamt if name not in ("reward", "done")):
                truth = np.stack([passage.clip.further[name].reshape(-1) for passage in shown])
                now, then = (torch.from_numpy(truth[:, row]).double() for row in (context - 1, context - 1 + horizon))
                vitals[name] = mean_interval((dreamt[name][:, horizon - 1] - then).abs(), rng)
                copied[name] = mean_interval((now - then).abs(), rng)
            more = true_sum > paid + 1e-6
            ended = torch.from_numpy(done[:, part].any(1))
            rows.append(
                Fate(
                    place,
                    arm,
                    horizon,
                    horizon * world.spec.dt_s,
                    mean_interval((dreamt["reward"][:, :horizon].sum(1) - true_sum).abs(), rng),
                    mean_interval((paid - true_sum).abs(), rng),
                    vitals,
                    copied,
                    auc(dreamt["reward"][:, :horizon].sum(1), more),
                    int(more.sum()),
                    auc(dreamt["done"][:, :horizon].sum(1), ended),
                    int(ended.sum()),
                )
            )
    return rows


def auc(score: torch.Tensor, positive: torch.Tensor) -> float:
    """Area under the ROC curve of scores [n]: how often a positive outranks a negative, ties counting half."""
    high, low = score[positive], score[~positive]
    if not len(high) or not len(low):
        return float("nan")
    above = (high[:, None] > low).double() + 0.5 * (high[:, None] == low).double()
    return float(above.mean())


def _follow(world: World, shown: Sequence[Passage], steps: int, rng: torch.Generator) -> dict[str, torch.Tensor]:
    """reward, done and the vitals that both the world and the passages tell, after each step: float [B, steps]."""
    clips = [passage.clip for passage in shown]
    numbers = [name for name, array in clips[0].further.items() if array[0].size == 1]
    vitals = [name for name in numbers if name in world.spec.channels]
    told = [name for name in ("reward", "done") if name in world.spec.channels] + vitals
    state, context = fold_context(world, clips, rng), clips[0].context
    found: dict[str, list[torch.Tensor]] = {name: [] for name in ("reward", "done", *vitals)}
    for step in range(steps):
        state = world.imagine(state, actions_at(world, clips, context - 1 + step), rng)
        now = world.render(state, told)
        for name, values in found.items():
            values.append(now[name].float().cpu() if name in now else torch.zeros(len(clips)))
    return {name: torch.stack(values, 1) for name, values in found.items()}


def _allowed(cache, first: int, stop: int, where: Where | None) -> list[tuple[int, int]]:
    """The stretches [first, stop) of an episode whose rows `where` allows."""
    if where is None:
        return [(first, stop)]
    inside = np.concatenate([[False], np.asarray(where(cache, first, stop), bool), [False]]).astype(int)
    begins, ends = np.flatnonzero(np.diff(inside) > 0), np.flatnonzero(np.diff(inside) < 0)
    return [(first + int(a), first + int(b)) for a, b in zip(begins, ends)]


def _passage(cache, start: int, stop: int, context: int, horizon: int) -> Passage:
    wanted = start + np.arange(context + horizon)
    rows, real = np.minimum(wanted, stop - 1), wanted < stop - 1

    def part(array):
        return None if array is None else np.asarray(array[rows])

    zeros = np.zeros(len(rows), np.float32)
    reward, done = part(cache.reward), part(cache.done)
    action = np.asarray(cache.action[rows]) * real.reshape(-1, *[1] * (np.ndim(cache.action) - 1))
    clip = Clip(
        np.asarray(cache.rgb[rows]), part(cache.depth), part(cache.pose), action, zeros if reward is None else reward,
        zeros.astype(bool) if done is None else done, context, 0, start,
        {name: np.asarray(array[rows]) for name, array in cache.further.items()},
    )  # fmt: skip
    return Passage(clip, real)


def _whole(rng: torch.Generator, below: int) -> int:
    return int(torch.randint(max(below, 1), (1,), generator=rng).item())
