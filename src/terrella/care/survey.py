"""survey: reads the metadata of a LeRobot v3.0 folder file by file, so that one broken file does not hide the others."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import av
import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..data.features import checked_features
from ..data.format import (
    DATA_PATH,
    INFO,
    TASKS,
    VIDEO_PATH,
    WORLD,
    fill_template,
    path_inside,
    sensor_from_json,
    whole_rate,
)
from ..data.meta import MOST, OPTIONAL, Episode, EpisodeTable, read_part, read_task_texts
from ..data.source import Sensor
from ..data.storage import mp4
from ..data.storage.remote import LocalFiles
from ..data.storage.tables import open_parquet, read_json, read_whole
from .features import BROKEN, features_without_info

_BROKEN = (OSError, pa.ArrowException, av.FFmpegError, ValueError, KeyError, TypeError, IndexError, DatasetError)
_FILES = 8  # files of a kind whose rate is measured
_ROWS, _PACKETS = 20_000_000, 256
_SAME = 5e-4  # relative; 29.97 and 30 differ by twice as much
_UNEVEN = 0.05  # share by which a time step may differ from the median
_MOST = 2 / 3  # share of the episodes, or videos, that must agree
RESTORE = "restore the file from a copy, or use --repair, which keeps what is whole"
LEFTOVER = "the recorder was killed while it committed this: record into the folder again, or delete the file"
FROM_ROWS = "use --repair, which makes it from the rows"
_LATEST_S = 1e12  # a video that begins later is damage

Look = tuple[np.ndarray, np.ndarray]  # mean and deviation of each colour of an episode's pictures, float64 [3], in 0..1


@dataclass(frozen=True)
class Fault:
    """One fault of a recording."""

    file: str  # relative to the dataset
    row: int | None  # of the whole dataset; None for a fault of the file
    what: str  # what is wrong, a sentence
    mend: str  # how to mend it, a sentence


@dataclass(frozen=True)
class Survey:
    """The metadata of a folder.

    info, about:  meta/info.json and meta/terrella.json; {} where they cannot be read.
    features:     of info.json; read from the other files where it cannot be read.
    fps:          of info.json, or the rate of rows and videos where these agree on another.
    streams:      sensors with clocks of their own.
    episodes:     by number, as meta/episodes lists them.
    complete:     whether all of meta/episodes could be read.
    looks:        (episode, camera) -> statistics of its pictures when they were recorded.
    tasks:        task_index -> its text.
    video_path:   template of the names of its videos.
    data, films:  names of all data files and of all videos.
    faults:       of these files.
    """

    root: Path
    info: Mapping[str, object]
    about: Mapping[str, object]
    features: dict[str, dict]
    fps: float
    streams: dict[str, Sensor]
    episodes: dict[int, Episode]
    complete: bool
    looks: dict[tuple[int, str], Look]
    tasks: dict[int, str]
    video_path: str
    data: list[str]
    films: list[str]
    faults: list[Fault] = field(default_factory=list)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Features that are videos."""
        return cameras_of(self.features)

    @property
    def world(self) -> dict:
        """Facts of the recorded world, from meta/terrella.json."""
        return _mapping(self.about.get("world"))

    @property
    def known(self) -> dict[str, Sensor]:
        """The sensors of the rows in meta/terrella.json; invalid ones are left out."""
        sensors = {}
        for name, stated in _mapping(self.about.get("sensors")).items():
            with suppress(*BROKEN):
                sensors[name] = sensor_from_json(name, stated)
        return sensors

    @property
    def ours(self) -> bool:
        """Whether Terrella's recorder wrote it."""
        return bool(self.about)

    def path(self, name: str) -> Path:
        """The path of a file; DatasetError where the name leads out of the folder."""
        return path_inside(self.root, name)


