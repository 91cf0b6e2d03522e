"""A world and the real environment beside it: opened, held to each other, compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..act.planning import Revealed
from ..core.errors import ActionError, PlanningError
from ..core.spec import Spec, kind_of
from ..core.world import World
from .named import Environment

STEPS = 200  # of an episode, where the environment sets no limit
_NEVER = (
    "snapshot",
    "reward",
    "done",
    "truncated",
    "uncertainty",
    "known",
    "places",
    "mosaic",
    "instruction",
    "latent",
)


def open_real(real: str, environment: Environment, spec: Spec) -> World:
    shape = spec.channels["rgb"].shape if "rgb" in spec.channels else None
    if shape and "rgb" in spec.observes and environment.size is None and real.startswith("gym:"):
        environment = replace(environment, size=(shape[0], shape[1]))
    told = any(kind_of(channel) == "snapshot" for channel in spec.observes)
    return Revealed(open_copied(real, environment)) if told else environment.open(real)


def open_copied(name: str, environment: Environment) -> World:
    """A simulator whose states are values, if it can be one."""
    return environment.open(name, forkable=name.startswith("gym:") and not name.startswith("gym:ALE/"))


def check_alike(world: Spec, real: Spec) -> None:
    """ActionError or PlanningError where what is planned in one cannot be done in the other."""
    mine, theirs = world.action_limits, real.action_limits
    if any(np.shape(a) != np.shape(b) or not np.allclose(a, b) for a, b in zip(mine, theirs)):
        raise ActionError(
            f"{world.name} takes actions in {world.action}, and {real.name} in {real.action}: they differ."
        )
    if not math.isclose(world.dt_s, real.dt_s, rel_tol=0.02):
        held = round(world.dt_s / real.dt_s)
        hint = (
            f"; {real.name}@{held} holds each action for {held} of its steps"
            if real.name.startswith("gym:") and held > 1
            else ""
        )
        raise PlanningError(
            f"{world.name} has {1 / world.dt_s:.4g} steps a second, and {real.name} {1 / real.dt_s:.4g}{hint or ': they differ'}."
        )
    for channel in world.observes:
        if channel not in real.channels:
            raise PlanningError(
                f"{world.name} is told '{channel}', which {real.name} does not show; it shows {', '.join(real.channels)}."
            )
        if real.channels[channel].shape != world.channels[channel].shape:
            raise PlanningError(
                f"{world.name} sees '{channel}' of shape {world.channels[channel].shape}, and {real.name} shows "
                f"{real.channels[channel].shape}; --size HEIGHT WIDTH sets that of pictures."
            )


def compared(world: Spec, real: Spec) -> tuple[str, ...]:
    """Channels in which dream and reality can be compared: pictures, and lists of numbers, that both show."""
    both = {
        name: space
        for name, space in real.channels.items()
        if name in world.channels and space.shape == world.channels[name].shape
    }
    return tuple(
        name for name, space in both.items() if kind_of(name) not in _NEVER and len(space.shape or ()) in (1, 3)
    )


def sound(value: Any) -> Any:
    """The same as JSON can say it: null for what is no finite number."""
    if isinstance(value, Mapping):
        return {str(key): sound(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [sound(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
