"""The energy of a session while it is played: watts for its page, and a pace that keeps a budget of watts."""

import time
from typing import Protocol

EVERY_S = 2.0  # between two figures
SLOWEST_S = 1.0  # of a step: where that takes too much still, the budget cannot be kept
SLACK = 1.1  # times the budget that still keep it


class Meter(Protocol):
    """Measures energy (measure/costs.py)."""

    estimated: bool
    how: str  # in words

    def joules(self) -> float:
        """Since it was made."""
        ...


class Power:
    """Counts the steps of a session, and joules of the process per step.

    step_s: seconds that a step must last at least to keep the budget; 0 without one."""

    def __init__(self, meter: Meter, budget: float | None = None):
        self.meter, self.budget, self.step_s = meter, budget, 0.0
        self._steps, self._since, self._joules = 0, time.perf_counter(), meter.joules()

    def stepped(self, held: int, now: float | None = None) -> dict[str, object] | None:
        """Counts a step of a session whose states hold `held` bytes. Every two seconds, an event for the page."""
        now = time.perf_counter() if now is None else now
        self._steps += 1
        took = now - self._since
        if took < EVERY_S:
            return None
        joules = self.meter.joules()
        watts, each = (joules - self._joules) / took, (joules - self._joules) / self._steps
        paused = took > 2 * EVERY_S and took > 2 * self._steps * SLOWEST_S
        self._steps, self._since, self._joules = 0, now, joules
        if paused:
            return None
        if self.budget is not None:
            self.step_s = min(SLOWEST_S, each / self.budget)
        kept = self.budget is None or watts <= SLACK * self.budget
        about = {"estimated": self.meter.estimated, "how": self.meter.how, "budget": self.budget, "kept": kept}
        return {"watts": round(watts, 2), "bytes": held, "step_s": self.step_s, **about}