def survey(root: str | Path) -> Survey:
    """Reads the metadata; DatasetError where `root` is no folder, or holds no LeRobot v3.0 dataset at all."""
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"there is no dataset at {root}; name the folder that holds meta/, data/ and videos/.")
    faults: list[Fault] = []
    info = read_object(root, INFO, faults, FROM_ROWS)
    about = read_object(root, WORLD, faults, RESTORE) if (root / WORLD).exists() else {}
    _only_v3(root, info)
    data_path, video_path = _templates(info, faults)
    data, films = list_files(root, _top(data_path), ".parquet"), list_files(root, _top(video_path), ".mp4")
    if not (info or data or (root / ".staging").exists()):
        raise DatasetError(f"{root} is not a LeRobot v3 dataset: it has neither {INFO} nor data; name another folder.")
    streams = _streams(root, about, faults)
    fps = _fps(root, info, data, films, faults)
    features = _features(info, faults) or features_without_info(root, about, data, films, video_path, fps)
    empty = info.get("total_episodes") == 0 and not data
    tables, complete = _episode_tables(root, cameras_of(features), empty, faults)
    episodes: dict[int, Episode] = {}
    looks: dict[tuple[int, str], Look] = {}
    for file, table in tables:
        try:
            listed = _episodes(table, file, cameras_of(features), fps, data_path, video_path, faults)
            episodes = {**listed, **episodes}
        except BROKEN as error:
            faults.append(Fault(file, None, _what(error, "table of episodes"), FROM_ROWS))
            complete = False
        with suppress(*BROKEN):
            looks |= _looks(table, cameras_of(features))
    episodes = dict(sorted(episodes.items()))
    tasks = {} if empty else _tasks(root, episodes, info.get("total_episodes"), faults)
    return Survey(
        root, info, about, features, fps, streams, episodes, complete, looks, tasks, video_path, data, films, faults
    )


def cameras_of(features: Mapping[str, dict]) -> tuple[str, ...]:
    """Features that are videos."""
    return tuple(name for name, feature in features.items() if feature["dtype"] == "video")


def list_files(root: Path, folder: str, suffix: str) -> list[str]:
    """Names of the files anywhere under a folder of the dataset, sorted."""
    return LocalFiles(root).list(folder, suffix)


def _mapping(value: object) -> dict:
    return dict(value) if isinstance(value, dict) else {}


# -- JSON ------------------------------------------------------------------------------------------------------------


def read_object(root: Path, name: str, faults: list[Fault], mend: str) -> dict:
    """A JSON object of the dataset; where it cannot be read, {} and one more fault."""
    try:
        value = read_json(path_inside(root, name))
        if not isinstance(value, dict):
            raise ValueError("it is not a JSON object")
        return value
    except FileNotFoundError:
        faults.append(Fault(name, None, "the file is missing", mend))
    except (OSError, ValueError, DatasetError) as error:
        faults.append(Fault(name, None, f"the file cannot be read ({error})", mend))
    return {}


def _only_v3(root: Path, info: Mapping[str, object]) -> None:
    version = str(info.get("codebase_version", "v3.0"))
    if version.removeprefix("v").split(".")[0] != "3" or (not info and (root / "meta/episodes.jsonl").exists()):
        raise DatasetError(
            f"{root} is a LeRobot dataset of version {version[:20] if info else 2}; convert it to v3.0 with LeRobot's "
            "`python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`."
        )


def _templates(info: Mapping[str, object], faults: list[Fault]) -> tuple[str, str]:
    templates = []
    for key, usual in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
        template = info.get(key) or usual
        try:
            fill_template(str(template), video_key="camera", chunk_index=0, file_index=0)
        except DatasetError as error:
            faults.append(Fault(INFO, None, f"{key}: {error}", f"set it to {usual}"))
            template = usual
        templates.append(str(template))
    return templates[0], templates[1]


def _top(template: str) -> str:
    """The folder in which all files of a template lie."""
    return template.split("{")[0].rpartition("/")[0]


