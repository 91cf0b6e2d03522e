"""Learning to doubt: a trained world dreams recorded stories again, and a Uncertainty learns how wrong each frame came out.

The generator stays as it is. Stories are dreamt with the recordings' memory, with holes torn in it, without it, and from a
lone picture, under the recorded actions or along the recorded poses; so the doubt meets invention without new recordings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from ..core.errors import DatasetError, TrainingError
from ..core.state import State
from ..core.world import Observation, make_rng
from ..worlds.folder import Learned
from ..worlds.history import HistoryWorld
from ..worlds.uncertainty import CELLS, KNOTS, Uncertainty, UncertaintyConfig, clues
from ..worlds.video import VideoWorld
from .samples import Recording
from .updates import Report

MEMORY, HOLES, NONE, LONE = "memory", "holes", "no memory", "lone picture"
SHOWN = (1, 3, 10)  # frames that a dream may be shown before it goes on alone
_APART = 5  # one in so many stories is for calibration


@dataclass(frozen=True)
class DoubtTraining:
    """Settings of the training of a world's doubt.

    Args:
        frames: Dreamt frames that it learns from.
        horizon: Steps that a dream lasts.
        batch: Stories dreamt together.
        steps: Training steps.
        seed: Of everything random.
    """

    frames: int = 12_000
    horizon: int = 64
    batch: int = 6
    steps: int = 1500
    seed: int = 0


@dataclass(frozen=True)
class Dreamt:
    """N frames of dreams: their clues [N, CLUES, h, w] (half precision) and situations [N, S], how wrong they are in
    cells [N, h / 2, w / 2] and on the whole [N], the number of their story, and what memory was left in it."""

    clues: torch.Tensor
    situation: torch.Tensor
    cells: torch.Tensor
    error: torch.Tensor
    story: torch.Tensor
    arm: list[str]

    @staticmethod
    def joined(parts: list[Dreamt]) -> Dreamt:
        names = ("clues", "situation", "cells", "error", "story")
        tensors = [torch.cat([vars(part)[name] for part in parts]) for name in names]
        return Dreamt(*tensors, arm=[arm for part in parts for arm in part.arm])

    def at(self, index: torch.Tensor) -> Dreamt:
        names = ("clues", "situation", "cells", "error", "story")
        return Dreamt(*(vars(self)[name][index] for name in names), arm=[self.arm[i] for i in index.tolist()])


def learn_uncertainty(
    world: Learned, recording: Recording, config: DoubtTraining, report: Report
) -> tuple[Uncertainty, dict]:
    """The doubt of `world` and what is known of it: its `sure` and `invents` levels, and of stories that
    neither taught nor calibrated it the mean error and the mean that was expected."""
    shown = max(SHOWN)
    horizon = min(config.horizon, int(_ahead(recording).max()) - shown)
    if horizon < 8:
        raise DatasetError(
            f"no {shown + 8} rows in a row can be dreamt again to learn doubt from; record longer episodes."
        )
    config = replace(config, horizon=horizon)
    stories = max(2, math.ceil(config.frames / (config.batch * config.horizon)))
    parts = []
    for number, part in enumerate(dreams(world, recording, config, stories)):
        parts.append(part)
        report(number, 2 * stories, f"doubt: dreamt {(number + 1) * config.batch * config.horizon:,} frames")
    seen = Dreamt.joined(parts)
    kept = seen.story % _APART == 0
    lessons, others = seen.at((~kept).nonzero()[:, 0]), seen.at(kept.nonzero()[:, 0])
    uncertainty = fit(lessons, config, report)
    apart = others.story // _APART % 2 == 0
    if apart.all() or not apart.any():
        apart = torch.arange(len(apart)) % 2 == 0
    calibrate(uncertainty, others.at(apart.nonzero()[:, 0]))
    others = others.at((~apart).nonzero()[:, 0])
    expected = answers(uncertainty, others)
    facts = {"sure": float(uncertainty.sure), "invents": float(uncertainty.invents), "frames": len(others.error)}
    facts |= {"error": float(others.error.mean()), "expected": float(expected.mean())}
    facts["rank_correlation"] = _rank_correlation(expected, others.error)
    return uncertainty, facts


class _Notebook:
    """In the place of a doubt: keeps what a doubt would be asked."""

    def __init__(self):
        self.asked: list[tuple[torch.Tensor, torch.Tensor]] = []

    def expected(self, glimpse, last, clean, situation, strange) -> torch.Tensor:
        self.asked.append((clues(glimpse, last, clean).half(), situation))
        return torch.zeros(len(clean))


def dreams(world: Learned, recording: Recording, config: DoubtTraining, batches: int) -> Iterator[Dreamt]:
    """Batches of stories from the recording, dreamt again; the same seed gives the same."""
    for number in range(batches):
        rng = np.random.default_rng([config.seed, 7, number])
        arms = [MEMORY] if isinstance(world, HistoryWorld) else [MEMORY, HOLES, NONE, HOLES, MEMORY, NONE, LONE]
        arm = arms[number % len(arms)]
        if arm == LONE and isinstance(world, VideoWorld) and world.estimator is None:
            arm = NONE
        shown = 1 if arm == LONE else int(rng.choice(SHOWN))
        begins = _begins(recording, shown + config.horizon, config.batch, rng)
        poses_given = arm != LONE and isinstance(world, VideoWorld) and not world.config.moving and rng.random() < 0.35
        yield _dream(world, recording, begins, shown, config.horizon, arm, poses_given, number * config.batch, rng)


@torch.inference_mode()
def _dream(
    world: Learned, recording: Recording, begins: np.ndarray, shown: int, horizon: int, arm: str, poses_given: bool,
    first_story: int, rng: np.random.Generator,
) -> Dreamt:  # fmt: skip
    book = _Notebook()
    dreamer = _noted(world, recording, begins, horizon, arm, book, rng)
    chance = make_rng(int(rng.integers(2**62)))
    alone = arm == LONE
    state = dreamer.observe(_evidence(dreamer, recording, begins, alone), None, chance)
    for row in range(1, shown):
        state = dreamer.imagine(state, recording.played(dreamer.spec, begins + row - 1), chance)
        state = dreamer.observe(_evidence(dreamer, recording, begins + row, alone), state, chance)
    parts = []
    for step in range(horizon):
        rows = begins + shown + step
        state = _onward(dreamer, state, recording, rows, poses_given, chance)
        book.asked, (maps, situation) = [], book.asked[-1]
        truth = recording.rgb(rows).float() / 255
        off = (dreamer.render(state, ("rgb",))["rgb"].permute(0, 3, 1, 2).float() / 255 - truth).abs().mean(1)
        cells = F.avg_pool2d(off, 2 * CELLS, ceil_mode=True, count_include_pad=False)
        stories = torch.arange(len(begins)) + first_story
        parts.append(Dreamt(maps, situation, cells, off.mean((1, 2)), stories, [arm] * len(begins)))
    return Dreamt.joined(parts)


def _onward(
    world: Learned, state: State, recording: Recording, rows: np.ndarray, pose: bool, chance: torch.Generator
) -> State:
    if pose:
        return world.observe({"pose": recording.pose(rows)}, state, chance)
    return world.imagine(state, recording.played(world.spec, rows - 1), chance)


def _noted(world, recording, begins, horizon, arm, book, rng) -> Learned:
    """`world` with the memory that is left in this arm, and with `book` for its doubt."""
    if not isinstance(world, VideoWorld) or arm == MEMORY:
        return world.with_senses(getattr(world, "eye", None), book)
    if arm in (NONE, LONE):
        return world.without_memory().with_senses(world.estimator, book)
    middle = recording.pose(begins + int(rng.integers(0, horizon)))[:, :2]
    away = (world.memory.pose[None, :, :2] - middle[:, None]).norm(dim=-1).amin(0)
    left = (away > float(rng.uniform(2.0, 8.0))).nonzero()[:, 0]
    return world.with_memory(world.memory.at(left)).with_senses(world.estimator, book)


def _evidence(world: Learned, recording: Recording, rows: np.ndarray, alone: bool) -> Observation:
    seen = recording.evidence(world.config, rows)
    return {"rgb": seen["rgb"]} if alone else seen


def _ahead(recording: Recording) -> np.ndarray:
    """Of each row, how many follow one another from it on that may be seen, by valid actions in one episode: [N]."""
    fine = recording.usable & np.asarray(recording.cache.action_valid)
    if recording.cache.done is not None:
        fine &= ~np.asarray(recording.cache.done)
    last = np.append(recording.start[1:] != recording.start[:-1], True)
    ends = np.flatnonzero(~fine | last)
    rows = np.arange(len(fine))
    end = ends[np.searchsorted(ends, rows)]
    return np.where(fine, end - rows + fine[end], 0)


def _begins(recording: Recording, length: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rows from which `length` of the same episode may be seen."""
    return rng.choice(np.flatnonzero(_ahead(recording) >= length), count)


