"""Folders of .npz episodes, one rollout each: read and written."""

import json
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...core.files import creating
from ...data.source import Sensor, Source, Take
from . import arrays, rows
from .arrays import Array, Place

ABOUT = "terrella.json"  # our description, in the folder of the episodes: names, units and frames
TIME, TASK, START = "time_s", "task", "start_ns"
_SPELLINGS = {  # `write` uses the first
    rows.OBSERVATION: ("observations", "observation", "obs"),
    rows.ACTION: ("actions", "action"),
    rows.REWARD: ("rewards", "reward"),
    rows.DONE: ("terminations", "terminated", "terminals", "dones", "done"),
    rows.TRUNCATED: ("truncations", "truncated", "timeouts"),
    rows.INFO: ("infos", "info"),
}
_NAMES = {spelling: role for role, spellings in _SPELLINGS.items() for spelling in spellings}


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of .npz files, one episode each, in the natural order of their names (or one such file).

    Keys: observations (obs), actions, rewards, terminations (terminated, dones), truncations (truncated), infos; entries of
    a Dict are "observations/NAME" or "obs.NAME". There are as many observations as actions, or one more. The first file
    determines the sensors. Files of `write` keep their names, units, times and tasks. Pickled arrays are refused.

    fps: rows per second. Default: the folder's own, else rows.FPS_UNKNOWN with a note.
    DatasetError where there are no such files, or one is damaged or differs in shape from the first.
    """
    path = Path(path)
    rows.check_fps(fps, str(path))
    files = sorted(path.glob("*.npz"), key=lambda p: rows.natural(p.name)) if path.is_dir() else [path]
    if not files:
        raise DatasetError(f"{path} has no .npz files; name a folder of episodes, one .npz each.")
    about = rows.read_json((path if path.is_dir() else path.parent) / ABOUT, missing={})
    described = rows.sensors_described(about, str(path / ABOUT)) if about else {}
    own = {_place(key): described[name] for name, key in _keys(described).items()}
    first = _arrays(files[0])
    candidates = {place: array for place, array in first.items() if place not in ((TIME,), (TASK,), (START,))}
    sensors, notes = arrays.columns(candidates, partial(arrays.sensor_at, _NAMES), "the key", own)
    if not any(rows.role_of(sensor.name) == rows.OBSERVATION for sensor in sensors.values()):
        keys = ", ".join(map(arrays.spelled, first)) or "nothing"
        raise DatasetError(f"{files[0]} has no observations; it holds {keys}, not observations or obs.NAME.")

    def takes(rate: float) -> Iterator[Take]:
        return (_take(file, sensors, rate) for file in files)

    return arrays.source("the folder", path.stem, sensors, takes, fps=fps, about=about, notes=notes)


def _place(key: str) -> Place:
    """The place of a key: "obs.front" -> ("obs", "front"); an unknown key is a place of its own."""
    for mark in ("/", "."):
        head, _, rest = key.partition(mark)
        if head in _NAMES and rest:
            return head, *rest.replace("/", ".").split(".")
    return (key,)


def _arrays(path: Path) -> dict[Place, Array]:
    """The arrays of a file, without their values."""
    stored: dict[Place, Array] = {}
    try:
        with zipfile.ZipFile(path) as file:
            for info in file.infolist():
                if not info.filename.endswith(".npy"):
                    continue
                with file.open(info) as member:
                    first = np.lib.format.read_magic(member) == (1, 0)
                    read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
                    shape, _, dtype = read_header(member)
                key = info.filename.removesuffix(".npy")
                size = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
                if dtype.hasobject or size > min(rows.MAX_BYTES, info.file_size):
                    raise DatasetError(f"'{key}' in {path} is {dtype} {list(shape)}: pickled, too large or cut off.")
                stored[_place(key)] = Array(tuple(shape), dtype, _reader(path, key))
    except FileNotFoundError as error:
        raise DatasetError(f"{path} does not exist; name a folder of .npz files.") from error
    except (OSError, EOFError, ValueError, SyntaxError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DatasetError(f"{path} is truncated or no .npz file ({error}); restore or remove it.") from error
    return stored


def _reader(path: Path, key: str) -> Callable[[int, int], np.ndarray]:
    """Reads rows of an array; the first call loads it whole, for a .npz cannot be read in part."""
    kept: list[np.ndarray] = []

    def read(start: int, stop: int) -> np.ndarray:
        if not kept:
            kept.append(_load(path, key))
        return kept[0][start:stop]

    return read


def _load(path: Path, key: str) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as file:
            return file[key]
    except Exception as error:  # zlib.error, and other errors of the decompressor
        raise DatasetError(f"'{key}' in {path} cannot be read ({error}); restore it from a copy.") from error


def _take(path: Path, sensors: Mapping[Place, Sensor], fps: float) -> Take:
    stored = _arrays(path)
    rowwise = [place for place, it in sensors.items() if place in stored and rows.role_of(it.name) != rows.INFO]
    count = max((stored[place].shape for place in rowwise), default=(0,))[0]
    time_s = np.arange(count) / fps
    if (TIME,) in stored:
        time_s = _load(path, TIME)
        if time_s.shape != (count,) or time_s.dtype.kind != "f":
            raise DatasetError(
                f"'{TIME}' in {path} has {list(time_s.shape)} times for {count} rows; it must have as many."
            )
    single = {key: _load(path, key) for key in (TASK, START) if (key,) in stored and stored[key,].shape == ()}
    start_ns = int(single[START]) if START in single else None
    readings = arrays.readings(stored, sensors, time_s.astype(np.float64), str(path))
    take = Take(readings, str(single.get(TASK, "")), start_ns, {"file": path.name})
    rows.rows_of(take, str(path))
    return take


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source as a folder of episode_0.npz, episode_1.npz, …; returns a note on everything that was left out.

    Keys are those of `read`: a single sensor of a role has no name ("observations"), several have one
    ("observations/images.front"). Values and times are exact; a take's sensors must share one clock.
    `progress(takes, 0)` is called after each take. DatasetError where a take does not fit, or `path` exists.
    """
    notes: dict[str, None] = {}
    keys = _keys(source.sensors)
    notes |= {
        f"'{name}' has no place in rollouts and was left out.": None for name in source.sensors if name not in keys
    }
    with creating(path) as staged:
        staged.mkdir()
        for number, take in rows.numbered(source, progress):
            _write_take(staged / f"episode_{number}.npz", source, take, keys, f"take {number}")
        written = {name: sensor for name, sensor in source.sensors.items() if name in keys}
        about = rows.describe(replace(source, sensors=written))
        (staged / ABOUT).write_text(json.dumps(about, indent=1), encoding="utf-8")
    return list(notes)


