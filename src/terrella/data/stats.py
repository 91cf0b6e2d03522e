"""Minimum, maximum, mean, standard deviation and count of features, per episode and merged (meta/stats.json)."""

from collections.abc import Iterable, Mapping

import numpy as np

Summary = dict[str, np.ndarray]  # min, max, mean, std: float64 [n] (or [3, 1, 1] for pictures); count: int64 [1]


def summarise(values: np.ndarray, sampled: bool = False) -> Summary:
    """The summary of each number of rows [T, ...]; `sampled`: one summary, shape [1, 1], of a sample of maps [T, h, w]."""
    if sampled:
        some = values[::4, ::4, ::4].astype(np.float64).reshape(-1, 1)
        return _summary(some, len(values), (1,) * (values.ndim - 1))
    return _summary(values.astype(np.float64).reshape(len(values), -1), len(values), values.shape[1:] or (1,))


def summarise_pictures(pictures: np.ndarray) -> Summary:
    """The summary of pictures uint8 [n, H, W, 3] by colour, in 0..1, shape [3, 1, 1]; of depth [n, H, W], shape [1, 1, 1]."""
    if pictures.ndim == 3:
        return _summary(pictures.reshape(-1, 1).astype(np.float64), len(pictures), (1, 1, 1))
    return _summary(pictures.reshape(-1, 3) / 255.0, len(pictures), (3, 1, 1))


def _summary(rows: np.ndarray, count: int, shape: tuple[int, ...]) -> Summary:
    with np.errstate(over="ignore", invalid="ignore"):  # the deviation of numbers near the largest overflows
        figures = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return {**{name: value.reshape(shape) for name, value in figures.items()}, "count": np.array([count])}


def merge(parts: Iterable[Mapping[str, Summary]]) -> dict[str, Summary]:
    """One summary for each feature, over the rows of all parts."""
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
        "min": np.minimum(a["min"], b["min"]), "max": np.maximum(a["max"], b["max"]), "mean": mean,
        "std": np.sqrt(spread), "count": np.array([n + m]),
    }  # fmt: skip


def to_json(stats: Mapping[str, Summary]) -> dict:
    """Plain lists, as meta/stats.json and the stats columns of meta/episodes hold them; JSON knows no infinity."""
    return {name: {key: np.nan_to_num(value).tolist() for key, value in each.items()} for name, each in stats.items()}


def from_json(stated: Mapping) -> dict[str, Summary]:
    """The inverse of `to_json`; KeyError, TypeError or ValueError where it is not one."""
    keys = ("min", "max", "mean", "std", "count")
    return {name: {key: np.asarray(summary[key], float) for key in keys} for name, summary in stated.items()}
