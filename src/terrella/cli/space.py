"""The commands `terrella space ...`: places of Gaussians, fitted to recordings, built, read from files, edited and exported."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..learn.recipes.splat import SplatFit
from ..serve.place_page import serve_place
from ..workflows.build_space import (
    BuildSpaceConfig,
    ImportSpaceConfig,
    build_space,
    fit_space,
    import_space,
)
from ..workflows.edit_space import EditSpaceConfig, edit_space
from ..workflows.editable_place import editable_place
from ..workflows.export_space import ExportSpaceConfig, export_space
from ..workflows.grow_space import GrowSpaceConfig, grow_space
from ..workflows.lift_space import LiftSpaceConfig, lift_space
from ..workflows.progress import stage
from ..workflows.results import command
from .say import Host, Json, PlaceName, Port, RecordingName, Token, opened, say, show


def fit(
    data: RecordingName, out: str, config: SplatFit, watch: bool = False, port: Port = 8767, json: Json = False
) -> None:
    """Make a place to walk in from a recording or from pictures. Ctrl-C stops it at any time; the same command continues.

    Args:
        data: A recording with poses (a folder, or an address: hf://..., s3://...), a folder of pictures with a transforms.json or
            COLMAP's sparse/0, or a folder of plain pictures or a video, whose poses COLMAP finds.
        out: Folder of the run; the world is saved in OUT/world.
        watch: Show the place on a page meanwhile, sharper every few seconds.
    """
    show(fit_space(data, out, config, watch_port=port if watch else None, progress=say), json, _viewing(out))


def build(
    source: Annotated[str | None, Positional, arg(metavar="[WORDS|LAYOUT]")] = None,
    *,
    out: Path,
    config: BuildSpaceConfig,
    json: Json = False,
) -> None:
    """Make a place to walk in from words, from a layout.json (rooms, doors, windows, stairs, furniture), or from the triangles of
    a .glb or .gltf. The same seed gives the same bytes.

    Args:
        source: Words ("a long room with two pillars and a red door"), or the layout.json, .glb or .gltf.
        out: Folder of the world.
    """
    show(build_space(source, out, config), json, _viewing(out))


def lift(
    picture: Annotated[Path, Positional, arg(metavar="PICTURE")], out: Path, config: LiftSpaceConfig, json: Json = False
) -> None:
    """Make a place to walk in from one picture (a photograph, a drawing, a game's screenshot) or one panorama. A network estimates
    depth, lens, and what lies behind edges.

    Args:
        picture: The picture: JPEG, PNG, WebP, GIF (its first frame), TIFF or BMP; or a panorama of 2:1.
        out: Folder of the world.
    """
    show(lift_space(picture, out, config), json, _viewing(out))


def grow(world: PlaceName, config: GrowSpaceConfig, json: Json = False) -> None:
    """Invent what a place does not know: walls, floor and ceiling of a room go on where nothing was seen. Each step is one edit,
    which `space edit --undo` takes back; the same command goes on.

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
    """
    show(grow_space(world, config, progress=say), json, _viewing(world))


def import_(
    file: Annotated[Path, Positional, arg(metavar="FILE")], out: Path, config: ImportSpaceConfig, json: Json = False
) -> None:
    """Make a world from a file of Gaussians: .ply, SuperSplat's compressed .ply, .spz of versions 1 to 4, .sog, or .glb; or from
    the triangles of a .glb or .gltf.

    Args:
        file: The file; for an unpacked .sog its folder.
        out: Folder of the world.
    """
    show(import_space(file, out, config), json, _viewing(out))


def export(
    world: PlaceName,
    file: Annotated[Path, Positional, arg(metavar="FILE")],
    config: ExportSpaceConfig,
    json: Json = False,
) -> None:
    """Write a world for other tools: Gaussians as .ply, .spz or .glb, a mesh (.glb), a panorama (.png), a film (.mp4), or a page
    (.html).

    The page is one file that draws, walks and edits without a server; it holds the place before its edits, and the edits.

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
        file: The file to write. Its ending decides the format.
    """
    with stage("drawing", say) as drawing:
        result = export_space(world, file, config, drawing)
    show(result, json)


def view(
    world: PlaceName,
    beside: str | None = None,
    port: Port = 8767,
    host: Host = "127.0.0.1",
    token: Token = None,
    json: Json = False,
) -> None:
    """Walk in a place and edit it by hand, on a page that your browser draws. Edits saved there are saved in the world.

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
        beside: Another world of Gaussians, or a file of them (as `space import` reads them), to compare it with. The page can
            also merge that world into this one.
    """
    place = editable_place(world, beside)

    def ready(address: str) -> None:
        opened(place.scene.name, address, {"gaussians": len(place.scene.gaussians)}, json)

    serve_place(place, port, host, token, ready)


def edit(world: PlaceName, config: EditSpaceConfig, json: Json = False) -> None:
    """Change a part of a world of Gaussians. Each edit is a line of its world.edits.jsonl; the scene itself stays as it was.

    Args:
        world: The folder of the world, or the run that made it.
    """
    show(edit_space(world, config, progress=say), json, _viewing(world))


def _viewing(place: str | Path) -> str:
    return command("terrella", "space", "view", place)
