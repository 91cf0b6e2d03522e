"""Certificates: what each rollout keeps and breaks, where, and for how many steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .tolerance import Tolerance
from .trajectory import Trajectory


@dataclass(frozen=True)
class Certificates:
    """Of B rollouts of T steps, by L laws."""

    laws: tuple[str, ...]
    worst: Tensor  # [B, L], the largest violation, in tolerances: above 1 breaks the law
    step: Tensor  # int64 [B, L], the step of the largest violation, counted from 1
    first: Tensor  # int64 [B, L], the first step that breaks the law; T + 1 where none does
    steps: int

    @property
    def broken(self) -> Tensor:
        """bool [B, L]."""
        return self.worst > 1

    @property
    def horizon(self) -> Tensor:
        """The certified horizon of each rollout [B]: the steps before the first that breaks any law."""
        return self.first.amin(1) - 1 if self.laws else torch.full((len(self.first),), self.steps)


def certify(motion: Trajectory, tolerances: Sequence[Tolerance]) -> Certificates:
    """The certificates of rollouts under calibrated laws; laws that are wrong in this domain are left out."""
    held = [one for one in tolerances if not one.wrong_here]
    shares = [one.law.residual(motion) / one.value for one in held]
    ratio = torch.stack(shares, -1) if shares else motion.position.new_zeros(motion.steps, motion.batch, 0)
    ratio = ratio.nan_to_num(nan=torch.inf)
    worst, step = ratio.max(0)
    above = ratio > 1
    first = torch.where(above.any(0), above.double().argmax(0) + 1, motion.steps + 1)
    return Certificates(tuple(one.law.name for one in held), worst, step + 1, first, motion.steps)
