"""Ranges that grow by themselves: what is randomised widens while the policy earns nearly what it has earned at best.

After automatic domain randomisation (OpenAI et al. 2019), with one scale for all parameters in place of two limits for each.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import nn

STEP = 0.02  # by which ranges grow after a batch
STEADY = 0.9  # how much of the mean reward is kept in a batch
HOLDS = 0.8  # of what was gained at best, with which a policy copes
FIRST = 10  # batches that say what a policy earns that has learned nothing


class Scaled(Protocol):
    """A world whose episodes draw from ranges: none at a scale of 0, the whole ones at 1 (sim/randomised.py)."""

    scale: float


class Growth(nn.Module):
    """The scale of a world's ranges, from 0 up; kept as buffers, so that a run that was stopped goes on with it."""

    scale: torch.Tensor
    recent: torch.Tensor
    first: torch.Tensor
    best: torch.Tensor
    seen: torch.Tensor

    def __init__(self, world: Scaled):
        super().__init__()
        self._world = [world]  # a list, for a world may itself be a module
        for name in ("scale", "recent", "first", "best", "seen"):
            self.register_buffer(name, torch.zeros((), dtype=torch.float64))

    def set(self) -> None:
        """Lets the episodes that begin from now on draw at this scale."""
        self._world[0].scale = float(self.scale)

    def follow(self, reward: torch.Tensor) -> None:
        """Grows, or waits, after a batch of these rewards."""
        self.seen += 1
        keep = min(STEADY, 1 - 1 / float(self.seen))  # a mean at first
        self.recent.lerp_(reward.double().mean(), 1 - keep)
        if self.seen <= FIRST:
            self.first.copy_(self.recent)
            self.best.copy_(self.recent)
            return
        self.best.copy_(torch.maximum(self.best, self.recent))
        gained = self.best - self.first
        if gained > 0 and self.recent - self.first >= HOLDS * gained:
            self.scale.add_(STEP).clamp_(max=1.0)
