"""How Minari keeps one episode on the disk: as a group of main_data.hdf5, or as a folder with an Arrow or Parquet table."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Lazy, Sensor
from . import rows

Place = tuple[str | int, ...]  # ("observations", "agent", 0): keys of Dicts and indices of Tuples
INFOS_DEEPEST = 8


class Episode(Protocol):
    """One episode as it is stored."""

    def steps(self) -> int:
        """How many rewards there are."""
        ...

    def infos(self) -> dict[tuple[str, ...], tuple[tuple[int, ...], np.dtype]]:
        """Place below `infos` -> shape and dtype of each array of numbers there that has a row for each step."""
        ...

    def values(self, place: Place, sensor: Sensor, count: int) -> np.ndarray | Lazy:
        """`count` values of the sensor; pictures are decoded when looked at."""
        ...

    def texts(self, place: Place) -> list[str]:
        """The texts of a Text space."""
        ...

    def facts(self) -> dict[str, object]:
        """What is known of the episode: its seed, sums of its rewards, …"""
        ...


def open_storage(data: Path, kind: object, count: int) -> Callable[[int], Episode]:
    """Opener of episode i of `count`; DatasetError where the storage is missing or of an unknown kind."""
    if kind == "hdf5":
        from .minari_hdf5 import Hdf5Episode

        if not (data / "main_data.hdf5").is_file():
            raise DatasetError(f"{data / 'main_data.hdf5'} is missing; restore it from a copy.")
        return lambda number: Hdf5Episode(data / "main_data.hdf5", number)
    if kind in ("arrow", "parquet"):
        return lambda number: TableEpisode(data / str(number), str(kind))
    raise DatasetError(f"{data} keeps its data as '{kind}'; only hdf5, arrow and parquet are known.")


def decode_jpeg(data: bytes, sensor: Sensor, where: str) -> np.ndarray:
    """One value of the sensor from a JPEG; DatasetError where it is damaged or of another size."""
    shape = rows.stored_shape(sensor)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG",)) as picture:
            if (picture.height, picture.width) != shape[:2] or len(picture.getbands()) != math.prod(shape[2:]):
                size = [picture.height, picture.width, len(picture.getbands())]
                raise DatasetError(f"{where} is a picture of {size} where the space says {list(shape)}.")
            return rows.from_stored(np.asarray(picture, np.uint8)[None], sensor)[0]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise DatasetError(f"{where} is a damaged JPEG ({error}); restore the file from a copy.") from error


class TableEpisode:
    """A folder with part-0.arrow (or .parquet): one row an observation, the last row's action is padding; and metadata.json."""

    def __init__(self, folder: Path, kind: str):
        self._folder = folder
        parts = sorted(folder.glob(f"*.{kind}"), key=rows.natural)
        if not parts:
            raise DatasetError(f"{folder} has no .{kind} file; restore the episode from a copy.")
        try:
            tables = [_arrow(part) if kind == "arrow" else _parquet(part) for part in parts]
            table = tables[0] if len(tables) == 1 else pa.concat_tables(tables)
            table.validate(full=True)
            self._columns = {name: table.column(name).combine_chunks() for name in table.column_names}
        except (pa.ArrowException, OSError, ValueError, KeyError, MemoryError) as error:
            raise DatasetError(
                f"{folder} cannot be read ({str(error)[:200]}); restore the episode from a copy."
            ) from error
        self._rows = table.num_rows
        if not self._rows or "observations" not in self._columns or "rewards" not in self._columns:
            raise DatasetError(f"{folder} has no observations and rewards; restore the episode from a copy.")

    def steps(self) -> int:
        return self._rows - 1

    def infos(self) -> dict[tuple[str, ...], tuple[tuple[int, ...], np.dtype]]:
        found = {}
        if "infos" in self._columns:
            for place, field in _info_fields(self._columns["infos"].type, ()):
                kind = field.type.value_type if pa.types.is_fixed_size_list(field.type) else field.type
                if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
                    size = (field.type.list_size,) if pa.types.is_fixed_size_list(field.type) else ()
                    stated = (field.metadata or {}).get(b"shape")  # "2,3", or nothing where a row is one number
                    shape = (
                        size if stated is None else tuple(int(part) for part in stated.split(b",") if part.isdigit())
                    )
                    found[place] = (shape if math.prod(shape) == math.prod(size) else size, kind.to_pandas_dtype())
        return {place: (shape, np.dtype(dtype)) for place, (shape, dtype) in found.items()}

    def values(self, place: Place, sensor: Sensor, count: int) -> np.ndarray | Lazy:
        array, where = self._array(place), f"{self._folder}, {'/'.join(map(str, place))}"
        if not count <= len(array) <= count + 1:
            raise DatasetError(f"{where} has {len(array)} rows where {count} are needed; the episode is inconsistent.")
        array = array.slice(0, count)
        if array.null_count:
            raise DatasetError(f"{where} has empty rows; restore the episode from a copy.")
        if pa.types.is_binary(array.type) or pa.types.is_large_binary(array.type):
            pictures = Lazy(count, lambda i: decode_jpeg(array[i].as_py(), sensor, f"{where}, row {i}"))
            return pictures if sensor.kind != "vector" else np.stack(list(pictures))
        flat = array.flatten() if pa.types.is_fixed_size_list(array.type) else array
        shape = rows.stored_shape(sensor)
        if not (pa.types.is_integer(flat.type) or pa.types.is_floating(flat.type) or pa.types.is_boolean(flat.type)):
            raise DatasetError(
                f"{where} is {str(array.type)[:80]}, not an array of numbers; the spaces are of another dataset."
            )
        if flat.null_count or len(flat) != count * math.prod(shape):
            raise DatasetError(f"{where} has {len(flat)} numbers where {count} x {list(shape)} are needed.")
        stored = flat.to_numpy(zero_copy_only=False).reshape(count, *shape)
        if sensor.kind == "vector":
            return rows.from_stored(stored.astype(sensor.dtype), sensor)
        return Lazy(count, lambda i: rows.from_stored(stored[i : i + 1].astype(sensor.dtype), sensor)[0])

    def texts(self, place: Place) -> list[str]:
        return [str(text) for text in self._array(place).to_pylist()]

    def facts(self) -> dict[str, object]:
        return rows.read_json(self._folder / "metadata.json", missing={})

    def _array(self, place: Place) -> pa.Array:
        array = self._columns.get(str(place[0]))
        for part in place[1:]:
            if array is None or not pa.types.is_struct(array.type) or array.type.get_field_index(str(part)) < 0:
                array = None
                break
            array = array.field(str(part))
        if array is None:
            raise DatasetError(f"{self._folder} has no {'/'.join(map(str, place))}; restore the episode from a copy.")
        return array


