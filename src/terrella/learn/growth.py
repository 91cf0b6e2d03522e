"""A curriculum of randomisation ranges: they widen as long as the policy earns nearly its best reward so far.

After automatic domain randomisation (OpenAI et al. 2019), with one scale for all parameters in place of two limits for each.
"""

from typing import Protocol

import torch
from torch import nn

STEP = 0.02  # by which the scale grows after a batch
DECAY = 0.9  # of the moving average of rewards
SUCCESS = 0.8  # the part of the best gain in reward at which ranges grow
FIRST = 10  # batches by which the reward of the untrained policy is estimated


class Scaled(Protocol):
    """A world that draws parameters of episodes from ranges: empty at scale 0, whole at 1 (sim/randomised.py)."""

    scale: float


class Growth(nn.Module):
    """The scale of a world's ranges, from 0 up to 1; kept as buffers, so that a resumed run continues with it."""

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
        """Episodes that begin from now on draw at this scale."""
        self._world[0].scale = float(self.scale)

    def update(self, reward: torch.Tensor) -> None:
        """Grows the scale, or keeps it, after a batch of these rewards."""
        self.seen += 1
        keep = min(DECAY, 1 - 1 / float(self.seen))  # a plain mean at first
        self.recent.lerp_(reward.double().mean(), 1 - keep)
        if self.seen <= FIRST:
            self.first.copy_(self.recent)
            self.best.copy_(self.recent)
            return
        self.best.copy_(torch.maximum(self.best, self.recent))
        gained = self.best - self.first
        if gained > 0 and self.recent - self.first >= SUCCESS * gained:
            self.scale.add_(STEP).clamp_(max=1.0)
