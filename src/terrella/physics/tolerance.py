"""Tolerances of laws, calibrated on rollouts of the truth by split conformal prediction (Vovk et al. 2005)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .laws import LAWS, Law
from .trajectory import Trajectory

FALSE_ALARMS = 0.005  # aimed at, of true rollouts
MARGIN = 1.1  # times the quantile


@dataclass(frozen=True)
class Tolerance:
    """The violation of a law, in its unit, from which on a rollout counts as breaking it."""

    law: Law
    value: float
    rollouts: int  # of the truth, on which it was calibrated
    false_alarms: float  # the expected share of true rollouts above it, at most
    wrong_here: str = ""  # why the law says nothing in this domain; "" where it does

    @property
    def origin(self) -> str:
        """Where the value comes from, in words."""
        return f"{self.rollouts} rollouts of the truth, at most {self.false_alarms:.1%} of which exceed it"


def calibrate(motion: Trajectory, laws: Sequence[Law] = LAWS) -> list[Tolerance]:
    """The tolerances of the laws that apply, from rollouts of the truth of the length that will be judged. Below 99 rollouts the
    expected false alarms are above 1%."""
    tolerances = []
    for law in laws:
        if law.missing(motion.system):
            continue
        worst = law.residual(motion).amax(0).sort().values
        count = len(worst)
        rank = min(math.ceil((count + 1) * (1 - FALSE_ALARMS)), count)
        value = max(MARGIN * float(worst[rank - 1]), law.floor(motion))
        most, why = law.ceiling(motion), ""
        if value > most:
            why = f"the truth itself breaks it by {value:.3g} {law.unit}, so it says nothing in this domain"
        tolerances.append(Tolerance(law, value, count, max(FALSE_ALARMS, 1 / (count + 1)), why))
    return tolerances


def false_alarm_rate(tolerance: Tolerance, motion: Trajectory) -> float:
    """The share of other true rollouts that the law accuses."""
    return float((tolerance.law.residual(motion).amax(0) > tolerance.value).double().mean())


def detection(tolerance: Tolerance, motion: Trajectory, seed: int = 0, factor: float = 2.0) -> tuple[int, int]:
    """(detected, injected): violations of `factor` times the tolerance, one in each true rollout that has an occasion."""
    seeds = torch.arange(motion.batch, dtype=torch.int64) + (seed << 20)
    broken, some = tolerance.law.violate(motion, factor * tolerance.value, seeds)
    above = tolerance.law.residual(broken).amax(0) > tolerance.value
    return int((above & some).sum()), int(some.sum())
