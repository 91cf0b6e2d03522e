"""Reading tables and JSON that may be damaged or hostile: nothing is decoded before its size has been found sane."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ...core.errors import DatasetError
from ..format import to_numpy
from .pages import Footer, Group, footer, largest

_SLACK = 1 << 20  # bytes that any column may take beyond its numbers
_LARGEST = 4 << 30  # bytes that one reading may unpack to
_REPEATED = 1 << 30  # the same, of texts that repeat one another
_LARGEST_JSON = 256 << 20  # bytes; stats.json of many cameras is long, but not so long
_BATCH = 64 << 20  # bytes that one batch of `batches` may unpack to
_ROWS_A_BYTE = 64  # more rows than these for each byte of a file are a bomb: at least their counters differ
_BYTES_A_BYTE = 1000
_FEW_ROWS = 1_000_000
_BROKEN = (OSError, pa.ArrowException, ValueError, KeyError, TypeError, OverflowError, RuntimeError)


def read_whole(path: Path, columns: list[str] | None = None, most_rows: int | None = None) -> pa.Table:
    """A parquet file's columns (nested ones by their path); DatasetError where it is missing, damaged or far too large."""
    try:
        told = footer(path)
        if most_rows is not None and told.rows > most_rows:
            raise ValueError(f"it claims {told.rows:,} rows where at most {most_rows:,} can be")
        with open_parquet(path) as file:
            return _unpacked(path, file, told, range(len(told.groups)), columns)
    except _BROKEN as error:
        raise _damaged(path, error) from error


def read_rows(
    path: Path, columns: list[str], start: int, stop: int, features: Mapping[str, dict]
) -> dict[str, pa.ChunkedArray]:
    """Columns of the rows `start` to `stop` (by the column "index") of a data file that may hold many episodes."""
    try:
        told = footer(path)
        groups = [at for at, group in enumerate(told.groups) if _may_hold(group, start, stop)]
        for at in groups:
            _promised(told.groups[at], columns, features)
        with open_parquet(path) as file:
            table = _unpacked(path, file, told, groups, ["index", *columns])
        index = table["index"].to_numpy()
        if len(index) != stop - start or not np.array_equal(index, np.arange(start, stop)):
            inside = (index >= start) & (index < stop)
            table = table.filter(pa.array(inside))
            if inside.sum() != stop - start or not np.array_equal(index[inside], np.arange(start, stop)):
                raise ValueError(
                    f"it has {int(inside.sum())} of the {stop - start} rows from {start} on, or they are moved"
                )
        return {name: table[name] for name in columns}
    except _BROKEN as error:
        raise _damaged(path, error) from error


