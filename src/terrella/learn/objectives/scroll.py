"""Scroll: the displacement of most of the picture in a step, predicted from earlier ones, frames and actions."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ...space.matching import clear_index, edge_shares
from ...worlds.generator import context_thumbnail
from ...worlds.scroll import Scroll, least_off
from ..feeds import RandomBatches
from ..learners import adamw, warmup_cosine
from ..recording import Recording
from ..sized_feed import SizedFeed
from ..train_step import TrainStep
from ..trainer import Loss, Run, Trainer

STEPS, BATCH, LENGTH = 600, 24, 8  # training steps, clips of each, and steps of a clip, which are predicted in turn
ROLLED_OUT = (
    0.5  # the part of the clips that continue from predictions: there pictures move by whole pixels, as in play
)
STILL_WEIGHT = 0.3  # sampling weight of a clip that does not scroll, relative to one that always does
TOLERANCE = (
    0.03  # how much less a displacement may explain to be less likely by a factor e: pictures scroll by parts of pixels
)
_ROWS = 512  # that are read at a time


class ScrollClips(NamedTuple):
    """Clips of LENGTH steps: frames uint8 [B, LENGTH, 3, H, W], the newest before each step; context [B, LENGTH, n];
    explained [B, slots - 1 + LENGTH, moves], how well each move explains a picture (matching.explains), the oldest first."""

    frames: torch.Tensor
    context: torch.Tensor
    explained: torch.Tensor


def learn_scroll(run: Run, scroll: Scroll, recording: Recording, moves: torch.Tensor, slots: int) -> None:
    """Trains `scroll` in place, if pictures of the recording scroll at all."""
    objective = ScrollObjective(scroll, recording, moves, slots)
    if objective.scrolls.any():
        feed = SizedFeed(lambda size: RandomBatches(lambda now: objective.sample(now, size)), BATCH)
        Trainer(run, "scroll", feed, objective, STEPS).train()


class ScrollObjective:
    """The likelihood of the displacements that explain the next picture about as well as the best."""

    def __init__(self, scroll: Scroll, recording: Recording, moves: torch.Tensor, slots: int):
        self.scroll, self.recording, self.moves, self.slots = scroll, recording, moves, slots
        rows = np.arange(1, recording.cache.length)
        parts = [rows[first : first + _ROWS] for first in range(0, len(rows), _ROWS)]
        explained = [edge_shares(recording.rgb(part - 1), recording.rgb(part), moves) for part in parts]
        self.explained = torch.cat([torch.zeros(1, len(moves)), *explained])
        self.rows = recording.rows_within(slots, LENGTH - 1)  # at which a clip may begin
        scrolls = clear_index(self.explained).numpy() > 0
        self.scrolls = np.lib.stride_tricks.sliding_window_view(scrolls, LENGTH).mean(1)[self.rows]
        self.modules = {"scroll": scroll}
        self.learners = {"scroll": adamw((scroll,), warmup_cosine(2e-3, 20), decay=0.05)}

    def sample(self, now: TrainStep, size: int = BATCH) -> ScrollClips:
        weight = STILL_WEIGHT + (1 - STILL_WEIGHT) * self.scrolls
        return self.clips_at(now.rng.choice(self.rows, size, p=weight / weight.sum()))

    def clips_at(self, rows: np.ndarray) -> ScrollClips:
        """The clips whose first steps are `rows`."""
        recording, slots = self.recording, self.slots
        shown = rows[:, None] + np.arange(-1, LENGTH - 1)
        frames = recording.rgb(shown.ravel())
        steps = rows[:, None] + np.arange(LENGTH)
        acts = recording.actions_before(steps.ravel(), np.arange(1, slots + 1)).flatten(1).unflatten(0, steps.shape)
        thumbnail = context_thumbnail(frames).unflatten(0, steps.shape)
        explained = self.explained[rows[:, None] + np.arange(1 - slots, LENGTH)]
        return ScrollClips(frames.unflatten(0, steps.shape), torch.cat([thumbnail, acts], 2), explained)

    def losses(self, batch: ScrollClips, now: TrainStep) -> Iterator[Loss]:
        frames, context, explained = (part.to(now.device) for part in batch)
        seen = self.scroll.frame_features(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        ages, losses, right = self.slots - 1, [], []
        rolled_out = torch.from_numpy(now.rng.random(len(explained)) < ROLLED_OUT).to(now.device)[:, None]
        first = torch.where(rolled_out[..., None], one_hot_clearest(explained[:, :ages]), explained[:, :ages])
        went = list(first.unbind(1))[::-1]  # the newest first
        for step in range(LENGTH):
            logits = self.scroll(seen[:, step], context[:, step], torch.stack(went[:ages], 1))
            target = explained[:, ages + step]
            near = (target - target.amax(1, keepdim=True)) / TOLERANCE
            valid = (target.amax(1) > 0.2).float()
            losses.append(-((logits.log_softmax(1) + near).logsumexp(1) * valid).sum() / valid.sum().clamp_min(1))
            guess = least_off(logits.detach(), self.moves.to(now.device))
            right.append((target.gather(1, guess[:, None]) > target.amax(1, keepdim=True) - TOLERANCE).float().mean())
            went.insert(0, torch.where(rolled_out, F.one_hot(guess, target.shape[1]).float(), target))
        loss = torch.stack(losses).mean()
        yield Loss("scroll", loss, {"scroll": loss, "right": torch.stack(right).mean()})


def one_hot_clearest(explained: torch.Tensor) -> torch.Tensor:
    """What moves explain [B, n, moves], as if the clearest explained all."""
    return F.one_hot(clear_index(explained.flatten(0, 1)), explained.shape[2]).float().unflatten(0, explained.shape[:2])
