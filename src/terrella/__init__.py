"""Terrella: worlds that are learned from recordings, played in a browser, planned in, and measured.

`import terrella` imports nothing heavy and configures nothing; each name below is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .core import Spec, State, World, check_world, make_rng, rollout
    from .core.env import as_env
    from .library import as_sb3, load, load_policy, worlds

__version__ = "0.1.0"
__all__ = ["Spec", "State", "World", "as_env", "as_sb3", "check_world", "load", "load_policy"]
__all__ += ["make_rng", "rollout", "worlds"]

_HOME = {
    **dict.fromkeys(["Spec", "State", "World", "check_world", "make_rng", "rollout"], ".core"),
    "as_env": ".core.env",
    **dict.fromkeys(["as_sb3", "load", "load_policy", "worlds"], ".library"),
}


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'terrella' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_HOME[name], __name__), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
