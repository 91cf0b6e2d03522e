"""Dataset: reads LeRobotDataset v3.0 folders, Terrella's own and others', near or far, as plain arrays."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from ..core.errors import DatasetError
from .episodes import Episode, EpisodeTable, read_episodes
from .format import (
    ACTION,
    ACTION_VALID,
    DEPTH,
    DEPTH_BEYOND,
    DEPTH_UNIT_M,
    DONE,
    INFO,
    POSE_NAMES,
    REWARD,
    RGB,
    STATE,
    STREAM_PATH,
    TASKS,
    TIME,
    WORLD,
    names_of,
    schema,
    sensor_from_json,
    sensors_of,
    to_numpy,
    where,
)
from .resample import resample
from .source import Lazy, Readings, Sensor, Source, Take, follows, is_action
from .storage import mp4
from .storage.remote import Files, LocalFiles, open_files
from .storage.tables import RowsOf, ValuesOf, read_json, read_rows, read_whole

# array name -> feature that holds it
COLUMNS = {
    "depth": DEPTH,
    "pose": STATE,
    "action": ACTION,
    "action_valid": ACTION_VALID,
    "reward": REWARD,
    "done": DONE,
}
_PICTURES = ("PNG", "JPEG", "WEBP")
_BOMBS = (Image.DecompressionBombError, Image.DecompressionBombWarning)
_WIDEST = 1 << 27  # numbers in one row of one feature; more is damage


class Dataset:
    """A recording. DatasetError where the folder is missing, foreign, of another version, or a file is broken.

    `root` is a folder, or the address of one ("hf://…", "s3://…"): its files are then fetched as they are needed.

    info:         meta/info.json.
    features:     its features.
    sensors:      the same as Sensors, without those that every LeRobot dataset has.
    streams:      sensors with clocks of their own, kept beside the rows.
    cameras:      names of the features that are pictures.
    fps:          rows a second.
    length:       rows in all.
    episodes:     a sequence of Episode.
    action_names: one per number of an action.
    world:        what Terrella's recorder knew of the recorded world (name, camera, keys, ...); {} for others.
    about:        meta/terrella.json; {} for others.
    """

    def __init__(self, root: str | Path | LocalFiles | Files):
        self.files = open_files(root) if isinstance(root, str | Path) else root
        self.root = Path(root if isinstance(root, str | Path) else root.root)
        self.name = str(root).rstrip("/").rsplit("/", 1)[-1]
        self.info = _read_info(self)
        try:
            self.features: dict[str, dict] = checked_features(self.info["features"])
            self.fps = float(self.info["fps"])
            self.length, count = int(self.info["total_frames"]), int(self.info["total_episodes"])
            if not (math.isfinite(self.fps) and self.fps > 0 and self.length >= 0 and count >= 0):
                raise ValueError("a sensible fps, total_frames or total_episodes")
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise DatasetError(f"{self.root / INFO} lacks {error}: it is not a whole LeRobot v3 info.json.") from error
        self.about = _read_about(self)
        self.world: dict = self.about.get("world", {})
        known = _read_sensors(self, "sensors")
        self.sensors = sensors_of(self.features, known)
        self.streams = _read_sensors(self, "streams")
        self.cameras = tuple(name for name, sensor in self.sensors.items() if sensor.kind == "image")
        self.rgb_key = RGB if RGB in self.cameras else (self.cameras[0] if self.cameras else None)
        self.episodes: EpisodeTable = read_episodes(self, count)

    @property
    def action_names(self) -> tuple[str, ...]:
        feature = self.features.get(ACTION, {"shape": [0], "names": None})
        return names_of(feature) or tuple(f"action_{i}" for i in range(feature["shape"][0]))

    def has(self, name: str) -> bool:
        """Whether episodes have the array `name` (rgb, depth, pose, action, action_valid, reward, done)."""
        if name == "rgb":
            return self.rgb_key is not None
        if name == "pose":
            return names_of(self.features.get(STATE, {})) == POSE_NAMES
        if name == "action_valid":
            return any(map(is_action, self.features))
        return COLUMNS[name] in self.features

    def episode(self, number: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The arrays of one episode of T rows: `names`, or all but the cameras other than "rgb".

        rgb uint8 [T, H, W, 3]; depth float32 [T, h, w] metres (65.535 = beyond range); pose float32 [T, 7];
        action float32 [T, A]; action_valid bool [T]; reward float32 [T]; done bool [T]; other features by their key
        (cameras as rgb, other depth as depth, the rest as stored).
        """
        episode = self._episode(number)
        known = [name for name in ("rgb", *COLUMNS) if self.has(name)]
        taken = {COLUMNS[name] for name in known if name != "rgb"}
        extra = [key for key in self.features if key.startswith("observation.") and key not in taken]
        numeric = [key for key in extra if key not in self.cameras]
        wanted = [*known, *numeric] if names is None else list(names)
        for name in wanted:
            if name not in known and name not in self.features:
                raise DatasetError(f"{self.root} has no '{name}'; it has {', '.join([*known, *extra])}.")
        pictures = [name for name in wanted if name == "rgb" or name in self.cameras]
        found = self._columns(episode, [name for name in wanted if name not in pictures])
        for name in pictures:
            found[name] = np.stack(list(self.frames(number, None if name == "rgb" else name)))
        return {name: found[name] for name in wanted}

    def frames(
        self, number: int, camera: str | None = None, first: int = 0, count: int | None = None
    ) -> Iterator[np.ndarray]:
        """The pictures of one episode, one after another: uint8 [H, W, 3]; of the first camera, or of `camera`.

        Those of `count` rows from row `first` of the episode on; of all that follow without `count`.
        """
        episode, camera = self._episode(number), self._camera(camera)
        count = episode.length - first if count is None else count
        if not 0 <= first <= first + count <= episode.length:
            raise DatasetError(
                f"episode {number} of {self.root} has {episode.length} rows, not {first} to {first + count}."
            )
        if camera in episode.videos:
            path, begin = self._film(episode, camera)
            return iter(mp4.frames(path, begin + first, count, self.fps)) if count else iter(())
        shape = tuple(self.features[camera]["shape"])
        pictures = self._table(episode, [camera])[camera]
        return (decoded(pictures[i].as_py(), shape, camera) for i in range(first, first + count))

    def rgb_at(self, indices: Sequence[int] | np.ndarray, camera: str | None = None) -> np.ndarray:
        """Full-resolution pictures uint8 [n, H, W, 3] of any rows of the dataset, in the order asked."""
        wanted, camera = np.asarray(indices, dtype=np.int64).reshape(-1), self._camera(camera)
        if wanted.size and not (0 <= wanted.min() and wanted.max() < self.length):
            raise DatasetError(f"row {wanted.max()} was asked of {self.root}, which has rows 0 to {self.length - 1}.")
        result = np.empty((len(wanted), *self.features[camera]["shape"]), np.uint8)
        numbers = self.episodes.of_rows(wanted)
        for number in np.unique(numbers):
            episode, inside = self.episodes[int(number)], np.flatnonzero(numbers == number)
            rows, back = np.unique(wanted[inside] - episode.start, return_inverse=True)
            if camera in episode.videos:
                path, first = self._film(episode, camera)
                result[inside] = mp4.frames_at(path, (rows + first).tolist(), self.fps)[back]
            else:
                table = self._table(episode, [camera])[camera]
                shape = result.shape[1:]
                result[inside] = np.stack([decoded(table[int(row)].as_py(), shape, camera) for row in rows])[back]
        return result

    def time_s(self, number: int) -> np.ndarray:
        """float64 [T]: the true time of each row in seconds since the episode began; row / fps where none was kept."""
        episode = self._episode(number)
        if TIME in self.features:
            return self._columns(episode, [TIME])[TIME].reshape(-1).astype(np.float64)
        return np.arange(episode.length) / self.fps

    def readings(self, number: int, name: str) -> Readings:
        """What a sensor or stream read in one episode, at its true times; [] where it read nothing."""
        if name in self.streams:
            return self._stream(number, self.streams[name])
        return self._take(number).readings[name]

    def aligned(
        self,
        number: int,
        name: str,
        policy: Literal["previous", "nearest", "linear"] = "previous",
        max_gap_s: float | None = None,
    ) -> tuple[Sequence | np.ndarray, np.ndarray]:
        """A stream's readings brought to the rows of an episode: (values of T rows, valid bool [T]), as `resample` says."""
        if name not in self.streams:
            raise DatasetError(f"{self.root} has no stream '{name}'; it has {', '.join(self.streams) or 'none'}.")
        return resample(
            self._stream(number, self.streams[name]), self.streams[name], self.time_s(number), policy, max_gap_s
        )

    def source(self) -> Source:
        """This recording as every format is read: sensors at the rows' times, streams at their own."""
        sensors = {**self.sensors, **self.streams}

        rate = None if self.streams or TIME in self.features else self.fps
        ours = ("version", "sensors", "streams", "terminal", "pose", "depth_unit_m", "depth_beyond")
        facts = {key: value for key, value in self.about.items() if key not in ours}
        takes = Lazy(len(self.episodes), self._take)
        return Source(self.name, sensors, lambda: takes, rate, str(self.info.get("robot_type") or ""), (), facts)

    # -- one episode ---------------------------------------------------------------------------------------------

    def _take(self, number: int) -> Take:
        episode, at = self._episode(number), self.time_s(number)
        readings: dict[str, Readings] = {}
        for name, sensor in self.sensors.items():
            there = self._there(episode, name)
            if not there.any():
                continue
            if sensor.kind == "image":
                values = self._pictures(episode, name)
            elif sensor.kind == "depth":
                stored = RowsOf(self.files.local(episode.data), name, episode.start, episode.stop, self.features)
                values = Lazy(episode.length, lambda i, stored=stored: _metres(stored[i]))
            else:
                values = self._stored(episode, [name])[name]
            if not there.all():
                rows = np.flatnonzero(there)
                values = values[rows] if isinstance(values, np.ndarray) else _chosen(values, rows)
            readings[name] = Readings(at[there], values)
        for name, sensor in self.streams.items():
            stream = self._stream(number, sensor)
            if len(stream.time_s):
                readings[name] = stream
        facts = {"language": self._language(episode, at)} if len(episode.tasks) > 1 else {}
        return Take(readings, episode.task, episode.start_ns, facts)

    def _there(self, episode: Episode, name: str) -> np.ndarray:
        """bool [T]: the rows in which a sensor was read; the rest is padding."""
        row, length = np.arange(episode.length), episode.length
        if not follows(name) or ACTION_VALID not in self.features:
            return row < (episode.counts or {}).get(name, length)
        acted = self._stored(episode, [ACTION_VALID])[ACTION_VALID].reshape(-1).astype(bool)
        if episode.counts is None:  # recorded by version 1: a terminal observation, after which nothing followed
            return acted
        count = episode.counts.get(name, length)
        return (row < count) & (acted | (row == length - 1)) if is_action(name) else row < count

    def _language(self, episode: Episode, at: np.ndarray) -> list[list]:
        """[[time_s, text], ...]: what is being done from each time on, in an episode whose rows have several tasks."""
        table = read_whole(self.files.local(TASKS))
        name = next((name for name in ("__index_level_0__", "task") if name in table.column_names), None)
        if name is None or "task_index" not in table.column_names:
            raise DatasetError(f"{self.root / TASKS} is no table of tasks; see `terrella data doctor {self.root}`.")
        texts = dict(zip(table["task_index"].to_pylist(), table[name].to_pylist()))
        number = self._stored(episode, ["task_index"])["task_index"].reshape(-1)
        changes = [0, *(np.flatnonzero(np.diff(number)) + 1)]
        return [[float(at[row]), str(texts.get(int(number[row]), ""))] for row in changes]

    def _pictures(self, episode: Episode, camera: str) -> Sequence[np.ndarray]:
        if camera in episode.videos:
            path, first = self._film(episode, camera)
            return mp4.Frames(path, first, episode.length, self.fps)
        stored = RowsOf(self.files.local(episode.data), camera, episode.start, episode.stop, self.features)
        shape = tuple(self.features[camera]["shape"])
        return Lazy(episode.length, lambda i: decoded(stored[i], shape, camera))

    def _stream(self, number: int, sensor: Sensor) -> Readings:
        name = STREAM_PATH.format(name=sensor.name, suffix="parquet", **where(number))
        if not self.files.exists(name):
            return Readings(np.zeros(0), np.zeros((0, *sensor.shape), sensor.dtype))
        path = self.files.local(name)
        try:
            time_s = read_whole(path, ["time_s"])["time_s"].to_numpy().astype(np.float64)
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{self.root / name} has no times; see `terrella data doctor {self.root}`.") from error
        if not np.isfinite(time_s).all() or (np.diff(time_s) < 0).any():
            raise DatasetError(f"{self.root / name}: its times do not ascend; see `terrella data doctor {self.root}`.")
        if sensor.kind == "image":
            film = self.files.local(STREAM_PATH.format(name=sensor.name, suffix="mp4", **where(number)))
            return Readings(time_s, mp4.Frames(film, 0, len(time_s), sensor.rate_hz or self.fps))
        stored = ValuesOf(path, "value", len(time_s))
        shape = (-1, sensor.shape[1]) if sensor.kind == "points" else sensor.shape

        def value(i: int) -> np.ndarray:
            try:
                numbers = stored[i].reshape(shape)
            except ValueError as error:
                raise DatasetError(f"{self.root / name}: reading {i} is not of shape {shape}; restore it.") from error
            return _metres(numbers) if sensor.kind == "depth" else numbers

        values = Lazy(len(time_s), value)
        if sensor.kind == "vector" and len(time_s):
            return Readings(time_s, np.stack(list(values)).astype(sensor.dtype, copy=False))
        return Readings(time_s, values)

    def _episode(self, number: int) -> Episode:
        if not 0 <= number < len(self.episodes):
            raise DatasetError(f"{self.root} has episodes 0 to {len(self.episodes) - 1}, no episode {number}.")
        return self.episodes[number]

    def _camera(self, name: str | None) -> str:
        name = self.rgb_key if name is None else name
        if name is None or name not in self.cameras:
            raise DatasetError(
                f"{self.root} has no pictures{f' {name}' if name else ''}; it has {', '.join(self.features)}."
            )
        return name

    def _film(self, episode: Episode, camera: str) -> tuple[Path, int]:
        film = episode.videos[camera]
        return self.files.local(film.file), film.first

    def _table(self, episode: Episode, columns: list[str]):
        return read_rows(self.files.local(episode.data), columns, episode.start, episode.stop, self.features)

    def _stored(self, episode: Episode, names: list[str]) -> dict[str, np.ndarray]:
        """Columns as they are stored, [T, *shape]."""
        table, found = self._table(episode, names), {}
        for name in names:
            try:
                found[name] = to_numpy(table[name], tuple(self.features[name]["shape"]))
            except (ValueError, TypeError, NotImplementedError) as error:
                raise DatasetError(
                    f"{self.root / episode.data}: column '{name}' is not what info.json says ({error})."
                ) from error
        return found

    def _columns(self, episode: Episode, names: list[str]) -> dict[str, np.ndarray]:
        stored = {name: COLUMNS.get(name, name) for name in names}
        there = self._stored(episode, [key for key in stored.values() if key in self.features])
        found = {}
        for name, key in stored.items():
            if key not in there:  # action_valid of a stranger's recording: what follows the last row is unknown
                found[name] = np.arange(episode.length) < episode.length - 1
            else:
                found[name] = _as_promised(name, there[key], self.sensors.get(key))
        return found


