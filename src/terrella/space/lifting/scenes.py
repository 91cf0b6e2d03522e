"""Random scenes for training pictures: rooms of `space build` with other looks, turned and rounded furniture and small things, and
cameras in them."""

from dataclasses import dataclass

import numpy as np

from ...core.errors import ContractError
from ..kernels_numba import shapes as kernels
from ..layout.blocks import Blocks, blocks_of
from ..layout.looks import Look, look_of
from ..layout.text_layout import ROOMS, parse_text
from .textures import MATERIAL_M, material_texture, random_texture

SIZES = ("", "", "", "small ", "large ", "long ", "wide ", "narrow ", "tall ", "low ", "tiny ", "huge ")
THINGS = ("table", "desk", "chairs", "stools", "bench", "sofa", "armchairs", "bed", "bookshelves", "wardrobe", "counter", "fridge",
          "crates", "boxes", "pillars", "lamp", "plants", "rug", "pictures", "platform", "windows", "door", "stairs")  # fmt: skip
NUMBERS = ("a", "a", "two", "three", "four", "some")


@dataclass(frozen=True)
class ShapeScene:
    """Solid shapes and their light, as kernels_numba/shapes.py has them, and where cameras may be."""

    shapes: np.ndarray
    bounds: np.ndarray
    lamps: np.ndarray
    sky: np.ndarray
    rooms: np.ndarray  # [R, 6], low and high corners of the air in each room
    tops: np.ndarray  # [T, 5], middles, heights and half sizes of what things stand on

    def is_free(self, place: np.ndarray, way: np.ndarray) -> bool:
        """Whether a camera at `place` [3] can move by `way` [3] and stays clear of what lies ahead."""
        (x, y, z), (dx, dy, dz) = place.tolist(), way.tolist()
        return not kernels.blocked(self.shapes, self.bounds, x, y, z, dx, dy, dz, 1.2, False)


@dataclass(frozen=True)
class Shot:
    """A camera: position and rotation in the world, focal length in widths of the picture, and height above the floor."""

    place: np.ndarray
    turn: np.ndarray  # [3, 3]
    pitch: float  # radians, up is positive
    roll: float
    focal: float
    height_m: float

    def camera(self, height: int, width: int) -> np.ndarray:
        """For the kernels: a picture of `height` x `width` pixels, `focal` in parts of its longer side."""
        long = self.focal * max(height, width)
        lens = [long, long, width / 2, height / 2]
        return np.concatenate([self.place, self.turn.ravel(), lens]).astype(np.float32)


def random_text(rng: np.random.Generator) -> str:
    """A sentence for `space build`."""
    rooms = []
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        kind = str(rng.choice(list(ROOMS)))
        many = int(rng.integers(2, 9))
        things = [f"{rng.choice(NUMBERS)} {rng.choice(SIZES)}{rng.choice(THINGS)}" for _ in range(many)]
        rooms.append(f"a {rng.choice(SIZES)}{kind} with {', '.join(things)}")
    return ", then ".join(rooms)


def random_scene(rng: np.random.Generator) -> ShapeScene:
    """A furnished place."""
    while True:
        try:
            blocks = blocks_of(parse_text(random_text(rng), int(rng.integers(1 << 30))).layout)
            break
        except ContractError:
            continue
    groups = _groups(blocks, rng)
    air = np.array([[*low, *high] for low, high in blocks.air])
    rooms = air[((air[:, 3:] - air[:, :3]) > [1.4, 1.4, 1.9]).all(1)]  # not the openings of doors and windows
    tops = _tops(groups)
    groups += _clutter(tops, rooms, rng) + _built_in(rooms, rng)
    shapes = np.concatenate(groups).astype(np.float32)
    ends = np.cumsum([0, *map(len, groups)])
    for number, (first, last) in enumerate(zip(ends, ends[1:])):
        shapes[first:last, 18] = number
    bounds = np.array([_bound(shapes, a, b) for a, b in zip(ends, ends[1:])], np.float32)
    return ShapeScene(shapes, bounds, *_lights(shapes, rooms, rng), rooms, tops)


