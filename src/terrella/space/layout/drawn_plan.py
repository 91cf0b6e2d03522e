"""A floor plan that was drawn by hand, as a layout: rectangles for rooms, spots for things, and words for the style."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import ContractError
from .furniture import KINDS, SAME
from .placing import CLEAR_M, furnish_drawn
from .room_layout import MOST_THINGS, WALLS, read_layout
from .text_layout import MOST_ROOMS, ROOMS, Decoration, ParsedText, decorate

INSET_M = 0.06  # from a drawn line to a room's own space: rooms that touch have a wall between them
TOUCH_M = 0.3  # rooms this near are side by side
DOOR_M, WINDOW_M, LEAST_M = 0.95, 1.5, 1.5  # widths of openings, and the least side of a drawn room
NEAR_M = 0.8  # an opening belongs to a wall this near; a thing this near to a wall turns its back to it
BEHIND_M = 0.3  # what stands this near before a wall, as it is drawn, keeps its back to it
DARK = ("cellar", "dungeon", "garage", "corridor", "courtyard", "garden")  # kinds of rooms without windows of their own
BACK = {"east": "west", "west": "east", "north": "south", "south": "north"}


def layout_of_plan(plan: Mapping[str, Any]) -> ParsedText:
    """The layout of a drawn plan. ContractError for one that cannot be built.

    plan: `rooms`, a list of {"kind": a kind of room, "box": [x0, y0, x1, y1]}, metres, x east, y north; `things`, a list of
        {"label": furniture, "door" or "window", "at": [x, y], "facing": a direction}; `words`, the style; `furnish`, whether
        rooms without things get the usual furniture. Rooms that touch are joined by doors, if possible where nothing stands;
        outer walls get windows if none is drawn.
    """
    drawn, things = _listed(plan, "rooms", MOST_ROOMS), _listed(plan, "things", MOST_THINGS)
    if not drawn:
        raise ContractError("the plan is empty; draw a room first.")
    kinds, words = [_kind(one) for one in drawn], " ".join(str(plan.get("words", "")).split())[:400]
    decoration = decorate(words, kinds)
    layout: dict[str, Any] = {
        "name": words[:60] or "a drawn plan", "seed": 0, **decoration.atmosphere,
        "rooms": _rooms(drawn, kinds, decoration), "doors": [], "windows": [], "stairs": [], "things": [],
    }  # fmt: skip
    for one in things:
        label = SAME.get(str(one.get("label")), str(one.get("label")))
        if label in ("door", "window"):
            _opening(layout, label, _numbers(one.get("at"), 2, label))
    for one in things:
        if one.get("label") not in ("door", "window"):
            _thing(layout, one)
    entries = _doors(layout)
    if not layout["windows"]:
        _windows(layout, kinds)
    for number, room in enumerate(layout["rooms"]):
        if plan.get("furnish") is True and not any(_room_of(layout, one["at"]) is room for one in layout["things"]):
            furnish_drawn(layout, number, decoration.furniture[number], entries[room["name"]])
    return ParsedText(read_layout(layout), layout, decoration.unknown, (), words)


def _listed(plan: Mapping[str, Any], name: str, most: int) -> list[Mapping[str, Any]]:
    listed = plan.get(name, [])
    if not isinstance(listed, list) or not all(isinstance(one, Mapping) for one in listed):
        raise ContractError(f"`{name}` of a plan is a list of objects.")
    if len(listed) > most:
        raise ContractError(f"a plan has at most {most} {name}; this one has {len(listed)}.")
    return listed


def _numbers(given: Any, count: int, what: str) -> list[float]:
    plain = isinstance(given, Sequence) and not isinstance(given, str) and len(given) == count
    if not plain or not all(isinstance(v, int | float) and math.isfinite(v) and abs(v) < 1000 for v in given):
        raise ContractError(f"the {what:.40} takes {count} finite numbers below 1,000 m; got {given!r:.60}.")
    return [float(v) for v in given]


def _kind(room: Mapping[str, Any]) -> str:
    if room.get("kind") not in ROOMS:
        raise ContractError(f"'{room.get('kind')!s:.40}' is no kind of room; kinds are {', '.join(ROOMS)}.")
    return str(room["kind"])


def _rooms(drawn: Sequence[Mapping[str, Any]], kinds: Sequence[str], decoration: Decoration) -> list[dict[str, Any]]:
    rooms: list[dict[str, Any]] = []
    for one, kind, looks in zip(drawn, kinds, decoration.looks):
        x0, y0, x1, y1 = _numbers(one.get("box"), 4, kind)
        (x0, x1), (y0, y1) = sorted((x0, x1)), sorted((y0, y1))
        if min(x1 - x0, y1 - y0) < LEAST_M:
            raise ContractError(f"the {kind} is {x1 - x0:.1f} by {y1 - y0:.1f} m; draw it {LEAST_M} m wide or more.")
        same = kinds[: len(rooms)].count(kind)
        size = [round(x1 - x0 - 2 * INSET_M, 3), round(y1 - y0 - 2 * INSET_M, 3), looks["height"]]
        look = {name: value for name, value in looks.items() if name != "height"}
        at = [round(x0 + INSET_M, 3), round(y0 + INSET_M, 3), 0.0]
        rooms.append({"name": f"{kind} {same + 1}" if same else kind, "at": at, "size": size, **look})
    for k, room in enumerate(rooms):
        for other in rooms[k + 1 :]:
            if all(_ends(room, a)[0] < _ends(other, a)[1] and _ends(other, a)[0] < _ends(room, a)[1] for a in range(2)):
                raise ContractError(
                    f"the rooms '{room['name']}' and '{other['name']}' overlap; draw them side by side."
                )
    return rooms


def _ends(room: Mapping[str, Any], axis: int) -> tuple[float, float]:
    return room["at"][axis], room["at"][axis] + room["size"][axis]


def _room_of(layout: Mapping[str, Any], at: Sequence[float]) -> Mapping[str, Any] | None:
    """The room in which a place lies, or the nearest one; None where it is far from all."""
    off = [max(sign * (at[a] - _ends(room, a)[upper]) for a in range(2) for upper, sign in ((0, -1), (1, 1)))
           for room in layout["rooms"]]  # fmt: skip
    return layout["rooms"][off.index(min(off))] if min(off) <= 0.2 else None


def _shared(room: Mapping[str, Any], wall: str, other: Mapping[str, Any]) -> tuple[float, float] | None:
    """The part of a wall behind which another room lies, in world coordinates along it; None for no part."""
    axis, upper = WALLS[wall]
    gap = _ends(other, axis)[0] - _ends(room, axis)[1] if upper else _ends(room, axis)[0] - _ends(other, axis)[1]
    low, high = (pick(_ends(one, 1 - axis)[k] for one in (room, other)) for k, pick in ((0, max), (1, min)))
    return (low, high) if other is not room and 0 < gap <= TOUCH_M + 2 * INSET_M and high > low else None


def _opening(layout: dict[str, Any], label: str, at: Sequence[float]) -> None:
    """Adds a door or a window to the nearest wall."""
    width, walls = (DOOR_M if label == "door" else WINDOW_M), []
    for room in layout["rooms"]:
        for wall, (axis, upper) in WALLS.items():
            low, high = _ends(room, 1 - axis)
            if low - 0.3 <= at[1 - axis] <= high + 0.3 and high - low >= width:
                along = min(max(at[1 - axis], low + width / 2), high - width / 2) - low
                walls.append((abs(at[axis] - _ends(room, axis)[upper]), room["name"], wall, round(along, 3)))
    off, name, wall, along = min(walls, default=(math.inf, "", "", 0.0))
    if off > NEAR_M:
        raise ContractError(
            f"no wall is near enough to the {label} at {list(at)}, or wide enough for it; move it to a wall."
        )
    layout[f"{label}s"].append({"room": name, "wall": wall, "at": along, "width": width})


def _doors(layout: dict[str, Any]) -> dict[str, list[tuple[str, float]]]:
    """Joins rooms that touch, unless a door is drawn there. Returns where one comes into each room."""
    entries: dict[str, list[tuple[str, float]]] = {room["name"]: [] for room in layout["rooms"]}
    for one in layout["doors"]:
        entries[one["room"]].append((one["wall"], one["at"]))
    for room in layout["rooms"]:
        for wall in ("east", "north"):
            for other in layout["rooms"]:
                span, axis = _shared(room, wall, other), WALLS[wall][0]
                if span is None:
                    continue
                sides = ((room, wall), (other, BACK[wall]))
                middles = [one["at"] + _ends(side, 1 - axis)[0] for side, its in sides for one in layout["doors"]
                           if (one["room"], one["wall"]) == (side["name"], its)]  # fmt: skip
                drawn = [at for at in middles if span[0] <= at <= span[1]]
                if not drawn and span[1] - span[0] >= DOOR_M + 0.2:
                    drawn = [_free(layout, room, axis, span)]
                    at = round(drawn[0] - _ends(room, 1 - axis)[0], 3)
                    layout["doors"].append({"room": room["name"], "wall": wall, "at": at, "width": DOOR_M})
                for at in drawn:
                    entries[room["name"]].append((wall, at - _ends(room, 1 - axis)[0]))
                    entries[other["name"]].append((BACK[wall], at - _ends(other, 1 - axis)[0]))
    return entries


def _free(layout: Mapping[str, Any], room: Mapping[str, Any], axis: int, span: tuple[float, float]) -> float:
    """Where along the upper wall of a room a door comes: the middle of the span, or the nearest spot that is free."""
    middle, slack, wall = sum(span) / 2, (span[1] - span[0] - DOOR_M - 0.2) / 2, _ends(room, axis)[1]

    def bars(one: Mapping[str, Any], at: float) -> bool:
        halves = [side / 2 for side in one["size"][:2]][:: -1 if one["facing"] in ("east", "west") else 1]
        before = abs(one["at"][axis] - wall) < halves[axis] + CLEAR_M
        return before and abs(one["at"][1 - axis] - at) < halves[1 - axis] + DOOR_M / 2 + 0.1

    solid = [
        one for one in layout["things"] if one["at"][2] < 2 and (one["at"][2] or not KINDS[one["label"]].soft)
    ]  # no rugs
    ways = sorted((middle + slack * k / 10 for k in range(-10, 11)), key=lambda at: abs(at - middle))
    return next((at for at in ways if not any(bars(one, at) for one in solid)), middle)


def _windows(layout: dict[str, Any], kinds: Sequence[str]) -> None:
    """Gives each room a window in the middle of at most two outer walls."""
    for room, kind in zip(layout["rooms"], kinds):
        outer = [wall for wall in ("south", "east", "north", "west") if kind not in DARK
                 and room["size"][1 - WALLS[wall][0]] >= WINDOW_M + 0.8
                 and not any(_shared(room, wall, other) for other in layout["rooms"])
                 and not any((one["room"], one["wall"]) == (room["name"], wall) for one in layout["doors"])]  # fmt: skip
        for wall in outer[:2]:
            along = round(room["size"][1 - WALLS[wall][0]] / 2, 3)
            layout["windows"].append({"room": room["name"], "wall": wall, "at": along, "width": WINDOW_M})


def _thing(layout: dict[str, Any], one: Mapping[str, Any]) -> None:
    """Adds a thing, moved into its room; what stands or hangs at walls turns its back to one that is near."""
    label = SAME.get(str(one.get("label")), str(one.get("label")))
    if label not in KINDS:
        raise ContractError(
            f"'{label:.40}' is no kind of furniture; kinds are door, window, {', '.join(sorted(KINDS))}."
        )
    at, facing, kind = _numbers(one.get("at"), 2, label), str(one.get("facing", "south")), KINDS[label]
    room = _room_of(layout, at)
    if room is None or facing not in WALLS:
        raise ContractError(f"the {label} at {at} lies in no room; move it into one.")
    off = {wall: abs(at[axis] - _ends(room, axis)[upper]) for wall, (axis, upper) in WALLS.items()}
    nearest = min(off, key=lambda wall: off[wall])
    hangs = kind.stands == "hung"
    if not hangs and off[BACK[facing]] < kind.size[1] / 2 + BEHIND_M:
        nearest = BACK[facing]
    if hangs or (kind.stands == "wall" and off[nearest] < max(NEAR_M, kind.size[1])):
        facing, (axis, upper) = BACK[nearest], WALLS[nearest]
        at[axis] = _ends(room, axis)[upper]
    turned = facing in ("east", "west")
    for a in range(2):
        half, (low, high) = kind.size[a != turned] / 2 if turned else kind.size[a] / 2, _ends(room, a)
        at[a] = min(max(at[a], low + half), high - half) if high - low >= 2 * half else (low + high) / 2
    height = min(kind.size[2], room["size"][2] - (kind.hangs_m if hangs else 0.0))
    z = kind.hangs_m if hangs else room["size"][2] - height if kind.stands == "ceiling" else 0.0
    size = [*kind.size[:2], round(height, 3)]
    layout["things"].append(
        {"label": label, "at": [round(at[0], 3), round(at[1], 3), round(z, 3)], "size": size, "facing": facing}
    )
