"""SkillPredictor: whether an instruction can be followed from here, whether it is done, and how many steps it takes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from ..actor_network import mlp

MOST_LOG_STEPS = 8.0


@dataclass(frozen=True)
class SkillOutlook:
    """What N observations promise for N instructions."""

    begins: torch.Tensor  # [N], log odds: recordings are in such a state at this instruction, rather than at any
    done: torch.Tensor  # [N], log odds
    log_steps: torch.Tensor  # [N], log(1 + steps until it is done)

    @property
    def suits(self) -> torch.Tensor:
        """[N] from 0 to 1: how common such a state is at this instruction beside its share of all; 1 for as common or more."""
        return self.begins.exp().clamp_max(1.0)


class SkillPredictor(nn.Module):
    """A small network on what an imitating policy sees and remembers, and on the features of the instruction."""

    def __init__(self, width: int, words: int, hidden: int = 128):
        super().__init__()
        self.layers = mlp(width + words, hidden, 2, 3, gain=0.1)

    def forward(self, features: torch.Tensor, words: torch.Tensor) -> SkillOutlook:
        """From features [N, width] of observations, with what is remembered, and [N, words] of instructions."""
        begins, done, log_steps = self.layers(torch.cat([features, words], 1)).unbind(1)
        return SkillOutlook(begins, done, log_steps.clamp(0, MOST_LOG_STEPS))
