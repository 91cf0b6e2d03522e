"""Dreams: a finished world goes on learning inside its own dreams, so that long play does not drift.

Self-Forcing (Huang et al. 2025): a world that learned from recorded frames meets its own mistakes only in play. Here it is
shown the start of a recorded stretch and rolls out with its own state - its own frames, its own keyframes - and every
frame it draws is held against the recorded one; the gradient ends at the frame before. What was not determined makes
dream and recording part: there the recorded frame alone would teach a mean of all that could be, so a critic, and a
teacher's distribution where there is one, say what a frame should look like.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from ...core.errors import DatasetError
from ...worlds.generator import encode_depth
from ...worlds.learned import LearnedWorld
from ...worlds.parts import newest_frame
from ..batches import Batch, as_drawn, coded
from ..history_batches import changing
from ..recording import Recording
from ..trainer import Loss, Now
from .distillation import Student

CONTEXT = 10  # recorded frames before a dream


class Rollouts:
    """`batch` dreams that follow recorded rows: what the generator is shown next, and the frame that was recorded."""

    def __init__(self, world: LearnedWorld, recording: Recording, horizon: int, batch: int, now: Now):
        """Of a world with a memory every other batch of dreams is without it: there most must be invented."""
        self.recording, self.world, self.config = recording, world, world.config
        if self.config.geometry and now.rng.random() < 0.5:
            self.world = world.without_memory()
        rows = now.rng.choice(beginnings(recording, horizon), batch)
        self.row = rows - CONTEXT + 1
        self.state = self.world.observe(recording.evidence(self.config, self.row), None, now.noise)
        if self.config.objects:  # these dreams are of what stands still
            self.state = self.state.replace(billboards=torch.zeros_like(self.state["billboards"]))
        while (self.row < rows).all():
            self.go_on(as_drawn(self.next_batch().truth))
            if self.config.objects:
                self.state = self.state.replace(instances=recording.instances(self.row).to(self.world.device))

    def next_batch(self) -> Batch:
        """What the generator is shown of the next frame, and the truth; on the world's device."""
        recording, world, there = self.recording, self.world, self.world.device
        self.row = self.row + 1
        found, weight = recording.rgb(self.row), None
        numbers = recording.action(self.row - 1).to(there)
        pose = recording.pose(self.row).to(there) if self.config.geometry else None
        self.state, self.after = world.move(self.state, numbers, pose)
        self.shown = world.look(self.after, self.state)
        if self.config.geometry:
            depth = recording.depth(self.row)
        else:
            depth = self.shown.glimpse.depth.cpu()
            newest = newest_frame(self.state).cpu()
            weight = changing(found, torch.stack([newest, recording.rgb(self.row - 1)], 1))
        truth = torch.cat([coded(found), encode_depth(depth)[:, None]], 1)
        if self.config.moving:
            truth = torch.cat([truth, recording.things(self.row)[:, None]], 1)
        if self.config.objects:
            weight = (~recording.covered(self.row))[:, None].float()
        return Batch(self.shown, truth, weight).to(there)

    @torch.no_grad()
    def go_on(self, clean: torch.Tensor) -> None:
        """The dream continues from the frame that was drawn."""
        self.state = self.world.take(self.after, self.state, self.shown, clean.detach())


def beginnings(recording: Recording, horizon: int) -> np.ndarray:
    """Rows from which `horizon` more can be dreamt, CONTEXT rows being known before them, within one episode and all usable."""
    rows = recording.within(CONTEXT - 1, horizon)
    if not len(rows):
        raise DatasetError(
            f"no stretch of {CONTEXT + horizon} rows of the recording may be trained on; record more, or dream a shorter --horizon."
        )
    return rows


class Dreams:
    """What a student learns of dreams, each of whose `horizon` frames is one update; `real(now)` gives recorded batches for its
    critic."""

    def __init__(self, student: Student, horizon: int, real: Callable[[Now], Batch]):
        self.student, self.horizon, self.real = student, horizon, real
        self.modules, self.learners = student.modules, student.learners

    def losses(self, batch: Rollouts, now: Now) -> Iterator[Loss]:
        for frame in range(self.horizon):
            asked, judged = batch.next_batch().to(now.device), now.step * self.horizon + frame
            fresh = yield from self.student.descent(asked, lambda: self.real(now).to(now.device), judged, now)
            batch.go_on(fresh)
