"""Outcome: what a step brings beside its picture (reward, the episode's end, the player's vitals), read off two frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import ObservationError


@dataclass(frozen=True)
class OutcomeConfig:
    """actions: numbers in an action as it is told to networks; rewards: the values between which a reward is told,
    ascending; vitals: names of the numbers that belong to the player ("health", "lives"); changes: for each of them the
    changes that a step may bring, ascending; spans: the usual size of each; side: larger frames are shrunk to it."""

    actions: int
    rewards: tuple[float, ...]
    vitals: tuple[str, ...] = ()
    changes: tuple[tuple[float, ...], ...] = ()
    spans: tuple[float, ...] = ()
    hidden: int = 64
    side: int = 64


class Happened(NamedTuple):
    """reward float32 [B], expected; done [B], a logit; vitals [B, V] after the step; hidden [B, hidden]."""

    reward: torch.Tensor
    done: torch.Tensor
    vitals: torch.Tensor
    hidden: torch.Tensor


class Logits(NamedTuple):
    """reward [B, len(rewards)]; for each vital [B, len(changes)]; hidden [B, hidden]; seen and remembered [B, inner]."""

    reward: torch.Tensor
    changes: list[torch.Tensor]
    hidden: torch.Tensor
    known: torch.Tensor


class Outcome(nn.Module):
    """A small convolutional network over the frame before and the frame after a step, and a GRU cell that remembers.

    Rewards and changes are classified among the values that the recording knows (two-hot between them, as in Dreamer 3):
    a reward is the expectation, a vital changes by the likeliest, so that a count of lives stays whole. Whether it is over
    is told from all that and from the vitals after the step: most games end when one of them is used up.
    """

    rewards: torch.Tensor

    def __init__(self, config: OutcomeConfig):
        super().__init__()
        self.config = config
        widths = (24, 32, 48, 64)
        self.look = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in zip(widths, widths[1:]))
        self.sum_up = nn.Linear(widths[-1] * 16, 128)
        self.remember = nn.GRUCell(128 + config.actions + len(config.vitals), config.hidden)
        inner = 128 + config.hidden
        self.paid = nn.Linear(inner, len(config.rewards))
        self.ending = nn.Linear(inner + 2 * len(config.vitals), 1)
        nn.init.constant_(self.ending.bias, -3.0)  # few steps are the last
        self.changed = nn.ModuleList(nn.Linear(inner, len(levels)) for levels in config.changes)
        self.register_buffer("rewards", torch.tensor(config.rewards), persistent=False)

    def begin(self, batch: int) -> torch.Tensor:
        """The hidden state in which a story begins: [batch, hidden]."""
        return torch.zeros(batch, self.config.hidden)

    def logits(
        self,
        before: torch.Tensor,
        after: torch.Tensor,
        action: torch.Tensor,
        vitals: torch.Tensor,
        hidden: torch.Tensor,
    ) -> Logits:
        """before and after uint8 [B, 3, H, W]; action [B, actions]; vitals [B, V] before the step; hidden [B, hidden]."""
        return self.judge(self.seen(before, after), action, vitals, hidden)

    def seen(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """What the two frames say, without memory: [B, 128]."""
        small = [_shrunk(frame, self.config.side) for frame in (before, after)]
        x = F.pixel_unshuffle(torch.cat([small[1], small[1] - small[0]], 1), 2)
        for layer in self.look:
            x = F.silu(layer(x))
        return F.silu(self.sum_up(F.adaptive_avg_pool2d(x, 4).flatten(1)))

    def judge(self, seen: torch.Tensor, action: torch.Tensor, vitals: torch.Tensor, hidden: torch.Tensor) -> Logits:
        """The same from `seen` [B, 128]."""
        spans = torch.tensor(self.config.spans, device=seen.device)
        hidden = self.remember(torch.cat([seen, action, vitals / spans], 1), hidden)
        known = torch.cat([seen, hidden], 1)
        return Logits(self.paid(known), [head(known) for head in self.changed], hidden, known)

    def ends(self, known: torch.Tensor, vitals: torch.Tensor) -> torch.Tensor:
        """The logit [B] that it is over, of Logits.known and the vitals [B, V] after the step."""
        spans = torch.tensor(self.config.spans, device=known.device)
        used_up = 4.0 * (vitals <= 0)  # loud, so that it is learned from few ends
        return self.ending(torch.cat([known, vitals / spans, used_up], 1))[:, 0]

    @torch.inference_mode()
    def forward(
        self,
        before: torch.Tensor,
        after: torch.Tensor,
        action: torch.Tensor,
        vitals: torch.Tensor,
        hidden: torch.Tensor,
        rng: torch.Generator | None = None,
    ) -> Happened:
        """The outcome of a step; arguments as for `logits`, on any device: the network's own is used, the CPU given back.
        With `rng` (of the CPU) each vital changes by chance, as likely as told; without, by the likeliest."""
        there = self.rewards.device
        told = self.logits(*(part.to(there) for part in (before, after, action, vitals, hidden)))
        reward = (told.reward.float().softmax(1) * self.rewards).sum(1)
        levels = (torch.tensor(values, device=there) for values in self.config.changes)
        moved = [values[_picked(logits, rng)] for logits, values in zip(told.changes, levels)]
        left = vitals.float() + torch.stack(moved, 1).cpu() if moved else vitals
        done = self.ends(told.known, left.to(there))
        return Happened(reward.cpu(), done.float().cpu(), left, told.hidden.float().cpu())


def _picked(logits: torch.Tensor, rng: torch.Generator | None) -> torch.Tensor:
    """One of the choices [B, L] for each: [B]."""
    if rng is None:
        return logits.argmax(1)
    chances = logits.float().softmax(1).cpu()
    return torch.multinomial(chances, 1, generator=rng)[:, 0].to(logits.device)


def _shrunk(frame: torch.Tensor, side: int) -> torch.Tensor:
    """uint8 [B, 3, H, W] -> [-1, 1] with even sides, the longer at most `side`."""
    height, width = frame.shape[-2:]
    share = min(1.0, side / max(height, width))
    size = [max(8, 2 * round(length * share / 2)) for length in (height, width)]
    picture = frame.float() / 127.5 - 1
    return picture if size == [height, width] else F.interpolate(picture, size, mode="area")


def told_vitals(outcome: Outcome, observation: Mapping[str, torch.Tensor], before: torch.Tensor) -> torch.Tensor:
    """The vitals [B, V] that evidence tells, and those of `before` [B, V] where it is silent; ObservationError for what is
    not one finite number a story."""
    vitals = before.clone()
    for column, name in enumerate(outcome.config.vitals):
        if name in observation:
            told = torch.as_tensor(observation[name]).float()
            if told.shape != (len(before),) or not torch.isfinite(told).all():
                raise ObservationError(f"{name} is finite float [B]; got {tuple(told.shape)}.")
            vitals[:, column] = told
    return vitals
