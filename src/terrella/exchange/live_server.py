"""A WebSocket server on this machine, Foxglove's own, that the Foxglove app connects to for live sensors.

It accepts every connection (measured: foxglove-sdk 0.30 accepts any Origin and Host), even of web pages. So it listens on a
random loopback address, and a gate in front of it admits only the Foxglove app, local pages and programs.
"""

import asyncio
import io
import logging
import random
import threading
from collections.abc import Mapping
from contextlib import suppress
from http.client import HTTPException, parse_headers
from urllib.parse import urlsplit

import numpy as np

from ..core.errors import DatasetError
from ..data.source import Sensor
from .formats import message_encoder
from .formats.mcap import topics

try:
    import foxglove
except ImportError as error:
    raise DatasetError("Foxglove needs packages that are not installed: pip install 'terrella[mcap]'.") from error

_LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
_MAX_CLIENTS = 8
_BACKLOG_BYTES = 2**25  # of readings queued for one client; a slower client loses the rest
_MAX_HEAD, _HEAD_TIMEOUT_S = 2**14, 5.0  # bytes and seconds of a handshake
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class LiveServer:
    """Serves the sensors' readings on `port` until closed; a reading is encoded only if a client subscribes to its sensor.
    DatasetError where the port is not available."""

    def __init__(self, port: int, sensors: Mapping[str, Sensor], name: str):
        self._sensors, self._context = sensors, (context := foxglove.Context())  # channels end with their context
        self._encoders = {key: message_encoder.MessageEncoder(sensor, jpeg=True) for key, sensor in sensors.items()}
        topic, calibration = topics(sensors), message_encoder.calibration_schema()

        def channel(topic: str, schema: foxglove.Schema) -> foxglove.Channel:
            return foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=context)

        self._channels = {key: channel(topic[key], self._encoders[key].schema) for key in sensors}
        self._calibrations = {
            key: channel(topic[key] + "/calibration", calibration)
            for key, sensor in sensors.items()
            if message_encoder.calibration(sensor, 0)
        }
        largest = max((int(np.prod(it.shape)) * np.dtype(it.dtype).itemsize for it in sensors.values()), default=1)
        self._server = _serve(name, context, min(max(_BACKLOG_BYTES // max(largest, 1), 16), 1024))
        try:
            self._gate = _Gate(port, self._server)
        except BaseException:
            self._server[0].stop()
            raise
        self.port = self._gate.port

    def add(self, name: str, time_ns: int, value: np.ndarray) -> None:
        """Sends a reading, and its camera's calibration, to the subscribed clients, without waiting for them."""
        if self._channels[name].has_sinks():
            self._channels[name].log(self._encoders[name](value, time_ns), log_time=time_ns)
        else:
            message_encoder.checked(self._sensors[name], value)
        if name in self._calibrations and self._calibrations[name].has_sinks():
            data = message_encoder.calibration(self._sensors[name], time_ns) or b""
            self._calibrations[name].log(data, log_time=time_ns)

    def flush(self) -> None:
        """Does nothing: readings are sent at once."""

    def close(self) -> None:
        """Disconnects all clients and frees the port."""
        self._server[0].stop()
        self._gate.close()

    abandon = close


def _serve(name: str, context: foxglove.Context, backlog: int) -> tuple[foxglove.websocket.WebSocketServer, str]:
    """Foxglove's server and its address: a random one of 127.0.0.0/8, where the system has more than 127.0.0.1."""
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # clients get their own error messages
    hidden = ".".join(str(random.SystemRandom().randint(1, 254)) for _ in range(3))
    options = {"name": name, "port": 0, "context": context, "message_backlog_size": backlog}
    for host in (f"127.{hidden}", "127.0.0.1"):  # macOS has only the second
        try:
            return foxglove.start_server(host=host, **options), host
        except RuntimeError as error:
            failure = error
    raise DatasetError(f"Foxglove's server cannot be started ({failure}).") from failure


class _Gate:
    """Forwards admitted connections to the server, in its own thread."""

    def __init__(self, port: int, server: tuple[foxglove.websocket.WebSocketServer, str]):
        self._inner = server[1], server[0].port
        self._stop, self._inside = asyncio.Event(), 0
        self._started, self.port = threading.Event(), port
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="live-server", daemon=True)
        self._thread.start()
        self._started.wait()
        if self._failure:
            raise DatasetError(f"Port {port} cannot be served ({self._failure}); choose another.") from self._failure

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def _run(self) -> None:
        try:
            asyncio.run(self._open())
        except (OSError, OverflowError) as error:  # the port is taken, forbidden or invalid
            self._failure = error
        finally:
            self._started.set()

    async def _open(self) -> None:
        server = await asyncio.start_server(self._admit, "127.0.0.1", self.port, limit=_MAX_HEAD)
        self.port, self._loop = server.sockets[0].getsockname()[1], asyncio.get_running_loop()
        self._started.set()
        await self._stop.wait()
        server.close()  # connections end with the loop

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._inside += 1
        ends = [writer]
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_TIMEOUT_S)
            if self._inside > _MAX_CLIENTS or not _is_admitted(head):
                writer.write(_REFUSED)
                await writer.drain()
                return
            from_server, to_server = await asyncio.open_connection(*self._inner)
            ends.append(to_server)
            to_server.write(head)
            both = [asyncio.ensure_future(_forward(*pair)) for pair in ((reader, to_server), (from_server, writer))]
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            for task in both:
                task.cancel()
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
            pass
        finally:
            self._inside -= 1
            for end in ends:
                end.close()


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(2**16):
            writer.write(data)
            await writer.drain()


def _is_admitted(head: bytes) -> bool:
    """Whether a handshake comes from Foxglove, a local page or a program. Browsers send the page's Origin."""
    try:
        headers = parse_headers(io.BytesIO(head.partition(b"\r\n")[2]))
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        return len(hosts) == 1 and urlsplit(f"//{hosts[0]}").hostname in _LOCAL_HOSTS and all(map(_is_trusted, origins))
    except (ValueError, HTTPException):
        return False


def _is_trusted(origin: str) -> bool:
    """Whether an Origin is the Foxglove app, on the web or installed (with its own scheme), or a local page."""
    parts = urlsplit(origin)
    if parts.scheme in ("http", "https"):
        host = parts.hostname or ""
        return host in _LOCAL_HOSTS or (
            parts.scheme == "https" and (host == "foxglove.dev" or host.endswith(".foxglove.dev"))
        )
    return parts.scheme != ""
