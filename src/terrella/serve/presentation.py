"""What the page says of a world: who draws it, whether one aims, and how an episode ended."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from ..core.spec import Spec

NEURAL = "A neural network draws every frame. No game engine is running."
DRAWN = {
    "learned": NEURAL,
    "latent": NEURAL,
    "simulator": "A simulator draws every frame. No neural network is running.",
    "splat": "A place made of coloured Gaussians. No neural network and no game engine draw it.",
    "recording": "A recording is replayed.",
}
_SHOOTS = re.compile(r"attack|fire|shoot", re.IGNORECASE)
_LIFE = {"health", "life", "lives", "hp", "hitpoints"}
UNUSUAL = (
    10.0  # how many times as large as the mean reward of an episode its last one is, if it decides about the episode
)


def drawn_by(spec: Spec) -> str:
    """One sentence on what draws this world's pictures, by the kind on its card; "" where the card does not say."""
    return DRAWN.get(str(spec.card.get("kind")), "")


def aims(spec: Spec) -> bool:
    """Whether a person looks through the eyes of somebody who shoots: an action is named so, and the camera has a pose."""
    return "pose" in spec.channels and any(_SHOOTS.search(name) for name in spec.action_names)


def numbers_of(spec: Spec) -> list[str]:
    """The channels that are single numbers, such as health, which the page shows beside the score."""
    others = ("reward", "done", "uncertainty", "drifted", "invented")
    return [name for name, space in spec.channels.items() if space.shape == () and name not in others]


def events_of(spec: Spec) -> list[str]:
    """Those of `numbers_of` that say whether something happened in this step, such as a hit: the page counts them."""
    return [name for name in numbers_of(spec) if spec.channels[name].dtype == np.bool_]


def outcome(
    names: Sequence[str], values: Sequence[float], reward: float, before: float, steps: int
) -> Mapping[str, str]:
    """How an episode of `steps` steps ended: "outcome" (died, won, lost or over) and "text", for people.

    names, values: the numbers of the last step; reward: of the last step; before: the return without it.
    """
    if any(name.lower() in _LIFE and value <= 0 for name, value in zip(names, values, strict=True)):
        return {"outcome": "died", "text": "You died"}
    if reward and abs(reward) >= UNUSUAL * abs(before) / max(steps - 1, 1):
        return {"outcome": "won", "text": "You made it"} if reward > 0 else {"outcome": "lost", "text": "You lost"}
    return {"outcome": "over", "text": "The episode is over"}