def _keys(sensors: Mapping[str, Sensor]) -> dict[str, str]:
    """Sensor -> its key, for every sensor that rollouts can store."""
    roles = {name: rows.role_of(name) for name, sensor in sensors.items() if sensor.kind != "points"}
    several = Counter(roles.values())
    keys: dict[str, str] = {}
    for name, role in roles.items():
        if role:
            key, rest = _SPELLINGS[role][0], name.removeprefix(role).removeprefix(".")
            keys[name] = f"{key}/{rest}" if rest and several[role] > 1 else key
    return keys


def _write_take(path: Path, source: Source, take: Take, keys: Mapping[str, str], where: str) -> None:
    if missing := [name for name in keys if name not in take.readings]:
        raise DatasetError(f"{where} lacks '{missing[0]}', which other takes have; leave out the one or the other.")
    kept = {name: take.readings[name] for name in keys}
    counts = rows.rows_of(replace(take, readings=kept), where)
    arrays = {keys[name]: rows.stored_values(readings, source.sensors[name], where) for name, readings in kept.items()}
    arrays[TIME] = counts.time_s
    if take.task:
        arrays[TASK] = np.array(take.task)
    if take.start_ns is not None:
        arrays[START] = np.array(take.start_ns)
    with zipfile.ZipFile(path, "w") as file:
        for key, array in arrays.items():
            with file.open(zipfile.ZipInfo(f"{key}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
