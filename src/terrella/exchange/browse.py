"""Browse: a recording of any format, opened for viewing: its episodes, single readings, and marks of bad episodes."""

from __future__ import annotations

import json
import re
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from ..core.files import write_json
from ..data.dataset import Dataset
from ..data.format import INFO
from ..data.resample import clock_of
from ..data.source import Readings, Sensor, Source, Take
from .convert import open_source, write_source
from .poses import pose_columns

MARKS = ".terrella-marks.json"  # in the folder of the recording
_MAX_OPEN = 2  # takes kept open at once
_MARKS_VERSION = 1
_HINT = "look for the cause with `terrella data doctor`"
_FORMS = {
    "image": "a picture, uint8 [H, W, 3]",
    "depth": "depth in metres, [h, w]",
    "points": "a cloud, [n, 3 or more]",
}

Progress = Callable[[int, int], None]  # (episodes done, episodes in all)
Export = Callable[[Path, Sequence[int], Progress], Sequence[str] | None]  # returns notes on what was left out


@dataclass(frozen=True)
class EpisodeEntry:
    """One line of the list of episodes."""

    rows: int  # readings of the first camera, or of the first sensor if there is no camera
    seconds: float  # time of the last reading
    task: str = ""  # the instruction, "" for none

    @staticmethod
    def of(take: Take) -> EpisodeEntry:
        cameras = [name for name in take.readings if name.startswith("observation.images")]
        first = next(iter([*cameras, *take.readings]), None)
        ends = [float(readings.time_s[-1]) for readings in take.readings.values() if len(readings.time_s)]
        return EpisodeEntry(len(take.readings[first].time_s) if first else 0, max(ends, default=0.0), take.task)


class Browse:
    """Views a recording; implements `terrella.serve.viewer.Viewable`.

    source:  the recording; takes that are not a sequence are read in order from the first.
    marks:   JSON file of the bad episodes, created with the first mark.
    entries: the list of episodes; without it, every take is opened once to learn its length.
    export:  (path, episodes, report) -> notes on what was left out or changed; writes episodes into a new folder.

    At most two takes are kept open. DatasetError where the marks are unreadable, or an episode, sensor or reading does not
    exist or cannot be decoded. Not thread-safe.
    """

    def __init__(
        self,
        source: Source,
        marks: str | Path,
        entries: Sequence[EpisodeEntry] | None = None,
        export: Export | None = None,
    ):
        self.source, self._marks_path, self._export = source, Path(marks), export
        self._open = _TakeReader(source).take
        self._texts = {name for name, sensor in source.sensors.items() if sensor.dtype == "string"}
        self.entries = tuple(entries if entries is not None else map(EpisodeEntry.of, source.takes()))
        self._takes: OrderedDict[int, _OpenTake] = OrderedDict()
        self._bad = _read_marks(self._marks_path)

    # -- contents -----------------------------------------------------------------------------------------------------

    def about(self) -> dict:
        """The recording as JSON: name, robot, fps, notes, sensors (in display order)."""
        source = self.source
        return {
            "name": source.name,
            "robot": source.robot,
            "fps": source.fps,
            "notes": list(source.notes),
            "sensors": [_describe(source, source.sensors[name]) for name in self._names() if name not in self._texts],
            "can_export": self._export is not None,
        }

    def listing(self) -> list[dict]:
        """Every episode as JSON: rows, seconds, task."""
        return [{"rows": entry.rows, "seconds": _finite(entry.seconds), "task": entry.task} for entry in self.entries]

    def episode(self, number: int) -> dict:
        """One episode as JSON: seconds, task, start_ns (as text, too long for a JSON number in a browser), language
        ([[time_s, text], ...]: changes of the instruction, and the values of text sensors), and the count of each sensor and its
        fault: why it cannot be shown, "" if it can.
        """
        opened = self._take(number)
        sensors, ends = {}, [0.0]
        language = _language(opened.take)
        for name in opened.take.readings:
            if name in self._texts:
                language += opened.texts(name)
                continue
            try:
                times = opened.times(name)
                sensors[name] = {"count": len(times), "fault": ""}
                ends += times[-1:].tolist()
            except DatasetError as error:
                sensors[name] = {"count": 0, "fault": str(error)}
        start = opened.take.start_ns
        return {
            "number": number,
            "seconds": max(ends),
            "task": opened.take.task,
            "start_ns": None if start is None else str(start),
            "language": sorted(language, key=lambda pair: pair[0]),
            "sensors": sensors,
        }

    # -- readings -----------------------------------------------------------------------------------------------------

    def times(self, number: int, sensor: str) -> np.ndarray:
        """float64 [n], ascending, seconds since the start of the episode."""
        return self._take(number).times(sensor)

    def reading(self, number: int, sensor: str, index: int) -> np.ndarray:
        """One picture uint8 [H, W, 3], depth float32 [h, w] in metres, cloud float32 [n, k], or vector [k]."""
        return self._take(number).reading(sensor, index)

    def series(self, number: int, sensor: str) -> np.ndarray:
        """All values of a vector sensor, float64 [n, k]."""
        return self._take(number).series(sensor)

    # -- marks and export ---------------------------------------------------------------------------------------------

    def marks(self) -> list[int]:
        """Numbers of the episodes that are marked bad, ascending."""
        return sorted(number for number in self._bad if number < len(self.entries))

    def mark(self, number: int, bad: bool) -> None:
        """Marks an episode bad, or good again, and saves the mark."""
        self._check(number)
        marked = self._bad | {number} if bad else self._bad - {number}
        try:
            write_json(self._marks_path, {"version": _MARKS_VERSION, "bad": sorted(marked)})
        except OSError as error:
            raise DatasetError(
                f"the mark cannot be saved in {self._marks_path} ({error.strerror}); make that folder writable, or view a copy."
            ) from error
        self._bad = marked

    def export(self, path: Path, keep: Sequence[int], report: Progress) -> tuple[int, list[str]]:
        """Writes the episodes `keep` into a new folder; may run in its own thread. Returns (its number of episodes, notes)."""
        if self._export is None:
            raise DatasetError(f"{self.source.name} was opened without an exporter; open it with browse().")
        for number in keep:
            self._check(number)
        notes = list(self._export(path, list(keep), report) or ())
        return len(Dataset(path).episodes) if (path / INFO).exists() else len(keep), notes

    # -- inside -------------------------------------------------------------------------------------------------------

    def _names(self) -> list[str]:
        kinds = ("image", "depth", "points", "vector")
        vectors = ("action", "observation.state", "next.reward", "next.done")

        def place(name: str) -> tuple[int, int]:
            kind = self.source.sensors[name].kind
            return kinds.index(kind), vectors.index(name) if name in vectors else len(vectors)

        return sorted(self.source.sensors, key=place)

    def _check(self, number: int) -> None:
        if not 0 <= number < len(self.entries):
            raise DatasetError(
                f"{self.source.name} has no episode {number}; it has {len(self.entries)}, numbered from 0."
            )

    def _take(self, number: int) -> _OpenTake:
        self._check(number)
        if number not in self._takes:
            while len(self._takes) >= _MAX_OPEN:
                self._takes.popitem(last=False)
            self._takes[number] = _OpenTake(self.source, number, self._open(number))
        self._takes.move_to_end(number)
        return self._takes[number]


