"""The Frechet distance between two sets of frames, in the features of the fixed encoder.

Two Gaussians are fitted to the features of real and of dreamt frames, and their 2-Wasserstein distance, squared, is
    |m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2))          (Dowson and Landau 1982; "FID" where the features are Inception's).

It is 0 if both sets look the same. It is not the FID of papers (another encoder), values at different frame sizes do not
compare, and a wrong frame that looks real costs nothing (see PSNR).

The plain value is biased upwards by about C / n. The jackknife over frames, left out of both sets at once (Quenouille 1956,
Tukey 1958), removes that term and gives the interval. A corrected value may be slightly below 0 if the sets are alike.
"""

import math

import torch

from .statistics import Figure

_MIN_GROUPS, _MAX_GROUPS = 8, 50  # of the jackknife: fewer give no reliable interval, more take long


def frechet(real: torch.Tensor, dreamt: torch.Tensor) -> torch.Tensor:
    """Squared Frechet distance of features [..., n, D] and [..., m, D]: float64 [...], uncorrected, never below 0."""
    real, dreamt = real.double(), dreamt.double()
    return frechet_of_moments(*_moments(real), *_moments(dreamt))


def frechet_of_moments(
    mean_a: torch.Tensor, cov_a: torch.Tensor, mean_b: torch.Tensor, cov_b: torch.Tensor
) -> torch.Tensor:
    """The same of means [..., D] and covariances [..., D, D]. tr (S1 S2)^(1/2) is the sum of the singular values of
    S1^(1/2) S2^(1/2), with symmetric roots by eigenvalues: the usual root of the product would lose half of the digits."""
    cross = torch.linalg.svdvals(_root(cov_a) @ _root(cov_b)).sum(-1)
    traces = torch.diagonal(cov_a + cov_b, dim1=-2, dim2=-1).sum(-1)
    return ((mean_a - mean_b).square().sum(-1) + traces - 2 * cross).clamp_min(0)


def frechet_interval(real: torch.Tensor, dreamt: torch.Tensor) -> Figure:
    """The bias-corrected distance with a 95% interval, of features [n, D] of equally many real and predicted frames.

    Rows are left out one by one, or in 50 random groups if there are more. Figure.count is the number of frames. NaN for fewer
    than three rows; no interval for fewer than eight.
    """
    mine, count = torch.arange(len(real)), min(len(real), _MAX_GROUPS)
    if len(real) > count:
        mine = torch.randperm(len(real), generator=torch.Generator().manual_seed(0)) % count
    if count < 3:
        return Figure(math.nan, math.nan, math.nan, len(real))
    whole = frechet(real, dreamt)
    left = torch.stack([frechet(real[mine != group], dreamt[mine != group]) for group in range(count)])
    value = float(count * whole - (count - 1) * left.mean())
    if count < _MIN_GROUPS:
        return Figure(value, math.nan, math.nan, len(real))
    deviation = float(((count - 1) / count * (left - left.mean()).square().sum()).sqrt())
    return Figure(value, value - 1.96 * deviation, value + 1.96 * deviation, len(real))


def _moments(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    mean = features.mean(-2)
    away = features - mean[..., None, :]
    return mean, away.mT @ away / (features.shape[-2] - 1)


def _root(matrix: torch.Tensor) -> torch.Tensor:
    values, vectors = torch.linalg.eigh(matrix)
    rounding = values.amax(-1, keepdim=True) * matrix.shape[-1] * torch.finfo(matrix.dtype).eps
    values = values.where(values > rounding, 0)  # the root of what rounding left would be large
    return (vectors * values.sqrt()[..., None, :]) @ vectors.mT
