"""The commands `terrella space ...`: places as Gaussians: fitted to recordings, taken from files, written for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from .. import progress
from ..learn.recipes.splat import SplatFit, fit_splat
from ..library import folder_of
from ..space.files import read_scene, write_scene
from ..worlds.folder import open_world
from ..worlds.splat import SplatConfig, SplatWorld
from ..worlds.splat_folder import save_splat, world_of
from .say import Json, result

Axes = Literal["rdf", "rub", "flu"]


def fit(data: Positional[str], out: str, config: SplatFit, json: Json = False) -> None:
    """Make a place to walk in of a recording with depth and poses. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: The recording: a folder, or an address (hf://..., s3://...).
        out: Folder of the run; the world lies in OUT/world.
    """
    with progress.shown("fitting") as report:
        facts = fit_splat(data, out, config, report)
    (ours, ours_by), (copied, copied_by) = facts["held_out_db"], facts["nearest_picture_db"]
    text = (
        f"{facts['gaussians']:,} Gaussians from {facts['pictures']} pictures in {facts['seconds']:.0f} s\n"
        f"{facts['held_out']} pictures kept from the fit: {ours:.1f} dB (+-{ours_by:.1f}); the nearest "
        f"picture instead: {copied:.1f} (+-{copied_by:.1f})\nwalk in it: terrella play {facts['world']}"
    )
    result(facts, json, text)


def import_(
    file: Positional[Path],
    out: Path,
    axes: Axes | None = None,
    scale: float = 1.0,
    size: tuple[int, int] = (192, 256),
    json: Json = False,
) -> None:
    """Make a world of a file of Gaussians: .ply, SuperSplat's compressed .ply, or .spz of versions 1 to 3.

    Args:
        file: The file.
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
    gaussians = read_scene(file, axes)
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
    json: Json = False,
) -> None:
    """Write the Gaussians of a world for other tools: .ply or .spz (version 3).

    Args:
        world: A world of Gaussians: its folder, or the run that made it.
        file: The file to write; its ending says which kind.
        axes: Axes of the file; default: rdf for .ply and rub for .spz.
        compressed: SuperSplat's compressed kind of .ply.
    """
    opened = open_splat(world)
    write_scene(opened.gaussians, file, axes, "compressed" if compressed else "")
    facts = {"gaussians": len(opened.gaussians), "bytes": file.stat().st_size, "file": str(file)}
    result(facts, json)


def open_splat(name: str) -> SplatWorld:
    """The world of Gaussians of that name; TerrellaError for another kind of world."""
    from ..core.errors import TerrellaError

    world = open_world(folder_of(name))
    if not isinstance(world, SplatWorld):
        raise TerrellaError(f"{name} is no world of Gaussians; `terrella space fit` and `space import` make such.")
    return world