def _as_promised(name: str, array: np.ndarray, sensor: Sensor | None) -> np.ndarray:
    if sensor is not None and sensor.kind == "depth":
        return array.astype(np.float32) * np.float32(DEPTH_UNIT_M)
    if name in ("reward", "done", "action_valid"):
        return array.reshape(-1).astype(np.float32 if name == "reward" else bool)
    return array.astype(np.float32) if name in ("pose", "action") else array


def _chosen(values: Sequence, rows: np.ndarray) -> Lazy:
    return Lazy(len(rows), lambda i: values[int(rows[i])])


def _metres(stored: np.ndarray) -> np.ndarray:
    metres = stored.astype(np.float32) * np.float32(DEPTH_UNIT_M)
    return np.where(stored == DEPTH_BEYOND, np.float32(np.inf), metres)


def decoded(picture: Mapping | None, shape: tuple[int, ...], camera: str) -> np.ndarray:
    """A picture kept as bytes, uint8 [H, W, 3]."""
    try:
        with Image.open(io.BytesIO((picture or {})["bytes"]), formats=_PICTURES) as image:
            if image.size != (shape[1], shape[0]):
                raise ValueError(f"it has {image.size[1]}x{image.size[0]} pixels, {shape[0]}x{shape[1]} are promised")
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, KeyError, TypeError, SyntaxError, *_BOMBS) as error:
        raise DatasetError(f"a picture of {camera} cannot be read ({error}); restore its file from a copy.") from error


