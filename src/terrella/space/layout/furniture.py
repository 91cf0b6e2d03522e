"""Furniture made of boxes: the usual size, look and parts of each kind, where it stands, and whether it stops walkers."""

from dataclasses import dataclass

# Corners in shares of width, depth and height; a look, "" for that of the whole.
Part = tuple[float, float, float, float, float, float, str]


@dataclass(frozen=True)
class Kind:
    """A kind of furniture."""

    size: tuple[float, float, float]  # width, depth and height in metres, with its front to the south
    look: str
    stands: str = "any"  # wall, middle, corner, any or hung (on a wall)
    parts: tuple[Part, ...] = ((0, 0, 0, 1, 1, 1, ""),)
    soft: bool = False  # walkers pass through it
    movable: bool = False  # it can be pushed


def _legs(top: float, thick: float, look: str = "") -> tuple[Part, ...]:
    """Four legs of height `top`; `thick` is a share of the width and the depth."""
    ends = ((0.02, 0.02 + thick), (0.98 - thick, 0.98))
    return tuple((a, c, 0, b, d, top, look) for a, b in ends for c, d in ends)


_SEAT: tuple[Part, ...] = ((0, 0, 0.42, 1, 1, 0.5, ""), (0, 0.9, 0.5, 1, 1, 1, ""), *_legs(0.42, 0.1))
_SOFA: tuple[Part, ...] = (
    (0, 0, 0.08, 1, 1, 0.5, ""), (0, 0.74, 0.5, 1, 1, 1, ""), (0, 0, 0.5, 0.09, 0.74, 0.75, ""),
    (0.91, 0, 0.5, 1, 0.74, 0.75, ""), (0.04, 0.1, 0, 0.96, 0.9, 0.08, "dark wood"),
)  # fmt: skip
_SHELF: tuple[Part, ...] = (
    (0, 0.9, 0, 1, 1, 1, ""), (0, 0, 0, 0.04, 0.9, 1, ""), (0.96, 0, 0, 1, 0.9, 1, ""),
    *((0.04, 0.0, z, 0.96, 0.9, z + 0.03, "") for z in (0.0, 0.24, 0.48, 0.72, 0.97)),
    *((0.04, 0.25, z, 0.96, 0.9, z + 0.15, "books") for z in (0.03, 0.27, 0.51, 0.75)),
)  # fmt: skip
_BED: tuple[Part, ...] = (
    (0, 0, 0, 1, 1, 0.3, "wood"), (0.02, 0.01, 0.3, 0.98, 0.96, 0.5, ""), (0, 0.96, 0.3, 1, 1, 1, "wood"),
    (0.08, 0.74, 0.5, 0.46, 0.93, 0.62, "white cloth"), (0.54, 0.74, 0.5, 0.92, 0.93, 0.62, "white cloth"),
)  # fmt: skip
KINDS = {
    "table": Kind((1.6, 0.9, 0.75), "wood", "middle", ((0, 0, 0.94, 1, 1, 1, ""), *_legs(0.94, 0.06))),
    "desk": Kind(
        (1.4, 0.7, 0.75),
        "wood",
        "wall",
        ((0, 0, 0.94, 1, 1, 1, ""), (0, 0, 0, 0.05, 1, 0.94, ""), (0.7, 0.05, 0, 1, 1, 0.94, "")),
    ),
    "chair": Kind((0.45, 0.45, 0.95), "wood", "any", _SEAT, movable=True),
    "stool": Kind((0.4, 0.4, 0.5), "wood", "any", ((0, 0, 0.88, 1, 1, 1, ""), *_legs(0.88, 0.12)), movable=True),
    "bench": Kind(
        (1.5, 0.4, 0.45),
        "wood",
        "wall",
        ((0, 0, 0.85, 1, 1, 1, ""), (0.05, 0.1, 0, 0.12, 0.9, 0.85, ""), (0.88, 0.1, 0, 0.95, 0.9, 0.85, "")),
    ),
    "sofa": Kind((2.0, 0.9, 0.85), "teal cloth", "wall", _SOFA),
    "armchair": Kind((0.9, 0.85, 0.85), "orange cloth", "any", _SOFA),
    "bed": Kind((1.6, 2.1, 0.95), "blue cloth", "wall", _BED),
    "bookshelf": Kind((1.2, 0.35, 2.0), "dark wood", "wall", _SHELF),
    "wardrobe": Kind(
        (1.3, 0.6, 2.1),
        "wood",
        "wall",
        ((0, 0.04, 0, 1, 1, 1, ""), (0.01, 0, 0.03, 0.49, 0.04, 0.98, ""), (0.51, 0, 0.03, 0.99, 0.04, 0.98, "")),
    ),
    "counter": Kind(
        (2.0, 0.6, 0.92), "white paint", "wall", ((0, 0.04, 0, 1, 1, 0.95, ""), (0, 0, 0.95, 1, 1, 1, "marble"))
    ),
    "fridge": Kind(
        (0.65, 0.65, 1.8),
        "metal",
        "wall",
        ((0, 0.05, 0, 1, 1, 1, ""), (0.01, 0, 0.02, 0.99, 0.05, 0.62, ""), (0.01, 0, 0.64, 0.99, 0.05, 0.98, "")),
    ),
    "crate": Kind((0.7, 0.7, 0.7), "wood", "corner", movable=True),
    "box": Kind((0.5, 0.5, 0.5), "brown paint", "any", movable=True),
    "pillar": Kind((0.45, 0.45, 9.0), "stone", "middle", ((0, 0, 0, 1, 1, 1, ""),)),
    "lamp": Kind(
        (0.4, 0.4, 1.6),
        "metal",
        "corner",
        (
            (0.25, 0.25, 0, 0.75, 0.75, 0.02, ""),
            (0.46, 0.46, 0.02, 0.54, 0.54, 0.8, ""),
            (0.05, 0.05, 0.8, 0.95, 0.95, 1, "lamp"),
        ),
    ),
    "plant": Kind(
        (0.6, 0.6, 1.2),
        "green leaves",
        "corner",
        (
            (0.25, 0.25, 0, 0.75, 0.75, 0.3, "orange stone"),
            (0.46, 0.46, 0.3, 0.54, 0.54, 0.5, "brown wood"),
            (0.1, 0.1, 0.5, 0.9, 0.9, 0.8, ""),
            (0.25, 0.25, 0.8, 0.75, 0.75, 1, ""),
        ),
    ),
    "rug": Kind((2.4, 1.6, 0.015), "red carpet", "middle", soft=True),
    "picture": Kind(
        (0.9, 0.04, 0.7),
        "blue paint",
        "hung",
        ((0, 0.2, 0, 1, 1, 1, "dark wood"), (0.06, 0, 0.08, 0.94, 0.2, 0.92, "")),
        True,
    ),
    "platform": Kind((2.0, 2.0, 1.0), "wood", "corner"),
}
SAME = {
    "column": "pillar", "couch": "sofa", "shelf": "bookshelf", "bookcase": "bookshelf", "cupboard": "wardrobe",
    "cabinet": "wardrobe", "closet": "wardrobe", "carpet": "rug", "painting": "picture", "refrigerator": "fridge",
    "tree": "plant", "worktop": "counter",
    "podium": "platform", "stage": "platform", "seat": "chair", "block": "box", "cube": "box",
}  # fmt: skip


def kind_of(label: str) -> Kind:
    """The kind of furniture of a label; a plain box for unknown words."""
    word = label.lower().strip()
    return KINDS.get(SAME.get(word, word), Kind((0.6, 0.6, 0.6), "paint"))
