"""Styles by words: materials, colours, furniture and windows that go together, and what stands in a room by default."""

from dataclasses import dataclass

from ...core.errors import ContractError


@dataclass(frozen=True)
class Style:
    """What goes together. Looks are those of looks.py; an empty one leaves the usual."""

    walls: str = ""
    floor: str = ""
    ceiling: str = ""
    wood: str = "#8a5a34 wood"
    dark_wood: str = "dark wood"
    cloth: str = ""
    second_cloth: str = ""
    metal: str = "metal"
    paint: str = "white paint"  # of frames, doors and skirting boards
    top: str = "marble"  # of counters
    rug: str = "red rug"
    panes: tuple[float, float] = (2, 1)  # of windows, across and upwards
    curtains: str = ""  # their look
    skirting: bool = True
    outside: str = "trees"  # trees, hills or city
    lamp: str = "pendant"  # what hangs from the ceiling, "" for panels
    extra: tuple[str, ...] = ()  # things in every furnished room
    without: tuple[str, ...] = ()


STYLES = {
    "plain": Style(),
    "modern": Style(
        walls="#e9e7e3 paint", floor="#b08d68 planks", ceiling="white paint", wood="#7a5236 wood", cloth="#8d9298 cloth",
        second_cloth="#b8693f cloth", metal="#2a2b2e metal", paint="#2f3033 paint", rug="#9aa0a3 rug", panes=(2, 1),
        curtains="#cfcac2 cloth", outside="city",
    ),
    "scandinavian": Style(
        walls="#f1efea paint", floor="#cfae84 planks", ceiling="white paint", wood="#d3ad7d wood", dark_wood="#b98f60 wood",
        cloth="#aab7b8 cloth", second_cloth="#e0c9a6 cloth", metal="#33363a metal", paint="white paint", top="#d8b98d wood",
        rug="#8fa3a8 rug", panes=(3, 2), curtains="#f3f0e8 cloth", outside="trees", extra=("plant",),
    ),
    "japanese": Style(
        walls="#d9ccae plaster", floor="tatami", ceiling="#b08a5c boards", wood="#a97b4c wood", dark_wood="#4a3122 wood",
        cloth="#3d4f63 cloth", second_cloth="#8c3b32 cloth", metal="#2c2724 metal", paint="#5a3d29 wood", top="#a97b4c wood",
        rug="#a9a06a rug", panes=(4, 3), outside="trees", lamp="lantern", without=("rug",),
    ),
    "industrial": Style(
        walls="brick", floor="#8b8984 concrete", ceiling="#9d9b96 concrete", wood="#7b5334 wood", dark_wood="#4a3424 wood",
        cloth="#7a4a2c cloth", second_cloth="#55606a cloth", metal="#2b2d30 metal", paint="#26282b metal", top="#8f8b84 concrete",
        rug="#6d2f28 rug", panes=(4, 4), skirting=False, outside="city",
    ),
    "rustic": Style(
        walls="#e6d9bf plaster", floor="#8a6140 planks", ceiling="#6f4b30 boards", wood="#8a5c36 wood", dark_wood="#5a3a22 wood",
        cloth="#8c3d30 cloth", second_cloth="#c9a36a cloth", metal="#3a332d metal", paint="#7a5233 wood", top="#8a5c36 wood",
        rug="#8f3a2f rug", panes=(2, 3), curtains="#b5583f cloth", outside="hills", lamp="chandelier",
    ),
    "medieval": Style(
        walls="stone", floor="flagstone", ceiling="dark stone", wood="#6b4526 wood", dark_wood="#3d2817 wood",
            cloth="#6e2622 cloth",
        second_cloth="#3c4a2e cloth", metal="#2d2a28 metal", paint="#4a3020 wood", top="stone", rug="#6e2622 rug", panes=(2, 3),
        skirting=False, outside="hills", lamp="chandelier", extra=("torch",), without=("fridge", "picture", "plant", "lamp"),
    ),
}  # fmt: skip
STYLE_WORDS = {**{word: word for word in STYLES if word != "plain"}, "nordic": "scandinavian", "scandi": "scandinavian",
    "minimalist": "modern",
               "contemporary": "modern", "farmhouse": "rustic", "cottage": "rustic", "country": "rustic", "gothic": "medieval",
               "castle": "medieval", "zen": "japanese", "urban": "industrial"}  # fmt: skip
