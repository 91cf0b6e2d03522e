"""Videos of others: how FFmpeg is given a file, which of its streams is the film, and the form of its pixels."""

from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

_COVERS = ("attached_pic", "timed_thumbnails", "still_image")
_WIDEST = 8  # ratio of a pixel's sides; more is damage


def media_address(path: str | Path) -> str:
    """A local file as FFmpeg takes it. A bare name with a colon ("10:30.mp4", "concat:a") would be a protocol to it."""
    return f"file:{path}"


def film_of(container: "InputContainer") -> int:
    """The place in `container.streams.video` of the film: no cover picture; of several films the longest, then the first.

    May read all packets: open the file again before reading frames. ValueError where there are no pictures.
    """
    films = {at: stream for at, stream in enumerate(container.streams.video) if stream.codec_context is not None}
    moving = {at: stream for at, stream in films.items() if not _is_cover(stream)} or films
    if not moving:
        raise ValueError("it has no pictures that can be decoded")
    if len(moving) == 1:
        return next(iter(moving))
    packets = container.demux(list(moving.values()))
    counts = Counter(packet.stream.index for packet in packets if packet.size)
    return max(moving, key=lambda at: counts[moving[at].index])


def _is_cover(stream: "VideoStream") -> bool:
    from av.stream import Disposition

    return any(stream.disposition & Disposition[name] for name in _COVERS)


def square_width(stream: "VideoStream", width: int) -> int:
    """The width, in pixels and even, at which pictures `width` wide have square pixels; their height stays."""
    ratio = stream.sample_aspect_ratio or Fraction(1)
    if ratio == 1 or not 1 / _WIDEST <= ratio <= _WIDEST:
        return width
    return max(2, 2 * round(width * ratio / 2))
