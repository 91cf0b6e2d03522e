"""Default keyboard keys for named actions, and a user's own keys, action names and idle action."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from .errors import TerrellaError
from .similar import did_you_mean
from .spec import CHOICE, Spec, can_idle, idle_name, neutral_action, shape_of

_CODES = {
    **{name: f"Arrow{name.title()}" for name in ("up", "down", "left", "right")}, "space": "Space", " ": "Space",
    "enter": "Enter", "return": "Enter", "\r": "Enter", "tab": "Tab", "shift": "ShiftLeft", "ctrl": "ControlLeft",
    "control": "ControlLeft", "esc": "Escape", "escape": "Escape",
}  # fmt: skip
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
# Keys for a choice, by its number of values without the idle one; the preferred keys come first.
_CLUSTERS = {
    1: (("Space",), ("KeyE",), ("KeyQ",), ("KeyX",), ("KeyZ",), ("KeyV",)),
    2: (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"), ("KeyA", "KeyD"), ("KeyW", "KeyS"), ("KeyJ", "KeyL"),
        ("KeyI", "KeyK")),
    4: tuple(tuple(one + way for way in ways) for one, ways in (
        ("Arrow", ("Up", "Right", "Down", "Left")), ("Key", "WDSA"), ("Key", "ILKJ"))),
}  # fmt: skip
_MANY = 10  # of a choice with more values, only the two ends get keys
_HINTS = (
    {"turn", "steer", "steering", "yaw", "rotate", "pan", "horizontal", "x", "strafe", "sideways"},
    {"move", "walk", "vertical", "y", "pitch", "tilt", "speed", "drive"},
)
_UPWARDS = {"ArrowUp", "KeyW", "KeyI"}
_SPARE = (*(f"Digit{digit}" for digit in "1234567890"), *(f"Key{letter}" for letter in "QERTZUIOPFGHJKLXCVBNM"))


def code_of(key: str | int) -> str:
    """The browser's code (KeyboardEvent.code) of a key: a name ("a", "left", "space"), an `ord` or pygame number, or a code."""
    if isinstance(key, int | np.integer):
        key = _PYGAME.get(int(key)) or (chr(key) if 0 <= key < 256 else "")
    if key.lower() in _CODES:
        return _CODES[key.lower()]
    if len(key) == 1 and key.isascii() and key.isalnum():
        return f"Digit{key}" if key.isdigit() else f"Key{key.upper()}"
    if re.fullmatch(r"[A-Z][A-Za-z]+\d?|Digit\d|F\d+", key):
        return key
    raise TerrellaError(
        f"'{key}' is not a key; give a name such as a, 1, left or space, or a browser code such as KeyA or ShiftLeft."
    )


def keys_of(names: Sequence[str]) -> dict[str, int]:
    """code -> index of the name that the key triggers.

    Names of movements and actions ("left", "fire") get arrows, W A S D and the space bar; names of several at once get
    combinations ("ArrowUp+Space"); other names get their first letter, or a free key. The idle action gets none.
    """
    taken: dict[str, int] = {}
    parts = {at: _parts(name) for at, name in enumerate(names)}
    single = {at: known[0] for at, (known, _) in parts.items() if len(known) == 1}
    turning = {way for at, way in single.items() if way != "Space" and not parts[at][1] & _STRAFES}
    for at, way in single.items():
        strafes = bool(parts[at][1] & _STRAFES) and way in turning
        taken.setdefault(way if way == "Space" else _SIDEWAYS[way] if strafes else f"Arrow{way}", at)
    for arrow, other in (("Up", "Right"), ("Down", "Left"), ("Left", "Down"), ("Right", "Up")):
        if f"Arrow{arrow}" not in taken and f"Arrow{other}" in taken and _one_axis(taken):
            taken[f"Arrow{arrow}"] = taken[f"Arrow{other}"]
    for way, letter in _SIDEWAYS.items():
        if f"Arrow{way}" in taken and letter not in taken:
            taken[letter] = taken[f"Arrow{way}"]
    for at, (known, _) in parts.items():
        codes = [way if way == "Space" else f"Arrow{way}" for way in known]
        if len(codes) > 1 and all(code in taken for code in codes):
            taken.setdefault("+".join(codes), at)
    idle = idle_name(names)
    for at, name in enumerate(names):
        if at not in taken.values() and at != idle:
            letter = f"Key{name[:1].upper()}" if name[:1].isascii() and name[:1].isalpha() else ""
            free = [code for code in (letter, *_SPARE) if code and code not in taken]
            if free:
                taken[free[0]] = at
    return taken


def _one_axis(taken: Mapping[str, int]) -> bool:
    """Whether a game moves along one axis only, so that both pairs of arrows can serve it."""
    return len({taken[code] for code in taken if code.startswith("Arrow")}) <= 2


