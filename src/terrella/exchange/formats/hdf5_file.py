"""Reads and writes HDF5 files without trusting them: links out of the file, false sizes and damage are refused."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor
from . import rows
from .arrays import Array, Place

try:
    from h5py import Dataset, File, Group, HardLink, string_dtype
except ImportError as missing:
    raise DatasetError("HDF5 files need the package h5py: pip install 'terrella[hdf5]'.") from missing

OURS = "terrella"  # the attribute that holds our description of the sensors
TEXT = string_dtype("utf-8")
# Deflate packs at most 1032 to 1: a dataset that claims more than that of its stored bytes is refused.
_ALWAYS_ALLOWED_BYTES, _MAX_RATIO = 1 << 26, 1100
_MAX_DEPTH = 16  # of nested groups
_HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError, MemoryError)


@contextmanager
def open_file(path: Path) -> Iterator[File]:
    """The file, for reading; HDF5's own errors become a DatasetError."""
    try:
        with _open(path) as file:
            yield file
    except _HDF5_ERRORS as error:
        raise DatasetError(f"{path} is damaged ({_first_line(error)}); restore it from a copy.") from error


def _open(path: Path) -> File:
    try:
        return File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError(f"{path} does not exist; name an HDF5 file.") from error
    except _HDF5_ERRORS as error:
        why = _first_line(error)
        raise DatasetError(f"{path} is truncated or no HDF5 file ({why}); restore it from a copy.") from error


def names_in(parent: Group) -> list[str]:
    """The names in a group."""
    return [str(name) for name in parent]


def child(parent: Group, name: str | int) -> Group | Dataset:
    """parent[name], or entry `name` of one of Minari's Tuples; DatasetError for links and for values in other files."""
    name = f"_index_{name}" if isinstance(name, int) else name
    where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
    try:
        link = parent.get(name, getlink=True)
        if link is not None and not isinstance(link, HardLink):
            raise DatasetError(f"{where} is a link, which may lead out of the file; repack the file without links.")
        item = parent[name]
    except _HDF5_ERRORS as error:
        raise DatasetError(f"{where} is missing or damaged ({_first_line(error)}); restore it from a copy.") from error
    if not isinstance(item, Group | Dataset):
        raise DatasetError(f"{where} is neither a group nor an array; restore the file from a copy.")
    if isinstance(item, Dataset) and (item.is_virtual or item.external):
        raise DatasetError(f"{where} keeps its values in other files; repack the file so that it holds them.")
    return item


def numeric(parent: Group, name: str | int, count: int | None = None) -> Dataset:
    """The numeric dataset `name` with `count` rows; DatasetError where it differs or claims more bytes than it stores."""
    where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
    data = child(parent, name)
    if not isinstance(data, Dataset) or data.dtype.kind not in "biuf" or data.ndim < 1:
        raise DatasetError(f"{where} is not an array of numbers with a row for each step.")
    size = data.size * data.dtype.itemsize
    if size > max(_ALWAYS_ALLOWED_BYTES, _MAX_RATIO * data.id.get_storage_size()):
        raise DatasetError(f"{where} claims {size} bytes but the file does not hold them; restore it from a copy.")
    if count is not None and len(data) != count:
        raise DatasetError(f"{where} has {len(data)} rows where {count} are needed; the file is inconsistent.")
    return data


def subgroup(parent: Group, *names: str | int) -> Group:
    """parent[name][…], which must be a group."""
    for name in names:
        item = child(parent, name)
        if not isinstance(item, Group):
            where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
            raise DatasetError(f"{where} is not a group; the file is inconsistent.")
        parent = item
    return parent


def all_datasets(parent: Group, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Dataset]]:
    """Every dataset in a group and its subgroups, with its place."""
    if len(place) > _MAX_DEPTH:
        raise DatasetError(f"{parent.file.filename} nests its groups too deep; it is damaged.")
    for name in names_in(parent):
        item = child(parent, name)
        if isinstance(item, Group):
            yield from all_datasets(item, (*place, name))
        else:
            yield (*place, name), item


