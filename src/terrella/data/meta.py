"""Reads the folder meta/ of a dataset: its facts, tasks and episodes."""

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from .format import DATA_PATH, INFO, TASKS, VIDEO_PATH, WORLD, fill_template, sensor_from_json
from .source import Sensor
from .storage.remote import Files, LocalFiles
from .storage.tables import read_json, read_whole


def read_info(root: Path, files: LocalFiles | Files) -> dict:
    """meta/info.json; DatasetError where there is none, or it is of another version."""
    make_one = f"record one with `terrella record world ENVIRONMENT --out {shlex.quote(str(root))}`"
    if not files.exists(INFO):
        if isinstance(files, LocalFiles) and not root.is_dir():
            raise DatasetError(f"there is no dataset at {root}; {make_one}.")
        if files.exists("meta/episodes.jsonl"):
            raise DatasetError(f"{root} has no {INFO}; it looks like a damaged LeRobot v2 dataset.")
        raise DatasetError(f"{root} is not a LeRobot dataset (it has no {INFO}); {make_one} in a new folder.")
    path = files.local(INFO)
    with _readable(root / INFO):
        info: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        version = str(info["codebase_version"])
    if version.removeprefix("v").split(".")[0] != "3":
        raise DatasetError(
            f"{root} is a LeRobot dataset of version {version[:20]} and v3.0 is read here; convert it with LeRobot's "
            "`python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`."
        )
    return info


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"{path} is not readable ({error}); restore it from a copy.") from error


def read_about(root: Path, files: LocalFiles | Files) -> dict:
    """meta/terrella.json; {} where there is none."""
    if not files.exists(WORLD):
        return {}
    path = files.local(WORLD)
    with _readable(root / WORLD):
        about: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        channels = {str(name): str(feature) for name, feature in dict(about.get("channels", {})).items()}
        return {**about, "world": dict(about["world"]), "channels": channels}


def read_sensors(root: Path, about: Mapping, kind: str) -> dict[str, Sensor]:
    """The Sensors under a key ("sensors", "streams") of meta/terrella.json."""
    with _readable(root / WORLD):
        return {name: sensor_from_json(name, stated) for name, stated in dict(about.get(kind, {})).items()}


def read_tasks(root: Path, files: LocalFiles | Files) -> tuple[str, ...]:
    """The texts of meta/tasks.parquet by task_index, "" for a missing number; () without that table."""
    if not files.exists(TASKS):
        return ()
    with _readable(root / TASKS):
        texts = read_task_texts(files.local(TASKS))
    return tuple(texts.get(number, "") for number in range(max(texts, default=-1) + 1))


def read_task_texts(path: Path) -> dict[int, str]:
    """task_index -> text, of a table of tasks; DatasetError or ValueError where it is not one."""
    table = read_whole(path)
    texts = next((name for name in ("__index_level_0__", "task") if name in table.column_names), None)
    if texts is None or "task_index" not in table.column_names:
        raise ValueError("it is not a table of tasks")
    numbers = table["task_index"].to_pylist()
    if not all(isinstance(number, int) and 0 <= number < len(numbers) + 1_000_000 for number in numbers):
        raise ValueError("a task_index is not a valid number")
    return {number: str(text) for number, text in zip(numbers, table[texts].to_pylist())}


MOST = 20_000_000  # most episodes; more is damage
OPTIONAL = ("tasks", "start_ns", "counts")  # columns of meta/episodes that other writers may lack


@dataclass(frozen=True)
class Film:
    """The pictures of one camera in one episode: frames of `file` (relative to the dataset) from number `first` on."""

    file: str
    first: int


@dataclass(frozen=True)
class Episode:
    """Rows [start, stop) of the dataset; `data` (relative to the dataset) holds them, `videos` show them.

    tasks:    its instructions; more than one where its rows differ.
    start_ns: wall-clock time of its time 0, nanoseconds since 1970; None where unknown.
    counts:   sensor -> rows up to the last that has it, where that is not the last row; None where unknown.
    """

    number: int
    start: int
    stop: int
    data: str
    videos: Mapping[str, Film] = field(default_factory=dict)
    tasks: tuple[str, ...] = ()
    start_ns: int | None = None
    counts: Mapping[str, int] | None = None

    @property
    def task(self) -> str:
        """The first instruction; "" for none."""
        return self.tasks[0] if self.tasks else ""

    @property
    def absent(self) -> tuple[str, ...]:
        """The sensors that it has no reading of: what its rows hold of them is padding."""
        return tuple(name for name, count in (self.counts or {}).items() if count == 0)

    @property
    def length(self) -> int:
        """Number of rows."""
        return self.stop - self.start

    @property
    def files(self) -> tuple[str, ...]:
        """The files that hold its rows and videos, relative to the dataset."""
        return (self.data, *(film.file for film in self.videos.values()))


