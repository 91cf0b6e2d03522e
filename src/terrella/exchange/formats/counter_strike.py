"""The Counter-Strike deathmatch recordings that DIAMOND learned from (Pearce and Zhu, arXiv:2104.04258), read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import hdf5, rows

# what is at each place of frame_i_y (ACTION) and of frame_i_xaux (AUX: the last three actions and what they met)
FPS = 16.0
KEYS = ("w", "a", "s", "d", "space", "ctrl", "shift", "1", "2", "3", "r")
CLICKS = ("mouse_left", "mouse_right")
_X = (2, 4, 10, 20, 30, 60, 100, 200, 300, 500, 1000)
_Y = (2, 4, 10, 20, 50, 100, 200)
MOUSE_X, MOUSE_Y = (tuple(sorted({*half, 0, *(-step for step in half)})) for half in (_X, _Y))
ACTION = (
    *KEYS,
    *CLICKS,
    *(f"mouse_x={step}" for step in MOUSE_X),
    *(f"mouse_y={step}" for step in MOUSE_Y),
)
AUX = tuple(
    f"{back}_ago.{name}"
    for back in (1, 2, 3)
    for name in (*KEYS, *CLICKS, "mouse_x_of_1000", "mouse_y_of_200", "health_of_100", "ammo_of_30", "is_ct")
)
_PARTS = {
    "xaux": ("observation.xaux", AUX),
    "y": (rows.ACTION, ACTION),
    "helperarr": ("observation.events", ("kill", "death")),
}


def read(path: Path, files: list[Path], fps: float | None) -> Source:
    """Files of frame_i_x (picture), frame_i_y (action), frame_i_xaux, frame_i_helperarr: each one take, 16 rows a second.

    Pictures are stored blue first and given red first. An action has 51 numbers, 0 or 1: 11 keys, 2 mouse buttons, one of
    23 horizontal and one of 15 vertical mouse steps (ACTION names them). "observation.events" says whether the player
    scored a kill, and whether it died, since the last row.
    """
    rate = fps or FPS
    with hdf5.opened(files[0]) as file:
        picture = hdf5.numbers(file, "frame_0_x")
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise DatasetError(f"{files[0]}/frame_0_x is {picture.dtype} {list(picture.shape)}, not a picture.")
        rows.check_size(picture.shape[0], picture.shape[1], f"{files[0]}/frame_0_x")
        found = [Sensor(f"{rows.IMAGES}{rows.CAMERA}", "image", picture.shape, "uint8", rate_hz=rate)]
        for part, (name, names) in _PARTS.items():
            if f"frame_0_{part}" in file:
                values = hdf5.numbers(file, f"frame_0_{part}")
                if values.ndim != 1:
                    raise DatasetError(f"{files[0]}/frame_0_{part} is {list(values.shape)}, not one row of numbers.")
                named = names if len(names) == len(values) else ()
                found.append(Sensor(name, "vector", values.shape, values.dtype.name, named, rate_hz=rate))
    sensors = {sensor.name: sensor for sensor in found}
    base = path if path.is_dir() else path.parent
    return Source(
        name=path.name if path.is_dir() else path.stem,
        sensors=sensors,
        takes=lambda: (_take(file, sensors, rate, file.relative_to(base).as_posix()) for file in files),
        fps=rate,
        robot="counter-strike",
        facts={"layout": "counter-strike"},
    )


def _take(path: Path, sensors: Mapping[str, Sensor], fps: float, name: str) -> Take:
    parts = {part: sensors[sensor] for part, (sensor, _) in _PARTS.items() if sensor in sensors}
    with hdf5.opened(path) as file:
        names = set(hdf5.members(file))
        frames = sum(bool(re.fullmatch(r"frame_\d+_x", key)) for key in names)
        missing = [
            key
            for i in range(frames)
            for key in (f"frame_{i}_x", *(f"frame_{i}_{p}" for p in parts))
            if key not in names
        ]
        if missing or not frames:
            raise DatasetError(
                f"{path} lacks {(missing or ['frame_0_x'])[0]}; it is truncated, or no Counter-Strike recording."
            )
        time_s = np.arange(frames) / fps
        readings = {}
        for part, sensor in parts.items():
            values = np.empty((frames, *sensor.shape), sensor.dtype)
            for i in range(frames):
                values[i] = _value(file, f"frame_{i}_{part}", sensor)
            readings[sensor.name] = Readings(time_s, values)
    camera = sensors[f"{rows.IMAGES}{rows.CAMERA}"]

    def picture(i: int) -> np.ndarray:
        with hdf5.opened(path) as file:
            return np.ascontiguousarray(_value(file, f"frame_{i}_x", camera)[..., ::-1])  # stored blue, green, red

    readings[camera.name] = Readings(time_s, Lazy(frames, picture))
    return Take(readings, facts={"file": name})


def _value(file: hdf5.File, name: str, sensor: Sensor) -> np.ndarray:
    dataset = hdf5.numbers(file, name)
    if dataset.shape != sensor.shape:
        raise DatasetError(
            f"{file.filename}/{name} is {list(dataset.shape)} where the first frame has {list(sensor.shape)}."
        )
    return np.asarray(dataset[()], sensor.dtype)
