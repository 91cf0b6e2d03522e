"""Arrays with a row per step as sensors, and back: shared by the formats that store episodes as rows."""

import json
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from ...core.errors import DatasetError
from ...data.format import sensor_from_json, sensor_json
from ...data.resample import clock_of
from ...data.source import Readings, Sensor, Source, Take

OBSERVATION, ACTION, INFO = "observation", "action", "info"
REWARD, DONE, TRUNCATED = "next.reward", "next.done", "next.truncated"
IMAGES, DEPTH = "observation.images.", "observation.depth"
CAMERA = "rgb"  # the camera's name where the format has none
LEAST_PICTURE_SIDE = 32  # as in Minari: smaller byte arrays are codes (MiniGrid's 7 x 7 x 3)
MAX_SIDE, MAX_PIXELS = 16_384, 1 << 26
FPS_UNKNOWN = 10.0  # rows per second if neither the recording nor the caller gives it
MAX_BYTES = 1 << 33  # of an episode's array; more means a damaged or hostile file
_MAX_CLOCK_SKEW = 0.5  # rows by which the sensors of one row may differ in time
PICTURE_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning)
_STORED = "stored_shape"


# -- arrays as sensors


def picture_layout(shape: Sequence[int], dtype: np.dtype | str, least: int = LEAST_PICTURE_SIDE) -> str | None:
    """The layout "hwc", "chw", "hw1" or "hw" of a byte array that is a picture, else None."""
    if np.dtype(dtype) != np.uint8 or len(shape) not in (2, 3):
        return None
    if len(shape) == 2:
        return "hw" if min(shape) >= least else None
    if shape[2] in (1, 3) and min(shape[:2]) >= least:
        return "hwc" if shape[2] == 3 else "hw1"
    if shape[0] in (1, 3) and min(shape[1:]) >= least:
        return "chw"
    return None


def sensor_for(role: str, key: str, shape: Sequence[int], dtype, least: int = LEAST_PICTURE_SIDE) -> Sensor:
    """The sensor of an array [n, *shape]: a picture if its bytes look like one (observations only), else a vector.

    role, key: "observation", "agent.pos" -> "observation.agent.pos", or "observation.images.agent.pos" for a picture. An
    empty key gives "observation.state" ("observation.images.rgb") or the role itself. A shape other than a flat vector or
    an RGB picture is kept in facts["stored_shape"]; `to_stored` restores it. DatasetError for non-numeric arrays.
    """
    shape, dtype = tuple(int(n) for n in shape), np.dtype(dtype)
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise DatasetError(f"'{key or role}' holds {dtype}, not numbers; leave it out of the recording.")
    if min(shape, default=0) < 0:
        raise DatasetError(f"'{key or role}' has the impossible shape {list(shape)}.")
    layout = picture_layout(shape, dtype, least) if role == OBSERVATION else None
    if layout is None:
        name = f"{role}.{key}" if role and key else ("observation.state" if role == OBSERVATION else role or key)
        return stored_as(Sensor(name, "vector", (math.prod(shape),), dtype.name), shape)
    height, width = shape[1:] if layout == "chw" else shape[:2]
    check_size(height, width, f"a picture of '{key or role}'")
    camera = key.removeprefix("images.") or CAMERA
    return stored_as(Sensor(f"{IMAGES}{camera}", "image", (height, width, 3), "uint8"), shape)


def depth_sensor(key: str, shape: Sequence[int], dtype) -> Sensor | None:
    """The sensor of pictures of metres, float32 [H, W] or [H, W, 1] called depth or NAME_depth; None for other arrays."""
    *_, end = re.split(r"[._/]", key)
    shape = tuple(int(n) for n in shape)
    if end != "depth" or dtype != np.float32 or len(shape) not in (2, 3) or shape[2:] not in ((), (1,)):
        return None
    check_size(shape[0], shape[1], f"'{key}'")
    camera = key.removesuffix("depth").rstrip("._/")
    return stored_as(Sensor(f"{DEPTH}.{clean(camera)}" if camera else DEPTH, "depth", shape[:2], "float32"), shape)


def stored_as(sensor: Sensor, shape: tuple[int, ...]) -> Sensor:
    """The sensor with `shape` as the stored shape of its readings; `stored_shape` ignores one that does not fit."""
    facts = {key: value for key, value in sensor.facts.items() if key != _STORED}
    return replace(sensor, facts=facts if shape == sensor.shape else {**facts, _STORED: list(shape)})


def stored_shape(sensor: Sensor) -> tuple[int, ...]:
    """The shape of one reading in its file."""
    given, shape = sensor.facts.get(_STORED), sensor.shape
    if not isinstance(given, list | tuple) or not all(isinstance(n, int) and n >= 0 for n in given):
        return shape
    possible = {(*shape, 1)} if sensor.kind == "depth" else set()
    if sensor.kind == "image":
        possible = {shape[:2], (*shape[:2], 1), (1, *shape[:2]), (3, *shape[:2])}
    fits = tuple(given) in possible or (sensor.kind == "vector" and math.prod(given) == shape[0])
    return tuple(given) if fits else shape


