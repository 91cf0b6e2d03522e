"""Risk against coverage: does a world know which of its frames are wrong, and by how much?

Frames are ordered by the world's own `uncertainty`; the risk at a coverage c is the mean error of the c that it is surest of
(El-Yaniv and Wiener 2010), and the area under that curve (AURC, Geifman et al. 2019) is its mean over all coverages. Ordered
by chance it is the mean error; by the error itself, as an oracle would, it is the least that any order has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from .statistics import Figure

RESAMPLES = 400
POINTS, BINS = 50, 8


@dataclass(frozen=True)
class Risk:
    """One arm's frames of every step up to `steps`; errors are mean absolute, intensities 0 to 1.

    aurc, random, oracle: the area under the curve by the world's own order, by chance, by the errors; closed: how much of
    the way from random to oracle its order goes (1: an oracle, 0: chance). expected: the mean of its uncertainty, beside
    `random`, which is the mean error; off: the mean distance between both in BINS equal bins of uncertainty (expected
    calibration error). coverage, risk and best: the curve and the oracle's; reliability: (expected, found) of each bin.
    Intervals are over clips.
    """

    place: str
    arm: str
    motion: str
    steps: int
    aurc: Figure
    random: Figure
    oracle: Figure
    closed: Figure
    expected: Figure
    off: Figure
    coverage: list[float]
    risk: list[float]
    best: list[float]
    reliability: list[tuple[float, float]]


def risk(
    place: str, arm: str, motion: str, error: torch.Tensor, uncertainty: torch.Tensor, rng: torch.Generator
) -> Risk:
    """Of errors and uncertainties [n, T] of the frames of n clips."""
    clips, steps = error.shape
    wrong, doubt = error.flatten().double(), uncertainty.flatten().double()
    clip = torch.arange(clips).repeat_interleave(steps)
    picks = torch.randint(clips, (RESAMPLES, clips), generator=rng)
    weights = torch.zeros(RESAMPLES + 1, clips, dtype=torch.float64)
    weights[0] = 1  # the clips as they are
    weights[1:].scatter_add_(1, picks, torch.ones(RESAMPLES, clips, dtype=torch.float64))
    by_doubt, by_error = doubt.argsort(stable=True), wrong.argsort(stable=True)
    areas, least = (_area(weights[:, clip[order]], wrong[order]) for order in (by_doubt, by_error))
    shares = weights / weights.sum(1, keepdim=True) / steps
    chance = shares[:, clip] @ wrong
    bins = [part for part in by_doubt.tensor_split(BINS) if len(part)]
    off = torch.zeros(len(weights), dtype=torch.float64)
    for part in bins:
        off += (shares[:, clip[part]] @ (wrong[part] - doubt[part])).abs()
    at = [max(1, round(len(wrong) * (k + 1) / POINTS)) - 1 for k in range(POINTS)]
    return Risk(
        place, arm, motion, steps,
        aurc=_figure(areas, clips),
        random=_figure(chance, clips),
        oracle=_figure(least, clips),
        closed=_figure((chance - areas) / (chance - least).clamp_min(1e-12), clips),
        expected=_figure(shares[:, clip] @ doubt, clips),
        off=_figure(off, clips),
        coverage=[(k + 1) / len(wrong) for k in at],
        risk=_running(wrong[by_doubt])[at].tolist(),
        best=_running(wrong[by_error])[at].tolist(),
        reliability=[(float(doubt[part].mean()), float(wrong[part].mean())) for part in bins],
    )  # fmt: skip


def pooled(parts: Sequence[tuple[torch.Tensor, torch.Tensor]], arm: str, motion: str, rng: torch.Generator) -> Risk:
    """The same over the clips of all places together: can it tell the known from the invented?"""
    error, uncertainty = (torch.cat([part[which] for part in parts]) for which in (0, 1))
    return risk("all", arm, motion, error, uncertainty, rng)


def _area(weights: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Of frames in order: error [N], weights [R, N] -> the mean over coverages of the mean error covered [R]."""
    covered = weights.cumsum(1)
    running = (weights * error).cumsum(1) / covered.clamp_min(1e-12)
    return (weights * running).sum(1) / covered[:, -1]


def _running(error: torch.Tensor) -> torch.Tensor:
    return error.cumsum(0) / torch.arange(1, len(error) + 1)


def _figure(values: torch.Tensor, clips: int) -> Figure:
    """The first value, with the 2.5% and 97.5% quantiles of the others."""
    if clips < 2:
        return Figure(float(values[0]), float("nan"), float("nan"), clips)
    low, high = values[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return Figure(float(values[0]), low, high, clips)
