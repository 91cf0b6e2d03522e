"""The light of a place that was built: another time of day or another sun, baked anew. Its layout and its edits stay."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from ..core.errors import ContractError, TerrellaError
from ..library import folder_of
from ..space.layout import ParsedText, build, read_layout
from ..space.layout.daylight import TIMES
from ..worlds.splat_folder import load_source
from .build_space import LAYOUT_FILE, save_built
from .progress import Progress, silent


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
    keep their numbers. TerrellaError for other places and for no light, or where the layout is no longer the place's."""
    if light_of(world) is None:
        raise TerrellaError(f"{world} was not built of words or a layout, so its light cannot be changed.")
    folder = folder_of(world)
    source = load_source(folder)
    document = {**json.loads((folder / LAYOUT_FILE).read_text()), "time": light.get("time"), "sun": light.get("sun")}
    layout = read_layout(document)
    place = build(layout, int(source.card.get("gaussians_asked", len(source.gaussians))), progress)
    if list(place.names) != list(source.object_names):
        raise TerrellaError(f"{folder / LAYOUT_FILE} was changed since; `terrella space build` builds the place of it.")
    parsed = ParsedText(layout, asdict(layout), (), ())
    save_built(place, parsed, folder, source.config.size, dict(source.card), keep_edits=True)
