"""The LeRobotDataset v3.0 layout: where its files lie, which features it has, and how Arrow holds them."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..core.spec import Spec, shape_of
from .channels import ACTION, DONE, REWARD, facts_of, sensors_of_channels
from .source import Sensor, is_action

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO, STATS, TASKS, WORLD = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/terrella.json"

ACTION_VALID = "action_valid"
TIME = "time_s"  # float64: seconds since the episode began, by the recorder's clock; `timestamp` is frame_index / fps
AUTOMATIC = ("timestamp", "frame_index", "episode_index", "index", "task_index")
POSE_CONVENTION = "T_world_cam: metres and quaternion w,x,y,z; world z up; camera x forward, y left, z up"
DEPTH_UNIT_M = 0.001  # one step of the stored uint16
DEPTH_BEYOND = 65535  # stored where nothing lies within range; reads back as 65.535 m


@dataclass(frozen=True)
class Layout:
    """What a recording holds.

    fps:      rows a second.
    sensors:  what each row has: images, depth, vectors of any shape; "action", "next.reward" and "next.done" are among them.
    streams:  what has a clock of its own and is kept next to the rows with true times, under streams/.
    clock:    whether each row keeps its true time too (TIME), next to LeRobot's frame_index / fps.
    pictures: "video" (H.264, lossy) or "png" (exact; for small worlds).
    robot:    LeRobot's robot_type.
    world:    free facts about the recorded world, kept in meta/terrella.json.
    facts:    whatever else is kept there, by name.
    channels: channel of the recorded world -> the sensor that holds it, where that is not `feature_of(channel)`.
    """

    fps: float
    sensors: Mapping[str, Sensor]
    streams: Mapping[str, Sensor] = field(default_factory=dict)
    clock: bool = False
    pictures: Literal["video", "png"] = "video"
    robot: str = "terrella"
    world: Mapping[str, object] = field(default_factory=dict)
    facts: Mapping[str, object] = field(default_factory=dict)
    channels: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of(spec: Spec, fps: float | None = None) -> Layout:
        """The layout that records a world (see Spec.recorded); DatasetError names what no recording can hold."""
        channels = sensors_of_channels(spec)
        width = int(np.prod(shape_of(spec.action)))
        names = spec.action_names if len(spec.action_names) == width else tuple(f"action_{i}" for i in range(width))
        units = spec.action_units or (spec.units.get(ACTION, ""),) * width
        units = {name: unit for name, unit in zip(names, units) if unit}
        action = Sensor(ACTION, "vector", (width,), names=names, units=units, frame=spec.action_frame)
        follow = {"reward": Sensor(REWARD, "vector", (1,)), "done": Sensor(DONE, "vector", (1,), "bool")}
        seen = [sensor for name, sensor in channels.items() if name not in follow]
        made = [*seen, action, *(channels.get(name, sensor) for name, sensor in follow.items())]
        rate = whole_rate(fps if fps is not None else 1 / spec.dt_s)
        named = {name: sensor.name for name, sensor in channels.items()}
        return Layout(rate, {sensor.name: sensor for sensor in made}, world=facts_of(spec), channels=named)

    @property
    def rows(self) -> dict[str, Sensor]:
        """The sensors of a row, with those that the recorder adds: which actions count, and the true time."""
        sensors = dict(self.sensors)
        if any(map(is_action, sensors)):
            sensors[ACTION_VALID] = Sensor(ACTION_VALID, "vector", (1,), "bool")
        if self.clock:
            sensors[TIME] = Sensor(TIME, "vector", (1,), "float64", units={TIME: "s"})
        return sensors

    def features(self) -> dict[str, dict]:
        """The `features` of meta/info.json."""
        features = {name: self._feature(sensor) for name, sensor in self.rows.items()}
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        for name in AUTOMATIC[1:]:
            features[name] = {"dtype": "int64", "shape": [1], "names": None}
        return features

    def _feature(self, sensor: Sensor) -> dict:
        shape, names = list(sensor.shape), list(sensor.names) or None
        if not shape or min(shape) < 1:
            why = "this world has no actions" if sensor.name == "action" else "a row needs numbers of a fixed shape"
            raise DatasetError(f"{sensor.name} has shape {tuple(shape)}: {why}.")
        if sensor.kind == "points":
            raise DatasetError(f"{sensor.name} has any number of points, which no row can hold: keep it as a stream.")
        if sensor.kind == "depth":
            return {"dtype": "uint16", "shape": shape, "names": ["height", "width"]}
        if sensor.kind == "vector":
            return {"dtype": sensor.dtype, "shape": shape, "names": names}
        if self.pictures == "png":
            return {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
        height, width = even_size(sensor)
        info = {"height": height, "width": width, "codec": "h264", "pix_fmt": "yuv420p", "is_depth_map": False}
        info = {f"video.{key}": value for key, value in {**info, "fps": self.fps, "channels": 3}.items()}
        names = ["height", "width", "channels"]
        return {"dtype": "video", "shape": shape, "names": names, "info": {**info, "has_audio": False}}


def even_size(sensor: Sensor) -> tuple[int, int]:
    """(height, width) of an image sensor that H.264 can hold; DatasetError where it cannot."""
    height, width = sensor.shape[:2]
    if height % 2 or width % 2:
        raise DatasetError(
            f"H.264 video needs an even height and width; {sensor.name}, {height}x{width}, is not: resize it, or record PNG."
        )
    return height, width


def names_of(feature: Mapping) -> tuple[str, ...]:
    """One name per number of a feature, () where it does not say."""
    names = feature.get("names")
    if isinstance(names, dict):  # older writers group them
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    return tuple(str(name) for name in names) if names else ()


def some_of(things: Sequence[object], most: int = 5) -> str:
    """The first few things in words: "3, 5, 8, 9, 12 and 4 more"."""
    more = f" and {len(things) - most} more" * (len(things) > most)
    return ", ".join(map(str, things[:most])) + more


def sensor_json(sensor: Sensor) -> dict:
    """A Sensor as meta/terrella.json keeps it."""
    plain = {"shape": list(sensor.shape), "names": list(sensor.names)}
    plain |= {"units": dict(sensor.units), "facts": dict(sensor.facts)}
    return {key: plain.get(key, value) for key, value in vars(sensor).items() if key != "name"}


def sensor_from_json(name: str, stated: Mapping) -> Sensor:
    """The inverse of `sensor_json`; KeyError, TypeError or ValueError where it is not one."""
    if stated["kind"] not in ("image", "depth", "points", "vector"):
        raise ValueError(f"{name} is of kind {stated['kind']!r}")
    rate = stated.get("rate_hz")
    return Sensor(
        name, stated["kind"], tuple(int(n) for n in stated["shape"]),
        str(np.dtype(stated["dtype"])) if stated["dtype"] != "string" else "string",
        tuple(str(n) for n in stated.get("names", ())),
        {str(key): str(unit) for key, unit in dict(stated.get("units", {})).items()}, str(stated.get("frame", "")),
        None if rate is None else float(rate), dict(stated.get("facts", {})),
    )  # fmt: skip


def whole_rate(fps: float) -> float:
    """A rate that is whole but for rounding, as an int."""
    return int(round(fps)) if abs(fps - round(fps)) < 1e-6 else float(fps)


def file_numbers(episode: int) -> dict[str, int]:
    """Chunk and file number of an episode's own files."""
    return {"chunk_index": episode // FILES_PER_CHUNK, "file_index": episode % FILES_PER_CHUNK}


def stream_path(name: str, episode: int, suffix: str) -> str:
    """Where a stream's table ("parquet") or film ("mp4") of an episode lies."""
    return "streams/{}/chunk-{chunk_index:03d}/file-{file_index:03d}.{}".format(name, suffix, **file_numbers(episode))


_FIELD = re.compile(r"\{(\w+)(?::0?[0-9])?d?\}")


def fill_template(template: str, **values: object) -> str:
    """A path template of info.json, filled in; DatasetError where it has other fields, or leads out of the dataset."""
    bare = _FIELD.sub("", template)
    unknown = set(_FIELD.findall(template)) - set(values)
    if "{" in bare or "}" in bare or unknown:
        raise DatasetError(f"the path template {template[:200]!r} of info.json is not one of LeRobot v3.")
    try:
        path = template.format(**values)
    except (ValueError, TypeError) as error:
        raise DatasetError(f"the path template {template[:200]!r} of info.json is not one of LeRobot v3.") from error
    return checked_name(path)


def checked_name(path: str) -> str:
    """A relative path that stays in its folder; else DatasetError."""
    parts = path.replace("\\", "/").split("/")
    if not path or path.startswith(("/", "~")) or ".." in parts or "\0" in path or ":" in parts[0] or len(path) > 1000:
        raise DatasetError(f"the path {path[:200]!r} leads out of the dataset; name files within it.")
    return path


def path_inside(root: Path, name: str) -> Path:
    """Where a file of a dataset lies, there or not; DatasetError where its name or a symbolic link leads out of `root`. In a
    Hugging Face cache (snapshots/REVISION/… -> ../../blobs/…) a link may lead to that cache's own blobs."""
    path, home = root / checked_name(name), os.path.realpath(root)
    real = os.path.realpath(path)
    parts = Path(home).parts
    blobs = [Path(*parts[:at], "blobs") for at, part in enumerate(parts) if part == "snapshots"]
    if not any(real.startswith(f"{folder}{os.sep}".replace("//", "/")) for folder in (home, *blobs)) and real != home:
        raise DatasetError(f"{path} is a link that leads out of the dataset, to {real}; put the file itself there.")
    return path


def schema(features: Mapping[str, dict]) -> pa.Schema:
    """Arrow schema of the data files, with the metadata from which Hugging Face `datasets` restores its types."""
    fields, described = [], {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        arrow, value = _types(feature["dtype"], tuple(feature["shape"]))
        fields.append(pa.field(key, arrow))
        described[key] = value
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": described}})})


PICTURE = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])  # as `datasets` keeps images


