"""Reads tables and JSON with pyarrow; a damaged file, or one that would fill the memory, is a clear error.

Reading the metadata of a column of a damaged file (`metadata.row_group(i).column(j)`) ends the process, so row groups are
chosen by the values of their column "index". Reading in batches bounds what a file unpacks to.
"""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ...core.errors import DatasetError
from ..format import to_numpy
from ..source import Lazy

BROKEN = (OSError, pa.ArrowException, ValueError, KeyError, TypeError, OverflowError, RuntimeError)
BATCH_BYTES = 64 << 20  # most bytes of one batch of numbers
TEXT_ROWS = 16  # rows of texts or pictures in a batch; their length is not known before
_TABLE = 64  # the same for tables with short rows
_SLACK = 64 << 20  # bytes that any read may unpack to
_LONG = 64 << 10  # further bytes for each row with texts: compressed, a text can repeat without end
_WIDEST = 64 << 20  # bytes of one reading of a stream
_LARGEST_JSON = 256 << 20  # bytes; stats.json of many cameras is long, but not so long
_ROWS_A_BYTE = 64  # more rows for each byte of a file are an attack: even their counters take space
_FEW_ROWS = 1_000_000


def read_whole(path: Path, columns: list[str] | None = None, most_rows: int | None = None) -> pa.Table:
    """A parquet file's columns (nested ones by their path); DatasetError where it is missing, damaged or far too large."""
    try:
        with open_parquet(path) as file:
            rows = file.metadata.num_rows
            if most_rows is not None and rows > most_rows:
                raise ValueError(f"it claims {rows:,} rows where at most {most_rows:,} can be")
            return _bounded(file, range(file.num_row_groups), columns, _table_step(file, columns), _LONG)
    except BROKEN as error:
        raise damaged_table(path, error) from error


def read_rows(
    path: Path, columns: list[str], start: int, stop: int, features: Mapping[str, dict]
) -> dict[str, pa.ChunkedArray]:
    """Columns of the rows `start` to `stop` (by the column "index") of a data file that may hold many episodes."""
    try:
        groups = [at for at, group in enumerate(_groups(path)) if group[1] < stop and group[2] >= start]
        with open_parquet(path) as file:
            table = _features(file, groups, ["index", *columns], features)
        index = table["index"].to_numpy()
        if len(index) != stop - start or not np.array_equal(index, np.arange(start, stop)):
            inside = (index >= start) & (index < stop)
            table = table.filter(pa.array(inside))
            if inside.sum() != stop - start or not np.array_equal(index[inside], np.arange(start, stop)):
                raise ValueError(f"it has {int(inside.sum())} of {stop - start} rows from {start} on, or they moved")
        return {name: table[name] for name in columns}
    except BROKEN as error:
        raise damaged_table(path, error) from error


def as_local(path: Path) -> str:
    """A path that pyarrow takes for no address, as it would "file:name" or "s3:name"."""
    return os.path.abspath(path)


def open_parquet(path: Path) -> pq.ParquetFile:
    """Opens a file with page checksums verified; ValueError where it claims absurdly many rows."""
    file = pq.ParquetFile(as_local(path), page_checksum_verification=True)
    if not 0 <= file.metadata.num_rows <= max(_FEW_ROWS, _ROWS_A_BYTE * os.stat(path).st_size):
        raise ValueError(f"it claims {file.metadata.num_rows:,} rows in {os.stat(path).st_size:,} bytes")
    return file


def _groups(path: Path) -> tuple[tuple[int, int, int], ...]:
    """(rows, least, greatest "index") of each row group."""
    about = os.stat(path)
    return _read_groups(str(path), about.st_size, about.st_mtime_ns)


@lru_cache(1024)
def _read_groups(path: str, _size: int, _changed_ns: int) -> tuple[tuple[int, int, int], ...]:
    groups = []
    with open_parquet(Path(path)) as file:
        for number in range(file.num_row_groups):
            try:
                index = file.read_row_group(number, columns=["index"])["index"].to_numpy()
                groups.append((len(index), int(index.min()), int(index.max())))
            except BROKEN:  # reading this group raises; the others can be read
                groups.append((0, -1, 1 << 62))
    return tuple(groups)


