"""Uncertainty: a trained world dreams recorded episodes again, and a network learns how wrong each frame came out.

The generator stays as it is. Episodes are dreamt with the recordings' memory, with holes torn in it, without it, and from
a lone picture, under the recorded actions or along the recorded poses; so invention is met without new recordings.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file

from ...core.errors import DatasetError
from ...core.files import replacing
from ...core.world import Observation, make_rng
from ...worlds.generator import Conditioning
from ...worlds.learned import LearnedWorld
from ...worlds.uncertainty import CELLS, KNOTS, UncertaintyConfig, UncertaintyNetwork, UncertaintyProbe, clues
from ..feeds import Drawn
from ..recording import Recording
from ..run_folder import resume_file
from ..trainer import CPU, Loss, Now, Run, Trainer, adamw, warmed

MEMORY, HOLES, NONE, LONE = "memory", "holes", "no memory", "lone picture"
ARMS = (MEMORY, HOLES, NONE, HOLES, MEMORY, NONE, LONE)  # in turn
SHOWN = (1, 3, 10)  # frames that a dream may be shown before it goes on alone
DREAMT = "dreamt"  # the folder of the run that keeps them until the training is over
_APART = 5  # one in so many episodes is for calibration


class Dreamt(NamedTuple):
    """N frames of dreams: their clues [N, CLUES, h, w] (half precision) and situations [N, S], how wrong they are in
    cells [N, h / 2, w / 2] and on the whole [N], the number of their episode [N], and which of ARMS they are of [N]."""

    clues: torch.Tensor
    situation: torch.Tensor
    cells: torch.Tensor
    error: torch.Tensor
    episode: torch.Tensor
    arm: torch.Tensor

    @staticmethod
    def joined(parts: list[Dreamt]) -> Dreamt:
        return Dreamt(*map(torch.cat, zip(*parts)))

    def at(self, index: torch.Tensor) -> Dreamt:
        return Dreamt(*(part[index] for part in self))


@dataclass(frozen=True)
class Rollout:
    """How dreams are made: `frames` in all, `horizon` steps each, `batch` at a time; `seed` of everything random."""

    frames: int = 12_000
    horizon: int = 64
    batch: int = 6
    seed: int = 0

    @property
    def batches(self) -> int:
        return max(2, math.ceil(self.frames / (self.batch * self.horizon)))


def learn_uncertainty(
    run: Run, world: LearnedWorld, recording: Recording, frames: int
) -> tuple[UncertaintyNetwork, dict]:
    """The uncertainty of `world` and what is known of it: its `sure` and `invents` levels, and of episodes that neither
    trained nor calibrated it the mean error and the mean that was expected."""
    horizon = _horizon(recording, frames)
    if horizon < 8:
        raise DatasetError(
            f"no {max(SHOWN) + 8} rows in a row can be dreamt again to learn uncertainty from; record longer episodes."
        )
    seen = _kept(run, world, recording, Rollout(frames, horizon, seed=run.seed))
    apart = seen.episode % _APART == 0
    learned, others = seen.at(~apart), seen.at(apart)
    uncertainty = fit(run, learned, _steps(frames))
    half = others.episode // _APART % 2 == 0
    if half.all() or not half.any():
        half = torch.arange(len(half)) % 2 == 0
    calibrate(uncertainty, others.at(half))
    others = others.at(~half)
    expected = answers(uncertainty, others)
    facts = {"sure": float(uncertainty.sure), "invents": float(uncertainty.invents), "frames": len(others.error)}
    facts |= {"error": float(others.error.mean()), "expected": float(expected.mean())}
    facts["rank_correlation"] = rank_correlation(expected, others.error)
    shutil.rmtree(run.out / DREAMT, ignore_errors=True)
    return uncertainty, facts


def expected_s(world: LearnedWorld, recording: Recording, frames: int) -> float:
    """Seconds that `learn_uncertainty` will take of such a world, by a few steps of dreaming and of learning."""
    horizon = _horizon(recording, frames)
    if horizon < 8:
        return 0.0
    dreamt_s, seen = _dreamt_s(world, recording, horizon)
    began = time.monotonic()
    with torch.random.fork_rng(devices=[]):
        objective = Errors(UncertaintyNetwork(UncertaintyConfig(seen.situation.shape[1])), seen)
    for step in range(3):
        now = Now(step, 0.0, CPU, np.random.default_rng(step), make_rng(step))
        for loss in objective.losses(objective.picked(now), now):
            loss.value.backward()
    return dreamt_s * frames + (time.monotonic() - began) * _steps(frames) / 3


def dreaming_s(world: LearnedWorld, recording: Recording, frames: int) -> float:
    """Seconds in which such a world dreams so many frames, by a few of them."""
    horizon = _horizon(recording, frames)
    return 0.0 if horizon < 8 else _dreamt_s(world, recording, horizon)[0] * frames


def _dreamt_s(world: LearnedWorld, recording: Recording, horizon: int) -> tuple[float, Dreamt]:
    """Seconds of a dreamt frame, and some of them."""
    trial = Rollout(0, min(24, horizon))  # no shorter: the frames that a dream is shown first take time, too
    dream(world, recording, replace(trial, horizon=4), 0)  # the first compiles
    began = time.monotonic()
    seen = dream(world, recording, trial, 0)
    return (time.monotonic() - began) / (trial.horizon * trial.batch), seen


def forget(out: Path) -> None:
    """Removes what a run has learned of its uncertainty so far."""
    shutil.rmtree(out / DREAMT, ignore_errors=True)
    resume_file(out, "uncertainty").unlink(missing_ok=True)


def _horizon(recording: Recording, frames: int) -> int:
    """Steps of a dream."""
    return min(64, max(8, frames // 40), int(ahead(recording).max()) - max(SHOWN))


def _steps(frames: int) -> int:
    """Training steps on so many frames."""
    return min(1500, max(20, frames // 6))


def _kept(run: Run, world: LearnedWorld, recording: Recording, rollout: Rollout) -> Dreamt:
    """All dreams for which there is time, two batches or more, each kept in the run's folder as soon as it is whole: a run that
    is stopped goes on with the next."""
    folder, began = run.out / DREAMT, time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[Dreamt] = []
    for number in range(rollout.batches):
        path = folder / f"{number:05d}.safetensors"
        if not path.exists():
            if len(parts) >= 2 and time.monotonic() - began > run.budget.most_s("dreams"):
                break
            made = dream(world, recording, rollout, number)
            with replacing(path) as staged:
                save_file({name: part.contiguous() for name, part in made._asdict().items()}, staged)
        parts.append(Dreamt(**load_file(path)))
        frames = (number + 1) * rollout.batch * rollout.horizon
        run.report(number + 1, rollout.batches, f"uncertainty: dreamt {frames:,} frames")
    return Dreamt.joined(parts)


@torch.inference_mode()
def dream(world: LearnedWorld, recording: Recording, rollout: Rollout, number: int) -> Dreamt:
    """One batch of episodes from the recording, dreamt again; the same seed and number give the same."""
    rng = np.random.default_rng([rollout.seed, 7, number])
    arms = ARMS if world.config.geometry else (MEMORY,)
    arm = arms[number % len(arms)]
    if arm == LONE and not world.estimator:
        arm = NONE
    alone, horizon = arm == LONE, rollout.horizon
    shown = 1 if alone else int(rng.choice(SHOWN))
    begins = rng.choice(np.flatnonzero(ahead(recording) >= shown + horizon), rollout.batch)
    posed = not alone and world.config.geometry and not world.config.moving and rng.random() < 0.35
    noted: list[tuple[torch.Tensor, torch.Tensor]] = []

    def note(conditioning: Conditioning, clean: torch.Tensor, situation: torch.Tensor) -> None:
        noted.append((clues(conditioning, clean).half().cpu(), situation.cpu()))

    def evidence(rows: np.ndarray) -> Observation:
        seen = recording.evidence(world.config, rows)
        return {"rgb": seen["rgb"]} if alone else seen

    dreamer = _remembering(world, recording, begins, horizon, arm, rng).replaced(uncertainty=UncertaintyProbe(note))
    chance = make_rng(int(rng.integers(2**62)))
    state = dreamer.observe(evidence(begins), None, chance)
    for row in range(1, shown):
        state = dreamer.imagine(state, recording.played(dreamer.spec, begins + row - 1), chance)
        state = dreamer.observe(evidence(begins + row), state, chance)
    parts, episodes = [], torch.arange(len(begins)) + number * rollout.batch
    for step in range(horizon):
        rows = begins + shown + step
        if posed:
            state = dreamer.observe({"pose": recording.pose(rows)}, state, chance)
        else:
            state = dreamer.imagine(state, recording.played(dreamer.spec, rows - 1), chance)
        drawn = dreamer.render(state, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float() / 255
        maps, situation = noted.pop()
        off = (drawn - recording.rgb(rows).float() / 255).abs().mean(1)
        cells = F.avg_pool2d(off, 2 * CELLS, ceil_mode=True, count_include_pad=False)
        kind = torch.full((len(begins),), ARMS.index(arm))
        parts.append(Dreamt(maps, situation, cells, off.mean((1, 2)), episodes, kind))
    return Dreamt.joined(parts)


def _remembering(world: LearnedWorld, recording: Recording, begins, horizon: int, arm: str, rng) -> LearnedWorld:
    """`world` with the memory that is left in this arm."""
    if arm == MEMORY:
        return world
    if arm in (NONE, LONE):
        return world.without_memory()
    middle = recording.pose(begins + int(rng.integers(0, horizon)))[:, :2].to(world.device)
    away = (world.memory.pose[None, :, :2] - middle[:, None]).norm(dim=-1).amin(0)
    left = (away > float(rng.uniform(2.0, 8.0))).nonzero()[:, 0]
    return world.with_memory(world.memory.at(left))


def ahead(recording: Recording) -> np.ndarray:
    """Of each row, how many follow one another from it on that may be seen, by valid actions in one episode: [N]."""
    fine = recording.usable & np.asarray(recording.cache.action_valid)
    if recording.cache.done is not None:
        fine &= ~np.asarray(recording.cache.done)
    last = np.append(recording.start[1:] != recording.start[:-1], True)
    ends = np.flatnonzero(~fine | last)
    rows = np.arange(len(fine))
    end = ends[np.searchsorted(ends, rows)]
    return np.where(fine, end - rows + fine[end], 0)


class Errors:
    """By the likelihood of errors that scatter exponentially around the expected one, of frames and of their cells: the
    expectation, not the median, is learned, and small errors count as much as large ones."""

    def __init__(self, uncertainty: UncertaintyNetwork, seen: Dreamt):
        self.uncertainty, self.seen = uncertainty, seen
        self.modules = {"uncertainty": uncertainty}
        self.learners = {"uncertainty": adamw((uncertainty,), warmed(3e-3, 50), decay=1e-3)}

    def picked(self, now: Now) -> tuple[torch.Tensor, ...]:
        """64 frames: their clues, situations, cells and errors; mirrored and in other colours now and then."""
        pick = torch.from_numpy(now.rng.integers(0, len(self.seen.error), 64))
        maps, cells = self.seen.clues[pick].float(), self.seen.cells[pick]
        if now.rng.random() < 0.5:
            maps, cells = maps.flip(-1), cells.flip(-1)
        if now.rng.random() < 0.5:
            colours = torch.from_numpy(now.rng.permutation(3))
            maps = torch.cat([maps[:, colours], maps[:, 3 + colours], maps[:, 6:]], 1)
        return maps, self.seen.situation[pick], cells, self.seen.error[pick]

    def losses(self, batch: tuple[torch.Tensor, ...], now: Now) -> Iterator[Loss]:
        maps, situation, cells, error = batch
        answer = self.uncertainty(maps, situation)
        loss = _unlikely(answer.mean((1, 2)), error) + 0.3 * _unlikely(answer, cells)
        yield Loss("uncertainty", loss, {"unlikely": loss})


def fit(run: Run, seen: Dreamt, steps: int) -> UncertaintyNetwork:
    """An uncertainty that expects the errors that were `seen`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        objective = Errors(UncertaintyNetwork(UncertaintyConfig(seen.situation.shape[1])), seen)
    Trainer(run, "uncertainty", Drawn(objective.picked), objective, steps, device=CPU).train()
    return objective.uncertainty.eval().requires_grad_(False)


