"""One episode of Minari's main_data.hdf5: the group episode_i."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Lazy, Sensor
from . import hdf5, rows
from .minari_stored import INFOS_DEEPEST, Place, decode_jpeg


class Hdf5Episode:
    """The file is opened at each question, and once more when pictures are looked at."""

    def __init__(self, path: Path, number: int):
        self._path, self._name = path, f"episode_{number}"

    def steps(self) -> int:
        with hdf5.opened(self._path) as file:
            return len(hdf5.numbers(hdf5.group(file, self._name), "rewards"))

    def infos(self) -> dict[tuple[str, ...], tuple[tuple[int, ...], np.dtype]]:
        with hdf5.opened(self._path) as file:
            episode = hdf5.group(file, self._name)
            if "infos" not in episode or not isinstance(hdf5.child(episode, "infos"), hdf5.Group):
                return {}
            steps = len(hdf5.numbers(episode, "rewards"))
            return dict(_info_arrays(hdf5.group(episode, "infos"), (), steps))

    def values(self, place: Place, sensor: Sensor, count: int) -> np.ndarray | Lazy:
        names = self._names(place)
        with hdf5.opened(self._path) as file:
            parent = _walk(file, names[:-1])
            stored = hdf5.child(parent, names[-1])
            if isinstance(stored, hdf5.Dataset) and _is_jpeg(stored, sensor):
                if len(stored) != count:
                    raise DatasetError(f"{self._where(place)} has {len(stored)} rows where {count} are needed.")
                pictures = self._jpegs(names, sensor, count)
                return pictures if sensor.kind != "vector" else np.stack(list(pictures))
            stored = hdf5.numbers(parent, names[-1], count)
            hdf5.check_shape(stored, sensor, self._where(place))
            if sensor.kind == "vector":
                return hdf5.taken(stored, sensor)
        return hdf5.pictures(self._path, names, sensor, 0, count)

    def texts(self, place: Place) -> list[str]:
        names = self._names(place)
        with hdf5.opened(self._path) as file:
            stored = hdf5.child(_walk(file, names[:-1]), names[-1])
            if not isinstance(stored, hdf5.Dataset) or stored.dtype.kind not in "OS" or stored.ndim != 1:
                raise DatasetError(f"{self._where(place)} holds no texts; restore it from a copy.")
            return [
                item.decode("utf-8", "replace") if isinstance(item, bytes) else str(item) for item in np.asarray(stored)
            ]

    def facts(self) -> dict[str, object]:
        with hdf5.opened(self._path) as file:
            return hdf5.attributes(hdf5.group(file, self._name))

    def _names(self, place: Place) -> tuple[str, ...]:
        return (self._name, *(f"_index_{part}" if isinstance(part, int) else part for part in place))

    def _where(self, place: Place) -> str:
        return f"{self._path}/{'/'.join(self._names(place))}"

    def _jpegs(self, names: tuple[str, ...], sensor: Sensor, count: int) -> Lazy:
        def make(i: int) -> np.ndarray:
            with hdf5.opened(self._path) as file:
                stored = hdf5.child(_walk(file, names[:-1]), names[-1])
                data = np.asarray(stored[i], np.uint8).tobytes() if isinstance(stored, hdf5.Dataset) else b""
            return decode_jpeg(data, sensor, f"{self._path}/{'/'.join(names)}, row {i}")

        return Lazy(count, make)


def _is_jpeg(stored: hdf5.Dataset, sensor: Sensor) -> bool:
    """Whether a row is the bytes of a JPEG: of equal lengths [n, bytes], or of different ones (an array of arrays)."""
    if len(rows.stored_shape(sensor)) not in (2, 3):
        return False
    return (stored.dtype.kind == "O" and stored.ndim == 1) or (stored.dtype == np.uint8 and stored.ndim == 2)


def _walk(file: hdf5.Group, names: tuple[str, ...]) -> hdf5.Group:
    for name in names:
        file = hdf5.group(file, name)
    return file


def _info_arrays(parent: hdf5.Group, place: tuple[str, ...], steps: int):
    for name in hdf5.members(parent):
        item, here = hdf5.child(parent, name), (*place, name)
        if isinstance(item, hdf5.Group):
            if len(here) < INFOS_DEEPEST:
                yield from _info_arrays(item, here, steps)
        elif item.dtype.kind in "biuf" and item.dtype.itemsize <= 8 and item.ndim and len(item) in (steps, steps + 1):
            yield here, (item.shape[1:], item.dtype)
