"""The true frame rate of a recording, measured in the timestamps of its rows and in its videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..data.format import INFO, contained, tidy
from ..data.storage import mp4
from ..data.storage.tables import read_whole

_BROKEN = (OSError, pa.ArrowException, av.FFmpegError, ValueError, KeyError, TypeError, IndexError, DatasetError)
_FILES = 8  # of each kind that are measured
_ROWS, _PACKETS = 20_000_000, 256
_SAME = 5e-4  # relative; 29.97 and 30 differ by twice as much
_UNEVEN = 0.05  # share by which a step may differ from the usual one
_MOST = 2 / 3  # of the episodes, or of the videos, must agree


def true_rate(
    root: Path, declared: float | None, data: Sequence[str], films: Sequence[str]
) -> tuple[float, tuple[str, str, str] | None]:
    """(frames per second, the file, fault and mend where they are not those of info.json, or of the videos).

    The rate of info.json stands unless the timestamps of the rows agree on another, and no video contradicts them.
    """
    rows, shown = _rate_of_rows(root, data), _rate_of_films(root, films)
    if declared is None:
        return tidy(rows or shown or 1.0), None
    if rows and not _same(rows, declared) and (shown is None or _same(shown, rows)):
        witnesses = "the timestamps of the rows and the videos run" if shown else "the timestamps of the rows run"
        what = f"fps is {declared:g}, but {witnesses} at {rows:g} frames per second"
        return tidy(rows), (INFO, what, f"set fps to {rows:g} there, as --repair does")
    if shown and not _same(shown, declared):
        what = f"the videos run at {shown:g} frames per second, {INFO} says {declared:g}"
        return declared, ("videos", what, "restore the videos from a copy, or encode them again at that rate")
    return declared, None


def _same(a: float, b: float) -> bool:
    return abs(a / b - 1) < _SAME


def _rate_of_rows(root: Path, data: Sequence[str]) -> float | None:
    rates: list[float | None] = []
    for name in _some(data):
        try:
            table = read_whole(contained(root, name), ["timestamp"], _ROWS)
            time_s = table["timestamp"].to_numpy().astype(np.float64)
            rates += [_even(each) for each in np.split(time_s, np.flatnonzero(~(np.diff(time_s) > 0)) + 1)[:1000]]
        except _BROKEN:
            continue
    return _shared([rate for rate in rates if rate])


def _rate_of_films(root: Path, films: Sequence[str]) -> float | None:
    rates = []
    for name in _some(films):
        try:
            with mp4.opened(contained(root, name)) as (container, stream):
                packets = (packet.pts for packet, _ in zip(container.demux(stream), range(_PACKETS)))
                ticks = np.sort([pts for pts in packets if pts is not None])
                rates.append(_even(ticks * float(stream.time_base or 0)))
        except _BROKEN:
            continue
    return _shared([rate for rate in rates if rate])


def _some(names: Sequence[str]) -> Sequence[str]:
    return names[:: max(1, len(names) // _FILES)][:_FILES]


def _even(time_s: np.ndarray) -> float | None:
    """The rate of ascending times [n]; None where most of them are not evenly spaced."""
    steps = np.diff(time_s)
    if not len(steps) or not np.isfinite(steps).all() or np.median(steps) <= 0:
        return None
    even = np.abs(steps / np.median(steps) - 1) <= _UNEVEN
    return float(even.sum() / steps[even].sum()) if even.mean() >= 0.9 else None


def _shared(rates: list[float]) -> float | None:
    """The rate that most have; whole where it is but for rounding."""
    if not rates:
        return None
    middle = float(np.median(rates))
    if np.mean([_same(rate, middle) for rate in rates]) < _MOST or not 1e-3 <= middle <= 1e6:
        return None
    return float(round(middle)) if round(middle) and _same(middle, round(middle)) else round(middle, 6)
