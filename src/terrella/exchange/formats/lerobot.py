"""LeRobot v3.0: reads a dataset as a Source, and writes any Source as one, resampled to rows."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ...core.errors import DatasetError
from ...core.files import creating, not_written
from ...data.channels import file_name
from ...data.dataset import Dataset
from ...data.features import EVENTS, PERSISTENT, unit_of
from ...data.format import ACTION_VALID, AUTOMATIC, TIME, Layout, whole_rate
from ...data.recorder import NotFinite, Recorder
from ...data.resample import SAME_TIME_S, Policy, resample, row_times
from ...data.source import Readings, Sensor, Source, Take, is_outcome
from ...data.storage.remote import LocalFiles
from ...data.storage.tables import open_parquet
from . import rows


def read(root: str | Path, fps: float | None = None) -> Source:
    """A LeRobot v3.0 folder, or its address. `fps` is ignored: the dataset states its own."""
    data = Dataset(root)
    unlisted: list[str] = []
    if isinstance(data.files, LocalFiles) and len(data.episodes):
        with (
            suppress(DatasetError, ValueError, OSError),
            open_parquet(data.files.local(data.episodes[0].data)) as table,
        ):
            columns = [name for name in table.schema_arrow.names if name not in data.info["features"]]
            unlisted += [f"the column '{name}'" for name in columns]
        films = data.files.list("videos", ".mp4")
        cameras = dict.fromkeys(film.split("/")[1] for film in films if film.count("/") > 1)
        unlisted += [f"the camera '{name}'" for name in cameras if name not in data.features]
    notes = [f"{what} is not in info.json and was left out." for what in unlisted]
    if annotations := [name for name in (PERSISTENT, EVENTS) if name in data.info["features"]]:
        where, kept = " and ".join(annotations), "nothing is kept"
        if PERSISTENT in annotations:
            kept = "the subtasks are kept, as instructions in place of an episode's only task"
        notes.append(f"of the annotations in {where} {kept}.")
    return replace(data.source(), notes=tuple(notes))


@dataclass(frozen=True)
class LeRobotRows:
    """How a Source becomes rows."""

    # Rows per second. None: the source's own rows; if each sensor has its own clock, a row per reading of the fastest camera,
    # else of the fastest observation.
    fps: float | None = None
    # A row's value of a sensor without a reading at that time, see `resample`. For images and depth, "linear" is "nearest".
    policy: Policy = "previous"
    # "video" (H.264) or "png" (exact).
    pictures: Literal["video", "png"] = "video"


def write(
    source: Source,
    root: str | Path,
    progress: Callable[[int, int], None] | None = None,
    how: LeRobotRows = LeRobotRows(),
    finish: Callable[[Path, list[str]], object] | None = None,
) -> list[str]:
    """Writes every take as an episode of a new LeRobot v3.0 folder; returns notes on what was changed or left out.

    A sensor with its own clock is stored twice: resampled in the rows, for every LeRobot reader, and with its true times as
    a stream. Points are streams only. `progress(takes, 0)` is called after each take; `finish(folder, notes)` may add files
    before the folder is moved to `root`.
    """
    root = Path(os.path.abspath(root))
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise DatasetError(f"{root} is not empty; convert into a new folder.")
    source, renamed = _with_file_names(source)
    first = next(iter(source.takes()), None)
    if first is None:
        raise DatasetError(f"{source.name} has no takes; choose another recording.")
    lead = _lead(source, first)
    layout, notes = _layout(source, first, lead, how)
    notes = [*renamed, *notes]
    with creating(root) as staged:
        try:
            notes += _write(source, layout, staged, lead, how, progress)
            if finish:
                finish(staged, notes)
        except DatasetError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            raise not_written(root, error.__cause__) from error  # the recorder's error names `staged`, which is deleted
    return notes


def _with_file_names(source: Source) -> tuple[Source, list[str]]:
    """The source with names that features can have, and a note on each sensor that has another name there."""
    names: dict[str, str] = {}
    for name in sorted(source.sensors, key=lambda name: file_name(name) != name):  # good names stay
        names[name] = rows.unique(file_name(name), names.values())
    notes = [f"'{name}' is '{now}' in LeRobot, where it names files." for name, now in names.items() if name != now]
    if not notes:
        return source, []
    sensors = {names[name]: replace(sensor, name=names[name]) for name, sensor in source.sensors.items()}

    def takes() -> Iterator[Take]:
        for take in source.takes():
            yield replace(take, readings={names.get(name, name): readings for name, readings in take.readings.items()})

    return replace(source, sensors=sensors, takes=takes), notes


def _write(source: Source, layout: Layout, root: Path, lead: str, how: LeRobotRows, progress) -> list[str]:
    left_out, notes = [], dict[str, None]()  # each note once, in order
    with Recorder(root, layout, interrupted="discard") as recorder:
        for number, take in enumerate(source.takes()):
            notes |= dict.fromkeys(take.notes)
            at = _row_times(source, take, layout, lead, how)
            if len(at) < 2:
                left_out.append(f"take {number} was left out: it has {len(at)} row{'s' * (len(at) != 1)}")
                continue
            try:
                notes |= dict.fromkeys(_write_take(recorder, take, at, source.fps is not None, how))
            except NotFinite as error:
                recorder.drop_episode()
                left_out.append(f"take {number} was left out: {str(error).rstrip('.')}")
            if progress:
                progress(number + 1, 0)
        if not recorder.episodes:
            raise DatasetError(f"nothing of {source.name} can be kept; {'; '.join(left_out)}.")
    return [*left_out, *notes]


def _row_times(source: Source, take: Take, layout: Layout, lead: str, how: LeRobotRows) -> np.ndarray:
    """The times of a take's rows: of the readings of `lead`, or of another sensor where the take lacks it."""
    if how.fps is not None:
        return row_times(take, layout.sensors, how.fps)
    if len(clock := take.readings.get(lead, _NONE).time_s):
        return clock
    if source.fps is None:  # each sensor has its own clock
        return row_times(take, layout.sensors, layout.fps)
    return max((readings.time_s for readings in take.readings.values()), key=len, default=_NONE.time_s)


