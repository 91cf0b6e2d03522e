"""robomimic's HDF5 layout: data/demo_i/{actions, obs/*, next_obs/*, states, rewards, dones}, read and written."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from ...data.storage import durable
from . import hdf5, rows

STATES = "info.states"
_FIXED = {
    rows.ACTION: "actions",
    rows.REWARD: "rewards",
    rows.DONE: "dones",
    rows.TRUNCATED: "truncated",
    STATES: "states",
}
_NAMES = {place: name for name, place in _FIXED.items()}
_FLAGS = ("dones", "truncated")


def read(path: Path, fps: float | None) -> Source:
    """A robomimic file.

    A demo with next_obs gives one observation more than actions. The simulator's states are "info.states". Filter keys
    (facts["robomimic"]["mask"]), env_args and the attributes of data and of each demo are kept as facts; an instruction
    (ep_meta's lang, LIBERO's problem_info) is the take's task.
    """
    with hdf5.opened(path) as file:
        data = hdf5.group(file, "data")
        demos = sorted((name for name in hdf5.members(data) if re.fullmatch(r"demo_\d+", name)), key=rows.natural)
        ours = hdf5.json_attribute(data, hdf5.OURS)
        env_args = hdf5.json_attribute(data, "env_args")
        env_args = env_args if isinstance(env_args, dict) else {}
        mask = _mask(file)
        columns, notes = _demo_columns(hdf5.group(data, demos[0]), ours, str(path))
        facts = {
            "env_args": env_args,
            "mask": mask,
            "attributes": hdf5.attributes(data, ("total", "env_args", hdf5.OURS)),
        }
        problem = hdf5.json_attribute(data, "problem_info")  # LIBERO's instruction
    task = problem.get("language_instruction") if isinstance(problem, dict) else ""
    task = task if isinstance(task, str) else ""
    ours = ours if isinstance(ours, dict) else {}
    kwargs = env_args.get("env_kwargs")
    known = ours.get("fps") or (kwargs.get("control_freq") if isinstance(kwargs, dict) else None)
    rate, more = rows.rate_of(fps, known, "robomimic")
    kept = ours.get("facts")
    robot = ours.get("robot") or _robots(kwargs)
    return Source(
        name=str(ours.get("name") or path.stem),
        sensors={sensor.name: sensor for sensor in columns.values()},
        takes=lambda: (_demo(path, name, columns, rate, task) for name in demos),
        fps=rate,
        robot=robot if isinstance(robot, str) else "",
        notes=(*notes, *more),
        facts={**(kept if isinstance(kept, dict) else {}), "robomimic": facts},
    )


def _robots(kwargs: object) -> object:
    robots = kwargs.get("robots") if isinstance(kwargs, dict) else ""
    return ", ".join(map(str, robots)) if isinstance(robots, list) else robots


def _mask(file: hdf5.File) -> dict[str, list[str]]:
    """Filter keys: name -> demos."""
    found: dict[str, list[str]] = {}
    if "mask" in file:
        group = hdf5.group(file, "mask")
        for name in hdf5.members(group):
            part = hdf5.child(group, name)
            if isinstance(part, hdf5.Dataset) and part.ndim == 1 and len(part) <= 1 << 24:
                found[name] = [
                    value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value) for value in part[()]
                ]
    return found


def _demo_columns(demo: hdf5.Group, ours: object, where: str) -> tuple[dict[tuple[str, ...], Sensor], list[str]]:
    """Where each sensor lies in a demo: ("obs", "agentview_image") -> its Sensor; and what is left out."""
    found: dict[tuple[str, ...], Sensor] = {}
    notes: list[str] = []
    mine = {}
    if isinstance(ours, dict):
        mine = {_place(sensor): sensor for sensor in rows.sensors_described(ours, where).values()}
    for name in hdf5.members(demo):
        if name == "obs":
            obs = hdf5.group(demo, "obs")
            for key in hdf5.members(obs):
                _add_column(found, notes, obs, ("obs", key), mine)
        elif name in _NAMES:
            _add_column(found, notes, demo, (name,), mine)
        elif name != "next_obs":
            notes.append(f"robomimic's '{name}' is left out: it is none of the arrays that robomimic documents.")
    if ("actions",) not in found:
        raise DatasetError(f"{where}/data has demos without actions; restore the file from a copy.")
    return found, notes


def _add_column(found: dict, notes: list[str], group: hdf5.Group, place: tuple[str, ...], mine: Mapping) -> None:
    item = hdf5.child(group, place[-1])
    if not isinstance(item, hdf5.Dataset) or item.dtype.kind not in "biuf" or item.ndim < 1:
        notes.append(f"robomimic's '{'/'.join(place)}' is left out: it is not an array of numbers.")
        return
    if not item.size and place[0] != "obs":
        return  # robomimic leaves `states` empty where there is no simulator
    guessed = _demo_sensor(place, item.shape[1:], item.dtype)
    sensor = mine.get(place)
    if sensor is None or sensor.shape != guessed.shape or sensor.kind != guessed.kind:
        sensor = guessed
    elif rows.stored_shape(sensor) != item.shape[1:]:
        sensor = replace(sensor, facts={**sensor.facts, "stored_shape": list(item.shape[1:])})
    taken_names = {other.name: other for other in found.values()}
    found[place] = replace(sensor, name=rows.unique(sensor.name, taken_names))


def _demo_sensor(place: tuple[str, ...], shape: tuple[int, ...], dtype: np.dtype) -> Sensor:
    key = place[-1]
    if place[0] != "obs":
        kind = np.dtype(bool) if key in _FLAGS else dtype
        return replace(rows.sensor_for("", key, shape, kind), name=_NAMES[key])
    if key.endswith("_depth") and dtype == np.float32 and len(shape) in (2, 3) and shape[2:] in ((), (1,)):
        rows.check_size(shape[0], shape[1], f"'{key}'")
        facts = {"stored_shape": list(shape)} if len(shape) == 3 else {}
        return Sensor(
            f"{rows.DEPTH}.{rows.clean(key.removesuffix('_depth'))}", "depth", shape[:2], "float32", facts=facts
        )
    least = 1 if key.endswith("_image") else rows.LEAST_PICTURE_SIDE
    sensor = rows.sensor_for(rows.OBSERVATION, rows.clean(key), shape, dtype, least=least)
    return replace(sensor, name=sensor.name.removesuffix("_image")) if sensor.kind == "image" else sensor


def _demo(path: Path, name: str, columns: Mapping[tuple[str, ...], Sensor], fps: float, task: str) -> Take:
    with hdf5.opened(path) as file:
        demo = hdf5.group(hdf5.group(file, "data"), name)
        steps = len(hdf5.numbers(demo, "actions"))
        claimed = hdf5.attributes(demo).get("num_samples", steps)
        if claimed != steps or not steps:
            raise DatasetError(
                f"{path}/data/{name} has {steps} actions where num_samples says {claimed}; restore or drop it."
            )
        after = hdf5.group(demo, "next_obs") if "next_obs" in demo else None
        if after is not None and any(place[0] == "obs" and place[-1] not in after for place in columns):
            after = None  # every sensor must have been seen after the last action, or none
        readings = {}
        for place, sensor in columns.items():
            group = hdf5.group(demo, "obs") if place[0] == "obs" else demo
            if place[-1] not in group:
                continue
            hdf5.check_shape(hdf5.numbers(group, place[-1], steps), sensor, f"{path}/data/{name}/{'/'.join(place)}")
            last = after if place[0] == "obs" else None
            readings[sensor.name] = _readings(path, name, place, sensor, group, last, steps, fps)
        more = hdf5.attributes(demo, ("num_samples",))
    meta = _as_dict(more.get("ep_meta"))  # robocasa's, and ours
    lang = meta.get("lang")
    return Take(
        readings, task=lang if isinstance(lang, str) else task, facts={"robomimic": {"demo": name, "attributes": more}}
    )


def _readings(path, demo, place, sensor, group, after, steps: int, fps: float) -> Readings:
    time_s = np.arange(steps + (after is not None)) / fps
    if sensor.kind == "vector":
        values = hdf5.taken(hdf5.numbers(group, place[-1], steps), sensor)
        if after is not None:
            last = hdf5.numbers(after, place[-1], steps)
            hdf5.check_shape(last, sensor, f"{path}/data/{demo}/next_obs/{place[-1]}")
            values = np.concatenate([values, hdf5.taken(last, sensor, steps - 1)])
        return Readings(time_s, values)
    here = hdf5.pictures(path, ("data", demo, *place), sensor, 0, steps)
    if after is None:
        return Readings(time_s, here)
    there = hdf5.pictures(path, ("data", demo, "next_obs", place[-1]), sensor, steps - 1, 1)
    return Readings(time_s, hdf5.followed_by(here, there))


def _as_dict(text: object) -> dict:
    try:
        found = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source as one robomimic file; returns sentences on what had no place in it.

    Every take must have "action" (one vector) and one rate throughout; where it has one observation more than actions it
    gets next_obs. What robomimic does not ask for (names, units, frames, fps) is kept in an attribute of `data`. Values
    are exact. `progress(takes, 0)` is called after each take. DatasetError where the takes do not fit, or `path` exists.
    """
    notes: dict[str, None] = {}
    known = _facts(source)
    with durable.in_whole(path) as staged, hdf5.File(staged, "w") as file:
        data, total = file.create_group("data"), 0
        for number, take in rows.numbered(source, progress):
            demo = data.create_group(_demo_name(take, data))
            total += _write_demo(demo, source, take, f"take {number}", notes)
        _write_attributes(data, known.get("attributes"))
        gym = {"env_name": source.name, "env_type": 2, "env_kwargs": {}}  # 2 is robomimic's number for Gym environments
        written = {name: sensor for name, sensor in source.sensors.items() if _place(sensor) is not None}
        kept = {key: value for key, value in source.facts.items() if key != "robomimic"}
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps(known.get("env_args") or gym)
        data.attrs[hdf5.OURS] = json.dumps(rows.describe(replace(source, sensors=written, facts=kept)))
        mask = known.get("mask")
        for key, demos in mask.items() if isinstance(mask, Mapping) else ():
            there = [demo.encode() for demo in demos if demo in data]
            file.create_dataset(f"mask/{rows.clean(key)}", data=np.array(there, dtype="S"))
    return list(notes)


