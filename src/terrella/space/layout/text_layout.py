"""Parses words into a layout: "a long room with two pillars and a red door". A small grammar, no language model; see docs/space.md.
Rooms follow one another to the east, joined by doors. Unknown words are reported.

    text    = room { room };  room = { size | look } NOUN { thing | surface };  thing = [number] { size | look } NOUN { place }
    surface = { look } ("floor" | "walls" | "ceiling");  place = ("on" | "in" | "at" | "by") ... SIDE
"""

import re
from dataclasses import dataclass, field
from typing import Any

from ...core.errors import ContractError
from . import looks
from .furniture import KINDS, SAME
from .placing import furnish_room
from .room_layout import RoomLayout, read_layout

ROOMS: dict[str, dict[str, Any]] = {  # width (to the east), depth and height in metres, and looks
    "room": {"size": (6.0, 4.8, 2.8)},
    "hall": {"size": (9.0, 6.0, 3.6), "floor": "tiles"},
    "corridor": {"size": (8.0, 2.0, 2.7)},
    "kitchen": {"size": (4.6, 3.8, 2.7), "floor": "tiles", "walls": "cream paint"},
    "bedroom": {"size": (4.8, 4.2, 2.7), "floor": "beige carpet", "walls": "pale blue paint"},
    "bathroom": {"size": (3.0, 2.6, 2.6), "floor": "tiles", "walls": "white tiles"},
    "study": {"size": (4.4, 3.8, 2.8), "walls": "light green paint"},
    "library": {"size": (7.0, 5.5, 3.4), "floor": "dark planks", "walls": "cream paint"},
    "gallery": {"size": (9.0, 4.5, 3.4), "floor": "light planks", "walls": "white paint"},
    "cellar": {"size": (6.0, 5.0, 2.5), "floor": "concrete", "walls": "brick", "ceiling": "concrete"},
    "garage": {"size": (6.5, 5.5, 2.8), "floor": "concrete", "walls": "concrete", "ceiling": "concrete"},
    "courtyard": {"size": (9.0, 8.0, 4.5), "floor": "stone", "walls": "brick", "ceiling": "sky"},
    "garden": {"size": (11.0, 9.0, 4.5), "floor": "grass", "walls": "stone", "ceiling": "sky"},
}
SIZES = {
    "long": (1.7, 1, 1), "short": (0.7, 1, 1), "wide": (1, 1.5, 1), "narrow": (1, 0.65, 1), "tall": (1, 1, 1.4),
    "high": (1, 1, 1.4),
    "low": (1, 1, 0.85), "big": (1.3, 1.3, 1.1), "large": (1.3, 1.3, 1.1), "huge": (1.8, 1.8, 1.4), "small": (0.75, 0.75, 1),
    "tiny": (0.6, 0.6, 0.95),
}  # fmt: skip
NUMBERS = {"a": 1, "an": 1, "one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "seven": 7, "eight": 8, "nine": 9,
           "ten": 10, "twelve": 12, "some": 3, "few": 3, "several": 4, "pair": 2}  # fmt: skip
SIDES = {"left": "north", "right": "south", "far": "east", "back": "east", "end": "east", "near": "west", "front": "west",
         "north": "north", "south": "south", "east": "east", "west": "west", "middle": "middle", "centre": "middle",
         "center": "middle", "corner": "corner"}  # fmt: skip
_SAME = {**SAME, "hallway": "corridor", "passage": "corridor", "office": "study", "basement": "cellar", "yard": "courtyard",
         "staircase": "stairs", "stair": "stairs", "steps": "stairs", "wall": "walls",
         "shelves": "bookshelf", "bookshelves": "bookshelf"}  # fmt: skip
_SURFACES = ("floor", "walls", "ceiling")
_PLACES = ("on", "in", "at", "by", "to", "against")
_QUIET = {*_PLACES, *"with and the of then there is are has have its it that which next beside behind beyond through from into "
          "leads leading lead another other side sides each very with, also plus both "
          "opens onto where stands stand full".split()}  # fmt: skip
_THINGS = {*KINDS, "door", "window", "stairs"}
MOST_EACH = 24


@dataclass
class _ItemText:
    """A thing in the text: its kind, how many, its look, its size relative to the usual, and where."""

    label: str
    count: int
    look: str
    scale: tuple[float, float, float]
    side: str = ""


@dataclass
class _RoomText:
    kind: str
    scale: tuple[float, float, float]
    looks: dict[str, str] = field(default_factory=dict)
    things: list[_ItemText] = field(default_factory=list)


