"""What `terrella space export` writes of a world beside files of Gaussians: GLB, a panorama (PNG), a film (MP4)."""

from __future__ import annotations

import io
import json as json_text
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

from ..core.errors import DatasetError, TerrellaError
from ..space.camera import planar_pose
from ..space.files import AXES, replace_whole
from ..space.files.glb import encode_gaussians, encode_mesh
from ..space.mesh import collider_mesh, fused, viewpoints
from ..space.raster import rasterise
from ..space.raster.move import turned
from ..worlds.splat import SplatWorld

ENDINGS = (".glb", ".png", ".mp4")
Kind = Literal["mesh", "collider", "gaussians"]
CELL_M, FILM_S = 0.05, 8.0  # unless said
OPTIONS = {  # and the files that each is of
    "axes": (".ply", ".spz"),
    "compressed": (".ply",),
    "spz": (".spz",),
    "kind": (".glb",),
    "cell": (".glb",),
    "seconds": (".mp4",),
    "path": (".mp4",),
}
RATE = 30  # pictures of a film a second
MOST_FACES = 5_000_000


def check_options(file: Path, given: Sequence[str]) -> None:
    """TerrellaError for options that do not belong to files that end so."""
    for name in given:
        if file.suffix.lower() not in OPTIONS[name]:
            raise TerrellaError(f"--{name} is of {' and '.join(OPTIONS[name])} files; leave it out for {file.name}.")


def write_other(
    world: SplatWorld, file: Path, kind: Kind, cell_m: float, seconds: float, path: Path | None
) -> Mapping[str, Any]:
    """Writes `file` of its ending's kind, replacing it whole; what to say of it."""
    if not len(world.gaussians):
        raise DatasetError(f"{world.name} has no Gaussian left; undo an edit.")
    if not all(bool(part.isfinite().all()) for part in vars(world.gaussians).values()):
        raise DatasetError(
            f"{world.name} has Gaussians whose numbers are not finite; undo an edit, or import its file again."
        )
    suffix = file.suffix.lower()
    with torch.no_grad():
        if suffix == ".glb":
            data, facts = _glb(world, kind, cell_m)
        elif suffix == ".png":
            data, facts = _panorama(world)
        else:
            data, facts = _film(world, seconds, path)
    replace_whole(file, lambda staged: staged.write_bytes(data))
    return {**facts, "bytes": len(data), "file": str(file)}


def _glb(world: SplatWorld, kind: Kind, cell_m: float) -> tuple[bytes, dict[str, Any]]:
    rot = torch.tensor(AXES["rub"], dtype=torch.float32)
    if kind == "gaussians":
        return encode_gaussians(turned(world.gaussians, rot), world.name), {"gaussians": len(world.gaussians)}
    if not 0.005 <= cell_m <= 10:
        raise TerrellaError("--cell is from 0.005 to 10 metres.")
    if kind == "collider":
        mesh = collider_mesh(world.collider)
    else:
        eyes = viewpoints(world.gaussians, world.collider, world.starts, world.config.body)
        mesh = fused(world.gaussians, eyes, cell_m)
    if len(mesh.faces) > MOST_FACES:
        raise TerrellaError(
            f"the mesh has {len(mesh.faces):,} faces, {MOST_FACES:,} is the most; ask for a larger --cell."
        )
    facts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    return encode_mesh(replace(mesh, vertices=mesh.vertices @ rot.T), world.name), facts


def _panorama(world: SplatWorld, height: int = 1024) -> tuple[bytes, dict[str, Any]]:
    """All that is around where one begins, equirectangular, twice as wide as high."""
    from PIL import Image

    seen = rasterise(world.gaussians, world.starts[:1], None, (height, 2 * height)).rgb[0]
    picture = (seen.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0)
    buffer = io.BytesIO()
    Image.fromarray(picture.numpy()).save(buffer, "PNG", optimize=True)
    return buffer.getvalue(), {"size": [2 * height, height], "pose": [round(v, 3) for v in world.starts[0].tolist()]}


def _film(world: SplatWorld, seconds: float, path: Path | None) -> tuple[bytes, dict[str, Any]]:
    import simplejpeg

    from ..serve.clip import make_clip

    if not 0.5 <= seconds <= 600:
        raise TerrellaError("--seconds is from 0.5 to 600.")
    poses = _along(_stations(world, path), round(seconds * RATE))
    height = 480
    size = (height, round(height * world.config.size[1] / world.config.size[0]) // 2 * 2)
    pictures = []
    for pose in poses:
        seen = rasterise(world.gaussians, pose[None], world.config.camera, size).rgb[0]
        picture = (seen.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
        pictures.append((simplejpeg.encode_jpeg(picture, quality=95, colorspace="RGB", colorsubsampling="444"),))
    return make_clip(pictures, 1 / RATE), {"pictures": len(pictures), "size": list(size[::-1])}


def _stations(world: SplatWorld, path: Path | None) -> torch.Tensor:
    """Places and headings [S, 4] (metres, radians) that a film goes through: those of a file, or around each start."""
    if path is None:
        found = []
        for start in world.starts[:6]:
            heading = 2 * math.atan2(float(start[6]), float(start[3]))
            found += [[*start[:3].tolist(), heading + turn * math.pi / 2] for turn in range(5)]
        return torch.tensor(found)
    try:
        given = torch.tensor(json_text.loads(path.read_text()), dtype=torch.float32)
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{path} cannot be read as a path ({error}); give a list of [x, y, z, degrees].") from error
    if given.ndim != 2 or given.shape[1] != 4 or len(given) < 2 or not bool(given.isfinite().all()):
        raise DatasetError(f"{path} is a list of two or more [x, y, z, degrees]; its shape is {list(given.shape)}.")
    return torch.cat([given[:, :3], given[:, 3:].deg2rad()], 1)


def _along(stations: torch.Tensor, count: int) -> torch.Tensor:
    """`count` poses evenly from the first station to the last, easing in and out of each."""
    at = torch.linspace(0, len(stations) - 1, count).clamp_max(len(stations) - 1 - 1e-4)
    first = at.long()
    share = at - first
    share = (share * share * (3 - 2 * share))[:, None]
    turn = (stations[1:, 3] - stations[:-1, 3] + math.pi) % (2 * math.pi) - math.pi
    step = torch.cat([stations[1:, :3] - stations[:-1, :3], turn[:, None]], 1)
    return planar_pose(*(stations[first] + share * step[first]).unbind(1))
