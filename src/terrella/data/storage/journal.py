"""Journal: an append-only log of readings. A kill, a power cut or a full disk can shorten it but not corrupt it.

A record is its length, the CRC-32 of its payload, and the payload: sensor number, time, raw values. Reading stops at the
first record that is cut or does not match its checksum, so a torn tail loses that record alone.
"""

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
        """`about` (JSON values) becomes the first record."""
        self._file = open(path, "wb", buffering=0)
        self._append(json.dumps(about).encode())

    def add(self, sensor: int, time_s: float, *values: bytes | np.ndarray) -> None:
        """Appends one reading of a sensor, as the raw bytes of its values."""
        raw = [value if isinstance(value, bytes) else np.ascontiguousarray(value).tobytes() for value in values]
        self._append(_STAMP.pack(sensor, time_s) + b"".join(raw))

    def _append(self, payload: bytes) -> None:
        data = memoryview(_HEAD.pack(len(payload), zlib.crc32(payload)) + payload)
        while data:  # an unbuffered write may take a part
            data = data[self._file.write(data) :]

    def close(self) -> None:
        self._file.close()


def read_about(path: Path) -> dict:
    """The first record; ValueError where it is not whole."""
    for payload in _records(path):
        about = json.loads(payload)
        if isinstance(about, dict):
            return about
    raise ValueError(f"{path} holds no whole record")


def read_records(path: Path) -> Iterator[tuple[int, float, bytes]]:
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
