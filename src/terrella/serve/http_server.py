"""The HTTP server of every page: the port, the files, and limits on how many connections may wait, and how long."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import secrets
import shlex
import shutil
import signal
import socket
import sys
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any, Protocol

import h11
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import State
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..core.errors import ServeError, TerrellaError
from .guard import Guard, is_loopback

WEB = Path(__file__).parent / "web"
KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
REQUEST_S = 10.0  # from the first to the last byte of a request, and for each further RENEWS bytes of it
RENEWS = 1 << 18  # a picture from a telephone takes longer than a request
MOST_WAITING = 64  # connections with an unfinished request; beyond it the oldest is dropped
COMPLAIN_EVERY_S = 60.0


def open_port(host: str, port: int) -> socket.socket:
    """A listening socket; ServeError if the address is not available. Port 0 takes any free one."""
    if not 0 <= port < 2**16:
        raise ServeError(f"{port} is no port; choose one from 1 to 65535 with --port (0 takes any that is free).")
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, number)
    except OSError as error:
        raise ServeError(f"{host} is no address of this machine ({error.strerror}); use --host 127.0.0.1.") from error
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise ServeError(
                f"port {port} is in use; stop what uses it or choose another with --port (0 takes any)."
            ) from error
        raise ServeError(
            f"cannot listen on {host}:{port} ({error.strerror}); choose another with --host and --port."
        ) from error
    listener.setblocking(False)
    return listener


def starting_command() -> str:
    """The `terrella` command that started this process, to be typed again; empty for another program."""
    program, *given = sys.argv
    if Path(program).name not in ("terrella", "__main__.py"):
        return ""
    known = shutil.which("terrella")
    short = (
        Path(program).name == "__main__.py" or known is not None and Path(known).resolve() == Path(program).resolve()
    )
    return shlex.join(["terrella" if short else os.path.relpath(program), *given])


def own_address() -> str:
    """This machine's address in its network, which other devices can open; its name where it has no network. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address of documentation: only the route to it is looked up
            return probe.getsockname()[0]
        except OSError:
            return socket.gethostname()


def page_address(host: str, port: int, token: str | None) -> str:
    shown = own_address() if host in ("0.0.0.0", "::") else host
    shown = f"[{shown}]" if ":" in shown else shown
    return f"http://{shown}:{port}/" + (f"?token={token}" if token else "")


def application(
    index: str | Callable[[], bytes],
    routes: Sequence[BaseRoute],
    lifespan: Callable[[Starlette], AbstractAsyncContextManager[None]] | None,
    host: str,
    token: str | None,
    policy: str | None = None,
) -> Starlette:
    """A page as an ASGI application. index: the first file, below web/, or a function that makes its content, which needs the
    token; host: the bound address, which decides the accepted Host headers; policy: its own Content-Security-Policy."""
    kinds = {f"/{file.relative_to(WEB).as_posix()}": KINDS.get(file.suffix) for file in WEB.rglob("*.*")}
    contents = {path: ((WEB / path[1:]).read_bytes(), kind) for path, kind in kinds.items() if kind}
    if isinstance(index, str):
        contents["/"] = (WEB / index).read_bytes(), "text/html"
    made = index if callable(index) else None

    def show(request: Request) -> Response:
        if made is not None and request.url.path == "/":
            try:
                return Response(made(), media_type="text/html")
            except TerrellaError as error:
                return PlainTextResponse(str(error), 500)
        content, kind = contents[request.url.path]
        return Response(content, media_type=kind)

    @contextlib.asynccontextmanager
    async def quiet_lifespan(app: Starlette) -> AsyncIterator[None]:
        quiet_accepting(asyncio.get_running_loop())
        async with lifespan(app) if lifespan else contextlib.nullcontext():
            app.state.on_ready()
            yield

    guard = Middleware(Guard, host=host, token=token, files=contents, policy=policy)
    return Starlette(
        routes=[*(Route(path, show) for path in {**contents, "/": None}), *routes],
        lifespan=quiet_lifespan,
        middleware=[guard],
    )


