"""Folders of plain videos and of images, without actions: read with their true times, and written."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import rows
from .suffixes import IMAGES, VIDEOS

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM")
_TURNS = {  # EXIF orientation -> what undoes it
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_ON_ITS_SIDE = {_TURNS[orientation] for orientation in (5, 6, 7, 8)}
_CAMERA = f"{rows.IMAGES}{rows.CAMERA}"
_MM = 1000.0
_CLOCK = Fraction(1, 1_000_000)  # ticks of the videos written
_LOSSY = {"preset": "veryfast", "crf": "18", "g": "8", "bf": "0", "threads": "1"}
_LOSSLESS = {"preset": "veryfast", "qp": "0", "g": "8", "bf": "0", "threads": "1"}


# -- videos


def read_videos(path: str | Path, fps: float | None = None) -> Source:
    """A folder of videos as a Source of pictures alone.

    Videos in the folder itself are one take each, of the camera "observation.images.rgb". Or the folder has sub-folders:
    each is one take, and each video in it a camera named after its file ("front.mp4": "observation.images.front"). Takes
    are in the natural order of their names. Any container that PyAV reads; other files are ignored.

    time_s are the file's own presentation times, counted from the take's first frame; they need not be even. A phone's
    rotation is applied. Frames are decoded when looked at: one after another without seeking, others from the last
    keyframe on. DatasetError where there are no videos, one is damaged, of absurd size, or not of its camera's size.
    """
    path = Path(path)
    takes = _takes_of(path, VIDEOS, "videos", deep=False)
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


def _takes_of(path: Path, suffixes: frozenset[str], what: str, deep: bool) -> dict[str, dict[str, list[Path]]]:
    """Take -> camera -> its files, by the rule of `read_videos` (or, `deep`, of `read_images`)."""
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; name a folder of {what}.")
    here, folders = _listed(path, suffixes)
    inside = {folder.name: _listed(folder, suffixes) for folder in folders}
    if deep:
        found = {}
        if here:
            found[path.name] = {rows.CAMERA: here}
        for name, (files, below) in inside.items():
            cameras = {_clean(sub.name): _listed(sub, suffixes)[0] for sub in below}
            cameras = {camera: images for camera, images in cameras.items() if images}
            if files and cameras:
                raise DatasetError(f"{path / name} has images and folders of images; keep the one or the other in it.")
            if files or cameras:
                found[name] = cameras or {rows.CAMERA: files}
    else:
        found = {file.stem: {rows.CAMERA: [file]} for file in here}
        if len(found) < len(here):
            found = {file.name: {rows.CAMERA: [file]} for file in here}
        for name, (files, _) in inside.items():
            cameras = {_clean(file.stem): [file] for file in files}
            if len(cameras) < len(files):
                raise DatasetError(f"{path / name} has two videos of the same name; a camera has one in each take.")
            if files:
                found[name] = cameras
    if here and any(files or below for files, below in inside.values()) and len(found) > (1 if deep else len(here)):
        raise DatasetError(f"{path} has {what} beside folders of {what}; keep the one or the other in it.")
    if not found:
        raise DatasetError(f"{path} has no {what} ({', '.join(sorted(suffixes))}); name a folder that has.")
    return found


def _listed(folder: Path, suffixes: frozenset[str]) -> tuple[list[Path], list[Path]]:
    """Files with one of the suffixes, and folders, in their natural order; hidden ones are ignored."""
    every = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: rows.natural(p.name))
    return [p for p in every if p.suffix.lower() in suffixes and p.is_file()], [p for p in every if p.is_dir()]


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
        self._told = len(self._ticks) == len(shown)  # whether each frame has a time of its own
        self._keys = [i for i, pts in enumerate(self._ticks) if (pts, True) in set(shown)] if self._told else []
        first = next(self._decoded(None), None)
        if first is None:
            raise DatasetError(f"the video {path} has no frames; remove it, or restore it from a copy.")
        self.shape = self._upright(first).shape
        times = [float(pts * tick) for pts in self._ticks] if self._told else self._times_by_decoding()
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
            number = self._number(frame) if self._told else self._following
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
        told = [time for time in times if time is not None]
        if len(told) == len(times) and all(a < b for a, b in zip(told, told[1:])):
            return told
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


def write_videos(
    source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None, lossless: bool = False
) -> list[str]:
    """Writes a source's pictures as mp4 files in a folder as `read_videos` reads it; returns what had no place in it.

    take_0.mp4, take_1.mp4, … where the only camera is "observation.images.rgb", else take_0/CAMERA.mp4. Times are kept to
    the microsecond. H.264 in 4:2:0, which every player shows, loses a little and needs even sizes; `lossless` keeps every
    value, of any size, as H.264 in RGB, which FFmpeg's players show. `progress(takes, 0)` is called after each take.
    DatasetError for odd sizes (unless lossless), frames at the same time, no pictures at all, or where `path` exists.
    """
    cameras, notes = _cameras(source, ("image",), "a video")
    for name in cameras:
        height, width = source.sensors[name].shape[:2]
        if not lossless and (height % 2 or width % 2):
            raise DatasetError(
                f"'{name}' is {width} x {height}; H.264 needs even sizes: crop it, or write it lossless."
            )
    with rows.fresh(path) as staged:
        staged.mkdir()
        for number, take in _numbered(source, cameras, progress):
            begin = min(float(take.readings[name].time_s[0]) for name in cameras if name in take.readings)
            for name, camera in cameras.items():
                if name in take.readings:
                    file = staged / f"take_{number}" / f"{camera}.mp4"
                    file = staged / f"take_{number}.mp4" if list(cameras) == [_CAMERA] else file
                    file.parent.mkdir(exist_ok=True)
                    _encode(file, source.sensors[name], take.readings[name], begin, lossless, f"take {number}")
    return notes


def _cameras(source: Source, kinds: tuple[str, ...], what: str) -> tuple[dict[str, str], list[str]]:
    """Sensor -> the name of its file or folder, and sentences on the sensors that have none."""
    found: dict[str, str] = {}
    for name, sensor in source.sensors.items():
        if sensor.kind in kinds:
            if sensor.kind == "depth":
                rest = name.removeprefix(rows.DEPTH).removeprefix(".")
                camera = f"{rest}_depth" if rest else "depth"
            else:
                camera = name.removeprefix(rows.IMAGES).removeprefix("observation.")
            camera = _clean(camera)
            if camera in found.values():
                raise DatasetError(f"two sensors would both be called '{camera}'; rename '{name}'.")
            found[name] = camera
    if not found:
        raise DatasetError(f"{source.name or 'the source'} has no pictures; write it in another format.")
    return found, [f"'{name}' has no place in {what} and was left out." for name in source.sensors if name not in found]


def _clean(camera: str) -> str:
    return ".".join(rows.clean(part) for part in camera.split("."))


def _numbered(source: Source, cameras: Mapping[str, str], progress) -> Iterator[tuple[int, Take]]:
    """Takes with pictures, checked; DatasetError where there are none."""
    number = -1
    for number, take in enumerate(source.takes()):
        seen = [name for name in cameras if name in take.readings and len(take.readings[name].values)]
        if not seen:
            raise DatasetError(f"take {number} has no pictures; leave it out.")
        for name in seen:
            rows.check_times(take.readings[name], f"'{name}' in take {number}")
        yield number, Take({name: take.readings[name] for name in seen}, take.task)
        if progress:
            progress(number + 1, 0)
    if number < 0:
        raise DatasetError(f"{source.name or 'the source'} has no takes; there is nothing to write.")


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


# -- images


def read_images(path: str | Path, fps: float | None = None) -> Source:
    """A folder of images as a Source of pictures alone, `fps` a second (None: 10).

    Images in the folder itself are one take of the camera "observation.images.rgb". Or each sub-folder is one take: with
    images in it, or with a folder of images for each camera ("take_0/front/1.png": "observation.images.front"). Takes and
    images are in natural order (2 before 10). EXIF orientation is applied, transparency and further frames are dropped.

    Images of 16 bits are depth in millimetres, 0 where nothing was seen (inf): "observation.depth", or
    "observation.depth.NAME" for the folder NAME or NAME_depth. DatasetError where there are no images, one is damaged, of
    absurd size, or not of its camera's size and kind.
    """
    path, fps = Path(path), rows.FPS_UNKNOWN if fps is None else fps
    rows.check_fps(fps, "a folder of images")
    takes = _takes_of(path, IMAGES, "images", deep=True)
    sensors: dict[str, Sensor] = {}
    names: dict[str, str] = {}
    for folder in takes.values():
        for camera, files in folder.items():
            if camera not in names:
                kind, shape = _look(files[0])
                names[camera] = f"{rows.IMAGES}{camera}" if kind == "image" else _depth_name(camera)
                if names[camera] in sensors:
                    raise DatasetError(f"{path} has two folders for '{names[camera]}'; rename '{camera}'.")
                dtype = "uint8" if kind == "image" else "float32"
                sensors[names[camera]] = Sensor(names[camera], kind, shape, dtype, rate_hz=float(fps))
    return Source(
        name=path.name,
        sensors=sensors,
        takes=lambda: (
            Take(
                {names[c]: _images(files, sensors[names[c]], fps) for c, files in folder.items()},
                facts={"folder": name},
            )
            for name, folder in takes.items()
        ),
        fps=float(fps),
    )


def _depth_name(camera: str) -> str:
    if camera in (rows.CAMERA, "depth"):
        return rows.DEPTH
    return f"{rows.DEPTH}.{camera.removesuffix('_depth') or camera}"


def _images(files: list[Path], sensor: Sensor, fps: float) -> Readings:
    for file in files:
        kind, shape = _look(file)
        if (kind, shape) != (sensor.kind, sensor.shape):
            raise DatasetError(
                f"{file} is {_said(kind, shape)} where the first of its camera is {_said(sensor.kind, sensor.shape)}; "
                "scale it to the same size, or keep it in a folder of its own."
            )
    return Readings(np.arange(len(files)) / fps, Lazy(len(files), lambda i: _load(files[i], sensor)))


def _said(kind: str, shape: tuple[int, ...]) -> str:
    return f"{'depth' if kind == 'depth' else 'a picture'} of {shape[1]} x {shape[0]}"


def _look(path: Path) -> tuple[Literal["image", "depth"], tuple[int, ...]]:
    """Kind and shape of an image's readings, from its header."""
    with _image(path) as picture:
        height, width = picture.height, picture.width
        if _turn(picture) in _ON_ITS_SIDE:
            height, width = width, height
        if picture.mode == "F":
            raise DatasetError(f"{path} has numbers with fractions, of unknown unit; make it an 8-bit or 16-bit image.")
        return ("depth", (height, width)) if picture.mode.startswith("I") else ("image", (height, width, 3))


