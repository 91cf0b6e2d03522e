"""Looks: "dark red planks" as a material, a colour and a procedural texture."""

import re
from dataclasses import dataclass

from ...core.errors import ContractError

COLOURS = {
    "white": "f2efe8", "black": "1c1c1e", "grey": "8c8c8a", "gray": "8c8c8a", "red": "b3261e", "orange": "d9772b",
    "yellow": "e3b53a", "green": "4f8a4a", "blue": "2f5d9e", "purple": "6d4a8f", "pink": "d98ca0", "brown": "6f4a30",
    "beige": "d9c6a3", "cream": "efe3c8", "turquoise": "3f9a97", "golden": "c9a13b", "navy": "22335c", "teal": "2b7073",
}  # fmt: skip
MATERIALS = {  # each with its default colour
    "plaster": "ebe4d6", "paint": "e6e2d8", "planks": "9c7148", "wood": "8a5a34", "tiles": "d5d2c9", "brick": "9a5440",
    "stone": "9b968c", "concrete": "a3a19b", "marble": "e4e0da", "carpet": "7c6a72", "cloth": "6d7f8e", "metal": "8f949a",
    "leaves": "4c7a3c", "grass": "5f8a3d", "books": "8a6a4a", "glass": "dfeaf2", "sky": "bcd6f2", "lamp": "ffe9c4",
    "boards": "a5825c", "checker": "dcd8ce", "subway": "eceae4", "flagstone": "8b857a", "tatami": "c6bf86", "paper": "f6efdd",
    "rug": "8f3a2f", "art": "d9cfb8", "shade": "ffdca8", "flame": "ffc27a", "bulb": "fff0d2",
}  # fmt: skip
GLOWING = {"glass": 1.0, "sky": 0.7, "lamp": 16.0, "shade": 14.0, "bulb": 60.0, "flame": 110.0}  # light sources
SHADES = {"dark": 0.5, "light": 1.6, "pale": 2.2, "bright": 1.2}
_SAME = {"wooden": "wood", "tiled": "tiles", "bricks": "brick", "parquet": "planks", "steel": "metal", "fabric": "cloth",
         "painted": "paint", "tile": "tiles", "plank": "planks", "carpeted": "carpet", "window": "glass"}  # fmt: skip
WORDS = {*COLOURS, *MATERIALS, *SHADES, *_SAME}


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
        elif word in SHADES:
            shade *= SHADES[word]
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
