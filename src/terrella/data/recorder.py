"""Recorder: writes rows to a LeRobotDataset v3.0 folder as they happen; a crash loses next to nothing."""

from __future__ import annotations

import shlex
import shutil
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, Protocol

import av
import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..core.files import FULL, remedy_of
from ..core.instruction import bytes_to_text
from . import stats
from .channels import ACTION, DONE, OF_TASK, REWARD, feature_of
from .features import unit_of
from .format import ACTION_VALID, DEPTH_BEYOND, TIME, Layout, even_size
from .source import Sensor, is_action, is_outcome
from .staged import LOG, ROW, SAMPLE_EVERY, WORDS, Parcel, Staged, growing_film, pack_row, staging_facts
from .storage.journal import Journal
from .storage.mp4 import Mp4Writer, Pressure
from .writer import Draft, Writer, fresh_folder

_BROKEN = (OSError, av.FFmpegError, pa.ArrowException)


class Watch(Protocol):
    """A live view of a recording."""

    start_ns: int  # wall-clock time of its time 0, nanoseconds since 1970

    def log(self, sensor_name: str, time_s: float, value: np.ndarray) -> None: ...


class Recorder:
    """Appends episodes to the folder `root`, which is new or was written by a Recorder of the same layout.

        with Recorder("recordings/arm", layout, "lift the cup") as recorder:
            recorder.add(observation, action, reward, done)    # one row
            recorder.end_episode()                             # commits the episode

    A row is an observation, the action taken in it, and the reward and done that followed. The last row of an episode is
    its terminal observation and has action_valid = False. Rows, and frames once they are encoded, are written at once to
    a hidden folder; `end_episode` makes an episode of them and replaces meta/info.json last. After a kill or a full disk,
    opening the folder again keeps the unfinished episode up to its last whole row (interrupted="keep"), or discards it if
    its task is the same ("discard", for recordings that will be made again). No frame is dropped: `add` blocks while 64
    frames of a camera wait for their encoder. DatasetError where `root` is foreign, locked by another recorder, or the
    disk is full; recorded data is never lost.

    task:      the instruction of the next episodes.
    live:      a live view that is sent each row and reading.
    recovered: rows kept of interrupted episodes.
    pressure:  how far the encoders fell behind so far.
    """

    def __init__(
        self,
        root: str | Path,
        layout: Layout,
        task: str = "explore",
        interrupted: Literal["keep", "discard"] = "keep",
        live: Watch | None = None,
    ):
        self.task, self.layout, self.recovered, self.live = task, layout, 0, live
        self._writer = Writer(root, layout)
        self.root, self._staging = self._writer.root, self._writer.staging
        self._names = list(layout.rows)
        self._packed = [sensor for sensor in layout.rows.values() if not self._is_video(sensor)]
        self._numbers = {name: 1 + i for i, name in enumerate(layout.streams)}
        self._videos: dict[str, Mp4Writer] = {}
        self._films: dict[str, Mp4Writer] = {}
        self._running: list[Callable[[], object]] = []  # functions that close the open files
        self._journal: Journal | None = None
        weakref.finalize(self, _abandon, self._running, self._writer.close).atexit = False
        self.pressure = Pressure()
        self._closed = False
        self._forget()
        try:
            self._recover(interrupted)
        except BaseException:
            self._writer.close()
            raise

    @property
    def rows(self) -> int:
        """Number of committed rows."""
        return self._writer.rows

    @property
    def episodes(self) -> int:
        """Number of committed episodes."""
        return self._writer.episodes

    def add(
        self,
        observation: Mapping[str, np.ndarray],
        action: np.ndarray | None = None,
        reward: float = 0.0,
        done: bool | None = None,
        time_s: float | None = None,
    ) -> None:
        """Adds one row; the observation has no batch axis (rgb uint8 [H, W, 3], depth metres [h, w], pose [7], ...). `action` is
        None for the terminal observation; `done` None repeats the row before; `time_s` as in `add_row`. The channel `text` becomes
        the instruction from this row on."""
        if "text" in observation and feature_of("text") not in self.layout.sensors:
            if (text := bytes_to_text(observation["text"])) != self._text:
                self.say(text)
            observation = {name: value for name, value in observation.items() if name not in OF_TASK}
        row = {self.layout.channels.get(name) or feature_of(name): value for name, value in observation.items()}
        unknown = sorted(name for name in row if name not in self.layout.sensors)
        if unknown:
            raise DatasetError(f"no place for '{unknown[0]}': this recording holds {', '.join(self.layout.sensors)}.")
        if action is not None:
            row[ACTION] = np.asarray(action, np.float32).reshape(-1)
            row[REWARD] = np.array([reward], np.float32)
        if done is not None:
            row[DONE] = np.array([bool(done)])
        self.add_row(row, time_s)

    def add_row(self, row: Mapping[str, np.ndarray | None], time_s: float | None = None) -> None:
        """Adds one row, by the names of the layout's sensors.

        Actions and outcomes ("action", "next.…") may be absent. A missing reading of another sensor is given as None and
        stored as zeros; a sensor that a whole episode lacks counts as absent. `time_s` is the time of the row, in seconds
        since the episode began, stored if the layout has a clock; None takes the current time.
        """
        self._check_open()
        at = self._elapsed() if time_s is None else float(time_s)
        values = self._checked(row, at)
        given = [name in (ACTION_VALID, TIME) or row.get(name) is not None for name in self._names]
        with self._nothing_lost():
            journal = self._begin()
            self._torn = True  # until row and frames are both written or queued
            journal.add(ROW, at, *pack_row(values, given, self._packed))
            for name, video in self._videos.items():
                video.add(values[name])
            for name, seen in self._pictures.items():
                if self.in_flight % SAMPLE_EVERY == 0:
                    seen.append(stats.summarise_pictures(values[name][None, ::4, ::4]))
            self._before = {name: values[name] for name in values if is_outcome(name) and values[name].dtype == bool}
            self.in_flight, self._time_s, self._torn = self.in_flight + 1, at, False
        self._show({name: value for name in self.layout.sensors if (value := row.get(name)) is not None})

    def log(self, stream: str, value: np.ndarray, time_s: float | None = None) -> None:
        """Adds one reading of a stream, at `time_s` seconds since the episode began; None takes the current time."""
        self._check_open()
        if stream not in self._numbers:
            raise DatasetError(f"this recording has no stream '{stream}'; it has {', '.join(self._numbers) or 'none'}.")
        sensor = self.layout.streams[stream]
        array = _as_stored(sensor, value, f"stream '{stream}'")
        at, newest = self._elapsed() if time_s is None else float(time_s), self._newest.get(stream, -np.inf)
        if not np.isfinite(at) or at < newest:
            raise DatasetError(f"stream '{stream}' has a reading at {at} s after one at {newest} s.")
        with self._nothing_lost():
            journal = self._begin()
            if sensor.kind == "image":
                self._films[stream].add(array)
            journal.add(self._numbers[stream], at, *([] if sensor.kind == "image" else [array]))
            self._newest[stream] = at
        self._show({stream: value})

    def say(self, task: str) -> None:
        """Sets the instruction of the next rows of this episode."""
        self._check_open()
        with self._nothing_lost():
            self._begin().add(WORDS, 0.0, task.encode())
        self._text = task

    def end_episode(self, start_ns: int | None = None) -> int | None:
        """Commits the episode in flight and returns its number; an episode of fewer than 2 rows is dropped and gives None.

        `start_ns` is the wall-clock time of its time 0 (nanoseconds since 1970); None takes the time at which it began, if
        the layout has a clock.
        """
        if self._closed:
            return None
        if self._left:
            before = self.episodes
            self._recover("keep")
            return self.episodes - 1 if self.episodes > before else None
        if self.in_flight < 2 or self._number != self.episodes:  # an interrupt may come just after the commit
            self._discard()
            return None
        with self._nothing_lost():
            number = self._writer.put(self._draft(start_ns))
        self._discard()
        self._writer.tidy()
        return number

    def take_episode(self) -> Parcel | None:
        """Takes the episode in flight, for `put_episode` of another recorder; None for fewer than 2 rows."""
        if self.in_flight < 2:
            self._discard()
            return None
        with self._nothing_lost():
            parcel = Parcel.of(self._draft(None))
        self._discard()
        return parcel

    def put_episode(self, parcel: Parcel) -> int:
        """Commits an episode taken from another recorder of this layout; returns its number."""
        self._check_open()
        if self.in_flight or self._left:
            raise DatasetError(f"an episode of {self.root} is in flight; end it before another is put there.")
        with self._nothing_lost():
            number = self._writer.put(parcel.unpacked(fresh_folder(self._staging)))
        self._discard()
        self._writer.tidy()
        return number

    def _draft(self, start_ns: int | None) -> Draft:
        self._stop()
        pictures = {name: stats.merge([{name: part} for part in seen])[name] for name, seen in self._pictures.items()}
        began = self._start_ns if self.layout.clock else None
        return Staged(self._staging).draft(self.in_flight, began if start_ns is None else start_ns, pictures)

    def drop_episode(self) -> None:
        """Drops the episode in flight."""
        if not self._closed:
            self._discard()

    def close(self) -> None:
        """Commits the episode in flight and unlocks the folder."""
        if self._closed:
            return
        try:
            if not self._left:
                self.end_episode()
        finally:
            self._closed = True
            self._stop(quietly=True)
            self._writer.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    # -- rows ---------------------------------------------------------------------------------------------------

    def _is_video(self, sensor: Sensor) -> bool:
        return sensor.kind == "image" and self.layout.pictures == "video"

    def _check_open(self) -> None:
        if self._closed:
            raise DatasetError(f"the recorder of {self.root} is closed; open another.")
        if self._journal is None and self.in_flight:
            raise DatasetError(f"an episode of {self.in_flight} rows waits to be committed; end it first.")
        if self._torn:
            raise DatasetError(f"a row was interrupted; end the episode, which keeps {self.in_flight} rows.")

    def _checked(self, row: Mapping[str, np.ndarray | None], time_s: float) -> dict[str, np.ndarray]:
        """Copies of the values of a row, as they are stored."""
        values: dict[str, np.ndarray] = {}
        for name, sensor in self.layout.sensors.items():
            value = row.get(name)
            if value is not None:
                values[name] = _as_stored(sensor, value, f"row {self.in_flight} of the episode: {name}")
            elif name in row or is_outcome(name):
                values[name] = self._before.get(name, _blank(sensor))
            else:
                short = name.removeprefix("observation.").removeprefix("images.")
                raise DatasetError(f"this recording has a channel '{short}', which the observation lacks.")
        acted = [row.get(name) is not None for name in self.layout.sensors if is_action(name)]
        if acted:
            values[ACTION_VALID] = np.array([any(acted)])
        if self.layout.clock:
            values[TIME] = np.array([time_s], np.float64)
            if time_s < self._time_s:
                raise DatasetError(
                    f"row {self.in_flight} of the episode is at {time_s} s, the row before at {self._time_s} s; times must ascend."
                )
        for name, value in values.items():
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                raise NotFinite(f"row {self.in_flight} of the episode has a {name} that is not a finite number.")
        return values

    def _show(self, values: Mapping[str, np.ndarray]) -> None:
        if self.live is not None:
            now_s = (time.time_ns() - self.live.start_ns) / 1e9
            for name, value in values.items():
                self.live.log(name, now_s, value)

    def _elapsed(self) -> float:
        return (time.monotonic_ns() - self._began_ns) / 1e9 if self._journal else 0.0

    def _begin(self) -> Journal:
        if self._journal is None:
            if self._left:  # the disk was full; now it may not be
                self._recover("keep")
            fresh_folder(self._staging)
            self._number, self._start_ns, self._began_ns = self.episodes, time.time_ns(), time.monotonic_ns()
            stated = staging_facts(self.layout, self._number, self.task, self._start_ns)
            self._journal = Journal(self._staging / LOG, stated)
            layout, folder = self.layout, self._staging
            for name, sensor in layout.sensors.items():
                if sensor.kind == "image":
                    self._pictures[name] = []
                if self._is_video(sensor):
                    film = growing_film(folder, name)
                    self._videos[name] = Mp4Writer(film, even_size(sensor), layout.fps, self.pressure)
            for name, sensor in layout.streams.items():
                if sensor.kind == "image":
                    film, rate = growing_film(folder, f"stream-{name}"), sensor.rate_hz or layout.fps
                    self._films[name] = Mp4Writer(film, even_size(sensor), rate, self.pressure)
            videos = [*self._videos.values(), *self._films.values()]
            self._running += [self._journal.close, *(video.abandon for video in videos)]
        return self._journal

    # -- interrupted episodes --------------------------------------------------------------------------------------

    def _recover(self, interrupted: Literal["keep", "discard"]) -> None:
        """Makes an episode of the staging folder, up to the last row whose frames are whole."""
        if not (self._staging / LOG).exists():
            return self._discard()
        try:
            with self._nothing_lost():
                staged = Staged(self._staging)
        except (ValueError, KeyError, TypeError):  # not even the first record is whole
            return self._discard()
        if staged.number != self.episodes:  # the recorder was killed after the commit
            return self._discard()
        if interrupted == "discard" and staged.task == self.task:
            return self._discard()
        if not staged.fits(self.layout):
            raise DatasetError(
                f"an interrupted episode of another layout lies in {self._staging}; "
                f"`terrella data doctor {shlex.quote(str(self.root))} --repair` keeps it; deleting that folder drops it."
            )
        with self._nothing_lost():
            length = staged.whole()
            if length >= 2:
                self._writer.put(staged.draft(length, staged.start_ns if self.layout.clock else None))
                self.recovered += length
        self._discard()
        self._writer.tidy()

    @contextmanager
    def _nothing_lost(self) -> Iterator[None]:
        """Turns a failed write into a DatasetError that says what is safe; the episode in flight stays in its folder."""
        try:
            yield
        except _BROKEN as error:
            rows = self.in_flight
            self._stop(quietly=True)
            self._forget()
            self._left = True
            self._writer.remove_unfinished()
            why = "the disk is full" if getattr(error, "errno", None) in FULL else f"writing failed ({error})"
            safe = f"{self.episodes} episodes ({self.rows} frames) are safe there"
            safe += f", the {rows} rows in flight are kept as far as they were written" if rows else ""
            raise DatasetError(f"{why} at {self.root}; {safe}: {remedy_of(error)} and record again.") from error

    def _stop(self, quietly: bool = False) -> None:
        """Closes the files of the episode in flight."""
        videos, self._videos, self._films = [*self._videos.values(), *self._films.values()], {}, {}
        self._running.clear()
        if self._journal:
            self._journal.close()
            self._journal = None
        for video in videos:
            video.abandon() if quietly else video.close()

    def _forget(self) -> None:
        self.in_flight, self._number, self._start_ns, self._began_ns, self._time_s = 0, -1, 0, 0, -np.inf
        self._torn = self._left = False
        self._pictures: dict[str, list[stats.Summary]] = {}
        self._newest: dict[str, float] = {}
        self._before: dict[str, np.ndarray] = {}
        self._text = self.task

    def _discard(self) -> None:
        """Drops the episode in flight and its files."""
        self._stop(quietly=True)
        self._forget()
        shutil.rmtree(self._staging, ignore_errors=True)