def _parts(name: str) -> tuple[list[str], set[str]]:
    """(directions and "Space" that a name means, in a fixed order; all its words)."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)}
    if not words & set(_WORDS):  # UPRIGHTFIRE
        words |= set(re.findall(r"up|down|left|right|fire|jump", name.lower())) if name.isupper() else set()
    known = {_WORDS[word] for word in words if word in _WORDS}
    if len(known) > 1 and words & {"turn", "move", "strafe", "lane"}:
        known -= {"Space"}
    return [way for way in ("Up", "Down", "Left", "Right", "Space") if way in known], words


def default_keys(space: spaces.Space, names: Sequence[str] = (), rest: Sequence[float] = ()) -> dict[str, list[float]]:
    """code -> flat action, the default keys of an action space.

    Choices and buttons get keys by their names (`keys_of`). Two or three choices without names get the left and right
    arrows, more get digits and letters. Each choice of a MultiDiscrete gets a cluster of keys (`_clusters`); `rest` is the
    action that does nothing. Of a Box, left and right are the limits of the first axis, up and down those of the second;
    where the second axis has no negative values (a throttle), down is the upper limit of the third.
    """
    if isinstance(space, spaces.MultiDiscrete):
        return _clusters(space, names, rest)
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


def _clusters(space: spaces.MultiDiscrete, names: Sequence[str], rest: Sequence[float]) -> dict[str, list[float]]:
    """Keys of several simultaneous choices; each key sets one choice, while the others rest.

    A choice of two values gets one key, of three a pair (left and right, up and down, then letters), of five the arrows,
    other numbers get digits and letters; of more than _MANY values, the two ends get a pair. Choices with known names
    ("turn", "forward", "fire") are served first. W A S D repeat the arrows where they are free.
    """
    low, count = (np.asarray(value, np.float64).ravel() for value in (space.start, space.nvec))
    still = np.asarray(rest, np.float64) if len(rest) == len(low) else low
    names = names if len(names) == len(low) else [""] * len(low)
    hints = [_hint(name) for name in names]
    taken: dict[str, list[float]] = {}
    for at in sorted(range(len(low)), key=lambda at: hints[at] is None):
        values = [value for value in low[at] + np.arange(count[at]) if value != still[at]]
        values = [values[0], values[-1]] if len(values) > _MANY else values
        codes = _cluster(len(values), hints[at], names[at], taken)
        if len(values) == 2 and values[0] < still[at] < values[1] and _UPWARDS & set(codes):
            values.reverse()
        taken |= {
            code: np.where(np.arange(len(low)) == at, value, still).tolist() for code, value in zip(codes, values)
        }
    if not taken.keys() & set(_SIDEWAYS.values()):
        taken |= {letter: taken[f"Arrow{way}"] for way, letter in _SIDEWAYS.items() if f"Arrow{way}" in taken}
    return taken


def _hint(name: str) -> int | None:
    """The cluster that the name of a choice suggests: 0 sideways or an action key, 1 forwards and back; None for neither."""
    known, words = _parts(name)
    if known:
        return 0 if {"Left", "Right", "Space"} & set(known) else 1
    return next((at for at, hints in enumerate(_HINTS) if hints & words), None)


def _cluster(size: int, hint: int | None, name: str, taken: Mapping[str, object]) -> list[str]:
    """`size` keys that are free."""
    known = list(_CLUSTERS.get(size, ()))
    if size == 1 and hint is None and name[:1].isascii() and name[:1].isalpha():
        known.insert(0, (f"Key{name[0].upper()}",))
    if hint and known:
        known.insert(0, known[min(hint, len(known) - 1)])
    free = [list(codes) for codes in known if not taken.keys() & set(codes)]
    return free[0] if free else [code for code in _SPARE if code not in taken][:size]


def parse_keys(table: Mapping, space: spaces.Space) -> dict[str, list[float]]:
    """code -> flat action, from a table of Gymnasium's `get_keys_to_action`: {"w": 1, ("w", "a"): 5, (ord("d"),): 3, None: 0}."""
    parsed = {}
    for keys, action in table.items():
        keys = () if keys is None else (keys,) if isinstance(keys, int) else tuple(keys)
        try:
            code = "+".join(sorted(code_of(key) for key in keys))
        except TerrellaError:
            continue
        if code:
            parsed[code] = np.asarray(action, np.float64).reshape(-1).tolist()
    width = int(np.prod(shape_of(space)))
    return {code: action for code, action in parsed.items() if len(action) == width}


