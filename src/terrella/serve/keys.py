"""The keys and names of a world's actions, as a page shows them and as a person changes them there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from gymnasium import spaces

from ..core.errors import TerrellaError
from ..core.keys import all_names, renamed
from ..core.spec import CHOICE, Spec, neutral_action
from .actions import axes_of

MAX_ACTIONS = 256  # that a page lists; further ones are listed where they have a key
Keep = Callable[[Spec], None]  # what is done with the spec once its keys were changed; TerrellaError where that fails


@dataclass(frozen=True)
class Action:
    """One thing to have a key for. value: the flat action; of: which of `Spec.action_names` is its name, None where that is made of
    several; sign: what is said behind the name, as of the ends of an axis."""

    name: str
    value: tuple[float, ...]
    of: int | None = None
    sign: str = ""


@dataclass(frozen=True)
class Rebound:
    """What a page asks for. keys: code -> place in the list of actions; names: place -> name."""

    keys: dict[str, int] = field(default_factory=dict)
    names: dict[int, str] = field(default_factory=dict)


def actions_of(spec: Spec) -> list[Action]:
    """What may have a key: each choice, each button, each value of several choices, each end of an axis; and what has one."""
    found = [action for action, _ in zip(_single(spec), range(MAX_ACTIONS))]
    for value in spec.keys.values():
        if _place(found, value) is None:
            found.append(Action(_joined(spec, value), tuple(float(number) for number in value)))
    return found


def _single(spec: Spec) -> Iterator[Action]:
    space, rest = spec.action, neutral_action(spec).ravel().astype(np.float64)
    names = [_tidy(name) for name in all_names(spec)]

    def only(at: int, value: float, others: np.ndarray) -> tuple[float, ...]:
        return tuple(np.where(np.arange(len(others)) == at, float(value), others).tolist())

    if isinstance(space, spaces.Discrete):
        for at in range(int(space.n)):
            yield Action(names[at], (float(space.start + at),), at)
    elif isinstance(space, spaces.MultiBinary):
        for at in range(rest.size):
            yield Action(names[at], only(at, 1, 0 * rest), at)
    elif isinstance(space, spaces.MultiDiscrete):
        for at, (low, count) in enumerate(zip(space.start.ravel(), space.nvec.ravel(), strict=True)):
            values = [value for value in low + np.arange(count) if value != rest[at]]
            for value in values:
                yield Action(names[at], only(at, value, rest), at, "" if len(values) == 1 else f": {value}")
    else:
        for at, axis in enumerate(axes_of(spec)):
            ends = [end for end in (axis["low"], axis["high"]) if end]
            for end in ends:
                sign = "" if len(ends) == 1 else " −" if end < 0 else " +"
                yield Action(names[at], only(at, end, 0 * rest), at, sign)


def _tidy(name: str) -> str:
    """MOVE_FORWARD is "forward", TURN_LEFT is "turn left"."""
    return name.lower().replace("_", " ").removeprefix("move ").strip() or name


def _joined(spec: Spec, value: list[float]) -> str:
    """The words for an action of several parts."""
    rest = 0 * np.asarray(value) if isinstance(spec.action, spaces.Box) else neutral_action(spec).ravel()
    numbers = not isinstance(spec.action, spaces.MultiBinary)
    names = [_tidy(name) for name in all_names(spec)]
    parts = [names[at] + (f" {number:g}" if numbers else "") for at, number in enumerate(value) if number != rest[at]]
    return ", ".join(parts) or "rest"


def _place(actions: list[Action], value: list[float] | np.ndarray) -> int | None:
    return next((at for at, action in enumerate(actions) if np.allclose(action.value, value)), None)


class KeyBook:
    """The keys of the world that is played. `keep` is told of each change; with `kept_in`, the words for the place where it keeps
    them, they are the world's keys from then on; without, each page has its own, and keeps them in its browser."""

    def __init__(self, spec: Spec, keep: Keep | None = None, kept_in: str = ""):
        self.spec, self.kept_in = spec, kept_in
        self._first, self._keep = spec, keep
        self.pages: set[Callable[[], None]] = set()  # called when a page has changed the keys, to look for news
        self._actions = actions_of(spec)  # whose places pages speak of, so that they stay

    def described(self) -> dict:
        """For a page: the actions with their names now and at first, code -> place of the keys now and at first, the place of the
        choice that is made without a key, and where all that is kept."""
        names = self.spec.action_names
        resting = (
            _place(self._actions, neutral_action(self._first).ravel()) if self.spec.action_mode == CHOICE else None
        )
        return {
            "actions": [
                {
                    "name": each.name if each.of is None or each.of >= len(names) else _tidy(names[each.of]),
                    "first_name": each.name,
                    "value": list(each.value),
                    "of": each.of,
                    "sign": each.sign,
                }
                for each in self._actions
            ],
            "keys": self._places(self.spec),
            "first_keys": self._places(self._first),
            "resting": resting,
            "kept_in": self.kept_in,
        }

    def changed(self, asked: Rebound) -> Spec:
        """The first spec with these keys and names; what rests goes on resting, whatever it is called. TerrellaError where there is
        no such action, or two would have one name."""
        spec = self._first
        if any(at >= len(self._actions) for at in (*asked.keys.values(), *asked.names)):
            raise TerrellaError(f"{spec.name} has {len(self._actions)} actions to give keys to; reload the page.")
        keys = {code: list(self._actions[at].value) for code, at in asked.keys.items()}
        names: dict[int, str] = {}
        for at, name in asked.names.items():
            place = self._actions[at].of
            if place is None:
                raise TerrellaError(f"'{self._actions[at].name}' is made of other names; it has none of its own.")
            names[place] = name
        return renamed(replace(spec, keys=keys), names)

    def keep(self, spec: Spec) -> None:
        """TerrellaError where it cannot be kept; it is in use all the same."""
        self.spec = spec if self.kept_in else self.spec
        if self._keep is not None:
            self._keep(spec)

    def news(self, spec: Spec) -> Spec | None:
        """The world's keys, where they are others than those of `spec`, which a page uses; None where each page has its own."""
        same = (spec.keys, spec.action_names) == (self.spec.keys, self.spec.action_names)
        return None if same or not self.kept_in else self.spec

    def _places(self, spec: Spec) -> dict[str, int]:
        found = {code: _place(self._actions, value) for code, value in spec.keys.items()}
        return {code: at for code, at in found.items() if at is not None}
