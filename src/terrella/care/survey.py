"""survey: what a LeRobot v3.0 folder says of itself, read so that one broken file does not hide the others."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
from PIL import Image

from ..core.errors import DatasetError
from ..data.dataset import checked_features
from ..data.episodes import Film, counts_of
from ..data.format import (
    AUTOMATIC,
    DATA_PATH,
    INFO,
    PICTURE,
    TASKS,
    TIME,
    VIDEO_PATH,
    WORLD,
    Layout,
    contained,
    fill,
    inside,
    sensor_from_json,
    tidy,
)
from ..data.source import Sensor
from ..data.storage import boxes
from ..data.storage.tables import read_json
from .tables import open_parquet, read_whole

RESTORE = "restore the file from a copy, or let --repair make a dataset of what is whole"
LEFTOVER = "it was being committed when the recorder was killed: record into the folder again, or delete the file"
_BROKEN = (OSError, pa.ArrowException, ValueError, KeyError, TypeError, OverflowError, AttributeError, DatasetError)
_MOST = 20_000_000  # episodes; more is damage
_LOOKED_AT = 15  # videos of a camera that are asked for their size


@dataclass(frozen=True)
class Fault:
    """file: relative to the dataset; row: of the whole dataset, None where it concerns the file; what and mend: sentences."""

    file: str
    row: int | None
    what: str
    mend: str


@dataclass(frozen=True)
class Told:
    """What meta/episodes tells of an episode: rows [start, stop) of the dataset, in `data`, shown by `films`."""

    number: int
    start: int
    stop: int
    data: str
    films: Mapping[str, Film]
    tasks: tuple[str, ...] = ()
    start_ns: int | None = None
    counts: Mapping[str, int] | None = None

    @property
    def length(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True)
class Survey:
    """What the folder says.

    info, about:  meta/info.json and meta/terrella.json; {} where they cannot be read.
    features:     of info.json; where it cannot be read, as the recording's other files tell.
    fps:          likewise.
    streams:      sensors with clocks of their own.
    told:         number -> episode, as meta/episodes tells; complete says whether all of meta/episodes could be read.
    tasks:        task_index -> its sentence.
    video_path:   the template of its videos' names.
    data, films:  the names of all data files and of all videos.
    faults:       met on the way.
    """

    root: Path
    info: Mapping[str, object]
    about: Mapping[str, object]
    features: dict[str, dict]
    fps: float
    streams: dict[str, Sensor]
    told: dict[int, Told]
    complete: bool
    tasks: dict[int, str]
    video_path: str
    data: list[str]
    films: list[str]
    faults: list[Fault] = field(default_factory=list)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Features that are videos."""
        return tuple(name for name, feature in self.features.items() if feature["dtype"] == "video")

    @property
    def world(self) -> dict:
        """What Terrella's recorder knew of the recorded world."""
        return _mapping(self.about.get("world"))

    @property
    def known(self) -> dict[str, Sensor]:
        """The sensors of the rows as meta/terrella.json tells; those that it tells wrongly are left out."""
        found = {}
        for name, told in _mapping(self.about.get("sensors")).items():
            try:
                found[name] = sensor_from_json(name, told)
            except _BROKEN:
                continue
        return found

    def size(self, camera: str) -> tuple[int, int] | None:
        """(height, width) of the camera's pictures, as most of some of its videos have it."""
        files = [file for file in self.films if camera_of(file, self.video_path) == camera]
        sizes = [_size(self.root, [file]) for file in files[:: max(1, len(files) // _LOOKED_AT)]]
        return max(sizes, key=sizes.count, default=None)

    @property
    def ours(self) -> bool:
        """Whether Terrella's recorder wrote it."""
        return bool(self.about)

    def path(self, name: str) -> Path:
        """Where a file of it lies; DatasetError where the name leads out of the folder."""
        return contained(self.root, name)


def survey(root: str | Path) -> Survey:
    """DatasetError where `root` is no folder, or holds no LeRobot v3.0 dataset, however damaged."""
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"there is no dataset at {root}; name the folder that holds meta/, data/ and videos/.")
    faults: list[Fault] = []
    info = _json(root, INFO, faults, "let --repair make it anew from the rows")
    about = _json(root, WORLD, faults, RESTORE) if (root / WORLD).exists() else {}
    _only_v3(root, info)
    data_path, video_path = _templates(info, faults)
    data, films = listed(root, _top(data_path), ".parquet"), listed(root, _top(video_path), ".mp4")
    if not (info or data or (root / ".staging").exists()):
        raise DatasetError(f"{root} is not a LeRobot v3 dataset: it has neither {INFO} nor data; name another folder.")
    streams = _streams(root, about, faults)
    features, fps = _features(root, info, about, data, films, video_path, faults)
    empty = info.get("total_episodes") == 0 and not data
    told, complete = _episodes(root, features, fps, data_path, video_path, empty, faults)
    tasks = {} if empty else _tasks(root, told, info.get("total_episodes"), faults)
    return Survey(root, info, about, features, fps, streams, told, complete, tasks, video_path, data, films, faults)


def listed(root: Path, folder: str, suffix: str) -> list[str]:
    """Names of the files anywhere under a folder of the dataset, sorted; hidden ones and linked folders are passed over."""
    found = []
    for place, folders, files in os.walk(root / inside(folder) if folder else root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in files:
            if name.endswith(suffix) and not name.startswith("."):
                found.append(Path(place, name).relative_to(root).as_posix())
    return sorted(found)


def _mapping(value: object) -> dict:
    return dict(value) if isinstance(value, dict) else {}


# -- JSON ------------------------------------------------------------------------------------------------------------


def _json(root: Path, name: str, faults: list[Fault], mend: str) -> dict:
    try:
        found = read_json(contained(root, name))
        if not isinstance(found, dict):
            raise ValueError("it is no JSON object")
        return found
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
    found = []
    for key, usual in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
        template = info.get(key) or usual
        try:
            fill(str(template), video_key="camera", chunk_index=0, file_index=0)
        except DatasetError as error:
            faults.append(Fault(INFO, None, f"{key}: {error}", f"set it to {usual}"))
            template = usual
        found.append(str(template))
    return found[0], found[1]


def _top(template: str) -> str:
    """The folder in which all files of a template lie."""
    return template.split("{")[0].rpartition("/")[0]


def _streams(root: Path, about: Mapping, faults: list[Fault]) -> dict[str, Sensor]:
    try:
        found = {name: sensor_from_json(name, told) for name, told in dict(about.get("streams", {})).items()}
        for name in found:
            contained(root, f"streams/{name}")
            if "/" in name:
                raise ValueError(f"'{name[:100]}' is no name")
        if found or about:
            return found
    except _BROKEN as error:
        faults.append(Fault(WORLD, None, f"its streams cannot be read ({error})", RESTORE))
    found = {}
    for file in listed(root, "streams", ".parquet"):  # each table keeps its sensor too
        name = file.split("/")[1]
        if name not in found:
            try:
                with open_parquet(contained(root, file)) as table:
                    found[name] = sensor_from_json(name, json.loads((table.schema_arrow.metadata or {})[b"sensor"]))
            except (*_BROKEN, RecursionError):
                continue
    if found:
        what = f"it does not declare the streams {', '.join(found)}, which lie in streams/"
        faults.append(Fault(WORLD, None, what, "let --repair declare them anew from their tables"))
    return found


# -- features --------------------------------------------------------------------------------------------------------


def _features(
    root: Path, info: Mapping, about: Mapping, data: list[str], films: list[str], video_path: str, faults: list[Fault]
) -> tuple[dict[str, dict], float]:
    features, fps = None, None
    if info:
        try:
            features = checked_features(json.loads(json.dumps(info["features"])))
        except (*_BROKEN, RecursionError) as error:
            faults.append(Fault(INFO, None, f"it lacks {error}", "let --repair make it anew from the rows"))
        try:
            fps = float(info["fps"])
            if not (np.isfinite(fps) and 1e-3 <= fps <= 1e6):
                raise ValueError(f"{fps:g} frames a second are not possible")
        except _BROKEN as error:
            fps = None
            faults.append(Fault(INFO, None, f"fps: {error}", "let --repair find it in the rows' timestamps"))
    if fps is None:
        fps = _rate(root, data, films)
    if features is None:
        features = _found_features(root, about, data, films, video_path, fps)
    return features, fps


def _rate(root: Path, data: list[str], films: list[str]) -> float:
    """As the timestamps of the rows tell; without rows, a video."""
    for name in data:
        try:
            times = read_whole(contained(root, name), ["timestamp"])["timestamp"].to_numpy().astype(np.float64)
            steps = np.diff(times)
            steps = steps[steps > 0]
            if len(steps):
                rate = 1 / float(np.median(steps))
                return tidy(round(rate) if abs(rate - round(rate)) < 0.01 * rate else round(rate, 3))
        except _BROKEN:
            continue
    for name in films:
        try:
            boxes.check(contained(root, name))
            with av.open(str(contained(root, name))) as container:
                return tidy(float(container.streams.video[0].average_rate or Fraction(0)))
        except (*_BROKEN, av.FFmpegError, IndexError):
            continue
    return 1.0


def _found_features(
    root: Path, about: Mapping, data: list[str], films: list[str], video_path: str, fps: float
) -> dict[str, dict]:
    """Without info.json: what meta/terrella.json, the tables and the videos tell."""
    form = _form(root, data)
    try:
        sensors = {name: sensor_from_json(name, told) for name, told in dict(about["sensors"]).items()}
        pictures = "png" if form is not None and PICTURE in form.types else "video"
        return Layout(fps, sensors, clock=form is not None and TIME in form.names, pictures=pictures).features()
    except _BROKEN:
        pass
    return found_features(root, data, films, video_path)


def found_features(root: Path, data: list[str], films: list[str], video_path: str) -> dict[str, dict]:
    """The features that the tables and videos have."""
    form, found = _form(root, data), {}
    for part in form if form is not None else ():
        found |= {part.name: feature} if (feature := _of_column(root, data, part)) else {}
    for name in sorted({camera for file in films if (camera := camera_of(file, video_path))}):
        size = _size(root, [file for file in films if camera_of(file, video_path) == name])
        if size:
            found[name] = {"dtype": "video", "shape": [*size, 3], "names": ["height", "width", "channels"]}
    ordered = [*(name for name in found if name not in AUTOMATIC), *(name for name in AUTOMATIC if name in found)]
    return {name: found[name] for name in ordered}


def _form(root: Path, data: list[str]) -> pa.Schema | None:
    for name in data:
        try:
            with open_parquet(contained(root, name)) as file:
                return file.schema_arrow
        except _BROKEN:
            continue
    return None


def _of_column(root: Path, data: list[str], part: pa.Field) -> dict | None:
    """The feature that a column holds; None where it is none."""
    kind, shape = part.type, []
    while isinstance(kind, pa.BaseExtensionType):
        kind = kind.storage_type
    if pa.types.is_struct(kind):
        size = _picture_size(root, data, part.name)
        names = ["height", "width", "channels"]
        return {"dtype": "image", "shape": [*size, 3], "names": names} if size else None
    while pa.types.is_nested(kind) and hasattr(kind, "value_type"):
        shape.append(kind.list_size if pa.types.is_fixed_size_list(kind) else 0)
        kind = kind.value_type
    if 0 in shape:
        for name in data:
            try:
                first = np.array(read_whole(contained(root, name), [part.name])[part.name][0].as_py())
                shape = list(first.shape)
                break
            except (*_BROKEN, IndexError):
                continue
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return {"dtype": "string", "shape": [1], "names": None}
    try:
        dtype = "bool" if pa.types.is_boolean(kind) else str(np.dtype(kind.to_pandas_dtype()))
    except (NotImplementedError, TypeError):
        return None
    return {"dtype": dtype, "shape": shape or [1], "names": None}


def _picture_size(root: Path, data: list[str], column: str) -> tuple[int, int] | None:
    for name in data:
        try:
            raw = read_whole(contained(root, name), [column])[column][0].as_py()["bytes"]
            with Image.open(io.BytesIO(raw), formats=("PNG", "JPEG", "WEBP")) as image:
                return image.size[1], image.size[0]
        except (*_BROKEN, IndexError):
            continue
    return None


def camera_of(file: str, video_path: str) -> str | None:
    """The camera whose file it is, by the part of its path where the template has the camera's name."""
    parts, pattern = file.split("/"), video_path.split("/")
    at = pattern.index("{video_key}") if "{video_key}" in pattern else None
    return parts[at] if at is not None and len(parts) == len(pattern) else None


def _size(root: Path, files: list[str]) -> tuple[int, int] | None:
    for file in files:
        try:
            boxes.check(contained(root, file))
            with av.open(str(contained(root, file))) as container:
                stream = container.streams.video[0]
                return stream.height, stream.width
        except (*_BROKEN, av.FFmpegError, IndexError):
            continue
    return None


# -- episodes and tasks ----------------------------------------------------------------------------------------------


def _episodes(
    root: Path, features: Mapping[str, dict], fps: float, data_path: str, video_path: str, empty: bool, faults: list
) -> tuple[dict[int, Told], bool]:
    told: dict[int, Told] = {}
    complete = True
    cameras = [name for name, feature in features.items() if feature["dtype"] == "video"]
    files = listed(root, "meta/episodes", ".parquet")
    if not files and not empty:
        faults.append(
            Fault("meta/episodes", None, "there is no table of episodes", "let --repair make it anew from the rows")
        )
        complete = False
    for file in files:
        try:
            for episode in _told(
                read_whole(contained(root, file), _columns(cameras), _MOST), cameras, fps, data_path, video_path
            ):
                told.setdefault(episode.number, episode)
        except _BROKEN as error:
            what = (
                str(error).split(";")[0] if isinstance(error, DatasetError) else f"it is no table of episodes ({error})"
            )
            faults.append(Fault(file, None, what, "let --repair make it anew from the rows"))
            complete = False
    return dict(sorted(told.items())), complete


def _columns(cameras: list[str]) -> list[str]:
    columns = [
        "episode_index",
        "data/chunk_index",
        "data/file_index",
        "dataset_from_index",
        "dataset_to_index",
        "tasks",
    ]
    for name in cameras:
        columns += [f"videos/{name}/{key}" for key in ("chunk_index", "file_index", "from_timestamp")]
    return [*columns, "start_ns", "counts"]


def _told(table: pa.Table, cameras: list[str], fps: float, data_path: str, video_path: str) -> list[Told]:
    missing = set(_columns(cameras)) - set(table.column_names) - {"start_ns", "counts", "tasks"}
    if missing:
        raise ValueError(f"it has no column {sorted(missing)[0]}")
    columns = {name: table[name].to_pylist() for name in table.column_names}
    found = []
    for i in range(len(table)):
        row = {name: column[i] for name, column in columns.items()}
        number, start, stop = (int(row[key]) for key in ("episode_index", "dataset_from_index", "dataset_to_index"))
        if number < 0 or not 0 <= start <= stop:
            raise ValueError(f"episode {number} has rows {start} to {stop}")
        films = {}
        for name in cameras:
            place = {key: int(row[f"videos/{name}/{key}"]) for key in ("chunk_index", "file_index")}
            first = float(row[f"videos/{name}/from_timestamp"])
            if not (np.isfinite(first) and 0 <= first < 1e12):
                raise ValueError(f"the video of episode {number} begins at {first} s")
            films[name] = Film(fill(video_path, video_key=name, **place), round(first * fps))
        data = fill(data_path, **{key: int(row[f"data/{key}"]) for key in ("chunk_index", "file_index")})
        tasks = row.get("tasks")
        tasks = [tasks] if isinstance(tasks, str) else list(tasks or [])
        start_ns = row.get("start_ns")
        start_ns = int(start_ns) if start_ns else None
        found.append(
            Told(number, start, stop, data, films, tuple(map(str, tasks)), start_ns, counts_of(row.get("counts")))
        )
    return found


def _tasks(root: Path, told: Mapping[int, Told], count: object, faults: list[Fault]) -> dict[int, str]:
    """`count`: of the episodes that are safe; the tasks of what a killed commit left beyond them are not missed."""
    try:
        table = read_whole(contained(root, TASKS))
        texts = next((name for name in ("__index_level_0__", "task") if name in table.column_names), None)
        if texts is None:
            raise ValueError("it has no sentences")
        found = {int(at): str(text) for at, text in zip(table["task_index"].to_pylist(), table[texts].to_pylist())}
        safe = [episode for number, episode in told.items() if not isinstance(count, int) or number < count]
        named = {task for episode in safe for task in episode.tasks}
        lost = sorted(named - set(found.values()))
        if lost:
            faults.append(Fault(TASKS, None, f"it lacks the task '{lost[0][:100]}' of meta/episodes", RESTORE))
        return found
    except _BROKEN as error:
        what = str(error).split(";")[0] if isinstance(error, DatasetError) else f"it is no table of tasks ({error})"
        faults.append(Fault(TASKS, None, what, "let --repair make it anew from meta/episodes"))
    return {}
