"""robomimic's HDF5 layout: data/demo_i/{actions, obs/*, next_obs/*, states, rewards, dones}, read and written."""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...core.files import creating
from ...data.source import Sensor, Source, Take
from . import arrays, hdf5_file, rows
from .spaces import split_texts

_NAMES = {
    "obs": rows.OBSERVATION,
    "actions": rows.ACTION,
    "rewards": rows.REWARD,
    "dones": rows.DONE,
    "truncated": rows.TRUNCATED,
    "states": "info.states",
}
_PLACES = {name: (key,) for key, name in _NAMES.items() if key != "obs"}
_ACTIONS = ("actions",)
_FLAGS = ("dones", "truncated")
_TOP = ("data", "mask")


def read(path: Path, fps: float | None) -> Source:
    """A robomimic file as a Source. A demo with next_obs has one more observation than actions.

    The simulator's states become "info.states"; filter keys (facts["robomimic"]["mask"]), env_args and attributes are kept as
    facts; an instruction (ep_meta's lang, LIBERO's problem_info) becomes the take's task.
    """
    with hdf5_file.open_file(path) as file:
        data = hdf5_file.subgroup(file, "data")
        demos = sorted((name for name in hdf5_file.names_in(data) if re.fullmatch(r"demo_\d+", name)), key=rows.natural)
        own = hdf5_file.json_attribute(data, hdf5_file.OURS)
        env_args = hdf5_file.json_attribute(data, "env_args")
        attributes = hdf5_file.attributes(data, ("total", "env_args", hdf5_file.OURS))
        facts = {"env_args": env_args, "mask": _mask(file), "attributes": attributes}
        every = [_headers(hdf5_file.subgroup(data, name)) for name in demos]
        notes = [f"'data/{name}' is left out: it is no demo." for name in hdf5_file.names_in(data) if name not in demos]
        notes += [f"'{name}' is left out: it is not known." for name in hdf5_file.names_in(file) if name not in _TOP]
        task = hdf5_file.json_attribute(data, "problem_info").get("language_instruction")  # LIBERO's instruction
    stored = arrays.union(every)
    if ("actions",) not in stored:
        raise DatasetError(f"{path}/data has demos without actions; restore the file from a copy.")
    described = rows.sensors_described(own, str(path)).values() if own else ()
    sensors, more = arrays.columns(stored, _guess, "robomimic's", {_place(it) or (): it for it in described})
    kwargs = env_args.get("env_kwargs")
    kwargs = kwargs if isinstance(kwargs, dict) else {}
    robots = kwargs.get("robots", "")
    robot = ", ".join(map(str, robots)) if isinstance(robots, list) else str(robots)

    def takes(rate: float) -> Iterator[Take]:
        return (_demo(path, name, sensors, rate, task if isinstance(task, str) else "") for name in demos)

    return arrays.source(
        "robomimic",
        path.stem,
        sensors,
        takes,
        fps=fps,
        about={**own, "fps": own.get("fps") or kwargs.get("control_freq"), "robot": own.get("robot") or robot},
        notes=[*notes, *more],
        facts={"robomimic": facts},
    )


def _headers(demo: hdf5_file.Group) -> dict[arrays.Place, arrays.Array]:
    """The arrays of a demo but for texts. robomimic leaves `states` empty where there is no simulator."""
    stored = {
        place: it
        for place, it in hdf5_file.headers(hdf5_file.all_datasets(demo)).items()
        if place[0] != "next_obs" and not (place[0] != "obs" and 0 in it.shape) and not it.is_text
    }
    steps = stored[_ACTIONS].shape[:1] if _ACTIONS in stored else ()
    rowless = (place for place, it in stored.items() if str(place[0]) not in _NAMES and it.shape[:1] != steps)
    return stored | {place: replace(stored[place], shape=()) for place in rowless}  # named as left out


