"""A served recording, on a free port, in a thread of its own."""

from __future__ import annotations

import contextlib
import threading

import httpx

from terrella.serve.http_server import make_server, open_port
from terrella.serve.viewer import build_viewer


@contextlib.contextmanager
def viewed(viewable, *, host="127.0.0.1", token=None, export_to=None):
    """Gives the page's address; the server has stopped when the block is left."""
    listener = open_port("127.0.0.1", 0)
    ready, addresses = threading.Event(), []

    def on_ready(url: str) -> None:
        addresses.append(url)
        ready.set()

    app = build_viewer(viewable, host, token, export_to)
    server = make_server(app, listener, host, token, on_ready, websockets=False)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    assert ready.wait(20), "the server did not start"
    try:
        yield addresses[0]
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()
        assert not thread.is_alive(), "the server did not stop"


@contextlib.contextmanager
def asked(viewable, **options):
    """An httpx client of a served recording."""
    with viewed(viewable, **options) as url, httpx.Client(base_url=f"http://127.0.0.1:{httpx.URL(url).port}") as client:
        yield client
