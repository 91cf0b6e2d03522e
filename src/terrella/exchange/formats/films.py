"""H.264 and H.265 as messages, one frame each: encoded one after another, decoded by number."""

from __future__ import annotations

import threading
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import numpy as np

from ...core.errors import DatasetError
from .messages import MAX_PIXELS

_HELD_BACK = 16  # messages after which a picture must have come out
_REMEMBERED = 4  # pictures
_CODECS = {"h264": "h264", "h265": "hevc"}
_KEY_UNITS = {"h264": (lambda byte: byte & 31, {5}), "h265": (lambda byte: byte >> 1 & 63, set(range(16, 22)))}


def h264_encoder(width: int, height: int) -> Callable[[np.ndarray], bytes]:
    """One message per frame: Annex B, no B-frames, the parameter sets with every keyframe."""
    options = {"preset": "veryfast", "tune": "zerolatency", "crf": "18", "g": "30", "bf": "0", "threads": "1"}
    codec: Any = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt, codec.options = width, height, "yuv420p", options
    codec.time_base = Fraction(1, 30)  # nobody reads it: each message has its own time
    count = 0

    def encode(value: np.ndarray) -> bytes:
        nonlocal count
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(value), format="rgb24")
        frame.pts, count = count, count + 1
        return b"".join(bytes(packet) for packet in codec.encode(frame))

    return encode


def decodable(read: Callable[[int], bytes], after_gap: np.ndarray, format: str) -> np.ndarray:
    """int64 [m], ascending: which messages of a film can be decoded: those from a keyframe on, up to the next gap.

    read(i) gives the data of message i; after_gap bool [n]: whether messages are missing just before message i.
    """
    if format not in _CODECS:
        raise DatasetError(f"its video is '{format}', and only h264 and h265 are read")
    found, good = [], False
    gaps = after_gap[1:].any()
    for i, gap in enumerate(after_gap.tolist()):
        good = good and not gap
        if not good:
            try:
                good = is_key(read(i), format)
            except DatasetError:
                continue
            if good and not gaps:  # nothing is missing after the first keyframe
                return np.arange(i, len(after_gap))
        if good:
            found.append(i)
    return np.array(found, np.int64)


def is_key(data: bytes, format: str) -> bool:
    """Whether a decoder can begin with this message."""
    at, (unit, keys) = -1, _KEY_UNITS[format]
    while (at := data.find(b"\x00\x00\x01", at + 1)) >= 0:
        if at + 3 < len(data) and unit(data[at + 3]) in keys:
            return True
    return False


class VideoDecoder:
    """Frames of a film by number, uint8 [H, W, 3].

    read(i) gives the data of message i of `count`, the first of which is a keyframe. Decoding starts at the last keyframe
    before what is asked for, and goes on from where it stands when frames are asked for in order. One thread decodes at
    a time.
    """

    def __init__(self, read: Callable[[int], bytes], count: int, format: str):
        self._read, self._count, self._format = read, count, format
        self._codec: Any = None
        self._fed, self._given = 0, -1  # the next message to decode, the last picture that came out
        self._frames: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()

    def __call__(self, index: int) -> np.ndarray:
        with self._lock:
            if index not in self._frames:
                self._go_to(index)
                try:
                    self._decode(index)
                except BaseException:
                    self._codec = None  # start anew, at a keyframe
                    raise
            return self._frames[index]

    def _go_to(self, index: int) -> None:
        ahead = self._codec is not None and index > self._given
        if ahead and index <= self._fed + 2:
            return
        key = next((i for i in range(index, -1, -1) if is_key(self._read(i), self._format)), None)
        if key is None:
            raise DatasetError("no keyframe comes before it")
        if not (ahead and key <= self._fed):
            self._codec = av.CodecContext.create(_CODECS[self._format], "r")
            self._codec.thread_count = 1
            self._codec.options = {"max_pixels": str(MAX_PIXELS)}
            self._fed, self._given, self._frames = key, key - 1, {}

    def _decode(self, index: int) -> None:
        while index not in self._frames:
            if self._fed > min(index + _HELD_BACK, self._count):
                raise DatasetError("it decodes to no picture")
            packet = None  # the end: what the decoder still holds comes out
            if self._fed < self._count:
                packet = av.Packet(self._read(self._fed))
                packet.pts = self._fed
            try:
                pictures = self._codec.decode(packet)
                self._fed += 1
                for picture in pictures:
                    if picture.pts is not None:
                        self._given = picture.pts
                        self._frames[picture.pts] = picture.to_ndarray(format="rgb24")
            except (av.FFmpegError, ValueError, MemoryError) as error:
                raise DatasetError(f"its video cannot be decoded ({error})") from error
            for old in list(self._frames)[:-_REMEMBERED]:
                if old != index:
                    del self._frames[old]
