"""The HTTP connections of a server: one that does not finish its request in time is closed, and only so many may wait."""

from __future__ import annotations

import asyncio
import sys
from collections import OrderedDict
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # from the first to the last byte of a request
MOST_WAITING = 64  # connections that have not finished a request; beyond it the oldest of them goes
COMPLAIN_EVERY_S = 60.0


def settings(app: Any, websockets: bool) -> uvicorn.Config:
    """How our pages are served; `websockets`: the page has one."""
    return uvicorn.Config(
        app, http=Door, ws="websockets-sansio" if websockets else "none", ws_max_size=2**16, ws_max_queue=64,
        ws_per_message_deflate=False, log_level="error", access_log=False, timeout_graceful_shutdown=2,
        server_header=False, proxy_headers=False,
    )  # fmt: skip


def quiet_accepting(loop: asyncio.AbstractEventLoop) -> None:
    """Where connections cannot be accepted (no file descriptors are left), a line now and then instead of a trace for each."""
    complained = -COMPLAIN_EVERY_S

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal complained
        if not isinstance(context.get("exception"), OSError) or "accept" not in context.get("message", ""):
            loop.default_exception_handler(context)
        elif loop.time() - complained >= COMPLAIN_EVERY_S:
            complained = loop.time()
            print(f"terrella: no more connections can be taken ({context['exception']}).", file=sys.stderr)

    loop.set_exception_handler(handle)


class Door(H11Protocol):
    """uvicorn's connection with a deadline for each request. A request that is whole is answered without one; a
    WebSocket takes the connection over, and is let in or refused by its own handshake."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        found = vars(self.server_state).setdefault("waiting", OrderedDict())  # oldest first
        self._waiting: OrderedDict[Door, asyncio.TimerHandle] = found
        if len(self._waiting) >= MOST_WAITING:
            next(iter(self._waiting)).drop()
        self._await_request()

    def data_received(self, data: bytes) -> None:
        if self not in self._waiting:
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
        """Closes the connection at once: its other end is not waited for."""
        self._stop_waiting()
        self.transport.abort()

    def _await_request(self) -> None:
        self._waiting[self] = self.loop.call_later(REQUEST_S, self.drop)

    def _stop_waiting(self) -> None:
        timer = self._waiting.pop(self, None)
        if timer is not None:
            timer.cancel()
