"""H.264 video files: an encoder that runs in parallel with the world, and exact frame reading (PyAV)."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from ...core.errors import DatasetError
from ..source import Lazy
from . import boxes, durable

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


@contextmanager
def opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A video's container and its first stream; one of BROKEN where it is none."""
    boxes.check(path)
    with av.open(str(path), "r") as container:
        yield container, container.streams.video[0]


def ticks(stream: VideoStream, fps: float) -> Fraction:
    """Frames of a video of `fps` that one tick of its stream's clock is."""
    return (stream.time_base or Fraction(0)) * Fraction(fps).limit_denominator(10_000)


def finish(growing: Path, target: Path, frames: int | None = None) -> int:
    """Copies a grown file, which is cut after its last whole frame, to `target` with its index in front.

    At most `frames` are taken; returns how many it holds. Nothing is encoded anew. DatasetError where not one is whole.
    """
    count, options = 0, FINISHED
    try:
        boxes.trim(growing)
        with opened(growing) as (source, stream), av.open(str(target), "w", format="mp4", options=options) as copy:
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
            raise broken(growing, str(error)) from error
    if not count:
        raise broken(growing, "it holds no frame")
    durable.sync_file(target)
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
