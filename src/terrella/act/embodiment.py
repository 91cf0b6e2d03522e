"""Embodiment: one of several bodies that a policy drives, with the action space that its recording declares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ..core.errors import ActionError
from ..core.spec import Spec, shape_of

EMBODIMENT = "embodiment"  # input of a network: which body it drives, one-hot [N, bodies]


@dataclass(frozen=True)
class Embodiment:
    """A body and its actions. Names, units, mode and frame are as in Spec."""

    name: str  # of the embodiment
    shape: tuple[int, ...]  # of one action
    low: tuple[float, ...]  # of each number of an action
    high: tuple[float, ...]  # of each number of an action
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    mode: str = ""
    frame: str = ""

    @staticmethod
    def of(spec: Spec) -> Embodiment:
        """The body that a world's actions drive."""
        low, high = (tuple(np.asarray(limit, np.float64).ravel().tolist()) for limit in spec.action_limits)
        meaning = tuple(spec.action_names), tuple(spec.action_units), spec.action_mode, spec.action_frame
        return Embodiment(spec.embodiment or spec.name, shape_of(spec.action), low, high, *meaning)

    def differs(self, other: Embodiment) -> str:
        """In what their actions differ, in words; "" where they are the same."""
        mine, theirs = asdict(self), asdict(other)
        unlike = [key for key in mine if key != "name" and mine[key] != theirs[key]]
        return ", ".join(f"{key} {_text(mine[key])} and {_text(theirs[key])}" for key in unlike)


def index_of(bodies: Sequence[Embodiment], spec: Spec) -> int:
    """Which of the bodies a world's actions drive. ActionError where it is none of them, or takes other actions."""
    given = Embodiment.of(spec)
    names = [body.name for body in bodies]
    if given.name not in names:
        raise ActionError(f"the policy drives {' and '.join(names)}, and {spec.name} is another body: {given.name}.")
    index = names.index(given.name)
    if unlike := bodies[index].differs(given):
        raise ActionError(f"the policy learned other actions of {given.name} than {spec.name} takes: {unlike}.")
    return index


def _text(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else str(value) or "none"
