"""The power of a session: watts every two seconds, and a pace that keeps a budget."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor

import pytest

from terrella.core.errors import TerrellaError
from terrella.serve import power as module
from terrella.serve.power import SLOWEST_S, Power
from terrella.serve.server import ServeConfig
from terrella.serve.session import Session
from terrella.serve.timeline import Timeline
from terrella.workflows.play import PlayConfig, prepared

from .panorama import Panorama
from .test_page import open_page, until  # noqa: F401
from .test_session import FakeSocket


class Meter:
    estimated, how = True, "by this test"

    def __init__(self):
        self.spent = 0.0

    def joules(self) -> float:
        return self.spent


def played(power: Power, meter: Meter, joules: float, idle_w: float = 0.0, steps: int = 400) -> list[dict]:
    """The figures of steps of 50 ms at least, each of some joules, on a machine that takes some power anyway."""
    now, events = power._since, []
    for _ in range(steps):
        took = max(0.05, power.step_s)
        now += took
        meter.spent += joules + idle_w * took
        if (event := power.stepped(2**20, now)) is not None:
            events.append(event)
    return events


def test_watts_are_joules_by_time():
    meter = Meter()
    first = played(Power(meter), meter, 0.2)[0]
    assert first["watts"] == pytest.approx(4.0) and first["kept"] and first["step_s"] == 0
    assert (first["bytes"], first["how"], first["estimated"]) == (2**20, "by this test", True)


@pytest.mark.parametrize("idle_w", [0.0, 1.0])
def test_a_budget_is_kept_by_slower_steps(idle_w):
    meter = Meter()
    last = played(Power(meter, 2.0), meter, 0.2, idle_w)[-1]
    assert last["watts"] == pytest.approx(2.0, rel=0.05) and last["kept"]
    assert last["step_s"] == pytest.approx(0.2 / (2 - idle_w), rel=0.05)


def test_a_budget_below_what_the_machine_takes_anyway_is_not_kept():
    meter = Meter()
    last = played(Power(meter, 2.0), meter, 0.2, idle_w=3.0)[-1]
    assert not last["kept"] and last["step_s"] == SLOWEST_S


def test_a_pause_gives_no_figure():
    meter = Meter()
    power = Power(meter, 2.0)
    assert power.stepped(0, power._since + 60) is None and power.step_s == 0


def test_a_budget_of_no_power_gets_a_sentence():
    with pytest.raises(TerrellaError, match="watts above 0"):
        prepared("doom-maze", PlayConfig(watts=0))


class Costly(Meter):
    """A joule each time that somebody looks."""

    def joules(self) -> float:
        self.spent += 1
        return self.spent


def test_a_session_tells_its_page_and_slows_down(monkeypatch):
    monkeypatch.setattr(module, "EVERY_S", 0.05)

    async def scenario() -> list[dict]:
        with ThreadPoolExecutor(1) as worker:
            session = Session(lambda: Timeline([Panorama(dt_s=0.01)], 0), worker, None, Power(Costly(), 100.0))
            socket, task = FakeSocket(session), asyncio.create_task(session.run())
            session.attach(socket)
            while len(costs := [event for event in socket.events if event["type"] == "costs"]) < 2:
                await asyncio.sleep(0.005)
            session.close()
            await task
            return costs

    first = asyncio.run(asyncio.wait_for(scenario(), 20))[0]
    assert first["estimated"] and first["budget"] == 100 and first["bytes"] > 0 and 0 < first["watts"] <= 20
    assert 0 < first["step_s"] <= 0.01, "a joule by the steps until then, at 100 W"


def test_the_page_shows_watts_and_how_they_were_measured(monkeypatch, serve_world, open_page):  # noqa: F811
    monkeypatch.setattr(module, "EVERY_S", 0.2)
    page = open_page(serve_world([Panorama()], config=ServeConfig(meter=Costly(), watts=0.05)).url)
    until(page, "terrella.costs !== null")
    assert page.text_content("#watts-name") == "est. power"
    assert "by this test" in page.get_attribute("#watts-cell", "title")
    until(page, "document.getElementById('toast').textContent.includes('0.05 W cannot be kept')")
