"""Image files from the disk or the page, as frames of the world's size."""

import base64
import io
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError

from ..core.errors import ServeError
from ..core.spec import Spec, chance_error, trust_level

FORMATS = ("JPEG", "PNG", "WEBP", "GIF", "BMP", "TIFF", "PPM")  # a small part of what Pillow can read
MAX_FILE = 2**26  # bytes of a file
MAX_PIXELS = 2**26
MAX_DROPPED_PIXELS = 2**22  # of a picture from the page, which scales it down itself
_GROUND = (40, 40, 44)  # behind transparent pixels


def read_picture(path: str | Path, size: tuple[int, int]) -> torch.Tensor:
    """The image file at `path` as `picture_of` returns it; ServeError if it cannot be read."""
    path = Path(path)
    try:
        if not path.is_file():
            raise ServeError(f"{path} is no file; give an image file (JPEG, PNG, WebP, GIF, BMP or TIFF).")
        if path.stat().st_size > MAX_FILE:
            raise ServeError(f"{path} has more than {MAX_FILE >> 20} MiB; save it smaller first.")
        data = path.read_bytes()
    except OSError as error:
        raise ServeError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    return picture_of(data, size, MAX_PIXELS, str(path))


def picture_of(data: bytes, size: tuple[int, int], most_pixels: int = MAX_PIXELS, name: str = "this") -> torch.Tensor:
    """An image of any size, upright by its EXIF orientation, cropped to its middle and scaled: uint8 [H, W, 3] of `size`. Its size
    is checked before decoding. ServeError if it is not of FORMATS, is damaged, or has more than `most_pixels`."""
    height, width = size
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.width * image.height > most_pixels:
                raise Image.DecompressionBombError
            turned = image.getexif().get(0x0112, 1) in (5, 6, 7, 8)
            across, down = (height, width) if turned else (width, height)
            image.draft("RGB", (4 * across, 4 * down))  # a JPEG is decoded at a fraction of its size
            upright = ImageOps.exif_transpose(image)
            rgb = ImageOps.fit(_plain(upright), (width, height), Image.Resampling.LANCZOS)
            return torch.from_numpy(np.array(rgb))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ServeError(f"{name} has too many pixels; scale it to at most {most_pixels / 1e6:.0f} million.") from error
    except UnidentifiedImageError as error:
        raise ServeError(f"{name} is no image of a known format: JPEG, PNG, WebP, GIF, BMP or TIFF.") from error
    except Exception as error:  # a decoder is fed a stranger's bytes, and may raise anything
        raise ServeError(
            f"{name} is an image that cannot be decoded ({type(error).__name__}); save it again."
        ) from error


def strip_of(pictures: torch.Tensor, height: int = 72) -> str:
    """Pictures uint8 [T, H, W, 3] side by side, each at most `height` pixels tall, as a JPEG in base64."""
    frames = [Image.fromarray(picture.cpu().numpy()) for picture in pictures]
    scale = min(1.0, height / frames[0].height)
    width, height = (max(1, round(scale * side)) for side in frames[0].size)
    strip, data = Image.new("RGB", (width * len(frames), height)), io.BytesIO()
    for at, frame in enumerate(frames):
        strip.paste(frame.resize((width, height), Image.Resampling.BILINEAR), (at * width, 0))
    strip.save(data, "JPEG", quality=80)
    return base64.b64encode(data.getvalue()).decode()


def uncertainty_levels(spec: Spec) -> tuple[float, float, float, float] | None:
    """For a world with the channel `uncertainty`: its usual value; that above which most of the picture is invented; that by drift
    above which the position is lost, half of what two random pictures of the world differ by; and that beyond which it is not to be
    trusted. Latents differ by 1 from their mean."""
    if "uncertainty" not in spec.channels:
        return None
    if "latent" in spec.channels:
        return 0.05, 0.7, 0.7, trust_level(0.05, chance_error(spec))
    card = spec.card.get("uncertainty")
    levels = card if isinstance(card, dict) else {}
    usual = ("sure", 0.02), ("invents", 0.08), ("ceiling", 0.2)
    sure, invents, ceiling = (_share(levels.get(name), value) for name, value in usual)
    return sure, max(invents, 1.01 * sure), ceiling / 2, trust_level(sure, ceiling)


def _share(value: object, usual: float) -> float:
    """A number of an untrusted card, if it is a share of full brightness, else the usual value."""
    return float(value) if isinstance(value, int | float) and 0 < value <= 1 else usual


def _plain(image: Image.Image) -> Image.Image:
    """RGB, 8 bits, without transparency."""
    if image.mode.startswith("I;16") or image.mode in ("I", "F"):
        values = np.nan_to_num(np.asarray(image, np.float32))
        low, high = float(values.min()), float(values.max())
        scale = (
            65535.0 if image.mode.startswith("I") and high > 255 else max(high, 1e-6) if image.mode == "F" else 255.0
        )
        return Image.fromarray(np.uint8(np.clip(values - min(low, 0), 0, scale) * (255 / scale))).convert("RGB")
    if "A" in image.getbands() or "transparency" in image.info:
        shown = image.convert("RGBA")
        ground = Image.new("RGBA", shown.size, (*_GROUND, 255))
        return Image.alpha_composite(ground, shown).convert("RGB")
    return image.convert("RGB")
