"""SOG of version 2 (PlayCanvas): a meta.json and WebP pictures with a Gaussian a pixel, zipped or in a folder."""

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..raster import Gaussians
from .compressed import whole_quats

META, MOST, LONGEST = "meta.json", 1 << 24, 1 << 28
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}
_ROW = 64  # palette entries in a row of the picture of harmonics


def zipped(data: bytes) -> Gaussians:
    """The Gaussians of a .sog; ValueError or KeyError for broken, too large or missing parts."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            longest = max((about.file_size for about in archive.infolist()), default=0)
            if longest > LONGEST:
                raise ValueError(f"a file in it is {longest:,} bytes long, {LONGEST:,} is the most")
            return _decoded(archive.read)
    except (zipfile.BadZipFile, EOFError, RuntimeError) as error:
        raise ValueError(f"its zip is broken ({error})") from error


def unzipped(folder: Path) -> Gaussians:
    """The same of a folder with a meta.json."""

    def read(name: str) -> bytes:
        if Path(name).name != name or not (folder / name).is_file():
            raise KeyError(name)
        return (folder / name).read_bytes()

    return _decoded(read)


def _decoded(read: Callable[[str], bytes]) -> Gaussians:
    try:
        meta = json.loads(read(META))
        if meta.get("version") != 2:
            raise ValueError(f"it is SOG of version {meta.get('version', 1)}, which is not 2")
        count = meta["count"]
        if type(count) is not int or not 0 < count < MOST:
            raise ValueError(f"its {META} speaks of {count} points")
        return _gaussians(meta, count, lambda of, k=0: _picture(read(meta[of]["files"][k])))
    except (OSError, TypeError, AttributeError, IndexError, RecursionError, Image.DecompressionBombError) as error:
        raise ValueError(f"its {META} or a picture is broken ({error})") from error


def _gaussians(meta: Mapping[str, Any], count: int, picture: Callable[..., np.ndarray]) -> Gaussians:
    def rows(of: str, k: int = 0) -> np.ndarray:
        pixels = picture(of, k).reshape(-1, 4)
        if len(pixels) < count:
            raise ValueError(f"its picture of {of} has {len(pixels):,} pixels for {count:,} points")
        return pixels[:count]

    low, high = (np.array(meta["means"][end], np.float32) for end in ("mins", "maxs"))
    share = (rows("means")[:, :3] | rows("means", 1)[:, :3].astype(np.uint16) << 8).astype(np.float32) / 65535
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is left out by who reads
        logs = low + (high - low) * share
        means = np.sign(logs) * np.expm1(np.abs(logs))
        scales = np.exp(_codebook(meta, "scales")[rows("scales")[:, :3]])
    turns, colours = rows("quats"), rows("sh0")
    if turns[:, 3].min() < 252:
        raise ValueError("its picture of quats holds none")
    three = (torch.from_numpy(turns[:, :3].astype(np.float32)) / 255 - 0.5) * 2**0.5
    quats = whole_quats(three, torch.from_numpy(turns[:, 3].astype(np.int64) - 252))
    sh = _codebook(meta, "sh0")[colours[:, None, :3]]
    if "shN" in meta:
        many, palette = _COEFFICIENTS[meta["shN"]["bands"]], picture("shN", 0)
        labels = rows("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
        if palette.shape[1] != _ROW * many or labels.max() >= _ROW * len(palette):
            raise ValueError(
                f"its picture of harmonics of {palette.shape[1]} x {palette.shape[0]} pixels does not fit them"
            )
        sh = np.concatenate([sh, _codebook(meta, "shN")[palette[..., :3]].reshape(-1, many, 3)[labels]], 1)
    opacities = torch.from_numpy(colours[:, 3].astype(np.float32)) / 255
    return Gaussians(torch.from_numpy(means), quats, torch.from_numpy(scales), opacities, torch.from_numpy(sh))


def _codebook(meta: Mapping[str, Any], of: str) -> np.ndarray:
    codebook = np.array(meta[of]["codebook"], np.float32)
    if codebook.shape != (256,):
        raise ValueError(f"its codebook of {of} has not 256 numbers")
    return codebook


def _picture(data: bytes) -> np.ndarray:
    """uint8 [height, width, 4]; its size is checked before decoding."""
    with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        if image.width * image.height > 2 * MOST:
            raise ValueError(f"it has a picture of {image.width:,} x {image.height:,} pixels")
        return np.asarray(image.convert("RGBA"))
