"""How a world's channels are named in a recording, and back: `rgb.wrist` is observation.images.wrist; which Sensor each is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import DatasetError, TerrellaError
from .source import Sensor

if TYPE_CHECKING:
    from gymnasium import spaces

    from ..core.spec import Camera, Spec

RGB, DEPTH, STATE, POSE = "observation.images.rgb", "observation.depth", "observation.state", "observation.pose"
ACTION, REWARD, DONE = "action", "next.reward", "next.done"
POSE_NAMES = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
NAME = re.compile(r"\w[\w.-]{0,200}")  # of a feature, and so of a file and a folder
MOST_AXES = 5
ESTIMATES = ("uncertainty", "known", "keyframes")  # what a learned world says of itself: recorded, but never learned from
RENAMED = {"cast": "objects"}  # channel of old recordings -> what it is called now
_MAIN = {"rgb": RGB, "depth": DEPTH, "pose": STATE, "reward": REWARD, "done": DONE, "observation": "observation"}
_IMAGES = "observation.images."


def feature_of(channel: str) -> str:
    """The feature that holds a channel: rgb.wrist -> observation.images.wrist, depth.wrist -> observation.depth.wrist.

    The main camera's are observation.images.rgb, observation.depth and observation.state (its pose).
    """
    kind, _, suffix = channel.partition(".")
    if channel in _MAIN:
        return _MAIN[channel]
    return f"{_IMAGES}{suffix}" if kind == "rgb" and suffix else f"observation.{channel}"


def channel_of(feature: str, names: Iterable[str] = ()) -> str:
    """The inverse of `feature_of`, for a stranger's features too; `names`: one per number of it, () where unknown."""
    if feature in (STATE, POSE):
        return "pose" if tuple(names) == POSE_NAMES else feature.removeprefix("observation.")
    for channel, known in _MAIN.items():
        if feature == known:
            return channel
    if feature.startswith(_IMAGES):
        return f"rgb.{feature.removeprefix(_IMAGES)}"
    channel = feature.removeprefix("observation.")
    return RENAMED.get(channel, channel)


def features_of(channels: Iterable[str]) -> dict[str, str]:
    """channel -> feature of all channels of one world; DatasetError where two would be one, or a name can be none.

    Where a world has a channel `state` besides its `pose`, the pose is observation.pose.
    """
    found: dict[str, str] = {}
    channels = list(channels)
    for channel in channels:
        feature = POSE if channel == "pose" and "state" in channels else feature_of(channel)
        if not NAME.fullmatch(feature):
            raise DatasetError(
                f"the channel '{channel[:100]}' cannot name a file; use letters, digits, '.', '_' and '-'."
            )
        for other, taken in found.items():
            if taken.lower() == feature.lower():
                raise DatasetError(f"the channels '{other}' and '{channel}' would both be {feature}; rename one of them.")
        found[channel] = feature
    return found


def sensors_of_channels(spec: Spec) -> dict[str, Sensor]:
    """channel -> Sensor of everything that a world shows; DatasetError names what no recording can hold."""
    features = features_of(spec.channels)
    return {name: _sensor(spec, name, space, features[name]) for name, space in spec.channels.items()}


def _sensor(spec: Spec, channel: str, space: spaces.Space, feature: str) -> Sensor:
    shape, dtype = _form(spec.name, channel, space)
    kind, unit = channel.partition(".")[0], spec.units.get(channel, "")
    if kind == "rgb" or channel in spec.cameras:
        if len(shape) != 3 or shape[2] != 3 or dtype != np.uint8:
            raise DatasetError(
                f"the channel '{channel}' of {spec.name} is {dtype} {shape}, and a picture is uint8 [height, width, 3]: "
                "give it another name, or that form."
            )
        return Sensor(feature, "image", shape, "uint8")
    if kind == "depth" and len(shape) == 2 and dtype.kind == "f":
        return Sensor(feature, "depth", shape)
    if kind == "pose" and shape == (7,):
        return Sensor(feature, "vector", shape, names=POSE_NAMES)
    if channel in ("reward", "done"):
        return Sensor(feature, "vector", (1,), "bool" if channel == "done" else "float32")
    units = {feature: unit} if unit else {}
    if len(shape) > 1:
        return Sensor(feature, "vector", shape, dtype.name, units=units)
    width = int(np.prod(shape))
    names = tuple(f"{channel}_{i}" for i in range(width))
    return Sensor(feature, "vector", (width,), dtype.name, names, {name: unit for name in names} if unit else {})


def _form(world: str, channel: str, space: spaces.Space) -> tuple[tuple[int, ...], np.dtype]:
    from ..core.spec import dtype_of, shape_of

    try:
        shape, dtype = shape_of(space), dtype_of(space)
    except (TerrellaError, TypeError) as error:
        raise DatasetError(
            f"the channel '{channel}' of {world} cannot be recorded: its values are not one array of numbers ({space})."
        ) from error
    if dtype.kind not in "biuf" or dtype.itemsize > 8 or len(shape) > MOST_AXES or 0 in shape:
        raise DatasetError(
            f"the channel '{channel}' of {world} is {dtype} {shape}, and a recording holds bools, integers and floats of "
            f"1 to {MOST_AXES} axes, none of them empty."
        )
    return shape, dtype


def camera_json(camera: Camera) -> dict[str, object]:
    """A Camera as meta/terrella.json keeps it."""
    return {
        "intrinsics": list(camera.intrinsics),
        "size": list(camera.size),
        "pose": camera.pose,
        "mount": list(camera.mount),
    }


def cameras_of(world: Mapping) -> dict[str, Camera]:
    """channel -> Camera of a recorded world, from the facts that meta/terrella.json keeps; {} where it keeps none.

    Of recordings that knew one camera alone: the main one, mounted on `pose`. DatasetError where the facts are damaged.
    """
    from ..core.spec import Camera

    try:
        if "cameras" not in world:
            main, size = world.get("camera"), world.get("size") or (0, 0)
            return {"rgb": Camera(_numbers(main, 4), _numbers(size, 2, int))} if main else {}  # pyright: ignore
        return {
            str(channel): Camera(
                _numbers(about["intrinsics"], 4),  # pyright: ignore[reportArgumentType]
                _numbers(about["size"], 2, int),  # pyright: ignore[reportArgumentType]
                None if about["pose"] is None else str(about["pose"]),
                _numbers(about["mount"], 7),
            )
            for channel, about in dict(world["cameras"]).items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"meta/terrella.json tells no cameras ({error}); restore it from a copy.") from error


def _numbers(values: object, count: int, kind: type = float) -> tuple:
    found = tuple(kind(value) for value in values)  # pyright: ignore[reportGeneralTypeIssues]
    if len(found) != count or not np.isfinite(found).all():
        raise ValueError(f"{count} finite numbers were expected, not {values!r}")
    return found
