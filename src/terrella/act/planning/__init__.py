"""Planners over any World: what futures cost, how good ones are searched, and the policy that acts on what it finds."""

from .costs import Cost, distance, distance_to, negative_reward
from .episodes import Episode, Judge, Played, play, play_from
from .exported import ActionModel, CostModel
from .futures import Imagined, imagined
from .pace import paced, tells_apart
from .planner import Decision, Planner, Thought
from .reaching import Reaching
from .revealed import Revealed
from .searches import Found, Hints, SearchConfig, search
from .task import Task
from .ways import NEAR_M, STRIDE_S, Destination, Wayfinder

__all__ = ["Cost", "Decision", "Episode", "Found", "Hints", "Judge", "Planner", "Played", "Revealed", "SearchConfig"]
__all__ += ["Task", "Thought", "distance", "distance_to", "negative_reward", "paced", "play", "play_from", "search"]
__all__ += ["NEAR_M", "STRIDE_S", "Destination", "Imagined", "Wayfinder", "imagined", "tells_apart"]
__all__ += ["ActionModel", "CostModel", "Reaching"]
