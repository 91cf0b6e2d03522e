"""doctor: examines a recording and names each fault with its place and its mend."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core.errors import DatasetError
from . import mp4
from .dataset import Dataset, Episode, read_table
from .format import ACTION, DATA_PATH, DONE, EPISODES_PATH, INFO, STATS, TASKS, VIDEO_PATH, schema, to_numpy

_RESTORE = "restore the file from a copy, or leave its episode out of training"
_LEFTOVER = "it was being committed when the recorder was killed: record into the folder again, or delete the file"


@dataclass(frozen=True)
class Fault:
    """file: relative to the dataset; row: of the whole dataset, None where it concerns the file; what and mend: sentences."""

    file: str
    row: int | None
    what: str
    mend: str


def doctor(root: str | Path) -> list[Fault]:
    """All faults of a LeRobot v3.0 recording, [] where it is sound. DatasetError where there is no dataset to examine."""
    dataset = Dataset(root)
    faults = [*_meta(dataset), *_extra_files(dataset)]
    actions: list[np.ndarray] = []
    expected = 0
    for episode in dataset.episodes:
        if episode.start != expected:
            what = f"episode {episode.number} starts at row {episode.start}, {expected} follows the one before"
            faults.append(Fault("meta/episodes", expected, what, _RESTORE))
        expected = episode.stop
        faults += _rows(dataset, episode, actions)
        faults += _video(dataset, episode)
    if expected != dataset.length:
        what = f"info.json counts {dataset.length} rows, the episodes hold {expected}"
        faults.append(Fault(INFO, None, what, f"set total_frames to {expected}"))
    return [*faults, *_constant(actions)]


def _meta(dataset: Dataset) -> Iterator[Fault]:
    try:
        if (dataset.root / STATS).exists():
            json.loads((dataset.root / STATS).read_text(encoding="utf-8"))
        else:
            yield Fault(
                STATS,
                None,
                "the file is missing, LeRobot cannot normalise without it",
                "record one more episode into the folder",
            )
    except ValueError as error:
        yield Fault(STATS, None, f"the file is not JSON ({error})", "record one more episode into the folder")
    try:
        read_table(dataset.root / TASKS)
    except DatasetError as error:
        yield Fault(TASKS, None, str(error).split(";")[0], "record one more episode into the folder")


def _extra_files(dataset: Dataset) -> Iterator[Fault]:
    """Files that no episode names: LeRobot would read them all the same."""
    known = {file for episode in dataset.episodes for file in (episode.data, episode.video)}
    patterns = [str(dataset.info.get("data_path") or DATA_PATH)]
    if dataset.rgb_key:
        patterns.append(str(dataset.info.get("video_path") or VIDEO_PATH).replace("{video_key}", dataset.rgb_key))
    for pattern in patterns:
        folder = pattern.split("/chunk-")[0]
        for file in sorted((dataset.root / folder).glob("chunk-*/*")):
            if file not in known:
                yield Fault(
                    str(file.relative_to(dataset.root)), None, "no episode of info.json uses this file", _LEFTOVER
                )
    for file in sorted((dataset.root / EPISODES_PATH).parent.parent.glob("chunk-*/*.parquet")):
        try:
            numbers = read_table(file, ["episode_index"])["episode_index"].to_pylist()
        except DatasetError as error:
            yield Fault(str(file.relative_to(dataset.root)), None, str(error).split(";")[0], _RESTORE)
            continue
        if any(number >= len(dataset.episodes) for number in numbers):
            what = f"it lists an episode beyond the {len(dataset.episodes)} of info.json"
            yield Fault(str(file.relative_to(dataset.root)), None, what, _LEFTOVER)


def _rows(dataset: Dataset, episode: Episode, actions: list[np.ndarray]) -> Iterator[Fault]:
    file = str(episode.data.relative_to(dataset.root))
    try:
        found = pq.ParquetFile(episode.data).schema_arrow
        promised = schema(dataset.features)
        wrong = [
            field.name
            for field in promised
            if field.name not in found.names or not _alike(found.field(field.name).type, field.type)
        ]
        for name in wrong:
            there = f"is {found.field(name).type}" if name in found.names else "is missing"
            what = f"column '{name}' {there}, info.json promises {promised.field(name).type}"
            yield Fault(file, episode.start, what, _RESTORE)
        table = read_table(episode.data, [name for name in promised.names if name not in wrong])
    except (DatasetError, OSError, pa.ArrowException):
        yield Fault(file, episode.start, "the table is missing, truncated or not parquet", _RESTORE)
        return
    columns: dict[str, np.ndarray] = {}
    inside = np.ones(len(table), bool)
    for name in table.column_names:
        try:
            columns[name] = to_numpy(table[name], tuple(dataset.features[name]["shape"]))
        except ValueError as error:
            yield Fault(file, episode.start, f"column '{name}' is broken: {error}", _RESTORE)
    if "episode_index" in columns:  # a stranger's file may hold several episodes
        inside = columns["episode_index"].reshape(-1) == episode.number
    columns = {name: column[inside] for name, column in columns.items()}
    rows = int(inside.sum())
    if rows != episode.length:
        yield Fault(
            file,
            episode.start,
            f"episode {episode.number} has {rows} rows here, {episode.length} in meta/episodes",
            _RESTORE,
        )
    yield from _counters(dataset, episode, file, columns, rows)
    yield from _values(episode, file, columns)
    if ACTION in columns and rows:
        actions.append(columns[ACTION][: max(1, rows - 1)].reshape(max(1, rows - 1), -1))


def _alike(found: pa.DataType, promised: pa.DataType) -> bool:
    """Whether two Arrow types hold the same: lists may be of fixed size or not, and datasets' own array types count."""
    while isinstance(found, pa.BaseExtensionType):
        found = found.storage_type
    while pa.types.is_nested(promised):
        if not pa.types.is_nested(found) or not hasattr(found, "value_type"):
            return False
        found, promised = found.value_type, promised.value_type
    return found == promised


