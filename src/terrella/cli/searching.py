"""How `terrella plan` searches, as it is said on the command line, and what is usual where nothing is said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Literal

from tyro.conf import arg

from ..act.planning import SearchConfig
from ..core.errors import TerrellaError

Kind = Literal["icem", "cem", "mppi", "gradient", "tree", "random"]
Milliseconds = Annotated[
    float | None,
    arg(help="Search for so long a decision instead of --iterations; outcomes then depend on the machine."),
]


@dataclass(frozen=True)
class Searching:
    """How plans are searched.

    Args:
        search: icem, cem, mppi, random; gradient in worlds that can be differentiated; tree over choices. Default: icem.
        samples: Plans that are tried in a round. Default: 64; for who walks to places 32.
        iterations: Rounds of a decision. Default: 5; for who walks 1.
        horizon: Moves of a plan. Default: 12; for who walks 4.
        block: Steps for which each move is held. Default: 1; for who walks as many as are 0.115 s.
        replan: Moves that are done before the next plan is made. Default: 1; with --cost last the whole plan, for an end that is
            always a horizon away need never come.
        cost: Of a goal: sum (sooner is better), last (the end of the horizon alone) or least (its best moment). Default: sum.
        trust: The world's uncertainty at which a plan ends; unless said, that from which it invents, if it tells one.
        proposal: A policy whose plans are tried as well: a folder of `train goals`, or another policy's name.
        agent: A policy that acts in place of the search, by the same names.
    """

    search: Kind | None = None
    samples: int | None = None
    iterations: int | None = None
    horizon: int | None = None
    block: int | None = None
    replan: int | None = None
    cost: Literal["sum", "last", "least"] | None = None
    trust: float | None = None
    proposal: str | None = None
    agent: str | None = None
    budget_ms: Milliseconds = None

    def refuse(self, why: str, *names: str) -> None:
        """TerrellaError where one of these settings is said, which nothing would heed; without names, any of a search."""
        known = names or [field.name for field in fields(self) if field.name != "agent"]
        said = [f"--{name.replace('_', '-')}" for name in known if getattr(self, name) is not None]
        if said:
            raise TerrellaError(f"{why}; leave {', '.join(said)} out.")

    def settled(self, usual: Mapping[str, int]) -> Settled:
        """With what was not said: `usual`, else what is usual everywhere."""
        said = {name: value for name, value in asdict(self).items() if value is not None}
        whole = Settled(**{**usual, **said})
        return whole if self.replan or whole.cost != "last" else replace(whole, replan=whole.horizon)


@dataclass(frozen=True)
class Settled(Searching):
    """The same with what was not said."""

    search: Kind = "icem"
    samples: int = 64
    iterations: int = 5
    horizon: int = 12
    block: int = 1
    replan: int = 1
    cost: Literal["sum", "last", "least"] = "sum"

    @property
    def config(self) -> SearchConfig:
        return SearchConfig(
            self.search, self.samples, self.iterations, self.horizon, self.block, budget_ms=self.budget_ms
        )
