"""Reads pictures of any mode with 8 or 16 bits, rotated by EXIF, and videos; broken ones are rejected."""

import warnings
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from ...core.errors import DatasetError
from ...core.video import film_of, media_address, square_width
from ..files.ply import full_scale

ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
VIDEOS = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v")
SMALLEST, MOST_PIXELS = 32, 100_000_000
PLAIN = 2.0  # standard deviation of colours in 0..255: less shows nothing
BLURRED = 0.4  # of the usual sharpness of a set: less is left out


def read_picture(path: Path, upright: bool = True, longest: int = 4096) -> np.ndarray:
    """uint8 [H, W, 3], reduced to at most `longest` pixels a side; `upright`: turned by its EXIF orientation. DatasetError for a
    broken, tiny or huge picture."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged EXIF data, of large pictures
            with Image.open(path) as opened:
                width, height = opened.size
                if min(width, height) < SMALLEST or width * height > MOST_PIXELS:
                    raise DatasetError(
                        f"{path} is {width} x {height} pixels; a picture has {SMALLEST} a side or more, and "
                        f"{MOST_PIXELS // 1_000_000} million at most. Scale it."
                    )
                if opened.mode in ("RGB", "L"):
                    opened.draft("RGB", (longest, longest))  # JPEGs decode faster when smaller
                picture = ImageOps.exif_transpose(opened) if upright else opened.copy()
    except DatasetError:
        raise
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is not there; check its name.") from error
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        if "truncated" in str(error).lower():
            raise DatasetError(
                f"{path} is incomplete: the file ends before the picture does. Copy it again."
            ) from error
        raise DatasetError(f"{path} cannot be read as a picture; save it as JPEG or PNG.") from error
    picture = _rgb(picture)
    share = longest / max(picture.size)
    if share < 1:
        picture = picture.resize([max(round(side * share), 1) for side in picture.size], Image.Resampling.BOX)
    return np.asarray(picture)


def opaque_part(path: Path, size: tuple[int, int]) -> np.ndarray | None:
    """Which pixels of a readable picture are opaque: bool [H, W] of that size, upright; None if it has no transparency."""
    with Image.open(path) as opened:
        if not opened.has_transparency_data:
            return None
        alpha = ImageOps.exif_transpose(opened).convert("RGBA").getchannel("A")
    return np.asarray(alpha.resize((size[1], size[0]), Image.Resampling.BOX)) >= 128


def is_plain(picture: np.ndarray) -> bool:
    """Whether a picture uint8 [H, W, 3] is of one colour, as of a covered lens."""
    return float(picture.std(axis=(0, 1)).max()) < PLAIN


def _rgb(picture: Image.Image) -> Image.Image:
    """Any mode as RGB: 16 bits and floats by their full scale, transparency on black."""
    if picture.mode.startswith(("I", "F")):
        numbers = np.nan_to_num(np.asarray(picture), posinf=0, neginf=0)
        most = full_scale(numbers.dtype, float(numbers.max()))
        picture = Image.fromarray((numbers.clip(0, most) * (255 / most)).round().astype(np.uint8))
    if picture.has_transparency_data:
        clear = picture.convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", clear.size, (0, 0, 0, 255)), clear)
    return picture.convert("RGB")


def sharpness(picture: np.ndarray) -> float:
    """Second over first differences: small for a blurred picture, whatever it shows."""
    grey = picture[..., 1].astype(np.float32)
    second, first = (sum(np.abs(np.diff(grey, order, axis)).mean() for axis in (0, 1)) for order in (2, 1))
    return float(second / max(first, 0.25))


def blurred(pictures_sharpness: list[float]) -> list[bool]:
    """Which pictures of a set are much less sharp than its median."""
    usual = float(np.median(pictures_sharpness)) if pictures_sharpness else 0.0
    return [one < BLURRED * usual for one in pictures_sharpness]


def video_pictures(path: Path, count: int, longest: int) -> list[np.ndarray]:
    """At most `count` frames of a video, the sharpest of each of `count` equal parts: uint8 [H, W, 3] each."""
    import av
    from av.error import FFmpegError

    try:
        with av.open(media_address(path)) as file:
            film = film_of(file)
        with av.open(media_address(path)) as file:
            stream = file.streams.video[film]
            total = stream.frames or sum(packet.size > 0 for packet in file.demux(stream))
        best: dict[int, tuple[float, np.ndarray]] = {}
        with av.open(media_address(path)) as file:
            stream = file.streams.video[film]
            for number, frame in enumerate(file.decode(stream)):
                width = square_width(stream, frame.width)
                share = min(1.0, longest / max(width, frame.height))
                picture = frame.reformat(
                    round(width * share), round(frame.height * share), "rgb24", interpolation="AREA"
                ).to_ndarray()
                picture, clear = np.rot90(picture, round(frame.rotation / 90)), sharpness(picture)
                stretch = number * count // max(total, count)
                if clear > best.get(stretch, (-1.0,))[0]:
                    best[stretch] = clear, np.ascontiguousarray(picture)
    except (FFmpegError, IndexError, OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read as a video; save it again as MP4.") from error
    if not best or min(next(iter(best.values()))[1].shape[:2]) < SMALLEST:
        raise DatasetError(f"{path} has no pictures of {SMALLEST} pixels a side; give another video.")
    return [best[stretch][1] for stretch in sorted(best)]
