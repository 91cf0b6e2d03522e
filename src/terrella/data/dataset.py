"""Dataset: reads LeRobotDataset v3.0 folders, Terrella's own and others', near or far, as plain arrays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from ..core.spec import Camera, kind_of
from .channels import ACTION, DONE, REWARD, RGB, cameras_of, channel_of
from .features import checked_features, decoded, metres, sensors_of, shown, unit_of
from .format import ACTION_VALID, DEPTH_BEYOND, INFO, TIME, names_of, stream_path, to_numpy
from .meta import Episode, EpisodeTable, read_about, read_episodes, read_info, read_sensors, read_tasks
from .source import Lazy, Readings, Sensor, Source, Take, follows, is_action
from .storage import mp4
from .storage.remote import Files, LocalFiles, open_files
from .storage.tables import RowsOf, ValuesOf, read_rows, read_whole

TASK = "task_index"
_FIXED = {
    "action": ACTION,
    "action_valid": ACTION_VALID,
    "reward": REWARD,
    "done": DONE,
    "task": TASK,
}  # array -> feature


class Dataset:
    """A recording. DatasetError where the folder is missing, foreign, of another version, or a file is broken.

    `root` is a folder, or the address of one ("hf://…", "s3://…"): its files are then fetched as they are needed.

    info:         meta/info.json.
    features:     its features.
    sensors:      the same as Sensors, without those that every LeRobot dataset has.
    streams:      sensors with clocks of their own, kept next to the rows.
    cameras:      names of the features that are pictures.
    channels:     channel of a World ("rgb", "rgb.wrist", "depth", "pose", "health", …) -> feature that holds it.
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
        self.info = read_info(self.root, self.files)
        try:
            self.features: dict[str, dict] = checked_features(self.info["features"])
            self.fps = float(self.info["fps"])
            self.length, count = int(self.info["total_frames"]), int(self.info["total_episodes"])
            if not (math.isfinite(self.fps) and self.fps > 0 and self.length >= 0 and count >= 0):
                raise ValueError("a sensible fps, total_frames or total_episodes")
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise DatasetError(f"{self.root / INFO} lacks {error}: it is not a whole LeRobot v3 info.json.") from error
        self.about = read_about(self.root, self.files)
        self.world: dict = self.about.get("world", {})
        self.sensors = sensors_of(self.features, read_sensors(self.root, self.about, "sensors"))
        self.streams = read_sensors(self.root, self.about, "streams")
        videos = [name for name, sensor in self.sensors.items() if self.features[name]["dtype"] == "video"]
        self.episodes: EpisodeTable = read_episodes(self.root, self.files, self.info, videos, count)
        self._look_for_depth()
        self.cameras = tuple(name for name, sensor in self.sensors.items() if sensor.kind == "image")
        self.rgb_key = RGB if RGB in self.cameras else (self.cameras[0] if self.cameras else None)
        self.channels = self._channels()
        self._array = {"depth": self.channels.get("depth"), "pose": self.channels.get("pose"), **_FIXED}

    @cached_property
    def tasks(self) -> tuple[str, ...]:
        """The texts of the tasks by their number ("task_index")."""
        return read_tasks(self.root, self.files)

    @cached_property
    def camera_models(self) -> dict[str, Camera]:
        """channel -> Camera: intrinsics, size, and the pose channel that it is mounted on; {} where nobody said."""
        size = self.sensors[self.rgb_key].shape[:2] if self.rgb_key else (1, 1)
        return cameras_of(self.world, size)

    @property
    def action_names(self) -> tuple[str, ...]:
        feature = self.features.get(ACTION, {"shape": [0], "names": None})
        return names_of(feature) or tuple(f"action_{i}" for i in range(feature["shape"][0]))

    def has(self, name: str) -> bool:
        """Whether episodes have the array `name` (rgb, depth, pose, action, action_valid, reward, done), or a channel."""
        if name == "action_valid":
            return any(map(is_action, self.features))
        return name in self.channels

    def feature(self, name: str) -> str | None:
        """The feature that an array, a channel or a feature's own name means; None where the recording has none such."""
        if name in self.features:
            return name
        meant = (_FIXED.get(name), self.channels.get(name), self.channels.get(channel_of(name)))
        return next((feature for feature in meant if feature in self.features), None)

    def episode(self, number: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The arrays of one episode of T rows: `names` (arrays, channels or features), or all but the cameras other than "rgb".

        rgb uint8 [T, H, W, 3]; depth float32 [T, h, w] metres (65.535 = beyond range); pose float32 [T, 7];
        action float32 [T, A]; action_valid bool [T]; reward float32 [T]; done bool [T]; other features by their key
        (cameras as rgb, other depth as depth, texts as objects, the rest as stored).
        """
        episode = self._episode(number)
        known = [name for name in ("rgb", *self._array) if self.has(name)]
        taken = {self.feature(name) for name in known}
        extra = [key for key in self.sensors if key not in taken]
        wanted = [*known, *(key for key in extra if key not in self.cameras)] if names is None else list(names)
        for name in wanted:
            if self.feature(name) is None and name != "action_valid":
                raise DatasetError(f"{self.root} has no '{name}'; it has {', '.join([*known, *extra])}.")
        return self._columns(episode, wanted)

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
        pictures = self._pictures(episode, camera)
        return (pictures[i] for i in range(first, first + count))

    def rgb_at(self, indices: Sequence[int] | np.ndarray, camera: str | None = None) -> np.ndarray:
        """Full-resolution pictures uint8 [n, H, W, 3] of any rows of the dataset, in the order asked."""
        wanted, camera = np.asarray(indices, dtype=np.int64).reshape(-1), self._camera(camera)
        if wanted.size and not (0 <= wanted.min() and wanted.max() < self.length):
            raise DatasetError(f"row {wanted.max()} was asked of {self.root}, which has rows 0 to {self.length - 1}.")
        result = np.empty((len(wanted), *self.sensors[camera].shape), np.uint8)
        numbers = self.episodes.of_rows(wanted)
        for number in np.unique(numbers):
            episode, inside = self.episodes[int(number)], np.flatnonzero(numbers == number)
            rows, back = np.unique(wanted[inside] - episode.start, return_inverse=True)
            pictures = self._pictures(episode, camera)
            result[inside] = np.stack([pictures[int(row)] for row in rows])[back]
        return result

    def time_s(self, number: int) -> np.ndarray:
        """float64 [T]: the true time of each row in seconds since the episode began; row / fps where none was kept."""
        episode = self._episode(number)
        if TIME in self.features:
            return self._columns(episode, [TIME])[TIME].reshape(-1).astype(np.float64)
        return np.arange(episode.length) / self.fps

    def readings(self, number: int, name: str) -> Readings:
        """What a sensor or stream read in one episode, at its true times; [] where it read nothing."""
        if name not in self.streams and name not in self.sensors:
            there = ", ".join(dict.fromkeys([*self.streams, *self.sensors])) or "none"
            raise DatasetError(f"{self.root} has no sensor '{name}'; it has {there}.")
        if name in self.streams:
            stream = self._stream(number, self.streams[name])
            if len(stream.time_s) or name not in self.sensors:
                return stream
        return self._of_rows(self._episode(number), name, self.time_s(number))  # it has the rows' times

    def source(self) -> Source:
        """This recording as every format is read: sensors at the rows' times, streams at their own."""
        sensors = {**self.sensors, **self.streams}
        rate = None if self.streams or TIME in self.features else self.fps
        ours = ("version", "sensors", "streams", "channels", "terminal", "pose", "depth_unit_m", "depth_beyond")
        facts = {key: value for key, value in self.about.items() if key not in ours}
        takes = Lazy(len(self.episodes), self._take)
        return Source(self.name, sensors, lambda: takes, rate, str(self.info.get("robot_type") or ""), (), facts)

    # -- one episode ---------------------------------------------------------------------------------------------

    def _take(self, number: int) -> Take:
        episode, at = self._episode(number), self.time_s(number)
        readings = {name: self._of_rows(episode, name, at) for name in self.sensors}
        streams = {name: self._stream(number, sensor) for name, sensor in self.streams.items()}
        readings |= {name: stream for name, stream in streams.items() if len(stream.time_s)}
        readings = {name: one for name, one in readings.items() if len(one.time_s)}
        facts = {"language": self._language(episode, at)} if len(episode.tasks) > 1 else {}
        return Take(readings, episode.task, episode.start_ns, facts)

    def _of_rows(self, episode: Episode, name: str, at: np.ndarray) -> Readings:
        """What a sensor read in the rows, whose times are `at`."""
        sensor, there = self.sensors[name], self._there(episode, name)
        if not there.any():
            return Readings(np.zeros(0), [])
        if sensor.kind == "vector":
            return Readings(at[there], self._stored(episode, [name])[name][there])
        rows, stored = np.flatnonzero(there), self._pictures(episode, name)

        def look(i: int) -> np.ndarray:
            value = stored[int(rows[i])]
            return metres(value.reshape(sensor.shape), sensor) if sensor.kind == "depth" else value

        return Readings(at[there], Lazy(len(rows), look))

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
        number = self._stored(episode, [TASK])[TASK].reshape(-1)
        changes = [0, *(np.flatnonzero(np.diff(number)) + 1)]
        texts = dict(enumerate(self.tasks))
        return [[float(at[row]), texts.get(int(number[row]), "")] for row in changes]

    def _pictures(self, episode: Episode, name: str) -> Sequence[np.ndarray]:
        """An image or depth sensor's rows as they are stored, each decoded when it is looked at."""
        sensor = self.sensors[name]
        if name in episode.videos:
            film = episode.videos[name]
            path, deep = self.files.local(film.file), sensor.kind == "depth"
            return mp4.Frames(path, film.first, episode.length, self.fps, deep)
        stored = RowsOf(self.files.local(episode.data), name, episode.start, episode.stop, self.features)
        if self.features[name]["dtype"] != "image":
            return stored
        return Lazy(episode.length, lambda i: shown(stored[i], sensor))

    def _stream(self, number: int, sensor: Sensor) -> Readings:
        name = stream_path(sensor.name, number, "parquet")
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
            film = self.files.local(stream_path(sensor.name, number, "mp4"))
            return Readings(time_s, mp4.Frames(film, 0, len(time_s), sensor.rate_hz or self.fps))
        stored = ValuesOf(path, "value", len(time_s))
        shape = (-1, sensor.shape[1]) if sensor.kind == "points" else sensor.shape

        def value(i: int) -> np.ndarray:
            try:
                numbers = stored[i].reshape(shape)
            except ValueError as error:
                raise DatasetError(f"{self.root / name}: reading {i} is not of shape {shape}; restore it.") from error
            return metres(numbers, sensor) if sensor.kind == "depth" else numbers

        values = Lazy(len(time_s), value)
        if sensor.kind == "vector" and len(time_s):
            return Readings(time_s, np.stack(list(values)).astype(sensor.dtype, copy=False))
        return Readings(time_s, values)

    def _episode(self, number: int) -> Episode:
        if not 0 <= number < len(self.episodes):
            raise DatasetError(f"{self.root} has episodes 0 to {len(self.episodes) - 1}, no episode {number}.")
        return self.episodes[number]

    def _camera(self, name: str | None) -> str:
        found = self.rgb_key if name is None else self.feature(name)
        if found is None or found not in self.cameras:
            raise DatasetError(
                f"{self.root} has no pictures{f' {name}' if name else ''}; it has {', '.join(self.features)}."
            )
        return found

    def _channels(self) -> dict[str, str]:
        stated, found = {feature: channel for channel, feature in self.about.get("channels", {}).items()}, {}
        main = {"rgb": self.rgb_key} if self.rgb_key else {}
        for name, sensor in self.sensors.items():
            channel = stated.get(name) or channel_of(name, sensor.names)
            kind = {"image": "rgb", "depth": "depth"}.get(sensor.kind)
            if kind and kind_of(channel) != kind:  # a stranger's own way of naming it
                channel = f"{kind}.{name.rsplit('.', 1)[-1]}"
                main.setdefault(kind, name)
            found.setdefault(channel, name)
        return {**main, **found}

    def _look_for_depth(self) -> None:
        """Makes depth of image features of one channel that prove to have 16 bits, though nothing says that they are depth."""
        for name, sensor in self.sensors.items():
            feature = self.features[name]
            grey = feature["dtype"] == "image" and feature["shape"][2] == 1
            if sensor.kind == "image" and grey and len(self.episodes):
                with suppress(DatasetError):  # whoever reads it gets an error
                    first = self._table(self.episodes[0], [name])[name]
                    if len(first) and decoded(first[0].as_py(), sensor.shape, name).ndim == 2:
                        self.sensors[name] = replace(sensor, kind="depth", shape=sensor.shape[:2], dtype="float32")

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
        stored = {name: self.feature(name) for name in names}
        columns = dict.fromkeys(key for key in stored.values() if key is not None)
        pictured = [key for key in columns if self.features[key]["dtype"] in ("image", "video")]
        there = self._stored(episode, [key for key in columns if key not in pictured])
        there |= {key: np.stack(list(self._pictures(episode, key))) for key in pictured}
        found = {}
        for name, key in stored.items():
            if key is None:  # action_valid of a stranger's recording: what follows the last row is unknown
                found[name] = np.arange(episode.length) < episode.length - 1
            else:
                found[name] = _as_promised(name, there[key], self.sensors.get(key))
        return found


def _as_promised(name: str, array: np.ndarray, sensor: Sensor | None) -> np.ndarray:
    if sensor is not None and sensor.kind == "depth":
        flat = array.reshape(len(array), *sensor.shape)
        return metres(flat, sensor, beyond=DEPTH_BEYOND * unit_of(sensor))
    if name in ("reward", "done", "action_valid"):
        return array.reshape(-1).astype(np.float32 if name == "reward" else bool)
    return array.astype(np.float32) if name in ("pose", "action") else array
