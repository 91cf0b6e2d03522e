"""A new footer for a parquet file that lost its own: a recorder was killed before it wrote one, or the file was cut.

The pages still say how large they are and how many values they hold; which column each belongs to follows from their
order and from how many numbers a row of each column has. A row group of which a column is missing is given up.
"""

import io
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core.errors import DatasetError
from ..data.storage.tables import open_parquet
from . import thrift

DATA, INDEX, DICTIONARY, DATA_V2 = range(4)
_FIELD = {DATA: 5, DICTIONARY: 7, DATA_V2: 8}  # where a page header keeps what is special to its type
_HEADER = 1 << 10  # bytes looked at for a header; more where it does not end there
_LONGEST_HEADER = 1 << 24


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
            stated, length = thrift.read_struct(data)
            break
        except IndexError:
            if len(data) < size or size > _LONGEST_HEADER:
                raise ValueError(f"no page begins at byte {at}") from None
            size *= 16
    kind = _number(stated, 1)
    if kind not in (DATA, INDEX, DICTIONARY, DATA_V2):
        raise ValueError(f"no page begins at byte {at}")
    about = stated.get(_FIELD.get(kind, 0), (thrift.STRUCT, {}))[1]
    values, encoding = (_number(about, 1), _number(about, 4 if kind == DATA_V2 else 2)) if about else (0, 0)
    page = Page(kind, at, length, _number(stated, 3), _number(stated, 2), values, encoding)
    if min(page.packed, page.unpacked, page.values) < 0:
        raise ValueError(f"the page at byte {at} claims less than nothing")
    return page


def _number(stated: object, field: int) -> int:
    kind, value = stated.get(field, (0, None)) if isinstance(stated, dict) else (0, None)
    if kind != thrift.I32 or not isinstance(value, int):
        raise ValueError(f"a page header lacks its field {field}")
    return value


_MAGIC = b"PAR1"
_TYPES = ("BOOLEAN", "INT32", "INT64", "INT96", "FLOAT", "DOUBLE", "BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")  # by number
_PLAIN_CODEC, _SNAPPY, _GZIP, _BROTLI, _ZSTD, _LZ4 = 0, 1, 2, 4, 6, 7
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MOST_PAGES = 1_000_000
_MOST_TRIED = 4096  # pages of a row group's first column

Chunk = list[Page]


def rebuild_footer(path: Path, form: pa.Schema, features: Mapping[str, dict], target: Path) -> int:
    """Writes the whole row groups of `path`, of schema `form`, with a new footer to `target`; returns their rows. DatasetError
    where no row group is whole."""
    leaves, footer = _template(form)
    each = [_values_of_a_row(name, features) for name, _ in leaves]
    with open(path, "rb") as file:
        if file.read(4) != _MAGIC:
            raise DatasetError(f"{path} does not begin as parquet does; restore it from a copy.")
        groups = _groups(_pages(file), each)
        codecs = _codecs(file, groups)
    for codec in codecs:
        _write(path, target, footer, leaves, groups, each, codec)
        if _readable(target):
            return sum(_rows(group, each) for group in groups)
    raise DatasetError(f"no row group of {path} is whole; restore it from a copy.")


def _template(form: pa.Schema) -> tuple[list[tuple[str, str]], thrift.Struct]:
    """((path, type) of each column of numbers, footer) of an empty file of that schema."""
    buffer = io.BytesIO()
    pq.write_table(form.empty_table(), buffer)
    raw = buffer.getvalue()
    footer, _ = thrift.read_struct(raw[-8 - int.from_bytes(raw[-8:-4], "little") : -8])
    columns = pq.ParquetFile(io.BytesIO(raw)).schema
    return [(columns.column(i).path, columns.column(i).physical_type) for i in range(len(columns.names))], footer


def _values_of_a_row(path: str, features: Mapping[str, dict]) -> int:
    for name, feature in features.items():
        if path == name or path.startswith(f"{name}."):
            return 1 if feature["dtype"] in ("image", "string") else int(np.prod(feature["shape"]))
    return 1


def _pages(file: BinaryIO) -> list[Page]:
    """All pages from the start on, up to the first that is cut or is none."""
    size, at, pages = file.seek(0, 2), 4, []
    while at < size and len(pages) < _MOST_PAGES:
        try:
            page = page_at(file, at)
        except (ValueError, IndexError):
            break
        if page.end > size or page.kind not in (DATA, DATA_V2, DICTIONARY) or page.end == at:
            break
        pages.append(page)
        at = page.end
    return pages


