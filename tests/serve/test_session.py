"""Laws of a session: back-pressure, the latest keys, commands in order, and surviving a dropped socket."""

from __future__ import annotations

import asyncio
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from terrella.serve.protocol import REPLAY, HeldControls, Show
from terrella.serve.session import MAX_UNACKED, Session
from terrella.serve.timeline import Timeline

from .mapped import Mapped
from .panorama import Panorama
from .wire import decode_frame


class FakeSocket:
    """A browser that acknowledges when it is told to, or at once."""

    def __init__(self, session: Session, prompt: bool = True):
        self.session, self.prompt = session, prompt
        self.frames, self.events, self.most_unacked = [], [], 0

    async def send_bytes(self, data: bytes) -> None:
        self.frames.append(decode_frame(data))
        self.most_unacked = max(self.most_unacked, self.session.unacked)
        if self.prompt:
            self.session.hear("ack", self.frames[-1].seq)

    async def send_text(self, data: str) -> None:
        self.events.append(json.loads(data))

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        pass

    @property
    def last(self):
        return self.frames[-1]


async def until(condition, seconds: float = 20.0) -> None:
    for _ in range(int(seconds / 0.005)):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise AssertionError("it never happened")


def play(scenario, world=None) -> None:
    """Runs scenario(session) beside a session of a fast world."""

    async def main() -> None:
        with ThreadPoolExecutor(1) as worker:
            session = Session(lambda: Timeline([world or Panorama(dt_s=1 / 400)], seed=0), worker)
            task = asyncio.create_task(session.run())
            try:
                await scenario(session)
            finally:
                session.close()
                await task

    asyncio.run(main())


def test_a_silent_browser_gets_two_frames_and_no_more():
    async def scenario(session):
        socket = FakeSocket(session, prompt=False)
        session.attach(socket)
        await until(lambda: len(socket.frames) == MAX_UNACKED)
        await asyncio.sleep(0.1)
        assert len(socket.frames) == MAX_UNACKED
        session.hear("ack", socket.frames[0].seq)
        await until(lambda: len(socket.frames) == MAX_UNACKED + 1)
        await asyncio.sleep(0.05)
        assert socket.most_unacked == MAX_UNACKED and session.timeline.history.newest.step == MAX_UNACKED

    play(scenario)


def test_never_more_than_two_on_their_way():
    async def scenario(session):
        socket = FakeSocket(session, prompt=False)
        session.attach(socket)
        for _ in range(60):
            await asyncio.sleep(0.003)
            if socket.frames:
                session.hear("ack", socket.last.seq)
                session.hear("ack", 10**6)  # of a frame that was never sent: means nothing
        assert socket.most_unacked <= MAX_UNACKED and len(socket.frames) > 10

    play(scenario)


def test_the_latest_keys_win_and_are_named_in_the_frame():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: socket.frames)
        session.hear("controls", HeldControls(1, ("ArrowLeft",), t=5.0))
        session.hear("controls", HeldControls(3, ("KeyW",), t=7.0))
        session.hear("controls", HeldControls(2, ("ArrowLeft",), t=6.0))  # late, and older
        await until(lambda: socket.last.action_id == 3)
        obeyed = next(frame for frame in socket.frames if frame.action_id == 3)
        assert obeyed.client_ms == 7.0
        await until(lambda: socket.last.episode_return > 2)
        assert socket.last.action_id == 3

    play(scenario)


def test_pausing_stops_time():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: len(socket.frames) > 3)
        session.hear("pause")
        await until(lambda: socket.events and socket.events[-1]["paused"])
        count = len(socket.frames)
        await asyncio.sleep(0.05)
        assert len(socket.frames) == count
        session.hear("resume")
        await until(lambda: len(socket.frames) > count + 3)

    play(scenario)


def test_a_world_in_which_every_action_does_something_waits_for_the_first_key(monkeypatch):
    monkeypatch.setattr("terrella.serve.session.can_idle", lambda spec: False)

    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: any(event.get("waits") for event in socket.events))
        await asyncio.sleep(0.05)
        assert socket.last.step == 0
        session.hear("controls", HeldControls(1, ("KeyW",)))
        await until(lambda: socket.last.step > 3)
        session.hear("controls", HeldControls(2))
        await until(lambda: socket.last.step > 9)
        session.hear("restart", 5)
        await until(lambda: socket.last.step == 0)
        await asyncio.sleep(0.05)
        assert socket.last.step == 0 and socket.events[-1]["waits"]

    play(scenario)


