"""The commands `terrella space ...`: places as Gaussians: fitted to recordings, taken from files, written for other tools."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from .. import progress
from ..learn.recipes.splat import SplatFit, Watch, fit_splat
from ..library import folder_of
from ..space.edits import ACTIONS, Edit, edited
from ..space.files import read_scene, replace_whole, write_scene
from ..space.files.gltf_scene import GLTF_ENDINGS, GltfScene, read_gltf
from ..space.files.spz import Version
from ..space.occupancy import extent
from ..space.solids import Solids
from ..worlds.additions import OBSERVED
from ..worlds.folder import open_world
from ..worlds.splat import SplatConfig, SplatWorld
from ..worlds.splat_folder import (
    UNDONE_FILE,
    checked_edits,
    merging,
    other_of,
    read_edits,
    save_splat,
    source_of,
    world_of,
    write_edits,
)
from .say import Host, Json, Port, Token, result, say
from .space_build import COUNT, of_scene
from .space_export import CELL_M, ENDINGS, FILM_S, Kind, check_options, write_other

if TYPE_CHECKING:
    from ..serve.place_page import PlaceScene

COARSE_M = 0.3  # cells that are wider let nobody through doors
Axes = Literal["rdf", "rub", "flu"]


def fit(
    data: Positional[str], out: str, config: SplatFit, watch: bool = False, port: Port = 8767, json: Json = False
) -> None:
    """Make a place to walk in of a recording or of pictures. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: A recording with poses (a folder, or an address: hf://..., s3://...), a folder of pictures with a transforms.json or
            COLMAP's sparse/0, or a folder of plain pictures or a video, of which COLMAP finds the poses.
        out: Folder of the run; the world lies in OUT/world.
        watch: Show the place on a page meanwhile, sharper every few seconds.
    """
    with contextlib.ExitStack() as stack:
        seen = stack.enter_context(_watching(port)) if watch else None
        report = stack.enter_context(progress.shown("fitting"))
        facts = fit_splat(data, out, config, report, seen)
    (ours, ours_by), (copied, copied_by) = facts["held_out_db"], facts["nearest_picture_db"]
    text = (
        f"{facts['gaussians']:,} Gaussians from {facts['pictures']} pictures in {facts['seconds']:.0f} s\n"
        f"{facts['held_out']} pictures kept from the fit: {ours:.1f} dB (+-{ours_by:.1f}); the nearest "
        f"picture instead: {copied:.1f} (+-{copied_by:.1f})\nwalk in it: terrella play {facts['world']}"
    )
    if facts["left_out"]:
        text += f"\nleft out, blurred or without overlap: {', '.join(facts['left_out'])}"
    result(facts, json, text)


@contextlib.contextmanager
def _watching(port: int) -> Iterator[Watch]:
    """A page on this machine that shows a fit."""
    from ..serve.live_place import live_page

    with live_page("127.0.0.1", port, lambda address: say(f"watch it at {address}")) as show:
        yield lambda make, facts: show(lambda: shown_place(make()), facts)


def import_(
    file: Positional[Path],
    out: Path,
    axes: Axes | None = None,
    scale: float = 1.0,
    size: tuple[int, int] = (192, 256),
    json: Json = False,
) -> None:
    """Make a world of a file of Gaussians: .ply, SuperSplat's compressed .ply, .spz of versions 1 to 4, .sog, or .glb; or of the
    triangles of a .glb or .gltf.

    Args:
        file: The file; of a .sog that was unpacked its folder.
        out: Folder of the world.
        axes: The file's axes: rdf (x right, y down, z forward: usual in .ply), rub (x right, y up, z back: usual in .spz), or flu
            (x forward, y left, z up: ours).
        scale: Metres of a unit of the file.
        size: Height and width of the pictures.
    """
    import torch

    from ..core.errors import TerrellaError
    from ..space.raster.move import turned

    if not 0 < scale < float("inf") or min(size) < 8 or max(size) > 4096:
        raise TerrellaError("--scale is above 0, and --size from 8 to 4096 pixels a side.")
    if file.suffix.lower() in GLTF_ENDINGS and axes is None:
        scene = read_gltf(file, scale)
        if isinstance(scene, GltfScene):
            return of_scene(scene, file, out, COUNT, size, json)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        gaussians = read_scene(file, axes)
    for warning in warned:
        say(f"{file}: {warning.message}")
    if scale != 1:
        gaussians = turned(gaussians, torch.eye(3), scale)
    lens = (0.5, 0.5 * size[1] / size[0], 0.5, 0.5)
    world = world_of(gaussians, file.stem, {"file": file.name}, SplatConfig(lens, size))
    save_splat(world, out)
    result({"gaussians": len(gaussians), "world": str(out)}, json, f"{len(gaussians):,} Gaussians; terrella play {out}")


def export(
    world: Positional[str],
    file: Positional[Path],
    axes: Axes | None = None,
    compressed: bool = False,
    spz: Version = 3,
    kind: Kind = "mesh",
    cell: float = CELL_M,
    seconds: float = FILM_S,
    path: Path | None = None,
    json: Json = False,
) -> None:
    """Write a world for other tools: Gaussians as .ply or .spz, .glb, a panorama (.png), a film (.mp4), a page (.html).

    The page, to walk in and edit, is one file that draws by itself, also from a disk;
    it holds the place as it was before its edits, and these.

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
        file: The file to write; its ending says which kind.
        axes: Axes of the file; default: rdf for .ply and rub for .spz.
        compressed: SuperSplat's compressed kind of .ply.
        spz: Version of an .spz: 3, which Spark opens, or 4, which PlayCanvas' engine opens.
        kind: What a .glb holds: a mesh with colours, the mesh of what stops bodies, or the Gaussians (KHR_gaussian_splatting).
        cell: Metres of a cell of the mesh.
        seconds: Of the film.
        path: The film's way: a JSON list of [x, y, z, degrees]. Default: a look around from each start.
    """
    given = {
        "axes": axes, "compressed": compressed, "spz": spz != 3, "kind": kind != "mesh", "cell": cell != CELL_M,
        "seconds": seconds != FILM_S, "path": path,
    }  # fmt: skip
    check_options(file, [name for name, said in given.items() if said])
    if file.suffix.lower() == ".html":
        from ..serve.place_page import PlacePage

        place, edits = place_of(world), read_edits(folder_of(world))
        content = PlacePage(place).html(edits)
        replace_whole(file, lambda staged: staged.write_bytes(content))
        return result({"gaussians": len(place.gaussians), "bytes": file.stat().st_size, "file": str(file)}, json)
    opened = open_splat(world)
    if file.suffix.lower() in ENDINGS:
        result(write_other(opened, file, kind, cell, seconds, path), json)
        return
    write_scene(opened.gaussians, file, axes, "compressed" if compressed else "", spz)
    facts = {"gaussians": len(opened.gaussians), "bytes": file.stat().st_size, "file": str(file)}
    result(facts, json)


def view(
    world: Positional[str],
    beside: str | None = None,
    port: Port = 8767,
    host: Host = "127.0.0.1",
    token: Token = None,
    json: Json = False,
) -> None:
    """Walk in a place and edit it by hand, on a page that your browser draws. Edits that are saved there are the world's own.

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
        beside: Another world of Gaussians, or a file of them (as `space import` reads them), that the page compares it with; a
            world can be merged there, too.
    """
    from ..serve.place_page import EditablePlace, serve_place

    folder, place = folder_of(world), place_of(world)

    def save(text: str) -> None:
        write_edits(folder, checked_edits(folder, text))

    def ready(address: str) -> None:
        result({"address": address, "gaussians": len(place.gaussians)}, json, f"{place.name}: open {address}")

    other = None if beside is None else compared_with(beside)
    merge = None if beside is None or Path(beside).is_file() else _mergeable(folder, beside)
    serve_place(EditablePlace(place, lambda: read_edits(folder), save, other, merge), port, host, token, ready)


def _mergeable(folder: Path, other: str) -> Edit | None:
    """The edit that merges a world; None where one of them holds the other."""
    from ..core.errors import ContractError

    try:
        return merging(folder, folder_of(other))
    except ContractError:
        return None


def compared_with(name: str) -> PlaceScene:
    """What a page compares a place with: a world of Gaussians as its edits have it, or a file in the axes usual for its kind."""
    file = Path(name)
    return shown_place(world_of(read_scene(file), file.name, {}, SplatConfig()) if file.is_file() else open_splat(name))


def place_of(world: str) -> PlaceScene:
    """What a page shows of a world of Gaussians: as it was before its edits."""
    open_splat(world)  # refuses what is none
    other = other_of(folder_of(world))
    return shown_place(source_of(folder_of(world)), lambda edit: shown_place(other(edit), walked=False))


def shown_place(
    source: SplatWorld, other: Callable[[Edit], PlaceScene] | None = None, walked: bool = True
) -> PlaceScene:
    """A world of Gaussians as a page takes it; `other` opens what an edit merges. Where nobody walks no floors and walls are read
    off the Gaussians."""
    from ..serve.place_page import PlaceScene

    config, seen = source.config, source.provenance == OBSERVED
    collider = Solids(source.solids) if len(source.solids) or not walked else source.occupancy
    return PlaceScene(
        source.name, source.gaussians, seen, source.objects, source.starts, collider, config.body, config.pace,
        config.keep, config.dt_s, source.object_names, other,
    )  # fmt: skip


def edit(
    world: Positional[str],
    box: tuple[float, float, float, float, float, float] | None = None,
    sphere: tuple[float, float, float, float] | None = None,
    plane: tuple[float, float, float, float] | None = None,
    object: int | None = None,
    move: tuple[float, float, float] | None = None,
    duplicate: tuple[float, float, float] | None = None,
    turn: float | None = None,
    scale: float | None = None,
    recolour: tuple[float, float, float] | None = None,
    delete: bool = False,
    merge: str | None = None,
    undo: bool = False,
    redo: bool = False,
    replay: Path | None = None,
    json: Json = False,
) -> None:
    """Change a part of a world of Gaussians. Each edit is a line of its world.edits.jsonl; the scene itself stays as it was.

    Args:
        world: The folder of the world, or the run that made it.
        box: What lies between two corners (x y z x y z, metres). Without a selection: all.
        sphere: What lies around a place (x y z radius).
        plane: What lies before a plane (a b c d: a x + b y + c z > d).
        object: The object of that number (`space view` shows it).
        move: By so many metres (x y z).
        duplicate: A second one, so many metres away (x y z).
        turn: By so many degrees about its middle, to the left.
        scale: By a factor about its middle.
        recolour: To one colour (red green blue, 0 to 1).
        delete: Take it away.
        merge: Add all of this other world of Gaussians: with --turn first turned about its origin, with --move then moved.
        undo: Take the last edit back.
        redo: Do again what was taken back last.
        replay: Take the edits of this file (one that the page saved) in place of those that the world has.
    """
    from ..core.errors import TerrellaError

    folder = folder_of(world)
    edits, undone = read_edits(folder), read_edits(folder, UNDONE_FILE)
    given = {"box": box, "sphere": sphere, "plane": plane, "object": object}
    places = {name: list(v) if isinstance(v, tuple) else v for name, v in given.items() if v is not None}
    asked: dict[str, Any] = {
        "move": move, "duplicate": duplicate, "turn": turn, "scale": scale, "recolour": recolour, "delete": delete or None,
    }  # fmt: skip
    deeds = [name for name, value in asked.items() if value is not None and not (merge and name in ("move", "turn"))]
    deeds += ["merge"] * (merge is not None)
    if len(places) > 1 or len(deeds) + undo + redo + (replay is not None) != 1:
        raise TerrellaError(
            "an edit is of one place (--box, --sphere, --plane or --object) and does one thing (--move, --delete, ...)."
        )
    if delete and not places:
        raise TerrellaError("say what to delete: --box, --sphere, --plane or --object.")
    if places and (merge or not deeds):
        raise TerrellaError("--merge, --undo, --redo and --replay are of the whole place; leave the selection out.")
    if undo and not edits or redo and not undone:
        raise TerrellaError(f"{world} has no edit to {'undo' if undo else 'redo'}.")
    if replay is not None:
        write_edits(folder, checked_edits(folder, read_text(replay)))
    elif undo:
        write_edits(folder, edits[:-1], [*undone, edits[-1]])
    else:
        opened = open_splat(world)
        if redo:
            new = undone[-1]
        elif merge is not None:
            new = _merging(folder, merge, move or (0.0, 0.0, 0.0), turn or 0.0)
        else:
            new = {"select": places or {"all": True}, "do": deeds[0]}
            if name := ACTIONS[deeds[0]][0]:
                new[name] = list(value) if isinstance(value := asked[deeds[0]], tuple) else value
        edited(opened.gaussians, [new], opened.objects, other_of(folder))  # refuses what cannot be done
        write_edits(folder, [*edits, new], undone[:-1] if redo else ())
    result(_after(world, merge, undo), json)


def _merging(folder: Path, merge: str, by: tuple[float, float, float], degrees: float) -> Edit:
    """The edit that merges the world of that name; TerrellaError for what is none."""
    from ..core.errors import TerrellaError

    if Path(merge).is_file():
        raise TerrellaError(f"{merge} is a file; `terrella space import` or `space build` makes a world of it first.")
    open_splat(merge)
    return merging(folder, folder_of(merge), by, degrees)


def _after(world: str, merge: str | None, undo: bool) -> dict[str, int]:
    """What is said of a world after an edit."""
    from ..core.errors import CheckpointError

    facts = {"edits": len(read_edits(folder_of(world)))}
    try:
        after = open_splat(world)
    except CheckpointError as error:
        if not undo:
            raise
        say(str(error))  # an edit before that one, to be taken back next
        return facts
    if merge and not len(after.solids) and (cell_m := extent(after.gaussians.means)[2]) > COARSE_M:
        say(
            f"{world} is so large now that floors and walls are read in cells of {cell_m:.1f} m; --undo takes that back, and "
            f"--scale makes {merge} smaller first."
        )
    return {**facts, "gaussians": len(after.gaussians)}


def read_text(path: Path) -> str:
    """What a file says; TerrellaError where it cannot be read."""
    from ..core.errors import TerrellaError

    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise TerrellaError(f"{path} cannot be read ({error}); give a world.edits.jsonl.") from error


def open_splat(name: str) -> SplatWorld:
    """The world of Gaussians of that name; TerrellaError for another kind of world."""
    from ..core.errors import TerrellaError

    world = open_world(folder_of(name))
    if not isinstance(world, SplatWorld):
        raise TerrellaError(f"{name} is no world of Gaussians; `terrella space fit` and `space import` make such.")
    return world