def _groups(blocks: Blocks, rng: np.random.Generator) -> list[np.ndarray]:
    """The shapes [n, 20] of each part of the building and of each thing."""
    fresh, cache = rng.random() < 0.6, {}
    boxes, objects, groups = blocks.boxes, np.asarray(blocks.objects), []
    turned = rng.random() < 0.5

    def look(one: Look, thing: int) -> np.ndarray:
        key = (one, thing if rng.random() < 0.3 else 0)
        if key not in cache:
            cache[key] = _look(one, fresh and not one.glow and rng.random() < 0.8, rng)
        return cache[key]

    for k in np.flatnonzero(objects == 0):
        groups.append(_box(boxes[k], look(blocks.looks[k], 0))[None])
    for number in range(1, objects.max(initial=0) + 1):
        rows = np.flatnonzero(objects == number)
        name = blocks.names[number - 1]
        shapes = np.stack([_box(boxes[k], look(blocks.looks[k], number)) for k in rows])
        if name not in ("door", "window", "stairs", "picture"):
            _round(shapes, name, rng)
            if turned:
                middle = (shapes[:, 1:3].min(0) + shapes[:, 1:3].max(0)) / 2
                _turn(shapes, middle, rng.normal(0, 0.25) if rng.random() < 0.7 else rng.uniform(-3, 3))
        groups.append(shapes)
    return groups


def _look(look: Look, fresh: bool, rng: np.random.Generator) -> np.ndarray:
    """Columns 9 to 19 of a shape."""
    glow = {"glass": 1.2, "sky": 1.0, "lamp": 2.5}.get(look.material, 0.0)
    colour = np.asarray(look.colour) ** 2.2
    if fresh:
        texture = random_texture(rng) if rng.random() < 0.6 else material_texture(str(rng.choice(list(_PLAIN))), rng)
        tint = rng.uniform(0.25, 0.95) * (1 - rng.random() ** 2 * rng.random(3)) if rng.random() < 0.7 else colour
        scale = MATERIAL_M * float(np.exp(rng.normal(0, 0.5)))
    else:
        texture, scale = material_texture(look.material, rng), MATERIAL_M
        tint = np.clip(colour * np.exp(rng.normal(0, 0.12, 3)), 0.01, 1)
    clear = float(look.material in ("glass", "sky"))
    return np.array([*tint, texture, scale, *rng.uniform(0, 7, 2), glow * rng.uniform(0.5, 1.3), clear, 0, 0])


_PLAIN = (
    "plaster",
    "paint",
    "planks",
    "wood",
    "tiles",
    "brick",
    "stone",
    "concrete",
    "marble",
    "carpet",
    "cloth",
    "metal",
)


def _box(box: np.ndarray, look: np.ndarray) -> np.ndarray:
    middle, half = (box[:3] + box[3:]) / 2, np.maximum((box[3:] - box[:3]) / 2, 1e-3)
    return np.array([kernels.BOX, *middle, *half, 1, 0, *look])


def _round(shapes: np.ndarray, name: str, rng: np.random.Generator) -> None:
    """Makes some boxes of a thing cylinders and ellipsoids."""
    half, some = shapes[:, 4:7], rng.random()
    slim = np.maximum(half[:, 0], half[:, 1]) < 0.06
    shapes[slim & (half[:, 2] > 0.1) & (some < 0.5), 0] = kernels.CYLINDER
    if name in ("pillar", "stool", "lamp", "plant") and rng.random() < 0.6:
        shapes[~slim, 0] = kernels.CYLINDER
    if name in ("plant", "lamp") and rng.random() < 0.6:
        shapes[shapes[:, 3] > np.median(shapes[:, 3]), 0] = kernels.ELLIPSOID
    if name == "table" and rng.random() < 0.25:
        shapes[shapes[:, 3].argmax(), 0] = kernels.CYLINDER