def _mask(file: hdf5_file.File) -> dict[str, list[str]]:
    """Filter keys: name -> demos."""
    if "mask" not in file:
        return {}
    parts = dict(hdf5_file.all_datasets(hdf5_file.subgroup(file, "mask")))
    return {arrays.spelled(place): hdf5_file.read_strings(it) for place, it in parts.items() if it.dtype.kind in "OS"}


def _guess(place: arrays.Place, shape: tuple[int, ...], dtype: np.dtype) -> Sensor | None:
    key = str(place[-1])
    if place[0] != "obs" or len(place) < 2:
        if place and place[0] not in _NAMES:
            return rows.sensor_for(rows.INFO, arrays.joined(place), shape, dtype)
        return arrays.sensor_at(_NAMES, place, shape, dtype) if len(place) == 1 else None
    if depth := rows.depth_sensor(key, shape, dtype):
        return depth
    least = 1 if key.endswith("_image") else rows.LEAST_PICTURE_SIDE
    sensor = rows.sensor_for(rows.OBSERVATION, rows.clean(arrays.spelled(place[1:])), shape, dtype, least)
    return replace(sensor, name=sensor.name.removesuffix("_image")) if sensor.kind == "image" else sensor


def _demo(path: Path, name: str, sensors: Mapping[arrays.Place, Sensor], fps: float, task: str) -> Take:
    where = f"{path}/data/{name}"
    with hdf5_file.open_file(path) as file:
        demo = hdf5_file.subgroup(file, "data", name)
        stored: dict[arrays.Place, hdf5_file.Dataset] = dict(hdf5_file.all_datasets(demo))
        lead = next((place for place in (("actions",), *sensors) if place in stored), ("actions",))
        steps = len(hdf5_file.numeric(hdf5_file.subgroup(demo, *lead[:-1]), lead[-1]))
        facts = hdf5_file.attributes(demo)
        claimed = facts.pop("num_samples", steps)
        if claimed != steps or not steps:
            raise DatasetError(f"{where} has {steps} actions where num_samples says {claimed}; restore or drop it.")
        observed = [place for place in sensors if place[0] == "obs" and place in stored]
        # a last observation after the last action needs every sensor
        after = all(("next_obs", *place[1:]) in stored for place in observed) and bool(observed)
        unused = not after and any(place[0] == "next_obs" for place in stored)
        lines = {
            place: hdf5_file.array_at(file, ("data", name, *place), item)
            for place, item in stored.items()
            if item.shape is not None and item.ndim < 2 and item.dtype.kind in "SO" and place not in sensors
        }
        texts = {place: arrays.texts(array) for place, array in lines.items() if array.is_text}
        parts = {}
        for place in sensors:
            if place in stored and not (place[0] != "obs" and 0 in stored[place].shape):
                pieces = [(("data", name, *place), 0, steps)]
                if after and place in observed:
                    pieces.append((("data", name, "next_obs", *place[1:]), steps - 1, steps))
                parts[place] = hdf5_file.concatenated(file, steps, *pieces)
        own = {place: sensor for place, sensor in sensors.items() if place in parts}
        readings = arrays.readings(parts, own, np.arange(steps + after) / fps, where)
    lang = hdf5_file.json_object(facts.get("ep_meta")).get("lang")  # as robocasa and `write` store it
    task, kept = split_texts(texts, lang if isinstance(lang, str) else task)
    more = {"robomimic": {"demo": name, "attributes": facts}, **({"texts": kept} if kept else {})}
    notes = ("next_obs was left out where it lacks an observation.",) if unused else ()
    return Take(readings, task, facts=more, notes=notes)


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source as one robomimic file, values exact; returns a note on everything that was left out.

    Every take needs "action" (one vector) and one rate for all sensors. A take with one more observation than actions gets
    next_obs. Names, units, frames and fps, which robomimic has no keys for, are kept in an attribute of `data`.
    `progress(takes, 0)` is called after each take. DatasetError where a take does not fit, or `path` exists.
    """
    notes: dict[str, None] = {}
    known = _facts(source)
    with creating(path) as staged, hdf5_file.File(staged, "w") as file:
        data, total = file.create_group("data"), 0
        for number, take in rows.numbered(source, progress):
            demo = data.create_group(_demo_name(take, data))
            total += _write_demo(demo, source, take, f"take {number}", notes)
        hdf5_file.set_attributes(data, known.get("attributes"))
        gym = {"env_name": source.name, "env_type": 2, "env_kwargs": {}}  # 2 is robomimic's number for Gym environments
        written = {name: sensor for name, sensor in source.sensors.items() if _place(sensor) is not None}
        kept = {key: value for key, value in source.facts.items() if key != "robomimic"}
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps(known.get("env_args") or gym)
        data.attrs[hdf5_file.OURS] = json.dumps(rows.describe(replace(source, sensors=written, facts=kept)))
        mask = known.get("mask")
        for key, demos in mask.items() if isinstance(mask, Mapping) else ():
            members = [demo.encode() for demo in demos if demo in data]
            file.create_dataset(f"mask/{rows.clean(key)}", data=np.array(members, dtype="S"))
    return list(notes)


def _facts(item: Source | Take) -> Mapping:
    facts = item.facts.get("robomimic")
    return facts if isinstance(facts, Mapping) else {}


def _demo_name(take: Take, data: hdf5_file.Group) -> str:
    name = _facts(take).get("demo")
    if isinstance(name, str) and re.fullmatch(r"demo_\d+", name) and name not in data:
        return name
    number = len(data)
    while f"demo_{number}" in data:
        number += 1
    return f"demo_{number}"


def _place(sensor: Sensor) -> tuple[str, ...] | None:
    """The keys of a sensor in a demo; None where robomimic has no place for it."""
    if sensor.name in _PLACES:
        return _PLACES[sensor.name]
    if rows.role_of(sensor.name) != rows.OBSERVATION or sensor.kind == "points":
        return None
    name = sensor.name.removeprefix("observation.")
    if sensor.kind == "image":
        return ("obs", f"{name.removeprefix('images.')}_image")
    if sensor.kind == "depth":
        return ("obs", f"{name.removeprefix('depth').removeprefix('.') or rows.CAMERA}_depth")
    return ("obs", name)


def _write_demo(demo: hdf5_file.Group, source: Source, take: Take, where: str, notes: dict[str, None]) -> int:
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
    counts = rows.rows_of(replace(take, readings={name: take.readings[name] for name in placed.values()}), where)
    if not counts.steps:
        raise DatasetError(f"{where} has no actions; leave it out.")
    if not rows.is_even(counts.time_s, source.fps):
        notes["robomimic keeps no times: the true times of the rows were left out."] = None
    for place, name in placed.items():
        sensor, readings = source.sensors[name], take.readings[name]
        if len(readings.values) < counts.steps:
            raise DatasetError(f"'{name}' in {where} has fewer readings than there are actions; resample it first.")
        targets = {"/".join(place): 0}
        if place[0] == "obs" and counts.observations > counts.steps:
            targets[f"next_obs/{place[1]}"] = 1
        flags = place[0] in _FLAGS
        shape = () if (flags or place[0] == "rewards") and sensor.shape == (1,) else rows.stored_shape(sensor)
        hdf5_file.store_readings(
            demo, targets, (counts.steps, *shape), sensor, readings, where, "int64" if flags else ""
        )
    attributes = _facts(take).get("attributes")
    hdf5_file.set_attributes(demo, attributes)
    if take.task:
        meta = hdf5_file.json_object(attributes.get("ep_meta")) if isinstance(attributes, Mapping) else {}
        demo.attrs["ep_meta"] = json.dumps({**meta, "lang": take.task})
    demo.attrs["num_samples"] = counts.steps
    return counts.steps
