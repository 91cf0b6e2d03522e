"""Writer: puts whole episodes into a LeRobotDataset v3.0 folder, each in one step that a crash cannot halve."""

import fcntl
import json
import os
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core import files
from ..core.errors import DatasetError
from . import stats
from .channels import NAME
from .format import (
    ACTION_VALID,
    DATA_PATH,
    DEPTH_BEYOND,
    DEPTH_UNIT_M,
    EPISODES_PATH,
    FILES_PER_CHUNK,
    INFO,
    POSE_CONVENTION,
    STATS,
    TASKS,
    VERSION,
    VIDEO_PATH,
    WORLD,
    Layout,
    even_size,
    file_numbers,
    schema,
    sensor_json,
    stream_path,
    to_arrow,
)
from .source import Sensor, is_outcome
from .storage.tables import as_local

ROWS_PER_GROUP = 256
BYTES_PER_GROUP = 1 << 25
_CHECKED = {"compression": "zstd", "write_page_checksum": True}  # a flipped bit is then an error
EPISODES_PER_TABLE = 128  # one-row tables of meta/episodes merged into one: a long dataset then opens quickly


@dataclass(frozen=True)
class Draft:
    """One whole episode, ready to be committed."""

    length: int  # number of rows
    rows: Iterable[Mapping[str, np.ndarray]]
    """Columns, at most ROWS_PER_GROUP rows at a time, without videos and LeRobot's automatic columns. The action of the
    last row is stored as not valid, because its outcome was not recorded."""
    videos: Mapping[str, Path]  # camera -> finished mp4 of `length` frames, in the staging folder of the writer
    pictures: Mapping[str, stats.Summary]  # camera -> statistics of its pictures
    task: str  # the instruction
    streams: Mapping[str, Iterable[tuple[float, np.ndarray | None]]] = field(default_factory=dict)
    """Stream -> its readings (time_s, value) in order; the value is None for cameras."""
    films: Mapping[str, Path] = field(default_factory=dict)  # camera stream -> finished mp4, one frame a reading
    start_ns: int | None = None  # wall-clock time of its time 0, nanoseconds since 1970; None where unknown
    tasks: Sequence[str] = ()  # the instruction of each row, where they differ; else ()
    counts: Mapping[str, int] = field(default_factory=dict)
    """Sensor -> rows up to the last that has it, where that is not the last row."""


