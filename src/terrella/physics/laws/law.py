"""Law: what every law has, and how a violation of a known size is injected to measure its power."""

from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from ...core import chance
from ..system import PhysicalSystem
from ..trajectory import Trajectory

SINGLE = 1e-5  # of a length or a speed: rounding of float32 channels


class Law(Protocol):
    """A law over the motion of bodies. `residual` is 0 where the law holds and grows with its violation, in `unit`."""

    name: str
    unit: str

    def missing(self, system: PhysicalSystem) -> str:
        """What the law lacks in this system, as "needs ..."; "" where it applies."""
        ...

    def residual(self, motion: Trajectory) -> Tensor:
        """The size of the violation in each step [T, B], 0 or more."""
        ...

    def floor(self, motion: Trajectory) -> float:
        """The smallest tolerance: the rounding of the channels, in `unit`."""
        ...

    def ceiling(self, motion: Trajectory) -> float:
        """The largest tolerance with which the law still says something, in `unit`: a truth beyond it breaks the law."""
        ...

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        """The motion with one violation of `size`, in `unit`, in each rollout, and bool [B]: the rollouts that had an occasion.
        seeds int64 [B]."""
        ...

    def correct(self, motion: Trajectory) -> Trajectory:
        """The motion with its last instant projected onto the states that keep the law."""
        ...


def with_last(motion: Trajectory, **parts: Tensor) -> Trajectory:
    """The motion with other tensors at its last instant: name -> [B, N, ...]."""
    return replace(
        motion, **{name: torch.cat([getattr(motion, name)[:-1], part[None]]) for name, part in parts.items()}
    )


def largest(values: Tensor, mask: Tensor) -> Tensor:
    """The largest of values [T, B, ...] where the mask is set, 0 where it is nowhere: [T, B]."""
    return (
        torch.where(mask, values, 0.0).flatten(2).amax(-1)
        if values[0, 0].numel()
        else values.new_zeros(values.shape[:2])
    )


def occasions(mask: Tensor, seeds: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A random step and body of each rollout among mask [T, B, N]: (steps [B], bodies [B], bool [B]: there is one)."""
    steps, batch, bodies = mask.shape
    flat = mask.transpose(0, 1).reshape(batch, steps * bodies)
    some = flat.any(1)
    weights = torch.where(some[:, None], flat.double(), 1.0)
    pick = chance.choice(seeds, weights, 1)
    return pick // bodies, pick % bodies, some


def random_directions(motion: Trajectory, seeds: Tensor) -> Tensor:
    """Unit vectors [B, 3] within the axes of the system."""
    axes = list(motion.system.axes)
    drawn = torch.zeros(motion.batch, 3, dtype=torch.float64)
    drawn[:, axes] = chance.normal(seeds, (len(axes),), 2).double()
    return drawn / drawn.norm(dim=1, keepdim=True).clamp_min(1e-9)


def shifted(values: Tensor, step: Tensor, body: Tensor, by: Tensor, rows: Tensor) -> Tensor:
    """values [T + 1, B, N, 3] with `by` [B, 3] added to one body of the rollouts `rows` (bool [B]) from instant step + 1 on."""
    instants = torch.arange(len(values))[:, None] > step[None, :]
    mask = (instants & rows)[..., None] & (torch.arange(values.shape[2]) == body[:, None])[None]
    return values + mask[..., None] * by[None, :, None, :]
