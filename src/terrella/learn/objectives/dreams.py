"""Dreams: a finished world goes on learning inside its own dreams, so that long play does not drift.

Self-Forcing (Huang et al. 2025): a world that learned from recorded frames meets its own mistakes only in play. Here it is
shown the start of a recorded stretch and rolls out with its own state - its own frames, its own keyframes - and every
frame it draws is held against the recorded one; the gradient ends at the frame before. What was not determined makes
dream and recording part: there the recorded frame alone would teach a mean of all that could be, so a critic, and a
teacher's distribution where there is one, say what a frame should look like.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import numpy as np
import torch

from ...core.errors import DatasetError
from ...worlds.generator import Generator, encode_depth
from ...worlds.learned import LearnedWorld
from ..batches import Batch, as_drawn, coded
from ..history_batches import changing
from ..losses import Critic, critic_learner, critic_loss, sharpened, total, truth_losses
from ..recording import Recording
from ..trainer import Average, Learner, Loss, Now
from .distillation import Matching, drawn, trusted

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
        self.asked = world.asked(self.state, numbers, pose)
        self.shown = world.conditioning(self.asked, self.state)
        if self.config.geometry:
            depth = recording.depth(self.row)
        else:
            depth = self.shown.glimpse.depth.cpu()
            newest = world.scene.frame(self.state).cpu()
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
        self.state = self.world.drawn(self.asked, self.state, self.shown, clean.detach())


def beginnings(recording: Recording, horizon: int) -> np.ndarray:
    """Rows from which `horizon` more can be dreamt, CONTEXT rows being known before them, within one episode and all usable."""
    usable, start = recording.usable, recording.start
    rows = np.arange(CONTEXT - 1, len(usable) - horizon)
    runs = np.cumsum(np.concatenate([[0], usable]))
    whole = runs[rows + horizon + 1] - runs[rows - CONTEXT + 1] == CONTEXT + horizon
    rows = rows[whole & (start[rows - CONTEXT + 1] == start[rows + horizon])]
    if not len(rows):
        raise DatasetError(
            f"no stretch of {CONTEXT + horizon} rows of the recording may be trained on; record more, or dream a shorter --horizon."
        )
    return rows


class Dreams:
    """`real(now)` gives recorded batches for the critic; the weights say how hard the recorded frames, the distribution of a
    `teacher`, where there is one, and the critic pull. Each of the `horizon` frames of a dream is one update."""

    def __init__(
        self,
        generator: Generator,
        flow_steps: int,
        horizon: int,
        learning_rate: float,
        real: Callable[[Now], Batch],
        teacher: Generator | None = None,
        truth: float = 0.05,
        matching: float = 1.0,
        critic: float = 1.0,
    ):
        self.flow_steps, self.horizon, self.real, self.weights = flow_steps, horizon, real, (truth, matching, critic)
        self.generator = copy.deepcopy(generator).train().requires_grad_(True)
        self.smooth, self.critic = Average(self.generator, 0.995), Critic()
        self.matching = None if teacher is None else Matching(teacher)
        self.modules = {"generator": self.generator, "smooth": self.smooth, "critic": self.critic}
        optimiser = torch.optim.AdamW(self.generator.parameters(), learning_rate, (0.9, 0.99), weight_decay=1e-4)

        def rate(now: Now) -> float:
            return learning_rate * min(1, (now.step + 1) / 10, (1 - now.share) / 0.3)

        self.learners = {
            "generator": Learner(optimiser, (self.generator,), rate, self.smooth),
            "critic": critic_learner(self.critic),
        }
        if self.matching is not None:
            self.modules["mimic"] = self.matching.mimic
            self.learners["mimic"] = self.matching.learner

    def losses(self, batch: Rollouts, now: Now) -> Iterator[Loss]:
        truth, matching, critic = self.weights
        for frame in range(self.horizon):
            asked = batch.next_batch().to(now.device)
            noise = now.randn(len(asked.truth), 4, *asked.truth.shape[2:])
            fresh = drawn(self.generator, noise, asked.shown, self.flow_steps, now.rng)
            clean = asked.judged(fresh)
            parts = truth_losses(clean, asked)
            loss = truth * total(parts)
            if self.matching is not None:
                parts["teacher"] = self.matching.towards_teacher(clean, asked.shown, now.noise)
                loss = loss + matching * parts["teacher"]
            if critic:
                heeded = critic * trusted(now.step * self.horizon + frame)
                loss = loss + sharpened(self.critic, clean, loss, asked.shown.glimpse, heeded)
            yield Loss("generator", loss, parts)
            real = self.real(now).to(now.device)
            judged = critic_loss(self.critic, clean, asked.shown.glimpse, real.truth, real.shown.glimpse)
            yield Loss("critic", judged, {"critic": judged})
            if self.matching is not None:
                yield self.matching.loss(clean, asked.shown, now.noise)
            batch.go_on(fresh)
