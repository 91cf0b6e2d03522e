"""Places things in a room that was described in words: at walls, in corners, around tables; at random where words leave it open."""

import math
import random
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from .furniture import kind_of
from .room_layout import MOST_THINGS

_SIDES = ("north", "south", "east", "west")
_FRONT = {"north": "south", "south": "north", "east": "west", "west": "east"}  # who stands at a wall looks away from it
MOST_EACH = 24
SLOT_M = 1.2  # of a wall, for each door or window
CLEAR_M = 0.9  # before doors
APART_M = 0.7  # between things, so that bodies pass
_STAIRS_M, _LANDING_M = (
    (2.2, 1.1, 1.08),
    1.6,
)  # stairs that rise to the east along a wall; the length of the platform after them
Rect = tuple[float, float, float, float]


@dataclass
class FurnitureRequest:
    """A thing in a text: its kind, how many, its look, its size relative to the usual, and where."""

    label: str
    count: int
    look: str
    scale: tuple[float, float, float]
    side: str = ""


def furnish_room(layout: dict[str, Any], number: int, requests: Sequence[FurnitureRequest], seed: int) -> list[str]:
    """Adds the requested things to room `number` of a layout, and a door to the next room. Returns those without a place, such as
    "2 chair"."""
    room, following = _Room(layout, number, random.Random(1000 * seed + number)), number + 1 < len(layout["rooms"])
    room.keep_clear(number > 0)
    lost = Counter({one.label: 0 for one in requests})
    for one in requests:
        lost[one.label] += max(one.count - MOST_EACH, 0)
    for label, count in room.fill(
        [replace(one, count=min(one.count, MOST_EACH)) for one in requests], number > 0, following
    ):
        lost[label] += count
    return [f"{count} {label}" for label, count in lost.items() if count]


def furnish_drawn(
    layout: dict[str, Any], number: int, requests: Sequence[FurnitureRequest], entries: Sequence[tuple[str, float]]
) -> None:
    """Adds the requested things, as far as there is place, to room `number` of a layout whose doors and windows are there. entries:
    where one comes in, the wall and the metres along it."""
    room = _Room(layout, number, random.Random(1000 * layout["seed"] + number))
    room.clear += [room._before(side, at - 0.6, at + 0.6, CLEAR_M + 0.1) for side, at in entries]
    room.fill(requests, False, False)


def across_and_up(scale: tuple[float, float, float]) -> tuple[float, float]:
    """How much wider and higher an opening is: big ones both, wide ones wider, tall ones higher."""
    return scale[0] * scale[1], scale[2] * (scale[0] if scale[0] == scale[1] else 1.0)


