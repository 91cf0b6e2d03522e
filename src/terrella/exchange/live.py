"""Streams a recording while it is made, to a file or to Foxglove, so that a running robot or game can be watched."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from ..data.source import Sensor, Source, Take

_FLUSH_S = 0.25  # how far a file may be behind, and what kill -9 may lose
_MAX_QUEUED_BYTES, _MAX_QUEUED = 2**26, 2**14  # readings that may wait to be encoded
_MAX_NOTES = 20


class Live:
    """Queues readings and encodes them in a thread of its own. Readings that it cannot keep up with are dropped and counted.

    target:  a new .mcap file, at most half a second behind; or a port number as text, for a WebSocket server on 127.0.0.1
             to which Foxglove connects ("0" chooses a free port, see `port`).
    sensors: name -> Sensor, every sensor that will be logged.

    `log` never raises and never waits: errors go to `notes`, lost readings are counted in `dropped`. DatasetError, from the
    constructor only, where the target cannot be used.
    """

    def __init__(self, target: str | Path, sensors: Mapping[str, Sensor], name: str):
        self.start_ns = time.time_ns()
        self._sensors = dict(sensors)
        self._notes: list[str] = []
        self._lost = 0
        self._queue: deque[tuple[str, int, np.ndarray]] = deque()
        self._bytes, self._closing, self._broken = 0, False, False
        self._wake = threading.Condition()
        self._out = _open(str(target), self._sensors, name, self.start_ns)
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Readings lost so far, to a full disk or a slow machine. Those that only a slow viewer misses are not counted."""
        return self._lost

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong, each note once."""
        return tuple(self._notes)

    @property
    def port(self) -> int | None:
        """Where the server listens; None for a file."""
        return getattr(self._out, "port", None)

    def log(self, sensor_name: str, time_s: float, value: np.ndarray) -> None:
        """Logs a copy of a reading, `time_s` seconds after `start_ns`. Vectors are cast to their sensor's dtype,
        pictures, depth and points must have it."""
        sensor = self._sensors.get(sensor_name)
        if sensor is None:
            return self._lose(f"'{sensor_name}' is not a declared sensor; declare it, or do not log it.")
        try:
            value = np.array(value)
            if sensor.kind == "vector":
                value = value.astype(sensor.dtype, casting="same_kind").reshape(sensor.shape)
            time_ns = self.start_ns + round(float(time_s) * 1e9)
            if not 0 <= time_ns < 2**63:
                raise OverflowError(f"{time_s} s is out of range")
        except Exception as error:  # a bad value must not stop the recording
            return self._lose(f"A reading of '{sensor_name}' cannot be logged ({error}); mend what logs it.")
        with self._wake:
            if self._closing or self._broken:
                self._lost += 1
            elif self._bytes + value.nbytes > _MAX_QUEUED_BYTES or len(self._queue) >= _MAX_QUEUED:
                self._lose("Live logging does not keep up; readings are dropped. Log less often, or smaller pictures.")
            else:
                self._bytes += value.nbytes
                self._queue.append((sensor_name, time_ns, value))
                self._wake.notify()

    def close(self) -> None:
        """Writes the queue and closes the file or the server. May be called again."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _lose(self, note: str) -> None:
        with self._wake:
            self._lost += 1
            self._note(note)

    def _note(self, note: str) -> None:
        if note and note not in self._notes and len(self._notes) < _MAX_NOTES:
            self._notes.append(note)

    def _run(self) -> None:
        flush_at = time.monotonic() + _FLUSH_S
        while (item := self._next(flush_at)) is not None:
            if item and self._broken:
                self._lose("")
            elif item:
                self._try(self._out.add, *item)
            if time.monotonic() >= flush_at:
                if not self._broken:
                    self._try(self._out.flush)
                flush_at = time.monotonic() + _FLUSH_S
        self._try(self._out.abandon if self._broken else self._out.close)

    def _next(self, flush_at: float) -> tuple[str, int, np.ndarray] | tuple[()] | None:
        """The next reading; () when a flush is due; None at the end."""
        with self._wake:
            if not self._queue and not self._closing:
                self._wake.wait(max(0.0, flush_at - time.monotonic()))
            if self._queue:
                item = self._queue.popleft()
                self._bytes -= item[2].nbytes
                return item
            return None if self._closing else ()

    def _try(self, do, *item) -> None:
        try:
            do(*item)
        except DatasetError as error:  # concerns this reading only
            self._lose(str(error))
        except Exception as error:  # from the disk or a library: it must not stop the recording
            self._broken = True
            self._note(f"Live logging has stopped ({type(error).__name__}: {error}); the recording goes on.")
            if item:
                self._lose("")


def _open(target: str, sensors: Mapping[str, Sensor], name: str, start_ns: int):
    """An object with add(name, time_ns, value), flush(), close() and abandon()."""
    if target.isascii() and target.isdigit():
        from .live_server import LiveServer

        return LiveServer(int(target), sensors, name)
    if not target.endswith(".mcap"):
        raise DatasetError(f"'{target}' is neither a port nor an .mcap file; name one of these.")
    from .formats.mcap_write import McapRecording

    source = Source(name, sensors, lambda: iter(()))
    if Path(target).exists():
        raise DatasetError(f"'{target}' exists already; choose another name for the live log.")
    try:
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        return McapRecording(Path(target), sensors, source, Take({}, start_ns=start_ns), start_ns, jpeg=True)
    except OSError as error:
        raise DatasetError(f"'{target}' cannot be written ({error.strerror}); choose another place.") from error
