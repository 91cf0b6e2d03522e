"""The server against strangers: junk, floods, other sites, wrong tokens, taken ports; and clips that can be watched."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import json
import socket
import time
import urllib.error
import urllib.request

import av
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from terrella.core.errors import ServeError
from terrella.serve import http_server, serve
from terrella.serve.guard import RateLimit, is_loopback, refusal
from terrella.serve.http_server import open_port, starting_command
from terrella.serve.server import ServeConfig

from .panorama import Panorama, SlowDream
from .wire import decode_frame


class Client:
    """A page without a browser."""

    def __init__(self, url: str, **options):
        self._connecting = connect(url, open_timeout=10, **options)
        self.events: list[dict] = []

    def __enter__(self):
        self.socket = self._connecting.__enter__()
        return self

    def __exit__(self, *exception):
        self._connecting.__exit__(*exception)

    def say(self, kind: str, **body) -> None:
        self.socket.send(json.dumps({"type": kind, **body}))

    def next(self):
        data = self.socket.recv(timeout=10)
        if isinstance(data, str):
            self.events.append(json.loads(data))
            return self.events[-1]
        frame = decode_frame(data)
        self.say("ack", seq=frame.seq)
        return frame

    def event(self, kind: str) -> dict:
        while not isinstance(body := self.next(), dict) or body["type"] != kind:
            pass
        return body

    def frame(self, step: int = 0):
        while isinstance(frame := self.next(), dict) or frame.step < step:
            pass
        return frame


def get(url: str, **headers) -> tuple[int, dict, bytes]:
    """Status, headers and body, whatever the status."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers), error.read()


def test_a_page_is_told_about_the_world_and_gets_frames(serve_world):
    with Client(serve_world().socket_url) as client:
        hello = client.event("hello")
        world = hello["worlds"][0]
        assert (
            world["name"] == "panorama"
            and world["cameras"] == [{"channel": "rgb", "name": "main", "size": [48, 64]}]
            and world["card"]["scores"] == {"psnr": 31.2}
        )
        frame = client.frame(5)
        assert frame.images[0].jpeg[:2] == b"\xff\xd8" and frame.newest == frame.step and frame.generation_ms > 0


def test_two_worlds_come_side_by_side(serve_world):
    with Client(serve_world([Panorama(forkable=False), SlowDream()]).socket_url) as client:
        hello = client.event("hello")
        assert [world["label"] for world in hello["worlds"]] == ["game", "dream"] and "running game" in hello[
            "no_rewind"
        ]
        assert len(client.frame(2).images) == 2


@pytest.mark.parametrize(
    "junk", ["hello?", b"\x00\xff\xfe", '{"type": "explode"}', '{"type": "ack", "seq": -1}', "[" * 3000]
)
def test_junk_is_answered_and_play_goes_on(serve_world, junk):
    with Client(serve_world().socket_url) as client:
        client.frame(2)
        client.socket.send(junk)
        assert len(client.event("error")["text"]) > 20
        step = client.frame().step
        client.frame(step + 3)


def test_a_long_message_is_refused_and_a_huge_one_ends_the_connection(serve_world):
    server = serve_world()
    with Client(server.socket_url) as client:
        client.socket.send("x" * 10_000)
        assert "too long" in client.event("error")["text"]
        client.socket.send("x" * 1_000_000)
        with pytest.raises(ConnectionClosed):
            while True:
                client.next()
    with Client(server.socket_url) as client:
        client.frame(1)


def test_a_flood_is_cut_off_and_the_server_lives(serve_world):
    server = serve_world(config=ServeConfig(per_s=50, burst=100))
    with Client(server.socket_url) as client, pytest.raises(ConnectionClosed):
        for number in range(5000):
            client.say("controls", id=number, held=["KeyW"], t=0)
        while True:
            client.next()
    with Client(server.socket_url) as client:
        client.frame(2)


def test_many_faults_end_the_connection(serve_world):
    with Client(serve_world(config=ServeConfig(faults=3)).socket_url) as client:
        for _ in range(3):
            client.socket.send("junk")
        with pytest.raises(ConnectionClosed):
            while True:
                client.next()


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Host": "evil.example:80"}, {"Origin": "null"}]
)
def test_other_sites_are_refused_before_the_upgrade(serve_world, headers):
    server = serve_world()
    if "Host" in headers:
        status, _, body = get(server.url, **headers)
        assert status == 403 and b"localhost" in body
        return
    with pytest.raises(InvalidStatus) as refused, Client(server.socket_url, additional_headers=headers):
        pass
    assert refused.value.response.status_code == 403


def test_our_own_page_may_connect(serve_world):
    server = serve_world()
    with Client(server.socket_url, additional_headers={"Origin": server.url.rstrip("/")}) as client:
        client.frame(1)


