"""Distributions over actions, from the outputs of a policy network: categorical, Bernoulli, or Gaussian squashed by tanh.

A sample is float [N, D]: the number of each choice, each button, or a number before tanh (SAC, Haarnoja et al. 2018).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core import chance

UNIFORM_SHARE = 0.01  # mixed into discrete distributions (DreamerV3, Hafner et al. 2023)
MIN_STD, MAX_STD = 0.05, 1.0  # standard deviation before tanh
_STREAM = 11


@dataclass(frozen=True)
class Categorical:
    """One categorical distribution or several: logits [N, sum(counts)]."""

    counts: tuple[int, ...]
    logits: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        seeds = chance.seeds(len(self.logits), rng, self.logits.device)
        return torch.stack([chance.choice(seeds, p, _STREAM + n) for n, p in enumerate(self._probs())], 1).float()

    def mode(self) -> torch.Tensor:
        return torch.stack([p.argmax(1) for p in self._probs()], 1).float()

    def log_prob(self, samples: torch.Tensor) -> torch.Tensor:
        """[N], of samples [N, D]."""
        picked = [p.gather(1, samples[:, n, None].long())[:, 0].log() for n, p in enumerate(self._probs())]
        return torch.stack(picked).sum(0)

    def entropy(self, samples: torch.Tensor) -> torch.Tensor:
        """[N], in nats."""
        return torch.stack([torch.special.entr(p).sum(1) for p in self._probs()]).sum(0)

    def _probs(self) -> list[torch.Tensor]:
        parts = self.logits.split(list(self.counts), 1)
        return [(1 - UNIFORM_SHARE) * part.softmax(1) + UNIFORM_SHARE / part.shape[1] for part in parts]


@dataclass(frozen=True)
class Bernoulli:
    """Independent buttons: logits [N, D]."""

    logits: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        seeds = chance.seeds(len(self.logits), rng, self.logits.device)
        return (chance.uniform(seeds, self.logits.shape[1:], _STREAM) < self._probs()).float()

    def mode(self) -> torch.Tensor:
        return (self.logits > 0).float()

    def log_prob(self, samples: torch.Tensor) -> torch.Tensor:
        probs = self._probs()
        return torch.where(samples > 0.5, probs, 1 - probs).log().sum(1)

    def entropy(self, samples: torch.Tensor) -> torch.Tensor:
        probs = self._probs()
        return (torch.special.entr(probs) + torch.special.entr(1 - probs)).sum(1)

    def _probs(self) -> torch.Tensor:
        return (1 - UNIFORM_SHARE) * self.logits.sigmoid() + UNIFORM_SHARE / 2


@dataclass(frozen=True)
class SquashedGaussian:
    """Gaussian before tanh: params [N, 2 D], means and unscaled deviations. Samples have gradients."""

    params: torch.Tensor

    def sample(self, rng: torch.Generator) -> torch.Tensor:
        mean, std = self._moments()
        return mean + std * chance.normal(chance.seeds(len(mean), rng, mean.device), mean.shape[1:], _STREAM)

    def mode(self) -> torch.Tensor:
        return self._moments()[0]

    def log_prob(self, samples: torch.Tensor) -> torch.Tensor:
        """Of samples before tanh: the log-determinant of tanh does not depend on the network."""
        mean, std = self._moments()
        z = (samples - mean) / std
        return -(z.square() / 2 + std.log() + math.log(2 * math.pi) / 2).sum(1)

    def entropy(self, samples: torch.Tensor) -> torch.Tensor:
        """Of the action after tanh, estimated from one sample with the noise of `samples`."""
        mean, std = self._moments()
        resampled = mean + std * ((samples - mean) / std).detach()
        squashed = 2 * (math.log(2) - resampled - F.softplus(-2 * resampled))  # log(1 - tanh²)
        return (std.log() + math.log(2 * math.pi * math.e) / 2 + squashed).sum(1)

    def _moments(self) -> tuple[torch.Tensor, torch.Tensor]:
        mean, raw = self.params.chunk(2, 1)
        return 3 * torch.tanh(mean / 3), MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(raw)


ActionDistribution = Categorical | Bernoulli | SquashedGaussian
