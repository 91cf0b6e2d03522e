"""H.264 video files: an encoder that runs beside the world, and exact frame reading (PyAV)."""

from __future__ import annotations

import io
import queue
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from ...core.errors import DatasetError
from . import boxes, durable

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
_FINISHED = {"movflags": "+faststart"}  # the index first: a cut file still plays up to the cut
_WAITING = 64  # frames that may wait for the encoder; then `add` waits, no frame is ever dropped
_LARGEST = 64_000_000  # pixels of a picture; a file that claims more is damaged or hostile


class Mp4Writer:
    """Encodes uint8 [H, W, 3] frames in a thread of its own; errors of that thread surface in `add` or `finish`.

    The file at `path` grows frame by frame. waited_s: seconds that `add` waited for the encoder; most_waiting: the most
    frames that ever waited.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float):
        self.path, self.waited_s, self.most_waiting = path, 0.0, 0
        self._size = size
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
            self.waited_s += time.perf_counter() - began
        self.most_waiting = max(self.most_waiting, self._frames.qsize())

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


class _Whole(io.RawIOBase):
    """A growing file up to its last whole fragment; other files as they are. A half-written header would spoil the rest."""

    def __init__(self, path: Path):
        self._file = open(path, "rb", buffering=0)
        self._end = _whole_bytes(self._file)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        room = max(0, self._end - self._file.tell())
        return self._file.readinto(memoryview(buffer)[:room]) or 0

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(self._end + offset) if whence == 2 else self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def close(self) -> None:
        self._file.close()
        super().close()


def _whole_bytes(file) -> int:
    """Bytes up to the end of the last fragment (moof and mdat) that is whole; all of them where there are no fragments."""
    end = file.seek(0, 2)
    at = whole = 0
    fragments = False
    while at + 8 <= end:
        file.seek(at)
        size, kind = struct.unpack(">I4s", file.read(8))
        if not fragments and (size < 8 or (at + size > end and kind != b"moof")):
            return end  # not in fragments, or damaged: whoever reads it will tell
        if size < 8 or at + size > end or (fragments and kind not in (b"moof", b"mdat")):
            break  # cut; after a power cut what follows may be zeros
        fragments |= kind == b"moof"
        at += size
        whole = whole if kind == b"moof" else at
    file.seek(0)
    return whole if fragments or at < end else end


def finish(growing: Path, target: Path, frames: int | None = None) -> int:
    """Copies a grown file, whole or cut, to `target` with its index in front; returns how many frames it holds.

    At most `frames` are taken. Nothing is encoded anew. DatasetError where not one frame is whole.
    """
    count = 0
    try:
        boxes.check(growing)
        with (
            _Whole(growing) as grown,
            av.open(grown, "r") as source,
            av.open(str(target), "w", format="mp4", options=_FINISHED) as copy,
        ):
            stream = source.streams.video[0]
            out = copy.add_stream_from_template(stream)
            for packet in source.demux(stream):
                if packet.size == 0 or packet.is_corrupt or count == frames:
                    break
                packet.stream = out
                copy.mux(packet)
                count += 1
    except (av.FFmpegError, IndexError, ValueError) as error:
        if isinstance(error, OSError) and error.errno and not isinstance(error, av.InvalidDataError):
            raise
        if not count:
            raise _broken(growing, str(error)) from error
    if not count:
        raise _broken(growing, "it holds no frame")
    durable.sync_file(target)
    return count


def frames(path: Path, first: int, count: int, fps: float, deep: bool = False) -> Iterator[np.ndarray]:
    """Frames `first` .. `first + count - 1` of the file, uint8 [H, W, 3]; DatasetError where one is missing.

    deep: of depth in a video of one channel of 16 bits, uint16 [H, W].
    """
    expected = first
    try:
        boxes.check(path)
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            bound(stream)
            if stream.width * stream.height > _LARGEST:
                raise _broken(path, f"it claims pictures of {stream.height}x{stream.width}")
            frames_a_tick = (stream.time_base or Fraction(0)) * Fraction(fps).limit_denominator(10_000)
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
                    raise _broken(path, f"frame {expected} has another size than it claims")
                yield reformatter.reformat(frame, format="gray16le" if deep else "rgb24").to_ndarray()
                expected += 1
                if expected == first + count:
                    return
    except (av.FFmpegError, OSError, IndexError, ZeroDivisionError, ValueError, OverflowError) as error:
        raise _broken(path, str(error)) from error
    raise _broken(path, f"frame {expected} is missing, {first + count} are needed")


def bound(stream) -> None:
    """Lets the stream's decoder refuse pictures of absurd size; ValueError where there is no decoder for it."""
    if stream.codec_context is None:
        raise ValueError("it is of an unknown codec")
    stream.codec_context.options = {"max_pixels": str(_LARGEST)}


def frames_at(path: Path, indices: Sequence[int], fps: float) -> np.ndarray:
    """uint8 [n, H, W, 3] of ascending, distinct frame numbers; seeks where that saves decoding."""
    found: list[np.ndarray] = []
    start = 0
    while start < len(indices):
        stop = start + 1
        while stop < len(indices) and indices[stop] - indices[stop - 1] <= KEYFRAME_EVERY:
            stop += 1
        wanted = set(indices[start:stop])
        run = frames(path, indices[start], indices[stop - 1] - indices[start] + 1, fps)
        found += [frame for at, frame in enumerate(run, indices[start]) if at in wanted]
        start = stop
    return np.stack(found)


class Frames(Sequence):
    """Frames `first` .. `first + count - 1` of a file, decoded when looked at; going on in order does not seek."""

    def __init__(self, path: Path, first: int, count: int, fps: float, deep: bool = False):
        self._path, self._first, self._count, self._fps, self._deep = path, first, count, fps, deep
        self._next, self._run = -1, iter(())

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._count))]
        if not -self._count <= index < self._count:
            raise IndexError(index)
        index = int(index) % self._count
        ahead = index - self._next
        if self._next < 0 or not 0 <= ahead <= 2 * KEYFRAME_EVERY:
            self._run = frames(self._path, self._first + index, self._count - index, self._fps, self._deep)
            ahead = 0
        self._next = -1  # until it is found
        for _ in range(ahead):
            next(self._run)
        frame = next(self._run)
        self._next = index + 1
        return frame


def count_frames(path: Path) -> int:
    """How many frames the file holds (read from its packets, nothing is decoded)."""
    try:
        boxes.check(path)
        with av.open(str(path)) as container:
            return sum(packet.size > 0 for packet in container.demux(video=0))
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise _broken(path, str(error)) from error


def count_whole(growing: Path) -> int:
    """How many frames of a growing file, whole or cut, are whole; 0 where there is none."""
    count = 0
    try:
        boxes.check(growing)
        with _Whole(growing) as grown, av.open(grown, "r") as container:
            for packet in container.demux(video=0):
                if packet.size == 0 or packet.is_corrupt:
                    break
                count += 1
    except (av.FFmpegError, OSError, IndexError, ValueError):
        pass
    return count


def _broken(path: Path, why: str) -> DatasetError:
    return DatasetError(
        f"the video {path} is missing, truncated or not H.264 mp4 ({why}); restore it from a copy, or remove its episode."
    )
