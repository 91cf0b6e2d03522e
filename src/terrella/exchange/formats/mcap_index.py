"""Finds every message of an MCAP file without reading their contents, as far as the file is whole.

The file's own layout: https://mcap.dev/spec. Only record headers, message indexes and the summary are read; the chunks
of a file that was cut, or that has no index, are unpacked once to see what is in them.
"""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError

try:
    import lz4.frame
    import zstandard
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

MAGIC = b"\x89MCAP0\r\n"
LARGEST = 2**28  # bytes of one chunk, unpacked, or of one message
_LARGEST_RECORD = 2**26  # of a schema, a channel, metadata, a message index
_KEPT = 2**26  # bytes of unpacked chunks that are remembered
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _METADATA = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x0C
_HEAD, _MESSAGE_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ")


class Damaged(ValueError):
    """A part of the file that is not what it should be."""


@dataclass(frozen=True)
class Schema:
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    topic: str
    encoding: str
    schema_id: int


@dataclass
class Chunk:
    """Where a chunk's packed bytes lie in the file; `messages` are its (channel, times, offsets)."""

    start: int
    size: int
    compression: str
    unpacked: int
    crc: int
    messages: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)


@dataclass(frozen=True)
class Messages:
    """A channel's messages by log time: uint64 [n] each; chunk 0 is the file itself, chunk i + 1 is chunks[i]."""

    log_ns: np.ndarray
    chunk: np.ndarray
    offset: np.ndarray


