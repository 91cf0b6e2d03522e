"""The layout of a place, as in a layout.json: rooms, doors, windows, stairs, things; checked before anything is built. World frame,
metres: x east, y north, z up. Walls are 0.1 m thick and lie outside a room's own space."""

from __future__ import annotations  # `_value` reads annotations as text

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from ...core.errors import ContractError
from .daylight import daylight_of
from .looks import look_of
from .styles import style_of

WALL_M = 0.1
REACH_M = 0.5  # a door leads to a room at most this far behind its wall
WALLS = {"east": (0, 1), "west": (0, 0), "north": (1, 1), "south": (1, 0)}  # axis, and whether at its upper end
MOST_M, MOST_AREA_M2, MOST_THINGS = 60.0, 2000.0, 400


@dataclass(frozen=True)
class Room:
    """A box with a floor, four walls and a ceiling, each with a look (looks.py)."""

    name: str
    at: tuple[float, float, float]  # its corner with the least x and y, and the height of its floor
    size: tuple[float, float, float]  # along x, y and z
    floor: str = "planks"
    walls: str = "plaster"
    ceiling: str = "white plaster"
    lamps: int | None = None  # light panels at the ceiling; default: by its size, fewer with windows

    @property
    def low(self) -> tuple[float, float, float]:
        return self.at

    @property
    def high(self) -> tuple[float, float, float]:
        return (self.at[0] + self.size[0], self.at[1] + self.size[1], self.at[2] + self.size[2])


@dataclass(frozen=True)
class Door:
    """A door in a wall of a room. It is open if it leads to another room, else shut."""

    room: str
    wall: str
    at: float | None = None  # metres from the wall's western or southern end to its middle; default: the wall's middle
    width: float = 0.95
    height: float = 2.1
    look: str = "wood"


@dataclass(frozen=True)
class Window:
    """Like a door, but `sill` metres above the floor."""

    room: str
    wall: str
    at: float | None = None
    width: float = 1.5
    height: float = 1.3
    sill: float = 0.9
    look: str = "white paint"


@dataclass(frozen=True)
class Stairs:
    """Steps that fill a box with the corner `at` and rise towards `up`."""

    at: tuple[float, float, float]
    size: tuple[float, float, float]
    up: str = "north"
    look: str = "wood"
    label: str = "stairs"


@dataclass(frozen=True)
class Thing:
    """An object in a room."""

    label: str  # a kind of furniture (furniture.py), or any other word for a plain box
    at: tuple[float, float, float]  # the middle of its foot
    size: tuple[float, float, float] | None = None  # along x, y and z if it faced south
    facing: str = "south"
    look: str | None = None
    movable: bool | None = None  # whether it can be pushed; default: as its kind


@dataclass(frozen=True)
class RoomLayout:
    """A whole place."""

    rooms: tuple[Room, ...]
    doors: tuple[Door, ...] = ()
    windows: tuple[Window, ...] = ()
    stairs: tuple[Stairs, ...] = ()
    things: tuple[Thing, ...] = ()
    start: tuple[float, float, float] | None = None  # x, y and heading in degrees (0 east, 90 north)
    name: str = ""  # default: the file's
    seed: int = 0
    style: str = "plain"  # of furniture, windows and frames (styles.py)
    time: str = "day"  # of the day (daylight.py)
    sun: tuple[float, float] | None = (
        None  # its heading and its height above the horizon, degrees; default: by the time
    )

    def __post_init__(self):
        check(self)


_PARTS = {"rooms": Room, "doors": Door, "windows": Window, "stairs": Stairs, "things": Thing}


def read_layout(source: str | Path | Mapping[str, Any]) -> RoomLayout:
    """The layout in a file of JSON, or in its content. ContractError says what is wrong with it."""
    if isinstance(source, Mapping):
        content: Any = source
    else:
        try:
            content = json.loads(Path(source).read_text())
        except OSError as error:
            raise ContractError(f"{source} cannot be read ({error.strerror}); give words, or a layout.json.") from error
        except ValueError as error:
            raise ContractError(f"{source} is no JSON ({error}); docs/space.md shows a layout.") from error
    if not isinstance(content, Mapping):
        raise ContractError("a layout is an object of JSON with `rooms`.")
    given: dict[str, Any] = {}
    for name, value in content.items():
        if name in _PARTS:
            if not isinstance(value, Sequence) or isinstance(value, str):
                raise ContractError(f"`{name}` of a layout is a list.")
            given[name] = tuple(_read(_PARTS[name], one, f"{name}[{at}]") for at, one in enumerate(value))
        else:
            given[name] = value
    return _read(RoomLayout, given, "the layout")


