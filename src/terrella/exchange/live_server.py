"""A WebSocket server on this machine that the Foxglove app connects to and sees sensors live.

Its protocol: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md. A watcher that does not keep up loses the
oldest of what waits for it; nobody else waits for it.
"""

from __future__ import annotations

import asyncio
import base64
import json
import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from ..core.errors import DatasetError
from ..data.source import Sensor
from .formats import foxglove
from .formats.mcap import topics

SUBPROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))
_HERE = ("127.0.0.1", "localhost", "::1")
_WATCHERS, _SUBSCRIPTIONS = 8, 1024
_BEHIND_BYTES, _BEHIND_COUNT = 2**23, 1024  # what may wait for one watcher
_ENCODING = "protobuf"


@dataclass
class _Watcher:
    """One connection: subscription id -> channel, and (subscription, time, payload) that wait to be sent."""

    socket: ServerConnection
    subscriptions: dict[int, int] = field(default_factory=dict)
    waiting: deque[tuple[int, int, bytes]] = field(default_factory=deque)
    behind: int = 0
    ready: asyncio.Event = field(default_factory=asyncio.Event)


class LiveServer:
    """Serves the sensors' readings until closed; `dropped` counts messages that slow watchers lost.

    A reading is encoded only when somebody watches its sensor. Pages of the web at large are refused: only the Foxglove
    app, local pages and programs may watch. DatasetError where the port cannot be had.
    """

    def __init__(self, port: int, sensors: Mapping[str, Sensor], name: str, image: str = "jpeg"):
        self.dropped = 0
        self.port = port
        self._name, self._sensors = name, sensors
        self._encoders = {key: foxglove.Encoder(sensor, _ENCODING, image) for key, sensor in sensors.items()}
        self._channels = {key: number for number, key in enumerate(sensors, 1)}
        topic = topics(sensors)
        self._advertised = [_channel(i, topic[key], self._encoders[key].codec) for key, i in self._channels.items()]
        self._calibrated: dict[int, tuple[int, bytes]] = {}  # sent to whoever subscribes: they never change
        for key, sensor in sensors.items():
            now = time.time_ns()
            data = foxglove.calibration_message(sensor.facts.get("calibration"), sensor.frame, now, _ENCODING)
            if data is not None:
                number = len(self._advertised) + 1
                calibration = foxglove.codec(foxglove.CALIBRATION, _ENCODING)
                self._advertised.append(_channel(number, topic[key] + "/calibration", calibration))
                self._calibrated[number] = (now, data)
        self._watched: frozenset[int] = frozenset()
        self._watchers: list[_Watcher] = []
        self._loop = asyncio.new_event_loop()
        self._started, self._stop = threading.Event(), asyncio.Event()
        self._failure: OSError | OverflowError | None = None
        self._thread = threading.Thread(target=self._run, name="live-server", daemon=True)
        self._thread.start()
        self._started.wait()
        if self._failure:
            raise DatasetError(f"Port {port} cannot be served ({self._failure}); choose another.") from self._failure

    def add(self, name: str, time_ns: int, value: np.ndarray) -> None:
        """Sends a reading to those who watch its sensor, without waiting for them."""
        channel = self._channels[name]
        if channel in self._watched:
            payload = self._encoders[name](value, time_ns)
            self._loop.call_soon_threadsafe(self._send, channel, time_ns, payload)
        else:
            foxglove.checked(self._sensors[name], value)

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Says goodbye to all watchers and frees the port."""
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    abandon = close

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except (OSError, OverflowError) as error:  # the port is taken, forbidden or none
            self._failure = error
        finally:
            self._loop.close()
            self._started.set()

    async def _serve(self) -> None:
        silent = logging.Logger("terrella.live", logging.CRITICAL + 1)
        server = await serve(
            self._watch,
            "127.0.0.1",
            self.port,
            subprotocols=SUBPROTOCOLS,
            process_request=_admit,
            compression=None,
            max_size=2**16,
            close_timeout=1,
            logger=silent,
        )
        async with server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._started.set()
            await self._stop.wait()

    async def _watch(self, socket: ServerConnection) -> None:
        if len(self._watchers) >= _WATCHERS:
            await socket.close(1013, "too many watchers")
            return
        watcher = _Watcher(socket)
        self._watchers.append(watcher)
        sender = asyncio.create_task(_send_all(watcher))
        info = {"name": self._name, "capabilities": [], "metadata": {}, "sessionId": str(time.time_ns())}
        try:
            await socket.send(json.dumps({"op": "serverInfo", **info}))
            await socket.send(json.dumps({"op": "advertise", "channels": self._advertised}))
            async for message in socket:
                if wrong := self._hear(watcher, message):
                    await socket.send(json.dumps({"op": "status", "level": 1, "message": wrong}))
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self._watchers.remove(watcher)
            self._count_watched()

    def _hear(self, watcher: _Watcher, message: str | bytes) -> str:
        """Does what a watcher asks; returns what is wrong with it."""
        try:
            asked = json.loads(message)
            if asked["op"] == "subscribe":
                for item in asked["subscriptions"]:
                    self._subscribe(watcher, int(item["id"]), int(item["channelId"]))
            elif asked["op"] == "unsubscribe":
                for number in asked["subscriptionIds"]:
                    watcher.subscriptions.pop(int(number), None)
            else:
                return f"'{str(asked['op'])[:40]}' is not served here."
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
            return f"The message is not understood ({type(error).__name__})."
        finally:
            self._count_watched()
        return ""

    def _subscribe(self, watcher: _Watcher, number: int, channel: int) -> None:
        known = 1 <= channel <= len(self._advertised)
        if not known or not 0 <= number < 2**32 or len(watcher.subscriptions) >= _SUBSCRIPTIONS:
            raise ValueError(channel)
        watcher.subscriptions[number] = channel
        if channel in self._calibrated:
            self._queue(watcher, number, *self._calibrated[channel])

    def _count_watched(self) -> None:
        self._watched = frozenset(channel for watcher in self._watchers for channel in watcher.subscriptions.values())

    def _send(self, channel: int, time_ns: int, payload: bytes) -> None:
        for watcher in self._watchers:
            for number, wanted in watcher.subscriptions.items():
                if wanted == channel:
                    self._queue(watcher, number, time_ns, payload)

    def _queue(self, watcher: _Watcher, number: int, time_ns: int, payload: bytes) -> None:
        watcher.waiting.append((number, time_ns, payload))
        watcher.behind += len(payload)
        while len(watcher.waiting) > 1 and (watcher.behind > _BEHIND_BYTES or len(watcher.waiting) > _BEHIND_COUNT):
            watcher.behind -= len(watcher.waiting.popleft()[2])
            self.dropped += 1
        watcher.ready.set()


async def _send_all(watcher: _Watcher) -> None:
    try:
        while True:
            await watcher.ready.wait()
            while watcher.waiting:
                number, time_ns, payload = watcher.waiting.popleft()
                watcher.behind -= len(payload)
                await watcher.socket.send(struct.pack("<BIQ", 1, number, time_ns) + payload)
            watcher.ready.clear()
    except ConnectionClosed:
        pass


def _channel(number: int, topic: str, codec: foxglove.Codec) -> dict[str, Any]:
    text = base64.b64encode(codec.schema) if codec.schema_encoding == "protobuf" else codec.schema
    return {
        "id": number,
        "topic": topic,
        "encoding": codec.message_encoding,
        "schemaName": codec.schema_name,
        "schemaEncoding": codec.schema_encoding,
        "schema": text.decode(),
    }


def _admit(socket: ServerConnection, request: Request) -> Response | None:
    """Refuses the pages of strangers, which a browser would let connect to this machine."""
    try:
        hosts = request.headers.get_all("Host")
        origins = request.headers.get_all("Origin")
        if len(hosts) == 1 and urlsplit(f"//{hosts[0]}").hostname in _HERE and all(map(_welcome, origins)):
            return None
    except ValueError:
        pass
    return socket.respond(403, "Only Foxglove and programs of this machine may watch.\n")


def _welcome(origin: str) -> bool:
    """The Foxglove app, on the web or installed (no web page has a scheme like its own), and local pages."""
    parts = urlsplit(origin)
    if parts.scheme in ("http", "https"):
        host = parts.hostname or ""
        return host in _HERE or (parts.scheme == "https" and (host == "foxglove.dev" or host.endswith(".foxglove.dev")))
    return parts.scheme != ""
