"""Adaptation: an encoder regresses numbers from labelled pictures, with features that do not tell them from unlabelled ones.

Domain-adversarial training by gradient reversal (Ganin et al. 2016); keypoints by a spatial softmax (Levine et al. 2016).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss

WIDTHS, HIDDEN = (16, 24, 32), 128
BATCH = 64


class KeypointEncoder(nn.Module):
    """Pictures uint8 [B, H, W, 3] to numbers [B, n]; `settle` sets the mean and standard deviation of the numbers."""

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, numbers: int):
        super().__init__()
        widths = (3, *WIDTHS)
        strides = (2, 2, 1)
        layers = [
            part
            for a, b, stride in zip(widths, widths[1:], strides)
            for part in (nn.Conv2d(a, b, 5, stride, 2), nn.GroupNorm(4, b), nn.SiLU())
        ]
        self.look = nn.Sequential(*layers)
        self.tell = nn.Sequential(nn.Linear(2 * WIDTHS[-1], HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, numbers))
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("scale", torch.ones(numbers))

    def settle(self, numbers: torch.Tensor) -> None:
        self.mean.copy_(numbers.mean(0))
        self.scale.copy_(numbers.std(0).clamp_min(1e-6))

    def features(self, pictures: torch.Tensor) -> torch.Tensor:
        """Keypoints [B, 2 * channels]: the expected position of each channel, -1 to 1."""
        maps = self.look(pictures.permute(0, 3, 1, 2).float() / 127.5 - 1)
        height, width = maps.shape[2:]
        share = maps.flatten(2).softmax(2).unflatten(2, (height, width))
        down, right = (torch.linspace(-1, 1, side, device=maps.device) for side in (height, width))
        return torch.cat([(share.sum(3) * down).sum(2), (share.sum(2) * right).sum(2)], 1)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return self.tell(self.features(pictures)) * self.scale + self.mean


@dataclass(frozen=True)
class LabelledPictures:
    """labelled: uint8 [N, H, W, 3] with numbers [N, n]; unlabelled: uint8 [M, H, W, 3], or none."""

    labelled: torch.Tensor
    numbers: torch.Tensor
    unlabelled: torch.Tensor | None = None

    def batch(self, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        rows = torch.from_numpy(now.rng.integers(len(self.labelled), size=BATCH))
        if self.unlabelled is None:
            return self.labelled[rows], self.numbers[rows], None
        others = torch.from_numpy(now.rng.integers(len(self.unlabelled), size=BATCH))
        return self.labelled[rows], self.numbers[rows], self.unlabelled[others]


class Adaptation:
    """Squared error of the numbers; with unlabelled pictures also a domain classifier on the encoder's features, whose gradient is
    reversed for the encoder, with a factor that grows to `weight`."""

    def __init__(self, encoder: KeypointEncoder, learning_rate: float = 2e-3, weight: float = 0.03):
        self.encoder, self.weight = encoder, weight
        self.judge = nn.Sequential(nn.Linear(2 * WIDTHS[-1], HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 1))
        self.modules = {"encoder": encoder, "judge": self.judge}
        self.learners = {"all": adamw((encoder, self.judge), warmup_cosine(learning_rate, 50, 0.02))}

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor, torch.Tensor | None], now: TrainStep) -> Iterator[Loss]:
        pictures, numbers, others = batch
        encoder = self.encoder
        features = encoder.features(pictures)
        loss = (encoder.tell(features) - (numbers - encoder.mean) / encoder.scale).square().mean()
        parts = {"mse": loss.detach()}
        if others is not None:
            grown = 2 / (1 + math.exp(-10 * now.share)) - 1
            both = torch.cat([features, encoder.features(others)])
            guess = self.judge(_reversed(both, self.weight * grown))[:, 0]
            truth = (torch.arange(len(guess), device=guess.device) < len(features)).float()
            loss = loss + F.binary_cross_entropy_with_logits(guess, truth)
            parts["domain accuracy"] = ((guess > 0) == (truth > 0.5)).float().mean()
        yield Loss("all", loss, parts)


class _Reverse(torch.autograd.Function):
    """Identity forwards; backwards the gradient times -weight."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: float) -> torch.Tensor:
        ctx.weight = weight
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return -ctx.weight * gradient, None


def _reversed(x: torch.Tensor, weight: float) -> torch.Tensor:
    out = _Reverse.apply(x, weight)
    assert isinstance(out, torch.Tensor)
    return out
