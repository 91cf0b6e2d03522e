"""The Counter-Strike deathmatch recordings that DIAMOND learned from (Pearce and Zhu, arXiv:2104.04258), read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Sensor, Source, Take
from . import arrays, hdf5, rows

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
_PARTS = {  # frame_i_PART -> its sensor, and the names of its numbers
    "x": (f"{rows.IMAGES}{rows.CAMERA}", ()),
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
    sensors: dict[arrays.Place, Sensor] = {}
    with hdf5.opened(files[0]) as file:
        for part, (name, names) in _PARTS.items():
            if f"frame_0_{part}" in file:
                found = hdf5.numbers(file, f"frame_0_{part}")
                kind = "image" if part == "x" else "vector"
                good = found.ndim == 1 if kind == "vector" else found.shape[2:] == (3,) and found.dtype == np.uint8
                if not good:
                    raise DatasetError(f"{files[0]}/frame_0_{part} is {found.dtype} {list(found.shape)}, not a {kind}.")
                if kind == "image":
                    rows.check_size(found.shape[0], found.shape[1], f"{files[0]}/frame_0_x")
                names = names if len(names) == len(found) else ()
                sensors[part,] = Sensor(name, kind, found.shape, found.dtype.name, names, rate_hz=fps or FPS)
    base = path if path.is_dir() else path.parent

    def takes(rate: float) -> Iterator[Take]:
        for file in files:
            there = _episode(file, sensors)
            found = arrays.readings(there, sensors, np.arange(there["x",].shape[0]) / rate, str(file))
            yield Take(found, facts={"file": file.relative_to(base).as_posix()})

    name = path.name if path.is_dir() else path.stem
    facts = {"layout": "counter-strike"}
    return arrays.source(name, name, sensors, takes, fps=fps or FPS, robot="counter-strike", facts=facts)


def _episode(path: Path, sensors: dict[arrays.Place, Sensor]) -> dict[arrays.Place, arrays.Array]:
    with hdf5.opened(path) as file:
        names = set(hdf5.members(file))
    frames = sum(bool(re.fullmatch(r"frame_\d+_x", key)) for key in names)
    needed = [f"frame_{i}_{part}" for i in range(max(frames, 1)) for (part,) in sensors]
    if missing := [key for key in needed if key not in names]:
        raise DatasetError(f"{path} lacks {missing[0]}; it is truncated, or no Counter-Strike recording.")

    def one(part: str, sensor: Sensor) -> arrays.Array:
        def read(start: int, stop: int) -> np.ndarray:
            found = np.empty((stop - start, *sensor.shape), sensor.dtype)
            with hdf5.opened(path) as file:
                for i in range(start, stop):
                    frame = hdf5.numbers(file, f"frame_{i}_{part}")
                    if frame.shape != sensor.shape:
                        shape, want = list(frame.shape), list(sensor.shape)
                        raise DatasetError(f"{path}{frame.name} is {shape} where the first frame has {want}.")
                    found[i - start] = frame[()]
            return found[..., ::-1] if part == "x" else found  # stored blue, green, red

        return arrays.Array((frames, *sensor.shape), np.dtype(sensor.dtype), read)

    return {place: one(str(place[0]), sensor) for place, sensor in sensors.items()}
