"""One episode of Minari's main_data.hdf5."""

import re
from pathlib import Path

import numpy as np

from . import hdf5_file
from .arrays import Array, Place, Shapes, jpeg_rows, spelled


class Hdf5Episode:
    """The group episode_i. Each method opens the file; reading pictures opens it once more."""

    def __init__(self, path: Path, number: int):
        self._path, self._name = path, f"episode_{number}"

    def arrays(self, shapes: Shapes) -> dict[Place, Array]:
        arrays: dict[Place, Array] = {}
        with hdf5_file.open_file(self._path) as file:
            for names, item in hdf5_file.all_datasets(hdf5_file.subgroup(file, self._name)):
                place: Place = tuple(int(it[7:]) if re.fullmatch(r"_index_\d+", it) else it for it in names)
                arrays[place] = Array(item.shape, item.dtype)
                if _is_jpeg(item, shapes.get(place, ())):
                    where = f"{self._path}/{self._name}/{spelled(names)}"
                    arrays[place] = jpeg_rows(
                        len(item), shapes[place], lambda i, names=names: self._packed(names, i), where
                    )
                elif arrays[place].is_numeric:
                    arrays[place] = hdf5_file.concatenated(file, len(item), ((self._name, *names), 0, len(item)))
        return arrays

    def headers(self, shapes: Shapes) -> dict[Place, Array]:
        return self.arrays(shapes)

    def texts(self, place: Place) -> list[str]:
        with hdf5_file.open_file(self._path) as file:
            return hdf5_file.read_strings(self._dataset(file, place))

    def facts(self) -> dict[str, object]:
        with hdf5_file.open_file(self._path) as file:
            return hdf5_file.attributes(hdf5_file.subgroup(file, self._name))

    def _dataset(self, file: hdf5_file.File, names: Place):
        return hdf5_file.child(hdf5_file.subgroup(file, self._name, *names[:-1]), names[-1])

    def _packed(self, names: tuple[str, ...], i: int) -> bytes:
        with hdf5_file.open_file(self._path) as file:
            return np.asarray(self._dataset(file, names)[i], np.uint8).tobytes()


def _is_jpeg(stored, shape: tuple[int, ...]) -> bool:
    """Whether a row is the bytes of a JPEG: all of one length [n, bytes], or of varying lengths (an array of arrays)."""
    packed = (stored.dtype.kind == "O" and stored.ndim == 1) or (stored.dtype == np.uint8 and stored.ndim == 2)
    return packed and len(shape) in (2, 3)
