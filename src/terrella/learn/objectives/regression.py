"""Regression by an ensemble, each member on rows of its own draw (bagging, Breiman 1996)."""

from collections.abc import Iterator

import torch
from torch import nn

from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss

BATCH = 256
BAGGING = 0.75  # the part of the rows from which a member learns
JITTER = 0.01  # noise on inputs, in standard deviations


class Regression:
    """Squared error of `network(inputs)` [members, B, out] to targets / unit."""

    def __init__(self, network: nn.Module, unit: torch.Tensor, scale: torch.Tensor, learning_rate: float):
        self.network, self.unit, self.scale = network, unit, scale
        self.modules = {"network": network}
        self.learners = {"network": adamw((network,), warmup_cosine(learning_rate, 20, 0.02), decay=1e-3)}

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor], now: TrainStep) -> Iterator[Loss]:
        inputs, targets = batch
        inputs = inputs + JITTER * self.scale * now.randn(*inputs.shape)
        predictions = self.network(inputs)
        mask = torch.from_numpy(now.rng.random((len(predictions), len(inputs), 1)) < BAGGING).float()
        mse = (mask * (predictions - targets / self.unit).square()).mean() / BAGGING
        yield Loss("network", mse, {"mse": mse.detach()})


def drawn_rows(inputs: torch.Tensor, targets: torch.Tensor, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor]:
    """A batch of rows, drawn uniformly."""
    rows = torch.from_numpy(now.rng.integers(len(inputs), size=BATCH))
    return inputs[rows], targets[rows]
