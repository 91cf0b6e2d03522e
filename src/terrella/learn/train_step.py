"""A training step: its number, device and randomness."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch

from ..core.precision import half_is_native, half_precision
from ..core.world import make_rng


@dataclass(frozen=True)
class TrainStep:
    """One training step. share: the part of the training that lies before it, by steps or by time, whichever is more;
    rng, noise: its randomness, seeded by (seed, step); precise: networks compute in float32."""

    step: int
    share: float
    device: torch.device
    rng: np.random.Generator
    noise: torch.Generator = field(repr=False)
    precise: bool = False
    halved: list[bool] = field(
        default_factory=list, repr=False
    )  # not empty once a network has computed in half precision

    def randn(self, *shape: int) -> torch.Tensor:
        """Standard normal noise on the device; a GPU draws it itself, so that nothing is copied to it."""
        return torch.randn(*shape, generator=self.noise, device=self._drawn_on).to(self.device)

    def rand(self, *shape: int) -> torch.Tensor:
        """Uniform noise in 0..1, likewise."""
        return torch.rand(*shape, generator=self.noise, device=self._drawn_on).to(self.device)

    @cached_property
    def seeding(self) -> torch.Generator:
        """The generator for worlds and policies, which draw seeds: on the CPU, where those of a batch are drawn at once."""
        return self.noise if self.noise.device.type == "cpu" else make_rng(self.noise.initial_seed())

    @property
    def _drawn_on(self) -> torch.device:
        return self.device if self.device.type == "meta" else self.noise.device

    def half(self) -> torch.autocast | nullcontext:
        """A context in which networks compute in half precision, where that is native."""
        if self.precise or not half_is_native(self.device):
            return nullcontext()
        if not self.halved:
            self.halved.append(True)
        return half_precision(self.device)
