"""Training on dreams: a finished world continues training on its own rollouts, so that long play drifts less.

Self-Forcing (Huang et al. 2025): a world trained on recorded frames meets its own errors only in play. Here it observes the start
of a recorded stretch and rolls out with its own state (its own frames, its own keyframes), and every frame is compared with the
recorded one; gradients do not flow from frame to frame. Where the recording does not determine the future, the recorded frame
alone would teach a mean of all that is possible; there a critic, and the distribution of a teacher, if there is one, are the
targets.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch

from ...core.errors import DatasetError
from ...worlds.generator import encode_depth
from ...worlds.learned import LearnedWorld
from ..batches import Batch, as_generated, encode_rgb
from ..recording import Recording
from ..train_step import TrainStep
from ..trainer import Loss
from .distillation import Student

CONTEXT = 10  # recorded frames before a rollout


class DreamRollouts:
    """`batch` rollouts that follow recorded rows: the inputs of the generator at each step, and the recorded frame."""

    def __init__(self, world: LearnedWorld, recording: Recording, horizon: int, batch: int, now: TrainStep):
        """Every other batch is rolled out without a memory: there most must be invented."""
        self.recording, self.world, self.config = recording, world, world.config
        if now.rng.random() < 0.5:
            self.world = world.without_memory()
        rows = now.rng.choice(dream_starts(recording, horizon), batch)
        self.row = rows - CONTEXT + 1
        self.state = self.world.observe(recording.evidence(self.config, self.row), None, now.noise)
        if self.config.objects:  # these rollouts are of static scenes
            self.state = self.state.replace(billboards=torch.zeros_like(self.state["billboards"]))
        while (self.row < rows).all():
            self.go_on(as_generated(self.next_batch().truth))
            if self.config.objects:
                self.state = self.state.replace(instances=recording.instances(self.row).to(self.world.device))

    def next_batch(self) -> Batch:
        """The inputs of the generator for the next frame, and the truth; on the world's device."""
        recording, world, device = self.recording, self.world, self.world.device
        self.row = self.row + 1
        target, weight = recording.rgb(self.row), None
        numbers = recording.action(self.row - 1).to(device)
        self.state, self.after = world.move(self.state, numbers, recording.pose(self.row).to(device))
        self.shown = world.look(self.after, self.state)
        truth = torch.cat([encode_rgb(target), encode_depth(recording.depth(self.row))[:, None]], 1)
        if self.config.moving:
            truth = torch.cat([truth, recording.things(self.row)[:, None]], 1)
        if self.config.objects:
            weight = (~recording.covered(self.row))[:, None].float()
        return Batch(self.shown, truth, weight).to(device)

    @torch.no_grad()
    def go_on(self, clean: torch.Tensor) -> None:
        """Continues the rollout from the generated frame."""
        self.state = self.world.take(self.after, self.state, self.shown, clean.detach())


def dream_starts(recording: Recording, horizon: int) -> np.ndarray:
    """Rows with CONTEXT usable rows up to them and `horizon` after them in their episode."""
    rows = recording.rows_within(CONTEXT - 1, horizon)
    if not len(rows):
        raise DatasetError(
            f"no stretch of {CONTEXT + horizon} rows of the recording may be trained on; record more, or give a shorter --horizon."
        )
    return rows


class DreamsObjective:
    """The student's losses on rollouts: each of the `horizon` frames is one update. `real(now)` gives recorded batches for the
    critic."""

    def __init__(self, student: Student, horizon: int, real: Callable[[TrainStep], Batch]):
        self.student, self.horizon, self.real = student, horizon, real
        self.modules, self.learners = student.modules, student.learners

    def losses(self, batch: DreamRollouts, now: TrainStep) -> Iterator[Loss]:
        for frame in range(self.horizon):
            target, updates = batch.next_batch().to(now.device), now.step * self.horizon + frame
            drawn = yield from self.student.update(target, lambda: self.real(now).to(now.device), updates, now)
            batch.go_on(drawn)
