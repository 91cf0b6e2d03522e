"""The channels in the observations of a Gymnasium environment: pictures of any layout, entries of Dicts and Tuples, a text."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, count
from typing import Any

import numpy as np
from gymnasium import spaces
from PIL import Image

from ..core.errors import TerrellaError
from ..core.instruction import TASK_NAMES
from ..core.spec import kind_of

_KNOWN_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_PIXELS = 16  # smallest side of a picture
# Channels that mean something else than an array of the observation, and those of which it must have this form.
_RESERVED = (
    "rgb", "reward", "done", "truncated", "numbers", "kinds", "ticket", "text", "instruction", "known", "places",
    "keyframes", "mosaic", "uncertainty", "drifted", "invented", "hit", "fallen",
)  # fmt: skip
_FORMS = {"depth": lambda space: len(space.shape) == 2, "pose": lambda space: space.shape == (7,)}

Path = tuple[Any, ...]  # keys of Dicts and indices of Tuples


@dataclass(frozen=True)
class ObservationPart:
    """A channel of an observation."""

    path: Path  # () for the observation itself
    space: spaces.Space
    form: str = ""  # layout of a picture: "hwc", "chw" or "hw"; "" for other arrays

    def shown(self, size: tuple[int, int] | None) -> spaces.Space:
        """The space of the channel; pictures are uint8 [H, W, 3], resized to `size` if that is given."""
        picture = (*(size or _sides(self.space, self.form)), 3)
        return spaces.Box(0, 255, picture, np.uint8) if self.form else self.space

    def read(self, observation: Any, name: str) -> np.ndarray:
        """The value; a picture becomes uint8 [H, W, 3]. TerrellaError where its shape differs from the space."""
        value = np.asarray(entry_at(observation, self.path, name))
        if self.form:
            white = float(self.space.high.flat[0])  # pyright: ignore[reportAttributeAccessIssue]
            return as_picture(value, self.form, name, white)
        try:
            return np.array(value, dtype=self.space.dtype).reshape(self.space.shape or ())
        except (ValueError, TypeError) as error:
            raise TerrellaError(
                f"{name} gave an observation of shape {value.shape}, where its space says {self.space.shape}."
            ) from error


@dataclass
class ObservationParts:
    """What becomes of each entry of an observation."""

    arrays: dict[str, ObservationPart]  # by channel
    text: Path | None = None  # the entry that is the text of the task
    left_out: dict[str, str] = field(default_factory=dict)  # entry -> why it is in no channel

    @property
    def renamed(self) -> dict[str, str]:
        """Entry -> channel, where their names differ."""
        labels = {label_of(part.path): channel for channel, part in self.arrays.items() if part.path}
        return {label: channel for label, channel in labels.items() if label != channel}


def parts_of(space: spaces.Space, seen: Any, rgb: bool, drawn: bool, taken: Iterable[str] = ()) -> ObservationParts:
    """The channels of an observation, of which `seen` is one. Entries of nested Dicts and Tuples are channels of their own:
    {"arm": {"pos": ...}} is "arm.pos". If pictures are wanted (`rgb`), one becomes `rgb` unless the environment renders one
    itself (`drawn`), and others with even sides further cameras: {"pixels": {"wrist": ...}} is "rgb.wrist". One text is that of
    the task. Names in `taken` belong to other channels."""
    parts, texts = ObservationParts({}), dict[Path, str]()
    reserved, used = {*_RESERVED, *taken}, set[str]()
    for path, inner, value in _leaves(space, seen):
        if isinstance(value, str) and inner is not None:
            texts[path] = value
            continue
        if not isinstance(inner, _KNOWN_SPACES) or 0 in (inner.shape or ()):
            empty = isinstance(inner, _KNOWN_SPACES)
            parts.left_out[label_of(path)] = "it is empty" if empty else _kind(inner)
            continue
        form = picture_form(inner) if rgb else ""
        large = form and (not path or min(sorted(inner.shape or ())[-2:]) >= _PIXELS)
        name = _channel(path)
        if large and "rgb" not in parts.arrays and (not drawn or name == "rgb" or not path):
            parts.arrays["rgb"] = ObservationPart(path, inner, form)
            continue
        if large and not any(side % 2 for side in _sides(inner, form)):  # which H.264 can hold
            name = next(f"rgb.{one}" for one in _numbered(name.rpartition(".")[2]) if f"rgb.{one}".lower() not in used)
            used.add(name.lower())
            parts.arrays[name] = ObservationPart(path, inner, form)
            continue
        kind = kind_of(name)
        if {name, kind} & reserved or (kind in _FORMS and not _FORMS[kind](inner)):
            name = f"seen_{name}"
        name = next(one for one in _numbered(name) if one.lower() not in used)
        used.add(name.lower())
        parts.arrays[name] = ObservationPart(path, inner)
    names = sorted(texts, key=lambda path: str(path[-1]).lower() not in TASK_NAMES if path else False)
    parts.text = names[0] if names else None
    parts.left_out |= {label_of(path): "a text beside that of the task" for path in names[1:]}
    return parts


def _leaves(space: Any, seen: Any, path: Path = ()) -> Iterator[tuple[Path, Any, Any]]:
    """(path, space, value) of each entry; the space is None for what an observation has and its space does not declare."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield path, space, seen
        return
    inner: dict[Any, Any] = dict(space.spaces if isinstance(space, spaces.Dict) else enumerate(space.spaces))
    for key, part in inner.items():
        yield from _leaves(part, entry_at(seen, (key,), "", None), (*path, key))
    for key in seen if isinstance(seen, Mapping) else ():
        if key not in inner:
            yield (*path, key), None, None