class EpisodeTable(Sequence[Episode]):
    """All episodes; an Episode is made when it is read."""

    def __init__(self, table: pa.Table, data_path: str, video_path: str, cameras: Sequence[str], fps: float):
        self._table, self._cameras, self._fps = table, tuple(cameras), fps
        self._data_path, self._video_path = data_path, video_path
        self.starts, self.stops = (_whole(table, f"dataset_{end}_index") for end in ("from", "to"))
        numbers = [name for name in table.column_names if name.endswith(("/chunk_index", "/file_index"))]
        self._at = {name: _whole(table, name) for name in numbers}
        self._from = {name: table[f"videos/{name}/from_timestamp"].to_numpy() for name in cameras}
        for seconds in self._from.values():
            if not np.isfinite(seconds).all() or (seconds < 0).any():
                raise ValueError("the start of a video is not a valid time")
        if (self.starts < 0).any() or (self.stops < self.starts).any():
            raise ValueError("an episode ends before it starts")

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, index: int) -> Episode:  # type: ignore[override]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index = int(index) % len(self)
        videos = {}
        for name in self._cameras:
            file = fill_template(self._video_path, video_key=name, **self._place(f"videos/{name}", index))
            videos[name] = Film(file, round(float(self._from[name][index]) * self._fps))
        tasks, start_ns, counts = (
            self._table[name][index].as_py() if name in self._table.column_names else None for name in OPTIONAL
        )
        tasks = tuple(map(str, [tasks] if isinstance(tasks, str) else tasks or []))
        data = fill_template(self._data_path, **self._place("data", index))
        start, stop = int(self.starts[index]), int(self.stops[index])
        return Episode(index, start, stop, data, videos, tasks, start_ns or None, counts_of(counts))

    def _place(self, what: str, index: int) -> dict[str, int]:
        return {name: int(self._at[f"{what}/{name}"][index]) for name in ("chunk_index", "file_index")}

    def of_rows(self, rows: np.ndarray) -> np.ndarray:
        """int64 [n]: the episode in which each row lies."""
        return np.searchsorted(self.stops, rows, side="right")


def read_episodes(
    root: Path, files: LocalFiles | Files, info: Mapping, cameras: Sequence[str], count: int
) -> EpisodeTable:
    """The first `count` episodes of meta/episodes; rows that a killed recorder left after them are ignored. info: meta/info.json;
    cameras: the features that are stored as video."""
    if count > MOST:
        raise DatasetError(f"{root} claims {count:,} episodes, more than possible; restore meta/info.json from a copy.")
    parts = _read_parts(files, cameras, count)
    try:
        table = pa.concat_tables(parts, promote_options="default") if parts else _nothing(columns_of(cameras))
        _, first = np.unique(_whole(table, "episode_index"), return_index=True)
        table = table.take(pa.array(first[: min(count, len(first))])).combine_chunks()
        if len(table) != count or not np.array_equal(_whole(table, "episode_index"), np.arange(count)):
            raise ValueError(f"it does not list the {count} episodes of info.json")
        data_path = str(info.get("data_path") or DATA_PATH)
        video_path = str(info.get("video_path") or VIDEO_PATH)
        return EpisodeTable(table, data_path, video_path, cameras, float(info["fps"]))
    except (ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise DatasetError(f"{root}/meta/episodes is damaged ({error}); restore it from a copy.") from error


def columns_of(cameras: Sequence[str]) -> list[str]:
    """The columns of meta/episodes that locate an episode."""
    films = [f"videos/{name}/{key}" for name in cameras for key in ("chunk_index", "file_index", "from_timestamp")]
    return ["episode_index", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index", *films]


def read_part(path: Path, cameras: Sequence[str], most_rows: int, more: Sequence[str] = OPTIONAL) -> pa.Table:
    """One table of meta/episodes, with those of the columns `more` that it has; DatasetError where it is damaged."""
    columns = columns_of(cameras)
    table = read_whole(path, [*columns, *more], most_rows)
    for name in set(columns) - set(table.column_names):
        raise DatasetError(f"{path} has no column {name}; restore it from a copy.")
    return table


def _read_parts(files: LocalFiles | Files, cameras: Sequence[str], count: int, attempts: int = 3) -> list[pa.Table]:
    """The tables of meta/episodes; listed again where a recorder has just merged some."""
    parts = []
    for name in files.list("meta/episodes", ".parquet"):
        try:
            parts.append(read_part(files.local(name), cameras, count + 10_000))
        except DatasetError:
            if attempts > 1 and not files.exists(name):
                return _read_parts(files, cameras, count, attempts - 1)
            raise
    return parts


def counts_of(text: object) -> dict[str, int] | None:
    with _readable(Path("meta/episodes")):
        return None if text is None else {str(name): int(count) for name, count in json.loads(str(text)).items()}


def _whole(table: pa.Table, name: str) -> np.ndarray:
    column = table[name]
    if column.null_count or not pa.types.is_integer(column.type):
        raise ValueError(f"column {name} does not hold whole numbers")
    return column.to_numpy().astype(np.int64)


def _nothing(columns: list[str]) -> pa.Table:
    types = {name: pa.float64() if name.endswith("from_timestamp") else pa.int64() for name in columns}
    return pa.table({name: pa.array([], kind) for name, kind in types.items()})