def batches(
    path: Path, features: Mapping[str, dict], columns: Sequence[str]
) -> Iterator[tuple[int, int, pa.Table | DatasetError]]:
    """(first row, rows, table) of a data file piece after piece, the largest of some megabytes; DatasetError where it is broken.

    A piece that cannot be read is given as the error itself, and reading goes on with the next row group.
    """
    try:
        told = footer(path)
        if told.rows > max(_FEW_ROWS, _ROWS_A_BYTE * path.stat().st_size):
            raise ValueError(f"it claims {told.rows:,} rows in {path.stat().st_size:,} bytes")
        file = open_parquet(path)
    except _BROKEN as error:
        raise _damaged(path, error) from error
    with file:
        at = 0
        for number, group in enumerate(told.groups):
            done = 0
            try:
                _promised(group, columns, features)
                size, widest = largest(path, [group], _tops(columns))
                if size > max(_LARGEST, _BYTES_A_BYTE * path.stat().st_size):
                    raise ValueError(f"it unpacks to {size:,} bytes")
                step = group.rows if size <= _BATCH else min(_BATCH * group.rows // size, _BATCH // widest)
                for batch in file.iter_batches(max(1, step), row_groups=[number], columns=list(columns)):
                    if batch.num_rows:
                        yield at + done, batch.num_rows, pa.Table.from_batches([batch])
                    done += batch.num_rows
                if done < group.rows:
                    raise ValueError(f"{group.rows - done} rows are missing")
            except _BROKEN as error:
                yield at + done, max(0, group.rows - done), _damaged(path, error)
            at += group.rows


def open_parquet(path: Path) -> pq.ParquetFile:
    """The file, its pages checked against their checksums where it has some; ValueError where its footer is damaged."""
    footer(path)
    return pq.ParquetFile(path, page_checksum_verification=True)


def _unpacked(
    path: Path, file: pq.ParquetFile, told: Footer, groups: Sequence[int], columns: list[str] | None
) -> pa.Table:
    """Whole row groups; ValueError where they unpack to more than _LARGEST."""
    size, widest = largest(path, [told.groups[at] for at in groups], None if columns is None else _tops(columns))
    if size <= _LARGEST:
        return file.read_row_groups(groups, columns=columns)
    parts, total = [], 0
    for batch in file.iter_batches(max(1, _BATCH // widest), row_groups=groups, columns=columns):
        total += batch.nbytes
        if total > _REPEATED:
            raise ValueError(f"it unpacks to more than {_REPEATED:,} bytes")
        parts.append(batch)
    return pa.Table.from_batches(parts, parts[0].schema if parts else file.schema_arrow)


def _tops(columns: Sequence[str]) -> set[str]:
    return {name.split(".")[0] for name in columns}


def _may_hold(group: Group, start: int, stop: int) -> bool:
    """Whether the row group may hold those rows, by the statistics of "index"; where they say nothing it may."""
    for column in group.columns:
        if column.path == "index" and column.least is not None and column.most is not None:
            return column.least < stop and column.most >= start
    return True


def _promised(group: Group, columns: Collection[str], features: Mapping[str, dict]) -> None:
    """ValueError where the group holds another number of values than its rows and the features' shapes give."""
    for column in group.columns:
        name = _top(column.path, features)
        if name not in columns:
            continue
        dtype, numbers = features[name]["dtype"], math.prod(features[name]["shape"])
        if column.values != group.rows * (1 if dtype in ("image", "string") else numbers):
            raise ValueError(f"column '{name}' holds {column.values:,} numbers in {group.rows:,} rows")
        if dtype == "image":
            most = group.rows * (numbers * 2 + 65536)
        else:
            most = _LARGEST if dtype == "string" else column.values * 16
        if column.unpacked > most + _SLACK:
            raise ValueError(f"column '{name}' claims {column.unpacked:,} bytes")


def _top(path: str, features: Mapping[str, dict]) -> str:
    """The feature that a leaf of the schema belongs to: "action.list.element" is of "action"."""
    if path in features:
        return path
    for part in (".list.", ".bytes", ".path"):
        if part in path and path.split(part)[0] in features:
            return path.split(part)[0]
    return path.rsplit(".list", 1)[0]


def _damaged(path: Path, error: BaseException) -> DatasetError:
    short = (str(error).splitlines() or [type(error).__name__])[0][:300]
    return DatasetError(
        f"the table {path} is missing, truncated or not parquet ({short}); restore it from a copy, or remove its episode."
    )


def read_json(path: Path) -> object:
    """What a JSON file holds; OSError where it is missing, ValueError where it is damaged, huge or nested without end."""
    if path.stat().st_size > _LARGEST_JSON:
        raise ValueError(f"it has {path.stat().st_size:,} bytes")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


class ValuesOf(Sequence):
    """The lists of numbers of one column, each a numpy array, read row group by row group when they are looked at."""

    def __init__(self, path: Path, column: str, count: int, first: int = 0):
        self._path, self._column, self._count, self._first = path, column, count, first
        self._starts = np.cumsum([0, *(group.rows for group in _told(path).groups)])
        self._open = -1
        self._group: pa.ChunkedArray | None = None

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):
        if not -self._count <= index < self._count:
            raise IndexError(index)
        row = self._first + int(index) % self._count
        group = int(np.searchsorted(self._starts, row, side="right")) - 1
        if group != self._open:
            self._group, self._open = self._read(group), group
        return self._value(row - int(self._starts[group]))

    def _read(self, group: int):
        try:
            with open_parquet(self._path) as file:
                return _unpacked(self._path, file, _told(self._path), [group], [self._column])[self._column]
        except _BROKEN as error:
            raise _damaged(self._path, error) from error

    def _value(self, row: int):
        assert self._group is not None
        try:
            return self._group[row].values.to_numpy(zero_copy_only=False)
        except (AttributeError, IndexError, TypeError) as error:
            raise _damaged(self._path, error) from error


class RowsOf(ValuesOf):
    """One feature of the rows `start` to `stop` (by the column "index"): arrays of its shape, pictures as they are kept."""

    def __init__(self, path: Path, column: str, start: int, stop: int, features: Mapping[str, dict]):
        index = read_whole(path, ["index"])["index"].to_numpy()
        first = int(np.argmax(index == start)) if len(index) else 0
        there = index[first : first + stop - start]
        if len(there) != stop - start or not np.array_equal(there, np.arange(start, stop)):
            raise _damaged(path, ValueError(f"it lacks rows of {start} to {stop - 1}, or they are moved"))
        self._features, self._shape = features, tuple(features[column]["shape"])
        super().__init__(path, column, stop - start, first)

    def _read(self, group: int):
        try:
            _promised(_told(self._path).groups[group], [self._column], self._features)
            column = super()._read(group)
            return column if self._features[self._column]["dtype"] == "image" else to_numpy(column, self._shape)
        except (ValueError, TypeError, NotImplementedError) as error:
            raise _damaged(self._path, error) from error

    def _value(self, row: int):
        value: Any = self._group
        return value[row] if isinstance(value, np.ndarray) else value[row].as_py()


def _told(path: Path) -> Footer:
    try:
        return footer(path)
    except _BROKEN as error:
        raise _damaged(path, error) from error
