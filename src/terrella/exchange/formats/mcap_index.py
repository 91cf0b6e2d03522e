"""Where every message of an MCAP file lies, as far as the file is whole; the `mcap` package reads what stands there.

The package's own reader ends at the first damage and gives no message by number. So the file is taken record by record
here, the package parses each, and one that is damaged costs itself alone. Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import os
import struct
import threading
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...core.errors import DatasetError

try:
    import lz4.frame
    import zstandard
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

MAGIC = b"\x89MCAP0\r\n"
LARGEST = 2**28  # bytes of one chunk, unpacked, or of one record
_KEPT = 2**26  # bytes of unpacked chunks that are remembered
_FRAME = struct.Struct("<BQ")
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError, zstandard.ZstdError)


@dataclass(frozen=True)
class Messages:
    """A topic's messages by log time: uint64 [n] times; int64 [n] where the chunk's record begins in the file, and the
    message's number in it (of one outside chunks: 0, and where it begins itself).

    after_gap: bool [n], whether a damaged chunk lies between this message and the one before it.
    """

    log_ns: np.ndarray
    chunk: np.ndarray
    place: np.ndarray
    after_gap: np.ndarray


class Index:
    """The schemas, channels, metadata and messages of one file; what is damaged is left out, with a note.

    Every chunk is unpacked once, so that its checksum is known to be right. DatasetError where the file is none of MCAP.
    """

    def __init__(self, path: Path):
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[Metadata] = []
        self.notes: list[str] = []
        self._found: dict[int, list[np.ndarray]] = {}  # channel -> [n, 3] of time, chunk, place
        self._gaps: list[int] = []  # where damaged chunks begin
        self._unpacked: OrderedDict[int, tuple[int, list[Message]]] = OrderedDict()  # chunk -> its bytes and messages
        self._lock = threading.Lock()
        try:
            with open(path, "rb") as file:
                self._scan(file, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise DatasetError(f"'{path}' cannot be read ({error.strerror}); check the path.") from error
        for channel in sorted(set(self._found) - set(self.channels)):
            count = sum(map(len, self._found[channel]))
            self.notes.append(f"{self.path.name}: {count} messages belong to no known channel and are left out.")

    def of(self, channels: Collection[int]) -> Messages:
        """The messages of these channels, in order of time."""
        parts = [part for channel in channels for part in self._found.get(channel, ())]
        found = np.concatenate([np.zeros((0, 3), np.uint64), *parts])
        log_ns, (chunk, place) = found[:, 0], found[:, 1:].astype(np.int64).T
        order = np.argsort(log_ns, kind="stable")
        possible = int((log_ns < 2**63).sum())
        if possible < len(order):
            what = f"{len(order) - possible} messages of '{self.channels[min(channels)].topic}' have impossible times"
            self.notes.append(f"{self.path.name}: {what} and are left out.")
        order = order[:possible]
        gaps_before = np.searchsorted(np.array(self._gaps, np.int64), np.where(chunk, chunk, place)[order])
        after_gap = np.diff(gaps_before, prepend=gaps_before[:1]) != 0
        return Messages(log_ns[order], chunk[order], place[order], after_gap)

    def data(self, topic: str, chunk: int, place: int) -> bytes:
        """The content of a topic's message; DatasetError where the file has changed since."""
        try:
            message = self._messages(chunk)[place] if chunk else self._record(place)
            if self.channels[message.channel_id].topic != topic:
                raise ValueError("another message lies there")
            return message.data
        except (*_DAMAGE, OSError, LookupError, AttributeError) as error:
            raise DatasetError(f"a message of '{topic}' in '{self.path}' cannot be read any more.") from error

    def _scan(self, file: BinaryIO, size: int) -> None:
        if file.read(len(MAGIC)) != MAGIC:
            raise DatasetError(f"'{self.path}' is no MCAP file: it does not begin as one; choose another file.")
        at = len(MAGIC)
        while at + _FRAME.size <= size:
            file.seek(at)
            opcode, length = _FRAME.unpack(file.read(_FRAME.size))
            if opcode == 0 or length > size - at - _FRAME.size:
                break
            if opcode == Opcode.FOOTER:
                return
            try:
                self._learn(at, _parsed(opcode, length, file))
            except _DAMAGE as error:
                what = "chunk" if opcode == Opcode.CHUNK else "record"
                self._gaps += [at] if opcode == Opcode.CHUNK else []
                self.notes.append(f"{self.path.name}: the {what} at byte {at} is damaged ({error}) and left out.")
            at += _FRAME.size + length
        where = f"at byte {at} of {size}"
        self.notes.append(f"{self.path.name}: the file was cut off or is damaged {where}; what comes before is read.")

    def _learn(self, at: int, record: Any) -> None:
        if isinstance(record, Chunk):
            records = _unpacked(record)
            inside: dict[int, list[tuple[int, int, int]]] = {}
            for place, message in enumerate(self._remember(at, records)):
                inside.setdefault(message.channel_id, []).append((message.log_time, at, place))
            for channel, found in inside.items():
                self._found.setdefault(channel, []).append(np.array(found, np.uint64))
            for inner in records:
                self._learn(at, None if isinstance(inner, Message) else inner)
        elif isinstance(record, Message):
            found = np.array([(record.log_time, 0, at)], np.uint64)
            self._found.setdefault(record.channel_id, []).append(found)
        elif isinstance(record, Metadata):
            self.metadata.append(record)
        elif isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Attachment):
            self.notes.append(f"{self.path.name}: the attachment '{record.name}' is not carried over.")

    def _record(self, at: int) -> Any:
        with open(self.path, "rb") as file:
            file.seek(at)
            opcode, length = _FRAME.unpack(file.read(_FRAME.size))
            return _parsed(opcode, length, file)

    def _messages(self, chunk: int) -> list[Message]:
        with self._lock:
            if chunk in self._unpacked:
                self._unpacked.move_to_end(chunk)
                return self._unpacked[chunk][1]
        return self._remember(chunk, _unpacked(self._record(chunk)))

    def _remember(self, chunk: int, records: list) -> list[Message]:
        messages = [record for record in records if isinstance(record, Message)]
        with self._lock:
            self._unpacked[chunk] = sum(len(message.data) for message in messages), messages
            while len(self._unpacked) > 1 and sum(size for size, _ in self._unpacked.values()) > _KEPT:
                self._unpacked.popitem(last=False)
        return messages


def _parsed(opcode: int, length: int, file: BinaryIO) -> Any:
    """The record whose body comes next in the file, as the package parses it; None where the package knows none such."""
    if length > LARGEST:
        raise ValueError(f"it claims {length} bytes, and at most {LARGEST} are read")
    if opcode not in set(Opcode):
        return None
    stream = io.BytesIO(_FRAME.pack(opcode, length) + file.read(length))
    return next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)


def _unpacked(chunk: Chunk) -> list:
    """The records in a chunk, its checksum tested; ValueError before more than it claims is unpacked."""
    claimed = chunk.uncompressed_size
    if claimed > LARGEST:
        raise ValueError(f"it claims {claimed} bytes, and at most {LARGEST} are read")
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) not in (-1, claimed):
        raise ValueError("it holds other than it claims")
    if chunk.compression == "lz4":  # the package would unpack without bound
        chunk.data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=claimed)
    elif chunk.compression not in ("", "zstd"):
        raise ValueError(f"its compression '{chunk.compression}' is none of zstd and lz4")
    chunk.compression = "" if chunk.compression == "lz4" else chunk.compression
    return breakup_chunk(chunk, validate_crc=True)
