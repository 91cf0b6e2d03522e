"""Reads and writes Minari datasets (0.5) without the `minari` package, which decodes whole episodes at once and makes the
environment that the metadata names. Here values are read one at a time, and no code that the files name is run."""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...core.files import creating
from ...data.source import Sensor, Source, Take, without
from . import arrays, rows, spaces
from .arrays import Place
from .minari_stored import Shapes, StoredEpisode, open_storage

VERSION = "0.5.4"  # of the layout that `write` writes (the first with pictures that are not JPEG)
_ID = re.compile(r"[-\w]+-v\d+", re.ASCII)
_ROLES = {"observations": rows.OBSERVATION, "actions": rows.ACTION}
_FOLLOW = {root: name for root, name in arrays.GYMNASIUM.items() if root not in _ROLES}
_ROOTS = {name: root for root, name in _FOLLOW.items()}
_NAMES = {**arrays.GYMNASIUM, "infos": rows.INFO}
_KEPT_ELSEWHERE = ("observation_space", "action_space", "total_episodes", "total_steps", "dataset_size", "terrella")


def read(path: str | Path, fps: float | None = None) -> Source:
    """A Minari dataset folder (or its `data` folder), stored as HDF5, Arrow or Parquet.

    Each leaf of a Dict or Tuple space becomes a sensor: "observation.agent.pos", "action.0". A space of one array becomes
    "observation.state" or "action"; pictures become "observation.images.NAME". Integers stay integers. A Text leaf named
    mission (or task, instruction, …) is the take's task; other texts are kept in its facts. Infos with a row per step become
    "info.NAME". next.done is Minari's termination, next.truncated its truncation. Spaces and metadata
    are kept as facts. A take has one more observation than actions.

    fps: rows per second. Default: as `write` stored it, else rows.FPS_UNKNOWN, because Minari stores none.
    DatasetError where files are missing or damaged, or a space has an unknown type.
    """
    rows.check_fps(fps, str(path))
    data, meta, count = _opened(Path(path))
    given = {root: _space(meta, f"{root.removesuffix('s')}_space", data) for root in _ROLES}
    spaces_facts = {f"{root.removesuffix('s')}_space": spaces.compact(space) for root, space in given.items()}
    leaves = {
        (root, *place): leaf
        for root, space in given.items()
        for place, leaf in spaces.leaves(space, root, str(data)).items()
    }
    known = {place: leaf for place, leaf in leaves.items() if leaf}
    shapes = {place: leaf.shape[1:] for place, leaf in known.items()}
    episode = open_storage(data, meta.get("data_format", "hdf5"), count)
    stored = arrays.union(episode(i).headers(shapes) for i in range(count))
    known |= {place: it for place, it in sorted(stored.items(), key=str) if place[0] in _FOLLOW or place[0] == "infos"}
    own = meta["terrella"] if isinstance(meta.get("terrella"), dict) else {}
    described = rows.sensors_described(own, str(data)) if own else {}
    places = _places(Source("", described, tuple, facts=spaces_facts))[1] if described else {}
    ours = {place: described[name] for place, name in places.items() if name}
    sensors, notes = arrays.columns(known, partial(arrays.sensor_at, _NAMES), "Minari's", ours)

    def takes(rate: float) -> Iterator[Take]:
        texts = [place for place, leaf in leaves.items() if leaf is None]
        return (_take(episode(i), f"{data}, episode {i}", sensors, shapes, texts, rate) for i in range(count))

    facts = {**spaces_facts, "minari": {key: value for key, value in meta.items() if key not in _KEPT_ELSEWHERE}}
    name = str(meta.get("dataset_id") or Path(path).name)
    return arrays.source("Minari", name, sensors, takes, fps=fps, about=own, notes=notes, facts=facts)


def _opened(path: Path) -> tuple[Path, dict, int]:
    """The data folder, its metadata, and its number of episodes."""
    data = path / "data" if (path / "data").is_dir() else path
    if not (data / "metadata.json").is_file():
        raise DatasetError(f"{path} is not a Minari dataset: {data / 'metadata.json'} is missing; name another folder.")
    meta = rows.read_json(data / "metadata.json")
    count = meta.get("total_episodes")
    if not isinstance(count, int) or not 0 < count <= 1 << 32:
        raise DatasetError(f"{data} claims {count} episodes; there is nothing to read.")
    return data, meta, count


def _space(meta: dict, key: str, data: Path) -> dict:
    text = meta.get(key)
    try:
        space = json.loads(text) if isinstance(text, str) else text
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{key} in {data / 'metadata.json'} is damaged ({error}); restore it.") from error
    if not isinstance(space, dict):
        raise DatasetError(f"{data / 'metadata.json'} has no {key}; open it once with minari, which adds it.")
    return space


