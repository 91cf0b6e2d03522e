"""Folders of images without actions, read, and written as PNG."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, ImageOps

from ...core.errors import DatasetError
from ...core.files import creating
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import folders, rows
from .folders import IMAGES

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM")
_ORIENTATION = 0x0112  # the EXIF tag; values from 5 on swap width and height
_MM = 1000.0


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of images as a Source of pictures, `fps` per second (default: 10).

    Either the images in the folder are one take of the camera "observation.images.rgb"; or each subfolder is one take, with
    images in it or with a folder of images per camera ("take_0/front/1.png": "observation.images.front"). Takes and images
    are in natural order (2 before 10). EXIF orientation is applied; transparency and further frames are dropped, which the
    notes of takes say.

    16-bit images are depth in millimetres, 0 for no measurement (inf): "observation.depth", or "observation.depth.NAME" for
    the folder NAME or NAME_depth. DatasetError where there are no images, or one is damaged, too large, or of another size
    or kind than its camera's first.
    """
    path, fps = Path(path), rows.FPS_UNKNOWN if fps is None else fps
    rows.check_fps(fps, "a folder of images")
    takes = folders.takes_of(path, IMAGES, "images", deep=True)
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
                notes=tuple(dict.fromkeys(note for part in folder.values() for file in part for note in _losses(file))),
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
                f"{file} is {_described(kind, shape)} where the first of its camera is {_described(sensor.kind, sensor.shape)}; "
                "scale it to the same size, or keep it in a folder of its own."
            )
    return Readings(np.arange(len(files)) / fps, Lazy(len(files), lambda i: _load(files[i], sensor)))


def _described(kind: str, shape: tuple[int, ...]) -> str:
    return f"{'depth' if kind == 'depth' else 'a picture'} of {shape[1]} x {shape[0]}"


def _look(path: Path) -> tuple[Literal["image", "depth"], tuple[int, ...]]:
    """Kind and shape of an image's readings, from its header."""
    with _image(path) as picture:
        height, width = picture.height, picture.width
        if _orientation(picture) > 4:
            height, width = width, height
        if picture.mode == "F":
            raise DatasetError(f"{path} has numbers with fractions, of unknown unit; make it an 8-bit or 16-bit image.")
        return ("depth", (height, width)) if picture.mode.startswith("I") else ("image", (height, width, 3))


def _losses(path: Path) -> list[str]:
    """Notes on what of an image is not read."""
    with _image(path) as picture:
        clear = "A" in picture.getbands() or "transparency" in picture.info
        notes = ["the transparency of images was dropped."] if clear else []
        return notes + ["of images with several frames the first was kept."] * (getattr(picture, "n_frames", 1) > 1)


def _load(path: Path, sensor: Sensor) -> np.ndarray:
    with _image(path) as picture:
        upright = ImageOps.exif_transpose(picture)
        value = rows.metres(np.asarray(upright)) if sensor.kind == "depth" else np.asarray(upright.convert("RGB"))
    if value.shape != sensor.shape:
        raise DatasetError(f"{path} changed while it was read; read the folder again.")
    return np.array(value)


def _orientation(picture: Image.Image) -> int:
    exif = picture.getexif() if picture.format != "PNG" else Image.Exif()
    if picture.format == "PNG":  # Pillow's getexif would decode the whole image
        exif.load(picture.info.get("exif", b""))
    value = exif.get(_ORIENTATION, 1)
    return value if isinstance(value, int) else 1


@contextmanager
def _image(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path, formats=_FORMATS) as picture:
            rows.check_size(picture.height, picture.width, f"the image {path}")
            yield picture
    except rows.PICTURE_ERRORS as error:
        raise DatasetError(f"the image {path} is damaged or of an unknown kind ({error}); restore it.") from error


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source's pictures and depth as PNG files, as `read` reads them; returns a note on everything left out.

    Files are take_0/000000.png, … if the only camera is "observation.images.rgb", else take_0/CAMERA/000000.png. Pictures
    are exact; depth is rounded to millimetres, and 0 where it is NaN or beyond 65.535 m. Times are not kept.
    `progress(takes, 0)` is called after each take. DatasetError where there are no pictures, or `path` exists.
    """
    cameras, left_out = folders.cameras(source, ("image", "depth"), "images")
    notes = dict.fromkeys(left_out)
    with creating(path) as staged:
        staged.mkdir()
        for number, take in folders.numbered(source, cameras, progress):
            for name, readings in take.readings.items():
                folder = staged / f"take_{number}"
                folder = folder if list(cameras) == [folders.CAMERA] else folder / cameras[name]
                folder.mkdir(parents=True)
                if not rows.is_even(readings.time_s, source.fps):
                    notes[f"images keep no times: those of '{name}' were left out."] = None
                row = 0
                for part in rows.batches(readings.values, source.sensors[name], f"take {number}", size=8):
                    for value in part:
                        if source.sensors[name].kind == "depth":
                            notes |= dict.fromkeys(rows.depth_lost(name, value))
                        stored = value if source.sensors[name].kind == "image" else _millimetres(value)
                        Image.fromarray(stored).save(folder / f"{row:06d}.png", compress_level=3)
                        row += 1
    return list(notes)


def _millimetres(depth_m: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        depth_mm = np.rint(np.nan_to_num(depth_m, nan=0, posinf=0, neginf=0).astype(np.float64) * _MM)
    return np.where((depth_mm > 0) & (depth_mm <= 65_535), depth_mm, 0).astype(np.uint16)
