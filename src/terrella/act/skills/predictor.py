"""SkillPredictor: whether an instruction can be followed from here, whether it is done, and how many steps it takes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from ..actor_network import mlp
from ..imitation_network import ImitationNetwork

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
    """A small network on what an imitating policy sees and remembers, on the features of the instruction, and on how far the
    policy's numbers (the hand) are from the waypoints that it expected when the instruction began."""

    def __init__(self, network: ImitationNetwork, hidden: int = 128):
        super().__init__()
        words = network.words.width if network.words is not None else 0
        self.numbers = len(network.mean)
        ahead = len(network.waypoints) * self.numbers
        self.layers = mlp(network.recalled_width + words + ahead, hidden, 2, 3, gain=0.1)

    def forward(self, features: torch.Tensor, words: torch.Tensor, waypoints: torch.Tensor | None) -> SkillOutlook:
        """From features [N, width] of observations, with what is remembered, [N, words] of instructions, and waypoints
        [N, waypoints, D], for a policy that has some."""
        seen = [features, words]
        if waypoints is not None:
            seen.append((waypoints - features[:, None, : self.numbers]).flatten(1))
        begins, done, log_steps = self.layers(torch.cat(seen, 1)).unbind(1)
        return SkillOutlook(begins, done, log_steps.clamp(0, MOST_LOG_STEPS))
