"""The light of a place that was built: another time of day or another sun, baked anew. Its layout and its edits stay."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from ..core.errors import ContractError, TerrellaError
from ..library import folder_of
from ..space.layout import ParsedText, build, read_layout
from ..space.layout.daylight import SAME_TIME, TIMES
from ..worlds.splat_folder import UNDONE_FILE, load_source, read_edits, write_edits
from .build_space import LAYOUT_FILE, save_built
from .progress import Progress, silent
from .put_things import relit_things

_PHRASES = {
    "day": "by day", "noon": "at noon", "morning": "in the morning", "sunset": "at sunset", "evening": "in the evening",
    "night": "at night", "overcast": "under clouds",
}  # fmt: skip
_WORDS = "|".join([*TIMES, *SAME_TIME, "clouds"])
_TIME = re.compile(
    rf"(?:^|\s+)(?:at|by|under|in the|in) (?:{_WORDS})\b|(?:^|\s+)(?:on|under) an? (?:{_WORDS}) (?:day|sky)\b",
    re.IGNORECASE,
)
_WEATHER = re.compile(r"(?:\ban? )?\b(?:sunny|cloudy|rainy|overcast)\b +(?=(\w))", re.IGNORECASE)


def light_of(world: str) -> dict[str, Any] | None:
    """The light of a place that was built: `time`, `sun` (its heading and its height in degrees; None: that of the time), and the
    `times` that there are, each with its sun or None. None for any other place."""
    try:
        layout = read_layout(folder_of(world) / LAYOUT_FILE)
    except ContractError:
        return None
    times = {name: daylight.sun for name, daylight in TIMES.items()}
    return {"time": layout.time, "sun": layout.sun, "times": times}


def relight_space(world: str, light: Mapping[str, Any], *, progress: Progress = silent) -> None:
    """Builds a place again by another light: {"time": a name, "sun": [heading, height] in degrees, or None}. Edits stay: objects
    keep their numbers. Furniture that was put is built again, too, and a time in the place's name changes. TerrellaError for other
    places and for no light, or where the layout is no longer the place's."""
    if light_of(world) is None:
        raise TerrellaError(f"{world} was not built of words or a layout, so its light cannot be changed.")
    folder = folder_of(world)
    source = load_source(folder)
    document = {**json.loads((folder / LAYOUT_FILE).read_text()), "time": light.get("time"), "sun": light.get("sun")}
    layout = read_layout(document)
    layout = replace(layout, name=name_at(layout.name, layout.time))
    place = build(layout, int(source.card.get("gaussians_asked", len(source.gaussians))), progress)
    if list(place.names) != list(source.object_names):
        raise TerrellaError(f"{folder / LAYOUT_FILE} was changed since; `terrella space build` builds the place of it.")
    parsed = ParsedText(layout, asdict(layout), (), ())
    put = [relit_things(folder, read_edits(folder, *file), layout.time) for file in ((), (UNDONE_FILE,))]
    save_built(place, parsed, folder, source.config.size, dict(source.card), keep_edits=True)
    write_edits(folder, *put)


def name_at(name: str, time: str) -> str:
    """A place's name at another time: "a sunny loft" at night is "a loft at night". A name without a time, or with
    several, stays."""

    def without(match: re.Match[str]) -> str:
        article = re.match("an? ", match[0], re.IGNORECASE)
        return ("an " if match[1] in tuple("aeiouAEIOU") else "a ") if article else ""

    shorter, times = _TIME.subn("", name)
    shorter, weather = _WEATHER.subn(without, shorter)
    return f"{shorter.strip()} {_PHRASES[time]}".strip() if times < 2 and times + weather else name
