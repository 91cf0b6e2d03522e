"""D4RL's flat HDF5 arrays (observations, actions, rewards, terminals, timeouts), cut into episodes when read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from . import hdf5, rows

_NAMES = {"actions": rows.ACTION, "rewards": rows.REWARD, "terminals": rows.DONE, "timeouts": rows.TRUNCATED}


def read(path: Path, fps: float | None) -> Source:
    """A file of flat arrays, cut into takes after each terminal and each timeout; what follows the last is a take too.

    With next_observations a take has one observation more than actions, else as many. Other arrays with a row for each
    step are "info.*"; metadata/* and the attributes are kept in facts["d4rl"].
    """
    with hdf5.opened(path) as file:
        count = len(hdf5.numbers(file, "actions"))
        columns: dict[tuple[str, ...], Sensor] = {}
        notes: list[str] = []
        _find_columns(file, (), count, columns, notes)
        ends = np.zeros(count, bool)
        for name in ("terminals", "timeouts"):
            if name in file:
                ends |= hdf5.numbers(file, name, count)[()].reshape(-1).astype(bool)
        has_next = "next_observations" in file and isinstance(hdf5.child(file, "next_observations"), hdf5.Dataset)
        facts = {"attributes": hdf5.attributes(file), **_metadata(file)}
    stops = [*(np.flatnonzero(ends) + 1).tolist()]
    if count and (not stops or stops[-1] < count):
        stops.append(count)
    if not stops:
        raise DatasetError(f"{path} has no rows; there is nothing to read.")
    rate, more = rows.rate_of(fps, None, "D4RL's layout")
    bounds = list(zip([0, *stops[:-1]], stops))
    return Source(
        name=path.stem,
        sensors={sensor.name: sensor for sensor in columns.values()},
        takes=lambda: (_take(path, columns, start, stop, has_next, rate) for start, stop in bounds),
        fps=rate,
        notes=(*notes, *more),
        facts={"d4rl": facts},
    )


def _find_columns(group: hdf5.Group, place: tuple[str, ...], count: int, columns: dict, notes: list[str]) -> None:
    if len(place) > hdf5.DEEPEST:
        raise DatasetError(f"{group.file.filename} nests its groups too deep; it is damaged.")
    for name in hdf5.members(group):
        here, item = (*place, name), hdf5.child(group, name)
        if here[0] in ("metadata", "next_observations"):
            continue
        if isinstance(item, hdf5.Group):
            _find_columns(item, here, count, columns, notes)
        elif not isinstance(item, hdf5.Dataset) or item.dtype.kind not in "biuf" or item.shape[:1] != (count,):
            if here[0] in ("observations", "actions", "rewards", "terminals", "timeouts"):
                hdf5.numbers(group, name, count)  # says what is wrong
            notes.append(f"D4RL's '{'/'.join(here)}' is left out: it is not an array of numbers with {count} rows.")
        else:
            sensor = _sensor(here, item.shape[1:], item.dtype)
            names = {other.name: other for other in columns.values()}
            columns[here] = replace(sensor, name=rows.unique(sensor.name, names))


def _sensor(place: tuple[str, ...], shape: tuple[int, ...], dtype: np.dtype) -> Sensor:
    key = ".".join(rows.clean(part) for part in (place[1:] if place[0] in ("observations", "infos") else place))
    if place[0] == "observations":
        return rows.sensor_for(rows.OBSERVATION, key, shape, dtype)
    if place[0] in _NAMES and len(place) == 1:
        kind = "bool" if place[0] in ("terminals", "timeouts") else dtype
        return replace(rows.sensor_for("", place[0], shape, kind), name=_NAMES[place[0]])
    return rows.sensor_for(rows.INFO, key, shape, dtype)


def _metadata(file: hdf5.File) -> dict:
    found = {}
    if "metadata" in file and isinstance(hdf5.child(file, "metadata"), hdf5.Group):
        group = hdf5.group(file, "metadata")
        for name in hdf5.members(group):
            item = hdf5.child(group, name)
            if isinstance(item, hdf5.Dataset) and item.ndim == 0:
                value = rows.json_or_none(item[()])
                if value is not None:
                    found[name] = value
    return {"metadata": found} if found else {}


def _take(path: Path, columns: Mapping, start: int, stop: int, has_next: bool, fps: float) -> Take:
    readings = {}
    with hdf5.opened(path) as file:
        for place, sensor in columns.items():
            group = file
            for name in place[:-1]:
                group = hdf5.group(group, name)
            dataset = hdf5.numbers(group, place[-1])
            hdf5.check_shape(dataset, sensor, f"{path}/{'/'.join(place)}")
            last = has_next and place == ("observations",)
            after = hdf5.numbers(file, "next_observations", len(dataset)) if last else None
            if after is not None:
                hdf5.check_shape(after, sensor, f"{path}/next_observations")
            time_s = np.arange(stop - start + last) / fps
            if sensor.kind == "vector":
                values = hdf5.taken(dataset, sensor, start, stop)
                if after is not None:
                    values = np.concatenate([values, hdf5.taken(after, sensor, stop - 1, stop)])
            else:
                here = hdf5.pictures(path, place, sensor, start, stop - start)
                there = hdf5.pictures(path, ("next_observations",), sensor, stop - 1, 1)
                values = hdf5.followed_by(here, there) if last else here
            readings[sensor.name] = Readings(time_s, values)
    return Take(readings, facts={"rows": [start, stop]})
