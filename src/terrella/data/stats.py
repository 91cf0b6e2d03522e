"""Minimum, maximum, mean, deviation and count of each feature, per episode and merged (LeRobot's meta/stats.json)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

Summary = dict[str, np.ndarray]  # min, max, mean, std: float64 [n] (or [3, 1, 1] for pictures); count: int64 [1]


def summarise(values: np.ndarray) -> Summary:
    """Of rows [T] or [T, n], per column; of maps [T, h, w], over a sample of everything as shape [1, 1]."""
    if values.ndim == 3:
        return _summary(values[::4, ::4, ::4].astype(np.float64).reshape(-1, 1), len(values), (1, 1))
    rows = values.astype(np.float64).reshape(len(values), -1)
    return _summary(rows, len(rows), (rows.shape[1],))


def summarise_pictures(pictures: np.ndarray, count: int) -> Summary:
    """Of sampled uint8 [n, H, W, 3] pictures, per colour in 0..1 as shape [3, 1, 1], standing for `count` rows."""
    return _summary(pictures.reshape(-1, 3) / 255.0, count, (3, 1, 1))


def _summary(rows: np.ndarray, count: int, shape: tuple[int, ...]) -> Summary:
    found = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return {**{name: value.reshape(shape) for name, value in found.items()}, "count": np.array([count])}


def merge(parts: Iterable[Mapping[str, Summary]]) -> dict[str, Summary]:
    """One summary per feature of all the parts' rows together."""
    total: dict[str, Summary] = {}
    for part in parts:
        for name, new in part.items():
            total[name] = _merge_two(total[name], new) if name in total else dict(new)
    return total


def _merge_two(a: Summary, b: Summary) -> Summary:
    n, m = int(a["count"][0]), int(b["count"][0])
    mean = (a["mean"] * n + b["mean"] * m) / (n + m)
    spread = (n * (a["std"] ** 2 + (a["mean"] - mean) ** 2) + m * (b["std"] ** 2 + (b["mean"] - mean) ** 2)) / (n + m)
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": np.array([n + m]),
    }


def to_json(stats: Mapping[str, Summary]) -> dict:
    """Plain lists, as meta/stats.json and the stats columns of meta/episodes hold them."""
    return {name: {key: value.tolist() for key, value in summary.items()} for name, summary in stats.items()}
