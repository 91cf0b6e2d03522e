"""Footer and pages of a parquet file, read before anything is unpacked: what pages claim must be what the footer says.

pyarrow's own view of a column's metadata ends the process where the footer is damaged, so the footer is read here.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from . import thrift

DATA, INDEX, DICTIONARY, DATA_V2 = range(4)
_FIELD = {DATA: 5, DICTIONARY: 7, DATA_V2: 8}  # where a page header keeps what is special to its type
_PLAIN, _DICTIONARIES, _DELTA_LENGTHS = 0, (2, 8), 6
_HEADER = 1 << 10  # bytes looked at for a header; more where it does not end there
_LONGEST_HEADER = 1 << 24
_SLACK = 1 << 16  # bytes that headers may be counted for or not
_LONGEST_FOOTER = 256 << 20
_INT64, _TEXTS = 2, (6, 7)  # physical types
_MAGIC = b"PAR1"


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a row group as the footer tells of it. least, most: of whole numbers, None where it does not say."""

    path: str
    kind: int
    values: int
    packed: int
    unpacked: int
    at: int
    least: int | None
    most: int | None


@dataclass(frozen=True, slots=True)
class Group:
    """A row group."""

    rows: int
    columns: tuple[Column, ...]


@dataclass(frozen=True, slots=True)
class Footer:
    """rows: in all; groups: of rows."""

    rows: int
    groups: tuple[Group, ...]


def footer(path: Path) -> Footer:
    """What the file's footer says; ValueError where there is none, OSError where there is no file."""
    about = os.stat(path)
    return _footer(str(path), about.st_size, about.st_mtime_ns)


@lru_cache(64)
def _footer(path: str, size: int, _changed_ns: int) -> Footer:
    with open(path, "rb") as file:
        file.seek(max(0, size - 8))
        tail = file.read(8)
        length = int.from_bytes(tail[:4], "little")
        if size < 12 or tail[4:] != _MAGIC:
            raise ValueError("it has no footer")
        if length > min(size - 12, _LONGEST_FOOTER):
            raise ValueError("its footer is longer than the file")
        file.seek(size - 8 - length)
        data = file.read(length)
    try:
        fields, _ = thrift.read_struct(data)
        groups = tuple(_group(group) for group in _items(fields, 4))
        found = Footer(_whole(fields, 3), groups)
    except (IndexError, TypeError, KeyError, AttributeError, UnicodeDecodeError, struct.error) as error:
        raise ValueError(f"its footer is damaged ({error})") from error
    if found.rows < 0 or sum(group.rows for group in groups) != found.rows or any(group.rows < 0 for group in groups):
        raise ValueError(f"its footer claims {found.rows:,} rows, its row groups others")
    return found


def _group(fields: thrift.Struct) -> Group:
    return Group(_whole(fields, 3), tuple(_column(column[3][1]) for column in _items(fields, 1)))


def _column(fields: thrift.Struct) -> Column:
    kind = _whole(fields, 1)
    at, dictionary = _whole(fields, 9), fields.get(11, (0, 0))[1]
    said = fields.get(12, (0, {}))[1]
    least, most = (_int64(said, field) if kind == _INT64 else None for field in (6, 5))
    name = ".".join(part.decode() for part in _items(fields, 3))
    first = min(at, dictionary) if isinstance(dictionary, int) and dictionary > 0 else at
    return Column(name, kind, _whole(fields, 5), _whole(fields, 7), _whole(fields, 6), first, least, most)


def _whole(fields: thrift.Struct, field: int) -> int:
    value = fields[field][1]
    if not isinstance(value, int):
        raise ValueError(f"field {field} is no number")
    return value


def _items(fields: thrift.Struct, field: int) -> list:
    value = fields[field][1]
    if not isinstance(value, tuple):
        raise ValueError(f"field {field} is no list")
    return value[1]