def _types(dtype: str, shape: tuple[int, ...]) -> tuple[pa.DataType, dict]:
    """The Arrow type of a feature, and what `datasets` calls it."""
    if dtype == "image":
        return PICTURE, {"_type": "Image"}
    try:
        arrow = pa.bool_() if dtype == "bool" else pa.string() if dtype == "string" else pa.from_numpy_dtype(dtype)
    except (TypeError, pa.ArrowException) as error:
        raise DatasetError(f"a feature of type {str(dtype)[:80]!r} is none that a recording can hold.") from error
    value: dict = {"dtype": dtype, "_type": "Value"}
    if len(shape) >= 2:
        for _ in shape:
            arrow = pa.list_(arrow)
        return arrow, {"shape": list(shape), "dtype": dtype, "_type": f"Array{len(shape)}D"}
    width = int(np.prod(shape))
    if width != 1:
        return pa.list_(arrow, width), {"feature": value, "length": width, "_type": "Sequence"}
    return arrow, value


def to_arrow(array: np.ndarray, kind: pa.DataType) -> pa.Array:
    """A numpy array [T], [T, n] or [T, h, w, …] as an Arrow array of a type from `schema`; pictures as PNG bytes [T]."""
    if kind == PICTURE:
        return pa.array([{"bytes": picture, "path": None} for picture in array], PICTURE)
    flat = pa.array(np.ascontiguousarray(array).reshape(-1), None if array.dtype != object else pa.string())
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(flat, kind.list_size)
    if pa.types.is_list(kind):
        for axis in range(array.ndim - 1, 0, -1):
            offsets = np.arange(int(np.prod(array.shape[:axis])) + 1, dtype=np.int32) * array.shape[axis]
            flat = pa.ListArray.from_arrays(offsets, flat)
    return flat


def to_numpy(column: pa.ChunkedArray, shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of `to_arrow`: [T, *shape], or ValueError where a row has another size or is null."""
    rows, flat = len(column), column.combine_chunks()
    while pa.types.is_list(flat.type) or pa.types.is_large_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        if not pa.types.is_fixed_size_list(flat.type) and len(flat.value_lengths().unique()) > 1:
            raise ValueError(f"its rows are not all of shape {shape}")
        flat = flat.flatten()
    if flat.null_count or len(flat) != rows * int(np.prod(shape)):
        raise ValueError(f"its rows are not all of shape {shape}")
    return flat.to_numpy(zero_copy_only=False).reshape(rows, *shape)
