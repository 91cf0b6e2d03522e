"""Folders of .npz episodes, one rollout each: read and written."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from ...data.storage import durable
from . import rows

ABOUT = "terrella.json"  # names, units and frames of what we wrote, in the folder of the episodes
TIME, TASK, START = "time_s", "task", "start_ns"
_SPELLINGS = {  # the first is what `write` writes
    rows.OBSERVATION: ("observations", "observation", "obs"),
    rows.ACTION: ("actions", "action"),
    rows.REWARD: ("rewards", "reward"),
    rows.DONE: ("terminations", "terminated", "terminals", "dones", "done"),
    rows.TRUNCATED: ("truncations", "truncated", "timeouts"),
    rows.INFO: ("infos", "info"),
}
_ROLE = {spelling: role for role, spellings in _SPELLINGS.items() for spelling in spellings}


@dataclass(frozen=True)
class _Array:
    """An array of an episode's file, of which only the header was read."""

    key: str
    shape: tuple[int, ...]
    dtype: np.dtype


# -- folders of .npz


def read(path: str | Path, fps: float | None = None) -> Source:
    """A folder of .npz files, each one episode, in the natural order of their names (or one such file).

    Keys: observations (obs), actions, rewards, terminations (terminated, dones), truncations (truncated), infos; parts of
    a Dict are "observations/NAME" or "obs.NAME". Observations may be as many as actions or one more. What `write` wrote
    comes back with its names, units, times and tasks. Pickled arrays are refused. The sensors are those of the first file.

    fps: rows a second, where the folder does not say; without either rows.FPS_UNKNOWN with a note.
    DatasetError where there are no such files, or one is damaged or of other shapes than the first.
    """
    path = Path(path)
    rows.check_fps(fps, str(path))
    files = sorted(path.glob("*.npz"), key=lambda p: rows.natural(p.name)) if path.is_dir() else [path]
    if not files:
        raise DatasetError(f"{path} has no .npz files; name a folder of episodes, one .npz each.")
    about = rows.read_json((path if path.is_dir() else path.parent) / ABOUT, missing={})
    described = rows.sensors_described(about, str(path / ABOUT)) if about else {}
    sensors, notes = _sensors(_headers(files[0]), described, str(files[0]))
    rate, more = rows.rate_of(fps, about.get("fps"), "the folder")
    facts = about.get("facts")
    return Source(
        name=str(about.get("name") or path.stem),
        sensors={sensor.name: sensor for sensor in sensors.values()},
        takes=lambda: (_take(file, sensors, rate) for file in files),
        fps=rate,
        robot=str(about.get("robot") or ""),
        notes=(*notes, *more),
        facts=facts if isinstance(facts, dict) else {},
    )


def _headers(path: Path) -> dict[str, _Array]:
    """What arrays a file holds; none of their values is read."""
    found = {}
    try:
        with zipfile.ZipFile(path) as file:
            for info in file.infolist():
                if not info.filename.endswith(".npy"):
                    continue
                with file.open(info) as member:
                    version = np.lib.format.read_magic(member)
                    header = (
                        np.lib.format.read_array_header_1_0
                        if version == (1, 0)
                        else np.lib.format.read_array_header_2_0
                    )
                    shape, _, dtype = header(member)
                key = info.filename.removesuffix(".npy")
                size = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
                if dtype.hasobject or size > min(rows.MOST_BYTES, info.file_size):
                    raise DatasetError(
                        f"'{key}' in {path} is {dtype} {list(shape)}: it is pickled, too large or cut off; write it anew."
                    )
                found[key] = _Array(key, tuple(shape), dtype)
    except FileNotFoundError as error:
        raise DatasetError(f"{path} does not exist; name a folder of .npz files.") from error
    except (OSError, EOFError, ValueError, SyntaxError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DatasetError(
            f"{path} is truncated or no .npz file ({error}); restore it from a copy, or remove it."
        ) from error
    return found


def _load(path: Path, key: str) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as file:
            return file[key]
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zipfile.LargeZipFile, MemoryError) as error:
        raise DatasetError(f"'{key}' in {path} cannot be read ({error}); restore it from a copy.") from error
    except Exception as error:  # zlib.error, and what else a damaged stream raises in the decompressor
        raise DatasetError(f"'{key}' in {path} is damaged ({error}); restore it from a copy.") from error


def _split(key: str) -> tuple[str, str]:
    """Role and name of a key: "obs.front" -> ("observation", "front"); ("", key) where it has none."""
    for mark in ("/", "."):
        head, _, rest = key.partition(mark)
        if head in _ROLE and (rest or head == key):
            return _ROLE[head], rest
    return "", key


def _sensors(
    headers: Mapping[str, _Array], described: Mapping[str, Sensor], where: str
) -> tuple[dict[str, Sensor], list[str]]:
    """Key -> its sensor, and sentences on what is left out."""
    found: dict[str, Sensor] = {}
    notes = []
    for key, array in headers.items():
        role, name = _split(key)
        if not role or array.dtype.kind not in "biuf" or not array.shape:
            if key not in (TIME, TASK, START):
                notes.append(f"'{key}' is left out: it is not an array of a rollout.")
            continue
        kind = np.dtype(bool) if role in (rows.DONE, rows.TRUNCATED) else array.dtype
        sensor = rows.sensor_for(
            role, ".".join(map(rows.clean, name.replace("/", ".").split("."))) if name else "", array.shape[1:], kind
        )
        mine = _mine(role, name, described)
        same = mine is not None and mine.dtype == kind.name and rows.stored_shape(mine) == array.shape[1:]
        taken = {other.name: other for other in found.values()}
        found[key] = mine if mine is not None and same else replace(sensor, name=rows.unique(sensor.name, taken))
    if not any(rows.role_of(sensor.name) == rows.OBSERVATION for sensor in found.values()):
        keys = ", ".join(headers) or "nothing"
        raise DatasetError(
            f"{where} has no observations; it holds {keys}, where keys like observations or obs.NAME are known."
        )
    return found, notes