def test_rewind_then_branch_goes_on_from_there():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: socket.frames and socket.last.step >= 20)
        session.hear("pause")
        await until(lambda: socket.events[-1]["paused"])
        shown = {frame.step: frame.images for frame in socket.frames}
        end = socket.last.step
        session.hear("rewind", 10)
        await until(lambda: socket.last.flags & REPLAY)
        assert socket.last.step == end - 10 and socket.last.images == shown[end - 10] and socket.last.newest == end
        session.hear("seek", 5)
        await until(lambda: socket.last.step == 5)
        session.hear("branch")
        await until(lambda: not socket.last.flags & REPLAY and socket.last.step >= 12)
        again = {frame.step: frame.images for frame in socket.frames[-6:]}
        assert all(images == shown[step] for step, images in again.items() if step in shown)
        session.hear("restart", 9)
        await until(lambda: socket.events[-1]["seed"] == 9)

    play(scenario)


def test_a_running_game_says_why_it_cannot_rewind():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: len(socket.frames) > 3)
        session.hear("rewind", 2)
        await until(lambda: any(event["type"] == "error" for event in socket.events))
        assert "running game" in next(event["text"] for event in socket.events if event["type"] == "error")
        count = len(socket.frames)
        await until(lambda: len(socket.frames) > count + 3)

    play(scenario, Panorama(forkable=False, dt_s=1 / 400))


def test_a_chart_tells_keyframes_only_when_they_changed():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        session.hear("show", Show(map=True, invented=False))
        charts = lambda: [event for event in socket.events if event["type"] == "chart"]  # noqa: E731
        await until(lambda: len(charts()) > 3)
        told = [event["places"] for event in charts() if "places" in event]
        assert len(told) < len(charts()) and all(a != b for a, b in zip(told, told[1:]))

    play(scenario, Mapped())


def test_a_dropped_socket_pauses_the_story_and_another_goes_on():
    async def scenario(session):
        first = FakeSocket(session)
        session.attach(first)
        session.hear("controls", HeldControls(50, ("KeyW",)))
        await until(lambda: first.frames and first.last.step >= 5)
        session.detach(first)
        await asyncio.sleep(0.05)
        step = session.timeline.history.newest.step
        await asyncio.sleep(0.05)
        assert session.timeline.history.newest.step == step
        second = FakeSocket(session)
        assert session.attach(second) is None
        await until(lambda: second.frames and second.last.step > step)
        assert second.frames[0].step == step and second.frames[0].seq > first.last.seq
        score = second.last.episode_return
        session.hear(
            "controls", HeldControls(1, ("ArrowLeft",))
        )  # a reloaded page counts anew, and no key of the old page is held
        await until(lambda: second.last.action_id == 1)
        assert second.last.episode_return == score

    play(scenario)


def test_a_broken_socket_is_let_go():
    class Broken(FakeSocket):
        async def send_bytes(self, data):
            raise ConnectionResetError

    async def scenario(session):
        session.attach(Broken(session))
        await until(lambda: not session.connected)
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: len(socket.frames) > 3)

    play(scenario)


def test_a_world_that_breaks_is_reported_and_can_be_restarted(capsys):
    world = Panorama(dt_s=1 / 400)
    world.breaks_at = 5

    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: socket.events and "paint is wet" in socket.events[-1]["text"])
        world.breaks_at = None
        session.hear("restart", 1)
        await until(lambda: socket.last.step > 8)
        assert socket.events[-1]["text"] == ""

    play(scenario, world)
    assert "RuntimeError" in capsys.readouterr().err


def test_a_world_that_cannot_start_is_reported():
    class NoStart(Panorama):
        def start(self, batch, rng):
            raise RuntimeError("no key")

    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: socket.events)
        assert "cannot start" in socket.events[-1]["text"]

    play(scenario, NoStart())


class SlowlyDrawn(Panorama):
    """A simulator whose pictures take five of its steps."""

    def __init__(self, kind: str):
        super().__init__(dt_s=1 / 100)
        self.spec = replace(self.spec, card={"kind": kind})

    def render(self, state, channels):
        if "rgb" in channels:
            time.sleep(0.05)
        return super().render(state, channels)


def test_a_simulator_that_is_drawn_slowly_keeps_its_pace_and_a_learned_world_draws_every_step():
    async def scenario(session):
        socket = FakeSocket(session)
        session.attach(socket)
        await until(lambda: len(socket.frames) >= 12)
        steps = [frame.step for frame in socket.frames]
        if session.timeline.spec.card["kind"] == "simulator":
            assert max(later - step for step, later in zip(steps[4:], steps[5:])) >= 4
        else:
            assert steps == list(range(steps[0], steps[0] + len(steps)))
        moments = session.timeline.history
        assert moments.at(steps[-2]).step == steps[-2], "steps that are not drawn can be gone back to"

    for kind in ("simulator", "learned"):
        play(scenario, SlowlyDrawn(kind))
