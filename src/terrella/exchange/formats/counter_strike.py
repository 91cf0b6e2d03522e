"""Reads the Counter-Strike deathmatch recordings that DIAMOND was trained on (Pearce and Zhu, arXiv:2104.04258)."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Sensor, Source, Take
from . import arrays, hdf5_file, rows

# ACTION names the numbers of frame_i_y, AUX those of frame_i_xaux (the last three actions and their effects).
FPS = 16.0
KEYS = ("w", "a", "s", "d", "space", "ctrl", "shift", "1", "2", "3", "r")
CLICKS = ("mouse_left", "mouse_right")
_X = (2, 4, 10, 20, 30, 60, 100, 200, 300, 500, 1000)
_Y = (2, 4, 10, 20, 50, 100, 200)
MOUSE_X, MOUSE_Y = (tuple(sorted({*half, 0, *(-step for step in half)})) for half in (_X, _Y))
ACTION = (*KEYS, *CLICKS, *(f"mouse_x={step}" for step in MOUSE_X), *(f"mouse_y={step}" for step in MOUSE_Y))
AUX = tuple(
    f"{back}_ago.{name}"
    for back in (1, 2, 3)
    for name in (*KEYS, *CLICKS, "mouse_x_of_1000", "mouse_y_of_200", "health_of_100", "ammo_of_30", "is_ct")
)
_FRAME = r"frame_\d+_(x|xaux|y|helperarr)"
_PARTS = {  # frame_i_PART -> its sensor, and the names of its numbers
    "x": (f"{rows.IMAGES}{rows.CAMERA}", ()),
    "xaux": ("observation.xaux", AUX),
    "y": (rows.ACTION, ACTION),
    "helperarr": ("observation.events", ("kill", "death")),
}


def read(path: Path, files: list[Path], fps: float | None) -> Source:
    """Files of frame_i_x (picture), frame_i_y (action), frame_i_xaux and frame_i_helperarr; each file is one take at 16 Hz.

    Pictures are stored as BGR and returned as RGB. An action has 51 numbers, 0 or 1: 11 keys, 2 mouse buttons, one of 23
    horizontal and one of 15 vertical mouse steps (see ACTION). "observation.events" is 1 where the player scored a kill, and
    where it died, since the last row.
    """
    sensors: dict[arrays.Place, Sensor] = {}
    for path_of_take in files:
        with hdf5_file.open_file(path_of_take) as file:
            for part in _PARTS:
                if (part,) not in sensors and f"frame_0_{part}" in file:
                    sensors[part,] = _sensor(path_of_take, file, part, fps or FPS)
    base = path if path.is_dir() else path.parent

    def takes(rate: float) -> Iterator[Take]:
        for file in files:
            stored, others = _episode(file, sensors)
            readings = arrays.readings(stored, sensors, np.arange(stored["x",].shape[0]) / rate, str(file))
            notes = (f"'{name}' is left out: it is not known." for name in others)
            yield Take(readings, facts={"file": file.relative_to(base).as_posix()}, notes=tuple(notes))

    name = path.name if path.is_dir() else path.stem
    facts = {"layout": "counter-strike"}
    return arrays.source(name, name, sensors, takes, fps=fps or FPS, about={"robot": "counter-strike"}, facts=facts)


def _sensor(path: Path, file: hdf5_file.File, part: str, fps: float) -> Sensor:
    name, names = _PARTS[part]
    data = hdf5_file.numeric(file, f"frame_0_{part}")
    kind = "image" if part == "x" else "vector"
    valid = data.ndim == 1 if kind == "vector" else data.shape[2:] == (3,) and data.dtype == np.uint8
    if not valid:
        raise DatasetError(f"{path}/frame_0_{part} is {data.dtype} {list(data.shape)}, not a {kind}.")
    if kind == "image":
        rows.check_size(data.shape[0], data.shape[1], f"{path}/frame_0_x")
    return Sensor(name, kind, data.shape, data.dtype.name, names if len(names) == len(data) else (), rate_hz=fps)


def _episode(path: Path, sensors: Mapping[arrays.Place, Sensor]) -> tuple[dict[arrays.Place, arrays.Array], list[str]]:
    """The arrays of a file, and the kinds of others in it, with # for the number of the frame."""
    with hdf5_file.open_file(path) as file:
        names = set(hdf5_file.names_in(file))
    frames = sum(bool(re.fullmatch(r"frame_\d+_x", key)) for key in names)
    sensors = {(part,): it for (part,), it in sensors.items() if part == "x" or f"frame_0_{part}" in names}
    needed = [f"frame_{i}_{part}" for i in range(max(frames, 1)) for (part,) in sensors]
    if missing := [key for key in needed if key not in names]:
        raise DatasetError(f"{path} lacks {missing[0]}; it is truncated, or not a Counter-Strike recording.")

    def one(part: str, sensor: Sensor) -> arrays.Array:
        def read(start: int, stop: int) -> np.ndarray:
            values = np.empty((stop - start, *sensor.shape), sensor.dtype)
            with hdf5_file.open_file(path) as file:
                for i in range(start, stop):
                    frame = hdf5_file.numeric(file, f"frame_{i}_{part}")
                    if frame.shape != sensor.shape:
                        shape, want = list(frame.shape), list(sensor.shape)
                        raise DatasetError(f"{path}{frame.name} is {shape} where the first frame has {want}.")
                    values[i - start] = frame[()]
            return values[..., ::-1] if part == "x" else values  # BGR to RGB

        return arrays.Array((frames, *sensor.shape), np.dtype(sensor.dtype), read)

    others = {re.sub(r"\d+", "#", key) for key in names if not re.fullmatch(_FRAME, key)}
    return {place: one(str(place[0]), sensor) for place, sensor in sensors.items()}, sorted(others)
