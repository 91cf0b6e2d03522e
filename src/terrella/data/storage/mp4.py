"""H.264 video files: an encoder that runs in parallel with the world, and exact frame reading (PyAV).

The boxes of a file are walked before FFmpeg makes room for the frames that they claim, and up to the last whole one.
"""

from __future__ import annotations

import os
import queue
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from av.container import InputContainer
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from ...core import files
from ...core.errors import DatasetError
from ..source import Lazy

_RUN = struct.Struct(">II")  # flags and frames of a fragment's run
_FIELDS = (0x100, 0x200, 0x400, 0x800)  # what a run may keep for each frame, four bytes each
_LARGEST = 1 << 24  # bytes of one fragment's table


def _check_boxes(path: Path) -> None:
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


def whole_fragments(path: Path) -> tuple[int, int]:
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
    size = whole_fragments(path)[0]
    if size < os.stat(path).st_size:
        os.truncate(path, size)


BROKEN = (av.FFmpegError, OSError, IndexError, ZeroDivisionError, ValueError, OverflowError)
KEYFRAME_EVERY = 8
_CODEC = {
    "preset": "veryfast",
    "crf": "18",
    "tune": "fastdecode,zerolatency",  # no frame waits in the encoder for later ones
    "g": "8",
    "keyint_min": "8",
    "bf": "0",
    "threads": "1",
}
# While it is recorded every frame is a fragment that stands alone, so that a cut file is whole up to its last frame.
_GROWING = {"movflags": "frag_every_frame+empty_moov+default_base_moof", "flush_packets": "1"}
FINISHED = {"movflags": "+faststart"}  # the index first: a cut file still plays up to the cut
_WAITING = 64  # frames that may wait for the encoder; then `add` waits, no frame is ever dropped
_LARGEST = 64_000_000  # pixels of a picture; a file that claims more is damaged or hostile


@dataclass
class Pressure:
    """How far behind encoders were. waited_s: time that `add` stood still; most_waiting: frames that queued at worst."""

    waited_s: float = 0.0
    most_waiting: int = 0


class Mp4Writer:
    """Encodes uint8 [H, W, 3] frames in a thread of its own; errors of that thread surface in `add` or `close`.

    The file at `path` grows frame by frame; `pressure` is told where the encoder is behind.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float, pressure: Pressure | None = None):
        self.path, self._size, self._pressure = path, size, pressure or Pressure()
        self._rate = Fraction(fps).limit_denominator(10_000)
        self._frames: queue.Queue[np.ndarray | None] = queue.Queue(_WAITING)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mp4-writer", daemon=True)
        self._thread.start()

    def add(self, frame: np.ndarray) -> None:
        """Queues a frame that nobody changes afterwards; waits where the encoder is behind."""
        if self._error:
            raise self._error
        try:
            self._frames.put_nowait(frame)
        except queue.Full:
            began = time.perf_counter()
            self._frames.put(frame)
            self._pressure.waited_s += time.perf_counter() - began
        self._pressure.most_waiting = max(self._pressure.most_waiting, self._frames.qsize())

    def close(self) -> None:
        """Ends the growing file; raises what went wrong in the encoder."""
        self._frames.put(None)
        self._thread.join()
        if self._error:
            raise self._error

    def abandon(self) -> None:
        """Stops without caring for the file."""
        try:
            self.close()
        except (OSError, av.FFmpegError):
            pass

    def _run(self) -> None:
        try:
            self._encode()
        except BaseException as error:  # handed to the caller's thread
            self._error = error
            while self._frames.get() is not None:
                pass

    def _encode(self) -> None:
        height, width = self._size
        with av.open(str(self.path), "w", format="mp4", options=_GROWING) as container:
            stream = container.add_stream("libx264", rate=self._rate, options=_CODEC)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.codec_context.time_base = 1 / self._rate
            count = 0
            while (frame := self._frames.get()) is not None:
                picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
                picture.pts = count
                count += 1
                container.mux(stream.encode(picture))
            container.mux(stream.encode())


@contextmanager
def opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A video's container and its first stream; one of BROKEN where it is none."""
    _check_boxes(path)
    with av.open(str(path), "r") as container:
        yield container, container.streams.video[0]