class Writer:
    """Writes episodes to the folder `root`, which is new or was written with the same layout; locked until `close`.

    rows, episodes: committed so far. DatasetError where `root` is foreign, damaged, or locked by another writer.
    """

    def __init__(self, root: str | Path, layout: Layout):
        self.root, self.layout = Path(root), layout
        if not 0.001 <= layout.fps <= 100_000:
            raise DatasetError(f"{layout.fps} rows a second are no possible video rate; give 0.001 to 100,000.")
        self.features = layout.features()
        self.schema = schema(self.features)
        self.staging = self.root / ".staging"
        for sensor in [*layout.sensors.values(), *layout.streams.values()]:
            if not NAME.fullmatch(sensor.name):
                raise DatasetError(f"'{sensor.name[:100]}' is no feature name; use letters, digits, '.', '_' and '-'.")
        for sensor in layout.streams.values():
            if sensor.kind == "image":
                even_size(sensor)
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self._lock = lock_folder(self.root)
        except OSError as error:
            raise DatasetError(f"cannot record to {self.root}: {error.strerror}; choose another folder.") from error
        try:
            self._open()
        except BaseException:
            self._lock.close()
            raise

    def close(self) -> None:
        """Unlocks the folder."""
        self._lock.close()

    def put(self, draft: Draft) -> int:
        """Commits an episode and returns its number. Its files move into place; meta/info.json is replaced last."""
        number = self.episodes
        tasks = list(dict.fromkeys([*self._tasks, *(draft.tasks or [draft.task])]))
        rows, of_episode = self._stage_rows(draft, tasks)
        staged = {DATA_PATH.format(**file_numbers(number)): rows}
        of_episode |= {name: {**seen, "count": np.array([draft.length])} for name, seen in draft.pictures.items()}
        for name, file in draft.videos.items():
            staged[VIDEO_PATH.format(video_key=name, **file_numbers(number))] = file
        for name, readings in draft.streams.items():
            staged[stream_path(name, number, "parquet")] = self._stage_stream(self.layout.streams[name], readings)
            if name in draft.films:
                staged[stream_path(name, number, "mp4")] = draft.films[name]
        staged[EPISODES_PATH.format(**file_numbers(number))] = table = self.staging / "episode.parquet"
        pq.write_table(self._episode_table(number, draft, of_episode), as_local(table), **_CHECKED)
        files.sync_file(table)
        for path, file in staged.items():
            files.move_into_place(file, self.root / path)
        merged = stats.merge([self._stats, _without_padding(of_episode, draft.counts)])
        files.write_json(self.root / STATS, stats.to_json(merged), indent=None)
        with files.replacing(self.root / TASKS) as path:
            pq.write_table(tasks_table(tasks), as_local(path), **_CHECKED)
        files.write_json(self.root / INFO, self._info(number + 1, self.rows + draft.length, len(tasks)))
        self.episodes, self.rows, self._stats, self._tasks = number + 1, self.rows + draft.length, merged, tasks
        return number

    def tidy(self, first: int | None = None) -> None:
        """Merges one-row tables of meta/episodes, EPISODES_PER_TABLE at a time, from episode `first` on (None: the newest); a
        failure leaves them as they are."""
        newest = max(0, self.episodes // EPISODES_PER_TABLE - 1) * EPISODES_PER_TABLE
        with suppress(OSError, pa.ArrowException, ValueError, KeyError):  # many small tables are valid, too
            oldest = newest if first is None else first
            for begin in range(oldest, self.episodes - EPISODES_PER_TABLE + 1, EPISODES_PER_TABLE):
                files = [self.root / EPISODES_PATH.format(**file_numbers(begin + i)) for i in range(EPISODES_PER_TABLE)]
                if files[-1].exists():  # the last one that a merge removes
                    _merge_tables([file for file in files if file.exists()], file_numbers(begin))

    def remove_unfinished(self) -> None:
        """Removes files of an episode that was moved into place but not committed."""
        number = self.episodes
        videos = [name for name, feature in self.features.items() if feature["dtype"] == "video"]
        files = [path.format(**file_numbers(number)) for path in (DATA_PATH, EPISODES_PATH)]
        files += [VIDEO_PATH.format(video_key=name, **file_numbers(number)) for name in videos]
        files += [stream_path(name, number, suffix) for name in self.layout.streams for suffix in ("parquet", "mp4")]
        for file in files:
            (self.root / file).unlink(missing_ok=True)

    # -- opening ------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self.rows, self.episodes, self._tasks, self._stats = 0, 0, [], {}
        info = self.root / INFO
        if info.exists():
            try:
                self._reopen(json.loads(info.read_text(encoding="utf-8")))
            except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
                first = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise DatasetError(
                    f"{self.root} is damaged ({first}); see `terrella data doctor {shlex.quote(str(self.root))}`, or record to a "
                    "new folder."
                ) from error
        else:
            strangers = [entry.name for entry in self.root.iterdir() if not entry.name.startswith(".")]
            if strangers not in ([], ["meta"]):
                raise DatasetError(f"{self.root} holds other files ({strangers[0]}, ...); record to an empty folder.")
        self.remove_unfinished()
        self.tidy(first=0)
        if not info.exists():
            facts = {"pose": POSE_CONVENTION, "depth_unit_m": DEPTH_UNIT_M, "depth_beyond": DEPTH_BEYOND}
            layout = self.layout
            stated = {"world": dict(layout.world), "sensors": _json(layout.sensors), "streams": _json(layout.streams)}
            stated |= {"channels": dict(layout.channels)} if layout.channels else {}
            try:
                files.write_json(self.root / WORLD, {**layout.facts, "version": 2, **stated, **facts})
            except (TypeError, ValueError) as error:
                raise DatasetError(f"the facts of {self.root} are no JSON values ({error}); leave them out.") from error
            files.write_json(self.root / INFO, self._info(0, 0, 0))

    def _reopen(self, info: dict) -> None:
        if info.get("codebase_version") != VERSION or not (self.root / WORLD).exists():
            raise DatasetError(f"{self.root} is a dataset that Terrella did not write; record to a new folder.")
        old, new = info["features"], json.loads(json.dumps(self.features))
        world = json.loads((self.root / WORLD).read_text(encoding="utf-8"))
        changed = sorted(name for name in {*old, *new} if old.get(name) != new.get(name))
        for kind, sensors in (("streams", self.layout.streams), ("sensors", self.layout.sensors)):
            now = json.loads(json.dumps(_json(sensors)))
            was = world.get(kind, {} if kind == "streams" else now)  # recordings of version 1 do not state them
            stated = sorted(name for name in {*was, *now} if not _alike(was.get(name), now.get(name)))
            changed += [name for name in stated if name not in changed]
        if changed or info["fps"] != self.layout.fps:
            what = ", ".join(changed) if changed else f"{info['fps']} frames/s"
            raise DatasetError(f"{self.root} was recorded with another layout ({what}); record to a new folder.")
        self.rows, self.episodes = info["total_frames"], info["total_episodes"]
        if self.episodes:
            self._tasks = pq.read_table(as_local(self.root / TASKS)).column("__index_level_0__").to_pylist()
            self._stats = stats.from_json(json.loads((self.root / STATS).read_text(encoding="utf-8")))
            if int(self._stats["index"]["count"][0]) != self.rows:
                self._stats = self._stats_of_episodes()  # the recorder was killed before info.json was replaced

    def _stats_of_episodes(self) -> dict[str, stats.Summary]:
        parts: dict[int, dict[str, stats.Summary]] = {}
        counts: dict[int, dict[str, int]] = {}
        for file in sorted((self.root / "meta" / "episodes").glob("chunk-*/file-*.parquet")):
            for row in pq.read_table(as_local(file)).to_pylist():
                part = parts.setdefault(row["episode_index"], {})
                counts[row["episode_index"]] = json.loads(row.get("counts") or "{}")
                for name, value in row.items():
                    if name.startswith("stats/"):
                        _, feature, key = name.split("/")
                        part.setdefault(feature, {})[key] = np.array(value)
        whole = (_without_padding(parts[number], counts[number]) for number in range(self.episodes))
        return stats.merge(whole)

    # -- files of an episode ------------------------------------------------------------------------------------

    def _stage_rows(self, draft: Draft, tasks: list[str]) -> tuple[Path, dict[str, stats.Summary]]:
        file, done, parts = self.staging / "data.parquet", 0, []
        index = {task: number for number, task in enumerate(tasks)}
        task = np.array([index[each] for each in draft.tasks or [draft.task] * draft.length], np.int64)
        options = {**_CHECKED, "compression_level": 3, "use_dictionary": False}
        with pq.ParquetWriter(as_local(file), self.schema, **options) as table:
            for group in draft.rows:
                columns = dict(group)
                left = range(min(ROWS_PER_GROUP, draft.length - done))
                count = len(next(iter(columns.values()), left))  # a recording of videos alone has no columns
                frame = np.arange(done, done + count, dtype=np.int64)
                done += count
                if done == draft.length and ACTION_VALID in columns:
                    columns[ACTION_VALID] = columns[ACTION_VALID].copy()
                    columns[ACTION_VALID][-1] = False
                columns["timestamp"] = (frame / self.layout.fps).astype(np.float32)
                columns["frame_index"], columns["index"] = frame, self.rows + frame
                columns["episode_index"] = np.full_like(frame, self.episodes)
                columns["task_index"] = task[frame.clip(max=len(task) - 1)]
                arrays = [to_arrow(columns[field.name], field.type) for field in self.schema]
                table.write_table(pa.Table.from_arrays(arrays, schema=self.schema))
                maps = {name for name, sensor in self.layout.rows.items() if sensor.kind == "depth"}
                numbers = {name: value for name, value in columns.items() if value.dtype != object}
                parts.append({name: stats.summarise(value, name in maps) for name, value in numbers.items()})
        if done != draft.length or done != len(task):
            raise DatasetError(f"an episode of {draft.length} rows was given {done} rows.")
        files.sync_file(file)
        return file, stats.merge(parts)

    def _stage_stream(self, sensor: Sensor, readings: Iterable[tuple[float, np.ndarray | None]]) -> Path:
        file = self.staging / f"stream-{sensor.name}.parquet"
        form = stream_schema(sensor)
        with pq.ParquetWriter(as_local(file), form, **_CHECKED) as table:
            readings = iter(readings)
            while group := list(_some(readings)):
                columns: list[pa.Array] = [pa.array([time_s for time_s, _ in group], pa.float64())]
                if sensor.kind != "image":
                    values = [value.reshape(-1) for _, value in group if value is not None]
                    offsets = np.cumsum([0, *map(len, values)])
                    columns.append(pa.LargeListArray.from_arrays(offsets, pa.array(np.concatenate(values))))
                table.write_table(pa.Table.from_arrays(columns, schema=form))
        files.sync_file(file)
        return file

    def _episode_table(self, number: int, draft: Draft, of_episode: dict[str, stats.Summary]) -> pa.Table:
        at, length, tasks = file_numbers(number), draft.length, list(dict.fromkeys(draft.tasks or [draft.task]))
        row: dict[str, object] = {"episode_index": number, "tasks": tasks, "length": length}
        row |= {f"data/{key}": value for key, value in at.items()}
        row |= {"dataset_from_index": self.rows, "dataset_to_index": self.rows + length}
        for name in draft.videos:
            row |= {f"videos/{name}/{key}": value for key, value in at.items()}
            row |= {f"videos/{name}/from_timestamp": 0.0, f"videos/{name}/to_timestamp": length / self.layout.fps}
        for feature, summary in stats.to_json(of_episode).items():
            row |= {f"stats/{feature}/{key}": value for key, value in summary.items()}
        row |= {f"meta/episodes/{key}": value for key, value in at.items()}
        row |= {"counts": json.dumps(dict(draft.counts))}
        # With its type: for each value whose type it infers, PyArrow looks for pandas again where there is none.
        form = pa.struct([(name, _type_of(value)) for name, value in row.items()])
        table = pa.Table.from_batches([pa.RecordBatch.from_struct_array(pa.array([row], form))])
        return table.append_column("start_ns", pa.array([draft.start_ns], pa.int64()))

    def _info(self, episodes: int, rows: int, tasks: int) -> dict:
        return {
            "codebase_version": VERSION, "robot_type": self.layout.robot, "total_episodes": episodes,
            "total_frames": rows, "total_tasks": tasks, "chunks_size": FILES_PER_CHUNK, "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200, "fps": self.layout.fps, "splits": {"train": f"0:{episodes}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if any(f["dtype"] == "video" for f in self.features.values()) else None,
            "features": self.features,
        }  # fmt: skip


def _type_of(value: object) -> pa.DataType:
    """The type that PyArrow infers of an int, a float, a string, or a list of one of them."""
    if isinstance(value, list):
        return pa.list_(_type_of(value[0]) if value else pa.null())
    return {int: pa.int64(), float: pa.float64(), str: pa.string()}[type(value)]


def _without_padding(of_episode: Mapping[str, stats.Summary], counts: Mapping[str, int]) -> dict[str, stats.Summary]:
    """The statistics of an episode without those of observations that it has no reading of."""
    return {name: it for name, it in of_episode.items() if is_outcome(name) or counts.get(name) != 0}


def _merge_tables(tables: Sequence[Path], at: Mapping[str, int]) -> None:
    """Merges tables of episodes into the first; after a killed merge, the first has some of the rows already."""
    table = pa.concat_tables([pq.ParquetFile(as_local(file)).read() for file in tables], promote_options="default")
    table = table.take(np.unique(table["episode_index"].to_numpy(), return_index=True)[1])
    for key, value in at.items():
        place = table.schema.get_field_index(f"meta/episodes/{key}")
        table = table.set_column(place, f"meta/episodes/{key}", pa.array(np.full(len(table), value, np.int64)))
    with files.replacing(tables[0]) as path:
        pq.write_table(table, as_local(path), **_CHECKED)
    for file in tables[1:]:
        file.unlink()


def stream_schema(sensor: Sensor) -> pa.Schema:
    """The schema of a stream's table: its times and, for all but cameras (which have an mp4), its flattened values; with the
    Sensor in the metadata, in case meta/terrella.json is lost."""
    fields = [pa.field("time_s", pa.float64())]
    if sensor.kind != "image":
        dtype = "uint16" if sensor.kind == "depth" else sensor.dtype
        fields.append(pa.field("value", pa.large_list(pa.from_numpy_dtype(np.dtype(dtype)))))
    return pa.schema(fields, metadata={"sensor": json.dumps(sensor_json(sensor))})


def lock_folder(root: Path):
    """The folder's lock, held until it is closed; DatasetError where another writer holds it."""
    handle = open(root / ".lock", "a")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        handle.close()
        raise DatasetError(f"another recorder is writing to {root}; stop it or record to another folder.") from error
    os.set_inheritable(handle.fileno(), False)
    return handle


def fresh_folder(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def group_columns(rows: Iterable[Mapping[str, np.ndarray]]) -> Iterator[dict[str, np.ndarray]]:
    """Single rows as columns of at most ROWS_PER_GROUP, and of about BYTES_PER_GROUP."""
    rows = iter(rows)
    while group := list(_some(rows)):
        yield _columns(group)


def _some(items: Iterator) -> Iterator:
    """The next items that make one group of rows."""
    room = BYTES_PER_GROUP
    for _ in range(ROWS_PER_GROUP):
        if room <= 0 or (item := next(items, None)) is None:
            return
        values = item.values() if isinstance(item, Mapping) else item
        room -= sum(value.nbytes if isinstance(value, np.ndarray) else 8 for value in values)
        yield item


def _columns(rows: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    columns = {}
    for name, value in rows[0].items():
        values = [row[name] for row in rows]
        if isinstance(value, np.ndarray) and value.dtype != object:
            columns[name] = np.stack(values)
        else:
            column = np.empty(len(values), object)
            column[:] = values
            columns[name] = column
    return columns


def _alike(was: Mapping | None, now: Mapping | None) -> bool:
    """Whether a sensor is the same as before; units and frame may have been unknown then."""
    if was is None or now is None:
        return was is now
    return all(was.get(key) == value or (key in ("units", "frame") and not was.get(key)) for key, value in now.items())


def _json(sensors: Mapping[str, Sensor]) -> dict:
    return {name: sensor_json(sensor) for name, sensor in sensors.items()}


def tasks_table(tasks: list[str]) -> pa.Table:
    """tasks.parquet as pandas reads it: indexed by the task's sentence."""
    index, keys = "__index_level_0__", ("name", "field_name", "pandas_type", "numpy_type", "metadata")
    columns = [("task_index", "task_index", "int64", "int64", None), (None, index, "unicode", "object", None)]
    stated = {"index_columns": [index], "column_indexes": [], "columns": [dict(zip(keys, one)) for one in columns]}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps({**stated, "pandas_version": "2.0.0"})})
