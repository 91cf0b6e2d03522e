"""Opens the real environment that belongs to a world, and checks that both have the same actions, clock and observations."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..act.planning import FullyObserved
from ..core.errors import ActionError, PlanningError, TerrellaError
from ..core.spec import Spec, kind_of
from ..core.world import World
from ..data.channels import facts_of
from ..library import is_truth
from .opening import EnvironmentConfig

STEPS = 200  # of an episode, where the environment sets no limit
_SIZE = re.compile(r"^[\d.e+-]+ ")  # 8 of "8 N m"
_NOT_COMPARED = {
    "snapshot", "reward", "done", "truncated", "uncertainty", "drifted", "invented",
    "known", "places", "mosaic", "text", "instruction", "latent",
}  # fmt: skip


def open_real(real: str, environment: EnvironmentConfig, spec: Spec, pictures: bool = True) -> World:
    """The real environment of a world with this spec, with pictures of the size that the world observes; without `pictures` a
    Gymnasium environment renders none, and needs no display. What is randomised is the simulator that stands for the world, never
    the real environment."""
    environment = replace(environment, randomise=None)
    shape = spec.channels["rgb"].shape if "rgb" in spec.channels else None
    if shape and "rgb" in spec.observes and environment.size is None and real.startswith("gym:"):
        environment = replace(environment, size=(shape[0], shape[1]))
    takes_snapshots = any(kind_of(channel) == "snapshot" for channel in spec.observes)
    if takes_snapshots:
        return FullyObserved(open_copied(real, environment))
    return environment.open(real, rgb=pictures or not real.startswith("gym:") or real.startswith("gym:ALE/"))


def refuse_randomised(world: str, environment: EnvironmentConfig) -> None:
    """TerrellaError where --randomise is given for a learned world."""
    if environment.randomise is not None and not is_truth(world):
        raise TerrellaError(f"{world} was learned and is as it is; --randomise is for simulators (mujoco:NAME).")


def open_copied(name: str, environment: EnvironmentConfig) -> World:
    """A simulator whose states can be copied, where it has such."""
    return environment.open(name, forkable=name.startswith("gym:") and not name.startswith("gym:ALE/"))


def check_alike(world: Spec, real: Spec) -> None:
    """ActionError or PlanningError where a plan made in one world cannot be executed in the other."""
    mine, theirs = world.action_limits, real.action_limits
    if any(np.shape(a) != np.shape(b) or not np.allclose(a, b) for a, b in zip(mine, theirs)):
        raise ActionError(
            f"{world.name} takes actions in {world.action}, and {real.name} in {real.action}: they differ."
        )
    if why := meaning_difference(facts_of(world), facts_of(real)):
        raise ActionError(f"the actions of {world.name} and {real.name} mean different things: {why}.")
    if not math.isclose(world.dt_s, real.dt_s, rel_tol=0.02):
        held = round(world.dt_s / real.dt_s)
        holds = f"; {real.name}@{held} holds each action for {held} of its steps"
        hint = holds if real.name.startswith("gym:") and held > 1 else ""
        raise PlanningError(
            f"{world.name} has {1 / world.dt_s:.4g} steps a second, and {real.name} {1 / real.dt_s:.4g}{hint or ': they differ'}."
        )
    for channel in world.observes:
        if channel not in real.channels:
            raise PlanningError(
                f"{world.name} observes '{channel}', which {real.name} does not show; it shows {', '.join(real.channels)}."
            )
        if real.channels[channel].shape != world.channels[channel].shape:
            raise PlanningError(
                f"{world.name} sees '{channel}' of shape {world.channels[channel].shape}, and {real.name} shows "
                f"{real.channels[channel].shape}; --size HEIGHT WIDTH sets that of pictures."
            )


def meaning_difference(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    """How the meanings of two worlds' actions differ, by their facts (data/channels.py): mode, frame, order of the axes, units.
    "" where all that both declare agrees. The sizes of units may differ: a weaker motor is a gap to measure."""
    kinds = ("mode", "frame", "names", "units")
    mode, frame, names, units = (tuple(one.get(f"action_{kind}") or "" for one in (mine, theirs)) for kind in kinds)
    if all(mode) and mode[0] != mode[1] and "axes" not in mode:  # "axes" does not say what the numbers are
        return f"{mode[0]} and {mode[1]}"
    if all(frame) and frame[0] != frame[1]:
        return f"in the frame of the {frame[0]} and of the {frame[1]}"
    if all(names) and list(names[0]) != list(names[1]) and sorted(names[0]) == sorted(names[1]):
        return f"their axes are {', '.join(names[0])}, and {', '.join(names[1])}"
    bare = [[_SIZE.sub("", unit) for unit in one] for one in units]
    if all(units) and any(a and b and a != b for a, b in zip(*bare)):
        return f"they are in {', '.join(units[0])}, and in {', '.join(units[1])}"
    return ""


def comparable_channels(world: Spec, real: Spec) -> tuple[str, ...]:
    """The channels in which imagination and reality can be compared: pictures and vectors that both render."""
    both = [name for name in real.channels if name in world.channels and kind_of(name) not in _NOT_COMPARED]
    shapes = {name: (real.channels[name].shape, world.channels[name].shape) for name in both}
    return tuple(name for name, (mine, other) in shapes.items() if mine == other and len(mine or ()) in (1, 3))
