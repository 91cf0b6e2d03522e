"""Reading tables that may be damaged or hostile piece by piece: nothing is decoded before its size has been found sane."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ..core.errors import DatasetError
from ..data.storage.tables import BROKEN, damaged
from .pages import Footer, Group, footer, largest

_SLACK = 1 << 20  # bytes that any column may take beyond its numbers
_LARGEST = 4 << 30  # bytes that one reading may unpack to
_REPEATED = 1 << 30  # the same, of texts that repeat one another
_BATCH = 64 << 20  # bytes that one batch of `batches` may unpack to
_ROWS_A_BYTE = 64  # more rows than these for each byte of a file are a bomb: at least their counters differ
_BYTES_A_BYTE = 1000
_FEW_ROWS = 1_000_000


def read_whole(path: Path, columns: list[str] | None = None, most_rows: int | None = None) -> pa.Table:
    """A parquet file's columns (nested ones by their path); DatasetError where it is missing, damaged or far too large."""
    try:
        told = footer(path)
        if most_rows is not None and told.rows > most_rows:
            raise ValueError(f"it claims {told.rows:,} rows where at most {most_rows:,} can be")
        with open_parquet(path) as file:
            return _unpacked(path, file, told, range(len(told.groups)), columns)
    except BROKEN as error:
        raise damaged(path, error) from error


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
    except BROKEN as error:
        raise damaged(path, error) from error
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
            except BROKEN as error:
                yield at + done, max(0, group.rows - done), damaged(path, error)
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
