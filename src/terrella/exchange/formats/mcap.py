"""Reads MCAP, the file format of robot logs (https://mcap.dev), with Foxglove's message types.

One file is one take; a folder of files has one take per file. What MCAP has no field for (sensor declarations, task, robot,
the exact start time) is in the file's metadata records "terrella.source", "terrella.sensors" and "terrella.take"; a file
without them is read as well. Foxglove has no message for an IMU: it is a vector, as all plain numbers are.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import messages, rows
from .mcap_index import Index, Messages, Metadata, Schema
from .video_frames import decodable_messages, message_frames

SOURCE, SENSORS, TAKE = "terrella.source", "terrella.sensors", "terrella.take"
_KEYS = {"image": "observation.images", "depth": "observation.depth", "points": "observation.points"}
_READERS = {  # the sensor kinds that a message type may be declared as
    "foxglove.CompressedImage": ("image", "depth"),
    "foxglove.RawImage": ("image", "depth"),
    messages.VIDEO: ("image",),
    "foxglove.PointCloud": ("points",),
}
_LOG = "foxglove.Log"
_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
_MAX_FRAMES = 256  # coordinate frames that one topic of transforms is split into


# -- reading -----------------------------------------------------------------------------------------------------------


def read(path: str | Path, fps: float | None = None) -> Source:
    """An .mcap file as one take, or a folder of them with one take per file, in the order of their names.

    Values are decoded when read; only their positions are kept in memory (24 bytes per message). Time is the log time, in
    seconds from the first message of the file; `fps` is ignored. A truncated file is read up to the cut. Damaged chunks, and
    video frames that need them, are left out. `notes` lists everything that is unknown, cut or damaged.

    DatasetError where there is no MCAP file, or no known message in it.
    """
    path = Path(path)
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if not files or not all(file.is_file() for file in files):
        raise DatasetError(f"There is no .mcap file at '{path}'; check the path.")
    about: dict[str, Any] = {}
    sensors: dict[str, Sensor] = {}
    notes: list[str] = []
    usable: list[Path] = []
    for file in files:
        try:
            opened = _File(file)
        except DatasetError as error:
            if len(files) == 1:
                raise
            notes.append(f"{file.name} is left out: {error}")
            continue
        about = about or opened.about
        notes += [note for note in (*opened.about.get("notes", ()), *opened.notes) if note not in notes]
        for name, sensor in opened.sensors.items():
            known = sensors.setdefault(name, sensor)
            if not _alike(known, sensor):
                notes.append(
                    f"{file.name}: '{name}' has another kind or shape than in {files[0].name}; it is left out."
                )
        usable.append(file)
    if not usable:
        raise DatasetError(f"None of the {len(files)} files in '{path}' can be read: {notes[0]}")

    def takes() -> Iterator[Take]:
        for file in usable:
            yield _File(file).take(sensors)

    return Source(
        name=about.get("name", path.stem),
        sensors=sensors,
        takes=takes,
        fps=about.get("fps"),
        robot=about.get("robot", ""),
        notes=tuple(notes),
        facts=about.get("facts", {}),
    )


def _alike(one: Sensor, other: Sensor) -> bool:
    return (one.kind, one.shape, one.dtype, one.names) == (other.kind, other.shape, other.dtype, other.names)


@dataclass(frozen=True)
class _Stream:
    """A sensor's readings in one file: log times uint64 [n], ascending, and a function that gives value i."""

    sensor: Sensor
    log_ns: np.ndarray
    value: Callable[[int], np.ndarray]


@dataclass(frozen=True)
class _Group:
    """The channels of one topic with the same schema and encoding, and their messages in order of time."""

    index: Index
    topic: str
    schema: Schema
    unpack: Callable[[bytes], dict[str, Any]]
    messages: Messages

    def fields(self, i: int) -> dict[str, Any]:
        data = self.index.data(self.topic, int(self.messages.chunk[i]), int(self.messages.place[i]))
        with _naming(self, i):
            return self.unpack(data)


@contextmanager
def _naming(group: _Group, i: int) -> Iterator[None]:
    """Adds the message's number and topic to a DatasetError."""
    try:
        yield
    except DatasetError as error:
        where = f"Message {i} of '{group.topic}' in '{group.index.path}' cannot be read"
        raise DatasetError(f"{where}: {error}; leave the file out, or mend what wrote it.") from error


