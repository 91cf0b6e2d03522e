"""The sensors and the facts of a recording for the channels of a world, and back."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core.errors import DatasetError, TerrellaError
from ..core.feature_names import (  # noqa: F401  (their importers read recordings)
    ACTION,
    DEPTH,
    DONE,
    NAME,
    POSE,
    POSE_NAMES,
    REWARD,
    RGB,
    STATE,
    channel_of,
    current_feature,
    feature_of,
    features_of,
    file_name,
)
from ..core.spec import TEXT, Camera, Spec, dtype_of, kind_of, shape_of
from .source import Sensor

MOST_AXES = 5
# Of a learned world, so no training data.
ESTIMATES = ("uncertainty", "drifted", "invented", "known", "places", "keyframes", "hit", "fallen")
OF_TASK = ("text", "instruction")  # channels that an episode's task holds
PRIVILEGED = ("expert", "truth", "action_confidence")  # no sensor gives them: seen by learners that name them


def usually_seen(channel: str) -> bool:
    """Whether a learner that names no channels sees this one: neither what no sensor gives, nor the masks of a merged recording."""
    return channel not in PRIVILEGED and not channel.endswith("_mask")


def sensors_of_channels(spec: Spec) -> dict[str, Sensor]:
    """channel -> Sensor, for all recorded channels of a world but those that its tasks hold; DatasetError for a channel that cannot
    be recorded."""
    has_task = spec.channels.get("text") == TEXT
    features = features_of(name for name in spec.recorded if not (has_task and name in OF_TASK))
    return {name: _sensor(spec, name, spec.channels[name], feature) for name, feature in features.items()}


def _sensor(spec: Spec, channel: str, space: spaces.Space, feature: str) -> Sensor:
    shape, dtype = _form(spec.name, channel, space)
    kind, unit = kind_of(channel), spec.units.get(channel, "")
    if kind == "rgb":
        if len(shape) != 3 or shape[2] != 3 or dtype != np.uint8:
            raise DatasetError(
                f"the channel '{channel}' of {spec.name} is {dtype} {shape}, but a picture is uint8 [height, width, 3]; "
                "rename the channel, or give it that form."
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
    return Sensor(feature, "vector", (width,), dtype.name, names, dict.fromkeys(names, unit) if unit else {})


def _form(world: str, channel: str, space: spaces.Space) -> tuple[tuple[int, ...], np.dtype]:
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


def facts_of(spec: Spec) -> dict[str, object]:
    """The facts of a world in meta/terrella.json, JSON values: its actions, cameras, units and time step."""
    low, high = (np.asarray(limit, np.float64).ravel().tolist() for limit in spec.action_limits)
    limits = {"action_low": low, "action_high": high} if np.isfinite([low, high]).all() else {}
    return {
        "name": spec.name, "embodiment": spec.embodiment or spec.name, "dt_s": spec.dt_s,
        "camera": list(spec.camera) if spec.camera else None,
        "cameras": {channel: _camera_json(camera) for channel, camera in spec.cameras.items()},
        "action_space": str(spec.action), "action_shape": list(shape_of(spec.action)),
        "action_names": list(spec.action_names), "action_units": list(spec.action_units),
        "action_mode": spec.action_mode, "action_frame": spec.action_frame,
        "keys": {key: [float(number) for number in value] for key, value in spec.keys.items()},
        "idle": [float(number) for number in spec.idle], "max_episode_steps": spec.max_episode_steps,
        "left_out": dict(_mapping(spec, "left_out")), "renamed": dict(_mapping(spec, "renamed")),
        "units": dict(spec.units), "discrete": isinstance(spec.action, spaces.Discrete | spaces.MultiDiscrete),
        **({"system": dict(spec.system)} if spec.system else {}), **limits,
    }  # fmt: skip


def _mapping(spec: Spec, name: str) -> Mapping:
    kept = spec.card.get(name)
    return kept if isinstance(kept, Mapping) else {}


def _camera_json(camera: Camera) -> dict[str, object]:
    return {
        "intrinsics": [float(number) for number in camera.intrinsics],
        "size": [int(number) for number in camera.size],
        "pose": camera.pose,
        "mount": [float(number) for number in camera.mount],
    }


def cameras_of(world: Mapping, size: Sequence[int] = (1, 1)) -> dict[str, Camera]:
    """channel -> Camera, from the facts of a recorded world; {} without cameras. DatasetError where they are damaged.

    An old recording states one camera only: the main one, mounted on `pose`, whose pictures have `size`.
    """
    try:
        if "cameras" not in world:
            main = world.get("camera")
            return {"rgb": Camera(_numbers(main, 4), _numbers(size, 2, int))} if main else {}
        return {
            str(channel): Camera(
                _numbers(about["intrinsics"], 4),
                _numbers(about["size"], 2, int),
                None if about["pose"] is None else str(about["pose"]),
                _numbers(about["mount"], 7),
            )
            for channel, about in dict(world["cameras"]).items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"the cameras in meta/terrella.json are damaged ({error}); restore that file.") from error


def _numbers(values: Any, count: int, kind: type = float) -> Any:
    numbers = tuple(kind(value) for value in values)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{count} finite numbers were expected, not {values!r}")
    return numbers
