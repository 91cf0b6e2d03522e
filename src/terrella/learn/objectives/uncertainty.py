"""Uncertainty: a trained world rolls out recorded episodes, and a network learns how large the error of each frame is.

The generator is not changed. Episodes are rolled out with the recordings' memory, with holes in it, without it, and from a lone
picture, under the recorded actions or along the recorded poses; so frames that are invented occur without new recordings.
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
from ...core.world import Observation, make_rng, without_end
from ...worlds.generator import Conditioning
from ...worlds.learned import LearnedWorld
from ...worlds.parts import newest_frame
from ...worlds.uncertainty import (
    CELLS,
    KNOTS,
    UncertaintyConfig,
    UncertaintyNetwork,
    UncertaintyProbe,
    input_maps,
    situation_of,
)
from ..calibration import isotonic
from ..feeds import RandomBatches
from ..learners import adamw, warmup_cosine
from ..recording import Recording
from ..run_folder import resume_file
from ..train_step import TrainStep
from ..trainer import CPU, Loss, Run, Trainer
from .drift import ROLLOUTS, ceiling_of, drift_frames, drift_horizon, fit_drift

MEMORY, HOLES, NONE, LONE = "memory", "holes", "no memory", "lone picture"
ARMS = (MEMORY, HOLES, NONE, HOLES, MEMORY, NONE, LONE)  # in turn
SHOWN = (1, 3, 10)  # numbers of recorded frames that a rollout may observe first
DREAMT = "dreamt"  # the folder of the run that keeps them until the training is over
MIN_HORIZON = 8  # steps of a rollout
DREAMING, DRIFTING = 0.45, 0.2  # the parts of the stage's time for rollouts, short and long; the rest is for training
_APART = 5  # every 5th episode is for calibration


class DreamFrames(NamedTuple):
    """N frames of rollouts: their clues [N, INPUT_MAPS, h, w] (half precision) and situations [N, S], the inputs; their errors
    in cells [N, h / 2, w / 2] and in the mean [N]; the number of their episode [N], and the index of their arm in ARMS [N]."""

    clues: torch.Tensor
    situation: torch.Tensor
    cells: torch.Tensor
    error: torch.Tensor
    episode: torch.Tensor
    arm: torch.Tensor

    @staticmethod
    def joined(parts: list[DreamFrames]) -> DreamFrames:
        return DreamFrames(*map(torch.cat, zip(*parts)))

    def at(self, index: torch.Tensor) -> DreamFrames:
        return DreamFrames(*(part[index] for part in self))


@dataclass(frozen=True)
class DreamSettings:
    """How rollouts are made: `frames` in all, `horizon` steps each, `batch` at a time, after a number of `shown` frames."""

    frames: int = 12_000
    horizon: int = 64
    batch: int = 6
    seed: int = 0
    shown: tuple[int, ...] = SHOWN

    @property
    def batches(self) -> int:
        return max(2, math.ceil(self.frames / (self.batch * self.horizon)))


def learn_uncertainty(
    run: Run, world: LearnedWorld, recording: Recording, frames: int
) -> tuple[UncertaintyNetwork, dict]:
    """The uncertainty of `world` and its facts: its `sure` and `invents` levels and, on episodes that were used neither for
    training nor for calibration, the mean error, the mean expected error and their rank correlation."""
    horizon = _horizon(recording, frames)
    if horizon < MIN_HORIZON:
        raise DatasetError(
            f"no {max(SHOWN) + MIN_HORIZON} rows in a row can be predicted to learn uncertainty from; record longer episodes."
        )
    seen = _kept(run, world.to(run.device), recording, DreamSettings(frames, horizon, seed=run.seed))
    apart = seen.episode % _APART == 0
    learned, others = seen.at(~apart), seen.at(apart)
    uncertainty = fit_uncertainty(run, learned, _steps(frames))
    half = others.episode // _APART % 2 == 0
    if half.all() or not half.any():
        half = torch.arange(len(half)) % 2 == 0
    calibrate(uncertainty, others.at(half))
    others = others.at(~half)
    facts = calibrate_drift(run, world.replaced(uncertainty=uncertainty), recording, frames)
    expected = expected_error(uncertainty, others)
    facts |= {"sure": float(uncertainty.sure), "invents": float(uncertainty.invents), "frames": len(others.error)}
    facts |= {"error": float(others.error.mean()), "expected": float(expected.mean())}
    facts["rank_correlation"] = rank_correlation(expected, others.error)
    shutil.rmtree(run.out / DREAMT, ignore_errors=True)
    return uncertainty, facts


def calibrate_drift(run: Run, world: LearnedWorld, recording: Recording, frames: int) -> dict[str, float]:
    """Sets the ceiling of the uncertainty of `world` and how fast its position drifts; these facts."""
    network, horizon = world.uncertainty, drift_horizon(recording, frames)
    assert isinstance(network, UncertaintyNetwork)
    network.ceiling.fill_(ceiling_of(recording, run.seed))
    network.invents.clamp_(max=0.6 * float(network.ceiling))
    network.sure.clamp_(max=0.5 * float(network.invents))
    limit_s = DRIFTING * run.budget.most_s("uncertainty")
    dreamer = world.to(run.device)
    fit_drift(network, drift_frames(dreamer, recording, horizon, seed=run.seed, limit_s=limit_s))
    return {"ceiling": float(network.ceiling), "drift_steps": horizon}


def uncertainty_seconds(world: LearnedWorld, recording: Recording, frames: int) -> float:
    """Seconds that `learn_uncertainty` will take with this world, estimated from a few steps."""
    horizon = _horizon(recording, frames)
    if horizon < MIN_HORIZON:
        return 0.0
    dreamt_s, seen = _dreamt_s(world, recording, horizon)
    began = time.monotonic()
    with torch.random.fork_rng(devices=[]):
        objective = UncertaintyObjective(UncertaintyNetwork(UncertaintyConfig(seen.situation.shape[1])), seen)
    for step in range(3):
        now = TrainStep(step, 0.0, CPU, np.random.default_rng(step), make_rng(step))
        for loss in objective.losses(objective.sample(now), now):
            loss.value.backward()
    return (
        dreamt_s * (frames + ROLLOUTS * drift_horizon(recording, frames))
        + (time.monotonic() - began) * _steps(frames) / 3
    )


def _dreamt_s(world: LearnedWorld, recording: Recording, horizon: int) -> tuple[float, DreamFrames]:
    """Seconds a frame of a rollout, and some frames."""
    trial = DreamSettings(0, 4, shown=(1,))
    dream(world, recording, replace(trial, horizon=1), 0)  # compiles
    began = time.monotonic()
    seen = dream(world, recording, trial, 0)
    step_s = (time.monotonic() - began) / (1 + trial.horizon)
    first = 2 * sum(SHOWN) / len(SHOWN)  # steps before a rollout: each shown frame is imagined and observed
    return step_s * (first + horizon) / (horizon * trial.batch), seen


def discard_uncertainty(out: Path) -> None:
    """Removes what a run has saved of its uncertainty."""
    shutil.rmtree(out / DREAMT, ignore_errors=True)
    resume_file(out, "uncertainty").unlink(missing_ok=True)


def _horizon(recording: Recording, frames: int) -> int:
    """Steps of a rollout: as many as fit into the stretches that hold half of the recording's frames, so that rollouts do not
    all begin in its longest episode. Below MIN_HORIZON if none fits."""
    ahead = recording.steps_ahead()
    lengths = ahead[(ahead > 0) & (np.append(0, ahead[:-1]) != ahead + 1)]  # of the stretches, each from its first row
    lengths = np.sort(lengths[lengths >= max(SHOWN) + MIN_HORIZON])[::-1]
    if not len(lengths):
        return 0
    typical = int(lengths[np.searchsorted(lengths.cumsum(), lengths.sum() / 2)])
    return min(64, max(MIN_HORIZON, frames // 40), typical - max(SHOWN))


def _steps(frames: int) -> int:
    """Training steps for a number of frames."""
    return min(1500, max(20, frames // 6))


def _kept(run: Run, world: LearnedWorld, recording: Recording, rollout: DreamSettings) -> DreamFrames:
    """As many batches of rollouts as there is time for, at least two. Each is saved in the run's folder when it is complete, so
    that a resumed run continues with the next."""
    folder, began = run.out / DREAMT, time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[DreamFrames] = []
    for number in range(rollout.batches):
        path = folder / f"{number:05d}.safetensors"
        if not path.exists():
            if len(parts) >= 2 and time.monotonic() - began > DREAMING * run.budget.most_s("uncertainty"):
                break
            made = dream(world, recording, rollout, number)
            with replacing(path) as staged:
                save_file({name: part.contiguous() for name, part in made._asdict().items()}, staged)
        parts.append(DreamFrames(**load_file(path)))
        frames = (number + 1) * rollout.batch * rollout.horizon
        run.report(number + 1, rollout.batches, f"uncertainty: {frames:,} frames rolled out")
    return DreamFrames.joined(parts)


@torch.inference_mode()
def dream(world: LearnedWorld, recording: Recording, rollout: DreamSettings, number: int) -> DreamFrames:
    """Rolls out one batch of recorded episodes; determined by the seed and the number."""
    rng = np.random.default_rng([rollout.seed, 7, number])
    arms = ARMS if world.config.geometry else (MEMORY,)
    arm = arms[number % len(arms)]
    if arm == LONE and not world.estimator:
        arm = NONE
    alone, horizon = arm == LONE, rollout.horizon
    shown = 1 if alone else int(rng.choice(rollout.shown))
    begins = rng.choice(np.flatnonzero(recording.steps_ahead() >= shown + horizon), rollout.batch)
    posed = not alone and world.config.geometry and not world.config.moving and rng.random() < 0.35
    inputs: list[tuple[torch.Tensor, torch.Tensor]] = []

    def note(conditioning: Conditioning, clean: torch.Tensor, gone: torch.Tensor) -> None:
        inputs.append((input_maps(conditioning, clean).half().cpu(), situation_of(gone, conditioning).cpu()))

    def evidence(rows: np.ndarray) -> Observation:
        seen = recording.evidence(world.config, rows)
        return {name: seen[name] for name in world.cameras} if alone else seen

    dreamer = _remembering(world, recording, begins, horizon, arm, rng).replaced(uncertainty=UncertaintyProbe(note))
    chance = make_rng(int(rng.integers(2**62)))
    state = dreamer.observe(evidence(begins), None, chance)
    for row in range(1, shown):
        state = dreamer.imagine(state, recording.recorded_actions(dreamer.spec, begins + row - 1), chance)
        state = dreamer.observe(evidence(begins + row), state, chance)
    parts, episodes = [], torch.arange(len(begins)) + number * rollout.batch
    for step in range(horizon):
        rows = begins + shown + step
        if posed:
            state = dreamer.observe({"pose": recording.pose(rows)}, state, chance)
        else:
            state = dreamer.imagine(without_end(state), recording.recorded_actions(dreamer.spec, rows - 1), chance)
        drawn = newest_frame(state).cpu().float() / 255
        maps, situation = inputs.pop()
        off = (drawn - recording.rgb(rows).float() / 255).abs().mean(1)
        cells = F.avg_pool2d(off, 2 * CELLS, ceil_mode=True, count_include_pad=False)
        kind = torch.full((len(begins),), ARMS.index(arm))
        parts.append(DreamFrames(maps, situation, cells, off.mean((1, 2)), episodes, kind))
    return DreamFrames.joined(parts)


def _remembering(world: LearnedWorld, recording: Recording, begins, horizon: int, arm: str, rng) -> LearnedWorld:
    """`world` with the memory that it has in this arm."""
    if arm == MEMORY:
        return world
    if arm in (NONE, LONE):
        return world.without_memory()
    middle = recording.pose(begins + int(rng.integers(0, horizon)))[:, :2].to(world.device)
    away = (world.memory.pose[None, :, :2] - middle[:, None]).norm(dim=-1).amin(0)
    left = (away > float(rng.uniform(2.0, 8.0))).nonzero()[:, 0]
    return world.with_memory(world.memory.at(left))


class UncertaintyObjective:
    """The likelihood of errors of frames and cells under exponential distributions with the predicted means: it is the mean that is
    learned, not the median, and relative errors count, so that small errors matter as much as large ones."""

    def __init__(self, uncertainty: UncertaintyNetwork, seen: DreamFrames):
        self.uncertainty, self.seen = uncertainty, seen
        self.modules = {"uncertainty": uncertainty}
        self.learners = {"uncertainty": adamw((uncertainty,), warmup_cosine(3e-3, 50), decay=1e-3)}

    def sample(self, now: TrainStep) -> tuple[torch.Tensor, ...]:
        """A batch of 64 frames: clues, situations, cells and errors; some mirrored, some with permuted colours."""
        pick = torch.from_numpy(now.rng.integers(0, len(self.seen.error), 64))
        maps, cells = self.seen.clues[pick].float(), self.seen.cells[pick]
        if now.rng.random() < 0.5:
            maps, cells = maps.flip(-1), cells.flip(-1)
        if now.rng.random() < 0.5:
            colours = torch.from_numpy(now.rng.permutation(3))
            maps = torch.cat([maps[:, colours], maps[:, 3 + colours], maps[:, 6:]], 1)
        return maps, self.seen.situation[pick], cells, self.seen.error[pick]

    def losses(self, batch: tuple[torch.Tensor, ...], now: TrainStep) -> Iterator[Loss]:
        maps, situation, cells, error = batch
        expected = self.uncertainty(maps, situation)
        loss = _exponential_nll(expected.mean((1, 2)), error) + 0.3 * _exponential_nll(expected, cells)
        yield Loss("uncertainty", loss, {"nll": loss})


def fit_uncertainty(run: Run, seen: DreamFrames, steps: int) -> UncertaintyNetwork:
    """An uncertainty trained on the frames."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        objective = UncertaintyObjective(UncertaintyNetwork(UncertaintyConfig(seen.situation.shape[1])), seen)
    trainer = Trainer(run, "uncertainty", RandomBatches(objective.sample), objective, steps, device=CPU)
    trainer.limit_s *= 1 - DREAMING - DRIFTING
    trainer.train()
    return objective.uncertainty.eval().requires_grad_(False)


