"""The contract that every room shares: World, Spec, State, Policy, rollout, as_env, check_world, errors. Each name is imported
when it is first used, because `core.spec` and `core.errors` need no torch."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .check import check_world
    from .env import WorldEnv, as_env
    from .policy import Policy
    from .rollouts import Rollout, rollout
    from .spec import Camera, Spec
    from .state import State
    from .world import Observation, World, make_rng

_HOME = {"check_world": "check", "WorldEnv": "env", "as_env": "env", "Policy": "policy", "Rollout": "rollouts"}
_HOME |= {"rollout": "rollouts", "Camera": "spec", "Spec": "spec", "State": "state"}
_HOME |= {"Observation": "world", "World": "world", "make_rng": "world"}

__all__ = ["Camera", "Observation", "Policy", "Rollout", "Spec", "State", "World", "WorldEnv"]
__all__ += ["as_env", "check_world", "make_rng", "rollout"]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)
