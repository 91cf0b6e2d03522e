"""Agreement of two scorings of policies: Pearson, Spearman and the mean maximum rank violation of SIMPLER, with intervals."""

import math
from dataclasses import dataclass

import torch

from .statistics import RESAMPLES, Figure, figure_of

LEAST = 3  # policies for a ranking


@dataclass(frozen=True)
class Agreement:
    """The agreement of two scorings of P policies."""

    pearson: Figure
    spearman: Figure
    mmrv: Figure  # in shares of `scale`
    scale: float  # the range of the second scores
    chance: float = math.nan  # p-value: share of random rankings with as high a Spearman correlation


def pearson(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The linear correlation of scores [..., P]; NaN if either are all equal."""
    one, other = (scores.double() - scores.double().mean(-1, keepdim=True) for scores in (one, other))
    spread = one.square().sum(-1).sqrt() * other.square().sum(-1).sqrt()
    return torch.where(spread > 1e-12, (one * other).sum(-1) / spread.clamp_min(1e-300), torch.nan).clamp(-1, 1)


def ranks(scores: torch.Tensor) -> torch.Tensor:
    """The ranks of scores [..., P], from 0 up; equal scores share their mean rank."""
    below = scores[..., None, :] < scores[..., :, None]
    same = scores[..., None, :] == scores[..., :, None]
    return below.sum(-1).double() + (same.sum(-1).double() - 1) / 2


def spearman(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The correlation of the ranks of scores [..., P]."""
    return pearson(ranks(one), ranks(other))


def mean_maximum_rank_violation(dream: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """MMRV (Li et al. 2024, SIMPLER): for each policy, the largest real difference to a policy that the dream ranks on the wrong
    side of it; the mean over policies [..., P], in the unit of the real scores."""
    wrong = (dream[..., :, None] > dream[..., None, :]) != (real[..., :, None] > real[..., None, :])
    return ((real[..., :, None] - real[..., None, :]).abs().double() * wrong).amax(-1).mean(-1)


def agreement(dream: torch.Tensor, real: torch.Tensor, rng: torch.Generator, scale: float | None = None) -> Agreement:
    """The agreement of scores [P, N] of P policies in N episodes; episode n starts alike for all.

    The 95% intervals are percentiles of a bootstrap over policies and episodes, the same episodes for all policies. Resamples
    without any difference have no correlation and are left out. scale: divisor of MMRV, by default the range of the real means.
    """
    count, episodes = real.shape
    dream, real = dream.double(), real.double()
    means = dream.mean(1), real.mean(1)
    scale = float(means[1].max() - means[1].min()) if scale is None else scale
    policies = torch.randint(count, (RESAMPLES, count), generator=rng)
    drawn = torch.randint(episodes, (RESAMPLES, episodes), generator=rng)
    weights = torch.zeros(RESAMPLES, episodes, dtype=torch.float64)
    weights.scatter_add_(1, drawn, torch.ones(RESAMPLES, episodes, dtype=torch.float64))
    resampled = [(weights @ scores.T / episodes).gather(1, policies) for scores in (dream, real)]
    figures = [_figure(measure(*means), measure(*resampled), count) for measure in (pearson, spearman)]
    violated = [mean_maximum_rank_violation(*each) / (scale or math.nan) for each in (means, resampled)]
    shuffled = means[0][torch.rand(RESAMPLES, count, generator=rng).argsort(-1)]
    p_value = (spearman(shuffled, means[1].expand_as(shuffled)) >= figures[1].value - 1e-9).double().mean()
    return Agreement(figures[0], figures[1], _figure(violated[0], violated[1], count), scale, float(p_value))


def halves(scores: torch.Tensor, rng: torch.Generator) -> Agreement | None:
    """The agreement of every other episode of [P, N] with the others; None for too few."""
    count = scores.shape[1] // 2
    return agreement(scores[:, 0 : 2 * count : 2], scores[:, 1 : 2 * count : 2], rng) if count > 1 else None


def _figure(value: torch.Tensor, drawn: torch.Tensor, count: int) -> Figure:
    known = drawn[torch.isfinite(drawn)]
    if count < LEAST or not bool(torch.isfinite(value)) or len(known) < RESAMPLES // 2:
        return Figure(float(value) if count >= LEAST else math.nan, math.nan, math.nan, count)
    return figure_of(value, known, count)