class Index:
    """The schemas, channels, metadata and messages of one file.

    verify: unpack every chunk at once and leave damaged ones out with a note, instead of stumbling on them later.
    `complete` is False for a file without its footer. DatasetError where the file is none of MCAP.
    """

    def __init__(self, path: Path, verify: bool = False):
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.messages: dict[int, Messages] = {}
        self.notes: list[str] = []
        self.complete = False
        self._chunks: list[Chunk] = []
        self._loose: dict[int, list[tuple[int, int]]] = {}
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        try:
            with open(path, "rb") as file:
                self._scan(file, os.fstat(file.fileno()).st_size)
            self._look_into_chunks(verify)
        except OSError as error:
            raise DatasetError(f"'{path}' cannot be read ({error.strerror}); check the path.") from error
        self._order()

    def data(self, channel_id: int, index: int) -> bytes:
        """The content of a channel's message; DatasetError where the file is damaged there."""
        messages = self.messages[channel_id]
        chunk, offset = int(messages.chunk[index]), int(messages.offset[index])
        try:
            if chunk == 0:
                with open(self.path, "rb") as file:
                    file.seek(offset)
                    opcode, length = _HEAD.unpack(_exactly(file, _HEAD.size))
                    body = _exactly(file, length) if opcode == _MESSAGE and length <= LARGEST else b""
            else:
                content = self._content(chunk - 1)
                opcode, length = _HEAD.unpack_from(content, offset)
                body = content[offset + _HEAD.size : offset + _HEAD.size + length]
            if opcode != _MESSAGE or len(body) != length:
                raise Damaged("no message lies where the index has one")
            found, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(body)
            if found != channel_id or log_ns != int(messages.log_ns[index]):
                raise Damaged("another message lies where the index has one")
            return body[_MESSAGE_HEAD.size :]
        except (Damaged, struct.error, OSError, OverflowError) as error:
            where = f"message {index} of '{self.channels[channel_id].topic}' in '{self.path}'"
            raise DatasetError(
                f"{where} is damaged ({error}); read the file with verify=True to leave it out."
            ) from error

    def _scan(self, file, size: int) -> None:
        if file.read(len(MAGIC)) != MAGIC:
            raise DatasetError(f"'{self.path}' is no MCAP file: it does not begin as one; choose another file.")
        at = len(MAGIC)
        while at + _HEAD.size <= size:
            file.seek(at)
            opcode, length = _HEAD.unpack(_exactly(file, _HEAD.size))
            if opcode == 0 or length > size - at - _HEAD.size:
                break
            if opcode == _FOOTER:
                self.complete = True
                return
            try:
                if opcode == _CHUNK:
                    self._chunks.append(_chunk(file, at + _HEAD.size, length))
                elif opcode == _MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack(_exactly(file, min(length, _MESSAGE_HEAD.size)))
                    self._loose.setdefault(channel, []).append((log_ns, at))
                elif opcode in (_SCHEMA, _CHANNEL, _METADATA, _MESSAGE_INDEX):
                    if length > _LARGEST_RECORD:
                        raise Damaged(f"a record of {length} bytes")
                    body = _exactly(file, length)
                    if opcode == _MESSAGE_INDEX:
                        self._index_of_chunk(body)
                    else:
                        self._learn(opcode, body)
            except (Damaged, struct.error, UnicodeDecodeError) as error:
                self.notes.append(f"{self.path.name}: the record at byte {at} is damaged ({error}) and left out.")
            at += _HEAD.size + length
        where = f"at byte {at} of {size}"
        self.notes.append(f"{self.path.name}: the file was cut off or is damaged {where}; what comes before is read.")

    def _index_of_chunk(self, body: bytes) -> None:
        channel, length = struct.unpack_from("<HI", body)
        if not self._chunks or length % 16 or len(body) < 6 + length:
            raise Damaged("a message index of no chunk")
        entries = np.frombuffer(body, "<u8", length // 8, 6).reshape(-1, 2)
        if len(entries) and entries[:, 1].max() >= self._chunks[-1].unpacked:
            raise Damaged("an index beyond its chunk")
        self._chunks[-1].messages.append((channel, entries[:, 0], entries[:, 1]))

    def _learn(self, opcode: int, body: bytes) -> None:
        cursor = _Cursor(body)
        if opcode == _METADATA:
            name = cursor.text()
            self.metadata.append((name, dict(cursor.pairs())))
        elif opcode == _SCHEMA:
            number, name, encoding = cursor.number("<H"), cursor.text(), cursor.text()
            self.schemas.setdefault(number, Schema(name, encoding, cursor.bytes()))
        else:
            number, schema_id, topic, encoding = cursor.number("<H"), cursor.number("<H"), cursor.text(), cursor.text()
            self.channels.setdefault(number, Channel(topic, encoding, schema_id))

    def _look_into_chunks(self, verify: bool) -> None:
        """Unpacks those chunks of which the file does not say what is in them."""
        for number, chunk in enumerate(self._chunks):
            known = all(channel in self.channels for channel, _, _ in chunk.messages)
            if self.complete and chunk.messages and known and not verify:
                continue
            try:
                content = self._content(number)
            except (Damaged, OSError) as error:
                what = f"the chunk at byte {chunk.start} is damaged ({error})"
                self.notes.append(f"{self.path.name}: {what}; its messages are left out.")
                chunk.messages = []
                continue
            chunk.messages = self._walk(content)

    def _walk(self, content: bytes) -> list[tuple[int, np.ndarray, np.ndarray]]:
        found: dict[int, list[tuple[int, int]]] = {}
        for opcode, at, length in _records(content):
            try:
                if opcode == _MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content, at + _HEAD.size)
                    found.setdefault(channel, []).append((log_ns, at))
                elif opcode in (_SCHEMA, _CHANNEL):
                    self._learn(opcode, content[at + _HEAD.size : at + _HEAD.size + length])
            except (Damaged, struct.error, UnicodeDecodeError) as error:
                self.notes.append(f"{self.path.name}: a record in a chunk is damaged ({error}) and left out.")
        return [(channel, *np.array(pairs, np.uint64).T) for channel, pairs in found.items()]  # type: ignore[misc]

    def _content(self, number: int) -> bytes:
        """A chunk unpacked, no more than LARGEST bytes of it; those of late are remembered."""
        with self._lock:
            if number in self._unpacked:
                self._unpacked.move_to_end(number)
                return self._unpacked[number]
        chunk = self._chunks[number]
        with open(self.path, "rb") as file:
            file.seek(chunk.start)
            packed = _exactly(file, chunk.size)
        content = _unpack(packed, chunk)
        with self._lock:
            self._unpacked[number] = content
            while len(self._unpacked) > 1 and sum(map(len, self._unpacked.values())) > _KEPT:
                self._unpacked.popitem(last=False)
        return content

    def _order(self) -> None:
        parts: dict[int, list[tuple[np.ndarray, int, np.ndarray]]] = {}
        for channel, pairs in self._loose.items():
            log_ns, offset = np.array(pairs, np.uint64).T
            parts.setdefault(channel, []).append((log_ns, 0, offset))
        for number, chunk in enumerate(self._chunks):
            for channel, log_ns, offset in chunk.messages:
                parts.setdefault(channel, []).append((log_ns, number + 1, offset))
            chunk.messages = []
        self._loose = {}
        for channel, items in sorted(parts.items()):
            if channel not in self.channels:
                count = sum(len(item[0]) for item in items)
                self.notes.append(f"{self.path.name}: {count} messages belong to no known channel and are left out.")
                continue
            log_ns = np.concatenate([item[0] for item in items])
            chunk = np.concatenate([np.full(len(item[0]), item[1], np.uint32) for item in items])
            offset = np.concatenate([item[2] for item in items])
            order = np.argsort(log_ns, kind="stable")
            possible = int((log_ns < 2**63).sum())
            if possible < len(order):
                what = f"{len(order) - possible} messages of '{self.channels[channel].topic}' have impossible times"
                self.notes.append(f"{self.path.name}: {what} and are left out.")
                order = order[:possible]
            if not possible:
                continue
            self.messages[channel] = Messages(log_ns[order], chunk[order], offset[order])