def _int64(said: object, field: int) -> int | None:
    raw = said.get(field, (0, None))[1] if isinstance(said, dict) else None
    return int.from_bytes(raw, "little", signed=True) if isinstance(raw, bytes) and len(raw) == 8 else None


@dataclass(frozen=True)
class Page:
    """kind: DATA, DICTIONARY or DATA_V2; at: first byte of its header; values, packed and unpacked bytes as it claims."""

    kind: int
    at: int
    header: int
    packed: int
    unpacked: int
    values: int
    encoding: int

    @property
    def end(self) -> int:
        return self.at + self.header + self.packed


def page_at(file: BinaryIO, at: int) -> Page:
    """The page whose header begins at byte `at`; ValueError where none does."""
    size = _HEADER
    while True:
        file.seek(at)
        data = file.read(size)
        try:
            told, length = thrift.read_struct(data)
            break
        except IndexError:
            if len(data) < size or size > _LONGEST_HEADER:
                raise ValueError(f"no page begins at byte {at}") from None
            size *= 16
    kind = _number(told, 1)
    if kind not in (DATA, INDEX, DICTIONARY, DATA_V2):
        raise ValueError(f"no page begins at byte {at}")
    about = told.get(_FIELD.get(kind, 0), (thrift.STRUCT, {}))[1]
    values, encoding = (_number(about, 1), _number(about, 4 if kind == DATA_V2 else 2)) if about else (0, 0)
    page = Page(kind, at, length, _number(told, 3), _number(told, 2), values, encoding)
    if min(page.packed, page.unpacked, page.values) < 0:
        raise ValueError(f"the page at byte {at} claims less than nothing")
    return page


def _number(told: object, field: int) -> int:
    kind, value = told.get(field, (0, None)) if isinstance(told, dict) else (0, None)
    if kind != thrift.I32 or not isinstance(value, int):
        raise ValueError(f"a page header lacks its field {field}")
    return value


def largest(path: Path, groups: Iterable[Group], columns: set[str] | None) -> tuple[int, int]:
    """(bytes that the columns of these row groups may unpack to, bytes that one value may take); columns by top name.

    ValueError where a page lies outside its column, or its column's pages hold another number of values or of bytes
    than the footer says.
    """
    total, widest = 0, 8
    with open(path, "rb") as file:
        for group in groups:
            for column in group.columns:
                if columns is not None and column.path.split(".")[0] not in columns:
                    continue
                pages = list(_pages(file, column))
                total += 16 * column.values  # a number, or the length of a text, and where it lies in its list
                if column.kind in _TEXTS:
                    texts, longest = _texts(pages)
                    total += texts
                    widest = max(widest, longest)
    return total, widest


def _pages(file: BinaryIO, column: Column) -> Iterator[Page]:
    at, end, values, unpacked = column.at, column.at + column.packed, 0, 0
    if at < 4 or column.values < 0 or column.packed < 0:
        raise ValueError(f"column '{column.path}' lies nowhere")
    while at < end and values < column.values:
        page = page_at(file, at)
        at = page.end
        values += page.values if page.kind != DICTIONARY else 0
        unpacked += page.unpacked
        if at > end or values > column.values or unpacked > column.unpacked + _SLACK:
            raise ValueError(f"column '{column.path}' claims more than the footer says")
        yield page
    if values != column.values:
        raise ValueError(f"column '{column.path}' has {values} of its {column.values} values")


def _texts(pages: list[Page]) -> tuple[int, int]:
    """(bytes of all values, bytes of one value) at most: a dictionary's or a prefix's text counts for each that refers to it."""
    dictionary = max((page.unpacked for page in pages if page.kind == DICTIONARY), default=0)
    total = 0
    for page in pages:
        if page.kind == DICTIONARY or page.encoding in (_PLAIN, _DELTA_LENGTHS):
            total += page.unpacked
        else:
            total += page.values * (dictionary if page.encoding in _DICTIONARIES else page.unpacked)
    return total, max((page.unpacked for page in pages), default=0)
