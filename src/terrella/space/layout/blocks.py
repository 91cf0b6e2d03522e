"""A layout as axis-aligned boxes with looks: walls, frames, steps, table legs, and the air between them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...core.errors import ContractError
from .furniture import kind_of
from .looks import Look, look_of
from .room_layout import REACH_M, WALL_M, WALLS, Door, Room, RoomLayout, Stairs, Thing, Window, room_at
from .shapes import SHAPES, SHARP, Shape
from .styles import Style, style_of, styled

RISER_M = 0.18  # largest height of a step
FRAME_M = 0.05
_LEAF_M = 0.04
SKIRTING_M = (0.012, 0.09)  # its depth and height
INSIDE_M = 2e-3  # an object that overlaps another by more cannot be pushed
LEVEL_M = 0.35  # largest difference of the floors that a door joins
_TURNS = {"south": 0, "east": 1, "north": 2, "west": 3}  # quarter turns to the left

Corner = tuple[float, float, float]


@dataclass
class Blocks:
    """K boxes, the air between them, and the objects that they form."""

    low: list[Corner] = field(default_factory=list)
    high: list[Corner] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    objects: list[int] = field(default_factory=list)  # the object that each belongs to, 0 for the building
    solid: list[bool] = field(default_factory=list)  # whether each stops walkers
    shapes: list[Shape] = field(default_factory=list)
    air: list[tuple[Corner, Corner]] = field(default_factory=list)  # boxes of free space
    names: list[str] = field(default_factory=list)  # of objects 1, 2, ...
    movable: set[int] = field(default_factory=set)  # the objects that can be pushed

    def add(
        self,
        low: Sequence[float],
        high: Sequence[float],
        look: Look,
        thing: int = 0,
        solid: bool = True,
        shape: Shape = SHARP,
    ) -> None:
        self.low.append((low[0], low[1], low[2]))
        self.high.append((high[0], high[1], high[2]))
        self.looks.append(look)
        self.objects.append(thing)
        self.solid.append(solid)
        self.shapes.append(shape)

    def named(self, name: str) -> int:
        """The number of a new object."""
        self.names.append(name)
        return len(self.names)

    @property
    def solids(self) -> np.ndarray:
        """float32 [S, 6], the boxes that stop walkers: low and high corners."""
        return self.boxes[np.asarray(self.solid)].astype(np.float32)

    @property
    def boxes(self) -> np.ndarray:
        """float64 [K, 6]: low and high corners."""
        return np.concatenate([np.asarray(self.low), np.asarray(self.high)], 1).astype(np.float64)

    @property
    def bodies(self) -> np.ndarray:
        """int32 [K]: the movable object that each box belongs to; 0 for fixed boxes, and for objects that overlap others."""
        boxes, solid = self.boxes, np.asarray(self.solid)
        owner = np.array([one if one in self.movable else 0 for one in self.objects], np.int32)
        for number in sorted(self.movable):
            mine = owner == number
            other = boxes[~mine & solid]
            shared = np.minimum(boxes[mine, None, 3:], other[:, 3:]) - np.maximum(boxes[mine, None, :3], other[:, :3])
            if (shared > INSIDE_M).all(2).any():
                owner[mine] = 0
        return owner


def blocks_of(plan: RoomLayout) -> Blocks:
    """The blocks of a layout; ContractError for parts that do not fit."""
    blocks = Blocks()
    holes: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    for door in plan.doors:
        _door(blocks, plan, door, holes)
    for window in plan.windows:
        _window(blocks, plan, window, holes)
    for room in plan.rooms:
        _room(blocks, room, holes, any(one.room == room.name for one in plan.windows), style_of(plan.style))
    for stairs in plan.stairs:
        _stairs(blocks, plan, stairs)
    for thing in plan.things:
        _thing(blocks, plan, thing)
    return blocks


class _Wall:
    """A wall with its own coordinates: along it, outwards from the room, and height."""

    def __init__(self, room: Room, wall: str):
        self.axis, upper = WALLS[wall]
        self.face = room.high[self.axis] if upper else room.low[self.axis]
        self.out = 1 if upper else -1
        self.origin, self.length = room.low[1 - self.axis], room.size[1 - self.axis]

    def box(self, a: tuple[float, float], out: tuple[float, float], z: tuple[float, float]) -> tuple[Corner, Corner]:
        """a: world coordinates along the wall; out: metres outwards of its inner face; z: heights."""
        ends = sorted(self.face + self.out * one for one in out)
        low, high = [0.0, 0.0, z[0]], [0.0, 0.0, z[1]]
        low[self.axis], high[self.axis] = ends
        low[1 - self.axis], high[1 - self.axis] = a
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _room(blocks: Blocks, room: Room, holes: dict, bright: bool, style: Style) -> None:
    (x0, y0, z0), (x1, y1, z1) = room.low, room.high
    w = WALL_M
    blocks.air.append((room.low, room.high))
    blocks.add((x0 - w, y0 - w, z0 - w), (x1 + w, y1 + w, z0), look_of(room.floor))
    blocks.add((x0 - w, y0 - w, z1), (x1 + w, y1 + w, z1 + w), look_of(room.ceiling))
    for name in WALLS:
        wall = _Wall(room, name)
        rects = [(wall.origin - w, wall.origin + wall.length + w, z0, z1)]
        for hole in holes.get((room.name, name), []):
            rects = [part for rect in rects for part in _without(rect, hole)]
        for a0, a1, low, high in rects:
            blocks.add(*wall.box((a0, a1), (0, w), (low, high)), look_of(room.walls))
            if style.skirting and low == z0 and look_of(room.ceiling).material != "sky":
                ends = max(a0, wall.origin), min(a1, wall.origin + wall.length)
                foot = wall.box(ends, (-SKIRTING_M[0], 0), (z0, z0 + SKIRTING_M[1]))
                blocks.add(*foot, look_of(style.paint), solid=False)
    lamps = room.lamps
    if look_of(room.ceiling).material == "sky":
        lamps = lamps or 0
    if lamps is None:
        lamps = math.ceil(room.size[0] * room.size[1] / (40 if bright else 14))
    for x, y in _spread(room, lamps):
        blocks.add((x - 0.35, y - 0.35, z1 - 0.03), (x + 0.35, y + 0.35, z1), look_of("lamp"), solid=False)


def _spread(room: Room, count: int) -> list[tuple[float, float]]:
    """`count` points or a few more, in rows and columns over a room."""
    if not count:
        return []
    across = max(round(math.sqrt(count * room.size[0] / room.size[1])), 1)
    down = math.ceil(count / across)
    return [
        (room.low[0] + room.size[0] * (i + 0.5) / across, room.low[1] + room.size[1] * (j + 0.5) / down)
        for i in range(across)
        for j in range(down)
    ]


def _without(rect: tuple[float, ...], hole: tuple[float, ...]) -> list[tuple[float, float, float, float]]:
    """The parts of a rectangle around a hole (both: from, to, lower, upper)."""
    a0, a1, z0, z1 = rect
    h0, h1, l0, l1 = max(hole[0], a0), min(hole[1], a1), max(hole[2], z0), min(hole[3], z1)
    if h0 >= h1 or l0 >= l1:
        return [(a0, a1, z0, z1)]
    parts = [(a0, h0, z0, z1), (h1, a1, z0, z1), (h0, h1, z0, l0), (h0, h1, l1, z1)]
    return [part for part in parts if part[1] - part[0] > 1e-9 and part[3] - part[2] > 1e-9]


def _door(blocks: Blocks, plan: RoomLayout, door: Door, holes: dict) -> None:
    room = next(one for one in plan.rooms if one.name == door.room)
    style, wall, thing = style_of(plan.style), _Wall(room, door.wall), blocks.named("door")
    look = look_of(styled(door.look, style), "wood")
    middle = wall.origin + (wall.length / 2 if door.at is None else door.at)
    a0, a1, z0 = middle - door.width / 2, middle + door.width / 2, room.at[2]
    top, white = z0 + door.height, look_of(style.paint)
    beyond, gap = _beyond(plan, room, door, wall, (a0, a1))
    f = FRAME_M
    if beyond is None:
        blocks.add(*wall.box((a0, a1), (-_LEAF_M, 0), (z0, top)), look, thing)
        for panel in ((0.12, 0.46), (0.54, 0.93)):
            low, high = (z0 + share * door.height for share in panel)
            blocks.add(*wall.box((a0 + 0.14, a1 - 0.14), (-_LEAF_M - 0.012, -_LEAF_M), (low, high)), look, thing)
        knob = wall.box((a1 - 0.13, a1 - 0.07), (-_LEAF_M - 0.055, -_LEAF_M), (z0 + 1.0, z0 + 1.06))
        blocks.add(*knob, look_of("golden metal"), thing, False, SHAPES["ball"])
        for span in ((a0 - f, a0), (a1, a1 + f)):
            blocks.add(*wall.box(span, (-_LEAF_M - 0.02, 0), (z0, top)), white)
        blocks.add(*wall.box((a0 - f, a1 + f), (-_LEAF_M - 0.02, 0), (top, top + f)), white)
        return
    other = {"east": "west", "west": "east", "north": "south", "south": "north"}[door.wall]
    for key in ((room.name, door.wall), (beyond.name, other)):
        holes.setdefault(key, []).append((a0, a1, min(z0, beyond.at[2]), top))
    blocks.air.append(wall.box((a0, a1), (0, gap), (min(z0, beyond.at[2]), top)))
    high = max(z0, beyond.at[2])
    blocks.add(*wall.box((a0, a1), (0, gap), (high - 0.3, high)), look_of(room.floor))
    for span in ((a0, a0 + f), (a1 - f, a1)):
        blocks.add(*wall.box(span, (-0.015, gap + 0.015), (high, top)), white)
    blocks.add(*wall.box((a0 + f, a1 - f), (-0.015, gap + 0.015), (top - f, top)), white)
    leaf = (a0 + f, a0 + f + _LEAF_M), (-0.015 - (door.width - 2 * f), -0.015), (z0, top - f)
    blocks.add(*wall.box(*leaf), look, thing)
    for side in (-0.05, _LEAF_M):
        at = a0 + f + side, a0 + f + side + 0.05
        knob = wall.box(at, (-door.width + 2 * f + 0.03, -door.width + 2 * f + 0.09), (z0 + 1.0, z0 + 1.06))
        blocks.add(*knob, look_of("golden metal"), thing, False, SHAPES["ball"])


def _beyond(
    plan: RoomLayout, room: Room, door: Door, wall: _Wall, span: tuple[float, float]
) -> tuple[Room | None, float]:
    """The room that a door leads to, and its distance; None if there is none behind the wall."""
    for other in plan.rooms:
        near = other.low[wall.axis] if wall.out > 0 else other.high[wall.axis]
        gap, k = wall.out * (near - wall.face), 1 - wall.axis
        overlap = min(other.high[k], span[1]) - max(other.low[k], span[0])
        apart = abs(other.at[2] - room.at[2])
        if other is room or not 0 < gap <= REACH_M or overlap <= 0 or other.high[2] < room.at[2] + door.height:
            continue
        if overlap < span[1] - span[0] - 1e-6:
            raise ContractError(f"a door of '{room.name}' leads half into '{other.name}'; move it along its wall.")
        if apart > LEVEL_M:
            raise ContractError(
                f"a door of '{room.name}' leads to '{other.name}' whose floor is {apart:g} m off; {LEVEL_M} m is the most."
            )
        return other, gap
    return None, 0.0


def _window(blocks: Blocks, plan: RoomLayout, window: Window, holes: dict) -> None:
    room = next(one for one in plan.rooms if one.name == window.room)
    style, wall, thing = style_of(plan.style), _Wall(room, window.wall), blocks.named("window")
    look = look_of(styled(window.look, style))
    middle = wall.origin + (wall.length / 2 if window.at is None else window.at)
    a0, a1 = middle - window.width / 2, middle + window.width / 2
    z0 = room.at[2] + window.sill
    z1 = z0 + window.height
    holes.setdefault((room.name, window.wall), []).append((a0, a1, z0, z1))
    blocks.air.append(wall.box((a0, a1), (0, WALL_M), (z0, z1)))
    blocks.add(*wall.box((a0, a1), (WALL_M - 0.03, WALL_M), (z0, z1)), look_of("glass"), thing)
    shut = wall.box((a0, a1), (WALL_M, WALL_M + 0.02), (z0, z1))  # the wall without the window
    blocks.add(*shut, look_of(room.walls), solid=False)
    f, depth = FRAME_M, (-0.02, WALL_M - 0.03)
    for span in ((a0, a0 + f), (a1 - f, a1)):
        blocks.add(*wall.box(span, depth, (z0, z1)), look, thing)
    for low in (z0, z1 - f):
        blocks.add(*wall.box((a0 + f, a1 - f), depth, (low, low + f)), look, thing)
    bar = (WALL_M - 0.06, WALL_M - 0.03)
    across, up = (max(round(one), 1) for one in style.panes)
    for k in range(1, across):
        at = a0 + f + (a1 - a0 - 2 * f) * k / across
        blocks.add(*wall.box((at - 0.015, at + 0.015), bar, (z0 + f, z1 - f)), look, thing)
    for k in range(1, up):
        at = z0 + f + (z1 - z0 - 2 * f) * k / up
        blocks.add(*wall.box((a0 + f, a1 - f), bar, (at - 0.015, at + 0.015)), look, thing)
    if style.curtains:
        _curtains(blocks, wall, (a0, a1, max(z0 - 0.25, room.at[2] + 0.02), z1 + 0.1), style, thing)
    blocks.add(*wall.box((a0 - 0.06, a1 + 0.06), (-0.12, 0), (z0 - 0.04, z0)), look, thing)


def _curtains(blocks: Blocks, wall: _Wall, rect: tuple[float, ...], style: Style, thing: int) -> None:
    """A rod and two gathered curtains beside a window."""
    a0, a1, low, high = rect
    ends = max(a0 - 0.3, wall.origin + 0.02), min(a1 + 0.3, wall.origin + wall.length - 0.02)
    blocks.add(*wall.box(ends, (-0.125, -0.1), (high, high + 0.025)), look_of(style.metal), thing, False, SHAPES["box"])
    for first, last in ((ends[0] + 0.02, a0 + 0.1), (a1 - 0.1, ends[1] - 0.02)):
        folds = max(round((last - first) / 0.075), 1)
        for k in range(folds):
            span = first + (last - first) * (k - 0.12) / folds, first + (last - first) * (k + 1.12) / folds
            deep = (-0.15 - 0.015 * (k % 2), -0.075)
            blocks.add(*wall.box(span, deep, (low, high)), look_of(style.curtains), thing, False, SHAPES["tube"])


def _stairs(blocks: Blocks, plan: RoomLayout, stairs: Stairs) -> None:
    high = tuple(a + b for a, b in zip(stairs.at, stairs.size))
    _inside(plan, stairs.at, high, stairs.label)
    thing, (axis, upper) = blocks.named(stairs.label), WALLS[stairs.up]
    count = math.ceil(stairs.size[2] / RISER_M - 1e-9)
    if stairs.size[axis] < 0.2 * count:
        raise ContractError(
            f"the {stairs.label} at {list(stairs.at)} need {0.2 * count:.1f} m to rise by {stairs.size[2]:g} m; make them longer."
        )
    for step in range(count):
        low, top = list(stairs.at), list(high)
        tread = stairs.size[axis] / count
        low[axis] = stairs.at[axis] + tread * (step if upper else count - 1 - step)
        top[axis] = low[axis] + tread
        top[2] = stairs.at[2] + stairs.size[2] * (step + 1) / count
        blocks.add(low, top, look_of(stairs.look), thing)


def _thing(blocks: Blocks, plan: RoomLayout, thing: Thing) -> None:
    kind, number = kind_of(thing.label), blocks.named(thing.label)
    room = room_at(plan, (thing.at[0], thing.at[1], thing.at[2] + 1e-3))
    width, depth, height = thing.size or kind.size
    if thing.size is None and room is not None:
        height = min(height, room.high[2] - thing.at[2])
    turns = _TURNS[thing.facing]
    spans = (depth, width) if turns % 2 else (width, depth)
    low = (thing.at[0] - spans[0] / 2, thing.at[1] - spans[1] / 2, thing.at[2])
    high = (low[0] + spans[0], low[1] + spans[1], low[2] + height)
    _inside(plan, low, high, thing.label)
    if kind.movable if thing.movable is None else thing.movable:
        blocks.movable.add(number)
    style = style_of(plan.style)
    own = look_of(thing.look, look_of(kind.look).material) if thing.look else look_of(styled(kind.look, style))
    for part in kind.parts:
        corners = [((x - 0.5) * width, (y - 0.5) * depth) for x, y in ((part.x0, part.y0), (part.x1, part.y1))]
        for _ in range(turns):
            corners = [(-y, x) for x, y in corners]
        (ax, ay), (bx, by) = corners
        at = thing.at
        blocks.add(
            (at[0] + min(ax, bx), at[1] + min(ay, by), at[2] + part.z0 * height),
            (at[0] + max(ax, bx), at[1] + max(ay, by), at[2] + part.z1 * height),
            look_of(styled(part.look, style)) if part.look else own,
            number,
            part.solid and not kind.soft,
            SHAPES[part.shape],
        )


def _inside(plan: RoomLayout, low: Sequence[float], high: Sequence[float], label: str) -> None:
    room = room_at(plan, [(a + b) / 2 for a, b in zip(low, high)])
    if room is None:
        raise ContractError(f"the {label} at {[round(v, 2) for v in low]} lies in no room.")
    if any(a < b - 2e-3 for a, b in zip(low, room.low)) or any(a > b + 2e-3 for a, b in zip(high, room.high)):
        raise ContractError(f"the {label} at {[round(v, 2) for v in low]} reaches out of the room '{room.name}'.")
