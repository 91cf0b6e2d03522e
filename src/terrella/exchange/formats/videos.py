"""Folders of plain videos, without actions: read with their true times, and written."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from ...data.storage import durable
from . import folders, rows
from .suffixes import VIDEOS

_CLOCK = Fraction(1, 1_000_000)  # ticks of the videos written
_LOSSY = {"preset": "veryfast", "crf": "18", "g": "8", "bf": "0", "threads": "1"}
_LOSSLESS = {"preset": "veryfast", "qp": "0", "g": "8", "bf": "0", "threads": "1"}


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of videos as a Source of pictures alone.

    Videos in the folder itself are one take each, of the camera "observation.images.rgb". Or the folder has sub-folders:
    each is one take, and each video in it a camera named after its file ("front.mp4": "observation.images.front"). Takes
    are in the natural order of their names. Any container that PyAV reads; other files are ignored.

    time_s are the file's own presentation times, counted from the take's first frame; they need not be even. A phone's
    rotation is applied. Frames are decoded when looked at: one after another without seeking, others from the last
    keyframe on. DatasetError where there are no videos, one is damaged, of absurd size, or not of its camera's size.
    """
    path = Path(path)
    takes = folders.takes_of(path, VIDEOS, "videos", deep=False)
    sensors = {}
    for folder in takes.values():
        for camera, files in folder.items():
            name = f"{rows.IMAGES}{camera}"
            if name not in sensors:
                video = _Video(files[0])
                sensors[name] = Sensor(name, "image", video.shape, "uint8", rate_hz=video.rate_hz)
    return Source(
        name=path.name,
        sensors=sensors,
        takes=lambda: (_video_take(name, folder, sensors) for name, folder in takes.items()),
    )


def _video_take(name: str, folder: Mapping[str, list[Path]], sensors: Mapping[str, Sensor]) -> Take:
    videos = {f"{rows.IMAGES}{camera}": _Video(files[0]) for camera, files in folder.items()}
    for sensor, video in videos.items():
        if video.shape != sensors[sensor].shape:
            size, want = (f"{shape[1]} x {shape[0]}" for shape in (video.shape, sensors[sensor].shape))
            raise DatasetError(
                f"{video.path} is {size} where the first of its camera is {want}; keep sizes in folders of their own."
            )
    begin = min(video.time_s[0] for video in videos.values())
    readings = {n: Readings(v.time_s - begin, Lazy(len(v.time_s), v.frame)) for n, v in videos.items()}
    return Take(readings, facts={"file": name})


