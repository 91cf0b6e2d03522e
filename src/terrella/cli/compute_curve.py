"""The curve of `terrella plan`: the same starts with ever fewer plans a decision, or ever less time; does thinking longer help?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from ..act.planning import PlayResult, SearchConfig
from ..core.world import make_rng
from ..measure.statistics import Figure, mean_interval

DOUBLINGS = 5  # points of the curve, at most
FEWEST = 2  # plans of a round that a search can do with


@dataclass(frozen=True)
class Point:
    """What a planner came to with so much compute. imagined: steps imagined for a decision, the median."""

    config: SearchConfig
    imagined: float
    worth: Figure
    played: PlayResult

    @property
    def words(self) -> str:
        return compute_of(self.config)


def compute_of(config: SearchConfig) -> str:
    """The compute of a search, in words."""
    return f"{config.samples} plans a round" if config.budget_ms is None else f"{config.budget_ms:g} ms a decision"


def less(config: SearchConfig) -> list[SearchConfig]:
    """The settings with the plans of a round, or the time of a decision, halved again and again; the least first."""
    shares = range(DOUBLINGS - 1, 0, -1)
    if config.budget_ms is not None:
        return [replace(config, budget_ms=config.budget_ms / 2**halvings) for halvings in shares]
    return [
        replace(config, samples=config.samples >> halvings)
        for halvings in shares
        if config.samples >> halvings >= FEWEST
    ]


def helped(points: Sequence[Point], what: str, seed: int) -> str:
    """In a sentence: whether the most compute did better than the least, start by start, and from where no more was gained."""
    least, most = points[0], points[-1]
    gained = gain(most.played, least.played, what, seed)
    between = f"by {gained} in {what} from {least.words} to {most.words}"
    if not gained.low > 0:  # nor where it cannot be told
        return f"Thinking longer is not seen to help: {between}."
    apart = [gain(most.played, point.played, what, seed).low > 0 for point in points]
    enough = points[1 + max(at for at, found in enumerate(apart) if found)]
    plateau = "no plateau is seen yet" if enough is most else f"more than {enough.words} is not seen to help"
    return f"Thinking longer helps, {between}; {plateau}."


def gain(mine: PlayResult, other: PlayResult, what: str, seed: int) -> Figure:
    """By how much one is better than another, start by start."""
    worth = lambda one: float(bool(one.success)) if what == "success" else one.reward  # noqa: E731
    apart = [worth(one) - worth(beside) for one, beside in zip(mine.episodes, other.episodes)]
    return mean_interval(torch.tensor(apart), make_rng(seed))