def _chunk(file, start: int, length: int) -> Chunk:
    head = _exactly(file, min(length, 128))
    cursor = _Cursor(head)
    cursor.at = 16  # its first and last time
    unpacked, crc, compression, size = cursor.number("<Q"), cursor.number("<I"), cursor.text(), cursor.number("<Q")
    if cursor.at + size > length:
        raise Damaged("a chunk longer than its record")
    return Chunk(start + cursor.at, size, compression, unpacked, crc)


def _unpack(packed: bytes, chunk: Chunk) -> bytes:
    if max(chunk.unpacked, chunk.size) > LARGEST:
        raise Damaged(f"it claims {max(chunk.unpacked, chunk.size)} bytes, and at most {LARGEST} are read")
    try:
        if chunk.compression == "zstd":
            content = zstandard.ZstdDecompressor().stream_reader(packed).read(chunk.unpacked)
        elif chunk.compression == "lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=chunk.unpacked)
        elif chunk.compression == "":
            content = packed
        else:
            raise Damaged(f"its compression '{chunk.compression}' is none of zstd and lz4")
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError) as error:
        raise Damaged(f"it cannot be unpacked: {error}") from error
    if len(content) != chunk.unpacked or (chunk.crc and zlib.crc32(content) != chunk.crc):
        raise Damaged("its check sum is wrong")
    return content


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, length) of the records in an unpacked chunk, as far as they are whole."""
    at = 0
    while at + _HEAD.size <= len(content):
        opcode, length = _HEAD.unpack_from(content, at)
        if length > len(content) - at - _HEAD.size:
            return
        yield opcode, at, length
        at += _HEAD.size + length


def _exactly(file, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise Damaged("the file ends there")
    return data


class _Cursor:
    """Reads MCAP's numbers, texts and bytes one after another; Damaged or struct.error at the end."""

    def __init__(self, data: bytes):
        self._data, self.at = data, 0

    def number(self, form: str) -> int:
        (value,) = struct.unpack_from(form, self._data, self.at)
        self.at += struct.calcsize(form)
        return value

    def bytes(self) -> bytes:
        length = self.number("<I")
        if length > len(self._data) - self.at:
            raise Damaged("a text longer than its record")
        self.at += length
        return self._data[self.at - length : self.at]

    def text(self) -> str:
        return self.bytes().decode()

    def pairs(self) -> Iterator[tuple[str, str]]:
        end = self.number("<I") + self.at
        while self.at < end:
            yield self.text(), self.text()
