"""Furniture made of parts: the usual size, look and parts of each kind, where it stands, and whether it stops walkers."""

from dataclasses import dataclass
from typing import NamedTuple


class Part(NamedTuple):
    """A part between corners in shares of width, depth and height."""

    x0: float
    y0: float
    z0: float
    x1: float
    y1: float
    z1: float
    look: str = ""  # "": that of the whole
    shape: str = "box"  # shapes.py, or leaves
    solid: bool = True


@dataclass(frozen=True)
class Kind:
    """A kind of furniture."""

    size: tuple[float, float, float]  # width, depth and height in metres, with its front to the south
    look: str
    stands: str = "any"  # wall, middle, corner, any, hung (on a wall) or ceiling
    parts: tuple[Part, ...] = (Part(0, 0, 0, 1, 1, 1),)
    soft: bool = False  # walkers pass through it
    movable: bool = False  # it can be pushed
    hangs_m: float = 1.25  # height of what hangs on a wall


def _parts(*rows: tuple) -> tuple[Part, ...]:
    return tuple(Part(*row) for row in rows)


def _legs(top: float, thick: float, look: str = "", shape: str = "leg") -> tuple[Part, ...]:
    """Four legs of height `top`; `thick` is a share of the width and the depth."""
    ends = ((0.03, 0.03 + thick), (0.97 - thick, 0.97))
    return tuple(Part(a, c, 0, b, d, top, look, shape) for a, b in ends for c, d in ends)


def _bowl(x: float, y: float, z: float, wide: tuple[float, float, float], look: str, shape: str = "bowl") -> Part:
    """Something small whose foot is at x, y, z; `wide` along each axis, all in shares."""
    return Part(x - wide[0] / 2, y - wide[1] / 2, z, x + wide[0] / 2, y + wide[1] / 2, z + wide[2], look, shape, False)


def _plates(seats: tuple[tuple[float, float], ...]) -> tuple[Part, ...]:
    """A plate and a cup for each seat on a table."""
    plates = tuple(_bowl(x, y, 1, (0.14, 0.25, 0.025), "white paint #f5f2ea") for x, y in seats)
    return plates + tuple(_bowl(x + 0.1, y, 1, (0.045, 0.08, 0.11), "#c9d6d3 paint", "tube") for x, y in seats)


_SEAT = (*_parts((0, 0, 0.43, 1, 1, 0.48, "", "round"), (0.04, 0.9, 0.75, 0.96, 0.98, 0.98, "", "round"),
                 (0.04, 0.91, 0.55, 0.96, 0.97, 0.65, "", "round"), (0.05, 0.9, 0.48, 0.14, 0.98, 0.98),
                     (0.86, 0.9, 0.48, 0.95, 0.98, 0.98)),
         *_legs(0.43, 0.09))  # fmt: skip
