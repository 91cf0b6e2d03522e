"""Planners over any World: the cost of futures, searches for cheap plans, and the policy that acts on the best one."""

from .budget import cost_discriminates, search_config_within
from .costs import Cost, distance, distance_to, negative_reward
from .episodes import PlayedEpisode, PlayResult, PlaySettings, SuccessCriterion, play, play_from
from .exported import ActionModel, CostModel
from .fully_observed import FullyObserved
from .goal_belief import GoalBeliefPolicy
from .imagined_futures import ImaginedFuture, imagined_futures
from .planner import Decision, Planner, PlannerMemory
from .problem import PlanningProblem
from .routes import NEAR_M, STRIDE_S, Destination, Navigator
from .searches import SearchConfig, SearchResult, WarmStart, search, within_measured_trust

__all__ = ["NEAR_M", "STRIDE_S", "ActionModel", "Cost", "CostModel", "Decision", "Destination", "FullyObserved"]
__all__ += ["GoalBeliefPolicy", "ImaginedFuture", "Navigator", "Planner", "PlannerMemory", "PlanningProblem"]
__all__ += [
    "PlayResult",
    "PlaySettings",
    "PlayedEpisode",
    "SearchConfig",
    "SearchResult",
    "SuccessCriterion",
    "WarmStart",
]
__all__ += ["cost_discriminates", "distance", "distance_to", "imagined_futures", "negative_reward", "play"]
__all__ += ["play_from", "search", "search_config_within", "within_measured_trust"]
