"""A served fake world, on a free port, in a thread of its own."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass, field

import pytest
import uvicorn

from terrella.serve.http_server import make_server, open_port
from terrella.serve.server import Sessions, build_app

from .panorama import Panorama


@dataclass
class Served:
    url: str
    server: uvicorn.Server
    sinks: list = field(default_factory=list)

    @property
    def socket_url(self) -> str:
        return self.url.replace("http", "ws").partition("?")[0] + "play"

    @property
    def sessions(self):
        return self.server.config.app.state.sessions


class ListSink:
    """Keeps what a recording would write."""

    def __init__(self):
        self.rows, self.ends, self.closed = [], 0, False

    def add(self, observation, action, reward, done):
        self.rows.append((observation, action, reward, done))

    def end_episode(self):
        self.ends += 1

    def close(self):
        self.closed = True


@contextlib.contextmanager
def served(worlds, *, host="127.0.0.1", token=None, record=True, config=None, policy=None, **kept):
    listener = open_port(host, 0)
    ready, addresses = threading.Event(), []

    def on_ready(url: str) -> None:
        addresses.append(url)
        ready.set()

    sinks: list[ListSink] = []

    def sink_factory() -> ListSink:
        sinks.append(ListSink())
        return sinks[-1]

    sessions = Sessions(worlds, config, sink_factory=sink_factory if record else None, policy=policy, **kept)
    server = make_server(build_app(sessions, host, token), listener, host, token, on_ready, websockets=True)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    assert ready.wait(20), "the server did not start"
    try:
        yield Served(addresses[0], server, sinks)
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()
        assert not thread.is_alive(), "the server did not stop"


@pytest.fixture
def serve_world():
    """serve_world(worlds, ...) -> Served; stopped at the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda worlds=None, **options: stack.enter_context(served(worlds or [Panorama()], **options))
