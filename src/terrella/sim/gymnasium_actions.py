"""Names of the actions of Gymnasium's own environments, which their documentation gives and they themselves do not."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import gymnasium


class Documented(NamedTuple):
    """Names of the actions, and which key does which; without keys those that the names suggest."""

    names: tuple[str, ...]
    keys: Mapping[str, int] = {}


_DOCUMENTED = {
    "CartPole": Documented(("push left", "push right")),
    "MountainCar": Documented(("push left", "no push", "push right")),
    "Acrobot": Documented(("torque -1", "no torque", "torque +1"), {"ArrowLeft": 0, "ArrowRight": 2}),
    "LunarLander": Documented(
        ("do nothing", "fire left engine", "fire main engine", "fire right engine"),
        {"ArrowLeft": 1, "ArrowUp": 2, "ArrowRight": 3},
    ),
    "FrozenLake": Documented(("left", "down", "right", "up")),
    "FrozenLake8x8": Documented(("left", "down", "right", "up")),
    "CliffWalking": Documented(("up", "right", "down", "left")),
    "CliffWalkingSlippery": Documented(("up", "right", "down", "left")),
    "Taxi": Documented(
        ("south", "north", "east", "west", "pickup passenger", "drop off passenger"),
        {"ArrowDown": 0, "ArrowUp": 1, "ArrowRight": 2, "ArrowLeft": 3, "Space": 4, "KeyE": 5},
    ),
    "Blackjack": Documented(("stick", "hit")),
}


def documented_actions(env: gymnasium.Env) -> Documented:
    """What is documented of the actions of `env`; without names for environments of others."""
    spec = env.unwrapped.spec
    if spec is None or not str(spec.entry_point).startswith("gymnasium.envs."):
        return Documented(())
    return _DOCUMENTED.get(re.sub(r"-v\d+$", "", spec.id), Documented(()))