def _info_fields(kind: pa.DataType, place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], pa.Field]]:
    if pa.types.is_struct(kind) and len(place) < INFOS_DEEPEST:
        for i in range(kind.num_fields):
            here = (*place, kind.field(i).name)
            if pa.types.is_struct(kind.field(i).type):
                yield from _info_fields(kind.field(i).type, here)
            else:
                yield here, kind.field(i)


def _arrow(path: Path) -> pa.Table:
    return pa.ipc.open_file(pa.memory_map(str(path))).read_all()


def _parquet(path: Path) -> pa.Table:
    with pq.ParquetFile(path) as file:
        width = sum(_width(field.type) for field in file.schema_arrow)
        if file.metadata.num_rows * width > rows.MOST_BYTES:
            raise DatasetError(f"{path} claims {file.metadata.num_rows} rows; restore it from a copy.")
        return file.read()


def _width(kind: pa.DataType) -> int:
    """Bytes of a row at least."""
    if pa.types.is_struct(kind):
        return sum(_width(kind.field(i).type) for i in range(kind.num_fields))
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _width(kind.value_type)
    return max(1, kind.bit_width // 8) if pa.types.is_primitive(kind) else 1


def joined(place: Sequence[str | int]) -> str:
    """A place as a part of a sensor's name."""
    return ".".join(rows.clean(part) for name in place for part in str(name).split("."))
