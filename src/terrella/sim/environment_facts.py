"""What a Gymnasium environment declares about itself: names and keys of its actions, its frame rate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, EnumMeta
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ..core.keys import default_keys, parse_keys
from ..core.spec import idle_name
from ..core.step_length import step_length
from .gymnasium_actions import documented_actions

_NAMERS = ("get_action_meanings", "action_meanings", "get_action_names", "action_names", "get_combos")
DEFAULT_FPS = 10  # of an environment without a frame rate


@dataclass(frozen=True)
class EnvironmentFacts:
    """Facts about an environment, found or assumed."""

    names: tuple[str, ...] = ()  # of the actions, as in Spec
    keys: Mapping[str, list[float]] = field(default_factory=dict)  # key -> action, as in Spec
    dt_s: float = 1 / DEFAULT_FPS  # seconds per step
    how: Mapping[str, str] = field(default_factory=dict)  # where each fact comes from, as text


def facts_of(env: gymnasium.Env, names: Sequence[str] = ()) -> EnvironmentFacts:
    """Reads the facts from an environment that has been reset, and may step it. Action names: `names`, `get_action_meanings` and
    the like, an `Actions` enum, or any attribute with "action" in its name that names each action; last, the documentation of
    Gymnasium. Keys: `get_keys_to_action`.
    Time: see `step_length`."""
    space, bare = env.action_space, env.unwrapped
    labels, source = (tuple(names), "its adapter") if names else _names(bare, space)
    documented = documented_actions(env)
    if not labels and isinstance(space, spaces.Discrete) and len(documented.names) == space.n:
        labels, source = documented.names, "Gymnasium's documentation"
    dt_s, clock = step_length(env)
    how = {"action names": source or "without names", "frame rate": clock if dt_s else f"{clock}, so {DEFAULT_FPS}"}
    table = _called(getattr(bare, "get_keys_to_action", None)) or getattr(bare, "keys_to_action", None)
    keys = parse_keys(table, space) if isinstance(table, Mapping) else {}
    idle = idle_name(labels)
    if isinstance(space, spaces.Discrete) and idle is not None:  # no key is pressed for it
        keys = {code: action for code, action in keys.items() if action != [idle + space.start]}
    how["keys"] = "get_keys_to_action" if keys else "by the actions' names" if labels else "default"
    if labels == documented.names:
        keys = keys or {code: [float(at)] for code, at in documented.keys.items()}
    return EnvironmentFacts(labels, keys or default_keys(space, labels), dt_s or 1 / DEFAULT_FPS, how)


def _names(bare: gymnasium.Env, space: spaces.Space) -> tuple[tuple[str, ...], str]:
    """(names, the attribute that has them)."""
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
            labels = _listed(each, count, start)
            if labels:
                return labels, name
    return (), ""


def _listed(value: Any, count: int, start: int) -> tuple[str, ...]:
    """One name per action from an enum, a dictionary in either direction, texts or tuples of texts; () for anything else."""
    if isinstance(value, EnumMeta):
        value = {one.value: name for name, one in value.__members__.items() if isinstance(one, Enum)}
    if isinstance(value, Mapping):
        by_number = all(isinstance(key, int | np.integer) for key in value)
        table = value if by_number else {at: name for name, at in value.items()}
        wanted = [table.get(start + at) for at in range(count)]
    elif isinstance(value, list | tuple) and len(value) == count:
        wanted = [" ".join(each) or "noop" if isinstance(each, tuple) and all(isinstance(one, str) for one in each) else each
                  for each in value]  # fmt: skip
    else:
        return ()
    plain = tuple(each for each in wanted if isinstance(each, str) and each)
    return plain if len(plain) == count and len(set(plain)) == count else ()


def _called(function: Callable | None) -> Any:
    """The result of a function without arguments; None where it needs some, or fails."""
    try:
        return function() if callable(function) else None
    except Exception:  # foreign code, whose result is optional
        return None
