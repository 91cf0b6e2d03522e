"""What a decision of `plan` costs in joules and bytes, and a search that keeps a budget of watts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..act.planning import SearchConfig
from ..core.errors import TerrellaError
from ..core.policy import Policy
from ..core.state import State, memory_of
from ..core.world import World, make_rng
from ..measure.costs import EnergyMeter
from ..serve.power import Meter
from .compute_curve import halved
from .costs import bytes_in_words

DECISIONS = 3  # that are measured, after a first


@dataclass(frozen=True)
class DecisionCost:
    """What a decision costs for one episode alone."""

    joules: float
    period_s: float  # from one decision to the next
    futures: int  # that are imagined together
    future_bytes: int  # of all of them, without what they share
    how: str  # how joules were measured
    budget: float | None = None  # watts
    search: str = ""  # what was given up to keep the budget: "16 of 64 plans a round"

    @property
    def watts(self) -> float:
        return self.joules / self.period_s

    @property
    def kept(self) -> bool:
        return self.budget is None or self.watts <= self.budget

    def facts(self) -> dict[str, Any]:
        """Its figures for JSON and the page's table."""
        figures = {"decision_joules": self.joules, "decision_watts": self.watts, "futures_bytes": self.future_bytes}
        budget = {} if self.budget is None else {"watts": self.budget, "watts_kept": self.kept}
        return {**figures, "energy": self.how, **budget}

    def lines(self) -> list[str]:
        """Sentences for people."""
        about = f"{self.joules:.3g} J ({self.how}), {self.watts:.3g} W with one each {self.period_s:.3g} s"
        held = f"its {self.futures} futures hold {bytes_in_words(self.future_bytes)}"
        lines = [f"a decision of one episode alone takes {about}; {held}"]
        if self.budget is not None and not self.kept:
            with_what = f" with {self.search}" if self.search else ""
            lines.append(f"--watts {self.budget:g} cannot be kept: it takes {self.watts:.3g} W{with_what}")
        elif self.search:
            lines.append(f"to keep --watts {self.budget:g} it searches {self.search}")
        return lines


def priced(
    search: SearchConfig,
    budget: float | None,
    policy: Callable[[SearchConfig], Policy],
    real: World,
    sees: Sequence[str],
    cuda: bool,
    seed: int,
) -> tuple[SearchConfig, DecisionCost]:
    """The search and what its decisions cost, from a start of `real`. budget: watts that planning may take, at one decision each
    `replan` moves; for it the plans a round, or the time, are halved, and then the rounds, as often as it takes."""
    if budget is not None and not budget > 0:
        raise TerrellaError(f"--watts {budget:g} is no power to plan with; give watts above 0, as in --watts 5.")
    fewer = [*reversed(halved(search))] if budget is not None else []
    while budget is not None and (least := (fewer or [search])[-1]).budget_ms is None and least.iterations > 1:
        fewer.append(replace(least, iterations=least.iterations // 2))
    meter, period_s = EnergyMeter(cuda), search.replan * search.block * real.spec.dt_s
    observation = real.render(real.start(1, make_rng(seed)), sees)
    cost, chosen = DecisionCost(0.0, period_s, search.samples, 0, meter.how, budget), search
    for chosen in (search, *fewer):
        joules, state = _measured(policy(chosen), observation, meter, seed)
        own = sum(size for key, size in memory_of([state]).items() if not isinstance(key, tuple)) if state else 0
        cost = replace(cost, joules=joules, futures=chosen.samples, future_bytes=chosen.samples * own)
        if cost.kept:
            break
    return chosen, replace(cost, search=_given_up(search, chosen))


def _given_up(whole: SearchConfig, chosen: SearchConfig) -> str:
    plans, rounds = (
        f"{chosen.samples} of {whole.samples} plans a round",
        f"{chosen.iterations} of {whole.iterations} rounds",
    )
    if chosen.budget_ms != whole.budget_ms:
        return f"for {chosen.budget_ms:g} of {whole.budget_ms:g} ms"
    words = [plans] * (chosen.samples != whole.samples) + [rounds] * (chosen.iterations != whole.iterations)
    return " and ".join(words)


@torch.no_grad()
def _measured(policy: Policy, observation: Any, meter: Meter, seed: int) -> tuple[float, State | None]:
    """Mean joules of a first decision, and the state in which it was made."""
    memory: Any = None
    for number in range(DECISIONS + 1):
        if number == 1:
            before = meter.joules()
        _, memory = policy.act(observation, policy.begin(1, make_rng(seed)), make_rng(seed))
    one = getattr(memory[0], "planner", memory[0])  # of a navigator
    return (meter.joules() - before) / DECISIONS, one.decision.state
