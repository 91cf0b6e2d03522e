"""The compute curve of `plan`: the same starts with ever fewer plans, or less time, per decision. Does thinking longer help?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..act.planning import PlayResult, SearchConfig
from ..core.world import make_rng
from ..measure.statistics import Figure, mean_interval, wilson

POINTS = 5  # of the curve at most, each with twice the compute of the one before
FEWEST = 2  # plans of a round that a search can do with


@dataclass(frozen=True)
class CurvePoint:
    """The episodes of a planner with some compute."""

    config: SearchConfig  # Its search.
    imagined: float  # Steps imagined per decision, the median.
    score: Figure  # Its success, or its return where success is not judged.
    played: PlayResult  # Its episodes.

    @property
    def label(self) -> str:
        return compute_of(self.config)


def compute_of(config: SearchConfig) -> str:
    """The compute of a search, in words."""
    return f"{config.samples} plans a round" if config.budget_ms is None else f"{config.budget_ms:g} ms a decision"


def halved(config: SearchConfig) -> list[SearchConfig]:
    """The search with its plans per round, or its time per decision, halved again and again; the least first."""
    halvings = range(POINTS - 1, 0, -1)
    if config.budget_ms is not None:
        return [replace(config, budget_ms=config.budget_ms / 2**times) for times in halvings]
    return [replace(config, samples=config.samples >> times) for times in halvings if config.samples >> times >= FEWEST]


def conclusion(points: Sequence[CurvePoint], measure: str, seed: int) -> str:
    """A sentence: does the most compute do better than the least, start by start, and from where is nothing more gained?"""
    least, most = points[0], points[-1]
    gained = gain(most.played, least.played, measure, seed)
    between = f"by {gained} in {measure} from {least.label} to {most.label}"
    if not gained.low > 0:  # NaN, too
        return f"Thinking longer is not seen to help: {between}."
    worse = [gain(most.played, point.played, measure, seed).low > 0 for point in points]
    enough = points[1 + max(at for at, is_worse in enumerate(worse) if is_worse)]
    plateau = "no plateau is seen yet" if enough is most else f"more than {enough.label} is not seen to help"
    return f"Thinking longer helps, {between}; {plateau}."


def gain(mine: PlayResult, other: PlayResult, measure: str, seed: int) -> Figure:
    """The mean difference between two policies, start by start."""
    score = lambda one: float(bool(one.success)) if measure == "success" else one.reward  # noqa: E731
    apart = [score(one) - score(beside) for one, beside in zip(mine.episodes, other.episodes)]
    return mean_interval(torch.tensor(apart), make_rng(seed))


def figures_of(played: PlayResult, seed: int) -> dict[str, Figure]:
    """Means over episodes, and medians over decisions."""
    episodes = played.episodes
    figures = {}
    if episodes[0].success is not None:
        figures["success"] = wilson(sum(bool(one.success) for one in episodes), len(episodes))
    figures["return"] = mean_interval(torch.tensor([one.reward for one in episodes]), make_rng(seed))
    figures["steps"] = mean_interval(torch.tensor([float(one.steps) for one in episodes]), make_rng(seed))
    if ms := [value for one in episodes for value in one.ms]:
        figures["ms a decision"] = _median(ms)
    if imagined := [value for one in episodes for value in one.imagined]:
        figures["steps imagined"] = _median(imagined)
    return figures


def _median(values: list) -> Figure:
    """The median, with the 5th and the 95th percentile."""
    low, middle, high = np.percentile(values, (5, 50, 95)).tolist()
    return Figure(middle, low, high, len(values))
