"""The server of a world's page: the page, its one WebSocket, clips to download, and the sessions behind them."""

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
from .chart import has_known_share, map_kind
from .clip import make_clip
from .guard import RateLimit
from .http_server import application, serve_page, starting_command
from .keys import Keep, KeyBook
from .picture import uncertainty_levels
from .power import Meter, Power
from .presentation import aims, drawn_by, events_of, numbers_of
from .recording import SinkFactory
from .session import Session
from .timeline import Timeline, check_playable, no_rewind


@dataclass(frozen=True)
class ServeConfig:
    """Where the page of a world is served, and what its sessions may use."""

    host: str = "127.0.0.1"  # the address to listen on
    port: int = 8765  # 0 picks a free one
    token: str | None = None  # a secret that the page's address must contain
    seed: int | None = 0  # of each session's first episode; None lets `terrella play` choose a good view
    seats: int = 4  # sessions at once; a world that cannot fork has one
    grace_s: float = 120.0  # how long a session outlives its socket
    idle_s: float = 1800.0  # how long a silent, paused session keeps its seat
    per_s: float = 240.0  # messages per second that a page may send in the long run
    burst: float = 480.0  # messages that it may send at once
    faults: int = 20  # malformed messages after which its socket is closed
    history_s: float = 30.0  # seconds of pictures that are kept, for rewinding and clips
    state_mb: int = 256  # memory for the states among them, in MiB
    meter: Meter | None = None  # measures the energy of this process, which the page then shows
    watts: float | None = None  # the most that play may take: its steps are made slower; needs a meter
    record_in: str = ""  # where `sink_factory` records, in words


class Sessions:
    """The sessions of one server, their one worker thread and their seats. The arguments are those of `serve`."""

    def __init__(
        self,
        worlds: Sequence[World],
        config: ServeConfig | None = None,
        *,
        sink_factory: SinkFactory | None = None,
        picture: torch.Tensor | None = None,
        policy: Policy | Agents | None = None,
        keep: Keep | None = None,
        kept_in: str = "",
    ):
        check_playable(worlds)
        self.worlds, self.config = tuple(worlds), config or ServeConfig()
        self._sink_factory, self._agents = sink_factory, agents_of(policy)
        seed, budgets = self.config.seed or 0, (self.config.history_s, self.config.state_mb)
        self._book = KeyBook(worlds[0].spec, keep, kept_in)
        self._make_timeline = lambda: Timeline(
            self.worlds, seed, sink_factory, picture, self._agents, *budgets, keys=self._book.spec
        )
        self._seats = self.config.seats if all(world.spec.forkable for world in worlds) else 1
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="world")
        self._open: dict[str, tuple[Session, asyncio.Task]] = {}
        self._ended: set[asyncio.Task] = set()

    def get(self, name: str | None) -> Session | None:
        return self._open[name][0] if name in self._open else None

    def open(self) -> Session:
        """A new session; ServeError if every seat is taken by a page that is open."""
        if len(self._open) >= self._seats:
            absent = [session for session, _ in self._open.values() if not session.connected]
            if not absent:
                raise ServeError(
                    f"{self.worlds[0].spec.name} is being played by somebody else; close the other page or try again later."
                )
            self._end(min(absent, key=lambda session: session.detached_at or 0.0))
        power = None if self.config.meter is None else Power(self.config.meter, self.config.watts)
        session = Session(self._make_timeline, self._worker, self._book, power)
        self._open[session.id] = session, asyncio.create_task(session.run())
        return session

    def sweep(self) -> None:
        """Ends the sessions without a socket for too long, and those without a message for too long."""
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
        """The message that describes the worlds to the page."""
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
            command=starting_command(),
            record_in=self.config.record_in,
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
        "vitals": numbers_of(spec),
        "events": events_of(spec),
        "aims": aims(spec),
        "drawn": drawn_by(spec),
        "uncertainty": uncertainty_levels(spec),
        "mapped": map_kind(spec),
        "knows_share": has_known_share(spec),
        "card": protocol.plain(spec.card),
    }


def build_app(sessions: Sessions, host: str = "127.0.0.1", token: str | None = None) -> Starlette:
    """The ASGI application."""
    # Half of the cores are the browser's: threads that wait for one another on a shared core lose a third of the frames.
    torch.set_num_threads(max(1, min(torch.get_num_threads(), (os.cpu_count() or 2) // 2)))

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
    config: ServeConfig | None = None,
    *,
    policy: Policy | Agents | None = None,
    picture: torch.Tensor | None = None,
    sink_factory: SinkFactory | None = None,
    keep: Keep | None = None,
    kept_in: str = "",
    on_ready: Callable[[str], None] | None = None,
) -> None:
    """Serves the page of one world, or of a game and a learned world side by side, until interrupted.

    On any address but this machine's own a token is mandatory: one is made if the config has none. ServeError where the
    port is taken or a world renders no pictures.

    Args:
        worlds:       The world that is played; or the game, and the learned world that is compared with it.
        policy:       A policy acts whenever nobody touches the controls. Agents (agent.py) act when a person lets them.
        picture:      uint8 [H, W, 3] (picture.py), the first frame of each episode.
        sink_factory: Makes the dataset to which the page records.
        keep:         Called with the spec whenever a person has changed the keys on a page.
        kept_in:      Where `keep` stores them for all pages, in words; "" if each page keeps its own in the browser.
        on_ready:     Called with the address to open, which carries the token.
    """
    config = config or ServeConfig()
    sessions = Sessions(
        worlds,
        config,
        sink_factory=sink_factory,
        picture=picture,
        policy=policy,
        keep=keep,
        kept_in=kept_in,
    )
    build = lambda token: build_app(sessions, config.host, token)  # noqa: E731
    serve_page(build, config.host, config.port, config.token, on_ready, websockets=True)