def _counters(dataset: Dataset, episode: Episode, file: str, columns, rows: int) -> Iterator[Fault]:
    expected = {"index": episode.start + np.arange(rows), "frame_index": np.arange(rows)}
    for name, should in expected.items():
        if name in columns:
            for at in np.flatnonzero(columns[name].reshape(-1) != should)[:1]:
                what = f"{name} is {int(columns[name].reshape(-1)[at])} where {int(should[at])} is due: rows are missing or moved"
                yield Fault(file, episode.start + int(at), what, _RESTORE)
    if "timestamp" in columns:
        late = np.abs(columns["timestamp"].reshape(-1) - np.arange(rows) / dataset.fps)
        for at in np.flatnonzero(late > 0.1 / dataset.fps)[:1]:
            what = f"timestamp is {late[at]:.3f} s off frame_index / {dataset.fps:g} frames per second"
            yield Fault(file, episode.start + int(at), what, "set timestamp to frame_index / fps")


def _values(episode: Episode, file: str, columns) -> Iterator[Fault]:
    for name, column in columns.items():
        if np.issubdtype(column.dtype, np.floating):
            for at in np.flatnonzero(~np.isfinite(column.reshape(len(column), -1)).all(1))[:1]:
                yield Fault(
                    file, episode.start + int(at), f"{name} is not a finite number", "leave the episode out of training"
                )
    if DONE in columns:
        for at in np.flatnonzero(columns[DONE].reshape(-1)[:-2])[
            :1
        ]:  # the last two: the step that ended it, and its end
            what = f"done is set {len(columns[DONE]) - 1 - int(at)} rows before the end of episode {episode.number}"
            yield Fault(file, episode.start + int(at), what, "split the episode there, or clear the flag")


def _video(dataset: Dataset, episode: Episode) -> Iterator[Fault]:
    if episode.video is None:
        return
    file = str(episode.video.relative_to(dataset.root))
    if not episode.video.exists():
        yield Fault(file, episode.start, "the video is missing", _RESTORE)
        return
    try:
        count = mp4.count_frames(episode.video)
    except DatasetError:
        yield Fault(file, episode.start, "the video is truncated or not mp4", _RESTORE)
        return
    shared = sum(other.video == episode.video for other in dataset.episodes) > 1
    if count < episode.first_frame + episode.length or (count > episode.length and not shared):
        what = f"the video has {count} frames, episode {episode.number} needs {episode.first_frame + episode.length}"
        yield Fault(file, episode.start + min(count, episode.length - 1), what, _RESTORE)
        return
    try:
        mp4.frames_at(episode.video, [episode.first_frame, episode.first_frame + episode.length - 1], dataset.fps)
    except DatasetError:
        yield Fault(file, episode.start, "the video's first or last frame cannot be decoded", _RESTORE)


def _constant(actions: list[np.ndarray]) -> Iterator[Fault]:
    """An action that never changes teaches nothing: mostly a controller that was not plugged in."""
    if not actions or sum(map(len, actions)) < 32:
        return
    every = np.concatenate(actions)
    if (every == every[0]).all():
        what = f"the action is {every[0].tolist()} in all {len(every)} rows"
        yield Fault("data", None, what, "check that actions are recorded, and record anew")