def _lead(source: Source, first: Take) -> str:
    present = [sensor for name, sensor in source.sensors.items() if len(first.readings.get(name, _NONE).time_s)]
    if not present:
        raise DatasetError(f"the first take of {source.name} has no readings; leave it out.")
    observed = [sensor for sensor in present if not is_outcome(sensor.name) and sensor.kind != "points"] or present
    cameras = [sensor for sensor in observed if sensor.kind == "image"]
    return max(cameras or observed, key=lambda sensor: len(first.readings[sensor.name].time_s)).name


_NONE = Readings(np.zeros(0), [])


def _layout(source: Source, first: Take, lead: str, how: LeRobotRows) -> tuple[Layout, list[str]]:
    at, notes = first.readings[lead].time_s, []
    rate = how.fps or source.fps or source.sensors[lead].rate_hz
    if rate is None:
        if len(at) < 2 or at[-1] <= at[0]:
            raise DatasetError(f"{source.name} has no frame rate; give --fps.")
        rate = float(f"{(len(at) - 1) / (at[-1] - at[0]):.6g}")
    own_clocks = source.fps is None or (how.fps is not None and how.fps != source.fps)
    sensors, streams, pictures = {}, {}, how.pictures
    for name, sensor in source.sensors.items():
        if name in (*AUTOMATIC, ACTION_VALID, TIME):
            continue
        if sensor.kind != "points" and 0 in sensor.shape:
            notes.append(f"{name} was left out: it has no numbers")
            continue
        own_rate = sensor.rate_hz is not None and whole_rate(sensor.rate_hz) != whole_rate(rate)
        reserved = sensor.kind == "points" or own_rate
        if sensor.kind == "image" and (sensor.shape[0] % 2 or sensor.shape[1] % 2) and pictures == "video":
            pictures = "png"
            notes.append(f"{name} is {sensor.shape[0]}x{sensor.shape[1]}, and H.264 needs even sizes: pictures are PNG")
        if sensor.kind != "points":
            sensors[name] = sensor
        if sensor.dtype == "string":
            continue  # text with its own clock is stored in the rows only
        if sensor.kind == "points" or (own_clocks or reserved) and (name != lead or how.fps):
            streams[name] = sensor
    if not sensors:
        raise DatasetError(f"{source.name} has only points, which rows cannot hold; add a camera or a pose.")
    facts = dict(source.facts)
    world = facts.pop("world", {})
    layout = Layout(
        whole_rate(float(rate)),
        sensors,
        streams,
        clock=source.fps is None,
        pictures=pictures,
        robot=source.robot or "unknown",
        world=world if isinstance(world, Mapping) else {},
        facts={**facts, "rows": {"lead": lead, "policy": how.policy, "fps_asked": how.fps}},
    )
    png_streams = {name for name, sensor in streams.items() if sensor.kind == "image" and pictures == "png"}
    if png_streams:
        notes.append(f"{', '.join(sorted(png_streams))}: kept in the rows only, because pictures are PNG")
        layout = replace(layout, streams={name: sensor for name, sensor in streams.items() if name not in png_streams})
    return layout, notes