class _OpenTake:
    """One take, with a cache of checked times and whole vectors."""

    def __init__(self, source: Source, number: int, take: Take):
        self.take, self._source, self._number = take, source, number
        self._times: dict[str, np.ndarray] = {}
        self._series: dict[str, np.ndarray] = {}

    def times(self, sensor: str) -> np.ndarray:
        if sensor not in self._times:
            self._times[sensor] = clock_of(self._readings(sensor), self._where(sensor))
        return self._times[sensor]

    def reading(self, sensor: str, index: int) -> np.ndarray:
        count = len(self.times(sensor))
        if not 0 <= index < count:
            raise DatasetError(f"{self._where(sensor)} has {count} readings, no reading {index}.")
        what = f"reading {index} of {self._where(sensor)}"
        with _decoding(what):
            value = np.asarray(self._readings(sensor).values[index])
        kind = self._source.sensors[sensor].kind
        flat = value.ndim == 2 and value.dtype.kind in "fiu"
        if kind == "image":
            valid = value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3 and value.size
        else:
            valid = kind == "vector" or (flat and (value.shape[1] >= 3 if kind == "points" else value.size))
        if not valid:
            raise DatasetError(f"{what} is {value.dtype} {list(value.shape)} and not {_FORMS[kind]}; {_HINT}.")
        return value

    def series(self, sensor: str) -> np.ndarray:
        if sensor not in self._series:
            if self._source.sensors[sensor].kind != "vector":
                raise DatasetError(f"{self._where(sensor)} is not a vector; read it one reading at a time.")
            times, values = self.times(sensor), self._readings(sensor).values
            with _decoding(self._where(sensor)):
                whole = np.asarray(values if isinstance(values, np.ndarray) else [np.asarray(v) for v in values])
                self._series[sensor] = whole.astype(np.float64).reshape(len(times), -1 if len(times) else 1)
        return self._series[sensor]

    def texts(self, sensor: str) -> list[list]:
        """[[time_s, "name: text"], ...] at the changes of a text sensor; or its fault, where it cannot be read."""
        label, changes = sensor.rpartition(".")[2], []
        try:
            for time_s, value in zip(self.times(sensor).tolist(), self._readings(sensor).values):
                text = f"{label}: {np.asarray(value).reshape(-1)[0]}"
                if not changes or changes[-1][1] != text:
                    changes.append([time_s, text])
        except DatasetError as error:
            changes.append([0.0, str(error)])
        return changes

    def _readings(self, sensor: str) -> Readings:
        if sensor not in self._source.sensors:
            known = ", ".join(self._source.sensors)
            raise DatasetError(f"{self._source.name} has no sensor {sensor}; it has {known}.")
        if sensor not in self.take.readings:
            raise DatasetError(f"episode {self._number} has no readings of {sensor}.")
        return self.take.readings[sensor]

    def _where(self, sensor: str) -> str:
        return f"{sensor} in episode {self._number}"


