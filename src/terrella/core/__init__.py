"""The contract that every room shares: World, Spec, State, rollout, as_env, check_world, errors."""

from .check import check_world
from .env import WorldEnv, as_env
from .rollout import Rollout, rollout
from .spec import Spec
from .state import State
from .world import Observation, World, make_rng

__all__ = [
    "Observation",
    "Rollout",
    "Spec",
    "State",
    "World",
    "WorldEnv",
    "as_env",
    "check_world",
    "make_rng",
    "rollout",
]
