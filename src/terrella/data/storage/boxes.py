"""The boxes of an mp4 file: walked before FFmpeg makes room for the frames that they claim, and up to the last whole one."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

_RUN = struct.Struct(">II")  # flags and frames of a fragment's run
_FIELDS = (0x100, 0x200, 0x400, 0x800)  # what a run may keep for each frame, four bytes each
_LARGEST = 1 << 24  # bytes of one fragment's table


def check(path: Path) -> None:
    """ValueError where a fragment claims more frames than it has bytes; OSError where there is no file."""
    about = os.stat(path)
    _checked(str(path), about.st_size, about.st_mtime_ns)


@lru_cache(1024)
def _checked(path: str, size: int, _changed_ns: int) -> None:
    with open(path, "rb") as file:
        for at, length, kind in _walk(file, size):
            if kind == b"moof":
                if length > _LARGEST:
                    raise ValueError(f"a fragment's table claims {length:,} bytes")
                _fragment(file, at, min(at + length, size), size)


def _walk(file: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """(place, bytes, kind) of the boxes of a file; the last may be cut, or claim what no box can have."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if length == 1:
            length = int.from_bytes(file.read(8), "big")
        yield at, length, kind
        if length < 8:  # 0: up to the end of the file
            return
        at += length


def _fragment(file: BinaryIO, start: int, end: int, size: int) -> None:
    file.seek(start)
    data = file.read(end - start)
    at = 8
    while at + 16 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"traf":
            at += 8  # its boxes follow
            continue
        if kind == b"trun":
            flags, frames = _RUN.unpack_from(data, at + 8)
            each = 4 * sum(bool(flags & field) for field in _FIELDS)
            if frames > (max(0, length - 16) // each if each else size):
                raise ValueError(f"a fragment claims {frames:,} frames")
        if length < 8:
            return
        at += length


def whole(path: Path) -> tuple[int, int]:
    """(bytes, fragments) of a growing file up to the end of its last fragment (moof and mdat) that is whole.

    All bytes of a file that has no fragments, or is damaged: whoever reads it will tell.
    """
    with open(path, "rb") as file:
        end = file.seek(0, 2)
        kept, fragments, begun = end, 0, False
        for at, length, kind in _walk(file, end):
            if not begun and (length < 8 or (at + length > end and kind != b"moof")):
                return end, 0
            if length < 8 or at + length > end or (begun and kind not in (b"moof", b"mdat")):
                break  # cut; after a power cut what follows may be zeros
            if kind == b"moof":
                kept, begun = kept if begun else at, True
            else:
                kept, fragments = at + length, fragments + begun
    return kept, fragments


def trim(path: Path) -> None:
    """Cuts a growing file after its last whole fragment; a half-written one would spoil the rest."""
    size = whole(path)[0]
    if size < os.stat(path).st_size:
        os.truncate(path, size)