def generated_names(space: spaces.Space) -> list[str]:
    """Generated names for the actions of a space: "action 0", "button 1", "axis 1"."""
    if isinstance(space, spaces.Discrete):
        return [f"action {at}" for at in range(int(space.n))]
    what = {"MultiBinary": "button", "MultiDiscrete": "choice"}.get(type(space).__name__, "axis")
    return [f"{what} {at + 1}" for at in range(int(np.prod(shape_of(space))))]


def all_names(spec: Spec) -> list[str]:
    """A name for every action, generated where the spec has none."""
    return [*spec.action_names, *generated_names(spec.action)[len(spec.action_names) :]]


def with_action_names(spec: Spec, names: Mapping[int, str]) -> Spec:
    """The spec with new names for the actions at these indices, the same idle action; TerrellaError for a name given twice."""
    if not names:
        return spec
    whole = [names.get(at, name) for at, name in enumerate(all_names(spec))]
    if len(set(whole)) < len(whole):
        raise TerrellaError("two actions would have one name; give each its own.")
    rests = spec.idle
    if not rests and spec.action_mode == CHOICE and can_idle(spec):
        rests = tuple(neutral_action(spec).ravel().astype(float).tolist())
    return replace(spec, action_names=tuple(whole), idle=rests)


def with_changes(own: Spec, before: Spec, after: Spec) -> Spec:
    """`own` with those keys and names of `after` that differ from `before`; the three are specs of one world."""
    keys = {code: value for code, value in own.keys.items() if code in after.keys or code not in before.keys}
    keys |= {code: value for code, value in after.keys.items() if before.keys.get(code) != value}
    names = zip(all_names(before), all_names(after), strict=True)
    return with_action_names(replace(own, keys=keys), {at: new for at, (old, new) in enumerate(names) if old != new})


def with_controls(
    spec: Spec, keys: Sequence[str] = (), action_names: Sequence[str] = (), idle: str | None = None
) -> Spec:
    """The spec with a user's controls.

    keys:         "KEY=ACTION", where the action is a name or numbers: "a=left", "w=0,1,0", "up+space=5" for two keys at
                  once, "w=move:2" for one of several choices.
    action_names: names of all actions, in order.
    idle:         the action that does nothing.

    TerrellaError where something does not fit the world.
    """
    if action_names:
        count = int(spec.action.n) if isinstance(spec.action, spaces.Discrete) else int(np.prod(shape_of(spec.action)))
        if len(action_names) != count:
            raise TerrellaError(f"{spec.name} has {count} actions; {len(action_names)} names were given.")
        chosen = default_keys(spec.action, action_names, spec.idle)
        spec = replace(spec, action_names=tuple(action_names), keys=chosen or spec.keys)
    given = {}
    for pair in keys:
        key, equals, action = pair.partition("=")
        if not equals:
            raise TerrellaError(f"a key is given as KEY=ACTION, as in --keys a=left d=right; got '{pair}'.")
        given["+".join(code_of(part) for part in key.split("+"))] = _action(spec, action)
    rests = tuple(_action(spec, idle)) if idle is not None else spec.idle
    own = spec.keys
    if rests != spec.idle and own == default_keys(spec.action, spec.action_names, spec.idle):
        own = default_keys(spec.action, spec.action_names, rests)
    how = spec.card.get("how")
    card = {**spec.card, "how": {**how, **({"keys": "given"} if given else {})}} if isinstance(how, dict) else spec.card
    return replace(spec, keys=given or own, idle=rests, card=card)


def _action(spec: Spec, text: str) -> list[float]:
    """The flat action that a name or a list of numbers means."""
    low, high = (np.asarray(limit, np.float64).reshape(-1) for limit in spec.action_limits)
    lower, (name, _, value) = [name.lower() for name in spec.action_names], text.lower().partition(":")
    if text.lower() in lower:
        at = lower.index(text.lower())
        if isinstance(spec.action, spaces.Discrete):
            return [low[0] + at]
        rest = neutral_action(spec).ravel() if isinstance(spec.action, spaces.MultiDiscrete) else 0
        return np.where(np.arange(len(low)) == at, high, rest).astype(np.float64).tolist()
    if isinstance(spec.action, spaces.MultiDiscrete) and name in lower and value:
        place, rest = lower.index(name), neutral_action(spec).ravel()
        text = ",".join(value if at == place else str(n) for at, n in enumerate(rest))
    try:
        action = [float(number) for number in text.split(",")]
    except ValueError:
        action = []
    if len(action) != len(low) or not ((low <= action).all() and (action <= high).all()):
        known = f"its actions are {', '.join(spec.action_names)}" if spec.action_names else "give it as a number"
        near = did_you_mean(text, spec.action_names)
        raise TerrellaError(f"'{text}' is no action of {spec.name}, which takes {spec.action}; {known}{near or '.'}")
    return action