def ticks(stream: VideoStream, fps: float) -> Fraction:
    """Frames of a video of `fps` that one tick of its stream's clock is."""
    return (stream.time_base or Fraction(0)) * Fraction(fps).limit_denominator(10_000)


def finish(path: Path, target: Path, frames: int | None = None, first: int = 0) -> int:
    """Copies frames to a file of their own with its index in front; returns how many it holds.

    At most `frames` are taken, from packet number `first` on, which begins at time 0. Nothing is encoded anew. DatasetError
    where not one is whole.
    """
    count, begin, options = 0, 0, FINISHED
    try:
        with opened(path) as (source, stream), av.open(str(target), "w", format="mp4", options=options) as copy:
            out = copy.add_stream_from_template(stream, opaque=True)
            for packet in islice(source.demux(stream), first, None):
                if packet.size == 0 or packet.is_corrupt or packet.pts is None or count == frames:
                    break
                begin = begin if count else packet.pts
                packet.pts -= begin
                packet.dts = None if packet.dts is None else packet.dts - begin
                packet.stream = out
                copy.mux(packet)
                count += 1
    except (av.FFmpegError, IndexError, ValueError) as error:
        if isinstance(error, OSError) and error.errno and not isinstance(error, av.InvalidDataError):
            raise
        if not count:
            raise broken(path, str(error)) from error
    if not count:
        raise broken(path, "it holds no frame")
    files.sync_file(target)
    return count


def frames(path: Path, first: int, count: int, fps: float, deep: bool = False) -> Iterator[np.ndarray]:
    """Frames `first` .. `first + count - 1` of the file, uint8 [H, W, 3]; DatasetError where one is missing.

    deep: of depth in a video of one channel of 16 bits, uint16 [H, W].
    """
    expected = first
    try:
        with opened(path) as (container, stream):
            bound(stream)
            if stream.width * stream.height > _LARGEST:
                raise broken(path, f"it claims pictures of {stream.height}x{stream.width}")
            frames_a_tick = ticks(stream, fps)
            stream.thread_count = 1  # of several episodes at once, each has a thread
            reformatter = VideoReformatter()
            if first:
                container.seek(round(first / frames_a_tick), stream=stream)
            for frame in container.decode(stream):
                at = round((frame.pts or 0) * frames_a_tick)
                if at < expected:
                    continue
                if at > expected:
                    break
                if (frame.width, frame.height) != (stream.width, stream.height):
                    raise broken(path, f"frame {expected} has another size than it claims")
                yield reformatter.reformat(frame, format="gray16le" if deep else "rgb24").to_ndarray()
                expected += 1
                if expected == first + count:
                    return
    except BROKEN as error:
        raise broken(path, str(error)) from error
    raise broken(path, f"frame {expected} is missing, {first + count} are needed")


def bound(stream) -> None:
    """Lets the stream's decoder refuse pictures of absurd size; ValueError where there is no decoder for it."""
    if stream.codec_context is None:
        raise ValueError("it is of an unknown codec")
    stream.codec_context.options = {"max_pixels": str(_LARGEST)}


class Frames(Lazy):
    """Frames `first` .. `first + count - 1` of a file, decoded when looked at; seeks where that saves decoding."""

    def __init__(self, path: Path, first: int, count: int, fps: float, deep: bool = False):
        super().__init__(count, self._frame)
        self._film = path, first, fps, deep
        self._next, self._run = -1, iter(())

    def _frame(self, index: int) -> np.ndarray:
        ahead = index - self._next
        if self._next < 0 or not 0 <= ahead <= KEYFRAME_EVERY:
            path, first, fps, deep = self._film
            self._run, ahead = frames(path, first + index, len(self) - index, fps, deep), 0
        self._next = -1  # until it is found
        for _ in range(ahead):
            next(self._run)
        frame = next(self._run)
        self._next = index + 1
        return frame


def broken(path: Path, why: str) -> DatasetError:
    return DatasetError(
        f"the video {path} is missing, truncated or not H.264 mp4 ({why}); restore it from a copy, or remove its episode."
    )
