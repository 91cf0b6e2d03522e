"""Whether a recording and a world are of the same game."""

from typing import Any

import numpy as np

from ..core.errors import DatasetError
from ..core.spec import Spec, shape_of
from .channels import facts_of
from .dataset import Dataset


def check_game(dataset: Dataset, spec: Spec) -> str:
    """Checks that a world can be trained and scored on a recording.

    DatasetError where the recording has no actions, other actions, or no pictures for a world that observes pictures.
    Returns a warning where it fits but its metadata names another game, or it has other steps a second, else "".
    """
    about: dict[str, Any] = dataset.world
    mine: dict[str, Any] = facts_of(spec)
    named = set(map(str, about.get("action_names") or ()))
    game, learned = about.get("name"), spec.card.get("game")
    limits = [name for name in ("action_low", "action_high", "discrete") if name in about and name in mine]
    theirs, ours, why = about.get("action_space") or ", ".join(dataset.action_names), spec.action, ""
    if not dataset.has("action"):
        why = "holds no actions"
    elif len(dataset.action_names) != int(np.prod(shape_of(spec.action))):
        why = f"has the actions {', '.join(dataset.action_names)}, which are not those of {spec.name} ({ours})"
    elif any(not _close(about[name], mine[name]) for name in limits):
        why = f"has actions in {theirs}, which are not those of {spec.name} ({ours})"
    elif named and spec.action_names and (learned is None or game != learned) and named.isdisjoint(spec.action_names):
        why = f"has the actions {', '.join(sorted(named))}, which are not those of {spec.name} ({', '.join(spec.action_names)})"
    elif "rgb" in spec.observes and not dataset.has("rgb"):
        why = f"holds no pictures, which {spec.name} observes"
    if why:
        raise DatasetError(
            f"{dataset.root} {why}: give recordings of its own game and actions, or train a new world on this one (terrella train)."
        )
    rate = 1 / spec.dt_s
    if abs(dataset.fps - rate) > 0.02 * rate:
        return f"{dataset.root} has {dataset.fps:.3g} steps a second; {spec.name} learned {rate:.3g}."
    differs = game and learned and game != learned
    return f"{dataset.root} is of {game}; {spec.name} learned {learned}." if differs else ""


def _close(a: Any, b: Any) -> bool:
    return np.shape(a) == np.shape(b) and np.allclose(a, b)