def test_a_token_opens_and_nothing_else_does(serve_world):
    server = serve_world(token="sesame")
    assert server.url.endswith("?token=sesame")
    for wrong in ("", "?token=", "?token=Sesame", "?token=s%C3%A9same"):
        with pytest.raises(InvalidStatus), Client(server.socket_url + wrong):
            pass
        assert get(server.url.partition("?")[0] + "check" + wrong)[0] == 403
    with Client(server.socket_url + "?token=sesame") as client:
        client.frame(1)


def test_the_rules_of_refusal():
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost") and not is_loopback("10.0.0.2")
    assert not refusal({"host": "localhost:1", "origin": "http://localhost:1"}, "127.0.0.1", None, None)
    assert not refusal({"host": "[::1]:1"}, "127.0.0.1", None, None)
    assert refusal({"host": "localhost:1", "origin": "http://localhost:2"}, "127.0.0.1", None, None)
    assert refusal({"host": "evil.example"}, "127.0.0.1", None, None) and refusal({}, "127.0.0.1", None, None)
    assert not refusal({"host": "10.0.0.2:1"}, "0.0.0.0", "t", "t") and refusal(
        {"host": "10.0.0.2:1"}, "0.0.0.0", "t", None
    )
    for headers in ({"host": "["}, {"host": "localhost:1", "origin": "http://["}):
        assert refusal(headers, "127.0.0.1", None, None) and refusal(headers, "0.0.0.0", "t", "t")
    assert not refusal({"host": "10.0.0.2:1"}, "0.0.0.0", "", None), "an empty token is none"


@pytest.mark.parametrize("token", [None, ""])
def test_an_address_that_others_reach_gets_a_token(token, serve_world, monkeypatch):
    seen = []
    monkeypatch.setattr("uvicorn.Server.run", lambda server, sockets: seen.append(server.config.app))
    monkeypatch.setattr("terrella.serve.http_server.is_loopback", lambda host: False)
    monkeypatch.setattr("terrella.serve.http_server.page_address", lambda host, port, token: seen.append(token))
    serve([Panorama()], ServeConfig(port=0, token=token))
    assert isinstance(seen[0], str) and len(seen[0]) > 16


def test_rates_refill():
    now = [0.0]
    rate = RateLimit(per_s=2, burst=3, clock=lambda: now[0])
    assert [rate.allows() for _ in range(4)] == [True, True, True, False]
    now[0] = 1.0
    assert [rate.allows() for _ in range(3)] == [True, True, False]


def test_headers_and_paths(serve_world):
    server = serve_world()
    _, headers, body = get(server.url)
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and b"/app.js" in body
    for path in ("../../etc/passwd", "%2e%2e/server.py", "style.css/..", "clip/nobody.mp4", "clip/%2e%2e%2fx.mp4"):
        assert get(server.url + path)[0] in (403, 404)


def test_a_taken_port_is_one_clear_sentence():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ServeError, match=f"port {port} is in use"):
            serve([Panorama()], ServeConfig(port=port))
    with pytest.raises(ServeError, match="no address"):
        open_port("no.such.host.invalid", 0)
    with pytest.raises(ServeError, match="no port"):
        open_port("127.0.0.1", 70000)
    with pytest.raises(ServeError, match="cannot listen"):
        open_port("203.0.113.7", 0)  # a documentation address: never this machine's


def test_seats_are_counted_and_the_absent_make_room(serve_world):
    server = serve_world([Panorama(forkable=False)])
    with Client(server.socket_url) as first:
        first.frame(1)
        with Client(server.socket_url) as second:
            assert "somebody else" in second.event("error")["text"]
            with pytest.raises(ConnectionClosed):
                second.next()
    for _ in range(200):  # the server hears of the closed socket a moment later
        if not next(iter(server.sessions._open.values()))[0].connected:
            break
        time.sleep(0.01)
    with Client(server.socket_url) as third:
        third.frame(1)


def test_a_session_is_resumed_and_taken_over(serve_world):
    server = serve_world()
    with Client(server.socket_url) as first:
        name = first.event("hello")["session"]
        step = first.frame(10).step
        with Client(f"{server.socket_url}?session={name}") as second:
            hello = second.event("hello")
            assert hello["session"] == name and hello["resumed"] and second.frame().step >= step
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    first.next()
            assert closed.value.rcvd.code == 4001


def test_lost_sessions_are_swept(serve_world):
    server = serve_world(config=ServeConfig(grace_s=0.0))
    with Client(server.socket_url) as client:
        client.say("record", on=True)
        while not client.event("status")["recording"]:
            pass
        client.frame(client.frame().step + 4)
    for _ in range(1000):
        if server.sinks[0].closed:
            break
        time.sleep(0.01)
    assert server.sinks[0].closed and server.sinks[0].ends == 1