def _take(episode: StoredEpisode, where: str, sensors: Mapping, shapes: Shapes, texts: list[Place], fps: float) -> Take:
    stored = episode.arrays(shapes)
    steps = stored["rewards",].shape[0] if ("rewards",) in stored else 0
    if not steps:
        raise DatasetError(f"{where} has no steps (rewards); remove it from the dataset.")
    own = {place: it for place, it in sensors.items() if place[0] != "infos" or _fits(stored.get(place), it)}
    odd = [arrays.spelled(place) for place in sensors if place in stored and place not in own]
    if lost := [place for place in own if place[0] in _ROLES and place not in stored]:
        raise DatasetError(f"{where} lacks '{arrays.spelled(lost[0])}', an array of numbers; mend it, or drop it.")
    readings = arrays.readings(stored, own, np.arange(steps + 1) / fps, where)
    rows.rows_of(Take(readings), where)
    facts = episode.facts()
    task, start_ns = facts.pop("task", ""), facts.pop("start_ns", None)
    of_places = {place: episode.texts(place) for place in texts}
    task, kept = spaces.split_texts(of_places, task if isinstance(task, str) else "")
    return Take(
        readings,
        task=task,
        start_ns=start_ns if isinstance(start_ns, int) else None,
        facts={"minari": facts, **({"texts": kept} if kept else {})},
        notes=tuple(f"'{name}' is left out where it is no array like that of the other episodes." for name in odd),
    )


def _fits(array: arrays.Array | None, sensor: Sensor) -> bool:
    return array is not None and array.is_numeric and array.shape[1:] == rows.stored_shape(sensor)


class _Lacking(DatasetError):
    """A take has no reading of the sensor `name`, which Minari needs in every episode."""

    def __init__(self, where: str, name: str):
        super().__init__(f"{where} lacks '{name}', which Minari needs in every episode; write another format.")
        self.name = name


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source as a Minari dataset (HDF5, lossless pictures); returns a note on everything that was left out.

    With MINARI_DATASETS_PATH set to the parent of `path`, `minari.load_dataset(path.name)` opens it. The name must end in
    -v0, -v1, …. Spaces are facts["observation_space"] and facts["action_space"] if their leaves match the sensors, else a
    Dict with a Box per sensor. Observations and actions that some take lacks are left out, all but the last of a role.
    Minari needs an observation after the last action: where a take has none, its last action is left out. Missing rewards
    become 0; a missing end becomes a truncation at the last step. Names, units, frames and fps are kept in the metadata.
    `progress(takes, 0)` is called after each take. DatasetError where a take does not fit or `path` exists.
    """
    notes: list[str] = []
    while True:
        try:
            return [*notes, *_written(source, Path(path), progress)]
        except _Lacking as error:
            role = rows.role_of(error.name)
            if sum(rows.role_of(name) == role for name in source.sensors) < 2:
                raise
            source = without(source, (error.name,))
            notes.append(f"'{error.name}' was left out: some take lacks it, and Minari needs it in every episode.")


def _written(source: Source, path: Path, progress: Callable[[int, int], None] | None) -> list[str]:
    from . import hdf5_file

    if not _ID.fullmatch(path.name):
        raise DatasetError(f"'{path.name}' is no Minari id: name the folder like name-v0.")
    notes: dict[str, None] = {}
    given, places = _places(source)
    for name in source.sensors:
        if rows.role_of(name) == "" or source.sensors[name].kind == "points":
            notes[f"'{name}' has no place in Minari's layout and was left out."] = None
    with creating(path) as staged:
        data = staged / "data"
        data.mkdir(parents=True)
        steps, number = 0, 0
        with hdf5_file.File(data / "main_data.hdf5", "w", track_order=True) as file:
            for number, take in rows.numbered(source, progress):
                group = file.create_group(f"episode_{number}")
                steps += _write_take(group, number, source, take, places, notes)
        meta = _metadata(source, given, path.name)
        size = round((data / "main_data.hdf5").stat().st_size / 1e6, 1)
        meta |= {"total_episodes": number + 1, "total_steps": steps, "dataset_size": size}
        (data / "metadata.json").write_text(json.dumps(meta), encoding="utf-8")
    return list(notes)


def _places(source: Source) -> tuple[dict[str, dict], dict[Place, str | None]]:
    """The spaces of observations and actions; and the sensor's name at each place, None for a text."""
    given: dict[str, dict] = {}
    places: dict[Place, str | None] = {}
    for root, role in _ROLES.items():
        given[root], leaves = _structure(source, root, role)
        places |= {(root, *place): name for place, name in leaves.items()}
    for name in source.sensors:
        flat = any(other != name and f"{name}.".startswith(f"{other}.") for other in source.sensors)
        if name in _ROOTS:
            places[_ROOTS[name],] = name
        elif rows.role_of(name) == rows.INFO and source.sensors[name].kind != "points":
            below = name.removeprefix("info.")  # info.deep.count -> deep/count, where "info.deep" is no array itself
            places["infos", *([below] if flat else below.split("."))] = name
    return given, places


