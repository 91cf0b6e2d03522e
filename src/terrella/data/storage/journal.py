"""Journal: an append-only log of readings that a kill, a power cut or a full disk can only shorten, never corrupt.

Each record is its length, the CRC-32 of what follows, and the payload: the number of a sensor, its time, and its raw
numbers. Reading stops at the first record that is cut or does not match, so a torn tail costs that record alone.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

_HEAD, _STAMP = struct.Struct("<II"), struct.Struct("<Hd")
_LIMIT = 1 << 30  # bytes of one record; more is damage


class Journal:
    """Appends readings to a new file; every append reaches the operating system before it returns."""

    def __init__(self, path: Path, about: Mapping[str, object]):
        """`about` (JSON values) is kept as the first record."""
        self._file = open(path, "wb", buffering=0)
        self._append(json.dumps(about).encode())

    def add(self, sensor: int, time_s: float, *values: bytes | np.ndarray) -> None:
        """One reading of a sensor, as raw bytes one after another."""
        raw = [value if isinstance(value, bytes) else np.ascontiguousarray(value).tobytes() for value in values]
        self._append(_STAMP.pack(sensor, time_s) + b"".join(raw))

    def _append(self, payload: bytes) -> None:
        data = memoryview(_HEAD.pack(len(payload), zlib.crc32(payload)) + payload)
        while data:  # an unbuffered write may take a part
            data = data[self._file.write(data) :]

    def close(self) -> None:
        self._file.close()


def about(path: Path) -> dict:
    """What the journal says of itself; ValueError where not even that is whole."""
    for payload in _records(path):
        found = json.loads(payload)
        if isinstance(found, dict):
            return found
    raise ValueError(f"{path} holds no whole record")


def readings(path: Path) -> Iterator[tuple[int, float, bytes]]:
    """(sensor, time_s, raw) of every whole record, in the order written."""
    records = _records(path)
    next(records, None)  # `about`
    for payload in records:
        if len(payload) < _STAMP.size:
            return
        sensor, time_s = _STAMP.unpack_from(payload)
        yield sensor, time_s, payload[_STAMP.size :]


def _records(path: Path) -> Iterator[bytes]:
    with open(path, "rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            if length < 2 or length > _LIMIT:
                return
            payload = file.read(length)
            if len(payload) < length or zlib.crc32(payload) != checksum:
                return
            yield payload
