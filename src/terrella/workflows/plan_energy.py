"""What a decision of `plan` costs in joules and bytes, and a search that keeps a budget of watts and of memory."""

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
class PlanBudget:
    """What planning may take; None: anything."""

    watts: float | None = None
    memory_mb: float | None = None  # MiB of all futures that are imagined together


@dataclass(frozen=True)
class DecisionCost:
    """What a decision costs for one episode alone."""

    joules: float
    period_s: float  # from one decision to the next
    futures: int  # that are imagined together
    future_bytes: int  # of all of them, without what they share
    how: str  # how joules were measured
    budget: PlanBudget = PlanBudget()
    search: str = ""  # what was given up to keep the budget: "16 of 64 plans a round"

    @property
    def watts(self) -> float:
        return self.joules / self.period_s

    @property
    def kept(self) -> bool:
        """Whether the watts are."""
        return self.budget.watts is None or self.watts <= self.budget.watts

    @property
    def fits(self) -> bool:
        """Whether the futures fit into the memory."""
        return self.budget.memory_mb is None or self.future_bytes <= self.budget.memory_mb * 2**20

    def facts(self) -> dict[str, Any]:
        """Its figures for JSON and the page's table."""
        figures = {"decision_joules": self.joules, "decision_watts": self.watts, "futures_bytes": self.future_bytes}
        watts = {} if self.budget.watts is None else {"watts": self.budget.watts, "watts_kept": self.kept}
        memory = {} if self.budget.memory_mb is None else {"memory_mb": self.budget.memory_mb, "memory_kept": self.fits}
        return {**figures, "energy": self.how, **watts, **memory}

    def lines(self) -> list[str]:
        """Sentences for people."""
        about = f"{self.joules:.3g} J ({self.how}), {self.watts:.3g} W with one each {self.period_s:.3g} s"
        held = f"its {self.futures} futures hold {bytes_in_words(self.future_bytes)}"
        lines = [f"a decision of one episode alone takes {about}; {held}"]
        with_what = f" with {self.search}" if self.search else ""
        if not self.kept:
            lines.append(f"--watts {self.budget.watts:g} cannot be kept: it takes {self.watts:.3g} W{with_what}")
        if not self.fits:
            needs = bytes_in_words(self.future_bytes)
            lines.append(f"--memory-mb {self.budget.memory_mb:g} cannot be kept: its futures hold {needs}{with_what}")
        if self.search and self.kept and self.fits:
            given = {"watts": self.budget.watts, "memory-mb": self.budget.memory_mb}
            words = " and ".join(f"--{name} {value:g}" for name, value in given.items() if value is not None)
            lines.append(f"to keep {words} it searches {self.search}")
        return lines


def priced(
    search: SearchConfig,
    budget: PlanBudget,
    policy: Callable[[SearchConfig], Policy],
    real: World,
    sees: Sequence[str],
    cuda: bool,
    seed: int,
) -> tuple[SearchConfig, DecisionCost]:
    """The search and what its decisions cost, from a start of `real`. For memory it has as many plans a round as fit. For watts, at
    one decision each `replan` moves, the plans a round, or the time, are halved, and then the rounds, as often as it takes."""
    for name, value, what in (("watts", budget.watts, "power"), ("memory-mb", budget.memory_mb, "memory")):
        if value is not None and not value > 0:
            raise TerrellaError(f"--{name} {value:g} is no {what} to plan with; give more than 0, as in --{name} 5.")
    meter, period_s = EnergyMeter(cuda), search.replan * search.block * real.spec.dt_s
    observation = real.render(real.start(1, make_rng(seed)), sees)

    def cost_of(one: SearchConfig) -> DecisionCost:
        joules, state = _measured(policy(one), observation, meter, seed)
        own = sum(size for key, size in memory_of([state]).items() if not isinstance(key, tuple)) if state else 0
        return DecisionCost(joules, period_s, one.samples, one.samples * own, meter.how, budget)

    chosen, cost = search, cost_of(search)
    if budget.memory_mb is not None and not cost.fits:
        most = int(budget.memory_mb * 2**20 * cost.futures / cost.future_bytes)
        chosen = replace(search, samples=max(2, most), elites=min(search.elites, max(2, most)))
        cost = cost_of(chosen)
    for fewer in _ever_fewer(chosen):
        if cost.kept:
            break
        chosen, cost = fewer, cost_of(fewer)
    return chosen, replace(cost, search=_given_up(search, chosen))


def _ever_fewer(search: SearchConfig) -> list[SearchConfig]:
    """The search with its plans a round, or its time, halved again and again, and then its rounds."""
    fewer = [*reversed(halved(search))]
    while (least := (fewer or [search])[-1]).budget_ms is None and least.iterations > 1:
        fewer.append(replace(least, iterations=least.iterations // 2))
    return fewer


def _given_up(whole: SearchConfig, chosen: SearchConfig) -> str:
    plans, rounds = (
        f"{chosen.samples} of {whole.samples} plans a round",
        f"{chosen.iterations} of {whole.iterations} rounds",
    )
    words = [plans] * (chosen.samples != whole.samples) + [rounds] * (chosen.iterations != whole.iterations)
    if chosen.budget_ms != whole.budget_ms:
        words.append(f"for {chosen.budget_ms:g} of {whole.budget_ms:g} ms")
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