@dataclass
class _File:
    """The contents of one file: `sensors`, `notes`, `about` (the recording) and its take."""

    path: Path
    notes: list[str] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)
    streams: dict[str, _Stream] = field(default_factory=dict)

    def __post_init__(self):
        index = Index(self.path)
        self._declared, self._take = self._metadata(index.metadata)
        groups = list(self._groups(index))
        self.notes = [*index.notes, *self.notes]
        every = index.of(index.channels)
        self._first_ns = int(every.log_ns[0]) if len(every.log_ns) else 0
        if not len(every.log_ns) and not self._declared:
            raise DatasetError(f"'{self.path}' holds no readable messages; choose another file.")
        self._calibrations: list[tuple[str, dict[str, object]]] = []
        streams: list[tuple[str, _Stream]] = []
        for group in groups:
            streams += self._streams_of(group)
        self._name(streams)
        self._calibrate(streams)
        if not self.streams:
            raise DatasetError(f"'{self.path}' holds no known messages: {' '.join(self.notes[:3])}")

    @property
    def sensors(self) -> dict[str, Sensor]:
        return {name: stream.sensor for name, stream in self.streams.items()}

    def take(self, sensors: Mapping[str, Sensor]) -> Take:
        zero_ns = self._take.get("zero_ns", self._first_ns)
        readings = {}
        for name, stream in self.streams.items():
            if _alike(stream.sensor, sensors[name]):
                time_s = (stream.log_ns - np.uint64(zero_ns)).view(np.int64) / 1e9
                readings[name] = Readings(time_s, Lazy(len(time_s), stream.value))
        start_ns = self._take["start_ns"] if "start_ns" in self._take else zero_ns or None
        return Take(readings, self._take.get("task", ""), start_ns, self._take.get("facts", {}))

    def _metadata(self, records: list[Metadata]) -> tuple[dict[str, Sensor], dict[str, Any]]:
        """(topic -> declared sensor, the take's task, facts and times); damaged records are noted and left out."""
        declared: dict[str, Sensor] = {}
        take: dict[str, Any] = {}
        for name, record in ((it.name, it.metadata) for it in records):
            if name not in (SOURCE, SENSORS, TAKE):
                self.notes.append(f"{self.path.name}: the metadata record '{name}' is not kept.")
                continue
            for key, text in record.items():
                try:
                    value = json.loads(text)
                    if name == SENSORS:
                        declared[str(value["topic"])] = rows.sensor_of({**value, "name": key})
                    elif isinstance(value, _ABOUT.get(key, ())):
                        (self.about if name == SOURCE else take)[key] = value
                    else:
                        raise ValueError(f"{type(value).__name__} is not allowed there")
                except (ValueError, TypeError, KeyError, RecursionError) as error:
                    self.notes.append(f"{self.path.name}: '{key}' in the record '{name}' is broken ({error}).")
        if not 0 <= take.get("zero_ns", 0) < 2**63:
            self.notes.append(
                f"{self.path.name}: the take's start time is impossible; time starts at its first message."
            )
            take = {key: value for key, value in take.items() if key not in ("zero_ns", "start_ns")}
        return declared, take

    def _groups(self, index: Index) -> Iterator[_Group]:
        members: dict[tuple[str, str, str], list[int]] = {}
        for number, channel in index.channels.items():
            schema = index.schemas.get(channel.schema_id, _NO_SCHEMA)
            members.setdefault((channel.topic, schema.name, channel.message_encoding), []).append(number)
        for (topic, name, encoding), numbers in members.items():
            schema = index.schemas.get(index.channels[numbers[0]].schema_id, _NO_SCHEMA)
            selected = index.of(numbers)
            if not len(selected.log_ns) and topic not in self._declared:
                if name != messages.CALIBRATION:
                    self._note(topic, "it has no messages")
                continue
            try:
                unpack = messages.unpacker(name, schema.encoding, schema.data, encoding)
            except DatasetError as error:
                self._note(topic, f"its {len(selected.log_ns)} messages are left out: {error}")
                continue
            yield _Group(index, topic, schema, unpack, selected)

    def _streams_of(self, group: _Group) -> list[tuple[str, _Stream]]:
        """(topic, stream) for each sensor in a group; messages of unknown types are noted."""
        if not len(group.messages.log_ns):
            sensor = self._declared_for(group)
            return [(group.topic, _Stream(sensor, group.messages.log_ns, lambda i: np.zeros(0)))] if sensor else []
        try:
            if group.schema.name == messages.CALIBRATION:
                first, last = (messages.calibration_of(group.fields(i)) for i in (0, len(group.messages.log_ns) - 1))
                self._calibrations.append((group.topic, first))
                if first != last:
                    self._note(group.topic, "the calibration changes during the recording; only the first is kept")
                return []
            if group.schema.name == _LOG:
                self._note(group.topic, f"its {len(group.messages.log_ns)} log texts are left out")
                return []
            if group.schema.name in (messages.TRANSFORM, messages.TRANSFORMS):
                return self._transforms(group)
            if group.schema.name == messages.VIDEO:
                return self._video(group)
            return self._plain(group)
        except DatasetError as error:
            self._note(group.topic, str(error))
            return []

    def _plain(self, group: _Group) -> list[tuple[str, _Stream]]:
        name = group.schema.name

        def reading(i: int) -> messages.Reading:
            fields = group.fields(i)
            with _naming(group, i):
                return messages.decode(name, fields)

        sensor = self._declared_for(group) or _sensor_like(self._sample(group, reading))

        def value(i: int) -> np.ndarray:
            decoded = reading(i)
            with _naming(group, i):
                return messages.fit(decoded, sensor)

        return [(group.topic, _Stream(sensor, group.messages.log_ns, value))]

    def _sample(self, group: _Group, reading: Callable[[int], messages.Reading]) -> messages.Reading:
        """The first message of a group, or a later one if it is broken. A note says where others have other fields."""
        samples: list[messages.Reading] = []
        broken: list[DatasetError] = []
        for i in sorted({0, len(group.messages.log_ns) // 2, len(group.messages.log_ns) - 1}):
            try:
                samples.append(reading(i))
            except DatasetError as error:
                broken.append(error)
        if not samples:
            raise broken[0]
        self.notes += [str(error) for error in broken]
        if any(other.names != samples[0].names for other in samples):
            self._note(group.topic, "its messages have different fields; only those of the first one are read")
        if samples[0].left_out:
            self._note(group.topic, f"{', '.join(sorted(samples[0].left_out))} cannot be kept")
        return samples[0]

    def _video(self, group: _Group) -> list[tuple[str, _Stream]]:
        first = group.fields(0)

        def data(i: int) -> bytes:
            return messages.video_of(group.fields(i))[1]

        format, count = messages.video_of(first)[0], len(group.messages.log_ns)
        kept = decodable_messages(data, group.messages.after_gap, format)
        if not len(kept):
            raise DatasetError("its video has no keyframe to start from")
        if begin := int(kept[0]):
            self._note(group.topic, f"its first {begin} frames come before the first keyframe and are left out")
        if lost := count - begin - len(kept):
            self._note(group.topic, f"{lost} frames that follow a damaged chunk cannot be decoded and are left out")
        decoder = message_frames(lambda i: data(int(kept[i])), len(kept), format)
        sensor = self._declared_for(group)
        if sensor is None:
            sensor = Sensor("", "image", decoder(0).shape, "uint8", frame=str(first.get("frame_id") or ""))
        chosen = sensor

        def value(i: int) -> np.ndarray:
            with _naming(group, int(kept[i])):
                return messages.fit(messages.Reading("image", decoder(i)), chosen)

        return [(group.topic, _Stream(sensor, group.messages.log_ns[kept], value))]

    def _transforms(self, group: _Group) -> list[tuple[str, _Stream]]:
        """A stream for each child frame: usually one topic carries them all."""
        values: dict[tuple[str, str], list[tuple[int, np.ndarray]]] = {}
        broken: list[DatasetError] = []
        for i, log_ns in enumerate(group.messages.log_ns.tolist()):
            try:
                transforms = list(messages.transforms_of(group.schema.name, group.fields(i)))
            except DatasetError as error:
                broken.append(error)
                continue
            for parent, child, value in transforms:
                if (parent, child) in values or len(values) < _MAX_FRAMES:
                    values.setdefault((parent, child), []).append((log_ns, value))
        if broken:
            self._note(group.topic, f"{len(broken)} of its messages are left out, the first because {broken[0]}")
        if len(values) == _MAX_FRAMES:
            self._note(group.topic, f"only its first {_MAX_FRAMES} coordinate frames are read")
        declared = self._declared_for(group)
        if declared is not None and len(values) == 1 and declared.shape == (7,):
            return [(group.topic, _joined(declared, *values.values()))]
        streams = []
        for (parent, child), pairs in values.items():
            first = messages.Reading("vector", pairs[0][1], messages.POSE_NAMES, parent, {"child_frame": child})
            streams.append((f"{group.topic}/{child}", _joined(_sensor_like(first), pairs)))
        return streams

    def _declared_for(self, group: _Group) -> Sensor | None:
        sensor = self._declared.get(group.topic)
        if sensor is None or sensor.kind in _READERS.get(group.schema.name, ("vector",)):
            return sensor
        self._note(group.topic, f"it is declared as {sensor.kind}, but {group.schema.name} is not of that kind")
        return None

    def _name(self, streams: list[tuple[str, _Stream]]) -> None:
        """Names the streams: declared sensors first, in their own order; then the others, after their topics."""
        order = list(self._declared)
        streams.sort(key=lambda item: (order.index(item[0]), "") if item[0] in order else (len(order), item[0]))
        for topic, stream in streams:
            name = stream.sensor.name or key_of(topic, stream.sensor)
            free = rows.unique(name, self.streams)
            self.streams[free] = replace(stream, sensor=replace(stream.sensor, name=free))

    def _calibrate(self, streams: list[tuple[str, _Stream]]) -> None:
        cameras = dict(zip((topic for topic, _ in streams), self.streams))
        cameras = {
            topic: name for topic, name in cameras.items() if self.streams[name].sensor.kind in ("image", "depth")
        }
        for topic, calibration in self._calibrations:
            name = _camera_of(topic, str(calibration["frame_id"]), cameras, self.sensors)
            if name is None:
                self._note(topic, "it is unclear which camera this calibration belongs to")
                continue
            stream = self.streams[name]
            if "calibration" not in stream.sensor.facts:
                facts = {**stream.sensor.facts, "calibration": calibration}
                self.streams[name] = replace(stream, sensor=replace(stream.sensor, facts=facts))

    def _note(self, topic: str, what: str) -> None:
        self.notes.append(f"{self.path.name}: '{topic}': {what.rstrip('.')}.")


def _sensor_like(reading: messages.Reading) -> Sensor:
    """A sensor, still without a name, for readings like this one."""
    shape = (0, reading.value.shape[1]) if reading.kind == "points" else reading.value.shape
    dtype = "float32" if reading.kind in ("depth", "points") else str(reading.value.dtype)
    units = {"x_m": "m", "y_m": "m", "z_m": "m"} if reading.names == messages.POSE_NAMES else {}
    return Sensor("", reading.kind, shape, dtype, reading.names, units, reading.frame, facts=reading.facts)


def _joined(sensor: Sensor, pairs: list[tuple[int, np.ndarray]]) -> _Stream:
    log_ns = np.array([log_ns for log_ns, _ in pairs], np.uint64)
    return _Stream(sensor, log_ns, lambda i: pairs[i][1].astype(sensor.dtype).reshape(sensor.shape))


def topic_of(name: str) -> str:
    """The topic of a sensor: "observation.images.front" -> "/observation/images/front"."""
    return "/" + name.replace(".", "/")


def topics(sensors: Mapping[str, Sensor]) -> dict[str, str]:
    """A topic for each sensor, also where names differ only in "." and "/"."""
    names: dict[str, str] = {}
    for name in sensors:
        names[name] = rows.unique(topic_of(name), set(names.values()))
    return names


def key_of(topic: str, sensor: Sensor) -> str:
    """The name of a topic's sensor: our own topics keep their names ("/observation/images/front" is observation.images.front),
    others go under their kind ("/camera/front/image" is observation.images.camera_front_image)."""
    under = _KEYS.get(sensor.kind, "observation")
    ours = topic.removeprefix("/").replace("/", ".")
    if ours == under or ours.startswith(under + "."):
        return ours
    if sensor.kind == "vector" and (ours == "action" or ours.startswith("next.")):
        return ours
    return f"{under}.{re.sub(r'[^A-Za-z0-9]+', '_', topic).strip('_') or 'unnamed'}"


def _camera_of(topic: str, frame: str, cameras: Mapping[str, str], sensors: Mapping[str, Sensor]) -> str | None:
    """The camera of a calibration: under the same topic, in the same coordinate frame, or the only one."""
    parent = topic.rpartition("/")[0]
    if parent in cameras:
        return cameras[parent]
    near = [name for other, name in cameras.items() if other.rpartition("/")[0] == parent]
    same = [name for name in cameras.values() if frame and sensors[name].frame == frame]
    for candidates in (near, same, list(cameras.values())):
        images = [name for name in candidates if sensors[name].kind == "image"]
        if len(images or candidates) == 1:
            return (images or candidates)[0]
    return None


_ABOUT: dict[str, Any] = {"name": str, "robot": str, "task": str, "notes": list, "facts": dict, "zero_ns": int}
_ABOUT |= {"fps": (int, float, type(None)), "start_ns": (int, type(None))}
