"""The keys of a keyboard for actions that have names, and what people say of keys, names and the action that rests."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from .errors import TerrellaError
from .spec import Spec, idle_name, shape_of

_CODES = {
    **{name: f"Arrow{name.title()}" for name in ("up", "down", "left", "right")},
    "space": "Space",
    " ": "Space",
    "enter": "Enter",
    "return": "Enter",
    "\r": "Enter",
    "tab": "Tab",
    "shift": "ShiftLeft",
    "ctrl": "ControlLeft",
    "control": "ControlLeft",
    "esc": "Escape",
    "escape": "Escape",
}
_PYGAME = {1073741903: "ArrowRight", 1073741904: "ArrowLeft", 1073741905: "ArrowDown", 1073741906: "ArrowUp"}
_WORDS = {
    **dict.fromkeys(("up", "forward", "forwards", "north", "ahead", "accelerate", "gas", "throttle", "faster"), "Up"),
    **dict.fromkeys(("down", "back", "backward", "backwards", "south", "brake", "slower", "reverse"), "Down"),
    **dict.fromkeys(("left", "west"), "Left"),
    **dict.fromkeys(("right", "east"), "Right"),
    **dict.fromkeys(("fire", "shoot", "attack", "jump", "flap", "interact", "do", "use", "toggle", "act"), "Space"),
}
_SIDEWAYS = {"Up": "KeyW", "Down": "KeyS", "Left": "KeyA", "Right": "KeyD"}
_STRAFES = {"strafe", "move", "step", "sidestep"}
_SPARE = (*(f"Digit{digit}" for digit in "1234567890"), *(f"Key{letter}" for letter in "QERTZUIOPFGHJKLXCVBNM"))


def code_of(key: str | int) -> str:
    """The browser's code (KeyboardEvent.code) of a key: "a", "left", "space", 32 (as `ord` and pygame give them), or a code."""
    if isinstance(key, int | np.integer):
        found = _PYGAME.get(int(key)) or (chr(key) if 0 <= key < 256 else "")
        key = found
    if key.lower() in _CODES:
        return _CODES[key.lower()]
    if len(key) == 1 and key.isascii() and key.isalnum():
        return f"Digit{key}" if key.isdigit() else f"Key{key.upper()}"
    if re.fullmatch(r"[A-Z][A-Za-z]+\d?|Digit\d|F\d+", key):
        return key
    raise TerrellaError(f"'{key}' is no key; name it as a, 1, left, space, or as the browser does (KeyA, ShiftLeft).")


def keys_of(names: Sequence[str]) -> dict[str, int]:
    """code -> which of the names: arrows, WASD and the space bar for what moves and acts, combinations ("ArrowUp+Space") for
    what is several of them, and the letter that a name begins with, or another, for the rest. What rests needs no key."""
    found: dict[str, int] = {}
    parts = {at: _parts(name) for at, name in enumerate(names)}
    single = {at: known[0] for at, (known, _) in parts.items() if len(known) == 1}
    turning = {way for at, way in single.items() if way != "Space" and not parts[at][1] & _STRAFES}
    for at, way in single.items():
        strafes = bool(parts[at][1] & _STRAFES) and way in turning
        found.setdefault(way if way == "Space" else _SIDEWAYS[way] if strafes else f"Arrow{way}", at)
    for arrow, other in (("Up", "Right"), ("Down", "Left"), ("Left", "Down"), ("Right", "Up")):
        if f"Arrow{arrow}" not in found and f"Arrow{other}" in found and _one_axis(found):
            found[f"Arrow{arrow}"] = found[f"Arrow{other}"]
    for way, letter in _SIDEWAYS.items():
        if f"Arrow{way}" in found and letter not in found:
            found[letter] = found[f"Arrow{way}"]
    for at, (known, _) in parts.items():
        codes = [way if way == "Space" else f"Arrow{way}" for way in known]
        if len(codes) > 1 and all(code in found for code in codes):
            found.setdefault("+".join(codes), at)
    idle = idle_name(names)
    for at, name in enumerate(names):
        if at not in found.values() and at != idle:
            letter = f"Key{name[:1].upper()}" if name[:1].isascii() and name[:1].isalpha() else ""
            free = [code for code in (letter, *_SPARE) if code and code not in found]
            if free:
                found[free[0]] = at
    return found


def _one_axis(found: Mapping[str, int]) -> bool:
    """Whether a game moves along one axis only, so that it may listen to both pairs of arrows."""
    ways = {found[code] for code in found if code.startswith("Arrow")}
    return len(ways) <= 2