_SOFA = _parts(
    (0.02, 0.05, 0.1, 0.98, 0.98, 0.32, "", "round"), (0, 0.76, 0.2, 1, 1, 0.95, "", "soft"),
        (0, 0, 0.1, 0.1, 0.95, 0.66, "", "soft"),
    (0.9, 0, 0.1, 1, 0.95, 0.66, "", "soft"), (0.1, 0.02, 0.3, 0.5, 0.78, 0.54, "", "soft"),
        (0.5, 0.02, 0.3, 0.9, 0.78, 0.54, "", "soft"),
    (0.11, 0.6, 0.5, 0.49, 0.84, 0.98, "", "pillow", False), (0.51, 0.6, 0.5, 0.89, 0.84, 0.98, "", "pillow", False),
    (0.12, 0.5, 0.52, 0.3, 0.7, 0.92, "orange cloth", "pillow", False),
        (0.74, 0.5, 0.52, 0.9, 0.7, 0.9, "#e8ddc8 cloth", "pillow", False),
    *((a, b, 0, a + 0.03, b + 0.06, 0.1, "dark wood", "leg") for a in (0.05, 0.92) for b in (0.08, 0.86)),
)  # fmt: skip
_ARMCHAIR = _parts(
    (0.05, 0.06, 0.14, 0.95, 0.95, 0.34, "", "round"), (0.04, 0.74, 0.2, 0.96, 1, 1, "", "soft"),
        (0, 0.02, 0.14, 0.2, 0.94, 0.68, "", "soft"),
    (0.8, 0.02, 0.14, 1, 0.94, 0.68, "", "soft"), (0.19, 0.02, 0.32, 0.81, 0.76, 0.56, "", "soft"),
    (0.24, 0.56, 0.5, 0.76, 0.78, 0.9, "#e8ddc8 cloth", "pillow", False),
    *((a, b, 0, a + 0.07, b + 0.07, 0.14, "dark wood", "leg") for a in (0.08, 0.85) for b in (0.08, 0.84)),
)  # fmt: skip
_SHELF = _parts(
    (0, 0.92, 0, 1, 1, 1), (0, 0, 0, 0.03, 0.92, 1), (0.97, 0, 0, 1, 0.92, 1), (0.485, 0.05, 0, 0.515, 0.92, 1),
    *((0.03, 0.02, z, 0.97, 0.92, z + 0.016) for z in (0.02, 0.21, 0.4, 0.59, 0.78, 0.984)),
    *((a, 0.25, z, a + 0.44, 0.92, z + 0.16, "books", "sharp") for z in (0.036, 0.226, 0.416, 0.606,
        0.796) for a in (0.035, 0.52)),
)  # fmt: skip
_BED = _parts(
    (0, 0, 0.12, 1, 1, 0.3, "wood", "round"), (0.02, 0.01, 0.28, 0.98, 0.96, 0.55, "white cloth", "soft"),
        (0, 0.96, 0, 1, 1, 1, "wood", "round"),
    (0, 0, 0.3, 1, 0.66, 0.59, "", "soft"), (0.08, 0.7, 0.5, 0.47, 0.95, 0.76, "white cloth", "pillow", False),
    (0.53, 0.7, 0.5, 0.92, 0.95, 0.76, "white cloth", "pillow", False),
        (0.3, 0.6, 0.55, 0.7, 0.74, 0.8, "orange cloth", "pillow", False),
    *((a, b, 0, a + 0.05, b + 0.04, 0.14, "wood", "leg") for a in (0.02, 0.93) for b in (0.02, 0.93)),
)  # fmt: skip
_DRAWERS = [(x, z) for x in (0.01, 0.255, 0.5, 0.755) for z in (0.12, 0.6)]
_COUNTER = _parts(
    (0, 0.06, 0.1, 1, 1, 0.95), (0.01, 0.12, 0, 0.99, 1, 0.1, "black paint"), (0, 0, 0.95, 1, 1, 1, "marble"),
    *((x, 0.03, z, x + 0.235, 0.06, z + (0.46 if z < 0.5 else 0.32)) for x, z in _DRAWERS),
    *((x + 0.08, 0.0, z + (0.4 if z < 0.5 else 0.26), x + 0.155, 0.03, z + (0.42 if z < 0.5 else 0.28),
        "metal", "round", False) for x, z in _DRAWERS),
    (0.1, 0.35, 1, 0.19, 0.65, 1.22, "#b5673f stone", "pot", False),
        (0.22, 0.4, 1, 0.27, 0.6, 1.17, "#d9d2c2 paint", "tube", False),
    (0.7, 0.5, 1, 0.82, 0.9, 1.12, "#c9cdd0 metal", "bowl", False), (0.86, 0.8, 1, 0.95, 0.84, 1.32, "wood", "round", False),
)  # fmt: skip
_POT = "#b5673f stone"
_LOW = (Part(0, 0, 0.84, 1, 1, 1, "", "round"), *_legs(0.84, 0.08), _bowl(0.3, 0.5, 1, (0.2, 0.3, 0.22), "#6d8a86 paint"),
        _bowl(0.68, 0.42, 1, (0.26, 0.3, 0.08), "books", "sharp"), _bowl(0.7, 0.6, 1, (0.07, 0.11, 0.25),
            "#e9e4d8 paint", "pot"))  # fmt: skip
