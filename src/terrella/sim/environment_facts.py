"""What a Gymnasium environment tells of itself: the names and keys of its actions, its frame rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, EnumMeta
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ..core.keys import default_keys, parse_keys

_NAMERS = ("get_action_meanings", "action_meanings", "get_action_names", "action_names", "get_combos")
DEFAULT_FPS = 10  # where an environment tells no frame rate


@dataclass(frozen=True)
class EnvironmentFacts:
    """names, keys: of the actions, as in Spec; dt_s: seconds in a step; how: what of this is from where, for people."""

    names: tuple[str, ...] = ()
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    dt_s: float = 1 / DEFAULT_FPS
    how: Mapping[str, str] = field(default_factory=dict)


def facts_of(env: gymnasium.Env, names: Sequence[str] = ()) -> EnvironmentFacts:
    """Asks the environment: `get_action_meanings` and the like, an `Actions` enum or whatever has "action" in its name and names
    each of them; `get_keys_to_action`; `dt`, `tau` or metadata["render_fps"]. `names` are taken where they
    are known already."""
    space, bare = env.action_space, env.unwrapped
    found, source = (tuple(names), "its adapter") if names else _names(bare, space)
    dt_s, clock = _step_seconds(env)
    how = {"action names": source or "none told", "frame rate": clock}
    table = _called(getattr(bare, "get_keys_to_action", None)) or getattr(bare, "keys_to_action", None)
    keys = parse_keys(table, space) if isinstance(table, Mapping) else {}
    how["keys"] = "get_keys_to_action" if keys else "by the actions' names" if found else "chosen"
    return EnvironmentFacts(found, keys or default_keys(space, found), dt_s, how)


def _names(bare: gymnasium.Env, space: spaces.Space) -> tuple[tuple[str, ...], str]:
    discrete = isinstance(space, spaces.Discrete)
    if not discrete and len(space.shape or ()) != 1:
        return (), ""
    count, start = (int(space.n), int(space.start)) if discrete else (int((space.shape or (0,))[0]), 0)
    others = sorted(name for name in dir(bare) if "action" in name.lower() and not name.startswith("__"))
    for name in (*_NAMERS, *others):
        if name in ("action_space", "_action_space", "np_random"):
            continue
        value = getattr(bare, name, None)
        value = _called(value) if name in _NAMERS and callable(value) else value
        for each in (value, getattr(value, "actions", None)):
            found = _listed(each, count, start)
            if found:
                return found, name
    return (), ""


def _listed(value: Any, count: int, start: int) -> tuple[str, ...]:
    """One name per action, of an enum, a dictionary either way round, texts or tuples of texts; () where it is none of these."""
    if isinstance(value, EnumMeta):
        value = {one.value: name for name, one in value.__members__.items() if isinstance(one, Enum)}
    if isinstance(value, Mapping):
        table = (
            value
            if all(isinstance(key, int | np.integer) for key in value)
            else {at: name for name, at in value.items()}
        )
        wanted = [table.get(start + at) for at in range(count)]
    elif isinstance(value, list | tuple) and len(value) == count:
        wanted = [" ".join(each) or "noop" if isinstance(each, tuple) and all(isinstance(one, str) for one in each) else each
                  for each in value]  # fmt: skip
    else:
        return ()
    plain = tuple(each for each in wanted if isinstance(each, str) and each)
    return plain if len(plain) == count and len(set(plain)) == count else ()


def _called(function: Callable | None) -> Any:
    """What a function without arguments gives; None where it wants some, or fails."""
    try:
        return function() if callable(function) else None
    except Exception:  # a stranger's code, of which nothing depends
        return None


def _step_seconds(env: gymnasium.Env) -> tuple[float, str]:
    for name in ("dt", "tau"):
        seconds = getattr(env.unwrapped, name, None)
        if isinstance(seconds, float) and 0 < seconds < math.inf:
            return seconds, f"its {name}"
    fps = env.metadata.get("render_fps")
    return (1 / fps, "its render_fps") if fps else (1 / DEFAULT_FPS, f"none told, so {DEFAULT_FPS}")