def concatenated(file: File, count: int, *pieces: tuple[Place, int, int]) -> Array:
    """Rows of several datasets of `count` rows each, concatenated; pieces are (place, first row, end row). A file that is closed
    by the time rows are read is opened once more."""
    path = Path(file.filename)
    held = [numeric(subgroup(file, *names[:-1]), names[-1], count) for names, _, _ in pieces]

    def read(start: int, stop: int) -> np.ndarray:
        if not all(held):
            again = _open(path)
            held[:] = [numeric(subgroup(again, *names[:-1]), names[-1], count) for names, _, _ in pieces]
        parts, row = [], 0
        for dataset, (_, first, last) in zip(held, pieces):
            begin, end = max(start - row, 0) + first, min(stop - row + first, last)
            try:
                parts += [np.asarray(dataset[begin:end])] if begin < end else []
            except _HDF5_ERRORS as error:
                where = f"{path}{dataset.name}"
                raise DatasetError(f"{where} cannot be read ({_first_line(error)}); restore it from a copy.") from error
            row += last - first
        return np.concatenate(parts) if parts else np.asarray(held[0][:0])

    size = sum(last - first for _, first, last in pieces)
    for dataset in held[1:]:
        if dataset.shape[1:] != held[0].shape[1:]:
            raise DatasetError(f"{path}{dataset.name} has another shape than {held[0].name}; drop the episode.")
    return Array((size, *held[0].shape[1:]), held[0].dtype, read)


def array_at(file: File, place: Place, item: Dataset) -> Array:
    """A dataset of any type as an array that is read when its values are needed."""
    if item.shape is None:  # an empty dataset, which has no values at all
        return Array((), item.dtype)
    if item.dtype.kind in "biuf" and item.ndim:
        return concatenated(file, len(item), (place, 0, len(item)))
    path = Path(file.filename)

    def read(start: int, stop: int) -> np.ndarray:
        with open_file(path) as again:
            stored = child(subgroup(again, *place[:-1]), place[-1])
            if not isinstance(stored, Dataset) or stored.size * stored.dtype.itemsize > _ALWAYS_ALLOWED_BYTES:
                raise DatasetError(f"{path}, {place} is too large to be what it seems; leave it out.")
            return np.asarray(stored[start:stop] if stored.ndim else stored[()])

    return Array(item.shape, item.dtype, read)


def headers(items: Iterable[tuple[tuple[str, ...], Dataset]]) -> dict[Place, Array]:
    """Shape and dtype of datasets, without their values."""
    return {place: Array(item.shape or (), item.dtype) for place, item in items}


def read_strings(dataset: Group | Dataset) -> list[str]:
    """The strings of a dataset [n]."""
    texts = isinstance(dataset, Dataset) and dataset.dtype.kind in "OS" and dataset.ndim == 1
    if not texts or len(dataset) > 1 << 24:
        raise DatasetError(f"{dataset.file.filename}{dataset.name} holds no strings; restore it from a copy.")
    return [it.decode("utf-8", "replace") if isinstance(it, bytes) else str(it) for it in np.asarray(dataset)]


def set_attributes(item: Group, given: object) -> None:
    """Stores the text, numbers and lists of a mapping as attributes of a group."""
    for key, value in given.items() if isinstance(given, Mapping) else ():
        if isinstance(value, str | int | float | list):
            item.attrs[key] = value


def store_readings(
    parent: Group,
    targets: Mapping[str, int],
    shape: tuple[int, ...],
    sensor: Sensor,
    readings: Readings,
    where: str,
    dtype: str = "",
) -> None:
    """Writes a sensor's readings as datasets of `shape`; targets: dataset name -> index of its first reading."""
    packed = {"chunks": (1, *shape[1:]), "compression": "gzip", "compression_opts": 1}
    more = packed if sensor.kind != "vector" else {}
    made = {parent.create_dataset(name, shape, dtype or sensor.dtype, **more): at for name, at in targets.items()}
    row = 0
    for part in rows.batches(readings.values, sensor, where, min(len(readings.values), shape[0] + max(made.values()))):
        stored = rows.to_stored(part, sensor).reshape(len(part), *shape[1:])
        for dataset, first in made.items():
            begin, end = max(row, first), min(row + len(part), first + shape[0])
            if begin < end:
                dataset[begin - first : end - first] = stored[begin - row : end - row]
        row += len(part)


def _first_line(error: BaseException) -> str:
    return (str(error).strip('"').splitlines() or [type(error).__name__])[0]


def attributes(item: Group, without: Sequence[str] = ()) -> dict[str, object]:
    """The attributes that JSON can represent, apart from those named in `without`."""
    values = {}
    for name in item.attrs:
        if name not in without:
            with suppress(*_HDF5_ERRORS):
                values[name] = rows.json_or_none(item.attrs[name])
    return {name: value for name, value in values.items() if value is not None}


def json_attribute(item: Group, name: str) -> dict:
    """The attribute as a JSON object; {} where it is missing or not an object."""
    return json_object(attributes(item).get(name))


def json_object(text: object) -> dict:
    """The JSON object in a text; {} where it is not one."""
    try:
        value = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
