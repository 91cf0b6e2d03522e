"""Planners over any World: what futures cost, how good ones are searched, and the policy that acts on what it finds."""

from .budget import search_within, tells_apart
from .costs import Cost, distance, distance_to, negative_reward
from .episodes import Episode, Judge, Played, play, play_from
from .exported import ActionModel, CostModel
from .futures import Imagined, imagined
from .planner import Decision, Planner, Thought
from .reaching import Reaching
from .revealed import Revealed
from .routes import NEAR_M, STRIDE_S, Destination, Navigator
from .searches import Found, Hints, SearchConfig, search
from .task import Task

__all__ = ["Cost", "Decision", "Episode", "Found", "Hints", "Judge", "Planner", "Played", "Revealed", "SearchConfig"]
__all__ += [
    "Task",
    "Thought",
    "distance",
    "distance_to",
    "negative_reward",
    "search_within",
    "play",
    "play_from",
    "search",
]
__all__ += ["NEAR_M", "STRIDE_S", "Destination", "Imagined", "Navigator", "imagined", "tells_apart"]
__all__ += ["ActionModel", "CostModel", "Reaching"]