MOODS = {
    "cosy": ("lamp", "rug", "armchair"),
    "cozy": ("lamp", "rug", "armchair"),
    "furnished": (),
    "homely": ("lamp", "rug"),
}
EMPTY = {"empty", "bare", "unfurnished"}
_LIVING = {
    "sofa": 1,
    "lowtable": 1,
    "rug": 1,
    "armchair": 1,
    "bookshelf": 1,
    "lamp": 1,
    "plant": 2,
    "picture": 2,
    "window": 2,
}
FURNISHINGS: dict[str, dict[str, int]] = {  # what stands in a room, and how many
    "room": _LIVING, "livingroom": _LIVING,
    "hall": {"bench": 1, "plant": 2, "picture": 3, "rug": 1, "window": 3},
    "corridor": {"picture": 3, "plant": 1},
    "kitchen": {"counter": 2, "fridge": 1, "table": 1, "chair": 4, "wallshelf": 1, "plant": 1, "picture": 1, "window": 2},
    "bedroom": {"bed": 1, "nightstand": 2, "wardrobe": 1, "rug": 1, "plant": 1, "picture": 1, "window": 1, "lamp": 1},
    "bathroom": {"counter": 1, "plant": 1, "window": 1, "stool": 1},
    "study": {"desk": 1, "chair": 1, "bookshelf": 2, "rug": 1, "lamp": 1, "plant": 1, "picture": 1, "window": 1},
    "library": {"bookshelf": 6, "armchair": 2, "table": 1, "chair": 2, "rug": 1, "lamp": 2, "window": 1},
    "gallery": {"picture": 6, "bench": 2, "plant": 1, "window": 2},
    "cellar": {"barrel": 4, "crate": 3, "table": 1, "stool": 2},
    "garage": {"crate": 4, "counter": 1, "barrel": 1, "stool": 1},
    "courtyard": {"plant": 5, "bench": 2, "table": 1, "chair": 2},
    "garden": {"plant": 8, "bench": 2},
    "dungeon": {"torch": 5, "barrel": 3, "chest": 1, "table": 1, "stool": 2, "crate": 2},
    "tearoom": {"lowtable": 1, "cushion": 4, "screen": 2, "plant": 1, "picture": 1, "window": 1},
    "loft": {"sofa": 1, "armchair": 2, "lowtable": 1, "rug": 1, "bookshelf": 1, "table": 1, "chair": 4, "lamp": 1, "plant": 3,
             "picture": 1, "window": 3},
}  # fmt: skip
ALWAYS = {"dungeon": "medieval", "tearoom": "japanese", "loft": "industrial"}  # rooms with a style of their own
_LAMPS = {"kitchen": 2, "hall": 3, "loft": 3, "library": 2, "gallery": 3, "courtyard": 0, "garden": 0, "dungeon": 0}


def style_of(name: str) -> Style:
    """The style of a name; ContractError for others."""
    if name not in STYLES:
        raise ContractError(f"the style '{name:.40}' is none of {', '.join(STYLES)}.")
    return STYLES[name]


def furnishing(kind: str, style: str, moods: set[str]) -> dict[str, int]:
    """The things in a room of a kind, and how many of each."""
    one = STYLES[style]
    things = dict(FURNISHINGS.get(kind, {}))
    for label in (*one.extra, *(label for mood in moods for label in MOODS.get(mood, ()))):
        things.setdefault(label, 3 if label == "torch" else 1)
    if one.lamp and kind not in ("garage", "cellar", "corridor"):
        things[one.lamp] = _LAMPS.get(kind, 1)
    return {label: count for label, count in things.items() if count and label not in one.without}


def styled(words: str, style: Style) -> str:
    """The look of a part of furniture in a style: "wood", "cloth" and such are the style's."""
    named = {"wood": style.wood, "dark wood": style.dark_wood, "teal cloth": style.cloth, "orange cloth": style.second_cloth,
             "blue cloth": style.cloth, "metal": style.metal, "white paint": style.paint, "red rug": style.rug,
                 "marble": style.top}  # fmt: skip
    return named.get(words) or words