def _mine(role: str, name: str, described: Mapping[str, Sensor]) -> Sensor | None:
    """The sensor that we wrote under a key, if we did: a role's only sensor is written under the role alone."""
    of_role = [sensor for sensor in described.values() if rows.role_of(sensor.name) == role]
    return described.get(f"{role}.{name}") if name else (of_role[0] if len(of_role) == 1 else None)


def _take(path: Path, sensors: Mapping[str, Sensor], fps: float) -> Take:
    headers = _headers(path)
    counts = {}
    for key, sensor in sensors.items():
        if key not in headers:
            raise DatasetError(f"{path} lacks '{key}', which the first episode has; mend it, or move it away.")
        if not headers[key].shape or headers[key].shape[1:] != rows.stored_shape(sensor):
            shape, want = list(headers[key].shape[1:]), list(rows.stored_shape(sensor))
            raise DatasetError(
                f"'{key}' in {path} is {shape} a row where the first episode has {want}; mend it, or move it away."
            )
        counts[key] = headers[key].shape[0]
    count = max(counts[key] for key, sensor in sensors.items() if rows.role_of(sensor.name) != rows.INFO)
    if long := [key for key in counts if counts[key] > count]:
        raise DatasetError(
            f"'{long[0]}' in {path} has {counts[long[0]]} rows where there are {count} observations; mend it."
        )
    times = _times(path, headers, count, fps)
    readings = {}
    for key, sensor in sensors.items():
        values = _pictures(path, key, sensor, counts[key]) if sensor.kind != "vector" else _vector(path, key, sensor)
        readings[sensor.name] = Readings(times[: counts[key]], values)
    task = str(_load(path, TASK)) if TASK in headers and headers[TASK].shape == () else ""
    start_ns = int(_load(path, START)) if START in headers and headers[START].shape == () else None
    take = Take(readings, task, start_ns, {"file": path.name})
    rows.rows_of(take, str(path))
    return take


def _times(path: Path, headers: Mapping[str, _Array], count: int, fps: float) -> np.ndarray:
    if TIME not in headers:
        return np.arange(count) / fps
    times = _load(path, TIME)
    if times.shape != (count,) or times.dtype.kind != "f":
        raise DatasetError(
            f"'{TIME}' in {path} has {list(times.shape)} times for {count} rows; it must have one for each."
        )
    return times.astype(np.float64)


def _vector(path: Path, key: str, sensor: Sensor) -> np.ndarray:
    return rows.from_stored(_load(path, key).astype(sensor.dtype), sensor)


def _pictures(path: Path, key: str, sensor: Sensor, count: int) -> Lazy:
    """The file is read at the first look: a .npz gives an array whole or not at all."""
    kept: list[np.ndarray] = []

    def make(i: int) -> np.ndarray:
        if not kept:
            kept.append(_load(path, key))
        return rows.from_stored(kept[0][i : i + 1], sensor)[0]

    return Lazy(count, make)


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source as a folder of episode_0.npz, episode_1.npz, …; returns sentences on what had no place in it.

    Keys as `read` knows them, one sensor of a role alone without a name ("observations"), several with ("observations/
    images.front"). Values and times are exact; a take's sensors must march in step. `progress(takes, 0)` is called
    after each take. DatasetError where they do not, or `path` exists.
    """
    notes: dict[str, None] = {}
    keys = _keys(source, notes)
    with durable.in_whole(path) as staged:
        staged.mkdir()
        for number, take in rows.numbered(source, progress):
            _write_take(staged / f"episode_{number}.npz", source, take, keys, f"take {number}")
        written = {name: sensor for name, sensor in source.sensors.items() if name in keys}
        about = rows.describe(replace(source, sensors=written))
        (staged / ABOUT).write_text(json.dumps(about, indent=1), encoding="utf-8")
    return list(notes)


def _keys(source: Source, notes: dict[str, None]) -> dict[str, str]:
    """Sensor -> its key."""
    found: dict[str, str] = {}
    roles = {name: rows.role_of(name) for name, sensor in source.sensors.items() if sensor.kind != "points"}
    for name in source.sensors:
        role = roles.get(name)
        if not role:
            notes[f"'{name}' has no place in rollouts and was left out."] = None
            continue
        key, rest = _SPELLINGS[role][0], name.removeprefix(role).removeprefix(".")
        found[name] = f"{key}/{rest}" if rest and list(roles.values()).count(role) > 1 else key
    return found


def _write_take(path: Path, source: Source, take: Take, keys: Mapping[str, str], where: str) -> None:
    if missing := [name for name in keys if name not in take.readings]:
        raise DatasetError(f"{where} lacks '{missing[0]}', which other takes have; leave out the one or the other.")
    kept = {name: take.readings[name] for name in keys}
    found = rows.rows_of(replace(take, readings=kept), where)
    arrays = {keys[name]: rows.whole(readings, source.sensors[name], where) for name, readings in kept.items()}
    arrays[TIME] = found.time_s
    if take.task:
        arrays[TASK] = np.array(take.task)
    if take.start_ns is not None:
        arrays[START] = np.array(take.start_ns)
    with zipfile.ZipFile(path, "w") as file:
        for key, array in arrays.items():
            with file.open(zipfile.ZipInfo(f"{key}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
