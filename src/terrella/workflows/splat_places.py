"""Opens places of Gaussians by name, as worlds and as the content of their pages."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..core.errors import TerrellaError
from ..library import folder_of
from ..serve.place_scene import PlaceScene
from ..space.edits import Edit
from ..space.files import read_scene
from ..space.solids import Solids
from ..worlds.additions import OBSERVED
from ..worlds.folder import open_world
from ..worlds.splat import SplatConfig, SplatWorld
from ..worlds.splat_folder import load_source, merged_loader, world_of

NOTHING_BEHIND = "beside and behind what the picture shows is nothing: `terrella space grow` invents the rest of a room"


@dataclass(frozen=True)
class SpaceResult:
    """What a command made of a place."""

    facts: Mapping[str, Any]  # Figures, names and paths, as JSON has them.
    lines: tuple[str, ...] = field(default=())  # The same for people.

    def to_json(self) -> dict[str, Any]:
        return dict(self.facts)

    def summary(self) -> str:
        return "\n".join(self.lines or (f"{name}: {value}" for name, value in self.facts.items()))


def open_splat(name: str) -> SplatWorld:
    """The world of Gaussians of that name; TerrellaError for another kind of world."""
    world = open_world(folder_of(name))
    if not isinstance(world, SplatWorld):
        raise TerrellaError(
            f"{name} is no world of Gaussians; `terrella space fit` and `space import` make such worlds."
        )
    return world


def page_scene(
    source: SplatWorld, other: Callable[[Edit], PlaceScene] | None = None, walked: bool = True
) -> PlaceScene:
    """A world of Gaussians as the content of a page.

    other:  opens the place that an edit merges.
    walked: if nobody walks in it, floors and walls are not computed from the Gaussians.
    """
    config, seen = source.config, source.provenance == OBSERVED
    collider = Solids(source.solids) if len(source.solids) or not walked else source.occupancy
    return PlaceScene(
        source.name, source.gaussians, seen, source.objects, source.starts, collider, config.body, config.pace,
        config.keep, config.dt_s, source.object_names, other, "; ".join(_notes(source.card)),
        config.collider != "open",
    )  # fmt: skip


def unheeded(card: Mapping[str, Any]) -> list[str]:
    """What of the words of a built place had no effect, in words; `card` is the place's."""
    named = {"not understood": card.get("not_understood"), "no place was left for": card.get("no_place_for")}
    return [
        f"{what}: {', '.join(map(str, words))}" for what, words in named.items() if isinstance(words, list) and words
    ]


def _notes(card: Mapping[str, Any]) -> list[str]:
    """What the page says of a place when it opens: words without effect, or why what was made of a picture may be poor."""
    doubts = card.get("doubts")
    framed = [NOTHING_BEHIND] if "picture" in card else []
    return [*unheeded(card), *framed, *(str(one).rstrip(".") for one in (doubts if isinstance(doubts, list) else ()))]


def unedited_scene(world: str) -> PlaceScene:
    """The content of the page of a world of Gaussians, before all edits."""
    open_splat(world)  # refuses other kinds of worlds
    folder = folder_of(world)
    other = merged_loader(folder)
    scene = page_scene(load_source(folder), lambda edit: page_scene(other(edit), walked=False))
    return replace(scene, collider_after=lambda edits: load_source(folder, edits).collider)


def compared_scene(name: str) -> PlaceScene:
    """The place that a page is compared with: a world of Gaussians after its edits, or a file in its usual axes."""
    file = Path(name)
    return page_scene(world_of(read_scene(file), file.name, {}, SplatConfig()) if file.is_file() else open_splat(name))