def _features(file: pq.ParquetFile, groups: Sequence[int], columns: list[str], features: Mapping[str, dict]):
    """Columns of a data file; ValueError where they unpack to more than their features allow."""
    wide, texts = 16, False
    for name in columns:
        dtype, shape = (features[name]["dtype"], features[name]["shape"]) if name in features else ("int64", [1])
        texts |= dtype in ("image", "string")
        wide += _LONG + 2 * math.prod(shape) if dtype in ("image", "string") else 16 * math.prod(shape)
    return _bounded(file, groups, columns, TEXT_ROWS if texts else max(1, BATCH_BYTES // wide), wide)


def _table_step(file: pq.ParquetFile, columns: list[str] | None) -> int:
    """Rows in a batch of a table that no feature describes."""
    numbers = all(
        pa.types.is_primitive(field.type) for field in file.schema_arrow if columns is None or field.name in columns
    )
    return _FEW_ROWS if numbers else _TABLE


def _bounded(file: pq.ParquetFile, groups: Iterable[int], columns: list[str] | None, step: int, wide: int) -> pa.Table:
    """Whole row groups, `step` rows at a time; ValueError where they unpack to more than `wide` bytes a row."""
    parts, rows, total = [], 0, 0
    for batch in file.iter_batches(step, row_groups=list(groups), columns=columns):
        rows, total = rows + batch.num_rows, total + batch.nbytes
        if total > _SLACK + rows * wide:
            raise ValueError(f"{rows:,} of its rows unpack to {total:,} bytes")
        parts.append(batch)
    form = parts[0].schema if parts else file.schema_arrow
    table = pa.Table.from_batches(parts, form)
    return table if parts or columns is None else table.select([name for name in columns if name in form.names])


def damaged_table(path: Path, error: BaseException) -> DatasetError:
    """The error for a table that cannot be read."""
    short = (str(error).splitlines() or [type(error).__name__])[0][:300]
    return DatasetError(
        f"the table {path} is missing, truncated or not parquet ({short}); restore it from a copy, or remove its episode."
    )


def read_json(path: Path) -> object:
    """The value in a JSON file; OSError where it is missing, ValueError where it is damaged, huge or nested too deeply."""
    if path.stat().st_size > _LARGEST_JSON:
        raise ValueError(f"it has {path.stat().st_size:,} bytes")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


class ValuesOf(Lazy):
    """The lists of numbers of one column as numpy arrays; a row group is read when one of its rows is."""

    def __init__(self, path: Path, column: str, count: int):
        super().__init__(count, self._row)
        self._path, self._column, self._first = path, column, 0
        try:
            with open_parquet(path) as file:
                rows = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        except BROKEN as error:
            raise damaged_table(path, error) from error
        self._starts = np.cumsum([0, *rows])
        self._open, self._group = -1, None

    def _row(self, index: int) -> Any:
        row = self._first + index
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        try:
            if group != self._open:
                with open_parquet(self._path) as file:
                    self._group, self._open = self._read(file, group), group
            return self._value(row - int(self._starts[group]))
        except (AttributeError, IndexError, NotImplementedError, *BROKEN) as error:
            raise damaged_table(self._path, error) from error

    def _read(self, file: pq.ParquetFile, group: int) -> Any:
        return _bounded(file, [group], [self._column], TEXT_ROWS, _WIDEST)[self._column]

    def _value(self, row: int) -> Any:
        assert self._group is not None
        return self._group[row].values.to_numpy(zero_copy_only=False)


class RowsOf(ValuesOf):
    """One feature of the rows `start` to `stop` (by the column "index"): arrays of its shape, pictures as stored."""

    def __init__(self, path: Path, column: str, start: int, stop: int, features: Mapping[str, dict]):
        super().__init__(path, column, stop - start)
        self._features, self._shape = features, tuple(features[column]["shape"])
        index = read_whole(path, ["index"])["index"].to_numpy()
        self._first = int(np.argmax(index == start)) if len(index) else 0
        stored = index[self._first : self._first + stop - start]
        if len(stored) != stop - start or not np.array_equal(stored, np.arange(start, stop)):
            raise damaged_table(path, ValueError(f"it lacks rows of {start} to {stop - 1}, or they are moved"))

    def _read(self, file: pq.ParquetFile, group: int) -> Any:
        column = _features(file, [group], [self._column], self._features)[self._column]
        return column if self._features[self._column]["dtype"] == "image" else to_numpy(column, self._shape)

    def _value(self, row: int) -> Any:
        value = self._group
        assert value is not None
        return value[row] if isinstance(value, np.ndarray) else value[row].as_py()