def _groups(pages: list[Page], each: list[int]) -> list[list[Chunk]]:
    """The pages as row groups of one chunk for each column, up to the last group that is whole."""
    groups, at = [], 0
    while at < len(pages):
        group = _group(pages, at, each)
        if group is None:
            break
        groups.append(group)
        at += sum(map(len, group))
    return groups


def _group(pages: list[Page], at: int, each: list[int]) -> list[Chunk] | None:
    """The smallest row group that begins at page `at` in which every column has the same number of rows."""
    values = 0
    for page in pages[at : at + _MOST_TRIED]:
        values += page.values if page.kind != DICTIONARY else 0
        if values and values % each[0] == 0:
            group = _chunks(pages, at, values // each[0], each)
            if group is not None:
                return group
    return None


def _chunks(pages: list[Page], at: int, rows: int, each: list[int]) -> list[Chunk] | None:
    chunks = []
    for values in each:
        chunk, left = [], rows * values
        while left > 0:
            if at == len(pages) or (pages[at].kind == DICTIONARY and chunk):
                return None
            chunk.append(pages[at])
            left -= pages[at].values if pages[at].kind != DICTIONARY else 0
            at += 1
        if left:
            return None
        chunks.append(chunk)
    return chunks


def _rows(group: list[Chunk], each: list[int]) -> int:
    return sum(page.values for page in group[0] if page.kind != DICTIONARY) // each[0]


def _codecs(file: BinaryIO, groups: list[list[Chunk]]) -> list[int]:
    """How the pages may be packed, the likeliest first: nothing but the footer says it."""
    for group in groups:
        for page in (page for chunk in group for page in chunk if page.packed > 4):
            file.seek(page.at + page.header)
            if file.read(4) == _ZSTD_MAGIC:
                return [_ZSTD]
    packed = any(page.packed != page.unpacked for group in groups for chunk in group for page in chunk)
    return ([_SNAPPY, _LZ4, _GZIP, _BROTLI] if packed else [_PLAIN_CODEC]) if groups else []


def _write(
    path: Path, target: Path, footer: thrift.Struct, leaves, groups: list[list[Chunk]], each, codec: int
) -> None:
    described = [_footer_group(group, leaves, _rows(group, each), codec) for group in groups]
    rows = sum(_rows(group, each) for group in groups)
    raw = thrift.write_struct({**footer, 3: (thrift.I64, rows), 4: (thrift.LIST, (thrift.STRUCT, described))})
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)
    with open(target, "r+b") as file:
        file.seek(groups[-1][-1][-1].end)
        file.truncate()
        file.write(raw + len(raw).to_bytes(4, "little") + _MAGIC)


def _footer_group(group: list[Chunk], leaves: list[tuple[str, str]], rows: int, codec: int) -> thrift.Struct:
    columns = []
    for chunk, (path, kind) in zip(group, leaves):
        data = [page for page in chunk if page.kind != DICTIONARY]
        about: thrift.Struct = {
            1: (thrift.I32, _TYPES.index(kind)),
            2: (thrift.LIST, (thrift.I32, sorted({3, *(page.encoding for page in chunk)}))),
            3: (thrift.LIST, (thrift.BINARY, [part.encode() for part in _parts(path)])), 4: (thrift.I32, codec),
            5: (thrift.I64, sum(page.values for page in data)),
            6: (thrift.I64, sum(page.header + page.unpacked for page in chunk)),
            7: (thrift.I64, chunk[-1].end - chunk[0].at), 9: (thrift.I64, data[0].at),
        }  # fmt: skip
        if chunk[0].kind == DICTIONARY:
            about[11] = (thrift.I64, chunk[0].at)
        columns.append({2: (thrift.I64, chunk[0].at), 3: (thrift.STRUCT, about)})
    size = sum(page.header + page.unpacked for chunk in group for page in chunk)
    return {1: (thrift.LIST, (thrift.STRUCT, columns)), 2: (thrift.I64, size), 3: (thrift.I64, rows)}


def _parts(path: str) -> list[str]:
    """A column's path in its parts; the names of features have dots themselves."""
    for tail in (".bytes", ".path"):
        if path.endswith(tail):
            return [path.removesuffix(tail), tail[1:]]
    name, *lists = path.split(".list.")
    return [name, *(part for each in lists for part in ("list", *each.split(".")))]


def _readable(path: Path) -> bool:
    """Whether the first row group can be read: the packing was guessed right."""
    try:
        with open_parquet(path) as file:
            return file.metadata.num_row_groups > 0 and next(file.iter_batches(16), None) is not None
    except (OSError, pa.ArrowException, ValueError):
        return False