def calibrate(uncertainty: UncertaintyNetwork, seen: Dreamt) -> None:
    """Isotonic regression (pool adjacent violators) of the error on the answer, in KNOTS bins of as many frames; and the
    levels at which the page of play calls a world sure or inventing."""
    answer = _learned(uncertainty, seen).clamp(0, 1)
    order = answer.argsort()
    bins = [part for part in np.array_split(order.numpy(), KNOTS) if len(part)]
    found = [float(answer[part].mean()) for part in bins]
    meant = pooled([float(seen.error[part].mean()) for part in bins], [len(part) for part in bins])
    while len(found) < KNOTS:
        found, meant = [*found, found[-1]], [*meant, meant[-1]]
    uncertainty.answers.copy_(torch.tensor(found))
    uncertainty.errors.copy_(torch.tensor(meant))
    known = torch.tensor([arm == MEMORY for arm in ARMS])[seen.arm]
    sure = seen.error[known].median() if known.any() else seen.error.quantile(0.25)
    rest = seen.error[~known].quantile(0.6) if (~known).any() else seen.error.quantile(0.9)
    uncertainty.sure.copy_(sure)
    uncertainty.invents.copy_(torch.maximum(rest, 1.5 * sure))


def answers(uncertainty: UncertaintyNetwork, seen: Dreamt) -> torch.Tensor:
    """The calibrated error that `uncertainty` expects of each frame [N]."""
    return uncertainty.calibrated(_learned(uncertainty, seen))


@torch.inference_mode()
def _learned(uncertainty: UncertaintyNetwork, seen: Dreamt) -> torch.Tensor:
    """The error before it is calibrated [N]."""
    parts = torch.arange(len(seen.error)).split(256)
    return torch.cat([uncertainty(seen.clues[part].float(), seen.situation[part]).mean((1, 2)) for part in parts])


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


def rank_correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    """Spearman's."""
    ranks = torch.stack([values.argsort().argsort().double() for values in (a, b)])
    return float(torch.corrcoef(ranks)[0, 1])
