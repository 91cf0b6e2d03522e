"""Writes MCAP with Foxglove's message types: a whole source, or readings as they arrive."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DatasetError
from ...core.files import creating, sync_file
from ...data.format import sensor_json
from ...data.resample import clock_of
from ...data.source import Readings, Sensor, Source, Take
from . import message_encoder, rows
from .mcap import SENSORS, SOURCE, TAKE, topics
from .message_encoder import MessageEncoder

try:
    from foxglove import Schema
    from mcap.writer import Writer
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

CALIBRATION_TOPIC = "/calibration"  # under the topic of its camera
_CHUNK = 2**20


def write(source: Source, path: str | Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Writes a source at `path`: one file if it ends in .mcap (one take), else a folder of take-000000.mcap, ….

    Values are exact. `progress(messages, messages_of_this_take)` is called on the way. `path` appears only when it is
    complete. DatasetError where the path exists, the disk is full, or a reading differs from its sensor's declaration.
    """
    path = Path(path)
    with creating(path) as staged:
        for number, take in rows.numbered(source, None):
            if path.suffix == ".mcap" and number:
                raise DatasetError(f"'{source.name}' has more than one take, and '{path}' is one file; name a folder.")
            if path.suffix != ".mcap":
                staged.mkdir(exist_ok=True)
            target = staged if path.suffix == ".mcap" else staged / f"take-{number:06d}.mcap"
            _write_take(source, take, target, progress)
            sync_file(target)
    return []


def _write_take(source: Source, take: Take, path: Path, progress) -> None:
    names = list(take.readings)
    for name in names:
        if name not in source.sensors:
            raise DatasetError(f"A take has readings of '{name}', which the source does not declare; declare it.")
    times = [_nanoseconds(name, take.readings[name]) for name in names]
    first = min((int(time_ns.min()) for time_ns in times if len(time_ns)), default=0)
    zero_ns = take.start_ns if take.start_ns is not None else max(0, -first)
    if not 0 <= zero_ns + first < 2**63:
        raise DatasetError(
            f"A take begins {first / 1e9:g} s from {zero_ns} ns, which MCAP cannot hold; mend its start."
        )
    whose = np.concatenate([np.full(len(time_ns), i) for i, time_ns in enumerate(times)] or [np.zeros(0, int)])
    which = np.concatenate([np.arange(len(time_ns)) for time_ns in times] or [np.zeros(0, int)])
    order = np.argsort(np.concatenate([*times, np.zeros(0, np.int64)]), kind="stable")
    sensors = {name: source.sensors[name] for name in names}
    with McapRecording(path, sensors, source, take, zero_ns) as recording:
        for done, at in enumerate(order.tolist()):
            name, i = names[whose[at]], int(which[at])
            recording.add(name, zero_ns + int(times[whose[at]][i]), np.asarray(take.readings[name].values[i]))
            if progress:
                progress(done + 1, len(order))


def _nanoseconds(name: str, readings: Readings) -> np.ndarray:
    time_s = clock_of(readings, name)
    if (np.abs(time_s) > 2**62 / 1e9).any():
        raise DatasetError(f"'{name}' has impossible times; mend them.")
    return np.rint(time_s * 1e9).astype(np.int64)


class McapRecording:
    """An open MCAP file: all sensors are declared first, then readings are added in any order of sensors.

    Everything added before a `flush` can be read even if the file ends there. The file must be new.
    source:  its name, fps, robot, notes and facts are stored; likewise `take`'s start_ns, task and facts.
    zero_ns: the log time of the take's second 0, in nanoseconds.
    jpeg:    write pictures as JPEG instead of PNG (exact).
    """

    def __init__(
        self, path: Path, sensors: Mapping[str, Sensor], source: Source, take: Take, zero_ns: int, jpeg: bool = False
    ):
        self._sensors = sensors
        self._encoders = {name: MessageEncoder(sensor, jpeg) for name, sensor in sensors.items()}
        self._file = open(path, "xb")
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(library="terrella")
        topic = topics(sensors)
        about = {"name": source.name, "fps": source.fps, "robot": source.robot, "notes": list(source.notes)}
        self._add_metadata(SOURCE, {**about, "facts": dict(source.facts)})
        self._add_metadata(SENSORS, {name: {**sensor_json(sensors[name]), "topic": topic[name]} for name in sensors})
        known = {"start_ns": take.start_ns, "task": take.task}
        self._add_metadata(TAKE, {**known, "facts": dict(take.facts), "zero_ns": zero_ns})
        self._schemas: dict[str, int] = {}
        self._channels = {name: self._channel(topic[name], self._encoders[name].schema) for name in sensors}
        self._calibrations = {
            name: self._channel(topic[name] + CALIBRATION_TOPIC, message_encoder.calibration_schema())
            for name, sensor in sensors.items()
            if message_encoder.calibration(sensor, 0)
        }

    def __enter__(self) -> McapRecording:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close() if kind is None else self.abandon()

    def add(self, name: str, log_ns: int, value: np.ndarray) -> None:
        """Adds a reading; DatasetError where it differs from its sensor's declaration, OSError from the disk."""
        if name in self._calibrations:  # written once, before the first picture
            data = message_encoder.calibration(self._sensors[name], log_ns) or b""
            self._writer.add_message(self._calibrations.pop(name), log_ns, data, log_ns)
        data = self._encoders[name](value, log_ns)
        self._writer.add_message(self._channels[name], log_ns, data, log_ns)

    def flush(self) -> None:
        """Ends the chunk and passes all bytes to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Writes the index and closes the file; OSError from the disk."""
        try:
            self._writer.finish()
            self._file.close()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Closes the file as it is, without an index: the last chunk may be incomplete."""
        with suppress(OSError):
            self._file.close()

    def _channel(self, topic: str, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._writer.register_channel(topic, "protobuf", self._schemas[schema.name])

    def _add_metadata(self, name: str, values: Mapping[str, Any]) -> None:
        try:
            self._writer.add_metadata(name, {key: json.dumps(value) for key, value in values.items()})
        except (TypeError, ValueError) as error:
            self._file.close()
            raise DatasetError(f"The facts of a source, take or sensor are not JSON ({error}); drop them.") from error
