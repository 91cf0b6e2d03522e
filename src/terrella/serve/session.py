"""A session: one person's timeline, paced by the world's clock and by the frames that their browser has acknowledged."""

import asyncio
import secrets
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

from starlette.websockets import WebSocket

from ..core.errors import TerrellaError
from ..core.spec import can_idle
from . import protocol
from .actions import MAX_AXES, axes_of, keys_of
from .chart import EVERY_S
from .history import Moment
from .keys import KeyBook
from .power import Power
from .protocol import HeldControls, Show
from .timeline import Timeline

MAX_UNACKED = 2
FUTURES_SHARE = 0.4  # of the worker's time, at most, for the futures that an agent considers
FUTURES_EVERY_S = 0.5  # at least, between two of them
MOST_UNDRAWN = 5  # steps of a simulator between two pictures, where drawing is slower than its clock
ENDING_S = 2.0  # for which the last picture of an episode stays, before the next begins


class Session:
    """Steps its timeline only while fewer than `MAX_UNACKED` frames are under way; the latest controls win. `run` is its one task,
    which executes other messages in order between steps. Without a socket it pauses, with its recording closed, until it is
    attached again."""

    def __init__(
        self,
        make_timeline: Callable[[], Timeline],
        worker: Executor,
        book: KeyBook | None = None,
        power: Power | None = None,
    ):
        self.id = secrets.token_urlsafe(16)
        self.timeline: Timeline | None = None
        self.detached_at: float | None = time.monotonic()
        self.heard_at = time.monotonic()
        self._make_timeline, self._worker, self._book = make_timeline, worker, book
        self._socket: WebSocket | None = None
        self._controls = HeldControls(0)
        self._commands: deque[tuple[str, Any]] = deque()
        self._wake = asyncio.Event()
        self._sent = self._acked = 0
        self._paused = self._closed = False
        self._unseen: Moment | None = (
            None  # a moment to send that is not a new step: after a rewind, restart or reconnect
        )
        self._error = ""
        self._sent_last: dict[str, dict[str, object]] = {}  # the last event of each kind that reports a state
        self._show = Show(map=False, invented=False)
        self._charted: dict[str, Any] = {}  # the map that the page has
        self._chart_due = self._futures_due = 0.0
        self._due = self._took_s = 0.0
        self._power = power

    # -- the socket's side: called on the event loop, never waits ------------------------------------------------

    @property
    def unacked(self) -> int:
        return self._sent - self._acked

    @property
    def connected(self) -> bool:
        return self._socket is not None

    def attach(self, socket: WebSocket) -> WebSocket | None:
        """Goes on through `socket`; returns the socket that was attached until now."""
        before, self._socket = self._socket, socket
        self.detached_at, self._acked, self._sent_last = None, self._sent, {}
        self._controls = HeldControls(0)  # a new page counts its messages anew
        self._show = Show(map=False, invented=False)
        self.heard_at = time.monotonic()
        self._unseen = self.timeline.shown if self.timeline else None
        self._wake.set()
        return before

    def detach(self, socket: WebSocket) -> None:
        """Forgets a socket that is gone: the timeline pauses, and its recording is closed."""
        if self._socket is socket:
            self._commands.append(("record", False))
            self._wake.set()
            self._socket = None
            self._controls = replace(self._controls, held=(), axes=())
            self.detached_at = time.monotonic()

    def hear(self, kind: str, value: Any = None, socket: WebSocket | None = None) -> None:
        """Takes a message of the player. Messages of a socket that was replaced are ignored."""
        if socket is not None and socket is not self._socket:
            return
        self.heard_at = time.monotonic()
        if kind == "controls":
            if value.id >= self._controls.id:
                self._controls = value
        elif kind == "ack":
            if self._acked < value <= self._sent:
                self._acked = value
                self._wake.set()
            return
        elif kind in ("seek", "picture") and self._commands and self._commands[-1][0] == kind:
            self._commands[-1] = kind, value  # while scrubbing, only the latest matters
        elif len(self._commands) < 64:
            self._commands.append((kind, value))
        self._wake.set()

    async def pictures(self) -> list[tuple[bytes, ...]]:
        """The JPEGs of the recent past; empty before the world has started."""
        return await self._work(self.timeline.pictures) if self.timeline else []

    def close(self) -> None:
        self._closed = True
        self._wake.set()

    # -- the one task --------------------------------------------------------------------------------------------

    async def run(self) -> None:
        pages = set() if self._book is None else self._book.pages
        pages.add(self._wake.set)
        try:
            await self._begin()
            while not self._closed:
                await self._turn()
        finally:
            pages.discard(self._wake.set)
            if self.timeline:
                await asyncio.shield(self._work(self.timeline.close))
            await self._event("error", text="this session has ended; reload the page to begin anew.")

    async def _begin(self) -> None:
        try:
            self.timeline = await self._work(self._make_timeline)
            self._unseen = self.timeline.shown
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Shows an exception of the world. A world may be anybody's code, so no exception ends the server."""
        reason = str(error)
        if not isinstance(error, TerrellaError):
            traceback.print_exc(file=sys.stderr)
            reason = f"{type(error).__name__}: {error}."
        started = self.timeline is not None
        self._error = (
            f"the world stopped: {reason} Restart to go on." if started else f"the world cannot start: {reason}"
        )

    async def _turn(self) -> None:
        self._wake.clear()
        while self._commands and self.timeline:
            await self._obey(*self._commands.popleft(), self.timeline)
        timeline = self.timeline
        if self._socket is not None:
            await self._send_keys(timeline)
            await self._send_status(timeline)
            await self._send_agent(timeline)
        if self._socket is None or timeline is None or self.unacked >= MAX_UNACKED:
            await self._wake.wait()
        elif self._unseen is not None:
            await self._send(self._unseen, timeline, 0.0, self._controls)
        elif self._paused or self._error or timeline.rewound or self._awaits_key(timeline):
            await self._wake.wait()
        else:
            await self._step_when_due(timeline)

    def _awaits_key(self, timeline: Timeline) -> bool:
        """Whether an episode waits for the first key, because every action of the world does something."""
        touched = self._controls.held or self._controls.axes or timeline.driver.on
        return timeline.shown.age == 0 and not touched and not can_idle(timeline.spec)

    async def _step_when_due(self, timeline: Timeline) -> None:
        loop, now = asyncio.get_running_loop(), time.perf_counter()
        if self._due - now > 0.0005:
            alarm = loop.call_later(self._due - now, self._wake.set)
            await self._wake.wait()
            alarm.cancel()
            return
        dt_s = timeline.spec.dt_s
        if self._power is not None:
            dt_s = max(dt_s, self._power.step_s)
            if (costs := self._power.stepped(timeline.history.state_bytes)) is not None:
                await self._event("costs", **costs)
        self._due = max(self._due + dt_s, now - dt_s)  # catches up after a late step, not after a long wait
        try:
            controls, moment, made_ms = await self._work(self._step, timeline)
        except Exception as error:
            return self._fail(error)
        await self._send(moment, timeline, made_ms, controls)
        if timeline.ending is not None:
            self._due = time.perf_counter() + ENDING_S
            await self._event("ended", **timeline.ending)

    def _step(self, timeline: Timeline) -> tuple[HeldControls, Moment, float]:
        """In the worker, so that the controls are read as late as possible. A simulator that is drawn too slowly keeps its pace:
        some of its steps are not drawn."""
        begun, controls, dt_s = time.perf_counter(), self._controls, timeline.spec.dt_s
        skips = all(world.spec.card.get("kind") == "simulator" for world in timeline.worlds)
        undrawn = (
            min(MOST_UNDRAWN, int(self._took_s / dt_s)) if skips and not timeline.shown.flags & protocol.DONE else 0
        )
        for _ in range(undrawn):
            moment = timeline.step(controls.held, controls.axes, draw=False)
            self._due += dt_s
            if moment.flags & protocol.DONE:
                break
        else:
            moment = timeline.step(controls.held, controls.axes)
        took_s = time.perf_counter() - begun
        self._took_s += 0.3 * (took_s - self._took_s)
        return controls, moment, took_s * 1e3

    async def _obey(self, kind: str, value: Any, timeline: Timeline) -> None:
        try:
            match kind:
                case "pause":
                    self._paused = True
                case "resume" if timeline.rewound:
                    self._unseen = await self._work(timeline.to_newest)
                case "restart":
                    new = secrets.randbelow(2**31) if value is None else value
                    self._unseen = await self._work(timeline.restart, new, value is not None)
                case "rewind":
                    self._unseen = await self._work(timeline.stand_at, timeline.shown.step - value)
                case "seek":
                    self._unseen = await self._work(timeline.stand_at, value)
                case "branch":
                    self._unseen = await self._work(timeline.branch)
                case "picture":
                    self._unseen = await self._work(timeline.enter, value)
                case "sync":
                    self._unseen = await self._work(timeline.sync)
                case "record":
                    await self._work(timeline.record, value)
                case "keys" if self._book is not None:
                    timeline.obeyed = self._book.changed(value)
                    try:
                        await self._work(self._book.keep, timeline.obeyed)
                    finally:
                        for wake in self._book.pages:
                            wake()
                case "drive":
                    timeline.driver.let(value)
                case "goal":
                    await self._work(timeline.seek, value)
                case "show":
                    self._show, self._charted, self._chart_due = value, {}, 0.0
                    timeline.look(value.cameras)
                    self._unseen = self._unseen or timeline.shown
            if kind in ("resume", "restart", "branch", "picture"):
                self._paused, self._error, self._due = False, "", 0.0
        except TerrellaError as error:
            await self._event("error", text=str(error))
        except Exception as error:
            self._fail(error)

    def _work(self, function: Callable, *arguments):
        return asyncio.get_running_loop().run_in_executor(self._worker, function, *arguments)

    async def _send_keys(self, timeline: Timeline | None) -> None:
        """Sends the keys that another page has set."""
        if self._book is not None and timeline is not None and (news := self._book.news(timeline.obeyed)) is not None:
            timeline.obeyed = news
            await self._event("keys", **self._book.described())

    async def _send_status(self, timeline: Timeline | None) -> None:
        """Sends the state of the session if it changed since it was last sent."""
        status: dict[str, object] = {"text": self._error}
        if timeline is not None:
            status |= {
                "paused": self._paused, "rewound": timeline.rewound, "recording": timeline.recording.on,
                "driving": timeline.driver.on, "seed": timeline.seed, "notice": timeline.notice,
                "waits": self._awaits_key(timeline),
            }  # fmt: skip
        if timeline is not None or self._error:
            await self._send_changed("status", status)

    async def _send_agent(self, timeline: Timeline | None) -> None:
        """Sends who drives, the goal, and the agent's last action as keys and axes."""
        if timeline is None or timeline.driver.agents is None:
            return
        driver = timeline.driver
        await self._send_changed("agent", driver.described())
        await self._send_changed("goal", driver.mark)
        if not driver.on or driver.acted is None:
            return await self._send_changed("acted", {"held": [], "axes": []})
        axes = driver.acted.double().flatten().tolist()[:MAX_AXES] if axes_of(timeline.spec) else []
        await self._send_changed("acted", {"held": keys_of(timeline.obeyed, driver.acted), "axes": axes})

    async def _send_changed(self, kind: str, body: dict[str, object]) -> None:
        """Sends an event if it changed since it was last sent."""
        if body != self._sent_last.get(kind):
            await self._event(kind, **body)
            self._sent_last[kind] = body

    async def _send(self, moment: Moment, timeline: Timeline, made_ms: float, controls: HeldControls) -> None:
        self._unseen = None
        images = moment.images
        if self._show.invented or not made_ms:
            images = await self._extra(timeline.images, moment, self._show.invented) or images
        self._sent += 1
        moment = replace(moment, images=images, flags=moment.flags | protocol.REPLAY * timeline.rewound)
        past = timeline.history.oldest_step, timeline.history.newest.step
        await self._deliver(protocol.encode_frame(moment, self._sent, *past, controls, made_ms, time.time()))
        if self._show.map and timeline.map_kind and (time.perf_counter() >= self._chart_due or timeline.rewound):
            await self._chart(timeline)
        if self._show.futures and timeline.driver.on and time.perf_counter() >= self._futures_due:
            await self._futures(timeline)

    async def _futures(self, timeline: Timeline) -> None:
        """Sends another piece of the futures that the agent considers, then waits until they take no more than their share."""
        began = time.perf_counter()
        futures = await self._extra(timeline.consider)
        ended = time.perf_counter()
        self._futures_due = ended + (1 / FUTURES_SHARE - 1) * (ended - began) + (FUTURES_EVERY_S if futures else 0.0)
        if futures is not None:
            await self._event("futures", **futures)

    async def _chart(self, timeline: Timeline) -> None:
        self._chart_due = time.perf_counter() + EVERY_S[timeline.map_kind]
        chart = await self._extra(timeline.map_event)
        if chart is not None:
            large = {name: chart.pop(name) for name in ("places", "mosaic") if name in chart}
            changed = {name: value for name, value in large.items() if value != self._charted.get(name)}
            self._charted |= changed
            await self._event("chart", **chart, **changed)

    async def _extra(self, function: Callable, *arguments):
        """Computes what is shown besides the step; if the world fails, None, and no more of it."""
        try:
            return await self._work(function, *arguments)
        except Exception:  # a world may be anybody's code: play goes on without
            traceback.print_exc(file=sys.stderr)
            self._show = Show(map=False, invented=False)
            return None

    async def _event(self, kind: str, **body) -> None:
        await self._deliver(protocol.encode_event(kind, **body))

    async def _deliver(self, data: str | bytes) -> None:
        socket = self._socket
        if socket is None:
            return
        try:
            await (socket.send_text(data) if isinstance(data, str) else socket.send_bytes(data))
        except Exception:  # however a connection breaks, the timeline waits for the next
            self.detach(socket)
