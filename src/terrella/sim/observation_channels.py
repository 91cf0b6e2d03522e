"""The channels in the observations of a Gymnasium environment: pictures of any layout, and entries of a Dict."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from PIL import Image

from ..core.errors import TerrellaError

_KNOWN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_PIXELS = 16  # smallest side of a picture
# Number of axes that a channel of this name must have; -1: not allowed in observations.
_AXES = {"depth": 2, "reward": -1, "done": -1}


@dataclass(frozen=True)
class ObservationPart:
    """A channel of an observation."""

    key: str | None  # of a Dict; None for the observation itself
    space: spaces.Space
    form: str = ""  # layout of a picture: "hwc", "chw" or "hw"; "" for other arrays

    def read(self, observation: Any, name: str) -> np.ndarray:
        """The value; a picture becomes uint8 [H, W, 3]. TerrellaError where its shape differs from the space."""
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


def parts_of(space: spaces.Space, name: str, rgb: bool, drawn: bool) -> dict[str, ObservationPart]:
    """Channel -> part. The arrays of a Dict keep their names; a picture among them becomes `rgb` if that is wanted and the
    environment renders none itself (`drawn`). TerrellaError where there is no array."""
    if not isinstance(space, spaces.Dict):
        check_space(space, name)
        form = picture_form(space) if rgb else ""
        return {"rgb" if form else "observation": ObservationPart(None, space, form)}
    parts: dict[str, ObservationPart] = {}
    for key, inner in space.spaces.items():
        channel = re.sub(r"\W", "_", str(key))
        if not isinstance(inner, _KNOWN_SPACES):
            continue
        form = picture_form(inner)
        large = rgb and form and min(sorted(inner.shape or ())[-2:]) >= _PIXELS
        if large and "rgb" not in parts and (channel == "rgb" or not drawn):
            parts["rgb"] = ObservationPart(key, inner, form)
            continue
        fits = channel != "rgb" and _AXES.get(channel, len(inner.shape or ())) == len(inner.shape or ())
        parts[channel if fits else f"seen_{channel}"] = ObservationPart(key, inner)
    if not parts:
        check_space(space, name)
    return parts


def check_space(space: spaces.Space, name: str) -> None:
    """TerrellaError where values of the space are not one array."""
    if not isinstance(space, _KNOWN_SPACES):
        raise TerrellaError(f"{name} has the space {space}; wrap it so that it is one array (FlattenObservation).")


def picture_form(space: spaces.Space) -> str:
    """The layout of a space of pictures (uint8, or floats up to 1): "hwc", "chw", "hw"; else ""."""
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
    """A picture of any layout as uint8 [H, W, 3]."""
    if value.ndim != len(form):
        raise TerrellaError(f"{name} gave a picture of shape {value.shape}, which does not match its space.")
    if value.dtype != np.uint8:
        value = (np.clip(value, 0, 1) * 255).round().astype(np.uint8)
    value = value.transpose(1, 2, 0) if form == "chw" else value[..., None] if form == "hw" else value
    return value if value.shape[2] == 3 else value.repeat(3, 2)


def resized(picture: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [*size, 3], area-averaged."""
    if size is None or picture.shape[:2] == tuple(size):
        return picture
    picture = np.ascontiguousarray(picture)
    return np.asarray(Image.fromarray(picture).resize((size[1], size[0]), Image.Resampling.BOX))


def space_of(value: Any, kind: str) -> spaces.Space:
    """The space of a channel of this kind, from one value in `info` or an attribute."""
    array = np.asarray(value, np.float32) if kind in ("depth", "pose") else np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TerrellaError(f"it is {array.dtype}, not numbers")
    if array.dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, array.shape, np.float32)
    if array.dtype == bool:
        return spaces.Box(0, 1, array.shape, np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
    limit = np.iinfo(array.dtype.type)
    return spaces.Box(limit.min, limit.max, array.shape, array.dtype.type)


def value_at(env: Any, info: Mapping, path: str) -> Any:
    """The value at "info.depth", a key of the last `info`, or at "camera.pose", attributes of the bare environment (methods are
    called)."""
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
