"""The table of a dataset's episodes: which rows each has, and in which files they lie."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from .format import DATA_PATH, VIDEO_PATH, fill
from .storage.tables import read_whole

if TYPE_CHECKING:
    from .dataset import Dataset

MOST = 20_000_000  # episodes; more is damage
OPTIONAL = ("tasks", "start_ns", "counts")  # columns of meta/episodes that a stranger's recording may lack


@dataclass(frozen=True)
class Film:
    """The pictures of one camera in one episode: frames from `first` on in `file` (relative to the dataset)."""

    file: str
    first: int


@dataclass(frozen=True)
class Episode:
    """Rows [start, stop) of the dataset; `data` (relative to the dataset) holds them, `videos` show them.

    task:     what it is about; `tasks` all of them, where its rows differ.
    start_ns: wall-clock time of its time 0 in nanoseconds since 1970, None where it was not kept.
    counts:   sensor -> rows up to the last that has it, where that is not the last of all; None where it was not kept.
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
        return self.tasks[0] if self.tasks else ""

    @property
    def length(self) -> int:
        return self.stop - self.start

    @property
    def files(self) -> tuple[str, ...]:
        """Every file that holds a part of it, relative to the dataset."""
        return (self.data, *(film.file for film in self.videos.values()))


class EpisodeTable(Sequence[Episode]):
    """All episodes; an Episode is made when it is looked at."""

    def __init__(self, table: pa.Table, data_path: str, video_path: str, cameras: Sequence[str], fps: float):
        self._table, self._cameras, self._fps = table, tuple(cameras), fps
        self._data_path, self._video_path = data_path, video_path
        self.starts, self.stops = (_whole(table, f"dataset_{end}_index") for end in ("from", "to"))
        self._at = {
            name: _whole(table, name) for name in table.column_names if name.endswith(("/chunk_index", "/file_index"))
        }
        self._from = {name: table[f"videos/{name}/from_timestamp"].to_numpy() for name in cameras}
        for seconds in self._from.values():
            if not np.isfinite(seconds).all() or (seconds < 0).any():
                raise ValueError("a video begins at no time")
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
            file = fill(self._video_path, video_key=name, **self._place(f"videos/{name}", index))
            videos[name] = Film(file, round(float(self._from[name][index]) * self._fps))
        tasks, start_ns, counts = (
            self._table[name][index].as_py() if name in self._table.column_names else None for name in OPTIONAL
        )
        tasks = tuple(map(str, [tasks] if isinstance(tasks, str) else tasks or []))
        data = fill(self._data_path, **self._place("data", index))
        start, stop = int(self.starts[index]), int(self.stops[index])
        return Episode(index, start, stop, data, videos, tasks, start_ns or None, counts_of(counts))

    def _place(self, what: str, index: int) -> dict[str, int]:
        return {name: int(self._at[f"{what}/{name}"][index]) for name in ("chunk_index", "file_index")}

    def of_rows(self, rows: np.ndarray) -> np.ndarray:
        """int64 [n]: the episode in which each row lies."""
        return np.searchsorted(self.stops, rows, side="right")


def read_episodes(dataset: Dataset, cameras: Sequence[str], count: int) -> EpisodeTable:
    """The first `count` episodes of meta/episodes; what a killed recorder left beyond them is not looked at.

    cameras: features that are kept as video.
    """
    root = dataset.root
    if count > MOST:
        raise DatasetError(
            f"{root} claims {count:,} episodes, more than can be meant; restore meta/info.json from a copy."
        )
    parts = _read_parts(dataset, cameras, count)
    try:
        table = pa.concat_tables(parts, promote_options="default") if parts else _nothing(columns_of(cameras))
        number = _whole(table, "episode_index")
        _, first = np.unique(number, return_index=True)
        table = table.take(pa.array(first[: min(count, len(first))])).combine_chunks()
        if len(table) != count or not np.array_equal(_whole(table, "episode_index"), np.arange(count)):
            raise ValueError(f"it does not list the {count} episodes of info.json")
        data_path = str(dataset.info.get("data_path") or DATA_PATH)
        video_path = str(dataset.info.get("video_path") or VIDEO_PATH)
        return EpisodeTable(table, data_path, video_path, cameras, dataset.fps)
    except (ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise DatasetError(f"{root}/meta/episodes is damaged ({error}); restore it from a copy.") from error


def columns_of(cameras: Sequence[str]) -> list[str]:
    """The columns of meta/episodes that say where an episode lies."""
    films = [f"videos/{name}/{key}" for name in cameras for key in ("chunk_index", "file_index", "from_timestamp")]
    return ["episode_index", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index", *films]


def read_part(path: Path, cameras: Sequence[str], most_rows: int, more: Sequence[str] = OPTIONAL) -> pa.Table:
    """One table of meta/episodes, with the columns `more` as far as it has them; DatasetError where it is none."""
    columns = columns_of(cameras)
    table = read_whole(path, [*columns, *more], most_rows)
    for name in set(columns) - set(table.column_names):
        raise DatasetError(f"{path} has no column {name}; restore it from a copy.")
    return table


def _read_parts(dataset: Dataset, cameras: Sequence[str], count: int, attempts: int = 3) -> list[pa.Table]:
    """The tables of meta/episodes; listed anew where a recorder has just made one of many."""
    parts = []
    for name in dataset.files.list("meta/episodes", ".parquet"):
        try:
            parts.append(read_part(dataset.files.local(name), cameras, count + 10_000))
        except DatasetError:
            if attempts > 1 and not dataset.files.exists(name):
                return _read_parts(dataset, cameras, count, attempts - 1)
            raise
    return parts


def counts_of(text: object) -> dict[str, int] | None:
    if text is None:
        return None
    try:
        return {str(name): int(count) for name, count in json.loads(str(text)).items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(
            f"meta/episodes tells no counts of an episode's rows ({error}); restore it from a copy."
        ) from error


def _whole(table: pa.Table, name: str) -> np.ndarray:
    column = table[name]
    if column.null_count or not pa.types.is_integer(column.type):
        raise ValueError(f"column {name} does not hold whole numbers")
    return column.to_numpy().astype(np.int64)


def _nothing(columns: list[str]) -> pa.Table:
    types = {name: pa.float64() if name.endswith("from_timestamp") else pa.int64() for name in columns}
    return pa.table({name: pa.array([], kind) for name, kind in types.items()})
