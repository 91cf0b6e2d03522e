"""Motion: how actions move the recorded poses, and the size of the body that slides along walls as recorded."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ...space.camera import yaw
from ...space.floorplan import floor_plan, slide
from ...space.keyframes import Keyframes
from ...worlds.body import Motion
from ...worlds.config import MotionConfig
from ..feeds import RandomBatches
from ..learners import Learner
from ..recording import Recording
from ..train_step import TrainStep
from ..trainer import CPU, Loss, Run, Trainer

_WINDOWS, _LENGTH = 512, 24  # trajectories, and steps of each, on which the body is fitted
_BATCH, _RARE = 512, 64  # steps of a batch, and how many of them are last steps of episodes


def learn_motion(run: Run, motion: Motion, recording: Recording, memory: Keyframes, steps: int):
    """Trains `motion` in place; returns the body that fits best (`body_m`, `short`), and its mean position error after 24 steps in
    metres."""
    seen = Steps.of(recording, motion.config)
    motion.middle.copy_((seen.place.amin(0) + seen.place.amax(0)) / 2)
    motion.span.copy_((seen.place.amax(0) - seen.place.amin(0)).max().clamp_min(1e-3))
    objective, ended = MotionObjective(motion, seen), bool(seen.ended.any())
    trainer = Trainer(run, "motion", RandomBatches(objective.sample), objective, steps, device=CPU)
    trainer.train()
    if not ended:  # no episode of the recording ended
        last = list(motion.ending.parameters())[-2:]
        last[0].data.zero_()
        last[1].data.fill_(-20.0)
    return trainer.compute_once("body", lambda: fit_body(motion.eval(), recording, memory, run.seed))


class Steps(NamedTuple):
    """n recorded steps: heading [n], speed [n, 2] metres a step, actions [n, history + 1, A] before each; next heading [n],
    displacement [n, 2] and place [n, 2] after it, and whether the episode ended there [n]."""

    heading: torch.Tensor
    speed: torch.Tensor
    actions: torch.Tensor
    next_heading: torch.Tensor
    displacement: torch.Tensor
    place: torch.Tensor
    ended: torch.Tensor

    @staticmethod
    def of(recording: Recording, config: MotionConfig) -> Steps:
        cache = recording.cache
        pose = torch.from_numpy(np.array(cache.pose))
        place, heading, number = pose[:, :2], yaw(pose), np.arange(cache.length)
        usable = recording.usable & np.roll(recording.usable, -1) & np.array(cache.action_valid)
        usable &= (number - recording.start >= 1) & (number + 1 < cache.length)
        rows = np.flatnonzero(usable)
        at = torch.from_numpy(rows)
        ended = np.zeros(len(rows), bool) if cache.done is None else np.array(cache.done)[rows]
        before = heading[at], place[at] - place[at - 1], _actions(recording, rows, config.history)
        return Steps(*before, heading[at + 1], place[at + 1] - place[at], place[at + 1], torch.from_numpy(ended))


class MotionObjective:
    """Absolute errors, so that the fit is that of free steps, which outnumber those against walls."""

    def __init__(self, motion: Motion, seen: Steps):
        self.motion, self.seen, self.rare = motion, seen, np.flatnonzero(seen.ended.numpy())
        self.modules = {"motion": motion}
        optimiser = torch.optim.Adam(motion.parameters(), lr=1e-2)

        def rate(now: TrainStep) -> float:
            """One cycle (Smith & Topin 2019): the rate rises and falls, the momentum falls and rises."""
            for group in optimiser.param_groups:
                group["betas"] = (0.95 - 0.1 * one_cycle(now.share, 0.0, 0.0), 0.999)
            return 1e-2 * one_cycle(now.share)

        self.learners = {"motion": Learner(optimiser, (motion,), rate, clip=math.inf)}

    def sample(self, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows of a batch of steps, and those from which termination is learned."""
        pick = torch.from_numpy(now.rng.integers(0, len(self.seen.heading), _BATCH))
        ends = pick.clone()
        if len(self.rare):
            ends[:_RARE] = torch.from_numpy(now.rng.choice(self.rare, _RARE))
        return pick, ends

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor], now: TrainStep) -> Iterator[Loss]:
        pick, ends = batch
        at = Steps(*(part[pick] for part in self.seen))
        heading, wish = self.motion(at.heading, at.speed, at.actions)
        off = heading - at.next_heading
        turn = torch.atan2(off.sin(), off.cos()).abs().mean() * 20
        move = (wish - at.displacement).abs().sum(-1).mean() * 10
        logit = self.motion.ends(self.seen.place[ends], self.seen.actions[ends, -1])
        ending = F.binary_cross_entropy_with_logits(logit, self.seen.ended[ends].float())
        yield Loss("motion", turn + move + 0.1 * ending, {"off_cm": 10 * move, "ending": ending})


def one_cycle(share: float, begin: float = 0.04, end: float = 4e-6, warm: float = 0.3) -> float:
    """From `begin` up to 1 and down to `end` along cosines."""
    if share < warm:
        return begin + (1 - begin) * 0.5 * (1 - math.cos(math.pi * share / warm))
    return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * (share - warm) / (1 - warm)))


def _actions(recording: Recording, rows: np.ndarray, history: int) -> torch.Tensor:
    """Actions [n, history + 1, A] up to each of `rows`; zero before an episode's first."""
    return recording.actions_before(rows, np.arange(history, -1, -1))


@torch.no_grad()
def fit_body(motion: Motion, recording: Recording, memory: Keyframes, seed: int) -> dict[str, float]:
    """The body whose trajectories end nearest to the recorded ones: a grid of 5 cm, then 5 mm around the best, then finer."""
    first = recording.rows_within(1, _LENGTH, acted=True)
    if not len(first):
        return {"body_m": 0.0, "short": 0.0}  # no trajectory is long enough: nothing stops the body
    first = np.random.default_rng(seed).choice(first, min(_WINDOWS, len(first)), replace=False)
    walls = floor_plan(memory.walls, memory.pose)
    errors = {}

    def off(half: float, short: float) -> float:
        if (half, short) not in errors:
            errors[half, short] = _endpoint_error(motion, recording, first, walls, half, short)
        return errors[half, short]

    def best(halves: Iterable[float], shares: Iterable[float]) -> tuple[float, float, float]:
        return min((off(half, short), half, short) for half in halves if half >= 0 for short in shares)

    # The error is a jagged valley half a centimetre wide: it is searched that finely, for each of three shares.
    _, half, _ = best(np.linspace(0.0, 1.0, 21).tolist(), (0.0,))
    _, half, _ = best((half + np.linspace(-0.05, 0.05, 21)).tolist(), (0.0, 1 / 32, 1 / 8))
    error, half, short = best((half,), (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8))
    for reach in (0.003, 0.001):
        error, half, short = best((half + reach * np.linspace(-1, 1, 5)).tolist(), (short,))
    return {"body_m": half, "short": short, "motion_error_m": error}


def _endpoint_error(motion: Motion, recording: Recording, first: np.ndarray, walls, half: float, short: float) -> float:
    """Mean distance in metres from the recorded places after `_LENGTH` steps from the rows `first`."""
    pose = recording.pose(first)
    place, heading = pose[:, :2], yaw(pose)
    speed = place - recording.pose(first - 1)[:, :2]
    for step in range(_LENGTH):
        heading, wish = motion(heading, speed, _actions(recording, first + step, motion.config.history))
        step_m, speed = slide(walls, place, wish, half, short)
        place = place + step_m
    return float((place - recording.pose(first + _LENGTH)[:, :2]).norm(dim=-1).mean())
