"""Calibration: isotonic regression of errors, and of being right on a score (Zadrozny & Elkan 2002), and the calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

BINS = 10


@dataclass(frozen=True)
class Isotonic:
    """A rising step function from a score to the probability of being right."""

    scores: np.ndarray  # ascending
    values: np.ndarray  # the probability of each

    @staticmethod
    def fit(scores: np.ndarray, right: np.ndarray) -> Isotonic:
        """Each probability is that of a pool of scores with one success and one failure added."""
        steps, at = np.unique(scores, return_inverse=True)
        count, hits = np.bincount(at), np.bincount(at, right)
        fitted = pool_adjacent_violators((hits / count).tolist(), count.tolist())
        pool = np.unique(fitted, return_inverse=True)[1]
        count, hits = np.bincount(pool, count), np.bincount(pool, hits)
        return Isotonic(steps, np.maximum.accumulate((hits + 1) / (count + 2))[pool])

    def __call__(self, scores: np.ndarray) -> np.ndarray:
        at = np.searchsorted(self.scores, scores).clip(0, len(self.values) - 1)
        return self.values[at]


def calibration_error(confidence: np.ndarray, right: np.ndarray) -> float:
    """The expected calibration error over BINS bins of confidence (Naeini et al. 2015)."""
    at = (np.asarray(confidence) * BINS).astype(int).clip(0, BINS - 1)
    gaps = [abs(confidence[at == one].mean() - right[at == one].mean()) * (at == one).mean() for one in np.unique(at)]
    return float(sum(gaps))


def isotonic(values: torch.Tensor, errors: torch.Tensor, bins: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Isotonic regression of errors [N] on values [N], in bins of equally many: mean value and fitted error of each [bins], the
    last repeated where there are fewer than `bins` values."""
    parts = [part for part in np.array_split(values.argsort().numpy(), bins) if len(part)]
    knots = [float(values[part].mean()) for part in parts]
    fitted = pool_adjacent_violators([float(errors[part].mean()) for part in parts], [len(part) for part in parts])
    lacking = bins - len(parts)
    return torch.tensor(knots + knots[-1:] * lacking), torch.tensor(fitted + fitted[-1:] * lacking)


def pool_adjacent_violators(values: list[float], weights: list[float]) -> list[float]:
    """The ascending sequence nearest to `values` in weighted least squares (Ayer et al. 1955)."""
    blocks: list[list[float]] = []  # mean, weight, count
    for value, weight in zip(values, weights, strict=True):
        blocks.append([value, weight, 1])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            mean, heavy, count = blocks.pop()
            below = blocks[-1]
            total = below[1] + heavy
            blocks[-1] = [(below[0] * below[1] + mean * heavy) / total, total, below[2] + count]
    return [mean for mean, _, count in blocks for _ in range(int(count))]