def _turn(shapes: np.ndarray, middle: np.ndarray, angle: float) -> None:
    """Turns upright shapes about an axis, in place."""
    c, s = np.cos(angle), np.sin(angle)
    off = shapes[:, 1:3] - middle
    shapes[:, 1:3] = middle + off @ np.array([[c, s], [-s, c]])
    shapes[:, 7:9] = shapes[:, 7:9] @ np.array([[c, s], [-s, c]])


def _tops(groups: list[np.ndarray]) -> np.ndarray:
    """Level surfaces of things: middle x, y, height, half sizes."""
    rows = [
        [one[1], one[2], one[3] + one[6], *(one[4:6] * 0.8)]
        for group in groups
        for one in group
        if 0.3 < one[3] + one[6] < 1.4 and min(one[4], one[5]) > 0.12 and one[7] > 0.98
    ]
    return np.array(rows).reshape(-1, 5)


def _clutter(tops: np.ndarray, rooms: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Small things on surfaces and on the floor."""
    groups = []
    busy = tops[rng.integers(len(tops))] if len(tops) else None
    for number in range(int(rng.integers(0, 40))):
        big = float(np.exp(rng.normal(-2.4, 0.5)))
        if busy is not None and rng.random() < 0.75:
            top = busy if number % 2 else tops[rng.integers(len(tops))]
            spot = np.array([*(top[:2] + top[3:] * rng.uniform(-1, 1, 2)), top[2]])
        else:
            room, big = rooms[rng.integers(len(rooms))], 2.2 * big
            spot = np.array([*rng.uniform(room[:2] + 0.2, room[3:5] - 0.2), room[2]])
        kind = int(rng.choice([0, 0, 1, 2]))
        half = big * np.exp(rng.normal(0, 0.4, 3)) * 0.7
        angle, base = rng.uniform(-3, 3), _look(look_of(str(rng.choice(_PLAIN))), True, rng)
        base[3 + 1] *= 0.4
        parts = [np.array([kind, spot[0], spot[1], spot[2] + half[2], *half, np.cos(angle), np.sin(angle), *base])]
        if rng.random() < 0.3:  # a thing on a thing
            more = half * rng.uniform(0.3, 0.9, 3)
            high = spot[2] + 2 * half[2] + more[2]
            parts.append(np.array([int(rng.choice([0, 1, 2])), spot[0], spot[1], high, *more, 1, 0, *base]))
        groups.append(np.stack(parts))
    return groups


def _built_in(rooms: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Blocks in corners, beams, half walls: rooms that are no boxes."""
    groups = []
    for room in rooms:
        size = room[3:] - room[:3]
        if rng.random() < 0.35:
            half, corner = size[:2] * rng.uniform(0.1, 0.25, 2), rng.integers(0, 2, 2)
            middle = np.where(corner, room[3:5] - half, room[:2] + half)
            high = size[2] / 2 if rng.random() < 0.6 else rng.uniform(0.3, 0.7)
            base = _look(look_of(str(rng.choice(_PLAIN))), True, rng)
            groups.append(np.array([[0, *middle, room[2] + high, *half, high, 1, 0, *base]]))
        if rng.random() < 0.2:
            base = _look(look_of("wood"), True, rng)
            for share in np.linspace(0.2, 0.8, int(rng.integers(2, 5))):
                x = room[0] + share * size[0]
                y, z = (room[1] + room[4]) / 2, room[5] - 0.1
                groups.append(np.array([[0, x, y, z, 0.08, size[1] / 2, 0.1, 1, 0, *base]]))
    return groups


def _bound(shapes: np.ndarray, first: int, last: int) -> list[float]:
    """A sphere around the shapes of a group."""
    low = (shapes[first:last, 1:4] - np.linalg.norm(shapes[first:last, 4:7], axis=1)[:, None]).min(0)
    high = (shapes[first:last, 1:4] + np.linalg.norm(shapes[first:last, 4:7], axis=1)[:, None]).max(0)
    middle = (low + high) / 2
    far = np.linalg.norm(shapes[first:last, 1:4] - middle, axis=1) + np.linalg.norm(shapes[first:last, 4:7], axis=1)
    return [*middle, far.max(), first, last]


def _lights(shapes: np.ndarray, rooms: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Lamps near the ceilings, light from all sides, and sometimes the sun."""
    lamps = []
    for room in rooms:
        for _ in range(int(rng.integers(0, 3))):
            spot = rng.uniform(room[:2] + 0.3, room[3:5] - 0.3)
            colour = (1 - 0.4 * rng.random() * np.array([0, 0.35, 1])) * rng.uniform(0.5, 3)
            lamps.append([*spot, room[5] - rng.uniform(0.05, 0.6), *colour, rng.uniform(0.02, 0.3)])
    sky = np.zeros((4, 3))
    sky[0] = rng.uniform(0.25, 1.0) * (1 - 0.25 * rng.random() * rng.random(3))
    sky[1] = sky[0] * rng.uniform(0.4, 0.9)
    heading, high = rng.uniform(0, 6.3), rng.uniform(0.3, 1.2)
    sky[2] = [np.cos(heading) * np.cos(high), np.sin(heading) * np.cos(high), np.sin(high)]
    if rng.random() < 0.5:
        sky[3] = rng.uniform(1, 4) * np.array([1, 0.92, 0.8])
    return np.array(lamps, np.float32).reshape(-1, 7), sky.astype(np.float32)


def random_shot(scene: ShapeScene, rng: np.random.Generator) -> Shot | None:
    """A camera that sees something; None if it was put badly."""
    wide = np.radians(rng.uniform(50, 100))
    if len(scene.tops) and rng.random() < 0.15:  # over a table
        top = scene.tops[rng.integers(len(scene.tops))]
        angle, pitch, far = rng.uniform(-np.pi, np.pi), -rng.uniform(0.3, 1.1), rng.uniform(0.5, 1.5)
        eye = top[:3] - far * np.array([np.cos(angle) * np.cos(pitch), np.sin(angle) * np.cos(pitch), np.sin(pitch)])
        rooms = [room for room in scene.rooms if (eye > room[:3] + 0.1).all() and (eye < room[3:] - 0.1).all()]
        if not rooms:
            return None
        floor = rooms[0][2]
    else:
        room = scene.rooms[rng.integers(len(scene.rooms))]
        high = rng.uniform(0.3, 1.0) if rng.random() < 0.15 else rng.normal(1.5, 0.2)
        floor = room[2]
        eye = np.array(
            [*rng.uniform(room[:2] + 0.2, room[3:5] - 0.2), floor + np.clip(high, 0.25, room[5] - floor - 0.2)]
        )
        middle = (room[:2] + room[3:5]) / 2 - eye[:2]
        angle = np.arctan2(middle[1], middle[0]) + rng.normal(0, 0.9)
        pitch = float(np.clip(rng.normal(-0.1, 0.16), -0.7, 0.4))
    x, y, z = eye.tolist()
    if kernels.inside_any(scene.shapes, x, y, z, 0.15):
        return None
    return aimed(eye, angle, pitch, rng.normal(0, 0.03), 0.5 / np.tan(wide / 2), eye[2] - floor)


def aimed(eye: np.ndarray, heading: float, pitch: float, roll: float, focal: float, height_m: float) -> Shot:
    """A camera at `eye` [3] that looks along `heading`, then up by `pitch`, then turned by `roll` about its axis (radians)."""
    return Shot(np.asarray(eye, float), rotation_of(heading, pitch, roll), pitch, roll, focal, height_m)


def rotation_of(heading: float, pitch: float, roll: float) -> np.ndarray:
    """[3, 3], camera (x forward, y left, z up) to world."""
    (ch, cp, cr), (sh, sp, sr) = np.cos([heading, pitch, roll]), np.sin([heading, pitch, roll])
    turn = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    tilt = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    return turn @ tilt @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