def _load(path: Path, sensor: Sensor) -> np.ndarray:
    with _image(path) as picture:
        turn = _turn(picture)
        upright = picture if turn is None else picture.transpose(turn)
        if sensor.kind == "depth":
            depth_mm = np.asarray(upright).astype(np.float32)
            found = np.where(depth_mm > 0, depth_mm / np.float32(_MM), np.float32(np.inf))
        else:
            found = np.asarray(upright.convert("RGB"))
    if found.shape != sensor.shape:
        raise DatasetError(f"{path} changed while it was read; read the folder anew.")
    return np.array(found)


def _turn(picture: Image.Image) -> Image.Transpose | None:
    """What makes the image upright, by its EXIF orientation."""
    exif = picture.getexif() if picture.format != "PNG" else Image.Exif()
    if picture.format == "PNG":  # Pillow would decode the whole image to look behind it
        exif.load(picture.info.get("exif", b""))
    return _TURNS.get(exif.get(0x0112, 1))


@contextmanager
def _image(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path, formats=_FORMATS) as picture:
            rows.check_size(picture.height, picture.width, f"the image {path}")
            yield picture
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise DatasetError(
            f"the image {path} is damaged or of an unknown kind ({error}); restore it from a copy."
        ) from error


def write_images(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source's pictures and depth as PNG files, as `read_images` reads them; returns what had no place in it.

    take_0/000000.png, … where the only sensor is "observation.images.rgb", else take_0/CAMERA/000000.png. Pictures are
    exact; depth is rounded to millimetres, and 0 where it is not a number or beyond 65.535 m. Times are not kept.
    `progress(takes, 0)` is called after each take. DatasetError where there are no pictures, or `path` exists.
    """
    cameras, left_out = _cameras(source, ("image", "depth"), "images")
    notes = dict.fromkeys(left_out)
    with rows.fresh(path) as staged:
        staged.mkdir()
        for number, take in _numbered(source, cameras, progress):
            for name, readings in take.readings.items():
                folder = staged / f"take_{number}"
                folder = folder if list(cameras) == [_CAMERA] else folder / cameras[name]
                folder.mkdir(parents=True)
                if not rows.even(readings.time_s, source.fps):
                    notes[f"images keep no times: those of '{name}' were left out."] = None
                row = 0
                for part in rows.batches(readings.values, source.sensors[name], f"take {number}", size=8):
                    for value in part:
                        stored = value if source.sensors[name].kind == "image" else _millimetres(value)
                        Image.fromarray(stored).save(folder / f"{row:06d}.png", compress_level=3)
                        row += 1
    return list(notes)


def _millimetres(depth_m: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        depth_mm = np.rint(np.nan_to_num(depth_m, nan=0, posinf=0, neginf=0).astype(np.float64) * _MM)
    return np.where((depth_mm > 0) & (depth_mm <= 65_535), depth_mm, 0).astype(np.uint16)
