"""Recorder: appends episodes to a LeRobotDataset v3.0 folder so that a crash loses at most the episode in flight."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core.errors import DatasetError
from . import durable, stats
from .format import (
    ACTION,
    ACTION_VALID,
    DATA_PATH,
    DEPTH,
    DEPTH_BEYOND,
    DEPTH_UNIT_M,
    DONE,
    EPISODES_PATH,
    FILES_PER_CHUNK,
    INFO,
    POSE_CONVENTION,
    REWARD,
    RGB,
    STATE,
    STATS,
    TASKS,
    VERSION,
    VIDEO_PATH,
    WORLD,
    Layout,
    schema,
    to_arrow,
    where,
)
from .mp4 import Mp4Writer

_ROWS_PER_GROUP = 256
_SAMPLE_EVERY = 16  # rows; pictures looked at for the statistics


class Recorder:
    """Appends to `root`, which is created or, where it was written by a Recorder of the same layout, gone on with.

    Each row is an observation, the action taken there and the reward and done that followed; the last row of an
    episode is its terminal observation and has action_valid = False. `end_episode` stages the episode's own mp4 and
    parquet files in a hidden folder, moves them into place and replaces meta/info.json last.
    DatasetError where root is foreign, locked by another recorder, or the disk is full; what was committed stays.
    """

    def __init__(self, root: str | Path, layout: Layout, task: str = "explore"):
        self.root, self.layout = Path(root), layout
        self._features = layout.features()
        self._schema = schema(self._features)
        self._staging = self.root / ".staging"
        self._video: Mp4Writer | None = None
        self._table: pq.ParquetWriter | None = None
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self._lock = _lock(self.root)
        except OSError as error:
            raise DatasetError(f"cannot record to {self.root}: {error.strerror}; choose another folder.") from error
        try:
            self._open(task)
        except BaseException:
            self._lock.close()
            raise

    def add(
        self,
        observation: Mapping[str, np.ndarray],
        action: np.ndarray | None = None,
        reward: float = 0.0,
        done: bool | None = None,
    ) -> None:
        """One row: observation without batch axis (rgb uint8 [H, W, 3], depth metres [h, w], pose [7], ...).

        `action` is None for the terminal observation; `done` None repeats the row before.
        """
        row = self._row(observation, action, reward, done)
        with self._nothing_lost():
            if not self._pending and not self._flushed:
                self._begin()
            if self._pending >= _ROWS_PER_GROUP:
                self._flush()
            if self._video:
                picture = row.pop(RGB)
                if self.in_flight % _SAMPLE_EVERY == 0:
                    self._pictures.append(picture[::4, ::4])
                self._video.add(picture)
            for key, value in row.items():
                self._rows[key].append(value)
            self._pending += 1

    def end_episode(self) -> int | None:
        """Commits the episode in flight and returns its number; None (and nothing kept) for fewer than 2 rows."""
        length = self._flushed + self._pending
        if length < 2:
            self._discard()
            return None
        with self._nothing_lost():
            self._rows[ACTION_VALID][-1] = np.zeros(1, bool)
            self._flush()
            self._commit(length)
        self._discard()
        return self.episodes - 1

    def close(self) -> None:
        """Commits the episode in flight and lets go of the folder."""
        try:
            self.end_episode()
        finally:
            self._discard()
            self._lock.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    @property
    def in_flight(self) -> int:
        """Rows added since the last commit."""
        return self._flushed + self._pending

    # -- opening ------------------------------------------------------------------------------------------------

    def _open(self, task: str) -> None:
        info = self.root / INFO
        fresh = not info.exists()
        if fresh:
            strangers = [entry.name for entry in self.root.iterdir() if not entry.name.startswith(".")]
            if strangers not in ([], ["meta"]):
                raise DatasetError(
                    f"{self.root} holds other files ({strangers[0]}, ...); record to a new or empty folder."
                )
            self.rows, self.episodes, self._tasks, self._stats = 0, 0, [], {}
        else:
            try:
                self._reopen(json.loads(info.read_text(encoding="utf-8")))
            except (OSError, ValueError, KeyError, pa.ArrowException) as error:
                first = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise DatasetError(
                    f"{self.root} is damaged ({first}); see `terrella data doctor {self.root}`, or record to a new folder."
                ) from error
        if task not in self._tasks:
            self._tasks.append(task)
        self._task = self._tasks.index(task)
        shutil.rmtree(self._staging, ignore_errors=True)
        for path in self._files(self.episodes).values():  # an episode that was moved into place but never committed
            (self.root / path).unlink(missing_ok=True)
        self._discard()
        if fresh:
            with self._nothing_lost():
                facts = {"pose": POSE_CONVENTION, "depth_unit_m": DEPTH_UNIT_M, "depth_beyond": DEPTH_BEYOND}
                durable.write_json(self.root / WORLD, {"version": 1, "world": dict(self.layout.world), **facts})
                durable.write_json(self.root / INFO, self._info(0, 0))

    def _reopen(self, info: dict) -> None:
        if info.get("codebase_version") != VERSION or not (self.root / WORLD).exists():
            raise DatasetError(f"{self.root} is a dataset that Terrella did not write; record to a new folder.")
        old, new = info["features"], self._features
        if old != json.loads(json.dumps(new)) or info["fps"] != self.layout.fps:
            changed = sorted(set(old) ^ set(new)) or [
                key for key in new if old[key] != json.loads(json.dumps(new[key]))
            ]
            what = ", ".join(changed) if changed else f"{info['fps']} frames/s"
            raise DatasetError(f"{self.root} was recorded with another layout ({what}); record to a new folder.")
        self.rows, self.episodes = info["total_frames"], info["total_episodes"]
        self._tasks, parts = [], []
        if self.episodes:
            self._tasks = pq.read_table(self.root / TASKS).column("__index_level_0__").to_pylist()
        for number in range(self.episodes):
            row = pq.read_table(self.root / self._files(number)["episode"]).to_pylist()[0]
            part: dict[str, stats.Summary] = {}
            for name, value in row.items():
                if name.startswith("stats/"):
                    _, feature, key = name.split("/")
                    part.setdefault(feature, {})[key] = np.array(value)
            parts.append(part)
        self._stats = stats.merge(parts)

    # -- rows ---------------------------------------------------------------------------------------------------

    def _row(self, observation, action, reward, done) -> dict[str, np.ndarray]:
        layout, row = self.layout, {}
        if layout.rgb:
            row[RGB] = self._array(observation, "rgb", (*layout.rgb, 3), np.uint8)
        if layout.depth:
            depth = self._array(observation, "depth", layout.depth, np.float32)
            steps = np.nan_to_num(depth / DEPTH_UNIT_M + 0.5, nan=DEPTH_BEYOND, posinf=DEPTH_BEYOND)
            row[DEPTH] = np.clip(steps, 0, DEPTH_BEYOND).astype(np.uint16)
        if layout.pose:
            row[STATE] = self._array(observation, "pose", (7,), np.float32)
        for name, length in layout.vectors.items():
            row[f"observation.{name}"] = self._array(observation, name, (length,), np.float32)
        width = len(layout.action)
        taken = np.zeros(width, np.float32) if action is None else np.asarray(action, np.float32).reshape(-1)
        if taken.shape != (width,):
            raise DatasetError(f"an action of this recording has {width} numbers; got {taken.size}.")
        row[ACTION], row[ACTION_VALID] = taken.copy(), np.array([action is not None])
        row[REWARD] = np.array([reward], np.float32)
        before = self._rows[DONE][-1][0] if self._pending else False
        row[DONE] = np.array([before if done is None else bool(done)])
        for key, value in row.items():
            if value.dtype == np.float32 and not np.isfinite(value).all():
                raise DatasetError(f"row {self.in_flight} of the episode has a {key} that is not a finite number.")
        return row

    def _array(self, observation, name: str, shape: tuple[int, ...], dtype) -> np.ndarray:
        if name not in observation:
            raise DatasetError(f"this recording has a channel '{name}', which the observation lacks.")
        array = np.asarray(observation[name])
        if array.size != np.prod(shape) or (len(shape) > 1 and array.shape != shape):
            raise DatasetError(f"channel '{name}' of this recording has shape {shape}; got {array.shape}.")
        return np.array(array, dtype).reshape(shape)  # a copy: the encoder reads it later

    def _begin(self) -> None:
        self._staging.mkdir(exist_ok=True)
        if self.layout.rgb:
            self._video = Mp4Writer(self._staging / "video.mp4", self.layout.rgb, self.layout.fps)
        self._table = pq.ParquetWriter(
            self._staging / "data.parquet", self._schema, compression="zstd", compression_level=3, use_dictionary=False
        )

    def _flush(self) -> None:
        """Moves the pending rows into a parquet row group."""
        values = {key: np.stack(column) for key, column in self._rows.items()}
        frame = np.arange(self._flushed, self._flushed + self._pending, dtype=np.int64)
        values["timestamp"] = (frame / self.layout.fps).astype(np.float32)
        values["frame_index"], values["index"] = frame, self.rows + frame
        values["episode_index"] = np.full_like(frame, self.episodes)
        values["task_index"] = np.full_like(frame, self._task)
        columns = [to_arrow(values[field.name], field.type) for field in self._schema]
        assert self._table
        self._table.write_table(pa.Table.from_arrays(columns, schema=self._schema))
        self._parts.append({key: stats.summarise(value) for key, value in values.items()})
        self._flushed += self._pending
        self._pending, self._rows = 0, self._no_rows()

    def _no_rows(self) -> dict[str, list]:
        automatic = ("timestamp", "frame_index", "episode_index", "index", "task_index")
        return {name: [] for name in self._schema.names if name not in automatic}

    # -- committing ---------------------------------------------------------------------------------------------

    def _files(self, episode: int) -> dict[str, str]:
        at = where(episode)
        files = {"data": DATA_PATH.format(**at)}
        if self.layout.rgb:
            files["video"] = VIDEO_PATH.format(video_key=RGB, **at)
        return {**files, "episode": EPISODES_PATH.format(**at)}

    def _commit(self, length: int) -> None:
        number, staged = self.episodes, {"data": self._staging / "data.parquet"}
        assert self._table
        self._table.close()
        self._table = None
        durable.sync_file(staged["data"])
        of_episode = stats.merge(self._parts)
        if self._video:
            self._video.close()
            self._video = None
            staged["video"] = self._staging / "video.mp4"
            of_episode[RGB] = stats.summarise_pictures(np.stack(self._pictures), length)
        staged["episode"] = self._staging / "episode.parquet"
        pq.write_table(self._episode_table(number, length, of_episode), staged["episode"], compression="zstd")
        durable.sync_file(staged["episode"])
        for name, path in self._files(number).items():
            durable.move_into_place(staged[name], self.root / path)
        merged = stats.merge([self._stats, of_episode])
        durable.write_json(self.root / STATS, stats.to_json(merged))
        durable.write_whole(self.root / TASKS, lambda path: pq.write_table(_tasks_table(self._tasks), path))
        durable.write_json(self.root / INFO, self._info(number + 1, self.rows + length))
        self.episodes, self.rows, self._stats = number + 1, self.rows + length, merged

    def _episode_table(self, number: int, length: int, of_episode: dict[str, stats.Summary]) -> pa.Table:
        at = where(number)
        row: dict[str, object] = {"episode_index": number, "tasks": [self._tasks[self._task]], "length": length}
        row |= {f"data/{key}": value for key, value in at.items()}
        row |= {"dataset_from_index": self.rows, "dataset_to_index": self.rows + length}
        if self.layout.rgb:
            row |= {f"videos/{RGB}/{key}": value for key, value in at.items()}
            row |= {f"videos/{RGB}/from_timestamp": 0.0, f"videos/{RGB}/to_timestamp": length / self.layout.fps}
        for feature, summary in stats.to_json(of_episode).items():
            row |= {f"stats/{feature}/{key}": value for key, value in summary.items()}
        row |= {f"meta/episodes/{key}": value for key, value in at.items()}
        return pa.table({name: [value] for name, value in row.items()})

    def _info(self, episodes: int, rows: int) -> dict:
        return {
            "codebase_version": VERSION,
            "robot_type": "terrella",
            "total_episodes": episodes,
            "total_frames": rows,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.layout.fps,
            "splits": {"train": f"0:{episodes}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self.layout.rgb else None,
            "features": self._features,
        }

    # -- giving up ----------------------------------------------------------------------------------------------

    def _nothing_lost(self) -> _NothingLost:
        return _NothingLost(self)

    def _discard(self) -> None:
        """Forgets the episode in flight."""
        if self._video:
            self._video.abandon()
        if self._table:
            try:
                self._table.close()
            except (OSError, pa.ArrowException):
                pass
        self._video, self._table = None, None
        self._rows, self._parts, self._pictures = self._no_rows(), [], []
        self._pending = self._flushed = 0
        shutil.rmtree(self._staging, ignore_errors=True)


class _NothingLost:
    """Turns a failure to write into a DatasetError that says what is safe, after removing the episode in flight."""

    def __init__(self, recorder: Recorder):
        self.recorder = recorder

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind, error, trace) -> None:
        if error is None or not isinstance(error, (OSError, av.FFmpegError, pa.ArrowException)):
            return
        recorder, full = self.recorder, getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        recorder._discard()
        for path in recorder._files(recorder.episodes).values():
            (recorder.root / path).unlink(missing_ok=True)
        why = "the disk is full" if full else f"writing failed ({error})"
        safe = f"{recorder.episodes} episodes ({recorder.rows} frames) are safe there"
        raise DatasetError(f"{why} at {recorder.root}; {safe}: free some space and record again to go on.") from error


def _lock(root: Path):
    handle = open(root / ".lock", "a")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        handle.close()
        raise DatasetError(f"another recorder is writing to {root}; stop it or record to another folder.") from error
    os.set_inheritable(handle.fileno(), False)
    return handle


def _tasks_table(tasks: list[str]) -> pa.Table:
    """tasks.parquet as pandas reads it: indexed by the task's sentence."""
    columns = [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": None,
            "field_name": "__index_level_0__",
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ]
    pandas = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), "__index_level_0__": pa.array(tasks, pa.string())}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