_TABLE = (
    Part(0, 0, 0.94, 1, 1, 1, "", "round"), Part(0.08, 0.1, 0.85, 0.92, 0.9, 0.94), *_legs(0.94, 0.05),
    _bowl(0.5, 0.5, 1, (0.18, 0.3, 0.12), "#5f7f86 paint"), _bowl(0.46, 0.47, 1.07, (0.055, 0.1, 0.1), "#b8442f paint", "ball"),
    _bowl(0.54, 0.5, 1.07, (0.055, 0.1, 0.1), "#d98a2f paint", "ball"), _bowl(0.5, 0.55, 1.07, (0.055, 0.1, 0.1),
        "#8ca046 paint", "ball"),
    *_plates(((0.2, 0.22), (0.2, 0.78), (0.78, 0.22), (0.78, 0.78))),
)  # fmt: skip
KINDS = {
    "table": Kind((1.6, 0.9, 0.75), "wood", "middle", _TABLE),
    "lowtable": Kind((1.1, 0.65, 0.38), "wood", "middle", _LOW),
    "desk": Kind(
        (1.4, 0.7, 0.75),
        "wood",
        "wall",
        (
            *_parts((0, 0, 0.94, 1, 1, 1, "", "round"), (0.68, 0.06, 0.1, 0.98, 0.98, 0.94)),
            *_parts((0.7, 0.04, 0.15, 0.96, 0.06, 0.5), (0.7, 0.04, 0.54, 0.96, 0.06, 0.9)),
            *_legs(0.94, 0.05),
            _bowl(0.15, 0.7, 1, (0.12, 0.24, 0.04), "metal", "tube"),
            _bowl(0.15, 0.7, 1.04, (0.016, 0.03, 0.4), "metal", "tube"),
            _bowl(0.15, 0.7, 1.4, (0.2, 0.38, 0.22), "shade", "shade"),
            _bowl(0.48, 0.4, 1, (0.3, 0.42, 0.02), "#f2eee4 paint", "sharp"),
        ),
    ),
    "nightstand": Kind(
        (0.45, 0.4, 0.5),
        "wood",
        "wall",
        (
            *_parts((0, 0.04, 0.2, 1, 1, 1, "", "round"), (0.06, 0, 0.28, 0.94, 0.04, 0.58), (0.06, 0, 0.62, 0.94, 0.04, 0.94)),
            *_legs(0.2, 0.1),
            _bowl(0.5, 0.5, 1, (0.3, 0.34, 0.35), "#6d8a86 paint", "ball"),
            _bowl(0.5, 0.5, 1.32, (0.6, 0.66, 0.45), "shade", "shade"),
        ),
    ),
    "chair": Kind((0.45, 0.45, 0.95), "wood", "any", _SEAT, movable=True),
    "stool": Kind((0.4, 0.4, 0.5), "wood", "any", (Part(0, 0, 0.9, 1, 1, 1, "", "tube"), *_legs(0.9, 0.1)), movable=True),
    "cushion": Kind((0.6, 0.6, 0.14), "teal cloth", "any", _parts((0, 0, 0, 1, 1, 1, "", "pillow")), movable=True),
    "bench": Kind(
        (1.5, 0.4, 0.45),
        "wood",
        "wall",
        _parts((0, 0, 0.88, 1, 1, 1, "", "round"), (0.06, 0.1, 0, 0.12, 0.9, 0.88), (0.88, 0.1, 0, 0.94, 0.9, 0.88)),
    ),
    "sofa": Kind((2.1, 0.95, 0.85), "teal cloth", "wall", _SOFA),
    "armchair": Kind((0.9, 0.85, 0.9), "orange cloth", "any", _ARMCHAIR),
    "bed": Kind((1.6, 2.1, 0.95), "blue cloth", "wall", _BED),
    "bookshelf": Kind((1.2, 0.35, 2.0), "dark wood", "wall", _SHELF),
    "wallshelf": Kind(
        (1.4, 0.24, 0.62),
        "wood",
        "hung",
        (
            *_parts((0, 0, 0, 1, 1, 0.05, "", "round"), (0, 0, 0.5, 1, 1, 0.55, "", "round")),
            *(_bowl(x, 0.5, 0.05, (0.1, 0.5, 0.12), look) for x, look in ((0.1, "#f5f2ea paint"), (0.23, "#c9d6d3 paint"),
                (0.78, _POT))),
            *(_bowl(x, 0.5, z, (0.07, 0.4, 0.26), look, "pot") for x, z, look in ((0.4, 0.05, "#5f7f86 paint"),
                (0.52, 0.05, "#d9b27a paint"), (0.9, 0.55, "#f5f2ea paint"))),
            *(_bowl(x, 0.5, 0.55, (0.08, 0.5, 0.2), "#e4ddcd paint", "tube") for x in (0.1, 0.2, 0.3)),
            Part(0.45, 0.2, 0.55, 0.72, 0.9, 0.9, "books", "sharp", False),
        ),
        True,
        hangs_m=1.4,
    ),
    "wardrobe": Kind(
        (1.3, 0.6, 2.1),
        "wood",
        "wall",
        _parts(
            (0, 0.04, 0.04, 1, 1, 1, "", "round"), (0.01, 0, 0.06, 0.495, 0.04, 0.98), (0.505, 0, 0.06, 0.99, 0.04, 0.98),
            (0.45, -0.04, 0.46, 0.47, 0, 0.56, "metal", "round", False),
                (0.53, -0.04, 0.46, 0.55, 0, 0.56, "metal", "round", False),
        ),
    ),
    "counter": Kind((2.0, 0.6, 0.92), "white paint", "wall", _COUNTER),
    "fridge": Kind(
        (0.65, 0.65, 1.8),
        "#d9dcdd metal",
        "wall",
        _parts(
            (0, 0.06, 0.02, 1, 1, 1, "", "round"), (0.005, 0, 0.03, 0.995, 0.06, 0.6, "", "round"),
                (0.005, 0, 0.615, 0.995, 0.06, 0.99, "", "round"),
            (0.06, -0.05, 0.4, 0.1, 0, 0.58, "metal", "round", False), (0.06, -0.05, 0.63, 0.1, 0, 0.8, "metal", "round", False),
        ),
    ),
    "crate": Kind((0.7, 0.7, 0.7), "boards", "corner", movable=True),
    "box": Kind((0.5, 0.5, 0.5), "brown paint", "any", movable=True),
    "barrel": Kind(
        (0.6, 0.6, 0.85),
        "dark wood",
        "corner",
        _parts(
            (0.02, 0.02, 0, 0.98, 0.98, 0.35, "boards", "pot"), (0, 0, 0.35, 1, 1, 0.65, "boards", "tube"),
                (0.02, 0.02, 0.65, 0.98, 0.98, 1, "boards", "shade"),
            (-0.01, -0.01, 0.32, 1.01, 1.01, 0.37, "metal", "tube", False),
                (-0.01, -0.01, 0.63, 1.01, 1.01, 0.68, "metal", "tube", False),
        ),
    ),
    "chest": Kind(
        (0.9, 0.5, 0.55),
        "dark wood",
        "wall",
        _parts(
            (0, 0, 0, 1, 1, 0.62), (0, 0, 0.64, 1, 1, 1, "", "soft"),
                *((x, -0.02, 0, x + 0.06, 1.02, 0.66, "metal", "box", False) for x in (0.12, 0.82)),
            (0.45, -0.05, 0.5, 0.55, 0, 0.74, "golden metal", "round", False),
        ),
    ),
    "pillar": Kind((0.45, 0.45, 9.0), "stone", "middle", _parts((0.03, 0.03, 0, 0.97, 0.97, 1, "", "tube"),
        (0, 0, 0, 1, 1, 0.06), (0, 0, 0.94, 1, 1, 1))),
    "lamp": Kind(
        (0.42, 0.42, 1.6),
        "metal",
        "corner",
        _parts(
            (0.2, 0.2, 0, 0.8, 0.8, 0.02, "", "tube"), (0.475, 0.475, 0.02, 0.525, 0.525, 0.82, "", "tube"),
                (0, 0, 0.8, 1, 1, 1, "shade", "shade"),
        ),
    ),
    "pendant": Kind(
        (0.42, 0.42, 0.8),
        "metal",
        "ceiling",
        _parts((0.485, 0.485, 0.3, 0.515, 0.515, 1, "", "tube"), (0.1, 0.1, 0.06, 0.9, 0.9, 0.32, "", "shade"),
            (0.32, 0.32, 0, 0.68, 0.68, 0.13, "bulb", "ball")),
        True,
    ),
    "lantern": Kind(
        (0.6, 0.6, 0.75),
        "dark wood",
        "ceiling",
        _parts((0.49, 0.49, 0.6, 0.51, 0.51, 1, "", "tube"), (0, 0, 0, 1, 1, 0.64, "shade", "ball")),
        True,
    ),
    "chandelier": Kind(
        (0.9, 0.9, 0.9),
        "metal",
        "ceiling",
        (
            *_parts((0.49, 0.49, 0.2, 0.51, 0.51, 1, "", "tube"), (0, 0.47, 0.14, 1, 0.53, 0.2, "dark wood"),
                (0.47, 0, 0.14, 0.53, 1, 0.2, "dark wood")),
            *(part for x, y in ((0.03, 0.5), (0.97, 0.5), (0.5, 0.03), (0.5, 0.97)) for part in (
                _bowl(x, y, 0.2, (0.05, 0.05, 0.13), "#efe6cf paint", "tube"), _bowl(x, y, 0.33, (0.05, 0.05, 0.1),
                    "flame", "flame"))),
        ),
        True,
    ),
    "torch": Kind(
        (0.2, 0.26, 0.7),
        "dark wood",
        "hung",
        _parts((0.4, 0.55, 0, 0.6, 0.75, 0.6, "", "pot"), (0.3, 0.5, 0.5, 0.7, 0.8, 0.62, "metal", "pot"),
            (0.4, 0.75, 0.3, 0.6, 1, 0.36, "metal"),
               (0.25, 0.45, 0.62, 0.75, 0.85, 1, "flame", "flame")),
        True,
        hangs_m=1.35,
    ),
    "candle": Kind((0.12, 0.12, 0.3), "#efe6cf paint", "any", _parts((0.2, 0.2, 0, 0.8, 0.8, 0.7, "", "tube"),
        (0.25, 0.25, 0.7, 0.75, 0.75, 1, "flame", "flame"))),
    "screen": Kind((1.6, 0.04, 1.8), "paper", "wall", _parts((0, 0, 0, 1, 1, 1, "", "sharp"))),
    "plant": Kind(
        (0.7, 0.7, 1.3),
        "green leaves",
        "corner",
        _parts(
            (0.27, 0.27, 0, 0.73, 0.73, 0.28, _POT, "pot"), (0.31, 0.31, 0.25, 0.69, 0.69, 0.285, "#3a2a1f carpet", "tube"),
            (0.47, 0.47, 0.28, 0.53, 0.53, 0.6, "brown wood", "tube", False), (0, 0, 0.34, 1, 1, 1, "", "leaves", False),
        ),
    ),
    "rug": Kind((2.4, 1.6, 0.015), "red rug", "middle", _parts((0, 0, 0, 1, 1, 1, "", "sharp")), soft=True),
    "picture": Kind(
        (0.9, 0.04, 0.7),
        "art",
        "hung",
        _parts((0, 0.2, 0, 1, 1, 1, "dark wood"), (0.05, 0, 0.06, 0.95, 0.2, 0.94, "", "sharp")),
        True,
    ),
    "platform": Kind((2.0, 2.0, 1.0), "wood", "corner"),
}  # fmt: skip
SAME = {
    "column": "pillar", "couch": "sofa", "bookcase": "bookshelf", "cupboard": "wardrobe", "coffeetable": "lowtable",
        "shelf": "bookshelf",
    "cabinet": "wardrobe", "closet": "wardrobe", "carpet": "rug", "painting": "picture", "refrigerator": "fridge",
    "tree": "plant", "worktop": "counter", "trunk": "chest", "pouf": "cushion", "keg": "barrel",
    "podium": "platform", "stage": "platform", "seat": "chair", "block": "box", "cube": "box",
}  # fmt: skip


def kind_of(label: str) -> Kind:
    """The kind of furniture of a label; a plain box for unknown words."""
    word = label.lower().strip()
    return KINDS.get(SAME.get(word, word), Kind((0.6, 0.6, 0.6), "paint"))
