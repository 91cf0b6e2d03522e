"""Videos as packets: which frames a file holds, and cutting it, where possible without encoding it again."""

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
_PACKED = ("h264", "hevc", "av1", "libdav1d", "vp9")  # entropy-coded packets, which never contain this run of zeros
_ZEROS = bytes(24)


@dataclass(frozen=True)
class Packets:
    """The n packets of a video, in the order of the file."""

    frames: np.ndarray  # int64 [n], frame number of each packet, by its time and the rate
    keys: np.ndarray  # bool [n], whether it is a keyframe
    digests: np.ndarray  # [n], 8 bytes of a hash of each packet
    zeroed: np.ndarray  # bool [n], whether a part of it was overwritten with zeros

    @property
    def count(self) -> int:
        """Number of frames from frame 0 up to the first gap."""
        frames = np.unique(self.frames[self.frames >= 0])
        return int(np.searchsorted(frames - np.arange(len(frames)), 1))


def read_packets(path: Path, fps: float) -> Packets:
    """Reads the packets without decoding; DatasetError where the file is not a video."""
    times, keys, digests, zeroed = [], [], [], []
    try:
        with mp4.open_video(path) as (container, stream):
            a_tick = mp4.frames_per_tick(stream, fps)
            codec = stream.codec_context.name if stream.codec_context else ""
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_corrupt or packet.pts is None or len(times) == _MOST:
                    break
                times.append(round(packet.pts * a_tick))
                keys.append(packet.is_keyframe)
                raw = bytes(packet)
                digests.append(hashlib.blake2b(raw, digest_size=8).digest())
                zeroed.append(codec in _PACKED and _ZEROS in raw)
    except mp4.BROKEN as error:
        if not times:
            raise mp4.broken_video(path, str(error)) from error
    frames = np.array(times, np.int64) if all(abs(at) < 2**62 for at in times) else np.full(len(times), -1)
    return Packets(frames, np.array(keys, bool), np.array(digests, "V8"), np.array(zeroed, bool))


def cut_video(path: Path, first: int, count: int, fps: float, target: Path, packed: Packets) -> bool:
    """Writes frames `first` to `first + count - 1` of a video to `target`.

    True where packets were copied, False where they were encoded again. DatasetError where a frame cannot be decoded.
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
                    mp4.finish_video(path, target, count, at)
                except (DatasetError, *mp4.BROKEN) as error:  # packets that cannot be copied may still be decoded
                    if getattr(error, "errno", None) in files.FULL:
                        raise
            with suppress(DatasetError):
                if np.array_equal(np.sort(read_packets(target, fps).frames), np.arange(count)):
                    files.sync_file(target)
                    return True
    _encode(path, first, count, fps, target)
    return False


def _encode(path: Path, first: int, count: int, fps: float, target: Path) -> None:
    growing, writer = target.with_suffix(".again.mp4"), None
    try:
        for frame in mp4.decode_frames(path, first, count, fps):
            if writer is None:
                height, width = frame.shape[:2]
                if height % 2 or width % 2:
                    raise DatasetError(f"{path} must be encoded again, which H.264 cannot for {height}x{width} pixels.")
                writer = Mp4Writer(growing, (height, width), fps)
            writer.add(frame)
        if writer:
            writer.close()
            mp4.finish_video(growing, target, count)
    finally:
        if writer:
            writer.abandon()
        growing.unlink(missing_ok=True)


def whole_frames(path: Path, first: int, count: int, fps: float) -> np.ndarray:
    """bool [count]: the frames that can be decoded, with all frames that they refer to. Decodes every frame."""
    good = np.zeros(count, bool)
    try:
        with mp4.open_video(path) as (container, stream):
            mp4.limit_pixels(stream)
            a_tick = mp4.frames_per_tick(stream, fps)
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
