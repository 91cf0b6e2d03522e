"""The keys and names of a world's actions, as a page shows them and as a person changes them there."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from gymnasium import spaces

from ..core.errors import TerrellaError
from ..core.keys import all_names, with_action_names
from ..core.spec import CHOICE, Spec, neutral_action
from .actions import axes_of

MAX_ACTIONS = 256  # actions that a page lists; more are listed only if they have a key
Keep = Callable[[Spec], None]  # stores a spec whose keys were changed; TerrellaError if that fails


@dataclass(frozen=True)
class Action:
    """An action that can have a key."""

    name: str
    value: tuple[float, ...]  # the flat action
    of: int | None = None  # the index of its name in `Spec.action_names`; None if it combines several
    sign: str = ""  # shown behind the name, for example at the ends of an axis


@dataclass(frozen=True)
class Rebound:
    """The keys and names that a page sets."""

    keys: dict[str, int] = field(default_factory=dict)  # code -> index in the list of actions
    names: dict[int, str] = field(default_factory=dict)  # index -> name


def actions_of(spec: Spec) -> list[Action]:
    """The actions that can have a key: choices, buttons, values of several choices, ends of axes; and all that have one."""
    actions = [action for action, _ in zip(_single(spec), range(MAX_ACTIONS))]
    for value in spec.keys.values():
        if _index(actions, value) is None:
            actions.append(Action(_joined(spec, value), tuple(float(number) for number in value)))
    return actions


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
    """The name of an action of several parts."""
    rest = 0 * np.asarray(value) if isinstance(spec.action, spaces.Box) else neutral_action(spec).ravel()
    numbers = not isinstance(spec.action, spaces.MultiBinary)
    names = [_tidy(name) for name in all_names(spec)]
    parts = [names[at] + (f" {number:g}" if numbers else "") for at, number in enumerate(value) if number != rest[at]]
    return ", ".join(parts) or "rest"


def _index(actions: list[Action], value: list[float] | np.ndarray) -> int | None:
    return next((at for at, action in enumerate(actions) if np.allclose(action.value, value)), None)


class KeyBook:
    """The keys of the played world. `keep` is called with each change. With `kept_in`, the name of the place where it stores
    them, they hold for every page; without, each page has its own keys and stores them in its browser."""

    def __init__(self, spec: Spec, keep: Keep | None = None, kept_in: str = ""):
        self.spec, self.kept_in = spec, kept_in
        self._first, self._keep = spec, keep
        self.pages: set[Callable[[], None]] = set()  # called when a page has changed the keys, to look for news
        self._actions = actions_of(spec)  # pages name actions by their index here, so the list never changes

    def described(self) -> dict:
        """For a page: the actions with their current and first names, the current and first keys (code -> index), the index of the
        choice that is made without a key, and where the keys are stored."""
        names = self.spec.action_names
        resting = (
            _index(self._actions, neutral_action(self._first).ravel()) if self.spec.action_mode == CHOICE else None
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
            "keys": self._indices(self.spec),
            "first_keys": self._indices(self._first),
            "resting": resting,
            "kept_in": self.kept_in,
        }

    def changed(self, change: Rebound) -> Spec:
        """The first spec with these keys and names; the idle action stays the same, whatever its name. TerrellaError for an unknown
        action, and for two actions of one name."""
        spec = self._first
        if any(at >= len(self._actions) for at in (*change.keys.values(), *change.names)):
            raise TerrellaError(f"{spec.name} has {len(self._actions)} actions to give keys to; reload the page.")
        keys = {code: list(self._actions[at].value) for code, at in change.keys.items()}
        names: dict[int, str] = {}
        for at, name in change.names.items():
            place = self._actions[at].of
            if place is None:
                raise TerrellaError(f"'{self._actions[at].name}' combines other actions; it has no name of its own.")
            names[place] = name
        return with_action_names(replace(spec, keys=keys), names)

    def keep(self, spec: Spec) -> None:
        """Uses these keys and stores them. TerrellaError if they cannot be stored; they are in use all the same."""
        self.spec = spec if self.kept_in else self.spec
        if self._keep is not None:
            self._keep(spec)

    def news(self, spec: Spec) -> Spec | None:
        """The world's spec, if its keys differ from those of the page's `spec`; None if not, or if each page has its own."""
        same = (spec.keys, spec.action_names) == (self.spec.keys, self.spec.action_names)
        return None if same or not self.kept_in else self.spec

    def _indices(self, spec: Spec) -> dict[str, int]:
        indices = {code: _index(self._actions, value) for code, value in spec.keys.items()}
        return {code: at for code, at in indices.items() if at is not None}