async def posted(request: Request, most: int) -> bytes:
    """The body of a POST; ServeError for more than `most` bytes."""
    content = bytearray()
    async for part in request.stream():
        content += part
        if len(content) > most:
            raise ServeError(f"more than {most:,} bytes were sent at once; send less.")
    return bytes(content)


class PageApplication(Protocol):
    """The ASGI application of a page. Its state gets `on_ready`, which it calls once it can be opened."""

    state: State

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None: ...


def make_server(
    app: PageApplication,
    listener: socket.socket,
    host: str,
    token: str | None,
    on_ready: Callable[[str], None] | None,
    websockets: bool,
) -> uvicorn.Server:
    """The server of a page, not yet running: `run(sockets=[listener])` runs it, and `should_exit` stops it. websockets: whether
    the page has one. `on_ready` gets the address to open."""
    url = page_address(host, listener.getsockname()[1], token)
    app.state.on_ready = lambda: on_ready and on_ready(url)
    settings = uvicorn.Config(
        app, http=GuardedConnection, ws="websockets-sansio" if websockets else "none", ws_max_size=2**16, ws_max_queue=64,
        ws_per_message_deflate=False, log_level="error", access_log=False, timeout_graceful_shutdown=2,
        server_header=False, proxy_headers=False,
    )  # fmt: skip
    return uvicorn.Server(settings)


def serve_page(
    build: Callable[[str | None], PageApplication],
    host: str,
    port: int,
    token: str | None,
    on_ready: Callable[[str], None] | None,
    websockets: bool,
) -> None:
    """Serves the application that `build(token)` returns until interrupted. On any address but this machine's own a token is
    mandatory: one is made if none is given, and the address carries it. ServeError where the port is taken."""
    if not token and not is_loopback(host):
        token = secrets.token_urlsafe(16)
    with contextlib.closing(open_port(host, port)) as listener:
        server = make_server(build(token), listener, host, token, on_ready, websockets)
        with contextlib.suppress(KeyboardInterrupt), _ended_like_ctrl_c():
            server.run(sockets=[listener])


@contextlib.contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Lets SIGTERM end the process as Ctrl-C does, so that worlds can end their own processes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # uvicorn puts it back, then raises it again
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def quiet_accepting(loop: asyncio.AbstractEventLoop) -> None:
    """If connections cannot be accepted (no file descriptors are left), prints a line now and then, not a trace for each."""
    complained = -COMPLAIN_EVERY_S

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal complained
        if not isinstance(context.get("exception"), OSError) or "accept" not in context.get("message", ""):
            loop.default_exception_handler(context)
        elif loop.time() - complained >= COMPLAIN_EVERY_S:
            complained = loop.time()
            print(f"terrella: no more connections can be taken ({context['exception']}).", file=sys.stderr)

    loop.set_exception_handler(handle)


class GuardedConnection(H11Protocol):
    """uvicorn's connection with a deadline for receiving each request, which moves on while a large one arrives. A complete request
    has no deadline, nor has a WebSocket once it takes over the connection."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        waiting = vars(self.server_state).setdefault("waiting", OrderedDict())  # oldest first
        self._waiting: OrderedDict[GuardedConnection, asyncio.TimerHandle] = waiting
        if len(self._waiting) >= MOST_WAITING:
            next(iter(self._waiting)).drop()
        self._await_request()

    def data_received(self, data: bytes) -> None:
        self._received += len(data)
        if self not in self._waiting or self._received > RENEWS:
            self._await_request()
        super().data_received(data)
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._stop_waiting()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def drop(self) -> None:
        """Closes the connection at once, without waiting for the other end."""
        self._stop_waiting()
        self.transport.abort()

    def _await_request(self) -> None:
        self._received = 0
        if (timer := self._waiting.get(self)) is not None:
            timer.cancel()
        self._waiting[self] = self.loop.call_later(REQUEST_S, self.drop)

    def _stop_waiting(self) -> None:
        timer = self._waiting.pop(self, None)
        if timer is not None:
            timer.cancel()
