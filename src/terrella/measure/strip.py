"""Strips of pictures: rows of frames with labels."""

import io
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

_GAP, _MARGIN, _LINE = 2, 96, 16


def strip(rows: Mapping[str, np.ndarray], columns: Sequence[str]) -> Image.Image:
    """One labelled row of frames for each entry: uint8 [T, H, W, 3] with T = len(columns) -> an RGB picture."""
    pictures = {label: join_row(frames) for label, frames in rows.items()}
    if not pictures or any(len(frames) != len(columns) for frames in rows.values()):
        raise ValueError("a strip needs at least one row, and each row one frame for each column label.")
    width, height = next(iter(pictures.values())).size
    canvas = Image.new("RGB", (_MARGIN + width, _LINE + (height + _GAP) * len(pictures)), (14, 16, 20))
    draw = ImageDraw.Draw(canvas)
    cell = (width + _GAP) // len(columns)
    for number, label in enumerate(columns):
        draw.text((_MARGIN + number * cell + 2, 2), label, fill=(168, 176, 190))
    for number, (label, picture) in enumerate(pictures.items()):
        top = _LINE + number * (height + _GAP)
        canvas.paste(picture, (_MARGIN, top))
        draw.text((4, top + height // 2 - 5), label, fill=(168, 176, 190))
    return canvas


def join_row(frames: np.ndarray) -> Image.Image:
    """Frames uint8 [T, H, W, 3] side by side with a small dark gap."""
    frames = np.asarray(frames, np.uint8)
    count, height, width, _ = frames.shape
    canvas = np.full((height, count * (width + _GAP) - _GAP, 3), 14, np.uint8)
    for number, frame in enumerate(frames):
        canvas[:, number * (width + _GAP) : number * (width + _GAP) + width] = frame
    return Image.fromarray(canvas)


def film(rows: Sequence[np.ndarray], dt_s: float, last_s: float = 1.0) -> bytes:
    """An animated WebP that loops: rows of frames uint8 [T, H, W, 3] above one another, each frame for dt_s, the last for last_s
    more."""
    gap = np.full((1, 2 * _GAP, *rows[0].shape[2:]), 14, np.uint8)
    frames = [
        Image.fromarray(np.concatenate([part for row in rows for part in (gap[0], row[at])][1:]))
        for at in range(len(rows[0]))
    ]
    times, data = [max(20, round(1000 * dt_s))] * len(frames), io.BytesIO()
    times[-1] += round(1000 * last_s)
    frames[0].save(data, "WEBP", save_all=True, append_images=frames[1:], duration=times, loop=0, quality=80, method=2)
    return data.getvalue()


def jpeg(picture: Image.Image, quality: int = 88) -> bytes:
    """A picture as JPEG bytes, colours not subsampled."""
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()
