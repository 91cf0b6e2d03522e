"""The one WebSocket's language: binary frames to the page, small JSON messages both ways."""

import json
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ..core.errors import ProtocolError
from .actions import MAX_AXES
from .history import Moment
from .keys import Rebound

VERSION = 4
MAX_MESSAGE = 4096  # bytes of one message from a page
MAX_PICTURE = 2**16 - 256  # bytes of a picture from a page, which are all that it sends as bytes
GOAL_MARK = b"\x00"  # no image file begins with it
MAX_HELD = 16  # keys held at once
MAX_KEYS = 256  # of a world
MAX_NAME = 40  # letters of an action's name
MAX_WORDS = 200  # letters of an instruction
MAX_CAMERAS = 16  # shown at once
U32 = 2**32 - 1

# flags of a frame
DONE = 1  # the episode ended with this frame
FRESH = 2  # first frame of an episode
REPLAY = 4  # a frame out of the history: the session stands in the past
BEYOND = 8  # more steps were imagined since the world last observed something than it is trusted for (`measured_trust`)

# version u8, flags u8, images u16, seq u32, step u32, oldest u32, newest u32, action id u32,
# generation ms f32, episode return f32, client's time of that action f64, server's time f64, uncertainty f32,
# drifted f32; little endian
_HEADER = struct.Struct("<BBHIIIIIffddff")
_IMAGE = struct.Struct("<BBHI")  # world, camera, 0, bytes


@dataclass(frozen=True)
class HeldControls:
    """What a person holds from now on."""

    id: int  # grows with each message
    held: tuple[str, ...] = ()  # keys, in the order they were pressed
    axes: tuple[float, ...] = ()  # the value of each axis, in the world's units
    t: float = 0.0  # the page's clock, s


@dataclass(frozen=True)
class Goal:
    """A goal for the agent, one of these. Without any, there is no goal any more."""

    at: tuple[float, float] | None = None  # a place on the map, x and y in metres
    here: bool = False  # the moment shown, once the agent may drive
    picture: bytes = b""  # the bytes of an image file
    words: str = ""  # an instruction


@dataclass(frozen=True)
class Show:
    """What the page shows from now on."""

    map: bool  # asks for chart events
    invented: bool  # asks for pictures with invented pixels tinted
    cameras: tuple[str, ...] = ()  # picture channels; () for the main one
    futures: bool = False  # asks for the futures that the agent considers


def encode_frame(
    moment: Moment, seq: int, oldest: int, newest: int, controls: HeldControls, made_ms: float, server_s: float
) -> bytes:
    """One moment as the page gets it. seq counts messages, and the page acknowledges it. oldest..newest are the steps that can be
    rewound to. `controls` are the latest that this step used; their id and time are echoed. Vitals are in the order of hello."""
    parts = [
        _HEADER.pack(
            VERSION, moment.flags, len(moment.images), seq & U32, moment.step, oldest, newest, controls.id, made_ms,
            moment.episode_return, controls.t, server_s, moment.uncertainty, moment.drifted,
        )
    ]  # fmt: skip
    for image in moment.images:
        parts += [_IMAGE.pack(image.world, image.camera, 0, len(image.jpeg)), image.jpeg]
    return b"".join([*parts, struct.pack(f"<{len(moment.vitals)}f", *moment.vitals)])


def parse_message(data: str | bytes) -> tuple[str, Any]:
    """A message from a page: its kind and its value. Text is JSON of a kind in `_READERS`. Bytes are an image file, with which a
    new episode begins; after a byte 0, an image file that is the goal. ProtocolError for a malformed message."""
    if isinstance(data, bytes):
        if not 0 < len(data) <= MAX_PICTURE:
            raise ProtocolError(f"a picture of {len(data)} bytes came; at most {MAX_PICTURE} are taken.")
        if data == GOAL_MARK:
            raise ProtocolError("a goal's picture came without a picture.")
        return ("goal", Goal(picture=data[1:])) if data[:1] == GOAL_MARK else ("picture", data)
    if len(data) > MAX_MESSAGE:
        raise ProtocolError(f"a message of {len(data)} bytes is too long; the limit is {MAX_MESSAGE}.")
    try:
        body = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ProtocolError("a message is not JSON; this is a Terrella play socket, see serve/protocol.py.") from error
    if not isinstance(body, dict):
        raise ProtocolError("a message must be a JSON object with a 'type'.")
    kind = body.get("type")
    read = _READERS.get(kind) if isinstance(kind, str) else None
    if read is None:
        raise ProtocolError(f"no message is called {str(kind)[:40]!r}.")
    return str(kind), read(body)


def _controls(body: dict) -> HeldControls:
    axes = body.get("axes", [])
    if not isinstance(axes, list) or len(axes) > MAX_AXES:
        raise ProtocolError(f"'axes' must be a list of at most {MAX_AXES} numbers.")
    held = _names(body, "held", MAX_HELD, "key codes")
    numbers = tuple(_finite(value, "axes") for value in axes)
    return HeldControls(_integer(body, "id", 0, U32), held, numbers, _finite(body.get("t", 0.0), "t"))


