"""The start page: cards of worlds, places and recordings, and one server that shows whichever of them a person opens."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from ..core.errors import ServeError, TerrellaError
from ..space.layout.drawn_plan import DOOR_M, WINDOW_M
from ..space.layout.furniture import KINDS
from ..space.layout.text_layout import ROOMS
from .http_server import WEB, application, posted, serve_page

MOST_WORDS, MOST_PLAN, MOST_PICTURE = 4096, 1 << 17, 32 << 20  # bytes of requests
_OPEN = re.compile(rb"(^|&)open(=|&|$)")  # in the address of the page that is open
Build = Callable[[str, str | None], Starlette]  # (host, token) -> the application of a page


@dataclass(frozen=True)
class StartCard:
    """Something that can be opened."""

    name: str  # by which it is opened
    title: str
    section: str  # "bundled", "world", "place", "recording" or "game"
    text: str  # a sentence


class Shelf(Protocol):
    """What the start page offers. One thread calls `thumbnail`, another the rest; each may raise a TerrellaError."""

    def cards(self) -> list[StartCard]: ...

    def thumbnail(self, name: str) -> bytes:
        """A JPEG of a card."""
        ...

    def open(self, name: str) -> Build:
        """The page of a card."""
        ...

    def build(self, words: str) -> str:
        """Builds the place that the words describe; returns its name."""
        ...

    def build_plan(self, plan: Mapping[str, Any]) -> str:
        """Builds the place of a drawn plan (space/layout/drawn_plan.py); returns its name."""
        ...

    def lift(self, name: str, picture: bytes) -> str:
        """Makes a place of a picture, whose file had this name; returns the place's name."""
        ...

    def progress(self) -> str:
        """What is being done now, in words; empty if nothing is known. Any thread may call it."""
        ...


class StartPage:
    """An ASGI application: the start page at /, and at /?open the page that was opened last. It shows one at a time, because each
    uses the machine for itself."""

    def __init__(self, shelf: Shelf, host: str = "127.0.0.1", token: str | None = None):
        self._shelf, self._host, self._token = shelf, host, token
        self._worker, self._painter = (
            ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("start", "thumbnails")
        )
        self._lock = asyncio.Lock()
        self._thumbnails: dict[str, bytes] = {}
        self._open: Starlette | None = None
        self._running = contextlib.AsyncExitStack()
        self._page = application("start/index.html", self._routes(), self._lifespan, host, token)
        self.state = self._page.state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path, page = scope.get("path", ""), self._open
        start = path.startswith("/start/") or path == "/" and not _OPEN.search(scope["query_string"])
        await (self._page if start or page is None or scope["type"] == "lifespan" else page)(scope, receive, send)

    def _routes(self) -> list[Route]:
        return [
            Route("/start/cards", self._cards),
            Route("/start/thumbnail", self._thumbnail),
            Route("/start/open", self._opens, methods=["POST"]),
            Route("/start/build", self._builds, methods=["POST"]),
            Route("/start/plan", self._plans, methods=["POST"]),
            Route("/start/picture", self._lifts, methods=["POST"]),
            Route("/start/draw", self._draws),
            Route("/start/progress", self._progress),
            Route("/start/kinds", self._kinds),
        ]

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        try:
            yield
        finally:
            await self._running.aclose()
            for worker in (self._worker, self._painter):
                worker.shutdown(cancel_futures=True)

    async def _cards(self, request: Request) -> Response:
        return JSONResponse([asdict(card) for card in await self._work(self._shelf.cards)])

    async def _thumbnail(self, request: Request) -> Response:
        name = request.query_params.get("name", "")
        try:
            if name not in self._thumbnails:
                paint = lambda: self._shelf.thumbnail(self._known(name))  # noqa: E731
                self._thumbnails[name] = await asyncio.get_running_loop().run_in_executor(self._painter, paint)
            return Response(self._thumbnails[name], media_type="image/jpeg")
        except Exception as error:  # a card without a picture is a card all the same
            return PlainTextResponse(str(error), 404)

    async def _kinds(self, request: Request) -> Response:
        """The rooms and the things of a plan, with their usual sizes in metres."""
        things = {
            "door": (DOOR_M, 0.15),
            "window": (WINDOW_M, 0.15),
            **{name: kind.size[:2] for name, kind in sorted(KINDS.items())},
        }
        return JSONResponse({"rooms": {name: {"size": one["size"]} for name, one in ROOMS.items()},
                             "things": {name: {"size": size} for name, size in things.items()}})  # fmt: skip

    async def _draws(self, request: Request) -> Response:
        """The page on which a plan is drawn."""
        return FileResponse(WEB / "start" / "plan.html", media_type="text/html")

    async def _progress(self, request: Request) -> Response:
        return PlainTextResponse(self._shelf.progress())

    async def _opens(self, request: Request) -> Response:
        return await self._answer(request, MOST_WORDS, lambda content: self._known(_words(content, "name")))

    async def _builds(self, request: Request) -> Response:
        return await self._answer(request, MOST_WORDS, lambda content: self._shelf.build(_words(content, "words")))

    async def _plans(self, request: Request) -> Response:
        return await self._answer(request, MOST_PLAN, lambda content: self._shelf.build_plan(_object(content)))

    async def _lifts(self, request: Request) -> Response:
        name = request.query_params.get("name", "")[:200]
        return await self._answer(request, MOST_PICTURE, lambda content: self._shelf.lift(name, content))

    async def _answer(self, request: Request, most: int, name_of: Callable[[bytes], str]) -> Response:
        """Opens what a POST names, or what is made of its content; the browser goes to /?open then."""
        try:
            content = await posted(request, most)
            async with self._lock:
                build = await self._work(lambda: self._shelf.open(name_of(content)))
                await self._show(build(self._host, self._token))
        except (ValueError, KeyError, TypeError, RecursionError):
            return PlainTextResponse("the start page sends a name, words, a plan or a picture; reload it.", 422)
        except TerrellaError as error:
            return PlainTextResponse(str(error), 422)
        return JSONResponse({})

    async def _show(self, app: Starlette) -> None:
        """Ends the page that is open, and begins this one."""
        self._open = None
        await self._running.aclose()
        app.state.on_ready = lambda: None
        await self._running.enter_async_context(app.router.lifespan_context(app))
        self._open = app

    def _known(self, name: str) -> str:
        if name not in {card.name for card in self._shelf.cards()}:
            raise ServeError(f"'{name[:60]}' is not on the start page any more; reload it.")
        return name

    def _work(self, function: Callable, *arguments):
        return asyncio.get_running_loop().run_in_executor(self._worker, function, *arguments)


def _object(content: bytes) -> Mapping[str, Any]:
    """A JSON object; ValueError for other content."""
    given = json.loads(content)
    if not isinstance(given, dict):
        raise ValueError("a request is an object of JSON")
    return given


def _words(content: bytes, field: str) -> str:
    text = _object(content)[field]
    if not isinstance(text, str) or not text.strip():
        raise ServeError("the start page sends a name or words; reload it.")
    return text


def serve_start(
    shelf: Shelf, host: str, port: int, token: str | None, on_ready: Callable[[str], None] | None = None
) -> None:
    """Serves the start page, and the pages that are opened from it, until interrupted. Arguments as for `serve_page`."""
    serve_page(lambda token: StartPage(shelf, host, token), host, port, token, on_ready, websockets=True)
