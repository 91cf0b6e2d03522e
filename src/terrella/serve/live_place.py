"""The page of a place while it is being fitted: it shows the newest state, and the fit never waits for it."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from .http_server import application, make_server, open_port
from .place_page import PlacePage, packed_place
from .place_scene import PlaceScene

Show = Callable[[Callable[[], PlaceScene], Mapping[str, Any]], None]
STARTS_S = 20.0


class Newest:
    """The newest state of the place, packed once, when a page asks for it."""

    def __init__(self):
        self._lock, self._packed, self._page = threading.Lock(), (0, b"", b""), (0, b"")
        self._newest: tuple[int, Callable[[], PlaceScene] | None, Mapping[str, Any]] = 0, None, {}

    def show(self, make: Callable[[], PlaceScene], facts: Mapping[str, Any]) -> None:
        """`make` returns the place as it is now. facts: `step`, `steps` and `db` (PSNR), for the page's header."""
        self._newest = self._newest[0] + 1, make, facts

    def html(self) -> bytes:
        """The page with the newest state, made once for each state."""
        with self._lock:
            number, make, _ = self._newest
            assert make is not None
            if self._page[0] != number:
                self._page = number, PlacePage(make()).html([], watch="/now")
            return self._page[1]

    def answer(self, after: int) -> tuple[bytes, bytes] | None:
        """The newest state: its description as JSON, and its columns in gzip; None if it is not newer than `after`."""
        with self._lock:
            number, make, facts = self._newest
            if number <= after or make is None:
                return None
            if self._packed[0] != number:
                place = make()
                about, data, _ = packed_place(place, len(place.gaussians))
                self._packed = number, json.dumps({**about, **facts, "number": number}).encode(), data
            return self._packed[1:]


@contextlib.contextmanager
def live_page(host: str, port: int, on_ready: Callable[[str], None]) -> Iterator[Show]:
    """Serves a page in a thread while the block runs. The block calls the `Show` that it gets at once, and then now and then.
    ServeError where the port is taken."""
    newest = Newest()

    async def now(request: Request) -> Response:
        after = request.query_params.get("after", "0")
        answer = await run_in_threadpool(newest.answer, int(after[:18]) if after.isdecimal() else 0)
        if answer is None:
            return Response(status_code=204)
        about, data = answer
        return Response(len(about).to_bytes(4, "little") + about + data, media_type="application/octet-stream")

    with contextlib.closing(open_port(host, port)) as listener, contextlib.ExitStack() as stack:

        def show(make: Callable[[], PlaceScene], facts: Mapping[str, Any]) -> None:
            newest.show(make, facts)
            if not started.is_set():
                started.set()
                policy = PlacePage(make()).policy
                app = application(newest.html, [Route("/now", now)], None, host, None, policy)
                server = make_server(app, listener, host, None, on_ready, websockets=False)
                thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
                thread.start()
                stack.callback(thread.join, STARTS_S)
                stack.callback(setattr, server, "should_exit", True)

        started = threading.Event()
        yield show
