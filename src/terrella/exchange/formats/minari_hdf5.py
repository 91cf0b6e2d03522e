"""One episode of Minari's main_data.hdf5."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from . import hdf5
from .arrays import Array, Place, spelled
from .minari_stored import Shapes, jpegs


class Hdf5Episode:
    """The group episode_i. The file is opened at each question, and once more when pictures are looked at."""

    def __init__(self, path: Path, number: int):
        self._path, self._name = path, f"episode_{number}"

    def arrays(self, shapes: Shapes) -> dict[Place, Array]:
        found: dict[Place, Array] = {}
        with hdf5.opened(self._path) as file:
            for names, item in hdf5.walked(hdf5.inside(file, self._name)):
                place: Place = tuple(int(it[7:]) if re.fullmatch(r"_index_\d+", it) else it for it in names)
                found[place] = Array(item.shape, item.dtype)
                if _is_jpeg(item, shapes.get(place, ())):
                    where = f"{self._path}/{self._name}/{spelled(names)}"
                    found[place] = jpegs(len(item), shapes[place], lambda i, names=names: self._packed(names, i), where)
                elif found[place].is_numbers:
                    found[place] = hdf5.array(file, len(item), ((self._name, *names), 0, len(item)))
        return found

    def texts(self, place: Place) -> list[str]:
        with hdf5.opened(self._path) as file:
            return hdf5.texts(self._dataset(file, place))

    def facts(self) -> dict[str, object]:
        with hdf5.opened(self._path) as file:
            return hdf5.attributes(hdf5.inside(file, self._name))

    def _dataset(self, file: hdf5.File, names: Place):
        return hdf5.child(hdf5.inside(file, self._name, *names[:-1]), names[-1])

    def _packed(self, names: tuple[str, ...], i: int) -> bytes:
        with hdf5.opened(self._path) as file:
            return np.asarray(self._dataset(file, names)[i], np.uint8).tobytes()


def _is_jpeg(stored, shape: tuple[int, ...]) -> bool:
    """Whether a row is the bytes of a JPEG: of equal lengths [n, bytes], or of different ones (an array of arrays)."""
    packed = (stored.dtype.kind == "O" and stored.ndim == 1) or (stored.dtype == np.uint8 and stored.ndim == 2)
    return packed and len(shape) in (2, 3)