def _facts(item: Source | Take) -> Mapping:
    found = item.facts.get("robomimic")
    return found if isinstance(found, Mapping) else {}


def _demo_name(take: Take, data: hdf5.Group) -> str:
    name = _facts(take).get("demo")
    if isinstance(name, str) and re.fullmatch(r"demo_\d+", name) and name not in data:
        return name
    number = len(data)
    while f"demo_{number}" in data:
        number += 1
    return f"demo_{number}"


def _place(sensor: Sensor) -> tuple[str, ...] | None:
    """Where a sensor lies in a demo, None where robomimic has no place for it."""
    if sensor.name in _FIXED:
        return (_FIXED[sensor.name],)
    if rows.role_of(sensor.name) != rows.OBSERVATION or sensor.kind == "points":
        return None
    name = sensor.name.removeprefix("observation.")
    if sensor.kind == "image":
        return ("obs", f"{name.removeprefix('images.')}_image")
    if sensor.kind == "depth":
        return ("obs", f"{name.removeprefix('depth').removeprefix('.') or rows.CAMERA}_depth")
    return ("obs", name)


def _write_demo(demo: hdf5.Group, source: Source, take: Take, where: str, notes: dict[str, None]) -> int:
    if rows.ACTION not in take.readings:
        raise DatasetError(f"{where} has no 'action', which robomimic needs; write it in another format.")
    placed: dict[tuple[str, ...], str] = {}
    for name in take.readings:
        place = _place(source.sensors[name])
        if place is None:
            notes[f"'{name}' has no place in robomimic's layout and was left out."] = None
        elif place in placed:
            both = f"'{name}' and '{placed[place]}'"
            raise DatasetError(f"{both} would both be robomimic's {'/'.join(place)}; rename one of them.")
        else:
            placed[place] = name
    found = rows.rows_of(replace(take, readings={name: take.readings[name] for name in placed.values()}), where)
    if not found.steps:
        raise DatasetError(f"{where} has no actions; leave it out.")
    if not rows.even(found.time_s, source.fps):
        notes["robomimic keeps no times: the true times of the rows were left out."] = None
    for place, name in placed.items():
        if len(take.readings[name].values) < found.steps:
            raise DatasetError(f"'{name}' in {where} has fewer readings than there are actions; resample it first.")
        _write_column(demo, place, source.sensors[name], take.readings[name], found, where)
    attributes = _facts(take).get("attributes")
    _write_attributes(demo, attributes)
    if take.task:
        meta = _as_dict(attributes.get("ep_meta")) if isinstance(attributes, Mapping) else {}
        demo.attrs["ep_meta"] = json.dumps({**meta, "lang": take.task})
    demo.attrs["num_samples"] = found.steps
    return found.steps