def _parts(name: str) -> tuple[list[str], set[str]]:
    """What of a name is known: ways to go and "Space", in that order; and all its words."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)}
    if not words & set(_WORDS):  # UPRIGHTFIRE
        words |= set(re.findall(r"up|down|left|right|fire|jump", name.lower())) if name.isupper() else set()
    known = {_WORDS[word] for word in words if word in _WORDS}
    if len(known) > 1 and words & {"turn", "move", "strafe", "lane"}:
        known -= {"Space"}
    return [way for way in ("Up", "Down", "Left", "Right", "Space") if way in known], words


def default_keys(space: spaces.Space, names: Sequence[str] = ()) -> dict[str, list[float]]:
    """code -> flat action, for whoever says nothing of keys. Of choices and buttons by their names; two or three nameless
    choices are on the left and right arrows, more on the digits and letters. Of axes: left and right are the ends of the first,
    up and down those of the second, or, where that knows no backwards (a throttle), up is the second and down the third."""
    if isinstance(space, spaces.Discrete):
        start, count = int(space.start), int(space.n)
        if len(names) != count and count <= 3:
            return {"ArrowLeft": [float(start)], "ArrowRight": [float(start + count - 1)]}
        made = keys_of(names) if len(names) == count else dict(zip(_SPARE, range(count)))
        return {key: [float(start + at)] for key, at in made.items()}
    if isinstance(space, spaces.MultiBinary) and len(shape_of(space)) == 1:
        count = shape_of(space)[0]
        made = keys_of(names) if len(names) == count else dict(zip(_SPARE, range(count)))
        return {key: np.eye(count)[at].tolist() for key, at in made.items() if "+" not in key}
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1 and space.is_bounded()):
        return {}

    def only(axis: int, value: float) -> list[float]:
        return [float(value) if place == axis else 0.0 for place in range(space.shape[0])]

    keys = {"ArrowLeft": only(0, space.low[0]), "ArrowRight": only(0, space.high[0])}
    if space.shape[0] > 1:
        back = 1 if space.low[1] < 0 else 2
        keys["ArrowUp"] = only(1, space.high[1])
        if back < space.shape[0]:
            keys["ArrowDown"] = only(back, space.low[1] if back == 1 else space.high[back])
    return keys if bool((space.low <= 0).all() and (space.high >= 0).all()) else {}


def told_keys(table: Mapping, space: spaces.Space) -> dict[str, list[float]]:
    """The keys of Gymnasium's `get_keys_to_action`: {"w": 1, ("w", "a"): 5, (ord("d"),): 3, None: 0}; those without a key rest."""
    found = {}
    for keys, action in table.items():
        keys = () if keys is None else (keys,) if isinstance(keys, int) else tuple(keys)
        try:
            code = "+".join(sorted(code_of(key) for key in keys))
        except TerrellaError:
            continue
        if code:
            found[code] = np.asarray(action, np.float64).reshape(-1).tolist()
    width = int(np.prod(shape_of(space)))
    return {code: action for code, action in found.items() if len(action) == width}


def with_controls(
    spec: Spec, keys: Sequence[str] = (), action_names: Sequence[str] = (), idle: str | None = None
) -> Spec:
    """The spec with what a person said on the command line: keys as "a=left" or "w=0,1,0" (by a name or the numbers of an
    action, "up+space=5" for two at once), names of all actions in order, and the action that rests. TerrellaError where
    something does not fit."""
    if action_names:
        count = int(spec.action.n) if isinstance(spec.action, spaces.Discrete) else int(np.prod(shape_of(spec.action)))
        if len(action_names) != count:
            raise TerrellaError(f"{spec.name} has {count} actions; {len(action_names)} names were given.")
        spec = replace(
            spec, action_names=tuple(action_names), keys=default_keys(spec.action, action_names) or spec.keys
        )
    told = {}
    for pair in keys:
        key, equals, action = pair.partition("=")
        if not equals:
            raise TerrellaError(f"a key is said as KEY=ACTION, as in --keys a=left d=right; got '{pair}'.")
        told["+".join(code_of(part) for part in key.split("+"))] = _action(spec, action)
    rests = tuple(_action(spec, idle)) if idle is not None else spec.idle
    how = spec.card.get("how")
    card = (
        {**spec.card, "how": {**how, **({"keys": "as told"} if told else {})}} if isinstance(how, dict) else spec.card
    )
    return replace(spec, keys=told or spec.keys, idle=rests, card=card)


def _action(spec: Spec, said: str) -> list[float]:
    """The flat action of a name, or of numbers."""
    low, high = (np.asarray(limit, np.float64).reshape(-1) for limit in spec.action_limits)
    lower = [name.lower() for name in spec.action_names]
    if said.lower() in lower:
        at = lower.index(said.lower())
        return (
            [low[0] + at]
            if isinstance(spec.action, spaces.Discrete)
            else np.where(np.arange(len(low)) == at, high, 0).tolist()
        )
    try:
        found = [float(number) for number in said.split(",")]
    except ValueError:
        found = []
    if len(found) != len(low) or not ((low <= found).all() and (found <= high).all()):
        there = f"; its actions are {', '.join(spec.action_names)}" if spec.action_names else ""
        raise TerrellaError(f"'{said}' is no action of {spec.name}, which takes {spec.action}{there}.")
    return found
