"""Folders of .npz files, of one rollout or many each: read and written."""

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
from . import arrays, flat, rows, stacked
from .arrays import Array, Place

ABOUT = "terrella.json"  # our description, in the folder of the episodes: names, units and frames
TIME, TASK, START = "time_s", "task", "start_ns"


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of .npz files in the natural order of their names, or one such file; each holds one episode or many.

    Keys: observations (obs), actions, rewards, terminations (terminated, dones, …), truncations (timeouts, …), infos; entries
    of a Dict are "observations/NAME" or "obs.NAME". Flat arrays are cut into episodes, see flat.py, and other arrays with a row
    for each step become "info.NAME" (pictures: observations). There are as many observations as actions, or one more. The
    sensors are those of all files. A text that stays the same is the task. Files of `write` keep their names, units, times
    and tasks. Pickled arrays are left out.

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
    if len(files) > 1:
        _refuse_single_steps(files[0])
    every = [stacked.split(_columns(file), str(file), bool(about)) for file in files]
    stored = arrays.union(episodes.stored for episodes in every)
    bare = flat.is_bare(stored)
    sensors, notes = arrays.columns(stored, partial(flat.guess, bare), "the key", own)
    if not any(rows.role_of(sensor.name) == rows.OBSERVATION for sensor in sensors.values()):
        keys = ", ".join(map(arrays.spelled, every[0].stored)) or "nothing"
        raise DatasetError(
            f"{files[0]} has no observations; it holds {keys}, none of them numbers called obs or obs.NAME. {' '.join(notes)}"
        )
    notes += [*([flat.BARE] * bare), *(every[0].notes if len(files) == 1 else ())]

    def takes(rate: float) -> Iterator[Take]:
        for file in files:
            yield from _takes(file, sensors, rate, bool(about))

    return arrays.source("the folder", path.stem, sensors, takes, fps=fps, about=about, notes=notes)


def _refuse_single_steps(path: Path) -> None:
    """DatasetError where a file, one of many, holds one step of an episode, as CALVIN's do."""
    for place, array in _arrays(path).items():
        if len(array.shape) == 3 and rows.picture_layout(array.shape, array.dtype) == "hwc":
            raise DatasetError(
                f"{path} holds a single step ('{arrays.spelled(place)}' is one picture); stack the steps of each episode into "
                "arrays with a row for each step, save them as one .npz, and name the folder of these."
            )


def _columns(path: Path) -> dict[Place, Array]:
    """The arrays of a file but for the times, task and start that `write` stores."""
    return {place: array for place, array in _arrays(path).items() if not _is_own(place, array)}


def _is_own(place: Place, array: Array) -> bool:
    """Whether it is one of the arrays that `write` stores beside the readings: the times, the task, the start."""
    return place == (TIME,) or (place in ((TASK,), (START,)) and array.shape == ())


def _place(key: str) -> Place:
    """The place of a key: "obs.front" -> ("obs", "front"); an unknown key is a place of its own."""
    for mark in ("/", "."):
        head, _, rest = key.partition(mark)
        if (head in flat.NAMES or head in flat.NEXT) and rest:
            return head, *rest.replace("/", ".").split(".")
    return flat.home(tuple(key.split("/")))


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
                if size > min(rows.MAX_BYTES, info.file_size) and not dtype.hasobject:
                    raise DatasetError(f"'{key}' in {path} is {dtype} {list(shape)}: too large or cut off.")
                stored |= arrays.fields(_place(key), Array(tuple(shape), dtype, _reader(path, key)))
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
        return kept[0][start:stop] if kept[0].ndim else kept[0]

    return read


def _load(path: Path, key: str) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as file:
            return file[key]
    except Exception as error:  # zlib.error, and other errors of the decompressor
        raise DatasetError(f"'{key}' in {path} cannot be read ({error}); restore it from a copy.") from error


def _takes(path: Path, sensors: Mapping[Place, Sensor], fps: float, whole: bool) -> Iterator[Take]:
    """The episodes of a file."""
    stored = _arrays(path)
    episodes = stacked.split({place: it for place, it in stored.items() if not _is_own(place, it)}, str(path), whole)
    single = {key: _load(path, key) for key in (TASK, START) if (key,) in stored and stored[key,].shape == ()}
    start_ns = int(single[START]) if START in single else None
    for number, (start, stop) in enumerate(episodes.spans):
        several = len(episodes.spans) > 1
        where = f"{path}, rows {start} to {stop - 1}" if several else str(path)
        times = partial(_times, path, stored, start, several, fps)
        take = episodes.take(number, sensors, times, where, str(single.get(TASK, "")))
        rows.rows_of(take, where)
        span = {"rows": [start, stop]} if several else {}
        yield replace(take, start_ns=start_ns, facts={"file": path.name, **span, **take.facts})


def _times(path: Path, stored: Mapping[Place, Array], start: int, several: bool, fps: float, count: int) -> np.ndarray:
    """The times of the rows of an episode: as stored, else `fps` a second."""
    if (TIME,) not in stored:
        return np.arange(count) / fps
    time_s = _load(path, TIME)
    own = time_s[start : start + count] if several else time_s
    if own.shape != (count,) or own.dtype.kind != "f":
        raise DatasetError(f"'{TIME}' in {path} has {list(time_s.shape)} times for {count} rows; it must have as many.")
    return (own - own[0] if several else own).astype(np.float64)


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
            key, rest = flat.SPELLINGS[role][0], name.removeprefix(role).removeprefix(".")
            keys[name] = f"{key}/{rest}" if rest and several[role] > 1 else key
    return keys


def _write_take(path: Path, source: Source, take: Take, keys: Mapping[str, str], where: str) -> None:
    kept = {name: take.readings[name] for name in keys if name in take.readings}
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
