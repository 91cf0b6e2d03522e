"""Scroll: by which displacement most of the picture goes on, from how it went on before, what is seen and what is done."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ...space.matching import clearest, explains
from ...worlds.codec import Scroll, least_off
from ...worlds.generator import context_thumbnail
from ..feeds import Drawn
from ..recording import Recording
from ..trainer import Loss, Now, Run, Trainer, adamw, warmed

STEPS, BATCH, LENGTH = 600, 24, 8  # pieces a step, and steps of each, which are guessed one after another
DREAMT = 0.5  # the share of pieces that go on from what was guessed: there pictures go by whole pixels, as in dreams
RARELY = 0.3  # as likely is a piece drawn in which the picture does not scroll, as one in which it always does
ALIKE = 0.03  # how much less a displacement may explain to be less right by e: pictures scroll by parts of pixels
_ROWS = 512  # that are read at a time


class Piece(NamedTuple):
    """LENGTH steps on end: frames uint8 [B, LENGTH, 3, H, W], the newest before each; context [B, LENGTH, n];
    found [B, slots - 1 + LENGTH, moves], how well each of the moves explains a picture (matching.explains), the oldest first."""

    frames: torch.Tensor
    context: torch.Tensor
    found: torch.Tensor


def learn_scroll(run: Run, scroll: Scroll, recording: Recording, moves: torch.Tensor, slots: int) -> None:
    """Fits `scroll` in place, where pictures of the recording scroll at all."""
    objective = Scrolling(scroll, recording, moves, slots)
    if objective.scrolls.any():
        Trainer(run, "scroll", Drawn(objective.drawn), objective, STEPS).train()


class Scrolling:
    """The likelihood of any displacement that explains the next picture about as well as the best does."""

    def __init__(self, scroll: Scroll, recording: Recording, moves: torch.Tensor, slots: int):
        self.scroll, self.recording, self.moves, self.slots = scroll, recording, moves, slots
        rows = np.arange(1, recording.cache.length)
        parts = [rows[first : first + _ROWS] for first in range(0, len(rows), _ROWS)]
        found = [explains(recording.rgb(part - 1), recording.rgb(part), moves) for part in parts]
        self.found = torch.cat([torch.zeros(1, len(moves)), *found])
        self.rows = recording.within(slots, LENGTH - 1)  # those that begin a piece
        scrolls = clearest(self.found).numpy() > 0
        self.scrolls = np.lib.stride_tricks.sliding_window_view(scrolls, LENGTH).mean(1)[self.rows]
        self.modules = {"scroll": scroll}
        self.learners = {"scroll": adamw((scroll,), warmed(2e-3, 20), decay=0.05)}

    def drawn(self, now: Now) -> Piece:
        weight = RARELY + (1 - RARELY) * self.scrolls
        return self.piece(now.rng.choice(self.rows, BATCH, p=weight / weight.sum()))

    def piece(self, rows: np.ndarray) -> Piece:
        """The pieces that begin with the pictures `rows`."""
        recording, slots = self.recording, self.slots
        shown = rows[:, None] + np.arange(-1, LENGTH - 1)
        frames = recording.rgb(shown.ravel())
        steps = rows[:, None] + np.arange(LENGTH)
        acts = recording.actions_before(steps.ravel(), np.arange(1, slots + 1)).flatten(1).unflatten(0, steps.shape)
        thumbnail = context_thumbnail(frames).unflatten(0, steps.shape)
        found = self.found[rows[:, None] + np.arange(1 - slots, LENGTH)]
        return Piece(frames.unflatten(0, steps.shape), torch.cat([thumbnail, acts], 2), found)

    def losses(self, batch: Piece, now: Now) -> Iterator[Loss]:
        frames, context, found = (part.to(now.device) for part in batch)
        seen = self.scroll.glanced(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        ages, losses, right = self.slots - 1, [], []
        dreamt = torch.from_numpy(now.rng.random(len(found)) < DREAMT).to(now.device)[:, None]
        first = torch.where(dreamt[..., None], one_of(found[:, :ages]), found[:, :ages])
        went = list(first.unbind(1))[::-1]  # the newest first
        for step in range(LENGTH):
            logits = self.scroll(seen[:, step], context[:, step], torch.stack(went[:ages], 1))
            wanted = found[:, ages + step]
            near = (wanted - wanted.amax(1, keepdim=True)) / ALIKE
            known = (wanted.amax(1) > 0.2).float()
            losses.append(-((logits.log_softmax(1) + near).logsumexp(1) * known).sum() / known.sum().clamp_min(1))
            guess = least_off(logits.detach(), self.moves.to(now.device))
            right.append((wanted.gather(1, guess[:, None]) > wanted.amax(1, keepdim=True) - ALIKE).float().mean())
            went.insert(0, torch.where(dreamt, F.one_hot(guess, wanted.shape[1]).float(), wanted))
        loss = torch.stack(losses).mean()
        yield Loss("scroll", loss, {"scroll": loss, "right": torch.stack(right).mean()})


def one_of(found: torch.Tensor) -> torch.Tensor:
    """What moves explain [B, n, moves], as if the clearest explained all."""
    return F.one_hot(clearest(found.flatten(0, 1)), found.shape[2]).float().unflatten(0, found.shape[:2])