def _goal(body: dict) -> Goal:
    at = body.get("at")
    if at is not None and (not isinstance(at, list) or len(at) != 2):
        raise ProtocolError("'at' must be a place, a list of x and y in metres.")
    place = None if at is None else (_finite(at[0], "at"), _finite(at[1], "at"))
    words = body.get("words", "")
    if not isinstance(words, str) or not words.isprintable() or len(words) > MAX_WORDS:
        raise ProtocolError(f"'words' must be an instruction of at most {MAX_WORDS} letters.")
    return Goal(place, "here" in body and _switch(body, "here"), words=words.strip())


def _rebound(body: dict) -> Rebound:
    keys, names = body.get("keys"), body.get("names", [])
    if not isinstance(keys, dict) or len(keys) > MAX_KEYS or not all(re.fullmatch(_CODE, code) for code in keys):
        raise ProtocolError(f"'keys' must be an object of at most {MAX_KEYS} key codes, and places of actions.")
    if not isinstance(names, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in names):
        raise ProtocolError("'names' must be a list of pairs, a place and a name.")
    for _, name in names:
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name.strip()) <= MAX_NAME:
            raise ProtocolError(f"the name of an action has 1 to {MAX_NAME} letters.")
    return Rebound(
        {code: _integer(keys, code, 0, U32) for code in keys},
        {_integer({"names": at}, "names", 0, U32): name.strip() for at, name in names},
    )


_CODE = r"[A-Z][A-Za-z0-9]{0,31}(\+[A-Z][A-Za-z0-9]{0,31}){0,3}"  # KeyboardEvent.code, or several held at once

_READERS: dict[str, Callable[[dict], Any]] = {
    "pause": lambda body: None,
    "resume": lambda body: None,  # goes on; from the past, back to the newest moment
    "branch": lambda body: None,  # goes on from the moment shown and forgets the later ones
    "sync": lambda body: None,  # the dream observes the game beside it
    "controls": _controls,
    "keys": _rebound,  # the keys and names of the actions from now on
    "ack": lambda body: _integer(body, "seq", 0, U32),  # of a frame that has arrived
    "restart": lambda body: None if body.get("seed") is None else _integer(body, "seed", 0, 2**31 - 1),
    "rewind": lambda body: _integer(body, "steps", -U32, U32),  # back from the moment shown, paused there
    "seek": lambda body: _integer(body, "step", 0, U32),  # to this moment or the nearest that is kept, paused there
    "record": lambda body: _switch(body, "on"),
    "drive": lambda body: _switch(body, "on"),  # whether the agent drives, until a person touches the controls
    "goal": _goal,
    "show": lambda body: Show(
        _switch(body, "map"),
        _switch(body, "invented"),
        _names(body, "cameras", MAX_CAMERAS, "picture channels"),
        "futures" in body and _switch(body, "futures"),
    ),
}


def _integer(body: dict, name: str, low: int, high: int) -> int:
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ProtocolError(f"'{name}' must be a whole number from {low} to {high}.")
    return value


def _finite(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e15:
        raise ProtocolError(f"'{name}' must be a finite number.")
    return float(value)


def _switch(body: dict, name: str) -> bool:
    value = body.get(name)
    if not isinstance(value, bool):
        raise ProtocolError(f"'{name}' must be true or false.")
    return value


def _names(body: dict, name: str, most: int, what: str) -> tuple[str, ...]:
    """A list of short strings; () if it is absent."""
    value = body.get(name, [])
    if not isinstance(value, list) or len(value) > most or not all(isinstance(k, str) and len(k) <= 64 for k in value):
        raise ProtocolError(f"'{name}' must be a list of at most {most} {what}.")
    return tuple(value)


def encode_event(kind: str, **body) -> str:
    """A JSON message to the page: hello, status, error, or one of these.

    keys:    keys that another page has set (KeyBook.described).
    agent:   driving, name; said: its latest news; thinks_ms: the 90th percentile of its decisions; away: its distance from the
             goal, in unit, or null; considers: whether it has futures to show.
    acted:   the agent's last action, as held keys and, for axes, as numbers; both empty if the person acted.
    goal:    at: a place on the map; image: a JPEG in base64; words. Each is null unless it is the goal.
    costs:   watts of the process; estimated: whether they are; how they were measured; bytes of the states of the session;
             budget: the watts that play may take, or null; kept: whether it does; step_s: seconds of a step that keeps it.
    ended:   how the episode ended that the last frame was of: outcome ("died", "won", "lost" or "over"), text, steps.
    futures: step at which they were requested, and plans, from the chosen one down to the worst: cost (null if not finite), and
             image, a JPEG in base64 of `frames` frames side by side, from the decision to the plan's end.
    chart:   world (its number on the page) and step, then camera [x, y in metres, heading in radians], known (the share of its
             picture that comes from memory, or null), imagined (the share that it remembers from its own imagination) and, if
             they changed since the last chart, places: x, y, heading and kind (1 recorded, 2 observed, 3 imagined, 4 walkable)
             of each, in one flat list. For a flat world instead, if it
             changed, mosaic: size [width, height in pixels] of the part that was seen, view: size of the picture in its middle,
             and in base64 image, a JPEG, and mask, a PNG that is transparent where nothing was seen.
    """
    return json.dumps({"type": kind, **body}, allow_nan=False)


def plain(card: Mapping[str, object]) -> dict:
    """A world's card as JSON: numbers, strings, lists and objects stay, the rest becomes text."""
    text = json.dumps(dict(card), default=lambda value: dict(value) if isinstance(value, Mapping) else str(value))
    return json.loads(text, parse_constant=str)
