"""Which channels the observations of a Gymnasium environment have: pictures of any form, and the parts of a dictionary."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from PIL import Image

from ..core.errors import TerrellaError

_KNOWN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_PIXELS = 16  # least side of what counts as a picture, where nothing else says so
_SHAPES = {
    "depth": 2,
    "reward": -1,
    "done": -1,
}  # axes that a channel of this name must have; -1: it is not for observations


@dataclass(frozen=True)
class Part:
    """A channel of an observation: `key` of the dictionary (None: the observation itself), and the form of a picture
    ("hwc", "chw", "hw"; "" for what is none)."""

    key: str | None
    space: spaces.Space
    form: str = ""

    def read(self, observation: Any, name: str) -> np.ndarray:
        """The value; a picture becomes uint8 [H, W, 3]. TerrellaError where its shape is not the space's."""
        given = observation if self.key is None else observation[self.key]
        value = np.asarray(given)
        if self.form:
            return as_picture(value, self.form, name)
        try:
            return np.array(value, dtype=self.space.dtype).reshape(self.space.shape or ())
        except (ValueError, TypeError) as error:
            raise TerrellaError(
                f"{name} gave an observation of shape {value.shape}, where its space says {self.space.shape}."
            ) from error


def parts_of(space: spaces.Space, name: str, rgb: bool, drawn: bool) -> dict[str, Part]:
    """channel -> Part. Of a Dict the entries that are arrays, by their names; the picture among them is `rgb`, where that is
    wanted and the environment draws none itself. TerrellaError where there is nothing that can be taken."""
    if not isinstance(space, spaces.Dict):
        check_space(space, name)
        form = picture_form(space) if rgb else ""
        return {"rgb" if form else "observation": Part(None, space, form)}
    found: dict[str, Part] = {}
    for key, inner in space.spaces.items():
        channel = re.sub(r"\W", "_", str(key))
        if not isinstance(inner, _KNOWN_SPACES):
            continue
        form = picture_form(inner)
        large = rgb and form and min(sorted(inner.shape or ())[-2:]) >= _PIXELS
        if large and "rgb" not in found and (channel == "rgb" or not drawn):
            found["rgb"] = Part(key, inner, form)
            continue
        fits = channel != "rgb" and _SHAPES.get(channel, len(inner.shape or ())) == len(inner.shape or ())
        found[channel if fits else f"seen_{channel}"] = Part(key, inner)
    if not found:
        check_space(space, name)
    return found


def check_space(space: spaces.Space, name: str) -> None:
    """TerrellaError where the values of a space are not one array."""
    if not isinstance(space, _KNOWN_SPACES):
        raise TerrellaError(f"{name} has the space {space}; wrap it so that it is one array (FlattenObservation).")


def picture_form(space: spaces.Space) -> str:
    """How a space holds pictures: uint8, or floats up to 1; colours last or first, or grey; "" where it holds none."""
    shape = space.shape or ()
    if not isinstance(space, spaces.Box):
        return ""
    if space.dtype == np.uint8 and len(shape) == 3 and shape[2] == 3:
        return "hwc"
    bright = space.dtype == np.uint8 or (
        space.dtype.kind == "f" and bool((space.low >= 0).all() and (space.high == 1).all())
    )
    if not bright or len(shape) not in (2, 3):
        return ""
    for form, size, depth in (("hwc", shape[:2], shape[2:]), ("chw", shape[1:], shape[:1]), ("hw", shape, (1,))):
        if len(size) == 2 and len(depth) == 1 and depth[0] in (1, 3) and min(size) >= _PIXELS:
            return form
    return ""


def as_picture(value: np.ndarray, form: str, name: str) -> np.ndarray:
    """uint8 [H, W, 3] of a picture in any form."""
    if value.ndim != len(form):
        raise TerrellaError(
            f"{name} gave a picture of shape {value.shape}, which is not of the form that its space has."
        )
    if value.dtype != np.uint8:
        value = (np.clip(value, 0, 1) * 255).round().astype(np.uint8)
    value = value.transpose(1, 2, 0) if form == "chw" else value[..., None] if form == "hw" else value
    return value if value.shape[2] == 3 else value.repeat(3, 2)


def resized(picture: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [*size, 3], each pixel the mean of the area that it covers."""
    if size is None or picture.shape[:2] == tuple(size):
        return picture
    picture = np.ascontiguousarray(picture)
    return np.asarray(Image.fromarray(picture).resize((size[1], size[0]), Image.Resampling.BOX))


def space_of(value: Any, kind: str) -> spaces.Space:
    """The space of a channel of some kind that is read off `info` or an attribute, from one value of it."""
    array = np.asarray(value, np.float32) if kind in ("depth", "pose") else np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TerrellaError(f"it is {array.dtype}, and a channel is made of numbers")
    if array.dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, array.shape, np.float32)
    if array.dtype == bool:
        return spaces.Box(0, 1, array.shape, np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
    limit = np.iinfo(array.dtype.type)
    return spaces.Box(limit.min, limit.max, array.shape, array.dtype.type)


def followed(env: Any, info: Mapping, path: str) -> Any:
    """What "info.depth" or "camera.pose" means: a key of the last `info`, or attributes of the bare environment, one after
    another; a method without arguments is called."""
    words, value = path.split("."), env
    if words[0] == "info":
        value, words = info, words[1:]
    for word in words:
        if isinstance(value, Mapping):
            if word not in value:
                raise TerrellaError(f"there is no '{path}': the keys are {', '.join(map(str, value)) or 'none'}.")
            value = value[word]
        elif hasattr(value, word):
            value = getattr(value, word)
            value = value() if callable(value) else value
        else:
            raise TerrellaError(f"there is no '{path}': {type(value).__name__} has no '{word}'.")
    return value
