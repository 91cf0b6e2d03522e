"""Access to the server: host and origin checks, the token, rate limits, and the headers of every page."""

import asyncio
import contextlib
import hmac
import ipaddress
import time
from collections.abc import Collection
from urllib.parse import parse_qs, urlsplit

from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def is_loopback(host: str) -> bool:
    """Whether `host` (a name or an address, without port) is this machine's own."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refusal(headers: dict[str, str], host: str, token: str | None, given: str | None) -> str:
    """Why a request is refused, in one sentence; empty if it may pass. A server on this machine answers only to this machine's
    names (against DNS rebinding), a browser must come from our page (`Origin` equals `Host`), and the token must be right."""
    own, origin = headers.get("host", ""), headers.get("origin")
    try:
        name = urlsplit(f"//{own}").hostname or ""
        page = None if origin is None else urlsplit(origin)
    except ValueError:  # such as "["
        return "the Host or Origin header is no address; open the address that the server printed."
    if is_loopback(host) and not is_loopback(name):
        return "this server answers to localhost only; open the address that it printed."
    if page is not None and (page.scheme not in ("http", "https") or page.netloc != own):
        return "another site's page may not use this server; open the address that it printed."
    if token and not hmac.compare_digest(token.encode(), (given or "").encode()):
        return "the token is missing or wrong; open the whole address that the server printed, with ?token=."
    return ""


class RateLimit:
    """At most `per_s` messages a second in the long run, `burst` at once."""

    def __init__(self, per_s: float, burst: float, clock=time.monotonic):
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._left, self._then = burst, clock()

    def allows(self) -> bool:
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._then) * self._per_s)
        self._then = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Guard:
    """ASGI middleware: applies `refusal`, and puts `HEADERS` on every answer. The files of a page need no token: they hold nothing
    secret. `policy` replaces the Content-Security-Policy."""

    def __init__(self, app: ASGIApp, host: str, token: str | None, files: Collection[str], policy: str | None = None):
        self._app, self._host, self._token, self._files = app, host, token, files
        self._headers = {**HEADERS, "Content-Security-Policy": policy or HEADERS["Content-Security-Policy"]}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        why = refusal(headers, self._host, None if scope["path"] in self._files else self._token, given)
        answer = PlainTextResponse(why, 403) if why else self._app
        if scope["type"] == "websocket":
            await answer(scope, receive, send)
            return await _gone(receive) if why else None

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.lower().encode(), value.encode()) for name, value in self._headers.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        await answer(scope, receive, send_with_headers)


async def _gone(receive: Receive) -> None:
    """Waits until a refused WebSocket's connection is closed, which is uvicorn's second disconnect message. If the handler returned
    earlier, uvicorn would report an error."""
    left = 2
    with contextlib.suppress(asyncio.TimeoutError):
        async with asyncio.timeout(10):
            while left:
                left -= (await receive())["type"] == "websocket.disconnect"
