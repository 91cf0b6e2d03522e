"""Changes a part of a place of Gaussians, merges another place into it, or takes edits back. The scene itself stays as it was."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import CheckpointError, TerrellaError
from ..library import folder_of
from ..serve.thing_page import Spot
from ..space.edits import ACTIONS, Edit, apply_edits
from ..space.occupancy import extent
from ..worlds.splat import SplatWorld
from ..worlds.splat_folder import UNDONE_FILE, checked_edits, merge_edit, merged_loader, read_edits, write_edits
from .progress import Progress, silent
from .put_things import put_things
from .results import command
from .splat_places import SpaceResult, open_splat

COARSE_M = 0.3  # in wider cells doors are closed
SELECTIONS = ("box", "sphere", "plane", "object")

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class EditSpaceConfig:
    """One edit: at most one selection, and one action."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Select the box between two corners (x y z x y z, metres). Without a selection the edit applies to
    everything."""
    sphere: tuple[float, float, float, float] | None = None  # Select the sphere around a point (x y z radius, metres).
    plane: tuple[float, float, float, float] | None = None  # Select one side of a plane (a b c d: a x + b y + c z > d).
    object: int | None = None  # Select the object with this number. A wrong one lists the objects.
    move: Triple | None = None  # Move by x y z metres.
    duplicate: Triple | None = None  # Add a copy that is moved by x y z metres.
    turn: float | None = None  # Turn to the left about its middle, in degrees.
    scale: float | None = None  # Scale about its middle by this factor.
    recolour: Triple | None = None  # Paint in one colour (red green blue, 0 to 1).
    delete: bool = False  # Delete the selection.
    merge: str | None = None
    """Add all of this other world of Gaussians. --turn first turns it about its origin, --move then moves it."""
    put: str | None = None
    """Put furniture that words name ("a red chair"): --move is where its foot stands, --turn where it looks (0 south, 90 east)."""
    undo: bool = False  # Undo the last edit.
    redo: bool = False  # Redo the edit that was undone last.
    replay: Path | None = None  # Replace the edits by those of this file (one that the page saved).

    @property
    def selection(self) -> dict[str, Any]:
        """The selections that are given, as an edit's line of JSON has them."""
        return {name: _listed(value) for name in SELECTIONS if (value := getattr(self, name)) is not None}

    @property
    def actions(self) -> dict[str, Any]:
        """The actions that are given, and their values."""
        values = {name: getattr(self, name) for name in (*ACTIONS, "merge", "put", "undo", "redo", "replay")}
        modifiers = ("move", "turn") if self.merge or self.put else ()
        given = {name: value for name, value in values.items() if value is not None and value is not False}
        return {name: value for name, value in given.items() if name not in modifiers}


def edit_space(world: str, config: EditSpaceConfig, *, progress: Progress = silent) -> SpaceResult:
    """Does one edit of a world of Gaussians and writes it to the world's world.edits.jsonl, a line an edit.

    TerrellaError for settings that contradict each other, and for an edit that cannot be done.
    """
    folder = folder_of(world)
    edits, undone = read_edits(folder), read_edits(folder, UNDONE_FILE)
    _check(world, config, edits, undone)
    if config.replay is not None:
        write_edits(folder, checked_edits(folder, _text_of(config.replay)))
    elif config.undo:
        write_edits(folder, edits[:-1], [*undone, edits[-1]])
    else:
        opened = open_splat(world)
        new = [undone[-1]] if config.redo else _new_edits(folder, config, progress)
        _check_object(world, opened, config.object)
        apply_edits(opened.gaussians, new, opened.objects, merged_loader(folder))  # raises if it cannot be done
        write_edits(folder, [*edits, *new], undone[:-1] if config.redo else ())
    return _result(world, config, progress)


def _check(world: str, config: EditSpaceConfig, edits: list[Edit], undone: list[Edit]) -> None:
    selection, actions = config.selection, config.actions
    if len(selection) > 1 or len(actions) != 1:
        raise TerrellaError(
            "an edit has at most one selection (--box, --sphere, --plane or --object) and one action (--move, --delete, ...)."
        )
    if config.delete and not selection:
        raise TerrellaError("say what to delete: --box, --sphere, --plane or --object.")
    if selection and next(iter(actions)) not in ACTIONS:
        raise TerrellaError(
            "--merge, --put, --undo, --redo and --replay change the whole place; leave the selection out."
        )
    if config.undo and not edits or config.redo and not undone:
        raise TerrellaError(f"{world} has no edit to {'undo' if config.undo else 'redo'}.")


def _check_object(world: str, opened: SplatWorld, number: int | None) -> None:
    """TerrellaError, with the objects that there are, for an object that there is not."""
    if number is None or bool((opened.objects == number).any()) and number > 0:
        return
    names = dict(enumerate(opened.object_names, 1))
    listed = [f"{k} {names.get(k, '')}".strip() for k in opened.objects.unique().tolist() if k > 0]
    raise TerrellaError(f"{world} has no object {number}; its objects: {', '.join(listed[:40]) or 'none'}.")


def _new_edits(folder: Path, config: EditSpaceConfig, progress: Progress) -> list[Edit]:
    """The edits as their lines of JSON: one, or one for each thing that is put."""
    if config.put is not None:
        at = config.move or (0.0, 0.0, 0.0)
        put = put_things(folder, config.put, Spot(at, at[2], degrees=config.turn or 0.0))
        if put.unknown:
            progress(f"not understood: {', '.join(put.unknown)}")
        return list(put.edits)
    if config.merge is not None:
        if Path(config.merge).is_file():
            raise TerrellaError(
                f"{config.merge} is a file; `terrella space import` or `space build` makes a world of it first."
            )
        open_splat(config.merge)
        return [merge_edit(folder, folder_of(config.merge), config.move or (0.0, 0.0, 0.0), config.turn or 0.0)]
    [(action, value)] = config.actions.items()
    parameter, _ = ACTIONS[action]
    edit = {"select": config.selection or {"all": True}, "do": action}
    return [{**edit, parameter: _listed(value)} if parameter else edit]


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _result(world: str, config: EditSpaceConfig, progress: Progress) -> SpaceResult:
    facts = {"edits": len(read_edits(folder_of(world)))}
    try:
        after = open_splat(world)
    except CheckpointError as error:
        if not config.undo:
            raise
        progress(str(error))  # an earlier edit is broken: the next --undo takes it back
        return SpaceResult(facts)
    if config.merge and not len(after.solids) and (cell_m := extent(after.gaussians.means)[2]) > COARSE_M:
        progress(
            f"{world} is so large now that floors and walls have cells of {cell_m:.1f} m; --undo takes that back, and "
            f"--scale makes {config.merge} smaller first."
        )
    made = f"{facts['edits']} edit(s), {len(after.gaussians):,} Gaussians"
    more = "" if config.undo else f"; take the last one back: {command('terrella', 'space', 'edit', world, undo=True)}"
    lines = (made + more, f"walk in it: {command('terrella', 'play', world)}")
    return SpaceResult({**facts, "gaussians": len(after.gaussians)}, lines)


def _text_of(path: Path) -> str:
    """The text of a file; TerrellaError if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise TerrellaError(f"{path} cannot be read ({error}); give a world.edits.jsonl.") from error