def _streams(root: Path, about: Mapping, faults: list[Fault]) -> dict[str, Sensor]:
    try:
        sensors = {name: sensor_from_json(name, stated) for name, stated in dict(about.get("streams", {})).items()}
        for name in sensors:
            path_inside(root, f"streams/{name}")
            if "/" in name:
                raise ValueError(f"'{name[:100]}' is not a valid name")
        if sensors or about:
            return sensors
    except BROKEN as error:
        faults.append(Fault(WORLD, None, f"its streams cannot be read ({error})", RESTORE))
    sensors = {}
    for file in list_files(root, "streams", ".parquet"):  # each table keeps its sensor too
        name = file.split("/")[1]
        if name not in sensors:
            with suppress(*BROKEN, RecursionError), open_parquet(path_inside(root, file)) as table:
                sensors[name] = sensor_from_json(name, json.loads((table.schema_arrow.metadata or {})[b"sensor"]))
    if sensors:
        what = f"it does not declare the streams {', '.join(sensors)}, which lie in streams/"
        faults.append(Fault(WORLD, None, what, "use --repair, which declares them from their tables"))
    return sensors


# -- features and rate -----------------------------------------------------------------------------------------------


def _features(info: Mapping, faults: list[Fault]) -> dict[str, dict] | None:
    if not info:
        return None
    try:
        return checked_features(json.loads(json.dumps(info["features"])))
    except (*BROKEN, RecursionError) as error:
        faults.append(Fault(INFO, None, f"it lacks {error}", FROM_ROWS))
        return None


def _fps(root: Path, info: Mapping, data: list[str], films: list[str], faults: list[Fault]) -> float:
    """The rate in info.json, unless the timestamps of the rows agree on another and no video contradicts them."""
    declared = None
    try:
        declared = float(info["fps"]) if info else None
        if declared is not None and not (np.isfinite(declared) and 1e-3 <= declared <= 1e6):
            what, declared = f"{declared:g} frames a second are not possible", None
            raise ValueError(what)
    except BROKEN as error:
        faults.append(Fault(INFO, None, f"fps: {error}", "use --repair, which takes it from the timestamps"))
    rows, shown = _rate_of_rows(root, data), _rate_of_films(root, films)
    if declared is None:
        return whole_rate(rows or shown or 1.0)
    if rows and not _same(rows, declared) and (shown is None or _same(shown, rows)):
        witnesses = "the timestamps of the rows and the videos run" if shown else "the timestamps of the rows run"
        what = f"fps is {declared:g}, but {witnesses} at {rows:g} frames per second"
        faults.append(Fault(INFO, None, what, f"set fps to {rows:g} there, as --repair does"))
        return whole_rate(rows)
    if shown and not _same(shown, declared):
        what = f"the videos run at {shown:g} frames per second, but {INFO} says {declared:g}"
        mend = "restore the videos from a copy, or encode them again at that rate"
        faults.append(Fault("videos", None, what, mend))
    return declared


def _same(a: float, b: float) -> bool:
    return abs(a / b - 1) < _SAME


def _rate_of_rows(root: Path, data: Sequence[str]) -> float | None:
    rates: list[float | None] = []
    for name in _some(data):
        with suppress(*_BROKEN):
            table = read_whole(path_inside(root, name), ["timestamp"], _ROWS)
            time_s = table["timestamp"].to_numpy().astype(np.float64)
            rates += [_even(each) for each in np.split(time_s, np.flatnonzero(~(np.diff(time_s) > 0)) + 1)[:1000]]
    return _shared([rate for rate in rates if rate])


def _rate_of_films(root: Path, films: Sequence[str]) -> float | None:
    rates = []
    for name in _some(films):
        with suppress(*_BROKEN), mp4.open_video(path_inside(root, name)) as (container, stream):
            packets = (packet.pts for packet, _ in zip(container.demux(stream), range(_PACKETS)))
            ticks = np.sort([pts for pts in packets if pts is not None])
            rates.append(_even(ticks * float(stream.time_base or 0)))
    return _shared([rate for rate in rates if rate])


