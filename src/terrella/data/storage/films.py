"""Videos as packets: which frames a file holds, where it may be cut, and cutting without encoding anew."""

from __future__ import annotations

import hashlib
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from ...core import files
from ...core.errors import DatasetError
from . import mp4
from .mp4 import Mp4Writer

_MOST = 50_000_000  # frames of one file; more is damage
_PACKED, _ZEROS = ("h264", "hevc", "av1", "libdav1d", "vp9"), bytes(24)  # entropy coding leaves no such run of zeros


@dataclass(frozen=True)
class Reel:
    """The packets of a video in the order of its file.

    frames:  int64 [n]: which frame (by its time and the rate) each packet is.
    keys:    bool [n]: whether decoding may begin there.
    digests: bytes of n: 8 of each packet, equal where packets are.
    zeroed:  bool [n]: whether a part of it was overwritten with zeros, as no encoder writes them.
    """

    frames: np.ndarray
    keys: np.ndarray
    digests: np.ndarray
    zeroed: np.ndarray

    @property
    def count(self) -> int:
        """Frames from the first on without a gap."""
        there = np.unique(self.frames[self.frames >= 0])
        return int(np.searchsorted(there - np.arange(len(there)), 1))


def reel(path: Path, fps: float) -> Reel:
    """Reads the packets, decodes nothing; DatasetError where the file is none."""
    found, keys, digests, zeroed = [], [], [], []
    try:
        with mp4.opened(path) as (container, stream):
            a_tick = mp4.ticks(stream, fps)
            codec = stream.codec_context.name if stream.codec_context else ""
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_corrupt or packet.pts is None or len(found) == _MOST:
                    break
                found.append(round(packet.pts * a_tick))
                keys.append(packet.is_keyframe)
                raw = bytes(packet)
                digests.append(hashlib.blake2b(raw, digest_size=8).digest())
                zeroed.append(codec in _PACKED and _ZEROS in raw)
    except mp4.BROKEN as error:
        if not found:
            raise mp4.broken(path, str(error)) from error
    frames = np.array(found, np.int64) if all(abs(at) < 2**62 for at in found) else np.full(len(found), -1)
    return Reel(frames, np.array(keys, bool), np.array(digests, "V8"), np.array(zeroed, bool))


def cut(path: Path, first: int, count: int, fps: float, target: Path, packed: Reel) -> bool:
    """Frames `first` .. `first + count - 1` of a video as one of its own.

    True where its packets were copied; False where they had to be decoded and encoded again. DatasetError where a frame
    cannot be had.
    """
    begin = np.flatnonzero(packed.frames == first)
    if len(begin) == 1 and packed.keys[begin[0]]:
        at = int(begin[0])
        packets = packed.frames[at : at + count]
        if len(packets) == count and np.array_equal(np.sort(packets), first + np.arange(count)):
            if first == 0 and len(packed.frames) == count:
                shutil.copyfile(path, target)
            else:
                try:
                    mp4.finish(path, target, count, at)
                except (DatasetError, *mp4.BROKEN) as error:  # what this mp4 writer cannot hold may still be decoded
                    if getattr(error, "errno", None) in files.FULL:
                        raise
            with suppress(DatasetError):
                if np.array_equal(np.sort(reel(target, fps).frames), np.arange(count)):
                    files.sync_file(target)
                    return True
    _encode(path, first, count, fps, target)
    return False


def _encode(path: Path, first: int, count: int, fps: float, target: Path) -> None:
    growing, writer = target.with_suffix(".again.mp4"), None
    try:
        for frame in mp4.frames(path, first, count, fps):
            if writer is None:
                height, width = frame.shape[:2]
                if height % 2 or width % 2:
                    raise DatasetError(
                        f"{path} must be encoded again, but H.264 cannot hold its {height}x{width} pixels."
                    )
                writer = Mp4Writer(growing, (height, width), fps)
            writer.add(frame)
        if writer:
            writer.close()
            mp4.finish(growing, target, count)
    finally:
        if writer:
            writer.abandon()
        growing.unlink(missing_ok=True)


def whole_frames(path: Path, first: int, count: int, fps: float) -> np.ndarray:
    """bool [count]: which of the frames can be decoded, all that they refer to included. Every one is tried."""
    good = np.zeros(count, bool)
    try:
        with mp4.opened(path) as (container, stream):
            mp4.bound(stream)
            a_tick = mp4.ticks(stream, fps)
            if first:
                container.seek(round(first / a_tick), stream=stream)
            lost = False
            for packet in container.demux(stream):
                lost = lost and not packet.is_keyframe
                try:
                    for frame in packet.decode():
                        at = round((frame.pts or 0) * a_tick) - first
                        lost |= frame.is_corrupt
                        if 0 <= at < count and not lost:
                            good[at] = True
                        elif at >= count + mp4.KEYFRAME_EVERY:
                            return good
                except av.FFmpegError:
                    lost = True
    except mp4.BROKEN:
        pass
    return good
