"""What a network says of the next action, as a distribution: of choices, of buttons, of axes.

A draw is what the network meant, float [N, D]: the number of each choice, each button, or of axes a number of any size that
tanh brings between the limits (as in SAC, Haarnoja et al. 2018). `actions` are what a world takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core import chance

UNIFORM_SHARE = 0.01  # share of the probability that is spread over all choices (DreamerV3, Hafner et al. 2023)
MIN_STD, MAX_STD = 0.05, 1.0  # deviation of an axis before tanh
_STREAM = 11


@dataclass(frozen=True)
class Categorical:
    """One choice of several, or several such: logits [N, sum(counts)]."""

    counts: tuple[int, ...]
    logits: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        seeds = chance.seeds(len(self.logits), rng, self.logits.device)
        return torch.stack([chance.choice(seeds, p, _STREAM + n) for n, p in enumerate(self._shares())], 1).float()

    def mode(self) -> torch.Tensor:
        return torch.stack([p.argmax(1) for p in self._shares()], 1).float()

    def log_prob(self, drawn: torch.Tensor) -> torch.Tensor:
        """[N], of draws [N, D]."""
        picked = [p.gather(1, drawn[:, n, None].long())[:, 0].log() for n, p in enumerate(self._shares())]
        return torch.stack(picked).sum(0)

    def entropy(self, drawn: torch.Tensor) -> torch.Tensor:
        """[N], in nats."""
        return torch.stack([torch.special.entr(p).sum(1) for p in self._shares()]).sum(0)

    def _shares(self) -> list[torch.Tensor]:
        parts = self.logits.split(list(self.counts), 1)
        return [(1 - UNIFORM_SHARE) * part.softmax(1) + UNIFORM_SHARE / part.shape[1] for part in parts]


@dataclass(frozen=True)
class Bernoulli:
    """Each button for itself: logits [N, D]."""

    logits: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        seeds = chance.seeds(len(self.logits), rng, self.logits.device)
        return (chance.uniform(seeds, self.logits.shape[1:], _STREAM) < self._share()).float()

    def mode(self) -> torch.Tensor:
        return (self.logits > 0).float()

    def log_prob(self, drawn: torch.Tensor) -> torch.Tensor:
        share = self._share()
        return torch.where(drawn > 0.5, share, 1 - share).log().sum(1)

    def entropy(self, drawn: torch.Tensor) -> torch.Tensor:
        share = self._share()
        return (torch.special.entr(share) + torch.special.entr(1 - share)).sum(1)

    def _share(self) -> torch.Tensor:
        return (1 - UNIFORM_SHARE) * self.logits.sigmoid() + UNIFORM_SHARE / 2


@dataclass(frozen=True)
class SquashedGaussian:
    """Normal before tanh: found [N, 2 D], means and what deviations are made of. Draws have gradients."""

    found: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        mean, deviation = self._shape()
        seeds = chance.seeds(len(mean), rng, mean.device)
        return mean + deviation * chance.normal(seeds, mean.shape[1:], _STREAM)

    def mode(self) -> torch.Tensor:
        return self._shape()[0]

    def log_prob(self, drawn: torch.Tensor) -> torch.Tensor:
        """Of what is drawn before tanh: what tanh adds does not depend on the network."""
        mean, deviation = self._shape()
        away = (drawn - mean) / deviation
        return -(away.square() / 2 + deviation.log() + math.log(2 * math.pi) / 2).sum(1)

    def entropy(self, drawn: torch.Tensor) -> torch.Tensor:
        """Of the action between -1 and 1, by one sample, which has the noise of `drawn`."""
        mean, deviation = self._shape()
        again = mean + deviation * ((drawn - mean) / deviation).detach()
        squashed = 2 * (math.log(2) - again - F.softplus(-2 * again))  # log(1 - tanh²)
        return (deviation.log() + math.log(2 * math.pi * math.e) / 2 + squashed).sum(1)

    def _shape(self) -> tuple[torch.Tensor, torch.Tensor]:
        mean, raw = self.found.chunk(2, 1)
        return 3 * torch.tanh(mean / 3), MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(raw)


ActionDistribution = Categorical | Bernoulli | SquashedGaussian