def _write_attributes(group: hdf5.Group, given: object) -> None:
    for key, value in given.items() if isinstance(given, Mapping) else ():
        if isinstance(value, str | int | float | list):
            group.attrs[key] = value


def _write_column(demo: hdf5.Group, place, sensor: Sensor, readings: Readings, found: rows.Rows, where: str) -> None:
    flags = place[0] in _FLAGS
    shape = () if (flags or place[0] == "rewards") and sensor.shape == (1,) else rows.stored_shape(sensor)
    dtype = np.dtype("int64") if flags else np.dtype(sensor.dtype)
    more = {} if sensor.kind == "vector" else {"chunks": (1, *shape), "compression": "gzip", "compression_opts": 1}
    here = demo.create_dataset("/".join(place), (found.steps, *shape), dtype, **more)
    after = None
    if place[0] == "obs" and found.observations > found.steps:
        after = demo.create_dataset(f"next_obs/{place[1]}", (found.steps, *shape), dtype, **more)
    row = 0
    for part in rows.batches(readings.values, sensor, where):
        part = rows.to_stored(part, sensor).reshape(len(part), *shape).astype(dtype)
        stop = min(row + len(part), found.steps)
        if stop > row:
            here[row:stop] = part[: stop - row]
        if after is not None and row + len(part) > 1:
            late = part[1:] if row == 0 else part
            after[row + len(part) - 1 - len(late) : row + len(part) - 1] = late
        row += len(part)
