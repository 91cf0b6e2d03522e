"""The web server: the page, its one WebSocket, clips to download, and the sessions behind them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from ..core.errors import ProtocolError, ServeError
from ..core.policy import Policy
from ..core.spec import suffix_of
from ..core.world import World
from . import protocol
from .actions import axes_of
from .agent import Agents, agents_of
from .chart import knows_share, mapped
from .clip import make_clip
from .door import application, serve_page
from .guard import RateLimit
from .keys import Keep, KeyBook
from .picture import uncertainty_levels
from .recording import SinkFactory
from .session import Session
from .timeline import Timeline, check_playable, no_rewind, vitals


@dataclass(frozen=True)
class ServeConfig:
    """seats: sessions at once (a world that cannot fork has one); grace_s: how long a session outlives its socket;
    idle_s: how long a silent, paused one keeps its seat; per_s and burst: messages a page may send; faults: those without a
    meaning, before its socket is closed; history_s: seconds of pictures kept (for rewinding and clips); state_mb: memory
    for the states among them."""

    seats: int = 4
    grace_s: float = 120.0
    idle_s: float = 1800.0
    per_s: float = 240.0
    burst: float = 480.0
    faults: int = 20
    history_s: float = 30.0
    state_mb: int = 256


class Sessions:
    """The sessions of one server, their one worker thread and their seats; the arguments are those of `serve`."""

    def __init__(
        self,
        worlds: Sequence[World],
        seed: int = 0,
        sink_factory: SinkFactory | None = None,
        picture: torch.Tensor | None = None,
        policy: Policy | Agents | None = None,
        config: ServeConfig | None = None,
        keep: Keep | None = None,
        kept_in: str = "",
    ):
        check_playable(worlds)
        self.worlds, self.config = tuple(worlds), config or ServeConfig()
        self._sink_factory, self._agents = sink_factory, agents_of(policy)
        kept = self.config.history_s, self.config.state_mb
        self._book = KeyBook(worlds[0].spec, keep, kept_in)
        self._make_timeline = lambda: Timeline(
            self.worlds, seed, sink_factory, picture, self._agents, *kept, keys=self._book.spec
        )
        self._seats = self.config.seats if all(world.spec.forkable for world in worlds) else 1
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="world")
        self._open: dict[str, tuple[Session, asyncio.Task]] = {}
        self._ended: set[asyncio.Task] = set()

    def get(self, name: str | None) -> Session | None:
        return self._open[name][0] if name in self._open else None

    def open(self) -> Session:
        """A new session; ServeError where every seat is taken by somebody present."""
        if len(self._open) >= self._seats:
            absent = [session for session, _ in self._open.values() if not session.connected]
            if not absent:
                raise ServeError(
                    f"{self.worlds[0].spec.name} is being played by somebody else; close the other page or try again later."
                )
            self._end(min(absent, key=lambda session: session.detached_at or 0.0))
        session = Session(self._make_timeline, self._worker, self._book)
        self._open[session.id] = session, asyncio.create_task(session.run())
        return session

    def sweep(self) -> None:
        """Ends the sessions whose socket has been gone, or whose player silent, for too long."""
        now, config = time.monotonic(), self.config
        for session, task in list(self._open.values()):
            gone = session.detached_at is not None and now - session.detached_at > config.grace_s
            if gone or task.done() or now - session.heard_at > config.idle_s:
                self._end(session)

    async def end_all(self) -> None:
        for session, _ in list(self._open.values()):
            self._end(session)
        await asyncio.gather(*self._ended, return_exceptions=True)
        self._worker.shutdown()

    def _end(self, session: Session) -> None:
        _, task = self._open.pop(session.id)
        session.close()
        self._ended.add(task)
        task.add_done_callback(self._ended.discard)

    def hello(self, session: Session, resumed: bool) -> str:
        """All that the page needs to know about the worlds."""
        labels = ("game", "dream") if len(self.worlds) == 2 else ("",)
        return protocol.encode_event(
            "hello",
            version=protocol.VERSION,
            session=session.id,
            resumed=resumed,
            worlds=[
                _describe(world, label) | self._book.described()
                for world, label in zip(self.worlds, labels, strict=True)
            ],
            no_rewind=no_rewind(self.worlds),
            no_record="" if self._sink_factory else "start the server with --record FOLDER.",
            agent=self._agents is not None,
            goals={
                "places": bool(self._agents and self._agents.places),
                "pictures": bool(self._agents and self._agents.pictures),
                "words": bool(self._agents and self._agents.words),
            },
        )


def _describe(world: World, label: str) -> dict:
    spec = world.spec
    return {
        "name": spec.name,
        "label": label,
        "cameras": [
            {"channel": name, "name": suffix_of(name) or "main", "size": spec.channels[name].shape[:2]}
            for name in spec.kinds("rgb")
        ],
        "dt_s": spec.dt_s,
        "action_mode": spec.action_mode,
        "action_frame": spec.action_frame,
        "axes": axes_of(spec),
        "scored": "reward" in spec.channels,
        "vitals": vitals(spec),
        "uncertainty": uncertainty_levels(spec),
        "mapped": mapped(spec),
        "knows_share": knows_share(spec),
        "card": protocol.plain(spec.card),
    }


def build_app(sessions: Sessions, host: str = "127.0.0.1", token: str | None = None) -> Starlette:
    """The ASGI application."""

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        app.state.sessions = sessions
        sweeper = asyncio.create_task(_sweep(sessions))
        try:
            yield
        finally:
            sweeper.cancel()
            await sessions.end_all()

    def check(request: Request) -> Response:
        return PlainTextResponse("ok")

    async def clip(request: Request) -> Response:
        session = sessions.get(request.path_params["session"])
        pictures = await session.pictures() if session else []
        if not pictures:
            return PlainTextResponse("this session has ended; reload the page.", 404)
        spec = sessions.worlds[0].spec
        content = await asyncio.get_running_loop().run_in_executor(None, make_clip, pictures, spec.dt_s)
        name = "".join(letter if letter.isalnum() else "-" for letter in spec.name)[:60]
        disposition = {"Content-Disposition": f'attachment; filename="{name}.mp4"'}
        return Response(content, media_type="video/mp4", headers=disposition)

    async def play(websocket: WebSocket) -> None:
        await _play(websocket, sessions)

    routes = [Route("/check", check), Route("/clip/{session}.mp4", clip), WebSocketRoute("/play", play)]
    return application("index.html", routes, lifespan, host, token)


async def _sweep(sessions: Sessions) -> None:
    while True:
        await asyncio.sleep(1)
        sessions.sweep()


async def _play(websocket: WebSocket, sessions: Sessions) -> None:
    await websocket.accept()
    session = sessions.get(websocket.query_params.get("session"))
    resumed = session is not None
    try:
        session = session or sessions.open()
    except ServeError as error:
        await websocket.send_text(protocol.encode_event("error", text=str(error)))
        return await websocket.close(1013, "no seat")
    await websocket.send_text(sessions.hello(session, resumed))
    before = session.attach(websocket)
    if before is not None:
        with contextlib.suppress(Exception):  # it may be gone already
            await before.close(4001, "opened in another page")
    try:
        await _listen(websocket, session, sessions.config)
    except (WebSocketDisconnect, RuntimeError):  # starlette raises the latter where the other task has closed it
        pass
    finally:
        session.detach(websocket)


async def _listen(websocket: WebSocket, session: Session, config: ServeConfig) -> None:
    rate, faults = RateLimit(config.per_s, config.burst), 0
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        data = message.get("text") or message.get("bytes") or ""
        if not rate.allows():
            await websocket.send_text(
                protocol.encode_event("error", text="too many messages a second; reload the page.")
            )
            return await websocket.close(1008, "too many messages")
        try:
            session.hear(*protocol.parse_message(data), websocket)
        except ProtocolError as error:
            faults += 1
            await websocket.send_text(protocol.encode_event("error", text=str(error)))
            if faults >= config.faults:
                return await websocket.close(1008, "too many faults")


def serve(
    worlds: Sequence[World],
    host: str = "127.0.0.1",
    port: int = 8765,
    token: str | None = None,
    sink_factory: SinkFactory | None = None,
    on_ready: Callable[[str], None] | None = None,
    seed: int = 0,
    config: ServeConfig | None = None,
    picture: torch.Tensor | None = None,
    policy: Policy | Agents | None = None,
    keep: Keep | None = None,
    kept_in: str = "",
) -> None:
    """Serves the page until interrupted. One world is played; of two, the first is the game and the second its dream.
    Episodes begin with the `picture`, uint8 [H, W, 3] (picture.py), where one is given. A `policy` drives while nobody
    touches the controls; Agents (agent.py) when a person lets them. `keep` is called with the spec
    whenever a person has changed the keys on a page; `kept_in` says, in words, where it keeps them for all pages, and is ""
    where each page keeps its own, in its browser.

    `on_ready` gets the address to open. On any address but this machine's own a token is mandatory: where none is
    given one is made, and the address carries it. ServeError where the port is taken or a world shows no picture.
    """
    sessions = Sessions(worlds, seed, sink_factory, picture, policy, config, keep, kept_in)
    # Half of the cores are the browser's: threads that wait for one another on a shared core lose a third of the frames.
    torch.set_num_threads(max(1, min(torch.get_num_threads(), (os.cpu_count() or 2) // 2)))
    serve_page(lambda token: build_app(sessions, host, token), host, port, token, on_ready, websockets=True)
