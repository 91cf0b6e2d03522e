"""Episodes of named arrays, as HDF5, Minari and .npz keep them: a table says which array is which sensor.

A format finds the arrays of an episode (`Array`, at their places) and names what the first keys of places mean (`names`).
`columns` makes sensors of that, `readings` the readings of a take, and `source` the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import rows

Place = tuple[str | int, ...]  # ("obs", "front"): keys of groups or Dicts, indices of Tuples
GYMNASIUM = {  # what the arrays of a rollout mean, as Gymnasium and Minari name them
    "observations": rows.OBSERVATION,
    "actions": rows.ACTION,
    "rewards": rows.REWARD,
    "terminations": rows.DONE,
    "truncations": rows.TRUNCATED,
}
Guess = Callable[[Place, tuple[int, ...], np.dtype], Sensor | None]


def _unread(start: int, stop: int) -> np.ndarray:
    raise DatasetError("of this array nothing but the header is known.")


@dataclass(frozen=True)
class Array:
    """An array of an episode as it is stored, shape (rows, ...); `read(start, stop)` gives rows of it."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[int, int], np.ndarray] = _unread

    @property
    def is_numbers(self) -> bool:
        return self.dtype.kind in "biuf" and self.dtype.itemsize <= 8 and len(self.shape) > 0


def joined(place: Place) -> str:
    """A place as a part of a sensor's name."""
    return ".".join(rows.clean(part) for key in place for part in str(key).split("."))


def named(names: Mapping[str, str], place: Place, shape: tuple[int, ...], dtype: np.dtype) -> Sensor | None:
    """The sensor of rows of that shape, by the meaning of the place's first key; None where the table does not have it.

    names: first key -> "observation", "action", "info" (further keys are the sensor's name), or a whole name.
    """
    name = names.get(str(place[0]))
    if name is None:
        return None
    if name in (rows.DONE, rows.TRUNCATED):
        dtype = np.dtype(bool)
    if len(place) > 1 or name == rows.OBSERVATION:
        return rows.sensor_for(name, joined(place[1:]), shape, dtype)
    return rows.sensor_for("", name, shape, dtype)


def columns(
    arrays: Mapping[Place, Array], guess: Guess, what: str, described: Mapping[Place, Sensor] | None = None
) -> tuple[dict[Place, Sensor], list[str]]:
    """Place -> its sensor, for each array that `guess` knows; and sentences on those that are left out.

    described: what we wrote there, taken instead of a guess where it fits.
    """
    found: dict[Place, Sensor] = {}
    notes, taken = [], set()
    for place, array in arrays.items():
        sensor = guess(place, array.shape[1:], array.dtype) if array.is_numbers else None
        if sensor is None:
            notes.append(f"{what} '{spelled(place)}' is left out: it is not an array of numbers that is known there.")
            continue
        mine = (described or {}).get(place)
        if mine is not None and mine.dtype == sensor.dtype:
            mine = rows.stored_as(mine, array.shape[1:])
            sensor = mine if rows.stored_shape(mine) == array.shape[1:] else sensor
        found[place] = replace(sensor, name=rows.unique(sensor.name, taken))
        taken.add(found[place].name)
    return found, notes


def readings(
    arrays: Mapping[Place, Array], sensors: Mapping[Place, Sensor], time_s: np.ndarray, where: str
) -> dict[str, Readings]:
    """The readings of one take, row i at time_s[i]; pictures are read when they are looked at.

    DatasetError where an array is missing, of another shape than its sensor, or longer than there are times.
    """
    found = {}
    for place, sensor in sensors.items():
        what, want = f"'{spelled(place)}' in {where}", rows.stored_shape(sensor)
        if place not in arrays:
            raise DatasetError(f"{where} lacks '{spelled(place)}', an array of numbers; mend it, or drop it.")
        array = arrays[place]
        if not array.is_numbers:
            raise DatasetError(f"{what} is not an array of numbers with a row for each step; restore it from a copy.")
        if array.shape[1:] != want:
            shape = list(array.shape[1:])
            raise DatasetError(f"{what} is {shape} a row where the first episode has {list(want)}; mend or drop it.")
        count = len(time_s[: array.shape[0]])
        if count < array.shape[0]:
            raise DatasetError(f"{what} has {array.shape[0]} rows where there are {count} observations; mend it.")

        def value(start: int, stop: int, array=array, sensor=sensor, what=what) -> np.ndarray:
            stored = array.read(start, stop)
            if stored.shape != (stop - start, *array.shape[1:]):
                raise DatasetError(f"{what} changed while it was read; read it anew.")
            return rows.from_stored(stored.astype(sensor.dtype, copy=False), sensor)

        one = Lazy(count, lambda i, value=value: value(i, i + 1)[0])
        found[sensor.name] = Readings(time_s[:count], value(0, count) if sensor.kind == "vector" else one)
    return found


def source(
    what: str,
    name: str,
    sensors: Mapping[Place, Sensor],
    takes: Callable[[float], Iterable[Take]],
    *,
    fps: float | None,
    about: Mapping | None = None,
    robot: str = "",
    notes: Iterable[str] = (),
    facts: Mapping[str, object] | None = None,
) -> Source:
    """A source of such takes; `takes(fps)` gives them.

    fps: rows a second as the caller says, else as `about` does (our own description of the recording), else a guess.
    """
    about = about or {}
    rate, more = rows.rate_of(fps, about.get("fps"), what)
    kept = about.get("facts")
    return Source(
        name=str(about.get("name") or name),
        sensors={sensor.name: sensor for sensor in sensors.values()},
        takes=lambda: takes(rate),
        fps=rate,
        robot=str(about.get("robot") or robot),
        notes=(*notes, *more),
        facts={**(kept if isinstance(kept, Mapping) else {}), **(facts or {})},
    )


def spelled(place: Place) -> str:
    return "/".join(map(str, place))
