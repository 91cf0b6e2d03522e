"""Video frames by number; and H.264 and H.265 streams with one frame per message."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import av
import numpy as np

from ...core.errors import DatasetError
from .rows import MAX_PIXELS

_MAX_DELAY = 16  # messages after which the decoder must have returned a frame
_NEAR = 2  # frames ahead that are decoded without looking for a keyframe
_CODECS = {"h264": "h264", "h265": "hevc"}
_KEY_UNITS = {"h264": (lambda byte: byte & 31, {5}), "h265": (lambda byte: byte >> 1 & 63, set(range(16, 22)))}


class FrameReader:
    """Frames of a video by number, uint8 [H, W, 3]. In order, each is decoded once; a jump starts at the last keyframe.

    begin: (i) -> (number, frame) pairs from keyframe i on.
    key:   (i) -> the last keyframe that is not after frame i.
    show:  (frame) -> its picture.
    what:  the video's name in errors.
    One thread decodes at a time.
    """

    def __init__(
        self,
        begin: Callable[[int], Iterator[tuple[int, av.VideoFrame]]],
        key: Callable[[int], int],
        show: Callable[[av.VideoFrame], np.ndarray],
        what: str = "the video",
    ):
        self._what = what
        self._begin, self._key, self._show = begin, key, show
        self._run: Iterator[tuple[int, av.VideoFrame]] | None = None
        self._next, self._last = 0, (-1, np.zeros(0))
        self._lock = threading.Lock()

    def __call__(self, index: int) -> np.ndarray:
        """Frame `index`; DatasetError where it cannot be decoded."""
        with self._lock:
            if self._last[0] != index:
                try:
                    self._last = index, self._show(self._frame(index))
                except BaseException:
                    self._run = None
                    raise
            return self._last[1].copy()

    def release(self) -> None:
        """Closes the file until the next frame is read."""
        self._run = None

    def _frame(self, index: int) -> av.VideoFrame:
        if self._run is None or not 0 <= index - self._next <= _NEAR:
            key = self._key(index)
            if self._run is None or not key <= self._next <= index:
                self._run, self._next = self._begin(key), key
        for again in (False, True):
            if again:  # the container's index was wrong
                self._run = self._begin(0)
            for number, frame in self._run:
                self._next = number + 1
                if number == index:
                    return frame
                if number > index + _MAX_DELAY:
                    break
        raise DatasetError(f"frame {index} of {self._what} cannot be decoded; restore it from a copy.")


def decodable_messages(read: Callable[[int], bytes], after_gap: np.ndarray, format: str) -> np.ndarray:
    """int64 [m]: the messages, of data `read(i)`, that can be decoded: from each keyframe to the next gap. after_gap: bool [n],
    whether messages are missing just before message i."""
    if format not in _CODECS:
        raise DatasetError(f"its video is '{format}', and only h264 and h265 are read")
    numbers, decodable = [], False
    gaps = after_gap[1:].any()
    for i, gap in enumerate(after_gap.tolist()):
        decodable = decodable and not gap
        if not decodable:
            try:
                decodable = is_keyframe(read(i), format)
            except DatasetError:
                continue
            if decodable and not gaps:  # no message is missing after the first keyframe
                return np.arange(i, len(after_gap))
        if decodable:
            numbers.append(i)
    return np.array(numbers, np.int64)


def is_keyframe(data: bytes, format: str) -> bool:
    """Whether a decoder can start at this message."""
    at, (unit, keys) = -1, _KEY_UNITS[format]
    while (at := data.find(b"\x00\x00\x01", at + 1)) >= 0:
        if at + 3 < len(data) and unit(data[at + 3]) in keys:
            return True
    return False


def message_frames(read: Callable[[int], bytes], count: int, format: str) -> FrameReader:
    """The frames of `count` messages, the first a keyframe; read(i) is the data of message i."""

    def begin(key: int) -> Iterator[tuple[int, av.VideoFrame]]:
        codec: Any = av.CodecContext.create(_CODECS[format], "r")
        codec.thread_count = 1
        codec.options = {"max_pixels": str(MAX_PIXELS)}
        seen = key
        for i in range(key, count + 1):
            if i > seen + _MAX_DELAY:
                raise DatasetError("it cannot be decoded")
            packet = None  # at the end, flushes the decoder
            if i < count:
                packet = av.Packet(read(i))
                packet.pts = i
            try:
                frames = codec.decode(packet)
            except (av.FFmpegError, ValueError, MemoryError) as error:
                raise DatasetError(f"its video cannot be decoded ({error})") from error
            for frame in frames:
                if frame.pts is not None:
                    seen = i
                    yield frame.pts, frame

    def last_key(index: int) -> int:
        for i in range(index, -1, -1):
            if is_keyframe(read(i), format):
                return i
        raise DatasetError("no keyframe comes before it")

    return FrameReader(begin, last_key, lambda frame: frame.to_ndarray(format="rgb24"))