@contextmanager
def _decoding(what: str) -> Iterator[None]:
    try:
        yield
    except DatasetError:
        raise
    except Exception as error:  # decoders fail in many ways on a broken file
        raise DatasetError(f"{what} cannot be decoded ({type(error).__name__}: {error}); {_HINT}.") from error


class _TakeReader:
    """Takes by number. Of a source that only iterates, reading goes on from the last take, or starts again."""

    def __init__(self, source: Source):
        self._source = source
        self._at, self._takes = 0, iter(())

    def take(self, number: int) -> Take:
        if number < self._at or self._at == 0:
            takes = self._source.takes()
            if isinstance(takes, Sequence) and number < len(takes):
                return takes[number]
            self._at, self._takes = 0, iter(takes)
        for take in self._takes:
            self._at += 1
            if self._at == number + 1:
                return take
        self._at = 0
        raise DatasetError(f"{self._source.name} has no episode {number} any more; open it again.")


def _describe(source: Source, sensor: Sensor) -> dict:
    label = re.sub(r"^(observation|next)\.((images|points)\.)?", "", sensor.name) or sensor.name
    count = (
        int(np.prod(sensor.shape)) if sensor.kind == "vector" else sensor.shape[-1] if sensor.kind == "points" else 0
    )
    names = list(sensor.names) if len(sensor.names) == count else [str(place) for place in range(count)]
    return {
        "name": sensor.name,
        "label": label,
        "kind": sensor.kind,
        "shape": list(sensor.shape),
        "dtype": sensor.dtype,
        "names": names,
        "units": [str(sensor.units.get(name, "")) for name in names],
        "frame": sensor.frame,
        "rate_hz": sensor.rate_hz,
        "camera": _camera(source, sensor),
        "pose": None if sensor.kind != "vector" or sensor.name == "action" else pose_columns(sensor),
    }


def _camera(source: Source, sensor: Sensor) -> dict | None:
    """The camera in the recorded world's description: intrinsics, size, pose (the channel it is mounted on) and mount."""
    world = source.facts.get("world")
    cameras = world.get("cameras") if isinstance(world, Mapping) else None
    suffix = sensor.name.removeprefix("observation.images.")
    camera = cameras.get("rgb" if suffix == "rgb" else f"rgb.{suffix}") if isinstance(cameras, Mapping) else None
    return dict(camera) if sensor.kind == "image" and isinstance(camera, Mapping) else None


def _language(take: Take) -> list[list]:
    spoken = take.facts.get("language", ())
    pairs: Iterator = iter(spoken if isinstance(spoken, (list, tuple)) else ())
    return [[_finite(pair[0]), str(pair[1])] for pair in pairs if isinstance(pair, (list, tuple)) and len(pair) == 2]


def _finite(number: object) -> float:
    try:
        value = float(number)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return 0.0
    return value if np.isfinite(value) else 0.0


def _read_marks(path: Path) -> frozenset[int]:
    if not path.exists():
        return frozenset()
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        bad = kept["bad"]
        if kept["version"] != _MARKS_VERSION or not all(type(number) is int and number >= 0 for number in bad):
            raise ValueError("its version differs, or its list of bad episodes is not one of integers")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"the marks in {path} cannot be read ({error}); mend the file, or move it away.") from error
    return frozenset(bad)


def browse(
    path: str | Path, carry: Callable[[Path, Path, Sequence[int], Progress], Sequence[str]] | None = None
) -> Browse:
    """Opens a recording of any format for viewing.

    carry: (from, to, episodes, report) copies episodes of a LeRobot folder bit for bit into a new one, for the export.
           Without it they are converted, as those of other formats are.
    """
    source, where = open_source(path), Path(path)
    if "://" in str(path):
        marks = Path(f".{where.name}{MARKS}")  # in the working directory: remotes are not written to
    else:
        marks = where / MARKS if where.is_dir() else where.with_name(f".{where.name}{MARKS}")

    def write(out: Path, keep: Sequence[int], report: Progress) -> list[str]:
        wanted = set(keep)
        chosen = replace(source, takes=lambda: (take for i, take in enumerate(source.takes()) if i in wanted))
        return write_source(chosen, out, "lerobot", progress=lambda done, _: report(done, len(keep)))

    if not (where / INFO).exists():
        return Browse(source, marks, export=write)
    dataset = Dataset(path)
    entries = [EpisodeEntry(episode.length, episode.length / dataset.fps, episode.task) for episode in dataset.episodes]
    export = write if carry is None else lambda out, keep, report: carry(where, out, keep, report)
    return Browse(source, marks, entries, export=export)