def from_stored(values: np.ndarray, sensor: Sensor) -> np.ndarray:
    """[n, *stored_shape] -> [n, *sensor.shape]."""
    if sensor.kind != "image" or values.shape[1:] == sensor.shape:
        return np.ascontiguousarray(values.reshape(len(values), *sensor.shape))
    height, width, _ = sensor.shape
    if values.ndim == 4 and values.shape[1] == 3:
        return np.ascontiguousarray(values.transpose(0, 2, 3, 1))
    return np.repeat(values.reshape(len(values), height, width, 1), 3, axis=3)


def to_stored(values: np.ndarray, sensor: Sensor) -> np.ndarray:
    """[n, *sensor.shape] -> [n, *stored_shape], in the sensor's dtype; grey is the mean of red, green and blue."""
    shape = stored_shape(sensor)
    values = np.asarray(values, sensor.dtype)
    if sensor.kind != "image" or shape == sensor.shape:
        return values.reshape(len(values), *shape)
    if shape[0] == 3:
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2))
    return np.rint(values.mean(axis=3, dtype=np.float64)).astype(np.uint8).reshape(len(values), *shape)


def check_size(height: int, width: int, what: str) -> None:
    """DatasetError for a picture that is too large to be real (a damaged or hostile file)."""
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        raise DatasetError(f"{what} is {width} x {height}; scale it to {MAX_PIXELS >> 20} megapixels or less.")


def metres(depth_mm: np.ndarray) -> np.ndarray:
    """Integer millimetres as float32 metres; 0 means no measurement and becomes inf."""
    return np.where(depth_mm > 0, depth_mm.astype(np.float32) / np.float32(1000), np.float32(np.inf))


def depth_lost(name: str, depth_m: np.ndarray, unit_m: float = 0.001) -> list[str]:
    """Notes on what depth in metres loses as 16-bit multiples of `unit_m`; inf and NaN lose nothing."""
    steps = np.asarray(depth_m, np.float64) / unit_m
    steps = steps[np.isfinite(steps) & (steps >= 0)]
    far, finer = steps > 65_535.5, np.abs(steps - np.rint(steps)) > 0.01
    lost = [f"depth of '{name}' beyond {65_535 * unit_m:g} m was kept as out of range"] if far.any() else []
    return lost + [f"depth of '{name}' was rounded to {1000 * unit_m:g} mm"] * bool((finer & ~far).any())


# -- names


def clean(part: str) -> str:
    """Text as part of a sensor's name: other characters than letters, digits, _ and - become _."""
    return re.sub(r"[^\w-]+", "_", part, flags=re.ASCII).strip("_") or "unnamed"


def unique(name: str, taken: Collection[str]) -> str:
    """`name`, or name_2, name_3, … if it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def natural(name: str | Path) -> list[tuple[int, int, str]]:
    """Sorting key that puts frame2 before frame10."""
    parts = re.split(r"(\d+)", str(name), flags=re.ASCII)
    return [(0, int(part), part) if i % 2 else (1, 0, part) for i, part in enumerate(parts)]


def role_of(name: str) -> str:
    """The role in a sensor's name: "observation", "action", "info", "next.reward", "next.done", "next.truncated" or ""."""
    if name in (REWARD, DONE, TRUNCATED):
        return name
    head = name.split(".", 1)[0]
    return head if head in (OBSERVATION, ACTION, INFO) else ""


# -- rows of a take


@dataclass(frozen=True)
class RowCounts:
    """The rows of a take whose sensors share one clock."""

    observations: int
    steps: int  # actions: as many as observations, or one less
    time_s: np.ndarray  # of the observations, s


def rows_of(take: Take, where: str) -> RowCounts:
    """The rows of a take; DatasetError where its sensors have different clocks."""
    seen = {name: len(r.time_s) for name, r in take.readings.items() if role_of(name) == OBSERVATION}
    done = {name: len(r.time_s) for name, r in take.readings.items() if role_of(name) not in (OBSERVATION, INFO, "")}
    for name, readings in take.readings.items():
        clock_of(readings, f"'{name}' in {where}")
    if len(set(seen.values())) > 1 or len(set(done.values())) > 1:
        counts = ", ".join(f"{name} {count}" for name, count in {**seen, **done}.items())
        raise DatasetError(f"{where} has sensors of different rates ({counts} readings); convert it to LeRobot first.")
    steps = next(iter(done.values()), 0)
    count = next(iter(seen.values()), steps)
    if not count or (done and steps not in (count, count - 1)):
        raise DatasetError(f"{where} has {count} observations and {steps} actions; it must have as many, or one less.")
    first = next(iter(seen or done))
    time_s = np.asarray(take.readings[first].time_s, np.float64)
    row_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else math.inf
    for name in (*seen, *done):
        other = take.readings[name].time_s
        if len(other) and np.abs(other - time_s[: len(other)]).max() > _MAX_CLOCK_SKEW * row_s:
            raise DatasetError(f"'{name}' in {where} was not read when '{first}' was; convert it to LeRobot first.")
    return RowCounts(count, steps, time_s)


