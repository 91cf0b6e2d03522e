"""The power of a session: watts every two seconds, and a pace that keeps a budget."""

from __future__ import annotations

import pytest

from terrella.core.errors import TerrellaError
from terrella.serve.power import SLOWEST_S, Power
from terrella.workflows.play import PlayConfig, prepared


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
