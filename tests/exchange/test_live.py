"""Live logging: what was logged is in the file or with the watcher, and nothing of it ever stops a recording."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

from terrella.core.errors import DatasetError
from terrella.data.source import Sensor
from terrella.exchange.live import Live

pytest.importorskip("mcap")
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from terrella.exchange.formats import mcap, mcap_write

CALIBRATION = {"width": 24, "height": 16, "distortion_model": "", "K": [9.0, 0, 12, 0, 9, 8, 0, 0, 1]}
SENSORS = {
    sensor.name: sensor
    for sensor in (
        Sensor("observation.images.front", "image", (16, 24, 3), "uint8", facts={"calibration": CALIBRATION}),
        Sensor("observation.depth", "depth", (6, 8)),
        Sensor("action", "vector", (2,), names=("steer", "gas")),
        Sensor("next.reward", "vector", (1,)),
    )
}
PICTURE = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)


def _until(true, seconds: float = 10.0) -> None:
    """Waits until `true()`; a test that waits in vain fails."""
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def _watch(live: Live, **options):
    return connect(f"ws://127.0.0.1:{live.port}", subprotocols=["foxglove.sdk.v1"], **options)  # type: ignore[list-item]


def _subscribe(watcher, advertised: dict, *topics: str) -> None:
    ids = {channel["topic"]: channel["id"] for channel in advertised["channels"]}
    subscriptions = [{"id": 10 + i, "channelId": ids[topic]} for i, topic in enumerate(topics)]
    watcher.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


def _heard(watcher) -> None:
    """Returns when all that the watcher sent before has been heard."""
    watcher.send("never heard of it")
    assert json.loads(watcher.recv(5))["op"] == "status"


# -- to a file ---------------------------------------------------------------------------------------------------------


def test_a_file_holds_what_was_logged(tmp_path):
    path = tmp_path / "new" / "live.mcap"
    with Live(str(path), SENSORS, "run") as live:
        value = np.array([0.5, -1], np.float32)
        for i in range(20):
            live.log("action", i / 10, value)
            value += 1  # the value logged is a copy
            live.log("observation.images.front", i / 10, PICTURE)
            live.log("next.reward", i / 10, 0.25)
        live.log("observation.depth", 2.0, np.full((6, 8), np.inf, np.float32))
    assert live.dropped == 0 and live.notes == () and live.port is None
    source = mcap.read(path)
    assert source.sensors == SENSORS and source.notes == () and source.name == "run"
    take = next(source.takes())
    assert take.start_ns == live.start_ns
    assert np.stack(take.readings["action"].values).tolist() == [[0.5 + i, -1 + i] for i in range(20)]
    assert np.allclose(take.readings["action"].time_s, np.arange(20) / 10, atol=1e-9)
    pictures = np.stack(list(take.readings["observation.images.front"].values))
    assert pictures.shape == (20, *PICTURE.shape)
    assert np.stack(take.readings["next.reward"].values).ravel().tolist() == [0.25] * 20
    assert np.isinf(take.readings["observation.depth"].values[0]).all()


def test_a_file_can_be_read_while_it_grows(tmp_path):
    path = tmp_path / "live.mcap"

    def seen() -> int:
        return len(next(mcap.read(path).takes()).readings["action"].values)

    with Live(path, SENSORS, "run") as live:
        for logged in range(1, 9):
            live.log("action", float(logged), np.zeros(2, np.float32))
            if logged in (3, 8):
                _until(lambda logged=logged: _readable(seen) == logged)


def _readable(count) -> int:
    try:
        return count()
    except DatasetError:
        return 0


SCRIPT = """
import sys, time
import numpy as np
from terrella.exchange.live import Live
from terrella.data.source import Sensor
live = Live(sys.argv[1], {"action": Sensor("action", "vector", (1,))}, "run")
i = 0
while True:
    live.log("action", i / 100, np.array([i], np.float32))
    print(i, flush=True)
    i += 1
    time.sleep(0.01)
