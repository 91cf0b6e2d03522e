"""Motion: how recorded poses move by what is done; then the body that slides along walls as the recorded one did."""

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
from ..feeds import Drawn
from ..recording import Recording
from ..trainer import CPU, Learner, Loss, Now, Run, Trainer

_WINDOWS, _LENGTH = 512, 24  # walks, and steps of each, on which the body is fitted
_BATCH, _RARE = 512, 64  # steps a batch, and those of them with which an episode ended


def learn_motion(run: Run, motion: Motion, recording: Recording, memory: Keyframes, steps: int):
    """Fits `motion` in place; returns the body that fits best (`body_m`, `short`), and how far off it is after 24 steps
    (mean, metres)."""
    seen = Steps.of(recording, motion.config)
    motion.middle.copy_((seen.place.amin(0) + seen.place.amax(0)) / 2)
    motion.span.copy_((seen.place.amax(0) - seen.place.amin(0)).max().clamp_min(1e-3))
    objective, ended = Moving(motion, seen), bool(seen.ended.any())
    trainer = Trainer(run, "motion", Drawn(objective.picked), objective, steps, device=CPU)
    trainer.train()
    if not ended:  # nothing was seen to end
        last = list(motion.ending.parameters())[-2:]
        last[0].data.zero_()
        last[1].data.fill_(-20.0)
    return trainer.once("body", lambda: fit_body(motion.eval(), recording, memory, run.seed))


class Steps(NamedTuple):
    """n recorded steps: heading [n], speed [n, 2] metres a step, actions [n, history + 1, A] before each; heading, way [n, 2]
    and place [n, 2] after it, and whether the episode ended there [n]."""

    heading: torch.Tensor
    speed: torch.Tensor
    actions: torch.Tensor
    turned: torch.Tensor
    moved: torch.Tensor
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


class Moving:
    """By absolute errors: steps against a wall are fewer than free ones, so that the fit is that of the free ones."""

    def __init__(self, motion: Motion, seen: Steps):
        self.motion, self.seen, self.rare = motion, seen, np.flatnonzero(seen.ended.numpy())
        self.modules = {"motion": motion}
        optimiser = torch.optim.Adam(motion.parameters(), lr=1e-2)

        def rate(now: Now) -> float:
            """One cycle (Smith and Topin 2019): the rate goes up and down, the momentum down and up."""
            for group in optimiser.param_groups:
                group["betas"] = (0.95 - 0.1 * one_cycle(now.share, 0.0, 0.0), 0.999)
            return 1e-2 * one_cycle(now.share)

        self.learners = {"motion": Learner(optimiser, (motion,), rate, clip=math.inf)}

    def picked(self, now: Now) -> tuple[torch.Tensor, torch.Tensor]:
        """Which steps a batch is of, and those by which the ending is learned."""
        pick = torch.from_numpy(now.rng.integers(0, len(self.seen.heading), _BATCH))
        ends = pick.clone()
        if len(self.rare):
            ends[:_RARE] = torch.from_numpy(now.rng.choice(self.rare, _RARE))
        return pick, ends

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor], now: Now) -> Iterator[Loss]:
        pick, ends = batch
        at = Steps(*(part[pick] for part in self.seen))
        heading, wish = self.motion(at.heading, at.speed, at.actions)
        off = heading - at.turned
        turn = torch.atan2(off.sin(), off.cos()).abs().mean() * 20
        move = (wish - at.moved).abs().sum(-1).mean() * 10
        logit = self.motion.ends(self.seen.place[ends], self.seen.actions[ends, -1])
        ending = F.binary_cross_entropy_with_logits(logit, self.seen.ended[ends].float())
        yield Loss("motion", turn + move + 0.1 * ending, {"off_cm": 10 * move, "ending": ending})


def one_cycle(share: float, begin: float = 0.04, end: float = 4e-6, warm: float = 0.3) -> float:
    """From `begin` up to 1 and down to `end`, along cosines."""
    if share < warm:
        return begin + (1 - begin) * 0.5 * (1 - math.cos(math.pi * share / warm))
    return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * (share - warm) / (1 - warm)))


def _actions(recording: Recording, rows: np.ndarray, history: int) -> torch.Tensor:
    """Actions [n, history + 1, A] up to each of `rows`; none before an episode's first."""
    return recording.actions_before(rows, np.arange(history, -1, -1))


@torch.no_grad()
def fit_body(motion: Motion, recording: Recording, memory: Keyframes, seed: int) -> dict[str, float]:
    """The body whose walks end nearest to the recorded ones: widths by 5 cm, by 5 mm around the best, then finer ones."""
    first = recording.within(1, _LENGTH, acted=True)
    if not len(first):
        return {"body_m": 0.0, "short": 0.0}  # no walk is long enough to tell: nothing will stop it
    first = np.random.default_rng(seed).choice(first, min(_WINDOWS, len(first)), replace=False)
    walls = floor_plan(memory.walls, memory.pose)
    errors = {}

    def off(half: float, short: float) -> float:
        if (half, short) not in errors:
            errors[half, short] = _walked_off(motion, recording, first, walls, half, short)
        return errors[half, short]

    def best(halves: Iterable[float], shares: Iterable[float]) -> tuple[float, float, float]:
        return min((off(half, short), half, short) for half in halves if half >= 0 for short in shares)

    # What is off is a jagged valley of half a centimetre's width: it is searched that finely, for each of three shares.
    _, half, _ = best(np.linspace(0.0, 1.0, 21).tolist(), (0.0,))
    _, half, _ = best((half + np.linspace(-0.05, 0.05, 21)).tolist(), (0.0, 1 / 32, 1 / 8))
    error, half, short = best((half,), (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8))
    for reach in (0.003, 0.001):
        error, half, short = best((half + reach * np.linspace(-1, 1, 5)).tolist(), (short,))
    return {"body_m": half, "short": short, "motion_error_m": error}


def _walked_off(motion: Motion, recording: Recording, first: np.ndarray, walls, half: float, short: float) -> float:
    """Mean distance in metres from the recorded places after `_LENGTH` steps from the rows `first`."""
    pose = recording.pose(first)
    place, heading = pose[:, :2], yaw(pose)
    speed = place - recording.pose(first - 1)[:, :2]
    for step in range(_LENGTH):
        heading, wish = motion(heading, speed, _actions(recording, first + step, motion.config.history))
        moved, speed = slide(walls, place, wish, half, short)
        place = place + moved
    return float((place - recording.pose(first + _LENGTH)[:, :2]).norm(dim=-1).mean())
