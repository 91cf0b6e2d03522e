"""Minari datasets (0.5): read from and written to the files of the `minari` package, which is not needed for it.

The package itself decodes whole episodes at once and makes the environment that a stranger's metadata names; its files are
few and documented, so they are read here one value at a time, and nothing in them is run.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from ...data.storage import durable
from . import rows, spaces
from .minari_stored import Episode, joined, open_storage

VERSION = "0.5.4"  # of the layout that `write` writes (the first with pictures that are not JPEG)
_ID = re.compile(r"(?:[-\w][-\w/]*/)?[-\w]+-v\d+", re.ASCII)
_ROLES = {"observations": rows.OBSERVATION, "actions": rows.ACTION}
_FOLLOW = {"rewards": rows.REWARD, "terminations": rows.DONE, "truncations": rows.TRUNCATED}
_KEPT_ELSEWHERE = ("observation_space", "action_space", "total_episodes", "total_steps", "dataset_size", "terrella")


def read(path: str | Path, fps: float | None = None) -> Source:
    """A Minari dataset folder (or its `data` folder), kept as HDF5, Arrow or Parquet.

    Dict and Tuple spaces become one sensor a leaf: "observation.agent.pos", "action.0"; a space of one array becomes
    "observation.state" or "action"; pictures are "observation.images.NAME". Discrete and other ints stay ints. A leaf
    that is a text named mission (or task, instruction, …) is the take's task; other texts are kept in its facts. Infos
    with a row for each step, as the first episode has them, are "info.NAME". next.done is Minari's termination,
    next.truncated its truncation. The spaces and metadata are kept as facts. A take has one observation more than actions.

    fps: rows a second; Minari keeps none, so without it (and where the dataset is not ours) rows.FPS_UNKNOWN is taken.
    DatasetError where files are missing or damaged, or spaces are of unknown types.
    """
    rows.check_fps(fps, str(path))
    data, meta, count = _opened(Path(path))
    given = {"observations": _space(meta, "observation_space", data), "actions": _space(meta, "action_space", data)}
    described = rows.sensors_described(meta["terrella"], str(data)) if isinstance(meta.get("terrella"), dict) else {}
    leaves: dict[tuple, spaces.Leaf] = {}
    for root, role in _ROLES.items():
        found = spaces.leaves(role, given[root], str(data))
        for leaf in found:
            leaves[(root, *leaf.path)] = _as_described(role, leaf, found, described)
    episode = open_storage(data, meta.get("data_format", "hdf5"), count)
    sensors = {place: leaf.sensor for place, leaf in leaves.items() if leaf.sensor is not None}
    for root, name in _FOLLOW.items():
        kind = "float64" if root == "rewards" else "bool"
        sensor = replace(rows.sensor_for("", root, (), kind), name=name)
        mine = described.get(name)
        one = mine is not None and mine.kind == "vector" and mine.shape == (1,)
        sensors[(root,)] = replace(mine, facts={**mine.facts, **sensor.facts}) if mine is not None and one else sensor
    for place, (shape, dtype) in sorted(episode(0).infos().items()):
        sensor = rows.sensor_for(rows.INFO, joined(place), shape, dtype)
        taken = {other.name: other for other in sensors.values()}
        sensors[("infos", *place)] = _described(replace(sensor, name=rows.unique(sensor.name, taken)), described)
    texts = {place: leaf for place, leaf in leaves.items() if leaf.sensor is None}
    ours = meta["terrella"] if described else {}
    rate, notes = rows.rate_of(fps, ours.get("fps"), "Minari")
    kept = ours.get("facts")
    facts = {
        **(kept if isinstance(kept, dict) else {}),
        "observation_space": spaces.compact(given["observations"]),
        "action_space": spaces.compact(given["actions"]),
        "minari": {key: value for key, value in meta.items() if key not in _KEPT_ELSEWHERE},
    }
    return Source(
        name=str(ours.get("name") or meta.get("dataset_id") or Path(path).name),
        sensors={sensor.name: sensor for sensor in sensors.values()},
        takes=lambda: (_take(episode(i), i, sensors, texts, rate) for i in range(count)),
        fps=rate,
        robot=str(ours.get("robot") or ""),
        notes=notes,
        facts=facts,
    )


def _opened(path: Path) -> tuple[Path, dict, int]:
    """The folder that has the data, its metadata, and how many episodes it claims."""
    data = path / "data" if (path / "data").is_dir() else path
    if not (data / "metadata.json").is_file():
        raise DatasetError(
            f"{path} is no Minari dataset: {data / 'metadata.json'} is missing; name a dataset's folder."
        )
    meta = rows.read_json(data / "metadata.json")
    count = meta.get("total_episodes")
    if not isinstance(count, int) or not 0 < count <= 1 << 32:
        raise DatasetError(f"{data} claims {count} episodes; there is nothing to read.")
    return data, meta, count


def _space(meta: dict, key: str, data: Path) -> dict:
    text = meta.get(key)
    try:
        found = json.loads(text) if isinstance(text, str) else text
    except (ValueError, RecursionError) as error:
        raise DatasetError(
            f"{key} in {data / 'metadata.json'} is damaged ({error}); restore it from a copy."
        ) from error
    if not isinstance(found, dict):
        raise DatasetError(
            f"{data / 'metadata.json'} has no {key}; open the dataset once with minari, which writes it."
        )
    return found


def _as_described(role: str, leaf: spaces.Leaf, found: tuple, described: Mapping[str, Sensor]) -> spaces.Leaf:
    """The leaf with the sensor that we wrote it from, if we did."""
    if leaf.sensor is None:
        return leaf
    mine = [name for name in described if rows.role_of(name) == role]
    names = [
        leaf.sensor.name,
        f"{role}.{leaf.path[0]}" if leaf.path else "",
        *(mine if len(found) == 1 == len(mine) else ()),
    ]
    for name in names:
        sensor = _described(replace(leaf.sensor, name=name), described)
        if name in described and sensor is described[name]:
            return replace(leaf, sensor=sensor)
    return leaf


def _described(sensor: Sensor, described: Mapping[str, Sensor]) -> Sensor:
    mine = described.get(sensor.name)
    same = mine is not None and rows.stored_shape(mine) == rows.stored_shape(sensor) and mine.dtype == sensor.dtype
    return mine if mine is not None and same else sensor


def _take(episode: Episode, number: int, sensors: Mapping[tuple, Sensor], texts: Mapping, fps: float) -> Take:
    steps = episode.steps()
    if not steps:
        raise DatasetError(f"episode {number} has no steps; remove it from the dataset.")
    infos = episode.infos()
    readings, time_s = {}, np.arange(steps + 1) / fps
    for place, sensor in sensors.items():
        if place[0] == "infos":
            if place[1:] not in infos or infos[place[1:]][0] != rows.stored_shape(sensor):
                continue
            values = _info(episode, place, sensor, steps)
        else:
            values = episode.values(place, sensor, steps + (place[0] == "observations"))
        readings[sensor.name] = Readings(time_s[: len(values)], values)
    facts = episode.facts()
    task, kept = facts.pop("task", ""), {}
    for place, leaf in texts.items():
        found = episode.texts(place)
        if len(set(found)) == 1 and leaf.is_instruction and not task:
            task = found[0]
        elif len(set(found)) > 1 or not leaf.is_instruction:
            kept["/".join(map(str, place))] = found
    start_ns = facts.pop("start_ns", None)
    return Take(
        readings,
        task=task if isinstance(task, str) else "",
        start_ns=start_ns if isinstance(start_ns, int) else None,
        facts={"minari": facts, **({"texts": kept} if kept else {})},
    )


def _info(episode: Episode, place: tuple, sensor: Sensor, steps: int):
    try:
        return episode.values(place, sensor, steps + 1)
    except DatasetError:
        return episode.values(place, sensor, steps)


def write(
    source: Source,
    path: str | Path,
    progress: Callable[[int, int], None] | None = None,
    dataset_id: str | None = None,
) -> list[str]:
    """Writes a source as a Minari dataset (HDF5, pictures lossless); returns sentences on what had no place in it.

    With MINARI_DATASETS_PATH set to the folder that holds `path`, `minari.load_dataset(path.name)` opens it. `dataset_id`
    is the last parts of `path` ("doom/maze-v0" for …/doom/maze-v0), by default the last alone; it must end in -v0, -v1, ….
    Spaces are the source's own where its sensors still are the leaves of facts["observation_space"], else a Dict of one
    Box for each sensor. Minari needs an observation after the last action: where a take has none, its last action is
    left out. Missing rewards are 0, missing ends a truncation at the last step; names, units, frames and fps are kept in
    the metadata. `progress(takes, 0)` is called after each take. DatasetError where takes do not fit or `path` exists.
    """
    from . import hdf5

    path = Path(path)
    dataset_id = dataset_id or path.name
    if not _ID.fullmatch(dataset_id) or path.parts[-len(Path(dataset_id).parts) :] != Path(dataset_id).parts:
        raise DatasetError(
            f"'{dataset_id}' is no Minari id for {path}: it must be the end of the path and look like name-v0 or group/name-v0."
        )
    notes: dict[str, None] = {}
    places, given = {}, {}
    for root, role in _ROLES.items():
        given[root], found = _structure(source, role, notes)
        places.update({(root, *leaf_place): name for leaf_place, name in found.items()})
    for name in source.sensors:
        if rows.role_of(name) == "" or source.sensors[name].kind == "points":
            notes[f"'{name}' has no place in Minari's layout and was left out."] = None
    with durable.in_whole(path) as staged:
        data = staged / "data"
        data.mkdir(parents=True)
        steps, number = 0, 0
        with hdf5.File(data / "main_data.hdf5", "w", track_order=True) as file:
            for number, take in rows.numbered(source, progress):
                group = file.create_group(f"episode_{number}")
                steps += _write_take(group, number, source, take, places, notes)
        meta = _metadata(source, given, dataset_id)
        size = round((data / "main_data.hdf5").stat().st_size / 1e6, 1)
        meta |= {"total_episodes": number + 1, "total_steps": steps, "dataset_size": size}
        (data / "metadata.json").write_text(json.dumps(meta), encoding="utf-8")
    return list(notes)


def _structure(source: Source, role: str, notes: dict[str, None]) -> tuple[dict, dict[tuple, str | None]]:
    """The space of a role, and what lies at each of its leaves: the name of a sensor, None for a text."""
    mine = {n: s for n, s in source.sensors.items() if rows.role_of(n) == role and s.kind != "points"}
    if not mine:
        raise DatasetError(
            f"{source.name or 'the source'} has no {role}s, which Minari needs; write it in another format."
        )
    own = source.facts.get(f"{role}_space")
    if isinstance(own, dict):
        try:
            leaves = spaces.leaves(role, own, "the source")
        except DatasetError:
            leaves = ()
        arrays = {leaf.sensor.name: leaf.sensor for leaf in leaves if leaf.sensor is not None}
        if arrays.keys() == mine.keys() and all(_same(arrays[name], mine[name]) for name in mine):
            return own, {leaf.path: leaf.sensor.name if leaf.sensor else None for leaf in leaves}
    if len(mine) == 1:
        (sensor,) = mine.values()
        return spaces.box(sensor), {(): sensor.name}
    keys = {name: name.removeprefix(f"{role}.") for name in mine}
    parts = {keys[name]: spaces.box(sensor) for name, sensor in mine.items()}
    return {"type": "Dict", "subspaces": parts}, {(key,): name for name, key in keys.items()}


def _same(one: Sensor, other: Sensor) -> bool:
    return one.dtype == other.dtype and rows.stored_shape(one) == rows.stored_shape(other)


def _metadata(source: Source, given: dict, dataset_id: str) -> dict:
    own = source.facts.get("minari")
    own = {key: value for key, value in own.items() if key not in _KEPT_ELSEWHERE} if isinstance(own, Mapping) else {}
    gone = ("minari", "observation_space", "action_space")
    kept = {key: value for key, value in source.facts.items() if key not in gone}
    return {
        **own,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": json.dumps(spaces.expanded(given["observations"])),
        "action_space": json.dumps(spaces.expanded(given["actions"])),
        "dataset_id": dataset_id,
        "minari_version": VERSION,
        "terrella": rows.describe(replace(source, facts=kept)),
    }


def _write_take(group, number: int, source: Source, take: Take, places: Mapping, notes: dict[str, None]) -> int:
    from . import hdf5

    where = f"take {number}"
    missing = [name for name in places.values() if name is not None and name not in take.readings]
    if missing:
        raise DatasetError(
            f"{where} lacks '{missing[0]}', which Minari needs in every episode; leave out the one or the other."
        )
    named = {name for name in places.values() if name is not None} | {
        n for n in take.readings if rows.role_of(n) in _FOLLOW.values()
    }
    found = rows.rows_of(replace(take, readings={name: take.readings[name] for name in named}), where)
    steps = min(found.steps, found.observations - 1)
    if steps < 1:
        raise DatasetError(f"{where} has {found.observations} observations; Minari needs 2 or more: leave it out.")
    if steps < found.steps:
        notes[
            "Minari needs an observation after the last action: where there was none, the last action was left out."
        ] = None
    if not rows.even(found.time_s, source.fps):
        notes["Minari keeps no times: the true times of the rows were left out."] = None
    for place, name in places.items():
        keys = "/".join(f"_index_{part}" if isinstance(part, int) else part for part in place)
        rows_here = steps + (place[0] == "observations")
        if name is None:
            texts = take.facts.get("texts")
            given = texts.get("/".join(map(str, place))) if isinstance(texts, Mapping) else None
            texts = given if isinstance(given, list) and len(given) == rows_here else [take.task] * rows_here
            group.create_dataset(keys, data=texts, dtype=hdf5.TEXT)
        else:
            _write_rows(group, keys, source.sensors[name], take.readings[name], rows_here, where)
    for root, values in _follow(source, take, steps, where, notes):
        group.create_dataset(root, data=values)
    for name, readings in take.readings.items():
        if rows.role_of(name) == rows.INFO and source.sensors[name].kind != "points":
            if len(readings.values) < steps:
                notes[f"'{name}' has not a reading for each step and was left out."] = None
                continue
            key = f"infos/{_info_key(name, take)}"
            _write_rows(group, key, source.sensors[name], readings, min(len(readings.values), steps + 1), where)
    own = take.facts.get("minari")
    attrs = {"task": take.task} if take.task else {}
    attrs |= {} if take.start_ns is None else {"start_ns": take.start_ns}
    for key, value in {
        **(own if isinstance(own, Mapping) else {}),
        **attrs,
        "id": number,
        "total_steps": steps,
    }.items():
        if isinstance(value, str | int | float | list):
            group.attrs[key] = value
    return steps


def _info_key(name: str, take: Take) -> str:
    """info.deep.count -> deep/count, or deep.count where "info.deep" is an array itself."""
    flat = any(other != name and (f"{name}.").startswith(f"{other}.") for other in take.readings)
    return name.removeprefix("info.") if flat else name.removeprefix("info.").replace(".", "/")


def _write_rows(group, key: str, sensor: Sensor, readings: Readings, count: int, where: str) -> None:
    shape = rows.stored_shape(sensor)
    more = {} if sensor.kind == "vector" else {"chunks": (1, *shape), "compression": "gzip", "compression_opts": 1}
    stored = group.create_dataset(key, (count, *shape), sensor.dtype, **more)
    row = 0
    for part in rows.batches(readings.values, sensor, where, count):
        stored[row : row + len(part)] = rows.to_stored(part, sensor)
        row += len(part)


def _follow(
    source: Source, take: Take, steps: int, where: str, notes: dict[str, None]
) -> Iterator[tuple[str, np.ndarray]]:
    """Rewards, terminations and truncations of the steps, each [steps]."""
    found: dict[str, np.ndarray] = {}
    for root, name in _FOLLOW.items():
        if name in take.readings:
            values = rows.whole(take.readings[name], source.sensors[name], where)
            if values.size != len(values):
                raise DatasetError(f"'{name}' in {where} has {values.shape[1:]} numbers a row; Minari has one.")
            values = values.reshape(-1)[:steps]
            found[root] = values if root == "rewards" else values.astype(bool)
    if "rewards" not in found:
        notes["there were no rewards: Minari's are 0."] = None
        found["rewards"] = np.zeros(steps)
    done = found.setdefault("terminations", np.zeros(steps, bool))
    if "truncations" not in found:
        found["truncations"] = np.zeros(steps, bool)
        found["truncations"][-1] = not done[-1]
    yield from found.items()
