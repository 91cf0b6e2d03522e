"""Regression: an ensemble foretells numbers from numbers, each member from rows of its own draw (bagging, Breiman 1996)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import nn

from ..trainer import Loss, Now, adamw, warmed

BATCH = 256
JITTER = 0.01  # of inputs, in deviations


class Regression:
    """`network(inputs)` [members, B, out] is moved towards targets in its own units, which `unit` says."""

    def __init__(self, network: nn.Module, unit: torch.Tensor, scale: torch.Tensor, learning_rate: float):
        self.network, self.unit, self.scale = network, unit, scale
        self.modules = {"network": network}
        self.learners = {"network": adamw((network,), warmed(learning_rate, 20, 0.02), decay=1e-3)}

    def losses(self, batch: tuple[torch.Tensor, torch.Tensor], now: Now) -> Iterator[Loss]:
        inputs, targets = batch
        inputs = inputs + JITTER * self.scale * now.randn(*inputs.shape)
        found = self.network(inputs)
        learns = torch.from_numpy(now.rng.random((len(found), len(inputs), 1)) < 0.75).float()
        away = (learns * (found - targets / self.unit).square()).mean() / 0.75
        yield Loss("network", away, {"away": away.detach()})


def drawn_rows(inputs: torch.Tensor, targets: torch.Tensor, now: Now) -> tuple[torch.Tensor, torch.Tensor]:
    """A batch of rows, drawn evenly."""
    rows = torch.from_numpy(now.rng.integers(len(inputs), size=BATCH))
    return inputs[rows], targets[rows]
