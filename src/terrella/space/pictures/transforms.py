"""transforms.json: posed pictures of nerfstudio, instant-ngp and NeRF's Blender sets (x right, y up, z back; z up)."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...core.errors import DatasetError
from ..files import ply
from .locating import locate, spellings
from .posed import Lens, Shots, absent, pose_of
from .reading import read_picture

FILES = ("transforms.json", "transforms_train.json")  # the latter in Blender's sets
_CAMERA = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "camera_model", "is_fisheye")
_BENDS = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE")


def file_of(path: Path) -> Path | None:
    """The transforms.json at a path, or in that folder; None where there is none."""
    return next((file for name in FILES if (file := path / name).is_file()), path if path.name in FILES else None)


def read_transforms(path: Path) -> Shots:
    """The posed pictures of a transforms.json, or of its folder, without those that are absent; DatasetError for a broken one."""
    path = file_of(path) or path
    try:
        doc = json.loads(path.read_text("utf-8-sig"))
        frames = list(doc["frames"])
        if not frames:
            raise ValueError("it lists no frames")
        names = [str(frame["file_path"]) for frame in frames]
        located = locate((path.parent,), names)
        if not any(located):
            raise ValueError(f"none of its {len(frames)} pictures is there, such as {names[0]}")
        cameras: dict[tuple[Any, ...], Lens] = {}
        files, lenses, poses = [], [], []
        for frame, file in zip(frames, located):
            if file is None:
                continue
            matrix = np.array(frame["transform_matrix"], float)
            if matrix.shape not in ((4, 4), (3, 4)):
                raise ValueError(f"the pose of {file.name} is no 4 x 4 matrix")
            rot = np.stack([-matrix[:3, 2], -matrix[:3, 0], matrix[:3, 1]], 1)
            poses.append(pose_of(rot, matrix[:3, 3], f"{path}: {file.name}"))
            files.append(file)
            lenses.append(_lens(doc | frame, file, cameras))
        points, left_out = _points(path.parent, doc.get("ply_file_path"))
    except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DatasetError(f"{path} cannot be read as posed pictures: {reason}; write it again.") from error
    left_out += [absent(name) for name, file in zip(names, located) if file is None]
    for key, what in (("mask_path", "masks"), ("depth_file_path", "depth pictures")):
        if many := sum(bool(frame.get(key)) for frame in frames):
            left_out.append(f"{many} {what} ({key}), which are not read")
    return Shots(files, lenses, torch.stack(poses), points, True, tuple(left_out))


def _lens(frame: dict[str, Any], file: Path, cameras: dict[tuple[Any, ...], Lens]) -> Lens:
    """The lens of a frame; the same one for the same numbers."""
    key = tuple(frame.get(name) for name in (*_CAMERA, *_BENDS))
    if key not in cameras:
        model = str(frame.get("camera_model", "OPENCV"))
        if model not in _MODELS:
            raise ValueError(f"cameras of the model {model} are not known, only {', '.join(_MODELS)}")
        height, width = (frame["h"], frame["w"]) if "w" in frame and "h" in frame else read_picture(file).shape[:2]
        width, height = int(width), int(height)
        fx = _focal(frame, "fl_x", "camera_angle_x", width)
        fy = _focal(frame, "fl_y", "camera_angle_y", height) if {"fl_y", "camera_angle_y"} & frame.keys() else fx
        focal = [float(v) for v in (fx, fy, frame.get("cx", width / 2), frame.get("cy", height / 2))]
        bend = {name: float(frame.get(name) or 0) for name in _BENDS}
        if min(width, height) < 8 or not all(map(np.isfinite, [*focal, *bend.values()])) or min(focal[:2]) <= 0:
            raise ValueError(f"the camera of {file.name} has no sensible size or focal length")
        fisheye = model == "OPENCV_FISHEYE" or bool(frame.get("is_fisheye"))
        cameras[key] = Lens(
            width, height, (focal[0], focal[1], focal[2], focal[3]), lambda at: _opencv(at, focal, bend, fisheye)
        )
    return cameras[key]


def _focal(frame: dict[str, Any], focal: str, angle: str, side: int) -> float:
    """A focal length in pixels: as stated, or from the angle of view across `side` pixels."""
    return float(frame[focal]) if focal in frame else 0.5 * side / float(np.tan(0.5 * float(frame[angle])))


def _opencv(at: np.ndarray, focal: list[float], k: dict[str, float], fisheye: bool) -> np.ndarray:
    """Tangents [N, 2] to pixels by OpenCV's models of distortion."""
    r2 = (at**2).sum(1, keepdims=True)
    if fisheye:
        r = np.sqrt(np.maximum(r2, 1e-16))
        t = np.arctan(r)
        bent = at * t * (1 + t**2 * (k["k1"] + t**2 * (k["k2"] + t**2 * (k["k3"] + t**2 * k["k4"])))) / r
    else:
        x, y = at[:, :1], at[:, 1:]
        skew = np.concatenate(
            [2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x), k["p1"] * (r2 + 2 * y * y) + 2 * k["p2"] * x * y], 1
        )
        bent = at * (1 + r2 * (k["k1"] + r2 * (k["k2"] + r2 * k["k3"]))) + skew
    return bent * focal[:2] + focal[2:]


def _points(folder: Path, name: Any) -> tuple[torch.Tensor, list[str]]:
    """Known points [N, 3], and the file of points if it is of no use."""
    if not name:
        return torch.zeros(0, 3), []
    file = next((one for spelling in spellings(str(name)) if (one := folder / spelling).is_file()), None)
    try:
        if file is None:
            return torch.zeros(0, 3), [absent(str(name))]
        points = ply.columns(ply.parse(file.read_bytes())["vertex"], "x", "y", "z")
        return points[points.isfinite().all(1)], []
    except (OSError, ValueError, KeyError) as error:
        return torch.zeros(0, 3), [f"{name} ({error})"]