def _write_take(recorder: Recorder, take: Take, at: np.ndarray, has_rows: bool, how: LeRobotRows) -> list[str]:
    layout, notes = recorder.layout, []
    recorder.task = take.task
    columns, exact = {}, set()
    deep = {name: unit_of(sensor) for name, sensor in layout.sensors.items() if sensor.kind == "depth"}
    for name, sensor in layout.sensors.items():
        readings = take.readings.get(name, _NONE)
        place = _places(readings.time_s, at)
        sparse = len(readings.time_s) < len(at) - 1  # these are gaps only if the source has rows
        if len(readings.time_s) and place is not None and (not sparse or (is_outcome(name) and has_rows)):
            columns[name], _ = (readings.values, place), exact.add(name)
            continue
        columns[name] = _resampled(readings, sensor, at, how.policy)
        if len(readings.time_s) and not is_outcome(name) and columns[name][1][0] < 0:
            notes.append(f"rows before the first reading of {name} hold that first reading")
    language = [(float(when), str(words)) for when, words in take.facts.get("language", ())]  # type: ignore[misc]
    for i, time_s in enumerate(at):
        while language and language[0][0] <= time_s + SAME_TIME_S:
            recorder.say(language.pop(0)[1])
        row = {}
        for name, (values, place) in columns.items():
            if place[i] >= 0:
                row[name] = values[int(place[i])]
            elif not is_outcome(name):
                first = int((place >= 0).argmax())
                row[name] = values[int(place[first])] if place[first] >= 0 else None
        for name in deep:
            notes += rows.depth_lost(name, row[name], deep[name]) if row.get(name) is not None else []
        recorder.add_row(row, float(time_s))
    for name in layout.streams:
        if name not in exact:
            readings = take.readings.get(name, _NONE)
            for time_s, value in zip(readings.time_s, readings.values):
                recorder.log(name, value, float(time_s))
    recorder.end_episode(take.start_ns)
    dropped = rows.facts_of(take)
    return notes + ([f"facts of single takes were not kept: {', '.join(dropped)}"] if dropped else [])


def _places(time_s: np.ndarray, at: np.ndarray) -> np.ndarray | None:
    """int64 [T]: the reading at each row's time, -1 for none; None if some reading lies between rows."""
    row = np.abs(np.searchsorted(at, time_s - SAME_TIME_S)).clip(max=len(at) - 1)
    if len(np.unique(row)) != len(time_s) or (np.abs(at[row] - time_s) > SAME_TIME_S).any():
        return None
    place = np.full(len(at), -1)
    place[row] = np.arange(len(time_s))
    return place


def _resampled(
    readings: Readings, sensor: Sensor, at: np.ndarray, policy: Policy
) -> tuple[Sequence | np.ndarray, np.ndarray]:
    """(values of T rows, int64 [T]: the row's index, or -1 where it has no value)."""
    mixes = sensor.kind == "vector" and not is_outcome(sensor.name)
    held: Policy = "nearest" if policy == "linear" and not mixes else policy
    values, valid = resample(readings, sensor, at, held)
    if is_outcome(sensor.name) and len(readings.time_s):  # an action lasts until the next one, the last for one period
        period = np.median(np.diff(readings.time_s)) if len(readings.time_s) > 1 else 0.0
        valid = valid & (at < readings.time_s[-1] + max(period, SAME_TIME_S))
    return values, np.where(valid, np.arange(len(at)), -1)
