"""Dataset: reads any LeRobotDataset v3.0, local or remote, as plain arrays."""

import math
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from ..core.spec import Camera, kind_of
from .channels import ACTION, DONE, REWARD, RGB, cameras_of, channel_of
from .features import PERSISTENT, checked_features, decode_picture, sensors_of, to_metres, to_picture, unit_of
from .format import ACTION_VALID, DEPTH_BEYOND, INFO, TIME, names_of, stream_path, to_numpy
from .meta import Episode, EpisodeTable, read_about, read_episodes, read_info, read_sensors, read_tasks
from .source import Lazy, Readings, Sensor, Source, Take, is_action, is_outcome
from .storage import mp4
from .storage.remote import Files, LocalFiles, open_files
from .storage.tables import RowsOf, ValuesOf, read_rows, read_whole

TASK = "task_index"
_FIXED = {  # array -> feature
    "action": ACTION, "action_valid": ACTION_VALID, "reward": REWARD, "done": DONE, "task": TASK,
}  # fmt: skip


class Dataset:
    """A recording, for reading.

        dataset = Dataset("recordings/arm")            # or "hf://datasets/USER/NAME", "s3://BUCKET/NAME"
        rows = dataset.episode(0, ["rgb", "action"])   # rgb uint8 [T, H, W, 3], action float32 [T, A]

    info:         meta/info.json.
    features:     its features.
    sensors:      its features as Sensors, without the automatic ones of every LeRobot dataset.
    streams:      sensors with a clock of their own, stored beside the rows.
    cameras:      names of the features that are pictures.
    channels:     channel of a World ("rgb", "rgb.wrist", "depth", "pose", "health", …) -> feature that holds it.
    fps:          rows a second.
    length:       number of rows.
    episodes:     a sequence of Episode.
    action_names: one name for each number of an action.
    world:        facts of the recorded world (name, camera, keys, ...); {} where Terrella did not record it.
    about:        meta/terrella.json; {} without one.

    The files of a remote recording are fetched when they are read. DatasetError where the folder is missing, foreign or of
    another version, or a file is damaged.
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
        """The texts of the tasks, by task_index."""
        return read_tasks(self.root, self.files)

    @cached_property
    def camera_models(self) -> dict[str, Camera]:
        """channel -> Camera (intrinsics, size, mount); {} where they are unknown."""
        size = self.sensors[self.rgb_key].shape[:2] if self.rgb_key else (1, 1)
        return cameras_of(self.world, size)

    @property
    def action_names(self) -> tuple[str, ...]:
        """One name for each number of an action."""
        feature = self.features.get(ACTION, {"shape": [0], "names": None})
        return names_of(feature) or tuple(f"action_{i}" for i in range(feature["shape"][0]))

    def has(self, name: str) -> bool:
        """Whether episodes have an array (rgb, depth, pose, action, action_valid, reward, done) or a channel of this name."""
        return any(map(is_action, self.features)) if name == "action_valid" else name in self.channels

    def feature(self, name: str) -> str | None:
        """The feature that `name` (an array, a channel or a feature) means; None for none."""
        if name in self.features:
            return name
        meant = (_FIXED.get(name), self.channels.get(name), self.channels.get(channel_of(name)))
        return next((feature for feature in meant if feature in self.features), None)

    def episode(self, number: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The arrays of one episode of T rows. None reads all but further cameras.

        names: arrays, channels or features. rgb is uint8 [T, H, W, 3]; depth float32 [T, h, w], metres (65.535 is beyond
        range); pose float32 [T, 7]; action float32 [T, A]; action_valid bool [T]; reward float32 [T]; done bool [T].
        Other cameras are as rgb, other depth as depth, texts are objects; other features are as stored.
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
        """The pictures of one episode, one by one, uint8 [H, W, 3]; `camera` None takes the main camera.

        Gives `count` pictures from row `first` of the episode on; None gives all the rest.
        """
        episode, camera = self._episode(number), self._camera(camera)
        count = episode.length - first if count is None else count
        if not 0 <= first <= first + count <= episode.length:
            raise DatasetError(f"episode {number} has {episode.length} rows, not {first} to {first + count}.")
        pictures = self._pictures(episode, camera)
        return (pictures[i] for i in range(first, first + count))

    def rgb_at(self, indices: Sequence[int] | np.ndarray, camera: str | None = None) -> np.ndarray:
        """Full-resolution pictures, uint8 [n, H, W, 3], of any rows of the dataset, in the order of `indices`."""
        wanted, camera = np.asarray(indices, dtype=np.int64).reshape(-1), self._camera(camera)
        if wanted.size and not (0 <= wanted.min() and wanted.max() < self.length):
            raise DatasetError(f"{self.root} has rows 0 to {self.length - 1}, no row {wanted.max()}.")
        result = np.empty((len(wanted), *self.sensors[camera].shape), np.uint8)
        numbers = self.episodes.of_rows(wanted)
        for number in np.unique(numbers):
            episode, inside = self.episodes[int(number)], np.flatnonzero(numbers == number)
            rows, back = np.unique(wanted[inside] - episode.start, return_inverse=True)
            pictures = self._pictures(episode, camera)
            result[inside] = np.stack([pictures[int(row)] for row in rows])[back]
        return result

    def time_s(self, number: int) -> np.ndarray:
        """float64 [T]: the time of each row in seconds since the episode began; row / fps where none was recorded."""
        episode = self._episode(number)
        if TIME in self.features:
            return self._columns(episode, [TIME])[TIME].reshape(-1).astype(np.float64)
        return np.arange(episode.length) / self.fps

    def readings(self, number: int, name: str) -> Readings:
        """The readings of a sensor or stream in one episode, at their own times; empty where it has none."""
        if name not in self.streams and name not in self.sensors:
            sensors = ", ".join(dict.fromkeys([*self.streams, *self.sensors])) or "none"
            raise DatasetError(f"{self.root} has no sensor '{name}'; it has {sensors}.")
        if name in self.streams:
            stream = self._stream(number, self.streams[name])
            if len(stream.time_s) or name not in self.sensors:
                return stream
        return self._of_rows(self._episode(number), name, self.time_s(number))  # at the times of the rows

    @property
    def embodiment(self) -> str:
        """The body that its actions drove: the recorded world's, else LeRobot's robot_type; "" where neither is known."""
        return str(self.world.get("embodiment") or self.world.get("name") or self.info.get("robot_type") or "")

    def source(self) -> Source:
        """The recording as a Source: sensors at the times of the rows, streams at their own."""
        sensors = {**self.sensors, **self.streams}
        rate = None if self.streams or TIME in self.features else self.fps
        ours = ("version", "sensors", "streams", "channels", "terminal", "pose", "depth_unit_m", "depth_beyond")
        facts = {key: value for key, value in self.about.items() if key not in ours}
        takes = Lazy(len(self.episodes), self._take)
        return Source(self.name, sensors, lambda: takes, rate, self.embodiment, (), facts)

    # -- one episode ---------------------------------------------------------------------------------------------

    def _take(self, number: int) -> Take:
        episode, at = self._episode(number), self.time_s(number)
        readings = {name: self._of_rows(episode, name, at) for name in self.sensors}
        streams = {name: self._stream(number, sensor) for name, sensor in self.streams.items()}
        readings |= {name: stream for name, stream in streams.items() if len(stream.time_s)}
        readings = {name: one for name, one in readings.items() if len(one.time_s)}
        language = self._language(episode, at) if len(episode.tasks) > 1 else self._subtasks(episode)
        facts = {"language": language} if language else {}
        return Take(readings, episode.task, episode.start_ns, facts)

    def _of_rows(self, episode: Episode, name: str, at: np.ndarray) -> Readings:
        """The readings of a sensor in the rows, whose times are `at`."""
        sensor, valid = self.sensors[name], self._valid_rows(episode, name)
        if not valid.any():
            return Readings(np.zeros(0), [])
        if sensor.kind == "vector":
            return Readings(at[valid], self._stored(episode, [name])[name][valid])
        rows, stored = np.flatnonzero(valid), self._pictures(episode, name)

        def look(i: int) -> np.ndarray:
            value = stored[int(rows[i])]
            return to_metres(value.reshape(sensor.shape), sensor) if sensor.kind == "depth" else value

        return Readings(at[valid], Lazy(len(rows), look))

    def _valid_rows(self, episode: Episode, name: str) -> np.ndarray:
        """bool [T]: the rows in which a sensor has a reading; the others are padding."""
        row, length = np.arange(episode.length), episode.length
        if not is_outcome(name) or ACTION_VALID not in self.features:
            return row < (episode.counts or {}).get(name, length)
        acted = self._stored(episode, [ACTION_VALID])[ACTION_VALID].reshape(-1).astype(bool)
        if episode.counts is None:  # recorded by version 1: the last row is a terminal observation
            return acted
        count = episode.counts.get(name, length)
        return (row < count) & (acted | (row == length - 1)) if is_action(name) else row < count

    def _language(self, episode: Episode, at: np.ndarray) -> list[list]:
        """[[time_s, text], ...]: the instruction from each time on, of an episode with several tasks."""
        number = self._stored(episode, [TASK])[TASK].reshape(-1)
        changes = [0, *(np.flatnonzero(np.diff(number)) + 1)]
        texts = dict(enumerate(self.tasks))
        return [[float(at[row]), texts.get(int(number[row]), "")] for row in changes]

    def _subtasks(self, episode: Episode) -> list[list]:
        """The same of LeRobot's annotation of subtasks, which each row repeats; [] without."""
        if PERSISTENT not in self.info["features"] or not episode.length:
            return []
        path, kind = self.files.local(episode.data), {PERSISTENT: {"dtype": "string", "shape": [1]}}
        try:
            notes = read_rows(path, [PERSISTENT], episode.start, episode.start + 1, kind)[PERSISTENT][0].as_py() or []
            spoken = [[float(one["timestamp"]), str(one["content"])] for one in notes if one["style"] == "subtask"]
        except (LookupError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{self.root / episode.data}: the annotations in {PERSISTENT} are damaged ({error})."
            ) from error
        return sorted(spoken)

    def _pictures(self, episode: Episode, name: str) -> Sequence[np.ndarray]:
        """The rows of an image or depth sensor as stored, each decoded when it is read."""
        sensor = self.sensors[name]
        if name in episode.videos:
            film = episode.videos[name]
            path, deep = self.files.local(film.file), sensor.kind == "depth"
            return mp4.Frames(path, film.first, episode.length, self.fps, deep)
        stored = RowsOf(self.files.local(episode.data), name, episode.start, episode.stop, self.features)
        if self.features[name]["dtype"] != "image":
            return stored
        return Lazy(episode.length, lambda i: to_picture(stored[i], sensor))

    def _stream(self, number: int, sensor: Sensor) -> Readings:
        name = stream_path(sensor.name, number, "parquet")
        if not self.files.exists(name):
            return Readings(np.zeros(0), np.zeros((0, *sensor.shape), sensor.dtype))
        path = self.files.local(name)
        doctor = f"`terrella data doctor {shlex.quote(str(self.root))}`"
        try:
            time_s = read_whole(path, ["time_s"])["time_s"].to_numpy().astype(np.float64)
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{self.root / name} has no times; see {doctor}.") from error
        if not np.isfinite(time_s).all() or (np.diff(time_s) < 0).any():
            raise DatasetError(f"{self.root / name}: its times do not ascend; see {doctor}.")
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
            return to_metres(numbers, sensor) if sensor.kind == "depth" else numbers

        values = Lazy(len(time_s), value)
        if sensor.kind == "vector" and len(time_s):
            return Readings(time_s, np.stack(list(values)).astype(sensor.dtype, copy=False))
        return Readings(time_s, values)

    def _episode(self, number: int) -> Episode:
        if not 0 <= number < len(self.episodes):
            raise DatasetError(f"{self.root} has episodes 0 to {len(self.episodes) - 1}, no episode {number}.")
        return self.episodes[number]

    def _camera(self, name: str | None) -> str:
        camera = self.rgb_key if name is None else self.feature(name)
        if camera is None or camera not in self.cameras:
            raise DatasetError(
                f"{self.root} has no pictures{f' {name}' if name else ''}; it has {', '.join(self.features)}."
            )
        return camera

    def _channels(self) -> dict[str, str]:
        stated, channels = {feature: channel for channel, feature in self.about.get("channels", {}).items()}, {}
        main = {"rgb": self.rgb_key} if self.rgb_key else {}
        for name, sensor in self.sensors.items():
            channel = stated.get(name) or channel_of(name, sensor.names)
            kind = {"image": "rgb", "depth": "depth"}.get(sensor.kind)
            if kind and kind_of(channel) != kind:  # another writer's name
                channel = f"{kind}.{name.rsplit('.', 1)[-1]}"
                main.setdefault(kind, name)
            channels.setdefault(channel, name)
        return {**main, **channels}

    def _look_for_depth(self) -> None:
        """Turns image features of one channel into depth where their pictures have 16 bits."""
        for name, sensor in self.sensors.items():
            feature = self.features[name]
            grey = feature["dtype"] == "image" and feature["shape"][2] == 1
            if sensor.kind == "image" and grey and len(self.episodes):
                with suppress(DatasetError):  # reading it raises
                    first = self._table(self.episodes[0], [name])[name]
                    if len(first) and decode_picture(first[0].as_py(), sensor.shape, name).ndim == 2:
                        self.sensors[name] = replace(sensor, kind="depth", shape=sensor.shape[:2], dtype="float32")

    def _table(self, episode: Episode, columns: list[str]):
        return read_rows(self.files.local(episode.data), columns, episode.start, episode.stop, self.features)

    def _stored(self, episode: Episode, names: list[str]) -> dict[str, np.ndarray]:
        """Columns as they are stored, [T, *shape]."""
        table, stored = self._table(episode, names), {}
        for name in names:
            try:
                stored[name] = to_numpy(table[name], tuple(self.features[name]["shape"]))
            except (ValueError, TypeError, NotImplementedError) as error:
                raise DatasetError(
                    f"{self.root / episode.data}: column '{name}' is not what info.json says ({error})."
                ) from error
        return stored

    def _columns(self, episode: Episode, names: list[str]) -> dict[str, np.ndarray]:
        stored = {name: self.feature(name) for name in names}
        columns = dict.fromkeys(key for key in stored.values() if key is not None)
        pictured = [key for key in columns if self.features[key]["dtype"] in ("image", "video")]
        arrays = self._stored(episode, [key for key in columns if key not in pictured])
        arrays |= {key: np.stack(list(self._pictures(episode, key))) for key in pictured}
        result = {}
        for name, key in stored.items():
            if key is None:  # other writers have no action_valid: the outcome of the last row is unknown
                result[name] = np.arange(episode.length) < episode.length - 1
            else:
                result[name] = _as_promised(name, arrays[key], self.sensors.get(key))
        return result


def _as_promised(name: str, array: np.ndarray, sensor: Sensor | None) -> np.ndarray:
    if sensor is not None and sensor.kind == "depth":
        flat = array.reshape(len(array), *sensor.shape)
        return to_metres(flat, sensor, beyond=DEPTH_BEYOND * unit_of(sensor))
    if name in ("reward", "done", "action_valid"):
        return array.reshape(-1).astype(np.float32 if name == "reward" else bool)
    return array.astype(np.float32) if name in ("pose", "action") else array
