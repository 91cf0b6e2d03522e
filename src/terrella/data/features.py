"""The features of a stranger's info.json: whether they can be, which Sensor each is, and the pictures that its rows keep."""

import io
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from PIL import Image

from ..core.errors import DatasetError
from .channels import MOST_AXES
from .format import ACTION_VALID, AUTOMATIC, DEPTH_BEYOND, DEPTH_UNIT_M, TIME, names_of, schema
from .source import Sensor

LANGUAGE = "language"  # dtype of LeRobot's annotations (since v3.1): lists of {role, content, style, ...}
PERSISTENT, EVENTS = "language_persistent", "language_events"
_WIDEST = 1 << 27  # most numbers in a row of a feature; more is damage
_PICTURES = ("PNG", "JPEG", "WEBP", "TIFF")
_DEEP = ("I;16", "I;16B", "I;16L", "I", "F")  # Pillow's modes of one channel of more than 8 bits
_BOMBS = (Image.DecompressionBombError, Image.DecompressionBombWarning)
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6}
_UNIT_KEYS = ("unit_m", "depth_unit_m", "depth_scale", "depth_unit", "unit", "units")  # keys that writers use


def checked_features(features: object) -> dict[str, dict]:
    """The features of an info.json but its annotations, checked; ValueError where they are invalid."""
    if not isinstance(features, dict) or not 0 < len(features) <= 10_000:
        raise ValueError("features")
    features = {
        name: one for name, one in features.items() if not (isinstance(one, dict) and one.get("dtype") == LANGUAGE)
    }
    for name, feature in features.items():
        shape: list = (feature.get("shape") if isinstance(feature, dict) else None) or []
        whole = isinstance(shape, list) and 0 < len(shape) <= MOST_AXES and all(type(n) is int and n > 0 for n in shape)
        if not whole or not isinstance(feature.get("dtype"), str):
            raise ValueError(f"a dtype and shape of feature '{name[:100]}'")
        if math.prod(shape) > _WIDEST:
            raise ValueError(f"a possible shape of feature '{name[:100]}' ({math.prod(shape):,} numbers a row)")
        if feature["dtype"] in ("video", "image"):
            if len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):  # some write channels first
                feature["shape"] = shape = [shape[1], shape[2], shape[0]]
            if len(shape) != 3 or shape[2] not in (1, 3):
                raise ValueError(f"height, width and 1 or 3 channels of camera '{name[:100]}'")
    schema(features)
    return features


def sensors_of(features: Mapping[str, dict], known: Mapping[str, Sensor]) -> dict[str, Sensor]:
    """The Sensors of `features`, with the facts in `known` (the sensors of meta/terrella.json) added. A feature is depth if it
    states so, or if its name does and it holds uint16 numbers or pictures of one channel."""
    sensors = {}
    for name, feature in features.items():
        if name in AUTOMATIC or name in (ACTION_VALID, TIME):
            continue
        shape, dtype = tuple(feature["shape"]), feature["dtype"]
        more = known.get(name)
        if size := _depth_size(name, feature, more):
            unit = _unit_m(feature)
            sensor = Sensor(name, "depth", size, facts={} if unit == DEPTH_UNIT_M else {"unit_m": unit})
        elif dtype in ("video", "image"):
            sensor = Sensor(name, "image", (*shape[:2], 3), "uint8")
        else:
            sensor = Sensor(name, "vector", shape, dtype, names_of(feature))
        if more is not None:
            facts = {**sensor.facts, **more.facts}
            sensor = replace(sensor, units=more.units, frame=more.frame, rate_hz=more.rate_hz, facts=facts)
        sensors[name] = sensor
    return sensors


def decode_picture(picture: Mapping | None, shape: tuple[int, ...], camera: str) -> np.ndarray:
    """A picture stored as bytes: uint8 [H, W, 3], or [H, W] as stored where it has one channel of more than 8 bits."""
    try:
        with Image.open(io.BytesIO((picture or {})["bytes"]), formats=_PICTURES) as image:
            if image.size != (shape[1], shape[0]):
                raise ValueError(f"it has {image.size[1]}x{image.size[0]} pixels, {shape[0]}x{shape[1]} are promised")
            return np.asarray(image if image.mode in _DEEP else image.convert("RGB"))
    except (OSError, ValueError, KeyError, TypeError, SyntaxError, *_BOMBS) as error:
        raise DatasetError(f"a picture of {camera} cannot be read ({error}); restore its file from a copy.") from error


def to_picture(picture: Mapping | None, sensor: Sensor) -> np.ndarray:
    """A picture kept as bytes, as its sensor is: uint8 [H, W, 3], or depth [H, W] as it is stored (of 8 bits too)."""
    array = decode_picture(picture, sensor.shape, sensor.name)
    if sensor.kind == "depth":
        return array if array.ndim == 2 else array[..., 0].astype(np.uint16)
    if array.ndim == 2:
        raise DatasetError(f"a picture of {sensor.name} has one channel of {array.dtype}: it is depth, not a picture.")
    return array


def to_metres(stored: np.ndarray, sensor: Sensor, beyond: float = np.inf) -> np.ndarray:
    """Stored depth as float32 metres; `beyond` where nothing was in range. Floats are metres already."""
    if stored.dtype.kind == "f":
        return stored.astype(np.float32, copy=False)
    depth_m = stored.astype(np.float32) * np.float32(unit_of(sensor))
    return np.where(stored == DEPTH_BEYOND, np.float32(beyond), depth_m)


def unit_of(sensor: Sensor) -> float:
    """Metres of one step of stored depth."""
    unit = sensor.facts.get("unit_m", DEPTH_UNIT_M)
    return float(unit) if isinstance(unit, int | float) and 0 < unit < math.inf else DEPTH_UNIT_M


def _depth_size(name: str, feature: Mapping, known: Sensor | None) -> tuple[int, int] | None:
    """(height, width) of a feature that holds depth, None where it holds something else."""
    shape, dtype, about = tuple(feature["shape"]), feature["dtype"], _about(feature)
    named = "depth" in name.lower() if known is None else known.kind == "depth"
    if dtype in ("image", "video"):
        deep = dtype == "image" or "16" in str(about.get("video.pix_fmt", ""))
        return shape[:2] if shape[2] == 1 and deep and (named or _is_depth_map(about)) else None
    plain = [n for n in shape if n > 1] if len(shape) == 3 and 1 in (shape[0], shape[2]) else list(shape)
    if len(plain) == 2 and ((dtype == "uint16" and named) or _is_depth_map(about)):
        return plain[0], plain[1]
    return None


def _about(feature: Mapping) -> Mapping:
    info = feature.get("info") or feature.get("video_info") or {}
    return info if isinstance(info, Mapping) else {}


def _is_depth_map(about: Mapping) -> bool:
    return bool(about.get("is_depth_map") or about.get("video.is_depth_map"))


def _unit_m(feature: Mapping) -> float:
    """Metres of one step of a depth feature, by its facts; DEPTH_UNIT_M where it states none."""
    for stated in (feature, _about(feature)):
        for key in _UNIT_KEYS:
            unit = stated.get(key)
            unit = _METRES.get(unit) if isinstance(unit, str) else unit
            if isinstance(unit, int | float) and not isinstance(unit, bool) and 0 < unit < math.inf:
                return float(unit)
    return DEPTH_UNIT_M
