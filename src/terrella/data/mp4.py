"""H.264 video files: an encoder that runs beside the world, and exact frame reading (PyAV)."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from ..core.errors import DatasetError

KEYFRAME_EVERY = 8
_CODEC = {
    "preset": "veryfast",
    "crf": "18",
    "tune": "fastdecode",
    "g": "8",
    "keyint_min": "8",
    "bf": "0",
    "threads": "1",
}
_MUXER = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}  # every fragment stands alone
_WAITING = 64  # frames that may wait for the encoder; then `add` waits, no frame is ever dropped


class Mp4Writer:
    """Encodes uint8 [H, W, 3] frames in a thread of its own; errors of that thread surface in `add` or `close`."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float):
        self._file = open(path, "wb")
        self._size = size
        self._rate = Fraction(fps).limit_denominator(10_000)
        self._frames: queue.Queue[np.ndarray | None] = queue.Queue(_WAITING)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mp4-writer", daemon=True)
        self._thread.start()

    def add(self, frame: np.ndarray) -> None:
        """Queues a frame that nobody changes afterwards."""
        if self._error:
            raise self._error
        self._frames.put(frame)

    def close(self) -> None:
        """Finishes the file and waits until it is on the disk."""
        self._frames.put(None)
        self._thread.join()
        try:
            if self._error:
                raise self._error
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

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
        with av.open(self._file, "w", format="mp4", options=_MUXER) as container:
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


def frames(path: Path, first: int, count: int, fps: float) -> Iterator[np.ndarray]:
    """Frames `first` .. `first + count - 1` of the file, uint8 [H, W, 3]; DatasetError where one is missing."""
    expected = first
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            frames_a_tick = (stream.time_base or Fraction(0)) * Fraction(fps).limit_denominator(10_000)
            if first:
                container.seek(round(first / frames_a_tick), stream=stream)
            for frame in container.decode(stream):
                at = round((frame.pts or 0) * frames_a_tick)
                if at < expected:
                    continue
                if at > expected:
                    break
                yield frame.to_ndarray(format="rgb24")
                expected += 1
                if expected == first + count:
                    return
    except (av.FFmpegError, OSError, IndexError, ZeroDivisionError) as error:
        raise _broken(path, str(error)) from error
    raise _broken(path, f"frame {expected} is missing, {first + count} are needed")


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


def count_frames(path: Path) -> int:
    """How many frames the file holds (read from its packets, nothing is decoded)."""
    try:
        with av.open(str(path)) as container:
            return sum(packet.size > 0 for packet in container.demux(video=0))
    except (av.FFmpegError, OSError, IndexError) as error:
        raise _broken(path, str(error)) from error


def _broken(path: Path, why: str) -> DatasetError:
    return DatasetError(
        f"the video {path} is missing, truncated or not H.264 mp4 ({why}); restore it from a copy, or remove its episode."
    )