def _structure(source: Source, root: str, role: str) -> tuple[dict, dict[Place, str | None]]:
    """The space of a role, and the sensor's name at each of its leaves."""
    own = {n: s for n, s in source.sensors.items() if rows.role_of(n) == role and s.kind != "points"}
    if not own:
        raise DatasetError(f"{source.name or 'the source'} has no {root}, which Minari needs; choose another format.")
    space = source.facts.get(f"{role}_space")
    try:
        leaves = spaces.leaves(space, role, "the source") if isinstance(space, dict) else {}
        known = {(root, *place): leaf for place, leaf in leaves.items() if leaf}
        sensors, odd = arrays.columns(known, partial(arrays.sensor_at, _NAMES), "")
        space = None if odd else space
    except DatasetError:
        leaves, sensors = {}, {}
    names = {place[1:]: sensor.name for place, sensor in sensors.items()}
    if isinstance(space, dict) and _forms(sensors.values()) == _forms(own.values()):
        return space, {place: names.get(place) for place in leaves}
    if len(own) == 1:
        (sensor,) = own.values()
        return spaces.box(sensor), {(): sensor.name}
    keys = {name: name.removeprefix(f"{role}.") for name in own}
    parts = {keys[name]: spaces.box(sensor) for name, sensor in own.items()}
    return {"type": "Dict", "subspaces": parts}, {(key,): name for name, key in keys.items()}


def _forms(sensors: Iterable[Sensor]) -> dict[str, tuple]:
    return {sensor.name: (sensor.dtype, rows.stored_shape(sensor)) for sensor in sensors}


def _metadata(source: Source, given: dict, dataset_id: str) -> dict:
    own = source.facts.get("minari")
    own = {key: value for key, value in own.items() if key not in _KEPT_ELSEWHERE} if isinstance(own, Mapping) else {}
    elsewhere = ("minari", "observation_space", "action_space")
    kept = {key: value for key, value in source.facts.items() if key not in elsewhere}
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
    from . import hdf5_file

    where = f"take {number}"
    missing = [name for place, name in places.items() if place[0] in _ROLES and name not in (None, *take.readings)]
    if missing:
        raise _Lacking(where, str(missing[0]))
    named = [name for place, name in places.items() if name is not None and place[0] != "infos"]
    counts = rows.rows_of(replace(take, readings={n: take.readings[n] for n in named if n in take.readings}), where)
    steps = min(counts.steps, counts.observations - 1)
    if steps < 1:
        raise DatasetError(f"{where} has {counts.observations} observations; Minari needs 2 or more: leave it out.")
    if steps < counts.steps:
        notes[
            "Minari needs an observation after the last action: where there was none, the last action was left out."
        ] = None
    if not rows.is_even(counts.time_s, source.fps):
        notes["Minari keeps no times: the true times of the rows were left out."] = None
    texts = take.facts.get("texts")
    for text in set(texts if isinstance(texts, Mapping) else ()) - {arrays.spelled(place) for place in places}:
        notes[f"the text '{text}' has no place in this space and was left out."] = None
    for place, name in places.items():
        keys = "/".join(f"_index_{part}" if isinstance(part, int) else part for part in place)
        count = steps + (place[0] == "observations")
        if name is None:
            texts = take.facts.get("texts")
            given = texts.get(arrays.spelled(place)) if isinstance(texts, Mapping) else None
            texts = given if isinstance(given, list) and len(given) == count else [take.task] * count
            group.create_dataset(keys, data=texts, dtype=hdf5_file.TEXT)
        elif name in take.readings:
            sensor, readings = source.sensors[name], take.readings[name]
            if len(readings.values) < steps:
                notes[f"'{name}' has not a reading for each step and was left out."] = None
                continue
            shape = rows.stored_shape(sensor)
            if place[0] in _FOLLOW:
                if math.prod(shape) != 1:
                    raise DatasetError(f"'{name}' in {where} has {list(shape)} numbers a row; Minari has one.")
                shape = ()
            count = min(len(readings.values), steps + 1) if place[0] == "infos" else count
            flag = place[0] in ("terminations", "truncations")
            hdf5_file.store_readings(group, {keys: 0}, (count, *shape), sensor, readings, where, "bool" if flag else "")
    if "rewards" not in group:
        notes["there were no rewards: Minari's are 0."] = None
        group["rewards"] = np.zeros(steps)
    if "terminations" not in group:
        group["terminations"] = np.zeros(steps, bool)
    if "truncations" not in group:
        group["truncations"] = (np.arange(steps) == steps - 1) & ~group["terminations"][-1]
    hdf5_file.set_attributes(group, take.facts.get("minari"))
    numbered = {"task": take.task or None, "start_ns": take.start_ns, "id": number, "total_steps": steps}
    hdf5_file.set_attributes(group, numbered)
    return steps