def fit(seen: Dreamt, config: DoubtTraining, report: Report) -> Uncertainty:
    """By the likelihood of errors that scatter exponentially around the expected one, of frames and of their cells: the
    expectation, not the median, is learned, and small errors count as much as large ones."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        uncertainty = Uncertainty(UncertaintyConfig(seen.situation.shape[1]))
    optimiser = torch.optim.AdamW(uncertainty.parameters(), 3e-3, (0.9, 0.99), weight_decay=1e-3)
    rng = np.random.default_rng([config.seed, 8])
    for step in range(config.steps):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * min(1, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        pick = torch.from_numpy(rng.integers(0, len(seen.error), 64))
        maps, cells = seen.clues[pick].float(), seen.cells[pick]
        if rng.random() < 0.5:
            maps, cells = maps.flip(-1), cells.flip(-1)
        if rng.random() < 0.5:
            colours = torch.from_numpy(rng.permutation(3))
            maps = torch.cat([maps[:, colours], maps[:, 3 + colours], maps[:, 6:]], 1)
        answer = uncertainty(maps, seen.situation[pick])
        loss = _unlikely(answer.mean((1, 2)), seen.error[pick]) + 0.3 * _unlikely(answer, cells)
        if not torch.isfinite(loss):
            raise TrainingError(f"the doubt's loss is not a number at step {step}; give another --seed.")
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(uncertainty.parameters(), 1.0)
        optimiser.step()
        if step % 50 == 0:
            report(config.steps + step, 2 * config.steps, "doubt: learning how wrong they were")
    return uncertainty.eval().requires_grad_(False)


def calibrate(uncertainty: Uncertainty, seen: Dreamt) -> None:
    """Isotonic regression (pool adjacent violators) of the error on the answer, in KNOTS bins of as many frames; and the
    levels at which the page of play calls a world sure or inventing."""
    answer = answers(uncalibrated(uncertainty), seen)
    order = answer.argsort()
    bins = [part for part in np.array_split(order.numpy(), KNOTS) if len(part)]
    found = [float(answer[part].mean()) for part in bins]
    meant = pooled([float(seen.error[part].mean()) for part in bins], [len(part) for part in bins])
    while len(found) < KNOTS:
        found, meant = [*found, found[-1]], [*meant, meant[-1]]
    uncertainty.found.copy_(torch.tensor(found))
    uncertainty.meant.copy_(torch.tensor(meant))
    known = torch.tensor([arm == MEMORY for arm in seen.arm])
    sure = seen.error[known].median() if known.any() else seen.error.quantile(0.25)
    rest = seen.error[~known].quantile(0.6) if (~known).any() else seen.error.quantile(0.9)
    uncertainty.sure.copy_(sure)
    uncertainty.invents.copy_(torch.maximum(rest, 1.5 * sure))


def uncalibrated(uncertainty: Uncertainty) -> Uncertainty:
    """The same network, answering as it was learned."""
    plain = Uncertainty(uncertainty.config)
    plain.load_state_dict({**plain.state_dict(), **dict(uncertainty.named_parameters())})
    return plain.eval().requires_grad_(False)


@torch.inference_mode()
def answers(uncertainty: Uncertainty, seen: Dreamt) -> torch.Tensor:
    """The calibrated error that `doubt` expects of each frame [N]."""
    parts = torch.arange(len(seen.error)).split(256)
    return torch.cat(
        [uncertainty.calibrated(uncertainty(seen.clues[p].float(), seen.situation[p]).mean((1, 2))) for p in parts]
    )


def pooled(values: list[float], weights: list[float]) -> list[float]:
    """The ascending sequence nearest to `values` in weighted squares (Ayer et al. 1955)."""
    blocks: list[list[float]] = []  # mean, weight, count
    for value, weight in zip(values, weights, strict=True):
        blocks.append([value, weight, 1])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            mean, heavy, count = blocks.pop()
            below = blocks[-1]
            total = below[1] + heavy
            blocks[-1] = [(below[0] * below[1] + mean * heavy) / total, total, below[2] + count]
    return [mean for mean, _, count in blocks for _ in range(int(count))]


def _unlikely(expected: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    return (expected.log() + error / expected).mean()


def _rank_correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    """Spearman's."""
    ranks = torch.stack([values.argsort().argsort().double() for values in (a, b)])
    return float(torch.corrcoef(ranks)[0, 1])
