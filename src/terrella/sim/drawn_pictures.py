"""Pictures as environments draw them, in any common form, as uint8 [H, W, 3]."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from ..core.errors import TerrellaError

MOST_OVERSHOOT = 16.0  # of the highlights in pictures of floats up to 1
_PICTURE_KEYS = ("rgb", "image", "pixels", "frame")
_MODES = ("1", "L", "LA", "RGB", "RGBA", "I", "I;16", "F")  # of PIL images that are arrays of brightness as they are


class DrawnPictures:
    """Reads what `render()` returns. The range of its numbers is that of the brightest picture so far.

    An array, tensor, PIL image or nested list of [H, W], [H, W, C] or [C, H, W], where C is 1 (grey), 2 (grey and alpha), 3 or 4
    (alpha, or depth, which is left out). White is 1; or 255 where a number is above 1 (of floats: far above); or 65535 where one
    is above 255. Black is 0, or -1 where floats up to 1 go below -0.5. Of a list of pictures the last counts, of a tuple and of a
    mapping the first with colours. `form` describes the first picture where it is none of uint8 [H, W, 3]. TerrellaError for
    anything else.
    """

    def __init__(self):
        self.form, self._white, self._signed = "", 0.0, False

    def read(self, value: Any) -> np.ndarray:
        """The picture as uint8 [H, W, 3]."""
        if isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3:
            self._white = self._white or 255.0
            return value
        array, what = _array(value)
        array = _colours(array, what)
        self._white = max(self._white, _white(array))
        if array.dtype.kind in "iu" and array.dtype != np.uint8 and self._white > 255:
            array = (np.clip(array, 0, 65535) // 256).astype(np.uint8)  # the high byte, as 16-bit pictures are read
        elif array.dtype != np.uint8:
            bright = np.nan_to_num(np.asarray(array, np.float64)) / self._white
            self._signed = self._signed or (self._white == 1 and bright.min() <= -0.5)
            bright = (bright + 1) / 2 if self._signed else bright
            array = (np.clip(bright, 0, 1) * 255).round().astype(np.uint8)
        self.form = self.form or f"drawn as {what} up to {self._white:g}"
        return array if array.shape[2] == 3 else array.repeat(3, 2)


def _array(value: Any) -> tuple[np.ndarray, str]:
    """(one picture as an array, what it was)."""
    if isinstance(value, Mapping):
        keys = [key for key in _PICTURE_KEYS if key in value] or list(value)
        return _first({repr(key): value[key] for key in keys}, f"of a dictionary of {', '.join(map(str, value))}")
    if isinstance(value, tuple) and any(map(_is_picture, value)):
        pictures = {f"number {n}": one for n, one in enumerate(value) if _is_picture(one)}
        return _first(pictures, f"of a tuple of {len(value)}")
    if isinstance(value, list) and value and _is_picture(value[-1]):
        return _array(value[-1])[0], f"a list of {type(value[-1]).__name__}"
    if isinstance(value, Image.Image):
        return np.asarray(value if value.mode in _MODES else value.convert("RGB")), f"a PIL image, {value.mode},"
    try:
        detach: Any = getattr(value, "detach", None)  # of a tensor
        array = np.asarray(detach().cpu() if detach else value)
    except (TypeError, ValueError):
        array = np.asarray(None)
    if array.dtype.kind not in "biuf" or array.size == 0:
        raise TerrellaError(f"its render() gives {type(value).__name__}, which is no picture")
    if array.ndim == 4:
        return array[-1], f"{array.dtype} {list(array.shape)}"
    kind = "" if isinstance(value, np.ndarray) else f"{type(value).__name__} of "
    return array, f"{kind}{array.dtype} {list(array.shape)}"


def _first(values: Mapping[str, Any], what: str) -> tuple[np.ndarray, str]:
    """The first of some pictures that has colours, else the first, and which it is."""
    arrays = {key: _array(value)[0] for key, value in values.items() if value is not None}
    if not arrays:
        raise TerrellaError(f"its render() gives none {what} that is a picture")
    coloured = (at for at, it in arrays.items() if it.ndim == 3 and (it.shape[0] == 3 or it.shape[2] in (3, 4)))
    chosen = next(coloured, next(iter(arrays)))
    return arrays[chosen], f"{chosen} {what}"


def _is_picture(value: Any) -> bool:
    return isinstance(value, Image.Image) or len(getattr(value, "shape", ())) >= 2


def _colours(array: np.ndarray, what: str) -> np.ndarray:
    """[H, W, 1 or 3], without alpha or depth."""
    if array.ndim == 2:
        return array[..., None]
    if array.ndim != 3 or (array.shape[2] > 4 and array.shape[0] not in (1, 3, 4)):
        raise TerrellaError(f"its render() gives {what}, which is no picture of [height, width, colours]")
    if array.shape[2] > 4:
        array = array.transpose(1, 2, 0)
    return array[..., :3] if array.shape[2] >= 3 else array[..., :1]


def _white(array: np.ndarray) -> float:
    """The number that means white: 1, 255 or 65535."""
    if array.dtype == np.uint8:
        return 255.0
    if array.dtype == bool:
        return 1.0
    top = float(np.nan_to_num(array, posinf=0.0).max())
    if top <= (MOST_OVERSHOOT if array.dtype.kind == "f" else 1):
        return 1.0
    return 255.0 if not top > 255 else 65535.0