def is_even(time_s: np.ndarray, fps: float | None) -> bool:
    """Whether row i lies at i / fps seconds."""
    return fps is not None and bool(np.allclose(time_s, np.arange(len(time_s)) / fps, rtol=0, atol=0.01 / fps))


def batches(
    values: Sequence[np.ndarray] | np.ndarray, sensor: Sensor, where: str, count: int | None = None, size: int = 64
) -> Iterator[np.ndarray]:
    """The (first `count`) values in batches of `size`, [m, *sensor.shape]; DatasetError where one has another shape."""
    count = len(values) if count is None else count
    for start in range(0, count, size):
        part = values[start : min(start + size, count)]
        for i, value in enumerate(part):
            if np.shape(value) != sensor.shape:
                shape = list(np.shape(value))
                raise DatasetError(f"'{sensor.name}' in {where} is {shape} at {start + i}, not {list(sensor.shape)}.")
        yield np.asarray(part).reshape(len(part), *sensor.shape)


def stored_values(readings: Readings, sensor: Sensor, where: str) -> np.ndarray:
    """All values of a sensor as one array [n, *stored_shape]."""
    parts = [to_stored(part, sensor) for part in batches(readings.values, sensor, where)]
    return np.concatenate(parts) if parts else np.empty((0, *stored_shape(sensor)), sensor.dtype)


def check_fps(fps: float | None, what: str) -> None:
    """DatasetError for an fps that is not positive and finite."""
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise DatasetError(f"{what} has {fps} rows a second; give an fps above 0.")


def rate_of(given: float | None, known: object, what: str) -> tuple[float, tuple[str, ...]]:
    """Rows per second: the caller's, else the file's, else FPS_UNKNOWN with a note."""
    if given is not None:
        return float(given), ()
    if isinstance(known, int | float) and not isinstance(known, bool) and np.isfinite(known) and known > 0:
        return float(known), ()
    return FPS_UNKNOWN, (
        f"{what} stores no times: rows are assumed to be 1/{FPS_UNKNOWN:g} s apart; give fps to correct that.",
    )


def facts_of(take: Take) -> list[str]:
    """The names of the facts of a take but for its language; each of its texts is one: "texts observations/sign"."""
    texts = take.facts.get("texts")
    names = [f"texts {name}" for name in texts] if isinstance(texts, Mapping) else []
    return sorted([*(set(take.facts) - {"language", "texts"}), *names])


# -- our own description, stored with the arrays: names, units and frames


def describe(source: Source) -> dict:
    """JSON of everything in a source that its arrays do not hold."""
    return {
        "sensors": [{"name": name, **sensor_json(sensor)} for name, sensor in source.sensors.items()],
        "fps": source.fps,
        "robot": source.robot,
        "name": source.name,
        "facts": dict(source.facts),
    }


def sensors_described(text: object, where: str) -> dict[str, Sensor]:
    """The sensors of a description; DatasetError where it is damaged."""
    try:
        sensors = [sensor_of(item) for item in text["sensors"]]  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"the description of sensors in {where} is damaged ({error}); delete it.") from error
    return {sensor.name: sensor for sensor in sensors}


def sensor_of(item: Mapping) -> Sensor:
    """A sensor from its description in a file; ValueError, TypeError or KeyError where it is invalid."""
    sensor = sensor_from_json(str(item["name"]), item)
    dimensions = {"image": 3, "depth": 2, "points": 2}.get(sensor.kind, len(sensor.shape))
    dtype = {"image": "uint8", "depth": "float32", "points": "float32"}.get(sensor.kind, sensor.dtype)
    if sensor.dtype != dtype or np.dtype(dtype).kind not in "biuf":
        raise ValueError(f"'{sensor.name}' is {sensor.kind} of {sensor.dtype}")
    if len(sensor.shape) != dimensions or min(sensor.shape, default=0) < 0:
        raise ValueError(f"the shape of '{sensor.name}' is {list(sensor.shape)}")
    return sensor


def read_json(path: Path, missing: dict | None = None) -> dict:
    """A JSON object; DatasetError where it is damaged, or missing without a default `missing`."""
    if missing is not None and not path.exists():
        return missing
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = "damaged" if path.exists() else "missing"
        raise DatasetError(f"{path} is {what} ({error}); restore it from a copy.") from error
    if not isinstance(value, dict):
        raise DatasetError(f"{path} is not a JSON object; restore it from a copy.")
    return value


def json_or_none(value: object) -> object:
    """The value if JSON can represent it, with numpy's numbers and arrays as plain ones; else None."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return None
    return value


def numbered(source: Source, progress: Callable[[int, int], None] | None) -> Iterator[tuple[int, Take]]:
    """Numbered takes; `progress(takes, 0)` is called after each is written. DatasetError where there are none."""
    number = -1
    for number, take in enumerate(source.takes()):
        yield number, take
        if progress:
            progress(number + 1, 0)
    if number < 0:
        raise DatasetError(f"{source.name or 'the source'} has no takes; there is nothing to write.")
