"""Looks: "dark red planks" as a material, a colour and a procedural texture."""

import re
from dataclasses import dataclass

import numpy as np

from ...core.errors import ContractError

COLOURS = {
    "white": "f2efe8", "black": "1c1c1e", "grey": "8c8c8a", "gray": "8c8c8a", "red": "b3261e", "orange": "d9772b",
    "yellow": "e3b53a", "green": "4f8a4a", "blue": "2f5d9e", "purple": "6d4a8f", "pink": "d98ca0", "brown": "6f4a30",
    "beige": "d9c6a3", "cream": "efe3c8", "turquoise": "3f9a97", "golden": "c9a13b", "navy": "22335c", "teal": "2b7073",
}  # fmt: skip
MATERIALS = {  # each with its default colour
    "plaster": "ebe4d6", "paint": "e6e2d8", "planks": "9c7148", "wood": "8a5a34", "tiles": "d5d2c9", "brick": "9a5440",
    "stone": "9b968c", "concrete": "a3a19b", "marble": "e4e0da", "carpet": "7c6a72", "cloth": "6d7f8e", "metal": "8f949a",
    "leaves": "4c7a3c", "grass": "5f8a3d", "books": "8a6a4a", "glass": "dfeaf2", "sky": "bcd6f2", "lamp": "fff0d2",
}  # fmt: skip
GLOWING = {
    "glass": 5.0,
    "sky": 3.0,
    "lamp": 16.0,
}  # light sources, and their brightness relative to a white wall outdoors
FINE = {
    "planks": 1.6,
    "tiles": 2.0,
    "brick": 2.4,
    "books": 4.0,
    "stone": 1.3,
    "marble": 1.3,
    "plaster": 0.55,
    "sky": 0.05,
}
_SEAMS = ("planks", "tiles", "brick", "stone")  # patterns with fine lines
_SHADES = {"dark": 0.5, "light": 1.6, "pale": 2.2, "bright": 1.2}
_SAME = {"wooden": "wood", "tiled": "tiles", "bricks": "brick", "parquet": "planks", "steel": "metal", "fabric": "cloth",
         "painted": "paint", "tile": "tiles", "plank": "planks", "carpeted": "carpet", "window": "glass"}  # fmt: skip
WORDS = {*COLOURS, *MATERIALS, *_SHADES, *_SAME}


@dataclass(frozen=True)
class Look:
    """A material with a colour."""

    material: str  # a key of MATERIALS
    colour: tuple[float, float, float]  # sRGB in 0..1

    @property
    def glow(self) -> float:
        return GLOWING.get(self.material, 0.0)


def look_of(words: str, usual: str = "paint") -> Look:
    """The look that words name; ContractError for an unknown word. Known are COLOURS, MATERIALS, shades and #rrggbb."""
    material, colour, shade = usual, "", 1.0
    for word in str(words).lower().replace(",", " ").split():
        word = _SAME.get(word, word)
        if word in MATERIALS:
            material = word
        elif word in COLOURS:
            colour = COLOURS[word]
        elif word in _SHADES:
            shade *= _SHADES[word]
        elif re.fullmatch("#[0-9a-f]{6}", word):
            colour = word[1:]
        else:
            raise ContractError(
                f"the look '{words:.60}' has the unknown word '{word:.30}'; colours are {', '.join(COLOURS)} or #rrggbb, "
                f"materials {', '.join(MATERIALS)}."
            )
    rgb = [int((colour or MATERIALS[material])[at : at + 2], 16) / 255 for at in (0, 2, 4)]
    rgb = [one * shade if shade <= 1 else 1 - (1 - one) / shade for one in rgb]
    return Look(material, (rgb[0], rgb[1], rgb[2]))


def texture_colours(look: Look, u: np.ndarray, v: np.ndarray, step: float, seed: int) -> np.ndarray:
    """Colours [N, 3] of a surface at u, v [N] in metres, averaged over squares of side `step`."""
    pattern, offsets = _PATTERNS.get(look.material), (-step / 4, step / 4)
    shade = np.ones(len(u))
    if pattern is not None and look.material not in _SEAMS:
        shade = pattern(u, v, seed)
    elif pattern is not None:
        shade = np.mean([pattern(u + a, v + b, seed) for a in offsets for b in offsets], 0)
    if look.material == "books":
        return np.clip(_books(u, v, seed) * shade[:, None], 0, 1)
    return np.clip(np.asarray(look.colour) * shade[:, None], 0, 1)


def _hash(seed: int, *parts: np.ndarray) -> np.ndarray:
    """Chance in 0..1 that integers fix."""
    mixed = np.full(np.broadcast(*parts).shape, (seed * 2654435761 + 97) & 0xFFFFFFFF, np.uint32)
    for part in parts:
        mixed = (mixed ^ np.floor(part).astype(np.int32).view(np.uint32)) * np.uint32(0x9E3779B1)
        mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(0x85EBCA77)
        mixed = mixed ^ (mixed >> np.uint32(13))
    return mixed / 0xFFFFFFFF