def _some(names: Sequence[str]) -> Sequence[str]:
    return names[:: max(1, len(names) // _FILES)][:_FILES]


def _even(time_s: np.ndarray) -> float | None:
    """The rate of ascending times [n], Hz; None where most are not evenly spaced."""
    steps = np.diff(time_s)
    if not len(steps) or not np.isfinite(steps).all() or np.median(steps) <= 0:
        return None
    even = np.abs(steps / np.median(steps) - 1) <= _UNEVEN
    return float(even.sum() / steps[even].sum()) if even.mean() >= 0.9 else None


def _shared(rates: list[float]) -> float | None:
    """The rate that most share, rounded to a whole number where it is close to one."""
    if not rates:
        return None
    middle = float(np.median(rates))
    if np.mean([_same(rate, middle) for rate in rates]) < _MOST or not 1e-3 <= middle <= 1e6:
        return None
    return float(round(middle)) if round(middle) and _same(middle, round(middle)) else round(middle, 6)


# -- episodes and tasks ----------------------------------------------------------------------------------------------


def _what(error: Exception, kind: str) -> str:
    return str(error).split(";")[0] if isinstance(error, DatasetError) else f"it is not a {kind} ({error})"


def _episode_tables(
    root: Path, cameras: tuple[str, ...], empty: bool, faults: list[Fault]
) -> tuple[list[tuple[str, pa.Table]], bool]:
    """(file, table) of each table that can be read, and whether all can."""
    more = [*OPTIONAL, "length", *(f"stats/{name}/{key}" for name in cameras for key in ("mean", "std"))]
    files, tables = list_files(root, "meta/episodes", ".parquet"), []
    if not files and not empty:
        faults.append(Fault("meta/episodes", None, "there is no table of episodes", FROM_ROWS))
    for file in files:
        try:
            tables.append((file, read_part(path_inside(root, file), cameras, MOST, more)))
        except BROKEN as error:
            faults.append(Fault(file, None, _what(error, "table of episodes"), FROM_ROWS))
    return tables, len(tables) == len(files) and (bool(files) or empty)


def _episodes(
    table: pa.Table,
    file: str,
    cameras: tuple[str, ...],
    fps: float,
    data_path: str,
    video_path: str,
    faults: list[Fault],
) -> dict[int, Episode]:
    episodes: dict[int, Episode] = {}
    listed = EpisodeTable(table, data_path, video_path, cameras, fps)
    numbers = table["episode_index"].to_pylist()
    lengths = table["length"].to_pylist() if "length" in table.column_names else [None] * len(numbers)
    for episode, number, length in zip(listed, numbers, lengths):
        if number < 0 or any(film.first > _LATEST_S * fps for film in episode.videos.values()):
            raise ValueError(f"episode {number} is none that can be, or its video begins at no possible time")
        episodes.setdefault(number, replace(episode, number=number))
        if length not in (None, episode.length):
            what = f"episode {number} has length {length}, but rows {episode.start} to {episode.stop - 1}"
            mend = f"set its length to {episode.length}, or use --repair, which counts again"
            faults.append(Fault(file, episode.start, what, mend))
    return episodes


def _looks(table: pa.Table, cameras: tuple[str, ...]) -> dict[tuple[int, str], Look]:
    looks = {}
    for name in cameras:
        if f"stats/{name}/mean" in table.column_names and f"stats/{name}/std" in table.column_names:
            means, stds = (table[f"stats/{name}/{key}"].to_pylist() for key in ("mean", "std"))
            for number, mean, std in zip(table["episode_index"].to_pylist(), means, stds):
                look = tuple(np.asarray(each, np.float64).reshape(-1) for each in (mean, std))
                if all(each.shape == (3,) and np.isfinite(each).all() for each in look):
                    looks[number, name] = look
    return looks


def _tasks(root: Path, episodes: Mapping[int, Episode], count: object, faults: list[Fault]) -> dict[int, str]:
    """task_index -> text. `count`: episodes in info.json; tasks of episodes after these (of a killed commit) may be missing."""
    try:
        tasks = read_task_texts(path_inside(root, TASKS))
        safe = [episode for number, episode in episodes.items() if not isinstance(count, int) or number < count]
        lost = sorted({task for episode in safe for task in episode.tasks} - set(tasks.values()))
        if lost:
            faults.append(Fault(TASKS, None, f"it lacks the task '{lost[0][:100]}' of meta/episodes", RESTORE))
        return tasks
    except BROKEN as error:
        mend = "use --repair, which makes it from meta/episodes"
        faults.append(Fault(TASKS, None, _what(error, "table of tasks"), mend))
    return {}
