"""The LeRobotDataset v3.0 layout: where its files lie, which features it has and how Arrow holds them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from gymnasium import spaces

from ..core.errors import DatasetError
from ..core.spec import Spec, shape_of

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO, STATS, TASKS, WORLD = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/terrella.json"

RGB, DEPTH, STATE = "observation.images.rgb", "observation.depth", "observation.state"
ACTION, ACTION_VALID, REWARD, DONE = "action", "action_valid", "next.reward", "next.done"
POSE_NAMES = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
POSE_CONVENTION = "T_world_cam: metres and quaternion w,x,y,z; world z up; camera x forward, y left, z up"
DEPTH_UNIT_M = 0.001  # one step of the stored uint16
DEPTH_BEYOND = 65535  # stored where nothing lies within range; reads back as 65.535 m
KNOWN_CHANNELS = ("rgb", "depth", "pose", "reward", "done")


@dataclass(frozen=True)
class Layout:
    """What a recording holds.

    fps:     rows a second.
    action:  one name per number of an action (they are stored as float32).
    rgb:     (H, W) in pixels, both even (H.264 yuv420p); None without pictures.
    depth:   (h, w); None without depth.
    pose:    whether the camera's pose is recorded (float32 [7], T_world_cam).
    vectors: other channels, name -> length, stored as float32 `observation.NAME`.
    world:   free facts about the recorded world, kept in meta/terrella.json.
    """

    fps: float
    action: tuple[str, ...]
    rgb: tuple[int, int] | None = None
    depth: tuple[int, int] | None = None
    pose: bool = False
    vectors: Mapping[str, int] = field(default_factory=dict)
    world: Mapping[str, object] = field(default_factory=dict)

    @staticmethod
    def of(spec: Spec, fps: float | None = None) -> Layout:
        """The layout that records every channel of a world that LeRobot v3.0 can hold."""
        channels = spec.channels
        size = {name: _height_width(channels[name]) for name in ("rgb", "depth") if name in channels}
        vectors = {
            name: int(np.prod(shape_of(space)))
            for name, space in channels.items()
            if name not in KNOWN_CHANNELS and len(shape_of(space)) <= 1
        }
        width = int(np.prod(shape_of(spec.action)))
        names = spec.action_names if len(spec.action_names) == width else tuple(f"action_{i}" for i in range(width))
        exact = fps if fps is not None else 1 / spec.dt_s
        world = {
            "name": spec.name,
            "dt_s": spec.dt_s,
            "camera": list(spec.camera) if spec.camera else None,
            "action_space": str(spec.action),
            "action_names": list(spec.action_names),
            "keys": {key: [float(number) for number in value] for key, value in spec.keys.items()},
            "units": dict(spec.units),
            "discrete": isinstance(spec.action, spaces.Discrete),
        }
        return Layout(_tidy(exact), names, size.get("rgb"), size.get("depth"), "pose" in channels, vectors, world)

    def features(self) -> dict[str, dict]:
        """The `features` of meta/info.json."""
        if self.rgb and (self.rgb[0] % 2 or self.rgb[1] % 2):
            raise DatasetError(
                f"H.264 video needs an even height and width; {self.rgb[0]}x{self.rgb[1]} is not: resize rgb."
            )
        found: dict[str, dict] = {}
        if self.rgb:
            found[RGB] = {
                "dtype": "video",
                "shape": [*self.rgb, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": self.rgb[0],
                    "video.width": self.rgb[1],
                    "video.codec": "h264",
                    "video.pix_fmt": "yuv420p",
                    "video.is_depth_map": False,
                    "video.fps": self.fps,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
        if self.depth:
            found[DEPTH] = _feature("uint16", list(self.depth), ["height", "width"])
        if self.pose:
            found[STATE] = _feature("float32", [7], POSE_NAMES)
        for name, length in self.vectors.items():
            found[f"observation.{name}"] = _feature("float32", [length], [f"{name}_{i}" for i in range(length)])
        found[ACTION] = _feature("float32", [len(self.action)], list(self.action))
        found[ACTION_VALID] = _feature("bool", [1])
        found[REWARD] = _feature("float32", [1])
        found[DONE] = _feature("bool", [1])
        found["timestamp"] = _feature("float32", [1])
        for name in ("frame_index", "episode_index", "index", "task_index"):
            found[name] = _feature("int64", [1])
        return found


def _height_width(space: spaces.Space) -> tuple[int, int]:
    height, width = shape_of(space)[:2]
    return height, width


def _tidy(fps: float) -> float:
    return int(round(fps)) if abs(fps - round(fps)) < 1e-6 else float(fps)


def _feature(dtype: str, shape: list[int], names: list[str] | None = None) -> dict:
    return {"dtype": dtype, "shape": shape, "names": names}


def where(episode: int) -> dict[str, int]:
    """Chunk and file number of an episode's own files."""
    return {"chunk_index": episode // FILES_PER_CHUNK, "file_index": episode % FILES_PER_CHUNK}


def schema(features: Mapping[str, dict]) -> pa.Schema:
    """Arrow schema of the data files, with the metadata from which Hugging Face `datasets` restores its types."""
    fields, described = [], {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        value = {"dtype": feature["dtype"], "_type": "Value"}
        arrow, shape = _arrow(feature["dtype"]), feature["shape"]
        if len(shape) == 2:
            value = {"shape": shape, "dtype": feature["dtype"], "_type": "Array2D"}
            arrow = pa.list_(pa.list_(arrow))
        elif shape[0] != 1:
            value = {"feature": value, "length": shape[0], "_type": "Sequence"}
            arrow = pa.list_(arrow, shape[0])
        fields.append(pa.field(key, arrow))
        described[key] = value
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": described}})})


def _arrow(dtype: str) -> pa.DataType:
    return pa.bool_() if dtype == "bool" else pa.from_numpy_dtype(np.dtype(dtype))


def to_arrow(array: np.ndarray, kind: pa.DataType) -> pa.Array:
    """A numpy array [T], [T, n] or [T, h, w] as an Arrow array of a type from `schema`."""
    flat = pa.array(np.ascontiguousarray(array).reshape(-1))
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(flat, kind.list_size)
    if pa.types.is_list(kind):
        rows, height, width = array.shape
        lines = pa.ListArray.from_arrays(np.arange(0, rows * height * width + 1, width, dtype=np.int32), flat)
        return pa.ListArray.from_arrays(np.arange(0, rows * height + 1, height, dtype=np.int32), lines)
    return flat


def to_numpy(column: pa.ChunkedArray, shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of `to_arrow`: [T, *shape], or ValueError where a row has another size or is null."""
    rows, flat = len(column), column.combine_chunks()
    while pa.types.is_list(flat.type) or pa.types.is_large_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    if flat.null_count or len(flat) != rows * int(np.prod(shape)):
        raise ValueError(f"its rows are not all of shape {shape}")
    return flat.to_numpy(zero_copy_only=False).reshape(rows, *shape)