def _noise(u: np.ndarray, v: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Smooth noise in 0..1 whose blobs are `size` metres wide."""
    a, b = u / size, v / size
    i, j = np.floor(a), np.floor(b)
    s, t = (3 - 2 * (a - i)) * (a - i) ** 2, (3 - 2 * (b - j)) * (b - j) ** 2
    low = _hash(seed, i, j) * (1 - s) + _hash(seed, i + 1, j) * s
    return low * (1 - t) + (_hash(seed, i, j + 1) * (1 - s) + _hash(seed, i + 1, j + 1) * s) * t


def _plaster(u, v, seed):
    return 0.97 + 0.025 * _noise(u, v, 0.9, seed) + 0.025 * _noise(u, v, 0.11, seed + 1)


def _planks(u, v, seed):
    row = np.floor(v / 0.14)
    along = u / 1.3 + _hash(seed, row) * 7
    seam = (np.abs(v / 0.14 - row - 0.5) > 0.47) | (np.abs(along - np.floor(along) - 0.5) > 0.496)
    grain = _noise(u * 0.12, v, 0.012, seed + 2)
    return (0.75 + 0.4 * _hash(seed, row, along) + 0.12 * (grain - 0.5)) * np.where(seam, 0.45, 1.0)


def _wood(u, v, seed):
    return 0.88 + 0.24 * _noise(u * 0.15, v, 0.02, seed)


def _tiles(u, v, seed):
    i, j = np.floor(u / 0.3), np.floor(v / 0.3)
    seam = (np.abs(u / 0.3 - i - 0.5) > 0.48) | (np.abs(v / 0.3 - j - 0.5) > 0.48)
    return (0.93 + 0.12 * _hash(seed, i, j) - 0.16 * ((i + j) % 2)) * np.where(seam, 0.6, 1.0)


def _brick(u, v, seed):
    row = np.floor(v / 0.085)
    along = u / 0.24 + 0.5 * (row % 2)
    seam = (np.abs(v / 0.085 - row - 0.5) > 0.43) | (np.abs(along - np.floor(along) - 0.5) > 0.475)
    return np.where(seam, 1.35, 0.75 + 0.4 * _hash(seed, row, along) + 0.1 * _noise(u, v, 0.03, seed))


def _stone(u, v, seed):
    row = np.floor(v / 0.4)
    along = u / 0.7 + 0.5 * (row % 2)
    seam = (np.abs(v / 0.4 - row - 0.5) > 0.48) | (np.abs(along - np.floor(along) - 0.5) > 0.488)
    return (0.85 + 0.2 * _hash(seed, row, along) + 0.15 * _noise(u, v, 0.09, seed)) * np.where(seam, 0.65, 1.0)


def _concrete(u, v, seed):
    return (
        0.85 + 0.15 * _noise(u, v, 0.9, seed) + 0.1 * _noise(u, v, 0.1, seed + 1) + 0.05 * _noise(u, v, 0.03, seed + 2)
    )


def _marble(u, v, seed):
    vein = np.abs(np.sin(2.2 * u + 1.3 * v + 5 * _noise(u, v, 0.6, seed) + 2 * _noise(u, v, 0.15, seed + 1)))
    return 1 - 0.35 * np.clip(1 - vein / 0.18, 0, 1)


def _rough(u, v, seed):
    return 0.75 + 0.3 * _noise(u, v, 0.05, seed) + 0.2 * _noise(u, v, 0.6, seed + 1)


def _cloth(u, v, seed):
    return 0.9 + 0.12 * _noise(u, v, 0.04, seed) + 0.06 * _noise(u, v, 0.3, seed + 1)


def _leaves(u, v, seed):
    return 0.5 + 0.9 * _noise(u, v, 0.06, seed)


def _books(u, v, seed):
    at = np.floor(u / 0.045 + 0.4 * _hash(seed, np.floor(u / 0.045)))
    tone = _hash(seed, at, 0 * at)
    palette = np.array([look_of(name).colour for name in ("red", "navy", "green", "brown", "cream", "teal", "golden")])
    return palette[(tone * len(palette)).astype(int) % len(palette)] * (0.7 + 0.4 * _hash(seed + 1, at, at))[:, None]


_PATTERNS = {
    "plaster": _plaster, "paint": _plaster, "planks": _planks, "wood": _wood, "tiles": _tiles, "brick": _brick, "stone": _stone,
    "concrete": _concrete, "marble": _marble, "carpet": _rough, "grass": _rough, "cloth": _cloth, "leaves": _leaves,
}  # fmt: skip
