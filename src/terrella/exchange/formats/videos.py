"""Folders of videos without actions, read with their true frame times, and written."""

import bisect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from ...core.errors import DatasetError
from ...core.files import creating
from ...core.video import film_of, media_address, square_width
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import folders, rows
from .folders import VIDEOS
from .video_frames import FrameReader

_CLOCK = Fraction(1, 1_000_000)  # ticks of the videos written
_CODEC = {"preset": "veryfast", "crf": "18", "g": "8", "bf": "0", "threads": "1"}


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of videos as a Source of pictures.

    Either each video in the folder is one take of the camera "observation.images.rgb"; or each subfolder is one take, and
    each video in it a camera named after its file ("front.mp4": "observation.images.front"). Takes are in the natural order
    of their names. Every container that PyAV reads is accepted; other files are ignored.

    time_s are the file's presentation times, from the take's first frame on; they may be uneven. A phone's rotation is
    applied, and pixels that are not square are made so by another width. Of several films in a file the longest is read; a
    take's notes name the others, and sound. Frames are decoded when read, without seeking if in order. DatasetError where
    there are no videos, or one is damaged, too large, or of another size than its camera's first.
    """
    path = Path(path)
    takes = folders.takes_of(path, VIDEOS, "videos", deep=False)
    sensors = {}
    for folder in takes.values():
        for camera, files in folder.items():
            name = f"{rows.IMAGES}{camera}"
            if name not in sensors:
                video = _video(files[0])
                sensors[name] = Sensor(name, "image", video.shape, "uint8", rate_hz=video.rate_hz)
    return Source(
        name=path.name,
        sensors=sensors,
        takes=lambda: (_video_take(name, folder, sensors) for name, folder in takes.items()),
    )


def _video_take(name: str, folder: Mapping[str, list[Path]], sensors: Mapping[str, Sensor]) -> Take:
    videos = {f"{rows.IMAGES}{camera}": _video(files[0]) for camera, files in folder.items()}
    for sensor, video in videos.items():
        if video.shape != sensors[sensor].shape:
            size, want = (f"{shape[1]} x {shape[0]}" for shape in (video.shape, sensors[sensor].shape))
            raise DatasetError(f"{video.path} is {size} where the first of its camera is {want}; keep them apart.")
    begin = min(video.time_s[0] for video in videos.values())
    readings = {n: Readings(v.time_s - begin, Lazy(len(v.time_s), v.frame)) for n, v in videos.items()}
    left_out = dict.fromkeys(note for video in videos.values() for note in video.left_out)
    return Take(readings, facts={"file": name}, notes=tuple(left_out))


@dataclass(frozen=True)
class _Video:
    """One video file: its frame times and frames. It is open only while frames are read."""

    path: Path
    shape: tuple[int, ...]
    rate_hz: float | None
    time_s: np.ndarray
    frames: FrameReader
    left_out: tuple[str, ...]  # notes on further streams of the file

    def frame(self, i: int) -> np.ndarray:
        picture = self.frames(i)
        if picture.shape != self.shape:
            raise DatasetError(f"the video {self.path} changes its size at frame {i}; cut it in two.")
        if i == len(self.time_s) - 1:
            self.frames.release()
        return picture


def _video(path: Path) -> _Video:
    with _opened(path) as container:
        film = film_of(container)
    with _opened(path) as container:
        stream = container.streams.video[film]
        left_out = _further_streams(container, stream)
        coded, width = stream.width, square_width(stream, stream.width)
        rows.check_size(stream.height, width, f"the video {path}")
        tick = stream.time_base or Fraction(1, 1000)
        rate_hz = float(stream.average_rate) if stream.average_rate else None
        shown = [(p.pts, p.is_keyframe) for p in container.demux(stream) if p.size and not p.is_discard]
    ticks = sorted({pts for pts, _ in shown if pts is not None})
    place: dict[int | None, int] = {pts: i for i, pts in enumerate(ticks)}
    timed = len(ticks) == len(shown)  # every frame has its own time
    keys = sorted({0, *(place[pts] for pts, is_key in shown if is_key)}) if timed else [0]

    def begin(key: int) -> Iterator[tuple[int, av.VideoFrame]]:
        for i, frame in enumerate(_decoded(path, film, ticks[key] if key else None)):
            number = place.get(frame.pts, -1) if timed else i
            if number >= 0:
                yield number, frame

    def show(frame: av.VideoFrame) -> np.ndarray:
        rows.check_size(frame.height, frame.width, f"the video {path}")
        turns = round(frame.rotation / 90) % 4
        if width != coded == frame.width:
            frame = frame.reformat(width=width, format="rgb24", interpolation="BICUBIC")
        picture = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture

    first = next(_decoded(path, film, None), None)
    if first is None:
        raise DatasetError(f"the video {path} has no frames; remove it, or restore it from a copy.")
    times = [float(pts * tick) for pts in ticks]
    if not timed:
        times = [frame.time for frame in _decoded(path, film, None)]
        if None in times or any(a >= b for a, b in zip(times, times[1:])):
            times = [i / (rate_hz or rows.FPS_UNKNOWN) for i in range(len(times))]
    frames = FrameReader(begin, lambda i: keys[bisect.bisect_right(keys, i) - 1], show, f"the video {path}")
    return _Video(path, show(first).shape, rate_hz, np.array(times, np.float64), frames, left_out)


def _further_streams(container: InputContainer, film: VideoStream) -> tuple[str, ...]:
    """Notes on everything in a file but its film."""
    notes = []
    for stream in container.streams:
        if stream.type == "audio":
            notes.append("the sound of videos was left out.")
        elif isinstance(stream, VideoStream) and stream.index != film.index:
            size = f"{stream.width} x {stream.height}" if stream.codec_context else "unknown size"
            notes.append(f"a further stream of pictures ({size}) in videos was left out: the longest film is read.")
        elif not isinstance(stream, VideoStream):
            notes.append(f"a stream of {stream.type or 'unknown kind'} in videos was left out.")
    return tuple(notes)


def _decoded(path: Path, film: int, seek_to: int | None) -> Iterator[av.VideoFrame]:
    with _opened(path) as container:
        stream = container.streams.video[film]
        if seek_to is not None:
            container.seek(seek_to, stream=stream)
        yield from container.decode(stream)


@contextmanager
def _opened(path: Path) -> Iterator[InputContainer]:
    """A video; FFmpeg's errors become a DatasetError. FFmpeg gets an open file and may open no other,
    so that a playlist cannot lead it out of the folder."""
    try:
        with open(path, "rb") as file, av.open(file, "r", options={"protocol_whitelist": "none"}) as container:
            if not any(stream.codec_context for stream in container.streams.video):
                raise DatasetError(f"{path} has no pictures that can be decoded; remove it from the folder of videos.")
            yield container
    except (av.FFmpegError, OSError, ValueError, MemoryError) as error:
        raise DatasetError(f"the video {path} is missing, damaged or unknown ({error}); restore it.") from error


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source's pictures as a folder of mp4 files, as `read` reads it; returns a note on everything left out.

    Files are take_0.mp4, take_1.mp4, … if the only camera is "observation.images.rgb", else take_0/CAMERA.mp4. Times are
    kept to the microsecond. H.264 in 4:2:0, which every player shows, is slightly lossy and needs even sizes.
    `progress(takes, 0)` is called after each take. DatasetError for odd sizes, two frames at one time, no pictures, or
    where `path` exists.
    """
    cameras, notes = folders.cameras(source, ("image",), "a video")
    for name in cameras:
        height, width = source.sensors[name].shape[:2]
        if height % 2 or width % 2:
            raise DatasetError(f"'{name}' is {width} x {height}; H.264 needs even sizes: crop it, or write images.")
    with creating(path) as staged:
        staged.mkdir()
        for number, take in folders.numbered(source, cameras, progress):
            begin = min(float(take.readings[name].time_s[0]) for name in cameras if name in take.readings)
            for name, camera in cameras.items():
                if name in take.readings:
                    file = staged / f"take_{number}" / f"{camera}.mp4"
                    file = staged / f"take_{number}.mp4" if list(cameras) == [folders.CAMERA] else file
                    file.parent.mkdir(exist_ok=True)
                    _encode(file, source.sensors[name], take.readings[name], begin, f"take {number}")
    return notes


def _encode(path: Path, sensor: Sensor, readings: Readings, begin: float, where: str) -> None:
    ticks = np.rint((readings.time_s - begin) / float(_CLOCK)).astype(np.int64)
    if (np.diff(ticks) <= 0).any():
        raise DatasetError(f"'{sensor.name}' in {where} has two pictures within a microsecond; drop one of them.")
    height, width, _ = sensor.shape
    with av.open(media_address(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", options=_CODEC)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = _CLOCK
        row = 0
        for part in rows.batches(readings.values, sensor, where, size=8):
            for picture in part:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                frame.pts, frame.time_base = int(ticks[row]), _CLOCK
                container.mux(stream.encode(frame))
                row += 1
        container.mux(stream.encode())