def entry_at(observation: Any, path: Path, name: str, *default: Any) -> Any:
    """The entry of a nested observation; `default`, or TerrellaError, where it has none."""
    value = observation
    for key in path:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            if default:
                return default[0]
            raise TerrellaError(
                f"{name} gave an observation without '{label_of(path)}', which its space declares."
            ) from None
    return value


def label_of(path: Path) -> str:
    """How an entry is called for people: "arm/pos"."""
    return "/".join(map(str, path)) or "observation"


def _channel(path: Path) -> str:
    words = [re.sub(r"\W", "_", str(key)) or "_" for key in path]
    if not words or isinstance(path[0], int):
        words.insert(0, "observation")
    return ".".join(words)


def _numbered(name: str) -> Iterator[str]:
    """name, name_2, name_3, ..."""
    return chain([name], (f"{name}_{number}" for number in count(2)))


def _sides(space: spaces.Space, form: str) -> tuple[int, ...]:
    """(height, width) of a space of pictures."""
    shape = space.shape or ()
    return shape[1:] if form == "chw" else shape[:2]


def _kind(space: Any) -> str:
    return "its space does not declare it" if space is None else f"a {type(space).__name__}"


def check_space(space: spaces.Space, name: str, what: str) -> None:
    """TerrellaError where values of the space of its `what` (actions, observations) are not one array."""
    if not isinstance(space, _KNOWN_SPACES):
        wrapper = f"gymnasium.wrappers.Transform{what.capitalize()[:-1]}"
        raise TerrellaError(f"{name} has {what} of the space {space}; wrap it so that they are one array ({wrapper}).")


def picture_form(space: spaces.Space) -> str:
    """The layout of a space of pictures (numbers from 0 to 255, or floats from 0 to 1): "hwc", "chw", "hw"; else ""."""
    shape = space.shape or ()
    if not isinstance(space, spaces.Box):
        return ""
    if space.dtype == np.uint8 and len(shape) == 3 and shape[2] == 3:
        return "hwc"
    floats, integers = space.dtype.kind == "f", space.dtype.kind in "iu"
    whites = (space.low >= 0).all() and ((floats and (space.high == 1).all()) or (space.high == 255).all())
    whites = whites and (floats or integers)
    if not (space.dtype == np.uint8 or whites) or len(shape) not in (2, 3):
        return ""
    for form, size, depth in (("hwc", shape[:2], shape[2:]), ("chw", shape[1:], shape[:1]), ("hw", shape, (1,))):
        if len(size) == 2 and len(depth) == 1 and depth[0] in (1, 3) and min(size) >= _PIXELS:
            return form
    return ""


def as_picture(value: np.ndarray, form: str, name: str, white: float = 1.0) -> np.ndarray:
    """A picture of any layout as uint8 [H, W, 3]; `white` is the largest of its floats."""
    if value.ndim != len(form):
        raise TerrellaError(f"{name} gave a picture of shape {value.shape}, which does not match its space.")
    if value.dtype != np.uint8:
        value = (np.clip(value / white, 0, 1) * 255).round().astype(np.uint8)
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