def _abandon(running: list[Callable[[], object]], unlock: Callable[[], None]) -> None:
    """Closes the files of a recorder that was not closed; the next recorder keeps its rows."""
    for end in running:
        end()
    unlock()


class NotFinite(DatasetError):
    """A row holds a number that is not finite."""


def _blank(sensor: Sensor) -> np.ndarray:
    if sensor.dtype == "string":
        return np.array([""], object)
    dtype = np.uint16 if sensor.kind == "depth" else np.dtype(sensor.dtype)
    return np.full(sensor.shape, DEPTH_BEYOND if sensor.kind == "depth" else 0, dtype)


def _as_stored(sensor: Sensor, value, what: str) -> np.ndarray:
    """A copy of the value as it is stored; depth in steps of its unit."""
    array = np.asarray(value)
    if sensor.dtype == "string":
        return np.array([str(array.reshape(-1)[0])], object)
    if sensor.kind == "points":
        if array.ndim != 2 or array.shape[1] != sensor.shape[1]:
            raise DatasetError(f"{what} should be points of shape [n, {sensor.shape[1]}]; got {array.shape}.")
        return np.array(array, sensor.dtype)
    if array.size != int(np.prod(sensor.shape)) or (len(sensor.shape) > 1 and array.shape != sensor.shape):
        raise DatasetError(f"{what} should have shape {sensor.shape}; got {array.shape}.")
    if sensor.kind == "depth":
        with np.errstate(over="ignore"):
            steps = array.astype(np.float64) / unit_of(sensor) + 0.5
            steps = np.nan_to_num(steps, nan=DEPTH_BEYOND, posinf=DEPTH_BEYOND)
        return np.clip(steps, 0, DEPTH_BEYOND).astype(np.uint16)
    dtype = np.dtype(sensor.dtype)
    if dtype.kind in "iub" and array.dtype != dtype:
        with np.errstate(invalid="ignore"):
            stored = array.astype(dtype)
        if not np.array_equal(stored, array):
            raise DatasetError(f"{what} should be {dtype}, and what it is ({array.dtype}) does not fit that.")
        return stored.reshape(sensor.shape)
    return np.array(array, dtype).reshape(sensor.shape)