def calibrate(uncertainty: UncertaintyNetwork, seen: DreamFrames) -> None:
    """Isotonic regression of the error on the network's output, and the levels at which the page of play calls a world certain or
    inventing."""
    answers, errors = isotonic(_raw_error(uncertainty, seen).clamp(0, 1), seen.error, KNOTS)
    uncertainty.answers.copy_(answers)
    uncertainty.errors.copy_(errors)
    known = torch.tensor([arm == MEMORY for arm in ARMS])[seen.arm]
    sure = seen.error[known].median() if known.any() else seen.error.quantile(0.25)
    rest = seen.error[~known].quantile(0.6) if (~known).any() else seen.error.quantile(0.9)
    uncertainty.sure.copy_(sure)
    uncertainty.invents.copy_(torch.maximum(rest, 1.5 * sure))


def expected_error(uncertainty: UncertaintyNetwork, seen: DreamFrames) -> torch.Tensor:
    """The calibrated expected error of each frame [N]."""
    return uncertainty.calibrated(_raw_error(uncertainty, seen))


@torch.inference_mode()
def _raw_error(uncertainty: UncertaintyNetwork, seen: DreamFrames) -> torch.Tensor:
    """The expected error before calibration [N]."""
    parts = torch.arange(len(seen.error)).split(256)
    return torch.cat([uncertainty(seen.clues[part].float(), seen.situation[part]).mean((1, 2)) for part in parts])


def _exponential_nll(expected: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    return (expected.log() + error / expected).mean()


def rank_correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    """Spearman's."""
    ranks = torch.stack([values.argsort().argsort().double() for values in (a, b)])
    return float(torch.corrcoef(ranks)[0, 1])
