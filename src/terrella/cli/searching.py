"""How `terrella plan` chooses actions, as given on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Literal

from ..act.planning import SearchConfig
from ..core.errors import TerrellaError


@dataclass(frozen=True)
class Searching:
    """How actions are chosen."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """How plans are searched."""
    cost: Literal["sum", "last", "least"] = "sum"
    """Which distances to the goal count: sum (all steps, so sooner is better), last (the end of the horizon) or least (the
    nearest step)."""
    proposal: str | None = None
    """A policy whose plans are tried as well: a folder of `train goals`, or another policy's name."""
    agent: str | None = None
    """A policy that acts in place of the search, by the same names."""

    def refuse(self, why: str, *names: str) -> None:
        """TerrellaError where one of these settings was given, though nothing would use it."""
        values = {**vars(self.search), "cost": self.cost, "proposal": self.proposal, "agent": self.agent}
        usual = {**vars(SearchConfig()), "cost": "sum", "proposal": None, "agent": None}
        given = [f"--{name.replace('_', '-')}" for name in names if values[name] != usual[name]]
        if given:
            raise TerrellaError(f"{why}; leave {', '.join(given)} out.")

    def filled(self, **defaults: int) -> Searching:
        """With defaults in place of zeros."""
        if self.cost == "last":
            horizon = self.search.filled(**defaults).horizon
            defaults = {**defaults, "replan": horizon}
        return replace(self, search=self.search.filled(**defaults))


SEARCH_SETTINGS = tuple(one.name for one in fields(SearchConfig))