"""


def test_kill_9_loses_at_most_half_a_second(tmp_path):
    path = tmp_path / "killed.mcap"
    with subprocess.Popen([sys.executable, "-c", SCRIPT, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        begun = time.monotonic()
        last, when = 0, []
        while last < 120:
            last = int(process.stdout.readline())
            when.append(time.monotonic() - begun)
        os.kill(process.pid, signal.SIGKILL)
    source = mcap.read(path)
    assert any("cut off" in note for note in source.notes)
    values = np.stack(next(source.takes()).readings["action"].values)[:, 0]
    assert values.tolist() == list(range(len(values)))
    assert when[-1] - when[len(values) - 1] < 1.0  # half a second, and how late a busy machine may be


def test_a_disk_that_fails_is_told_and_the_recording_goes_on(tmp_path, monkeypatch):
    live = Live(tmp_path / "full.mcap", SENSORS, "run")
    live.log("action", 0.0, np.zeros(2, np.float32))
    _until(lambda: _readable(lambda: len(next(mcap.read(tmp_path / "full.mcap").takes()).readings)) > 0)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(mcap_write.McapRecording, "flush", full)
    _until(lambda: bool(live.notes))
    for i in range(5):
        live.log("action", 1.0 + i, np.zeros(2, np.float32))
    live.close()
    assert "No space left" in live.notes[0] and "goes on" in live.notes[0] and live.dropped == 5
    assert len(next(mcap.read(tmp_path / "full.mcap").takes()).readings["action"].values) == 1


def test_readings_that_are_none_are_told_and_counted(tmp_path):
    with Live(tmp_path / "live.mcap", SENSORS, "run") as live:
        live.log("action", 0.0, np.zeros(2, np.float32))
        for name, time_s, value in (
            ("nothing", 0.0, 1.0),
            ("action", float("nan"), [0.0, 0.0]),
            ("action", 1e30, [0.0, 0.0]),
            ("action", 0.0, [0.0]),
            ("action", 0.0, "left"),
            ("action", 0.0, [[1], [1, 2]]),
            ("observation.images.front", 0.0, PICTURE[:-1]),
            ("observation.depth", 0.0, np.zeros((6, 8))),
        ):
            live.log(name, time_s, value)  # type: ignore[arg-type]
    assert live.dropped == 8 and len(live.notes) == 8
    live.log("action", 0.0, np.zeros(2, np.float32))
    live.close()
    assert live.dropped == 9
    assert len(next(mcap.read(tmp_path / "live.mcap").takes()).readings["action"].values) == 1


def test_logging_never_waits_for_a_slow_disk(tmp_path, monkeypatch):
    add = mcap_write.McapRecording.add

    def slow(*args):
        time.sleep(0.02)
        add(*args)

    monkeypatch.setattr(mcap_write.McapRecording, "add", slow)
    monkeypatch.setattr("terrella.exchange.live._MAX_QUEUED", 8)
    with Live(tmp_path / "slow.mcap", SENSORS, "run") as live:
        begun = time.perf_counter()
        for i in range(200):
            live.log("action", i / 100, np.zeros(2, np.float32))
        assert time.perf_counter() - begun < 0.02 * 100
    kept = len(next(mcap.read(tmp_path / "slow.mcap").takes()).readings["action"].values)
    assert kept + live.dropped == 200 and live.dropped > 0 and "keep up" in live.notes[0]


@pytest.mark.parametrize("target", ["", "port", "live.txt", "-1", "99999", "٣"])
def test_targets_that_cannot_be_are_refused(target):
    with pytest.raises(DatasetError, match="neither a port nor an .mcap file|Port 99999"):
        Live(target, SENSORS, "run")


def test_what_exists_is_not_overwritten(tmp_path):
    (tmp_path / "live.mcap").write_bytes(b"mine")
    with pytest.raises(DatasetError, match="exists already"):
        Live(tmp_path / "live.mcap", SENSORS, "run")
    with pytest.raises(DatasetError, match="cannot be written"):
        Live(tmp_path / "live.mcap" / "live.mcap", SENSORS, "run")
    assert (tmp_path / "live.mcap").read_bytes() == b"mine"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(DatasetError, match="cannot be served.*choose another"):
            Live(str(taken.getsockname()[1]), SENSORS, "run")


# -- to a watcher ------------------------------------------------------------------------------------------------------


def test_a_watcher_sees_what_it_subscribes_to():
    with Live("0", SENSORS, "my run") as live:
        with _watch(live) as watcher:
            assert watcher.subprotocol == "foxglove.sdk.v1"
            info, advertised = (json.loads(watcher.recv(5)) for _ in range(2))
            assert info["op"] == "serverInfo" and info["name"] == "my run"
            channels = {channel["topic"]: channel for channel in advertised["channels"]}
            assert channels["/observation/images/front"]["schemaName"] == "foxglove.CompressedImage"
            assert channels["/observation/images/front"]["encoding"] == "protobuf"
            assert channels["/action"]["schemaName"] == "terrella.Vector"
            _subscribe(watcher, advertised, "/observation/images/front", "/observation/images/front/calibration")
            _heard(watcher)
            for i in range(3):
                live.log("action", i / 10, np.zeros(2, np.float32))
                live.log("observation.images.front", i / 10, PICTURE)
            for i in range(3):
                for subscription in (10, 11):
                    message = watcher.recv(5)
                    log_ns = live.start_ns + i * 10**8
                    assert struct.unpack_from("<BIQ", message) == (1, subscription, log_ns)
                    if subscription == 10:
                        picture = CompressedImage.FromString(bytes(message[13:]))
                        assert picture.format == "jpeg" and picture.timestamp.nanos == log_ns % 10**9
                    else:
                        assert list(CameraCalibration.FromString(bytes(message[13:])).K) == CALIBRATION["K"]
            watcher.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [10, 11]}))
            _subscribe(watcher, advertised, "/action")
            _heard(watcher)
            live.log("observation.images.front", 1.0, PICTURE)
            live.log("action", 1.0, np.ones(2, np.float32))
            assert watcher.recv(5)[:13] == struct.pack("<BIQ", 1, 10, live.start_ns + 10**9)
    assert live.dropped == 0 and live.notes == ()
    with socket.socket() as again:  # the port is free
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", live.port or 0))


@pytest.mark.parametrize(
    "message",
    [
        b"\x00\x01",
        "[]",
        "{}",
        '{"op": "fly"}',
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}',
        '{"op": "subscribe", "subscriptions": [[1]]}',
        '{"op": "unsubscribe", "subscriptionIds": [{}]}',
        "[" * 60_000,
        '{"op": "subscribe", "subscriptions": [{"id": 1e999, "channelId": 1}]}',
    ],
)
def test_what_a_watcher_says_wrong_is_answered(message):
    with Live("0", SENSORS, "run") as live:
        with _watch(live) as watcher:
            watcher.recv(5), watcher.recv(5)
            watcher.send(message)
            assert json.loads(watcher.recv(5))["op"] == "status"
        with _watch(live) as watcher:
            assert json.loads(watcher.recv(5))["op"] == "serverInfo"


def test_only_foxglove_and_this_machine_may_watch():
    with Live("0", SENSORS, "run") as live:
        for origin in (
            "https://evil.example",
            "http://app.foxglove.dev",
            "null",
            "https://evil-foxglove.dev",
            "https://[",
        ):
            with pytest.raises(InvalidStatus, match="403"):
                _watch(live, origin=origin)
        with pytest.raises(InvalidStatus, match="403"):  # a name of the attacker's that leads here
            _watch(live, additional_headers={"Host": "evil.example"})
        for origin in ("https://app.foxglove.dev", "http://localhost:8080", "file://", None):
            with _watch(live, origin=origin) as watcher:
                assert json.loads(watcher.recv(5))["op"] == "serverInfo"


def test_a_slow_watcher_holds_up_nobody(monkeypatch):
    monkeypatch.setattr("terrella.exchange.live_server._BACKLOG_BYTES", 2**18)
    sensor = Sensor("observation.images.big", "image", (256, 256, 3), "uint8")
    noise = np.random.default_rng(0).integers(0, 255, sensor.shape, np.uint8)
    with Live("0", {sensor.name: sensor}, "run") as live:
        with _watch(live, max_queue=1, close_timeout=0.1) as slow, _watch(live) as quick:
            for watcher in (slow, quick):
                watcher.recv(5)
                _subscribe(watcher, json.loads(watcher.recv(5)), "/observation/images/big")
                _heard(watcher)
            for i in range(80):
                live.log(sensor.name, i / 30, noise)
                assert len(quick.recv(5)) > 2**16
    assert live.dropped == 0 and live.notes == ()


def test_what_never_finishes_its_handshake_is_let_go(monkeypatch):
    monkeypatch.setattr("terrella.exchange.live_server._HEAD_TIMEOUT_S", 0.3)
    with Live("0", SENSORS, "run") as live:
        idle = [socket.create_connection(("127.0.0.1", live.port or 0)) for _ in range(20)]
        endless = socket.create_connection(("127.0.0.1", live.port or 0))
        endless.sendall(b"GET / HTTP/1.1\r\n" + b"x: " + b"y" * 2**15)
        for connection in (*idle, endless):
            connection.settimeout(5)
            try:
                assert connection.recv(100) == b""
            except ConnectionResetError:
                pass
            connection.close()
        with _watch(live) as watcher:
            assert json.loads(watcher.recv(5))["op"] == "serverInfo"


def test_a_watcher_that_vanishes_is_forgotten():
    with Live("0", SENSORS, "run") as live:
        for _ in range(12):  # more than may watch at a time
            with _watch(live) as watcher:
                watcher.recv(5)
                _subscribe(watcher, json.loads(watcher.recv(5)), "/action")
                watcher.socket.shutdown(socket.SHUT_RDWR)
        live.log("action", 0.0, np.zeros(2, np.float32))

        def served() -> bool:
            with _watch(live) as watcher:
                try:
                    return json.loads(watcher.recv(5))["op"] == "serverInfo"
                except Exception:  # too many watchers still
                    return False

        _until(served)
    assert live.notes == ()
