"""The position of every intact message of an MCAP file (https://mcap.dev/spec), scanned record by record, so that a damaged
record costs only itself: the reader of the `mcap` package stops at the first damage and gives no access by number."""

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
MAX_BYTES = 2**28  # of one unpacked chunk or one record
_CACHE_BYTES = 2**26  # of unpacked chunks
_FRAME = struct.Struct("<BQ")
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError, zstandard.ZstdError)


@dataclass(frozen=True)
class Messages:
    """The messages of a topic, in order of log time."""

    log_ns: np.ndarray  # uint64 [n]
    chunk: np.ndarray  # int64 [n], byte at which the chunk's record begins; 0 for a message outside chunks
    place: np.ndarray  # int64 [n], number of the message in its chunk; outside chunks, the byte at which it begins
    after_gap: np.ndarray  # bool [n], whether a damaged chunk lies between this message and the one before it


class Index:
    """The schemas, channels, metadata and messages of one file. Damaged parts (every chunk's checksum is compared) are left out,
    with a note; DatasetError where the file is not MCAP."""

    def __init__(self, path: Path):
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[Metadata] = []
        self.notes: list[str] = []
        self._positions: dict[int, list[np.ndarray]] = {}  # channel -> [n, 3] of time, chunk, place
        self._gaps: list[int] = []  # bytes at which damaged chunks begin
        self._unpacked: OrderedDict[int, tuple[int, list[Message]]] = OrderedDict()  # chunk -> its bytes and messages
        self._lock = threading.Lock()
        try:
            with open(path, "rb") as file:
                self._scan(file, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise DatasetError(f"'{path}' cannot be read ({error.strerror}); check the path.") from error
        for channel in sorted(set(self._positions) - set(self.channels)):
            count = sum(map(len, self._positions[channel]))
            self.notes.append(f"{self.path.name}: {count} messages belong to no known channel and are left out.")

    def of(self, channels: Collection[int]) -> Messages:
        """The messages of these channels, in order of time."""
        parts = [part for channel in channels for part in self._positions.get(channel, ())]
        positions = np.concatenate([np.zeros((0, 3), np.uint64), *parts])
        log_ns, (chunk, place) = positions[:, 0], positions[:, 1:].astype(np.int64).T
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
        """The content of a message; DatasetError where the file has changed since."""
        try:
            message = self._messages(chunk)[place] if chunk else self._record(place)
            if self.channels[message.channel_id].topic != topic:
                raise ValueError("another message is at that position")
            return message.data
        except (*_PARSE_ERRORS, OSError, LookupError, AttributeError) as error:
            raise DatasetError(
                f"a message of '{topic}' in '{self.path}' cannot be read any more; open the file again."
            ) from error

    def _scan(self, file: BinaryIO, size: int) -> None:
        if file.read(len(MAGIC)) != MAGIC:
            raise DatasetError(f"'{self.path}' is not an MCAP file: its first bytes differ; choose another file.")
        at = len(MAGIC)
        while at + _FRAME.size <= size:
            file.seek(at)
            opcode, length = _FRAME.unpack(file.read(_FRAME.size))
            if opcode == 0 or length > size - at - _FRAME.size:
                break
            if opcode == Opcode.FOOTER:
                return
            try:
                self._add(at, _parsed(opcode, length, file))
            except _PARSE_ERRORS as error:
                what = "chunk" if opcode == Opcode.CHUNK else "record"
                self._gaps += [at] if opcode == Opcode.CHUNK else []
                self.notes.append(f"{self.path.name}: the {what} at byte {at} is damaged ({error}) and left out.")
            at += _FRAME.size + length
        where = f"at byte {at} of {size}"
        self.notes.append(f"{self.path.name}: the file was cut off or is damaged {where}; what comes before is read.")

    def _add(self, at: int, record: Any) -> None:
        if isinstance(record, Chunk):
            records = _unpacked(record)
            inside: dict[int, list[tuple[int, int, int]]] = {}
            for place, message in enumerate(self._cache(at, records)):
                inside.setdefault(message.channel_id, []).append((message.log_time, at, place))
            for channel, positions in inside.items():
                self._positions.setdefault(channel, []).append(np.array(positions, np.uint64))
            for inner in records:
                self._add(at, None if isinstance(inner, Message) else inner)
        elif isinstance(record, Message):
            position = np.array([(record.log_time, 0, at)], np.uint64)
            self._positions.setdefault(record.channel_id, []).append(position)
        elif isinstance(record, Metadata):
            self.metadata.append(record)
        elif isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Attachment):
            self.notes.append(f"{self.path.name}: the attachment '{record.name}' is not kept.")

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
        return self._cache(chunk, _unpacked(self._record(chunk)))

    def _cache(self, chunk: int, records: list) -> list[Message]:
        messages = [record for record in records if isinstance(record, Message)]
        with self._lock:
            self._unpacked[chunk] = sum(len(message.data) for message in messages), messages
            while len(self._unpacked) > 1 and sum(size for size, _ in self._unpacked.values()) > _CACHE_BYTES:
                self._unpacked.popitem(last=False)
        return messages


def _parsed(opcode: int, length: int, file: BinaryIO) -> Any:
    """The record whose body comes next in the file, parsed by the package; None for an unknown kind."""
    if length > MAX_BYTES:
        raise ValueError(f"it claims {length} bytes, and at most {MAX_BYTES} are read")
    if opcode not in set(Opcode):
        return None
    stream = io.BytesIO(_FRAME.pack(opcode, length) + file.read(length))
    return next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)


def _unpacked(chunk: Chunk) -> list:
    """The records in a chunk, after checking its checksum; ValueError if it unpacks to more than it declares."""
    claimed = chunk.uncompressed_size
    if claimed > MAX_BYTES:
        raise ValueError(f"it claims {claimed} bytes, and at most {MAX_BYTES} are read")
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) not in (-1, claimed):
        raise ValueError("its content does not have the declared size")
    if chunk.compression == "lz4":  # the package would unpack it without limit
        chunk.data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=claimed)
    elif chunk.compression not in ("", "zstd"):
        raise ValueError(f"its compression '{chunk.compression}' is neither zstd nor lz4")
    chunk.compression = "" if chunk.compression == "lz4" else chunk.compression
    return breakup_chunk(chunk, validate_crc=True)