class _Video:
    """One video file: when its frames are shown, and the frames. It is open only while frames are looked at."""

    def __init__(self, path: Path):
        self.path = path
        self._frames: Iterator[av.VideoFrame] | None = None  # being decoded
        self._following = 0  # number of the frame that comes next
        self._last: tuple[int, np.ndarray] | None = None
        with _opened(path) as (container, stream):
            rows.check_size(stream.height, stream.width, f"the video {path}")
            tick = stream.time_base or Fraction(1, 1000)
            self.rate_hz = float(stream.average_rate) if stream.average_rate else None
            shown = [(p.pts, p.is_keyframe) for p in container.demux(stream) if p.size and not p.is_discard]
        self._ticks = sorted({pts for pts, _ in shown if pts is not None})
        self._timed = len(self._ticks) == len(shown)  # whether each frame has a time of its own
        self._keys = [i for i, pts in enumerate(self._ticks) if (pts, True) in set(shown)] if self._timed else []
        first = next(self._decoded(None), None)
        if first is None:
            raise DatasetError(f"the video {path} has no frames; remove it, or restore it from a copy.")
        self.shape = self._upright(first).shape
        times = [float(pts * tick) for pts in self._ticks] if self._timed else self._times_by_decoding()
        self.time_s = np.array(times, np.float64)

    def frame(self, i: int) -> np.ndarray:
        """Frame i, uint8 [H, W, 3]."""
        if self._last is not None and self._last[0] == i:
            return self._last[1].copy()
        key = self._keys[bisect.bisect_right(self._keys, i) - 1] if self._keys and self._keys[0] <= i else 0
        if self._frames is None or i < self._following or key > self._following:
            self._begin(self._ticks[key] if key else None)
        found = self._advance(i)
        if found is None:  # the container's index led elsewhere
            self._begin(None)
            found = self._advance(i)
        if found is None:
            self._frames = None
            raise DatasetError(f"frame {i} of the video {self.path} is missing or damaged; restore it from a copy.")
        picture = self._upright(found)
        if picture.shape != self.shape:
            raise DatasetError(f"the video {self.path} changes its size at frame {i}; cut it in two.")
        self._last = (i, picture)
        if i == len(self.time_s) - 1:
            self._frames = None  # closes the file
        return picture.copy()

    def _begin(self, seek_to: int | None) -> None:
        self._frames, self._following = self._decoded(seek_to), 0

    def _advance(self, i: int) -> av.VideoFrame | None:
        """Decodes up to frame i; None where it does not come."""
        for frame in self._frames or ():
            number = self._number(frame) if self._timed else self._following
            if number is not None:
                self._following = number + 1
                if number >= i:
                    return frame if number == i else None
        return None

    def _number(self, frame: av.VideoFrame) -> int | None:
        at = bisect.bisect_left(self._ticks, frame.pts) if frame.pts is not None else len(self._ticks)
        return at if at < len(self._ticks) and self._ticks[at] == frame.pts else None

    def _decoded(self, seek_to: int | None) -> Iterator[av.VideoFrame]:
        with _opened(self.path) as (container, stream):
            if seek_to is not None:
                container.seek(seek_to, stream=stream)
            yield from container.decode(stream)

    def _upright(self, frame: av.VideoFrame) -> np.ndarray:
        rows.check_size(frame.height, frame.width, f"the video {self.path}")
        turns = round(frame.rotation / 90) % 4
        picture = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture

    def _times_by_decoding(self) -> list[float]:
        times = [frame.time for frame in self._decoded(None)]
        known = [time for time in times if time is not None]
        if len(known) == len(times) and all(a < b for a, b in zip(known, known[1:])):
            return known
        return [i / (self.rate_hz or rows.FPS_UNKNOWN) for i in range(len(times))]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A video and its first stream of pictures; what FFmpeg stumbles over inside is a DatasetError.

    FFmpeg gets an open file and may open no other, so that no playlist leads it out of the folder.
    """
    try:
        with open(path, "rb") as file, av.open(file, "r", options={"protocol_whitelist": "none"}) as container:
            if not container.streams.video or container.streams.video[0].codec_context is None:
                raise DatasetError(f"{path} has no pictures that can be decoded; remove it from the folder of videos.")
            yield container, container.streams.video[0]
    except (av.FFmpegError, OSError, ValueError, MemoryError) as error:
        raise DatasetError(
            f"the video {path} is missing, damaged or of an unknown kind ({error}); restore it."
        ) from error


def write(
    source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None, lossless: bool = False
) -> list[str]:
    """Writes a source's pictures as mp4 files in a folder as `read` reads it; returns what had no place in it.

    take_0.mp4, take_1.mp4, … where the only camera is "observation.images.rgb", else take_0/CAMERA.mp4. Times are kept to
    the microsecond. H.264 in 4:2:0, which every player shows, loses a little and needs even sizes; `lossless` keeps every
    value, of any size, as H.264 in RGB, which FFmpeg's players show. `progress(takes, 0)` is called after each take.
    DatasetError for odd sizes (unless lossless), frames at the same time, no pictures at all, or where `path` exists.
    """
    cameras, notes = folders.cameras(source, ("image",), "a video")
    for name in cameras:
        height, width = source.sensors[name].shape[:2]
        if not lossless and (height % 2 or width % 2):
            raise DatasetError(
                f"'{name}' is {width} x {height}; H.264 needs even sizes: crop it, or write it as images."
            )
    with durable.in_whole(path) as staged:
        staged.mkdir()
        for number, take in folders.numbered(source, cameras, progress):
            begin = min(float(take.readings[name].time_s[0]) for name in cameras if name in take.readings)
            for name, camera in cameras.items():
                if name in take.readings:
                    file = staged / f"take_{number}" / f"{camera}.mp4"
                    file = staged / f"take_{number}.mp4" if list(cameras) == [folders.CAMERA] else file
                    file.parent.mkdir(exist_ok=True)
                    _encode(file, source.sensors[name], take.readings[name], begin, lossless, f"take {number}")
    return notes


def _encode(path: Path, sensor: Sensor, readings: Readings, begin: float, lossless: bool, where: str) -> None:
    ticks = np.rint((readings.time_s - begin) / float(_CLOCK)).astype(np.int64)
    if (np.diff(ticks) <= 0).any():
        raise DatasetError(f"'{sensor.name}' in {where} has two pictures within a microsecond; drop one of them.")
    height, width, _ = sensor.shape
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(
            "libx264rgb" if lossless else "libx264", options=_LOSSLESS if lossless else _LOSSY
        )
        stream.width, stream.height, stream.pix_fmt = width, height, "rgb24" if lossless else "yuv420p"
        stream.time_base = stream.codec_context.time_base = _CLOCK
        row = 0
        for part in rows.batches(readings.values, sensor, where, size=8):
            for picture in part:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                frame.pts, frame.time_base = int(ticks[row]), _CLOCK
                container.mux(stream.encode(frame))
                row += 1
        container.mux(stream.encode())