@dataclass(frozen=True)
class ParsedText:
    """A layout that was described in words."""

    layout: RoomLayout
    document: dict[str, Any]  # the same, as layout.json has it
    unknown: tuple[str, ...]  # words that were not understood
    left_out: tuple[str, ...]  # things for which there was no place


def parse_text(text: str, seed: int = 0) -> ParsedText:
    """The layout that a text describes; ContractError if none of its words names a room or a thing."""
    rooms, unknown = _parsed(text)
    if not rooms:
        raise ContractError(
            f"nothing in '{text:.80}' names a room or a thing; try \"a long room with two pillars and a red door\". "
            f"Rooms: {', '.join(ROOMS)}. Things: {', '.join(sorted(_THINGS))}."
        )
    layout: dict[str, Any] = {
        "name": "place",
        "seed": seed,
        "rooms": [],
        "doors": [],
        "windows": [],
        "stairs": [],
        "things": [],
    }
    x, names = 0.0, []
    for room in rooms:
        about = {**ROOMS[room.kind], **room.looks}
        size = [round(max(a * b, 1.6), 2) for a, b in zip(about.pop("size"), room.scale)]
        if any(one.label in ("stairs", "platform") for one in room.things):
            size[2] = max(size[2], 3.2)
        names.append(room.kind if room.kind not in names else f"{room.kind} {len(names) + 1}")
        layout["rooms"].append(
            {"name": names[-1], "at": [round(x, 2), round(-size[1] / 2, 2), 0.0], "size": size, **about}
        )
        x += size[0] + 0.12
    left_out: list[str] = []
    for at, room in enumerate(rooms):
        following = at + 1 < len(rooms)
        left_out += furnish_room(layout, at, room.things, following, seed)
    return ParsedText(read_layout(layout), layout, tuple(unknown), tuple(left_out))


def _parsed(text: str) -> tuple[list[_RoomText], list[str]]:
    """The rooms with their things, and the words that were not understood."""
    rooms: list[_RoomText] = []
    unknown: list[str] = []
    words: list[str] = re.findall(r"[a-z0-9#]+", text.lower())[:400]
    count, scale, look, placed, definite, last = 1, (1.0, 1.0, 1.0), [], False, False, None
    for at, word in enumerate(words):
        noun, following = _noun(word), _noun(words[at + 1]) if at + 1 < len(words) else ""
        compound = following in ROOMS and (word in ("living", "dining", "sitting"))
        if word in SIDES and last is not None and placed:
            last.side, placed = SIDES[word], False
        elif word in NUMBERS or word.isdigit():
            count = min(NUMBERS.get(word) or int(word), MOST_EACH)
        elif noun in ROOMS:
            if not (
                rooms and (definite or placed) and count == 1 and not look
            ):  # "in the middle of the room" is no new one
                rooms.append(_RoomText(noun, scale, {"walls": " ".join(look)} if look else {}))
                last = None
            count, scale, look, placed = 1, (1.0, 1.0, 1.0), [], False
        elif noun in _SURFACES and (look or not placed):
            rooms = rooms or [_RoomText("room", (1.0, 1.0, 1.0))]
            rooms[-1].looks |= {noun: " ".join(look)} if look else {}
            count, scale, look = 1, (1.0, 1.0, 1.0), []
        elif noun in _THINGS and not (noun == "rug" and following in _SURFACES):
            rooms = rooms or [_RoomText("room", (1.0, 1.0, 1.0))]
            last = _ItemText(noun, count, " ".join(look), scale)
            rooms[-1].things.append(last)
            count, scale, look, placed = 1, (1.0, 1.0, 1.0), [], False
        elif word in SIZES:
            scale = (scale[0] * SIZES[word][0], scale[1] * SIZES[word][1], scale[2] * SIZES[word][2])
        elif word in looks.WORDS:
            look.append(word)
        elif word in SIDES or compound or word in _QUIET or noun in _SURFACES:
            placed = placed or word in _PLACES
        else:
            unknown.append(word)
        definite = word == "the" or definite and word not in (*_QUIET, *_THINGS)
    return rooms, list(dict.fromkeys(unknown))


def _noun(word: str) -> str:
    """The word in the singular, by its usual name."""
    for one in (word, word.removesuffix("s"), word.removesuffix("es"), word.removesuffix("ies") + "y"):
        one = _SAME.get(one, one)
        if one in ROOMS or one in _THINGS or one in _SURFACES:
            return one
    return word
