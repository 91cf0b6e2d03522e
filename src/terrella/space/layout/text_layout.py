"""Parses words into a layout: "a long room with two pillars and a red door". A small grammar, no language model; see docs/space.md.
Rooms follow one another to the east, joined by doors. Unknown words are reported.

    text    = room { room };  room = { size | look } NOUN { thing | surface };  thing = [number] { size | look } NOUN { place }
    surface = { look } ("floor" | "walls" | "ceiling");  place = ("on" | "in" | "at" | "by") ... SIDE
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ...core.errors import ContractError
from . import looks
from .daylight import SAME_TIME, TIMES
from .furniture import KINDS, SAME
from .placing import FurnitureRequest, furnish_room
from .room_layout import MOST_THINGS, RoomLayout, read_layout
from .styles import ALWAYS, EMPTY, MOODS, STYLE_WORDS, STYLES, furnishing

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
    "dungeon": {"size": (7.0, 5.4, 3.0), "floor": "flagstone", "walls": "stone", "ceiling": "dark stone", "lamps": 0},
    "loft": {"size": (8.5, 6.0, 3.8), "floor": "concrete"},
    "tearoom": {"size": (5.4, 4.6, 2.6)},
    "livingroom": {"size": (6.0, 4.8, 2.8)},
    "garage": {"size": (6.5, 5.5, 2.8), "floor": "concrete", "walls": "concrete", "ceiling": "concrete"},
    "courtyard": {"size": (9.0, 8.0, 4.5), "floor": "stone", "walls": "brick", "ceiling": "sky"},
    "garden": {"size": (11.0, 9.0, 4.5), "floor": "grass", "walls": "stone", "ceiling": "sky"},
}
SIZES = {
    "long": (1.7, 1, 1), "short": (0.7, 1, 1), "wide": (1, 1.5, 1), "broad": (1, 1.5, 1), "narrow": (1, 0.65, 1),
    "tall": (1, 1, 1.4), "high": (1, 1, 1.4), "low": (1, 1, 0.8), "big": (1.3, 1.3, 1.1), "large": (1.3, 1.3, 1.1),
    "huge": (1.8, 1.8, 1.4), "giant": (1.8, 1.8, 1.4), "enormous": (1.8, 1.8, 1.4), "small": (0.75, 0.75, 1),
    "little": (0.75, 0.75, 1), "tiny": (0.6, 0.6, 0.95),
}  # fmt: skip
_ONES = ("zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen seventeen eighteen "
         "nineteen twenty")  # fmt: skip
NUMBERS = {**{word: at for at, word in enumerate(_ONES.split())}, "single": 1, "some": 3, "few": 3,
           "several": 4, "many": 6, "lots": 6}  # fmt: skip
GROUPS = {"pair": 2, "pairs": 2, "couple": 2, "dozen": 12, "dozens": 12, "hundred": 100}
PLURALS = {
    "pillar": 4,
    "chair": 4,
    "door": 2,
    "stairs": 1,
    "room": 2,
    "torch": 6,
}  # how many without a number; of others 3
SIDES = {"left": "north", "right": "south", "far": "east", "back": "east", "end": "east", "near": "west", "front": "west",
         "north": "north", "south": "south", "east": "east", "west": "west", "middle": "middle", "centre": "middle",
         "center": "middle", "corner": "corner"}  # fmt: skip
_SAME = {**SAME, "hallway": "corridor", "passage": "corridor", "office": "study", "basement": "cellar", "yard": "courtyard",
         "staircase": "stairs", "stair": "stairs", "steps": "stairs", "wall": "walls",
         "shelves": "bookshelf", "bookshelves": "bookshelf"}  # fmt: skip
_SURFACES = ("floor", "walls", "ceiling")
_PLACES = ("on", "in", "at", "by", "to", "against")
_RELATIONS = {*_PLACES, *"next beside behind beyond near under above below over opposite between around inside".split()}
_NONE = ("no", "without", "zero", "nor", "0")
_BREAKS = {"with", "then", "but", *_NONE}  # adjectives do not reach over them
_QUIET = {*"with and or but the of then there is are has have its it that which also plus through from into leads leading lead "
          "another made opens onto where stands stand side sides".split()}  # fmt: skip
_THINGS = {*KINDS, "door", "window", "stairs"}
_SIDELESS = {
    "door": ("middle", "corner"),
    "window": ("middle", "corner"),
    "stairs": ("east", "west", "middle", "corner"),
}
_NOUNS = {*ROOMS, *_THINGS, *_SURFACES}
_FILLERS = re.compile(r"\b(put|place|add|set|here|there|please|right|just)\b")  # "put a chair right here"
MOST_ROOMS = 12
MOST_COUNT = 10_000


@dataclass
class _RoomText:
    kind: str
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    looks: dict[str, str] = field(default_factory=dict)
    things: list[FurnitureRequest] = field(default_factory=list)
    without: set[str] = field(default_factory=set)  # what is not to be there


@dataclass(frozen=True)
class ParsedText:
    """A layout that was described in words."""

    layout: RoomLayout
    document: dict[str, Any]  # the same, as layout.json has it
    unknown: tuple[str, ...]  # words that were not understood, or have no effect
    left_out: tuple[str, ...]  # things for which there was no place
    text: str = ""


def parse_text(text: str, seed: int = 0) -> ParsedText:
    """The layout that a text describes; ContractError if none of its words names a room or a thing."""
    reader = _Reader(text)
    if not reader.rooms:
        raise ContractError(
            f"nothing in '{text:.80}' names a room or a thing; try \"a long room with two pillars and a red door\". "
            f"Rooms: {', '.join(ROOMS)}. Things: {', '.join(sorted(_THINGS))}."
        )
    name = " ".join(text.split())
    layout: dict[str, Any] = {
        "name": name if len(name) <= 60 else f"{name[:58].rsplit(' ', 1)[0].rstrip(' ,')}...",
        "seed": seed,
        **_atmosphere(reader, [room.kind for room in reader.rooms]),
        "rooms": [],
        "doors": [],
        "windows": [],
        "stairs": [],
        "things": [],
    }
    x, names = 0.0, []
    for room in reader.rooms:
        about = {**ROOMS[room.kind], **_looks(room, layout["style"])}
        if (
            _furnished(room, reader)
            and sum(one.count for kept in reader.rooms for one in kept.things) < MOST_THINGS // 4
        ):
            _furnish(room, layout["style"], reader.moods, about)
        least = (1.6, 1.6, 2.3)  # a door must fit
        size = [round(max(a * b, c), 2) for a, b, c in zip(about.pop("size"), room.scale, least)]
        if any(one.label in ("stairs", "platform") for one in room.things):
            size[2] = max(size[2], 3.2)
        names.append(room.kind if room.kind not in names else f"{room.kind} {len(names) + 1}")
        layout["rooms"].append(
            {"name": names[-1], "at": [round(x, 2), round(-size[1] / 2, 2), 0.0], "size": size, **about}
        )
        x += size[0] + 0.12
    left_out: list[str] = []
    for at, room in enumerate(reader.rooms):
        left_out += furnish_room(layout, at, room.things, seed)
    unknown = tuple(dict.fromkeys(reader.unknown))
    return ParsedText(read_layout(layout), layout, unknown, tuple(left_out), name)


def furniture_in(text: str) -> tuple[list[FurnitureRequest], tuple[str, ...], str]:
    """The furniture that a text names ("two red chairs here"), the words without effect, and the style, "" for none."""
    reader = _Reader(_FILLERS.sub(" ", text.lower()))
    things = [one for room in reader.rooms for one in room.things]
    unknown = reader.unknown + [room.kind for room in reader.rooms if not reader.implied]
    unknown += [one.label for one in things if one.label in _SIDELESS]
    unknown += [word for word in reader.words if SIDES.get(word) in {one.side for one in things}]
    return [one for one in things if one.label not in _SIDELESS], tuple(dict.fromkeys(unknown)), reader.style


@dataclass(frozen=True)
class Decoration:
    """What words give to rooms that are there already."""

    atmosphere: dict[str, str]  # style and time
    looks: tuple[dict[str, Any], ...]  # of each room: height in metres, floor, walls, ceiling, lamps
    furniture: tuple[list[FurnitureRequest], ...]  # the usual of each room
    unknown: tuple[str, ...]  # words without effect


def decorate(text: str, kinds: Sequence[str]) -> Decoration:
    """What a text ("scandinavian, at sunset, brick walls") gives to rooms of these kinds (ROOMS); "room" is all of them."""
    reader = _Reader(text)
    atmosphere, looks, furniture = _atmosphere(reader, kinds), [], []
    for kind in kinds:
        same = [room for room in reader.rooms if room.kind in (kind, "room")]
        room = _RoomText(kind, looks=dict(same[-1].looks) if same else {}, without=same[-1].without if same else set())
        about = {**ROOMS[kind], **_looks(room, atmosphere["style"])}
        about["height"] = about.pop("size")[2]
        _furnish(room, atmosphere["style"], reader.moods, about)
        looks.append(about)
        furniture.append([one for one in room.things if one.label not in _SIDELESS])
    idle = [room.kind for room in reader.rooms if room.kind not in (*kinds, "room")]
    idle += [one.label for room in reader.rooms for one in room.things]
    return Decoration(atmosphere, tuple(looks), tuple(furniture), tuple(dict.fromkeys([*reader.unknown, *idle])))


def _atmosphere(reader: "_Reader", kinds: Sequence[str]) -> dict[str, str]:
    """The style and the time of a text about rooms of some kinds."""
    style = reader.style or next((ALWAYS[kind] for kind in kinds if kind in ALWAYS), "plain")
    return {"style": style, "time": reader.time or ("night" if set(kinds) == {"dungeon"} else "day")}


def _looks(room: _RoomText, style: str) -> dict[str, str]:
    """The looks of a room's surfaces: those of the style, unless the text says others; a mere shade changes the style's."""
    outdoors = ROOMS[room.kind].get("ceiling") == "sky"
    own = {} if outdoors else {name: getattr(STYLES[style], name) for name in _SURFACES if getattr(STYLES[style], name)}
    if room.kind in ("bathroom", "cellar", "garage") and style != "medieval":
        own.pop("floor", None)
    for name, look in room.looks.items():
        usual = (
            own.get(name)
            or ROOMS[room.kind].get(name)
            or {"floor": "planks", "walls": "plaster", "ceiling": "white plaster"}[name]
        )
        shades = all(word in looks.SHADES for word in look.split())
        own[name] = f"{usual} {look}" if shades else look
    return own


def _furnished(room: _RoomText, reader: "_Reader") -> bool:
    """Whether a room gets more things than the text names: where it gives a style, a mood or a time, and in kinds with a style."""
    if reader.moods & EMPTY:
        return False
    return bool(reader.style or reader.moods or reader.time or room.kind in ALWAYS)


def _furnish(room: _RoomText, style: str, moods: set[str], about: dict[str, Any]) -> None:
    """Adds the usual things of a room that the text does not name."""
    for label, count in furnishing(room.kind, style, moods).items():
        if label not in room.without and not any(one.label == label for one in room.things):
            room.things.append(FurnitureRequest(label, count, "", (1.0, 1.0, 1.0)))
    if STYLES[style].lamp and any(one.label == STYLES[style].lamp for one in room.things):
        about["lamps"] = 0


class _Reader:
    """Reads a text word by word: `rooms` with their things, and the words without effect, `unknown`."""

    def __init__(self, text: str):
        self.rooms: list[_RoomText] = []
        self.unknown: list[str] = []
        self.here: list[_RoomText] = []  # the rooms that get what follows
        self.last: FurnitureRequest | None = None
        self.side = ""  # given before its thing: "in the corner a lamp"
        self.implied = False  # whether no word named the first room yet
        self.none = self.definite = self.placed = self.strange = False
        self.relation = ""  # the last preposition
        self.noun, self.made_of = "", False  # the noun just read, and whether "of" followed it: "walls of red brick"
        self._forget()
        self.style = self.time = ""
        self.moods: set[str] = set()
        joined = re.sub(
            r"\b(tea|living|sitting) ?(room)", lambda at: at[1].replace("sitting", "living") + at[2], text.lower()
        )
        joined = re.sub(r"\b(coffee|low) (table)", "lowtable", joined)
        self.words: list[str] = re.findall(r"[a-z0-9#]+|[,;.:]", joined)[:400]
        for at, word in enumerate(self.words):
            self.at = at
            self._read(word)
            self.definite = word == "the" or (self.definite and word not in _QUIET and _noun(word) not in _NOUNS)
        self._drop()

    def _forget(self) -> None:
        """Begins a new phrase."""
        self.count: int | None = None
        self.scale, self.look = (1.0, 1.0, 1.0), []
        self.waiting: list[str] = []  # sizes, looks and numbers before their noun
        self.strange = False  # whether an unknown word came after them

    def _drop(self) -> None:
        """Reports the words that wait for a noun, because none came."""
        self.unknown += self.waiting
        if self.side:
            self.unknown.append(self.side)
        self.side = ""
        self._forget()

    def _read(self, word: str) -> None:
        noun, following = _noun(word), self._word(1)
        self.made_of = bool(self.noun) and (word == "of" or self.made_of and word in looks.WORDS)
        self.noun = self.noun if self.made_of or word == "made" else ""
        if word in _BREAKS or (self.strange and word in ("and", ",", ";", ".", "a", "an")):
            self._drop()
        if word in _NONE:
            self.none = True
        elif word in ("a", "an"):  # no number: "a row of pillars"
            self._drop() if self.waiting else None
        elif word in SIDES and self._is_side(word):
            self._set_side(word)
        elif word in NUMBERS or word in GROUPS or word.isdigit():
            self._number(word)
        elif word in STYLE_WORDS or word in MOODS or word in EMPTY:
            self.style = STYLE_WORDS.get(word, self.style)
            self.moods |= {word} if word not in STYLE_WORDS else set()
        elif word in TIMES or word in SAME_TIME:
            self.time = SAME_TIME.get(word, word)
            self.placed, self.relation = False, ""
        elif noun in ROOMS:
            self._room(noun, word)
        elif noun in _SURFACES:
            self._surface(noun)
        elif noun in _THINGS and not (noun == "rug" and _noun(following) in _SURFACES):
            self._thing(noun, word)
        elif word in SIZES or (word == "very" and following in SIZES):
            more = SIZES[following if word == "very" else word]
            self.scale = (self.scale[0] * more[0], self.scale[1] * more[1], self.scale[2] * more[2])
            self.waiting.append(word)
        elif self.made_of and word != "of":
            self._made_of(word)
        elif word in looks.WORDS or re.fullmatch("#[0-9a-f]{6}", word):
            self.look.append(word)
            self.waiting.append(word)
        elif word in _RELATIONS:
            self.relation, self.placed = word, self.placed or word in _PLACES
        elif (
            word not in _QUIET
            and not (word in ("living", "dining", "sitting") and following in ROOMS)
            and word.isalnum()
        ):
            self.unknown.append(word)
            self.strange = bool(self.waiting)

    def _made_of(self, look: str) -> None:
        """Adds a look to the surface or the thing just read."""
        if self.noun in _SURFACES:
            for room in self.here:
                room.looks[self.noun] = f"{room.looks.get(self.noun, '')} {look}".strip()
        elif self.last is not None:
            self.last.look = f"{self.last.look} {look}".strip()

    def _word(self, ahead: int) -> str:
        return self.words[self.at + ahead] if 0 <= self.at + ahead < len(self.words) else ""

    def _is_side(self, word: str) -> bool:
        """Whether it says where a thing is, and is no preposition: not "near the door", nor "in front of the door"."""
        return not (word == "near" and not self.placed or word == "front" and self._word(1) == "of")

    def _set_side(self, word: str) -> None:
        side = SIDES[word]
        if not self.placed:
            self.unknown.append(word)
        elif self.last is None:
            self.side = word
        elif side in _SIDELESS.get(self.last.label, ()):
            self.unknown.append(word)
        else:
            self.last.side = side
        self.placed, self.relation = False, ""

    def _number(self, word: str) -> None:
        if word in GROUPS:
            self.count = (self.count or 1) * GROUPS[word]
        else:
            self._drop() if self.waiting else None
            self.count = min(NUMBERS[word] if word in NUMBERS else int(word[:9]), MOST_COUNT)
            self.none = self.none and word in ("single", "some")
        self.waiting.append(word)

    def _taken(self, noun: str, word: str) -> int:
        """How many of a noun there are to be; its phrase ends here."""
        plural = word not in (noun, "stair", "staircase") and word.endswith("s")
        count = self.count if self.count is not None else PLURALS.get(noun, 3) if plural else 1
        count = 0 if self.none else count
        self.none = self.none and self._word(1) in ("or", "nor")
        self.placed, self.relation = False, ""
        self._forget()
        self.noun = noun if noun not in ROOMS else ""
        return count

    def _room(self, noun: str, word: str) -> None:
        same = [room for room in self.rooms if room.kind == noun]
        if self.rooms and (self.definite or self.placed) and (same or noun == "room") and not self.waiting:
            self.here = same[-1:] or self.here  # "in the middle of the room" is no new one
            self._taken(noun, "")
            return
        scale, look, implied = self.scale, " ".join(self.look), self.relation == "in" and self.implied
        count = self._taken(noun, word)
        if count == 1 and implied:  # "two pillars in a hall"
            self.rooms[0].kind, self.rooms[0].scale, self.implied = noun, scale, False
            self.rooms[0].looks = {**({"walls": look} if look else {}), **self.rooms[0].looks}
            return
        if count > MOST_ROOMS - len(self.rooms):
            self.unknown.append(f"{count} {noun}s")
            count = MOST_ROOMS - len(self.rooms)
        if count:
            self.here = [_RoomText(noun, scale, {"walls": look} if look else {}) for _ in range(count)]
            self.rooms += self.here
            self.last, self.implied = None, False

    def _surface(self, noun: str) -> None:
        if self.placed and not self.look and not self.none:  # "at the far wall"
            self.unknown += self.waiting
            self._forget()
            return
        self._begin()
        (x, y, z), look = self.scale, " ".join(self.look)
        used = {"floor": (x, y, 1.0), "ceiling": (1.0, 1.0, z), "walls": (x, y, z)}[noun]
        if self.none:
            look = "sky" if noun == "ceiling" else look
            self.unknown += [] if noun == "ceiling" else [f"no {noun}"]
        self.unknown += [one for one in self.waiting if one in SIZES and used == (1.0, 1.0, 1.0)]
        self.unknown += [one for one in self.waiting if (one in NUMBERS or one.isdigit()) and self.count != 4]
        for room in self.here:
            room.scale = (room.scale[0] * used[0], room.scale[1] * used[1], room.scale[2] * used[2])
            room.looks |= {noun: look} if look else {}
        self._taken(noun, "")

    def _thing(self, noun: str, word: str) -> None:
        self._begin()
        related = self.relation if self.definite or self.last is not None and self.relation not in ("", "to") else ""
        self.unknown += [related] if related else []
        if self.definite and related and not self.waiting and any(one.label == noun for one in self.here[-1].things):
            self._taken(noun, "")  # "a lamp beside the table" is no second table
            return
        flat = self.scale[:2] == (1.0, 1.0)
        if noun == "stairs" or (noun in ("pillar", "rug") and flat):  # pillars reach the ceiling
            self.unknown += [one for one in self.waiting if one in SIZES]
        scale, look = self.scale, " ".join(self.look)
        count = self._taken(noun, word)
        side, self.side = SIDES.get(self.side, ""), ""
        for room in self.here:
            self.last = FurnitureRequest(noun, count, look, scale, side)
            if count:
                room.things.append(self.last)
            else:
                room.things = [one for one in room.things if one.label != noun]
                room.without.add(noun)

    def _begin(self) -> None:
        """A room, if the text names none before its things."""
        if not self.rooms:
            self.implied, self.here = True, [_RoomText("room")]
            self.rooms += self.here


def _noun(word: str) -> str:
    """The word in the singular, by its usual name."""
    for one in (word, word.removesuffix("s"), word.removesuffix("es"), word.removesuffix("ies") + "y"):
        one = _SAME.get(one, one)
        if one in _NOUNS:
            return one
    return word
