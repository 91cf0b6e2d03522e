"""H.264 video files: an encoder that runs in parallel with the world, and exact frame reading (PyAV).

The boxes of a file are checked before FFmpeg allocates memory for the frames that they claim.
"""

import os
import queue
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
from ...core.video import media_address
from ..source import Lazy

_RUN = struct.Struct(">II")  # flags and frames of a fragment's run
_FIELDS = (0x100, 0x200, 0x400, 0x800)  # optional fields of a run, four bytes a frame each
_TABLE_BYTES = 1 << 24  # bytes of one fragment's table


def _check_boxes(path: Path) -> None:
    """ValueError where a fragment claims more frames than it has bytes; OSError where there is no file."""
    about = os.stat(path)
    _checked(str(path), about.st_size, about.st_mtime_ns)


@lru_cache(1024)
def _checked(path: str, size: int, _changed_ns: int) -> None:
    with open(path, "rb") as file:
        for at, length, kind in _walk(file, size):
            if kind == b"moof":
                if length > _TABLE_BYTES:
                    raise ValueError(f"a fragment's table claims {length:,} bytes")
                _fragment(file, at, min(at + length, size), size)


def _walk(file: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """(place, bytes, kind) of the boxes of a file; the last may be cut or have an invalid length."""
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
    """(bytes, fragments) of a growing file up to the end of its last whole fragment (moof and mdat).

    All bytes, and 0, of a file without fragments or with other damage, which the reader reports.
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


def trim_fragments(path: Path) -> None:
    """Cuts a growing file after its last whole fragment; FFmpeg cannot read on from half of one."""
    size = whole_fragments(path)[0]
    if size < os.stat(path).st_size:
        os.truncate(path, size)


BROKEN = (av.FFmpegError, OSError, IndexError, ZeroDivisionError, ValueError, OverflowError)
KEYFRAME_EVERY = 8
_CODEC = {"preset": "veryfast", "crf": "18", "g": "8", "keyint_min": "8", "bf": "0", "threads": "1"}
_CODEC["tune"] = "fastdecode,zerolatency"  # no frame waits in the encoder for later ones
# While recording, every frame is a fragment of its own, so a cut file is readable up to its last frame.
_GROWING = {"movflags": "frag_every_frame+empty_moov+default_base_moof", "flush_packets": "1"}
FINISHED = {"movflags": "+faststart"}  # the index in front: a cut file still plays up to the cut
_WAITING = 64  # frames that may wait for the encoder; then `add` blocks, and no frame is dropped
_PICTURE_PIXELS = 64_000_000  # pixels of a picture; a file that claims more is damaged or hostile


@dataclass
class Pressure:
    """How far encoders fell behind."""

    waited_s: float = 0.0  # time for which `add` blocked
    most_waiting: int = 0  # longest queue, frames


class Mp4Writer:
    """Encodes uint8 [H, W, 3] frames in a thread of its own; errors of that thread surface in `add` or `close`.

    The file at `path` grows frame by frame. `pressure` counts how far the encoder falls behind.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float, pressure: Pressure | None = None):
        self.path, self._size, self._pressure = path, size, pressure or Pressure()
        self._rate = Fraction(fps).limit_denominator(10_000)
        self._frames: queue.Queue[np.ndarray | None] = queue.Queue(_WAITING)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mp4-writer", daemon=True)
        self._thread.start()

    def add(self, frame: np.ndarray) -> None:
        """Queues a frame, which must not change afterwards; blocks while the queue is full."""
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
        """Finishes the growing file; raises an error of the encoder."""
        self._frames.put(None)
        self._thread.join()
        if self._error:
            raise self._error

    def abandon(self) -> None:
        """Stops, and ignores errors."""
        with suppress(OSError, av.FFmpegError):
            self.close()

    def _run(self) -> None:
        try:
            self._encode()
        except BaseException as error:  # handed to the caller's thread
            self._error = error
            while self._frames.get() is not None:
                pass

    def _encode(self) -> None:
        height, width = self._size
        with av.open(media_address(self.path), "w", format="mp4", options=_GROWING) as container:
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
def open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container of a video and its first stream; raises one of BROKEN where it is not a video."""
    _check_boxes(path)
    with av.open(media_address(path), "r") as container:
        yield container, container.streams.video[0]


def frames_per_tick(stream: VideoStream, fps: float) -> Fraction:
    """Frames, at `fps`, in one tick of the clock of a stream."""
    return (stream.time_base or Fraction(0)) * Fraction(fps).limit_denominator(10_000)


def finish_video(path: Path, target: Path, frames: int | None = None, first: int = 0) -> int:
    """Copies at most `frames` packets, from packet `first` on, to a file with its index in front; returns their number.

    Nothing is encoded again; the first packet gets time 0. DatasetError where no packet is whole.
    """
    count, begin, options, to = 0, 0, FINISHED, media_address(target)
    try:
        with open_video(path) as (source, stream), av.open(to, "w", format="mp4", options=options) as copy:
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
            raise broken_video(path, str(error)) from error
    if not count:
        raise broken_video(path, "it holds no frame")
    files.sync_file(target)
    return count


def decode_frames(path: Path, first: int, count: int, fps: float, deep: bool = False) -> Iterator[np.ndarray]:
    """Frames `first` to `first + count - 1` of the file, uint8 [H, W, 3]; DatasetError where one is missing.

    deep: the video is depth of one channel of 16 bits; frames are uint16 [H, W].
    """
    expected = first
    try:
        with open_video(path) as (container, stream):
            limit_pixels(stream)
            if stream.width * stream.height > _PICTURE_PIXELS:
                raise broken_video(path, f"it claims pictures of {stream.height}x{stream.width}")
            frames_a_tick = frames_per_tick(stream, fps)
            stream.thread_count = 1  # several episodes are decoded at once, each in a thread of its own
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
                    raise broken_video(path, f"frame {expected} has another size than it claims")
                yield reformatter.reformat(frame, format="gray16le" if deep else "rgb24").to_ndarray()
                expected += 1
                if expected == first + count:
                    return
    except BROKEN as error:
        raise broken_video(path, str(error)) from error
    raise broken_video(path, f"frame {expected} is missing, {first + count} are needed")


def limit_pixels(stream) -> None:
    """Makes the decoder refuse pictures of absurd size; ValueError where there is no decoder."""
    if stream.codec_context is None:
        raise ValueError("it is of an unknown codec")
    stream.codec_context.options = {"max_pixels": str(_PICTURE_PIXELS)}


class Frames(Lazy):
    """Frames `first` to `first + count - 1` of a file, each decoded when it is read; seeks where that is faster."""

    def __init__(self, path: Path, first: int, count: int, fps: float, deep: bool = False):
        super().__init__(count, self._frame)
        self._film = path, first, fps, deep
        self._next, self._run = -1, iter(())

    def _frame(self, index: int) -> np.ndarray:
        ahead = index - self._next
        if self._next < 0 or not 0 <= ahead <= KEYFRAME_EVERY:
            path, first, fps, deep = self._film
            self._run, ahead = decode_frames(path, first + index, len(self) - index, fps, deep), 0
        self._next = -1  # until the frame is decoded
        for _ in range(ahead):
            next(self._run)
        frame = next(self._run)
        self._next = index + 1
        return frame


def broken_video(path: Path, why: str) -> DatasetError:
    return DatasetError(
        f"the video {path} is missing, truncated or not H.264 mp4 ({why}); restore it from a copy, or remove its episode."
    )
