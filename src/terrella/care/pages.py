"""The pages of a parquet file as their own headers tell of them, without the footer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import BinaryIO

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