class _Room:
    def __init__(self, layout: dict[str, Any], number: int, rng: random.Random):
        self.layout, self.room, self.rng = layout, layout["rooms"][number], rng
        room = self.room
        self.joined = [room["size"], *(one["size"] for one in layout["rooms"][number + 1 : number + 2])]
        (self.x0, self.y0, _), (w, d, self.height) = room["at"], room["size"]
        self.x1, self.y1 = self.x0 + w, self.y0 + d
        self.taken: list[Rect] = []  # where things stand
        self.clear: list[Rect] = []  # where nothing may
        self.hung: list[Rect] = []  # what hangs on walls
        self.tables: list[tuple[Rect, list[tuple[float, float, str]]]] = []

    def keep_clear(self, entered: bool) -> None:
        """Keeps free where one comes in from the west, or where one begins."""
        middle, deep, half = (self.y0 + self.y1) / 2, *((CLEAR_M + 0.2, 0.6) if entered else (1.4, 0.5))
        self.clear.append((self.x0, middle - half, self.x0 + deep, middle + half))

    def fill(self, requests: Sequence[FurnitureRequest], entered: bool, following: bool) -> list[tuple[str, int]]:
        """Openings first, then the largest things. Returns how many of which have no place."""
        lost = self._openings([one for one in requests if one.label in ("door", "window")], entered, following)
        order = {"stairs": 0, "pillar": 1, "middle": 2, "wall": 3, "corner": 4, "hung": 5, "any": 6, "ceiling": 7}
        rest = [one for one in requests if one.label not in ("door", "window")]
        rest.sort(
            key=lambda one: order.get(one.label, order[kind_of(one.label).stands if one.label != "stairs" else "wall"])
        )
        for one in rest:
            space = MOST_THINGS - len(self.layout["things"]) - len(self.layout["stairs"])
            done = self._place(
                replace(one, count=min(one.count, max(space // 2 if one.label == "stairs" else space, 0)))
            )
            if done < one.count:
                lost.append((one.label, one.count - done))
        return lost

    def _openings(self, requests: Sequence[FurnitureRequest], entered: bool, following: bool) -> list[tuple[str, int]]:
        """Adds doors and windows, spread evenly over each wall; returns those for which it is too short."""
        on: dict[str, list[FurnitureRequest]] = {side: [] for side in _SIDES}
        joined = [side for side, present in (("east", following), ("west", entered)) if present]
        free = [side for side in ("east", "north", "south", "west") if side not in joined]
        first = following
        if following:
            self._door("east", None, next((one for one in requests if one.label == "door"), None))
        for one in requests:
            count = one.count - (first and one.label == "door")
            first = first and one.label != "door"
            fits = max(int(self._length("south") / (1.5 * across_and_up(one.scale)[0] + 0.6)), 1)
            for k in range(count):
                if one.side in free:
                    side = one.side
                elif one.label == "door":
                    side = next((s for s in free if not any(other.label == "door" for other in on[s])), "north")
                else:
                    side = "south" if k < fits else "north"
                on[side].append(one)
        lost = []
        for side, several in on.items():
            fit = several[: max(int(self._length(side) / SLOT_M), 1)]
            lost += [(one.label, 1) for one in several[len(fit) :]]
            for k, one in enumerate(fit):
                at = round(self._length(side) * (k + 0.5) / len(fit), 3)
                if one.label == "door":
                    self._door(side, at, one, len(fit))
                else:
                    self._window(side, at, one, len(fit))
        return lost

    def _length(self, side: str) -> float:
        return self.y1 - self.y0 if side in ("east", "west") else self.x1 - self.x0

    def _door(self, side: str, at: float | None, request: FurnitureRequest | None, several: int = 1) -> None:
        sizes = self.joined if at is None else self.joined[:1]  # a door to the next room fits both
        across, up = across_and_up(request.scale) if request else (1.0, 1.0)
        most = min(one[1] for one in sizes) if at is None else self._length(side) / several
        width = round(max(min(0.95 * across, most - 0.2), 0.7), 2)
        height = round(min(2.1 * up, min(one[2] for one in sizes) - 0.05), 2)
        one = {
            "room": self.room["name"],
            "wall": side,
            "width": width,
            "height": max(height, 1.9),
            **({"look": request.look} if request and request.look else {}),
            **({"at": at} if at else {}),
        }
        self.layout["doors"].append(one)
        middle = self._length(side) / 2 if at is None else at
        half = max(0.6, width / 2 + 0.1)
        self.clear.append(self._before(side, middle - half, middle + half, CLEAR_M + 0.1))

    def _window(self, side: str, at: float, one: FurnitureRequest, several: int) -> None:
        across, up = across_and_up(one.scale)
        width = round(min(1.5 * across, self._length(side) / several - 0.3), 2)
        height = round(min(1.3 * up, self.height - 0.6), 2)
        sill = round(min(0.9, max(self.height - height - 0.3, 0.2)), 2)
        look = {"look": one.look} if one.look else {}
        wall = {"room": self.room["name"], "wall": side, "at": at}
        self.layout["windows"].append({**wall, "width": width, "height": height, "sill": sill, **look})

    def _before(self, side: str, low: float, high: float, deep: float) -> Rect:
        """The floor in front of a part of a wall."""
        if side in ("east", "west"):
            a = (self.x1 - deep, self.x1) if side == "east" else (self.x0, self.x0 + deep)
            return (a[0], self.y0 + low, a[1], self.y0 + high)
        b = (self.y1 - deep, self.y1) if side == "north" else (self.y0, self.y0 + deep)
        return (self.x0 + low, b[0], self.x0 + high, b[1])

    def _place(self, one: FurnitureRequest) -> int:
        """How many of them could be placed."""
        if one.label == "stairs":
            return sum(self._stairs(one) for _ in range(one.count))
        kind, done = kind_of(one.label), 0
        scale = one.scale
        if (
            kind.stands in ("wall", "hung") and scale[0] != scale[1]
        ):  # seen from the front: wide ones are wider, not deeper
            scale = (scale[0] * scale[1], 1.0, scale[2])
        size = tuple(round(a * b, 3) for a, b in zip(kind.size, scale))
        height = min(size[2], self.height - (1.35 if kind.stands == "hung" else 0))
        size = (size[0], size[1], round(height, 3))
        if kind.stands == "ceiling":
            return self._hang(one, kind, size)
        spots = (
            self._row(one.count, size) if one.label in ("pillar", "rug", "table", "lowtable") and not one.side else []
        )
        for k in range(one.count):
            ways = [*spots[k : k + 1], *self._spots(one, kind.stands, size)]
            for margin in (APART_M, 0.25, 0.02):
                spot = next(
                    (
                        spot
                        for spot in ways
                        if self._free(self._rect(spot, size), margin, kind.soft, one.label)
                        and self._unhung(spot, size, kind)
                    ),
                    None,
                )
                if spot:
                    break
            if not spot:
                break
            self._put(one, kind, size, spot)
            done += 1
        return done

    def _hang(self, one: FurnitureRequest, kind, size) -> int:
        """Hangs lamps from the ceiling: over tables first, then in a row along the room."""
        over = [((rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2) for rect, _ in self.tables]
        spots = over[: one.count] if one.count <= len(over) else [(x, y) for x, y, _ in self._row(one.count, (1, 1, 1))]
        if len(over) == 1 and one.count == 2 and one.label == "pendant":
            (x0, y0, x1, y1), long = self.tables[0][0], 0
            long = int(y1 - y0 > x1 - x0)
            spots = [
                (over[0][0] + (0.4 * way if not long else 0), over[0][1] + (0.4 * way if long else 0))
                for way in (-1, 1)
            ]
        low = max(self.height - size[2], 1.5 if over else 1.75)
        hung = [
            (x, y, "south")
            for x, y in spots
            if low < self.height - 0.2 and self._inside(self._rect((x, y, "south"), size))
        ]
        for spot in hung:
            self._put(one, kind, (size[0], size[1], round(self.height - low, 3)), spot, round(low, 3))
        return len(hung)

    def _put(self, one: FurnitureRequest, kind, size, spot: tuple[float, float, str], z: float = 0.0) -> None:
        x, y, facing = spot
        z = kind.hangs_m if kind.stands == "hung" else z
        look = {"look": one.look} if one.look else {}
        entry = {"label": one.label, "at": [round(x, 3), round(y, 3), z], "size": list(size), "facing": facing, **look}
        self.layout["things"].append(entry)
        rect = self._rect(spot, size)
        if kind.stands == "hung":
            self.hung.append(rect)
        if not kind.soft:
            self.taken.append(rect)
        if one.label in ("table", "desk", "lowtable"):
            self.tables.append((rect, self._seats(rect, one.label, facing)))

    def _rect(self, spot: tuple[float, float, str], size) -> Rect:
        x, y, facing = spot
        w, d = (size[1], size[0]) if facing in ("east", "west") else size[:2]
        return (x - w / 2, y - d / 2, x + w / 2, y + d / 2)

    def _unhung(self, spot: tuple[float, float, str], size, kind) -> bool:
        """Whether nothing hangs there yet."""
        return kind.stands != "hung" or not any(_meet(self._rect(spot, size), other, 0.1) for other in self.hung)

    def _inside(self, rect: Rect) -> bool:
        low, high = (self.x0 - 1e-6, self.y0 - 1e-6), (self.x1 + 1e-6, self.y1 + 1e-6)
        return rect[0] >= low[0] and rect[1] >= low[1] and rect[2] <= high[0] and rect[3] <= high[1]

    def _free(self, rect: Rect, margin: float, soft: bool, label: str) -> bool:
        inside = self._inside(rect)
        if soft or not inside:
            return inside
        margin = 0.02 if label in ("chair", "pillar", "cushion") else margin
        under = (
            [one for one, _ in self.tables] if label in ("chair", "cushion") else []
        )  # chairs stand half under tables
        return not any(_meet(rect, other, margin) for other in self.taken if other not in under) and not any(
            _meet(rect, other, 0.0) for other in self.clear
        )

    def _row(self, count: int, size) -> list[tuple[float, float, str]]:
        """Adds things in the middle, one after the other along the room; pillars in pairs."""
        pairs = size[2] > 2 and count % 2 == 0
        many = count // 2 if pairs else count
        places = []
        for k in range(many):
            x = self.x0 + (self.x1 - self.x0) * (k + 1) / (many + 1)
            for share in (0.27, 0.73) if pairs else (0.5,):
                places.append((x, self.y0 + (self.y1 - self.y0) * share, "south"))
        return places

    def _spots(self, one: FurnitureRequest, stands: str, size) -> Iterator[tuple[float, float, str]]:
        """Candidate positions of a thing, the best first."""
        if one.label in ("chair", "cushion"):
            for _, seats in self.tables:
                yield from list(seats)
        if one.side == "middle":
            yield ((self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2, "south")
        if one.side == "corner" or stands == "corner" and not one.side:
            corners = [(x, y) for x in (self.x0 + size[0] / 2 + 0.05, self.x1 - size[0] / 2 - 0.05)
                       for y in (self.y0 + size[1] / 2 + 0.05, self.y1 - size[1] / 2 - 0.05)]  # fmt: skip
            for x, y in self.rng.sample(corners, 4):
                yield (x, y, "south" if y > (self.y0 + self.y1) / 2 else "north")
        if stands in ("wall", "hung", "corner") or one.side in _SIDES:
            sides = [one.side] if one.side in _SIDES else self.rng.sample(_SIDES, 4)
            for side in sides:
                yield from self._along(side, size, stands == "hung")
        if stands in ("middle", "any"):
            for _ in range(60):
                x, y = self.rng.uniform(self.x0, self.x1), self.rng.uniform(self.y0, self.y1)
                yield (x, y, self.rng.choice(_SIDES))

    def _along(self, side: str, size, hung: bool) -> Iterator[tuple[float, float, str]]:
        """Positions at a wall, from its middle outwards, not in front of windows that they would hide."""
        length, deep = self._length(side), size[1] / 2
        blocked = [
            (one["at"] - one["width"] / 2, one["at"] + one["width"] / 2)
            for one in self.layout["windows"]
            if one["room"] == self.room["name"] and one["wall"] == side and (hung or size[2] > 0.9)
        ]
        steps = max(int((length - size[0]) / 0.15), 0)
        for k in sorted(range(steps + 1), key=lambda k: abs(k - steps / 2)):
            at = size[0] / 2 + (length - size[0]) * (k / steps if steps else 0.5)
            if any(a < at + size[0] / 2 and at - size[0] / 2 < b for a, b in blocked):
                continue
            rect = self._before(side, at, at, deep)
            x = rect[2] if side == "west" else rect[0]
            y = rect[3] if side == "south" else rect[1]
            yield (x, y, _FRONT[side])

    def _seats(self, rect: Rect, label: str, facing: str) -> list[tuple[float, float, str]]:
        """Positions of chairs around a table: along its longer sides, then at its ends; at a desk only in front."""
        x0, y0, x1, y1 = rect
        x, y, off = (x0 + x1) / 2, (y0 + y1) / 2, 0.12
        if label == "desk":
            return [{"south": (x, y0 - off, "north"), "north": (x, y1 + off, "south"), "east": (x1 + off, y, "west"),
                     "west": (x0 - off, y, "east")}[facing]]  # fmt: skip
        spread = (x1 - x0) / 4 if x1 - x0 >= 1.1 else 0.0
        rows = [(x + s, y0 - off, "north") for s in {-spread, spread}] + [
            (x + s, y1 + off, "south") for s in {-spread, spread}
        ]
        rows.sort(key=lambda one: (one[0], one[1]))
        return [rows[k] for k in ((0, 3, 1, 2) if len(rows) == 4 else (0, 1))] + [
            (x0 - off, y, "east"),
            (x1 + off, y, "west"),
        ]

    def _stairs(self, one: FurnitureRequest) -> bool:
        """Adds stairs along a wall that rise to the east, up to a platform."""
        (long, wide, high), landing = _STAIRS_M, _LANDING_M
        sides = [one.side] if one.side in ("north", "south") else ["north", "south"]
        for side in sides:
            for steps in range(20):
                x = self.x1 - long - landing - steps * (self.x1 - self.x0 - long - landing) / 20
                y = self.y1 - wide if side == "north" else self.y0
                rect = (x, y, x + long + landing, y + wide)
                if x >= self.x0 and self.height > high + 1.4 and self._free(rect, 0.1, False, "stairs"):
                    look = {"look": one.look} if one.look else {}
                    at = [round(x, 3), round(y, 3), 0.0]
                    self.layout["stairs"].append({"at": at, "size": [long, wide, high], "up": "east", **look})
                    top = [round(x + long + landing / 2, 3), round(y + wide / 2, 3), 0.0]
                    self.layout["things"].append(
                        {"label": "platform", "at": top, "size": [landing, wide, high], **look}
                    )
                    self.taken.append(rect)
                    return True
        return False


def _meet(one: Rect, other: Rect, margin: float) -> bool:
    return (
        one[0] < other[2] + margin
        and other[0] < one[2] + margin
        and one[1] < other[3] + margin
        and other[1] < one[3] + margin
    ) and not math.isclose(one[0], one[2])