def checked_features(features: object) -> dict[str, dict]:
    """The features of an info.json; ValueError where they are none."""
    if not isinstance(features, dict) or not 0 < len(features) <= 10_000:
        raise ValueError("features")
    for name, feature in features.items():
        shape: list = (feature.get("shape") if isinstance(feature, dict) else None) or []
        whole = isinstance(shape, list) and 0 < len(shape) <= 5 and all(type(n) is int and n > 0 for n in shape)
        if not whole or not isinstance(feature.get("dtype"), str):
            raise ValueError(f"a dtype and shape of feature '{name[:100]}'")
        if math.prod(shape) > _WIDEST:
            raise ValueError(f"a possible shape of feature '{name[:100]}' ({math.prod(shape):,} numbers a row)")
        if feature["dtype"] in ("video", "image"):
            if len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):  # some write channels first
                feature["shape"] = shape = [shape[1], shape[2], shape[0]]
            if len(shape) != 3 or shape[2] != 3:
                raise ValueError(f"height, width and 3 channels of camera '{name[:100]}'")
    schema(features)
    return features


def _read_info(dataset: Dataset) -> dict:
    root, files = dataset.root, dataset.files
    make_one = f"record one with `terrella record doom --out {root}`"
    if not files.exists(INFO):
        if isinstance(files, LocalFiles) and not root.is_dir():
            raise DatasetError(f"there is no dataset at {root}; {make_one}.")
        if files.exists("meta/episodes.jsonl"):
            raise DatasetError(f"{root} has no {INFO}; it looks like a damaged LeRobot v2 dataset.")
        raise DatasetError(f"{root} is not a LeRobot dataset (it has no {INFO}); {make_one} in a new folder.")
    path = files.local(INFO)
    try:
        info: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        version = str(info["codebase_version"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{root / INFO} is not a LeRobot info.json ({error}); restore it from a copy.") from error
    if version.removeprefix("v").split(".")[0] != "3":
        raise DatasetError(
            f"{root} is a LeRobot dataset of version {version[:20]} and v3.0 is read here; convert it with LeRobot's "
            "`python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`."
        )
    return info


def _read_about(dataset: Dataset) -> dict:
    if not dataset.files.exists(WORLD):
        return {}
    path = dataset.files.local(WORLD)
    try:
        about: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        return {**about, "world": dict(about["world"])}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{dataset.root / WORLD} is not readable ({error}); restore it from a copy.") from error


def _read_sensors(dataset: Dataset, kind: str) -> dict[str, Sensor]:
    try:
        return {name: sensor_from_json(name, told) for name, told in dict(dataset.about.get(kind, {})).items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{dataset.root / WORLD} is not readable ({error}); restore it from a copy.") from error
