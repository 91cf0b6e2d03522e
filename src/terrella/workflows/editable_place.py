"""Opens a place of Gaussians for its page: what is edited there is saved in the place."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.errors import ContractError
from ..library import folder_of
from ..serve.place_page import EditablePlace
from ..serve.place_scene import PlaceScene
from ..space.edits import Edit
from ..worlds.splat_folder import checked_edits, merge_edit, read_edits, write_edits
from .export_space import exported_file
from .put_things import put_things
from .relight_space import light_of, relight_space
from .splat_places import compared_scene, unedited_scene


def editable_place(world: str, beside: str | None = None) -> EditablePlace:
    """A world of Gaussians as a page edits it: edits that are saved on the page are saved in the world's folder.

    beside: another world, or a file of Gaussians, to compare it with. A world can be merged on the page, too.
    """
    folder = folder_of(world)
    return EditablePlace(
        unedited_scene(world),
        lambda: read_edits(folder),
        lambda text: write_edits(folder, checked_edits(folder, text)),
        None if beside is None else compared_scene(beside),
        None if beside is None or Path(beside).is_file() else _merge_of(folder, beside),
        lambda words, spot: put_things(folder, words, spot),
        lambda wish, drawing: exported_file(world, wish, drawing),
        lambda: light_of(world),
        None if light_of(world) is None else lambda light: _relit(world, light),
        hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
    )


def _relit(world: str, light: Mapping[str, Any]) -> PlaceScene:
    """The place as it looks by another light, which is saved."""
    relight_space(world, light)
    return unedited_scene(world)


def _merge_of(folder: Path, other: str) -> Edit | None:
    """The edit that merges a world; None if one of the two contains the other."""
    try:
        return merge_edit(folder, folder_of(other))
    except ContractError:
        return None
