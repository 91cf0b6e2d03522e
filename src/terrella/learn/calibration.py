"""Calibrated confidence: isotonic regression of being right on a score (Zadrozny & Elkan 2002), and the calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BINS = 10


@dataclass(frozen=True)
class Isotonic:
    """A rising step function from a score to the probability of being right."""

    scores: np.ndarray  # ascending: the last score of each step
    values: np.ndarray  # the probability there

    @staticmethod
    def fit(scores: np.ndarray, right: np.ndarray) -> Isotonic:
        """By pooling adjacent violators. Each probability is that of its pool with one success and one failure added."""
        order = np.argsort(scores, kind="stable")
        pools: list[list[float]] = []  # successes, count, last score
        for score, hit in zip(np.asarray(scores, np.float64)[order], np.asarray(right, np.float64)[order]):
            if pools and pools[-1][2] == score:
                pools[-1][0], pools[-1][1] = pools[-1][0] + hit, pools[-1][1] + 1
            else:
                pools.append([hit, 1.0, score])
            while len(pools) > 1 and pools[-2][0] * pools[-1][1] >= pools[-1][0] * pools[-2][1]:
                hits, count, last = pools.pop()
                pools[-1] = [pools[-1][0] + hits, pools[-1][1] + count, last]
        hits, counts, lasts = np.array(pools).T
        return Isotonic(lasts, np.maximum.accumulate((hits + 1) / (counts + 2)))

    def __call__(self, scores: np.ndarray) -> np.ndarray:
        at = np.searchsorted(self.scores, scores).clip(0, len(self.values) - 1)
        return self.values[at]


def calibration_error(confidence: np.ndarray, right: np.ndarray) -> float:
    """The expected calibration error over BINS bins of confidence (Naeini et al. 2015)."""
    at = (np.asarray(confidence) * BINS).astype(int).clip(0, BINS - 1)
    gaps = [abs(confidence[at == one].mean() - right[at == one].mean()) * (at == one).mean() for one in np.unique(at)]
    return float(sum(gaps))