def _read(kind: type, content: Any, where: str) -> Any:
    """A dataclass from a JSON object; ContractError for missing and unknown fields, and for values of another type."""
    if not isinstance(content, Mapping):
        raise ContractError(f"{where} is an object; got {content!r:.60}.")
    known = {one.name: one for one in fields(kind)}
    unknown = [str(name) for name in content if name not in known]
    missing = [name for name, one in known.items() if one.default is MISSING and name not in content]
    if unknown or missing:
        what = f"has the unknown field '{unknown[0]:.40}'" if unknown else f"lacks '{missing[0]}'"
        raise ContractError(f"{where} {what}; its fields are {', '.join(known)}.")
    return kind(**{name: _value(value, str(known[name].type), f"{where}.{name}") for name, value in content.items()})


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _value(value: Any, kind: str, where: str) -> Any:
    if value is None and "None" in kind or kind.endswith("...]"):
        return value
    if kind.startswith("tuple"):
        many = kind.split("]")[0].count("float")
        if many == 3 and where.endswith(".at") and isinstance(value, Sequence) and len(value) == 2:
            value = [*value, 0.0]
        if isinstance(value, Sequence) and len(value) == many and all(map(_finite, value)):
            return tuple(float(v) for v in value)
        raise ContractError(f"{where} takes {many} finite numbers; got {value!r:.60}.")
    if kind.startswith("bool"):
        if isinstance(value, bool):
            return value
        raise ContractError(f"{where} is true or false; got {value!r:.60}.")
    if kind.startswith("str"):
        if isinstance(value, str) and value.strip():
            return value
        raise ContractError(f"{where} takes a word or more; got {value!r:.60}.")
    whole = kind.startswith("int")
    if isinstance(value, int | float) and _finite(value) and (not whole or value == int(value) and value >= 0):
        return int(value) if whole else float(value)
    raise ContractError(f"{where} takes a {'whole number' if whole else 'finite number'}; got {value!r:.60}.")


def check(plan: RoomLayout) -> None:
    """ContractError for a layout that cannot be built."""
    daylight_of(plan.time)
    style_of(plan.style)
    if not plan.rooms:
        raise ContractError("a layout has at least one room.")
    names = [room.name for room in plan.rooms]
    if len(set(names)) < len(names):
        raise ContractError(f"two rooms are called '{max(names, key=names.count)}'; give each its own name.")
    count = len(plan.things) + len(plan.stairs)
    if count > MOST_THINGS:
        raise ContractError(f"a layout has at most {MOST_THINGS} things; this one has {count}.")
    for room in plan.rooms:
        _sizes(room.size, f"the room '{room.name}'", 0.8)
        for look in (room.floor, room.walls, room.ceiling):
            look_of(look)
    if sum(room.size[0] * room.size[1] for room in plan.rooms) > MOST_AREA_M2:
        raise ContractError(f"the rooms of a layout cover at most {MOST_AREA_M2:.0f} square metres; make them smaller.")
    for at, one in enumerate(plan.rooms):
        for other in plan.rooms[at + 1 :]:
            if all(one.low[k] < other.high[k] + WALL_M and other.low[k] < one.high[k] + WALL_M for k in range(3)):
                raise ContractError(
                    f"the rooms '{one.name}' and '{other.name}' overlap or touch; leave {WALL_M} m or more for the wall."
                )
    _check_openings(plan)
    for thing in (*plan.stairs, *plan.things):
        look_of(thing.look or "paint")
        if thing.size is not None:
            _sizes(thing.size, f"the {thing.label}", 0.01)
        facing = thing.up if isinstance(thing, Stairs) else thing.facing
        if facing not in WALLS:
            raise ContractError(f"the {thing.label} faces '{facing}'; directions are {', '.join(WALLS)}.")
    if plan.start is not None and room_at(plan, (*plan.start[:2], plan.rooms[0].at[2] + 0.5)) is None:
        raise ContractError(f"the start {list(plan.start)} lies in no room.")


def room_at(plan: RoomLayout, place: Sequence[float]) -> Room | None:
    """The room that contains a point [3]."""
    for room in plan.rooms:
        if all(room.low[k] - 1e-6 <= place[k] <= room.high[k] + 1e-6 for k in range(3)):
            return room
    return None


def _sizes(size: Sequence[float], whose: str, least: float) -> None:
    if not all(least <= one <= MOST_M for one in size):
        raise ContractError(f"{whose} has the size {list(size)}; sides are from {least} to {MOST_M:.0f} m.")


def _check_openings(plan: RoomLayout) -> None:
    rooms = {room.name: room for room in plan.rooms}
    spans: dict[tuple[str, str], list[tuple[float, float, float, float, str]]] = {}
    for one in (*plan.doors, *plan.windows):
        kind = "door" if isinstance(one, Door) else "window"
        if one.room not in rooms:
            raise ContractError(
                f"a {kind} is in the room '{one.room}', and there is none; rooms are {', '.join(rooms)}."
            )
        if one.wall not in WALLS:
            raise ContractError(f"a {kind} of '{one.room}' is in the wall '{one.wall}'; walls are {', '.join(WALLS)}.")
        room = rooms[one.room]
        look_of(one.look)
        along = room.size[1 - WALLS[one.wall][0]]
        at, sill = along / 2 if one.at is None else one.at, one.sill if isinstance(one, Window) else 0.0
        if min(one.width, one.height) < 0.3 or sill < 0:
            raise ContractError(f"a {kind} of '{one.room}' is {one.width} by {one.height} m; 0.3 m is the least.")
        left, right, top = at - one.width / 2, at + one.width / 2, sill + one.height
        if left < 0 or right > along or top > room.size[2]:
            raise ContractError(f"a {kind} does not fit into the {one.wall} wall of '{one.room}' ({along:g} m wide).")
        for a, b, low, high, other in spans.setdefault((one.room, one.wall), []):
            if left < b and a < right and sill < high and low < top:
                raise ContractError(f"a {kind} and a {other} overlap in the {one.wall} wall of '{one.room}'; move one.")
        spans[one.room, one.wall].append((left, right, sill, top, kind))