def test_a_clip_can_be_watched(serve_world):
    server = serve_world([Panorama(forkable=False), SlowDream()])
    with Client(server.socket_url) as client:
        name = client.event("hello")["session"]
        client.frame(12)
        _, headers, body = get(f"{server.url}clip/{name}.mp4")
        assert headers["content-disposition"] == 'attachment; filename="fixed-panorama.mp4"'
        with av.open(io.BytesIO(body)) as film:
            frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
            assert film.streams.video[0].average_rate == 50
    assert len(frames) >= 12 and frames[0].shape == (480, 1280, 3)
    assert abs(frames[-1][100:, :640].astype(int) - frames[-1][100:, 640:]).mean() < 8, "game and dream, side by side"


def test_recording_without_a_folder_says_so(serve_world):
    with Client(serve_world(record=False).socket_url) as client:
        assert "--record" in client.event("hello")["no_record"]
        client.say("record", on=True)
        assert "--record" in client.event("error")["text"]


def raw(server) -> socket.socket:
    """A connection on which nothing is said yet."""
    port = int(server.url.partition("?")[0].rstrip("/").rpartition(":")[2])
    return socket.create_connection(("127.0.0.1", port), timeout=10)


def closed(connection: socket.socket) -> bool:
    """Whether the server has let go of it (waits up to the timeout)."""
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True
    except TimeoutError:
        return False


@pytest.mark.parametrize(
    "begun",
    [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\n", b"POST /a HTTP/1.1\r\nHost: localhost\r\nContent-"],
)
def test_a_request_that_is_not_finished_in_time_is_closed(serve_world, monkeypatch, begun):
    monkeypatch.setattr(http_server, "REQUEST_S", 0.3)
    server = serve_world()
    with raw(server) as slow:
        slow.sendall(begun)
        assert closed(slow)


def test_a_large_request_may_take_longer_while_it_arrives(serve_world, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_S", 0.5)
    monkeypatch.setattr(http_server, "RENEWS", 1000)
    with raw(serve_world()) as slow:
        slow.sendall(b"POST /icon.svg HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000\r\n\r\n")
        for _ in range(6):
            time.sleep(0.2)
            slow.sendall(b"x" * 1500)
        assert slow.recv(100).startswith(b"HTTP/1.1 405")


def test_a_second_request_has_a_deadline_too(serve_world, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_S", 0.5)
    server = serve_world()
    with raw(server) as slow:
        slow.sendall(b"GET /icon.svg HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(100).startswith(b"HTTP/1.1 200")
        slow.sendall(b"GET /icon")
        end = time.monotonic() + 5
        while slow.recv(65536):
            assert time.monotonic() < end


def test_those_who_wait_cannot_lock_others_out(serve_world, monkeypatch, capfd):
    monkeypatch.setattr(http_server, "MOST_WAITING", 8)
    server = serve_world(token="sesame")
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(raw(server)) for _ in range(60)]
        for _ in range(3):
            assert get(server.url)[0] == 200
        with Client(server.socket_url + "?token=sesame") as client:
            client.frame(2)
        assert sum(closed(connection) for connection in idle[:40]) == 40, "the oldest make room"
    assert "Traceback" not in capfd.readouterr().err


def test_running_out_of_descriptors_is_said_in_a_line(capfd):
    loop = asyncio.new_event_loop()
    try:
        http_server.quiet_accepting(loop)
        for _ in range(100):
            error = OSError(errno.EMFILE, "Too many open files")
            loop.call_exception_handler({"message": "socket.accept() out of system resource", "exception": error})
    finally:
        loop.close()
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "Too many open files" in said


def test_a_refused_websocket_leaves_no_error_in_the_log(serve_world, capfd):
    server = serve_world(token="sesame")
    for _ in range(2):
        with pytest.raises(InvalidStatus), Client(server.socket_url):
            pass
    hello = b"GET /play HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    with raw(server) as gone:  # and one that does not wait for the answer
        gone.sendall(hello + b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n")
    time.sleep(0.5)
    assert capfd.readouterr().err == ""


def test_a_closed_tab_lets_another_record(serve_world):
    server = serve_world()
    with Client(server.socket_url) as client:
        client.say("record", on=True)
        while not client.event("status")["recording"]:
            pass
        client.frame(client.frame().step + 4)
    for _ in range(1000):
        if server.sinks[0].closed:
            break
        time.sleep(0.01)
    assert server.sinks[0].closed and server.sinks[0].ends == 1, "long before the session itself is given up"


@pytest.mark.parametrize(
    ("program", "command"),
    [
        (["/usr/lib/terrella/__main__.py", "play", "my hall"], "terrella play 'my hall'"),
        (["/usr/bin/pytest", "-q"], ""),
        (["bin/terrella", "play", "--port", "1"], "bin/terrella play --port 1"),
    ],
)
def test_pages_get_the_command_that_started_their_server(program, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", program)
    assert starting_command() == command
