"""How Minari stores an episode: as a group of main_data.hdf5, or as a folder with an Arrow or Parquet table."""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ...core.errors import DatasetError
from ...data.storage.tables import as_local
from . import rows
from .arrays import Array, Place, Shapes, jpeg_rows, spelled

_MAX_DEPTH = 16


class StoredEpisode(Protocol):
    """One stored episode."""

    def arrays(self, shapes: Shapes) -> dict[Place, Array]:
        """Every array with rows; JPEG pictures are decoded when they are read."""
        ...

    def headers(self, shapes: Shapes) -> dict[Place, Array]:
        """`arrays` without the values."""
        ...

    def texts(self, place: Place) -> list[str]:
        """The strings of a Text space, one per row."""
        ...

    def facts(self) -> dict[str, object]:
        """The metadata of the episode: its seed, sum of rewards, …"""
        ...


def open_storage(data: Path, kind: object, count: int) -> Callable[[int], StoredEpisode]:
    """A function that opens episode i of `count`; DatasetError where the storage is missing or of an unknown kind."""
    if kind == "hdf5":
        from .minari_hdf5 import Hdf5Episode  # h5py is needed for this storage alone

        if not (data / "main_data.hdf5").is_file():
            raise DatasetError(f"{data / 'main_data.hdf5'} is missing; restore it from a copy.")
        return lambda number: Hdf5Episode(data / "main_data.hdf5", number)
    if kind in ("arrow", "parquet"):
        return lambda number: TableEpisode(data / str(number), str(kind))
    raise DatasetError(f"{data} keeps its data as '{kind}'; only hdf5, arrow and parquet are known.")


class TableEpisode:
    """A folder with metadata.json and part-0.arrow (or .parquet): one row per observation; the last row's action is padding."""

    def __init__(self, folder: Path, kind: str):
        self._folder, self._kind = folder, kind

    @cached_property
    def _leaves(self) -> dict[tuple[str, ...], tuple]:
        return self._opened(_arrow if self._kind == "arrow" else _parquet)

    def _opened(self, read: Callable[[Path], pa.Table]) -> dict[tuple[str, ...], tuple]:
        """The leaves of the tables that `read` reads from the files."""
        folder, kind = self._folder, self._kind
        parts = sorted(folder.glob(f"*.{kind}"), key=rows.natural)
        if not parts:
            raise DatasetError(f"{folder} has no .{kind} file; restore the episode from a copy.")
        try:
            table = pa.concat_tables(map(read, parts))
            table.validate(full=True)
            columns = {name: table.column(name).combine_chunks() for name in table.column_names}
            return {place: leaf for name, column in columns.items() for place, leaf in _leaves(column, (name,))}
        except (pa.ArrowException, OSError, ValueError, KeyError, MemoryError) as error:
            raise DatasetError(f"{folder} cannot be read ({str(error)[:200]}); restore it from a copy.") from error

    def arrays(self, shapes: Shapes) -> dict[Place, Array]:
        return self._arrays(self._leaves, shapes)

    def headers(self, shapes: Shapes) -> dict[Place, Array]:
        schema = _arrow_schema if self._kind == "arrow" else _parquet_schema
        return self._arrays(self._opened(lambda path: schema(path).empty_table()), shapes)

    def _arrays(self, leaves: Mapping[tuple[str, ...], tuple], shapes: Shapes) -> dict[Place, Array]:
        known = {tuple(map(str, place)): place for place in shapes}
        arrays = {}
        for names, (array, stated) in leaves.items():
            place: Place = known.get(names) or names
            count = len(array) - (names[0] not in ("observations", "infos"))
            arrays[place] = self._array(array.slice(0, max(count, 0)), shapes.get(place, stated), spelled(names))
        return arrays

    def _array(self, array: pa.Array, shape: tuple[int, ...] | None, what: str) -> Array:
        count, where = len(array), f"{self._folder}, {what}"
        if array.null_count:
            raise DatasetError(f"{where} has empty rows; restore the episode from a copy.")
        if shape and (pa.types.is_binary(array.type) or pa.types.is_large_binary(array.type)):
            return jpeg_rows(count, shape, lambda i: array[i].as_py(), where)
        flat = array.flatten() if pa.types.is_fixed_size_list(array.type) else array
        if not _is_numeric(flat.type):
            return Array((count,), np.dtype(object))
        if flat.null_count:
            raise DatasetError(f"{where} has empty numbers; restore the episode from a copy.")
        row = (array.type.list_size,) if flat is not array else ()
        shape = shape if shape is not None and math.prod(shape) == math.prod(row) else row
        stored = flat.to_numpy(zero_copy_only=False).reshape(count, *shape)
        return Array(stored.shape, stored.dtype, lambda start, stop: stored[start:stop])

    def texts(self, place: Place) -> list[str]:
        names = tuple(map(str, place))
        if names not in self._leaves:
            raise DatasetError(f"{self._folder} has no {spelled(place)}; restore the episode from a copy.")
        return [str(text) for text in self._leaves[names][0].to_pylist()]

    def facts(self) -> dict[str, object]:
        return rows.read_json(self._folder / "metadata.json", missing={})


def _leaves(array: pa.Array, place: tuple[str, ...], metadata: Mapping | None = None) -> Iterator[tuple]:
    """(place, (array, shape of a row in its metadata)) of every field that is not a struct: "2,3", or "" for one number."""
    if pa.types.is_struct(array.type) and len(place) < _MAX_DEPTH:
        for i in range(array.type.num_fields):
            part = array.type.field(i)
            yield from _leaves(array.field(i), (*place, part.name), part.metadata)
    else:
        stated = (metadata or {}).get(b"shape")
        shape = None if stated is None else tuple(int(part) for part in stated.split(b",") if part.isdigit())
        yield place, (array, shape)


def _is_numeric(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _arrow(path: Path) -> pa.Table:
    return pa.ipc.open_file(pa.memory_map(str(path))).read_all()


def _arrow_schema(path: Path) -> pa.Schema:
    return pa.ipc.open_file(pa.memory_map(str(path))).schema


def _parquet_schema(path: Path) -> pa.Schema:
    with pq.ParquetFile(as_local(path)) as file:
        return file.schema_arrow


def _parquet(path: Path) -> pa.Table:
    with pq.ParquetFile(as_local(path)) as file:
        if file.metadata.num_rows * sum(_width(field.type) for field in file.schema_arrow) > rows.MAX_BYTES:
            raise DatasetError(f"{path} claims {file.metadata.num_rows} rows; restore it from a copy.")
        return file.read()


def _width(kind: pa.DataType) -> int:
    """The fewest bytes that a row takes."""
    if pa.types.is_struct(kind):
        return sum(_width(kind.field(i).type) for i in range(kind.num_fields))
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _width(kind.value_type)
    return max(1, kind.bit_width // 8) if pa.types.is_primitive(kind) else 1
