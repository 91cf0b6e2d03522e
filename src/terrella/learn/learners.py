"""Learners: optimisers, their learning rates, and averages of weights."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import nn

from .train_step import TrainStep

Module = TypeVar("Module", bound=nn.Module)


class Ema(nn.Module, Generic[Module]):
    """An exponential moving average of a module's weights, which play uses; its decay ramps up to `limit`."""

    updates: torch.Tensor
    module: Module

    def __init__(self, raw: Module, limit: float):
        super().__init__()
        self.limit, self.module = limit, copy.deepcopy(raw).eval().requires_grad_(False)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def update(self, raw: nn.Module) -> None:
        """Without a wait for the device."""
        keep = ((self.updates + 1) / (self.updates + 20)).clamp_max(self.limit)
        mine: list[torch.Tensor] = list(self.module.parameters())
        theirs: list[torch.Tensor] = list(raw.parameters())
        away = torch._foreach_sub(theirs, mine)
        torch._foreach_mul_(away, 1 - keep)
        torch._foreach_add_(mine, away)
        self.updates += 1


@dataclass(frozen=True)
class Learner:
    """An optimiser and the modules whose parameters it updates.

    rate:    the learning rate at a step, times the "pace" of each parameter group that has one; None: constant.
    average: of the first module's weights.
    clip:    the norm to which each module's gradient is clipped.
    """

    optimiser: torch.optim.Optimizer
    modules: Sequence[nn.Module]
    rate: Callable[[TrainStep], float] | None = None
    average: Ema[Any] | None = None
    clip: float = 1.0


def adamw(
    modules: Sequence[nn.Module],
    rate: Callable[[TrainStep], float],
    decay: float = 1e-4,
    betas: tuple[float, float] = (0.9, 0.99),
    average: Ema[Any] | None = None,
) -> Learner:
    """AdamW for all parameters of the modules."""
    weights = [weight for module in modules for weight in module.parameters()]
    return Learner(torch.optim.AdamW(weights, betas=betas, weight_decay=decay), modules, rate, average)


def warmup_cosine(peak: float, steps: int, low: float = 0.0) -> Callable[[TrainStep], float]:
    """Linear warm-up to `peak` over `steps` steps, then cosine decay to `low` times it over the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps) * cosine_decay(now.share, low)


def hold_then_decay(peak: float, steps: int) -> Callable[[TrainStep], float]:
    """Linear warm-up to `peak` over `steps` steps, constant, then linear decay to 0 over the last 30% of the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps, (1 - now.share) / 0.3)


def cosine_decay(share: float, low: float = 0.0) -> float:
    """From 1 down to `low` as `share` goes from 0 to 1."""
    return low + (1 - low) * (0.5 + 0.5 * float(np.cos(np.pi * min(share, 1.0))))
