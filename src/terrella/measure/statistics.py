"""Figures with 95% confidence intervals: seeded bootstrap over clips, Wilson, Clopper-Pearson."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

RESAMPLES = 2000


@dataclass(frozen=True)
class Figure:
    """A measured value, its 95% interval (NaN for fewer than two clips) and the number of clips."""

    value: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        value, low, high = (f"{x:,.0f}" if abs(x) >= 999.5 else f"{x:.3g}" for x in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}] (n={self.count})"


@dataclass(frozen=True)
class Band:
    """A curve: value, low and high at each step."""

    value: list[float]
    low: list[float]
    high: list[float]
    count: int

    def at(self, place: int) -> Figure:
        return Figure(self.value[place], self.low[place], self.high[place], self.count)

    def in_db(self) -> Band:
        """Ratios of powers as decibels."""

        def decibels(ratios: list[float]) -> list[float]:
            return [10 * math.log10(ratio) if ratio > 0 else math.nan for ratio in ratios]

        return Band(decibels(self.value), decibels(self.low), decibels(self.high), self.count)


def mean_interval(values: torch.Tensor, rng: torch.Generator) -> Figure:
    """Mean of values [n] with the percentile bootstrap interval (Efron 1979)."""
    return mean_band(values[:, None], rng).at(0)


def mean_band(values: torch.Tensor, rng: torch.Generator) -> Band:
    """Mean over clips of values [n, T], with an interval at each step."""
    values = values.double()
    return _band(values.mean(0), lambda weights: weights @ values / weights.sum(1, keepdim=True), len(values), rng)


def wilson(successes: int, count: int) -> Figure:
    """The success rate with the 95% interval of Wilson (1927), valid also for few trials, and for none or all successful."""
    if not count:
        return Figure(math.nan, math.nan, math.nan, 0)
    share, z2 = successes / count, 1.959964**2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = math.sqrt(share * (1 - share) * z2 / count + (z2 / (2 * count)) ** 2) / (1 + z2 / count)
    return Figure(share, max(0.0, middle - half), min(1.0, middle + half), count)


def clopper_pearson(successes: int, count: int) -> Figure:
    """The success rate with the exact 95% interval of Clopper and Pearson (1934)."""
    if not count:
        return Figure(math.nan, math.nan, math.nan, 0)
    log_binomials = [math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in range(count + 1)]

    def at_least(least: int, share: float) -> float:
        """The probability of `least` successes or more."""
        log_p, log_q = math.log(share), math.log1p(-share)
        return sum(math.exp(log_binomials[k] + k * log_p + (count - k) * log_q) for k in range(least, count + 1))

    def solve(least: int, level: float) -> float:
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if at_least(least, middle) < level else (low, middle)
        return (low + high) / 2

    low = solve(successes, 0.025) if successes else 0.0
    return Figure(successes / count, low, solve(successes + 1, 0.975) if successes < count else 1.0, count)


def ratio_interval(top: torch.Tensor, bottom: torch.Tensor, rng: torch.Generator) -> Figure:
    """sum(top) / sum(bottom) over clips [n], both resampled together; robust to clips with a tiny denominator."""
    return ratio_band(top[:, None], bottom[:, None], rng).at(0)


def ratio_band(top: torch.Tensor, bottom: torch.Tensor, rng: torch.Generator) -> Band:
    """sum(top) / sum(bottom) over clips [n, T], with an interval at each step."""
    top, bottom = top.double(), bottom.double()
    return _band(top.sum(0) / bottom.sum(0), lambda weights: (weights @ top) / (weights @ bottom), len(top), rng)


def median_interval(values: torch.Tensor, rng: torch.Generator) -> Figure:
    """Median of values [n] with the percentile bootstrap interval."""
    values = values.double()
    if not len(values):
        return Figure(math.nan, math.nan, math.nan, 0)
    picks = torch.randint(len(values), (RESAMPLES, len(values)), generator=rng)
    return figure_of(values.quantile(0.5), values[picks].quantile(0.5, dim=1), len(values))


def curve_interval(
    values: torch.Tensor, measure: Callable[[torch.Tensor], torch.Tensor], rng: torch.Generator
) -> Figure:
    """What `measure` (curves [R, T] -> [R]) finds in the mean curve of values [n, T], with an interval over clips."""
    values = values.double()
    resampled = _weights(len(values), rng) @ values / len(values)
    return figure_of(measure(values.mean(0, keepdim=True))[0], measure(resampled), len(values))


def last_step_above(values: torch.Tensor, floor: torch.Tensor, rng: torch.Generator) -> Figure:
    """The last step up to which the mean of values [n, T] has stayed at or above the mean of floor [n].

    Steps count from 1; 0 if the first is already below, T if none is. Clips of both are resampled together.
    """
    over = values.double() - floor.double()[:, None]

    def last(means: torch.Tensor) -> torch.Tensor:
        """Means [..., T] -> steps before the first that is below 0: [...]."""
        return (means >= -1e-9).cumprod(-1).sum(-1).double()

    return curve_interval(over, last, rng)


def _band(centre: torch.Tensor, resample: Callable, count: int, rng: torch.Generator) -> Band:
    if count < 2:
        nothing = [math.nan] * len(centre)
        return Band(centre.tolist() if count else nothing, nothing, nothing, count)
    low, high = interval_of(resample(_weights(count, rng)))
    return Band(centre.tolist(), low.tolist(), high.tolist(), count)


def interval_of(draws: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The 2.5% and 97.5% quantiles of draws [n, T], each [T]; nan is left out."""
    if not draws.isfinite().all():
        low, high = draws.nanquantile(torch.tensor([0.025, 0.975], dtype=draws.dtype), dim=0)
        return low, high
    ends = [share * (len(draws) - 1) for share in (0.025, 0.975)]  # selection takes a fifth of a sort's time
    near = np.partition(draws.numpy(), sorted({int(end) + more for end in ends for more in (0, 1)}), axis=0)
    low, high = (torch.from_numpy(near[int(end)] + (end % 1) * (near[int(end) + 1] - near[int(end)])) for end in ends)
    return low, high


def _weights(count: int, rng: torch.Generator) -> torch.Tensor:
    """Bootstrap weights, the draws of each clip in each resample: float64 [RESAMPLES, count]."""
    picks = torch.randint(count, (RESAMPLES, count), generator=rng)
    ones = torch.ones(RESAMPLES, count, dtype=torch.float64)
    return torch.zeros_like(ones).scatter_add_(1, picks, ones)


def figure_of(centre: torch.Tensor, resampled: torch.Tensor, count: int) -> Figure:
    """The value, with the 2.5% and 97.5% quantiles of its resamples [R] if there are two clips or more."""
    if count < 2:
        return Figure(float(centre), math.nan, math.nan, count)
    low, high = resampled.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return Figure(float(centre), low, high, count)
