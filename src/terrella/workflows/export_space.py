"""Writes a place for other tools: Gaussians (PLY, SPZ, GLB), a mesh (GLB), a panorama (PNG), a film (MP4) or a page (HTML)."""

import io
import json
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import simplejpeg
import torch
import torch.nn.functional as F
from PIL import Image

from ..core.errors import DatasetError, TerrellaError
from ..library import folder_of
from ..serve.clip import make_clip
from ..serve.place_page import PlacePage
from ..space.camera import planar_pose, tilted_pose
from ..space.files import AXES, replace_whole, write_scene
from ..space.files.glb import encode_gaussians, encode_mesh
from ..space.files.spz import Version
from ..space.mesh import collider_mesh, fused, viewpoints
from ..space.raster import Gaussians, rasterise
from ..space.raster.move import transform
from ..worlds.splat import SplatWorld
from ..worlds.splat_folder import read_edits
from .splat_places import SpaceResult, open_splat, unedited_scene

OPTIONS = {  # the files that each option is for
    "axes": (".ply", ".spz"),
    "compressed": (".ply",),
    "spz": (".spz",),
    "kind": (".glb",),
    "cell": (".glb",),
    "ground": (".ply", ".spz", ".glb"),
    "seconds": (".mp4",),
    "path": (".mp4",),
    "aspect": (".mp4",),
    "exposure": (".mp4", ".png"),
    "at": (".png",),
}
FRAMES_PER_S = 30  # of a film
STARTS = 0.12  # share of a film in which the camera gathers speed, and comes to rest
MOST_STOPS, GAMMA = 4.0, 2.2  # of an exposure; of the pictures
EXPORTS = ("spz", "ply", "glb", "gaussians.glb", "mp4")  # what the page of a place downloads
LONGEST_S = 120  # of a film that the page asks for
MOST_FACES = 5_000_000
Drawing = Callable[[int, int], None]  # pictures of a film that are drawn so far, and in all


@dataclass(frozen=True)
class ExportSpaceConfig:
    """How a place is written."""

    axes: Literal["rdf", "rub", "flu"] | None = None  # Axes of the file; default: rdf for .ply and rub for .spz.
    compressed: bool = False  # Write SuperSplat's compressed form of .ply.
    spz: Version = 3  # Version of an .spz: 3, which Spark opens, or 4, which PlayCanvas' engine opens.
    kind: Literal["mesh", "collider", "gaussians"] = "mesh"
    """Content of a .glb: a mesh with colours, the mesh that stops bodies, or the Gaussians (KHR_gaussian_splatting)."""
    cell: float = 0.05  # Size of a cell of the mesh, in metres.
    ground: bool = False  # Move the floor below the first start to height 0.
    seconds: float = 8.0  # Duration of the film, in seconds.
    path: Path | None = None
    """Path of the film: a JSON list of [x, y, z, degrees] or [x, y, z, degrees, degrees upwards]. Default: a look around from
    each start."""
    aspect: float | None = None  # Width of the film over its height. Default: that of the world's pictures.
    exposure: float = 0.0  # Makes film and panorama brighter, in stops; negative: darker.
    at: tuple[float, float, float] | None = None
    """Viewpoint of a panorama (.png): x y z in metres; its middle looks along x. Default: the first start and its heading."""


def export_space(
    world: str, file: Path, config: ExportSpaceConfig, drawing: Drawing = lambda done, total: None
) -> SpaceResult:
    """Writes a world of Gaussians to `file`, whose ending decides the format. The file is replaced as a whole. drawing: called
    before each picture of a film with their number so far and in all; an error that it raises ends the film."""
    suffix = file.suffix.lower()
    for field in fields(config):
        if getattr(config, field.name) != field.default and suffix not in OPTIONS[field.name]:
            kinds = " and ".join(OPTIONS[field.name])
            raise TerrellaError(f"--{field.name} is for {kinds} files; leave it out for {file.name}.")
    if suffix == ".glb" and config.kind != "mesh" and config.cell != ExportSpaceConfig.cell:
        raise TerrellaError(f"--cell is for a .glb of --kind mesh; leave it out for --kind {config.kind}.")
    if not abs(config.exposure) <= MOST_STOPS or config.aspect is not None and not 0.2 <= config.aspect <= 5:
        raise TerrellaError(f"--exposure is from -{MOST_STOPS:g} to {MOST_STOPS:g} stops, and --aspect from 0.2 to 5.")
    if suffix == ".html":
        scene = unedited_scene(world)
        content, facts = PlacePage(scene).html(read_edits(folder_of(world))), {"gaussians": len(scene.gaussians)}
    elif suffix in (".glb", ".png", ".mp4"):
        content, facts = _drawn(open_splat(world), suffix, config, drawing)
    else:
        opened = open_splat(world)
        shown = _opaque(opened.gaussians)
        shown = replace(shown, means=shown.means - _ground(opened, config))
        write_scene(shown, file, config.axes, "compressed" if config.compressed else "", config.spz)
        content, facts = None, {"gaussians": len(shown)}
    if content is not None:
        replace_whole(file, lambda staged: staged.write_bytes(content))
    return SpaceResult({**facts, "bytes": file.stat().st_size, "file": str(file)})


def exported_file(world: str, wish: Mapping[str, Any], drawing: Drawing = lambda done, total: None) -> bytes:
    """The content of a file that the page of a place asks for: {"kind": one of EXPORTS, and of a film "path", "seconds" and
    "exposure"}. drawing: as of `export_space`. TerrellaError for what cannot be written."""
    kind = wish.get("kind")
    if kind not in EXPORTS:
        raise TerrellaError(f"the page writes {', '.join(EXPORTS)}; reload it.")
    with tempfile.TemporaryDirectory() as folder:
        file, path = Path(folder) / f"place.{kind.split('.')[-1]}", Path(folder) / "path.json"
        config = ExportSpaceConfig(kind="gaussians") if kind == "gaussians.glb" else ExportSpaceConfig()
        if kind == "mp4":
            seconds, exposure = wish.get("seconds"), wish.get("exposure")
            if not isinstance(seconds, int | float) or not isinstance(exposure, int | float) or seconds > LONGEST_S:
                raise TerrellaError(f"a film has seconds, {LONGEST_S} at most, and an exposure in stops.")
            path.write_text(json.dumps(wish.get("path")))
            config = ExportSpaceConfig(seconds=seconds, path=path, aspect=16 / 9, exposure=exposure)
        export_space(world, file, config, drawing)
        return file.read_bytes()


def _ground(world: SplatWorld, config: ExportSpaceConfig) -> torch.Tensor:
    """What is subtracted from positions [3], in metres."""
    floor = world.collider.floor(world.starts[:1, :3], world.config.body) if config.ground else torch.zeros(1)
    return torch.cat([torch.zeros(2), floor])


def _opaque(gaussians: Gaussians) -> Gaussians:
    """Those that are drawn: without the surfaces that objects hide."""
    return gaussians.at(gaussians.opacities > 0)


def _drawn(
    world: SplatWorld, suffix: str, config: ExportSpaceConfig, drawing: Drawing
) -> tuple[bytes, Mapping[str, Any]]:
    """A mesh, a panorama or a film: the bytes of its file, and its figures."""
    if not len(world.gaussians):
        raise DatasetError(f"{world.name} has no Gaussian left; undo an edit.")
    if not all(bool(part.isfinite().all()) for part in vars(world.gaussians).values()):
        raise DatasetError(
            f"{world.name} has Gaussians whose numbers are not finite; undo an edit, or import its file again."
        )
    with torch.no_grad():
        if suffix == ".glb":
            return _glb(world, config)
        return _panorama(world, config) if suffix == ".png" else _film(world, config, drawing)


def _glb(world: SplatWorld, config: ExportSpaceConfig) -> tuple[bytes, dict[str, Any]]:
    rot = torch.tensor(AXES["rub"], dtype=torch.float32)
    if config.kind == "gaussians":
        shown = _opaque(world.gaussians)
        shown = replace(shown, means=shown.means - _ground(world, config))
        return encode_gaussians(transform(shown, rot), world.name), {"gaussians": len(shown)}
    if not 0.005 <= config.cell <= 10:
        raise TerrellaError("--cell is from 0.005 to 10 metres.")
    if config.kind == "collider":
        mesh = collider_mesh(world.collider)
    else:
        eyes = viewpoints(world.gaussians, world.collider, world.starts, world.config.body)
        mesh = fused(world.gaussians, eyes, config.cell)
    if len(mesh.faces) > MOST_FACES:
        raise TerrellaError(
            f"the mesh has {len(mesh.faces):,} faces, {MOST_FACES:,} is the most; ask for a larger --cell."
        )
    facts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    vertices = (mesh.vertices - _ground(world, config)) @ rot.T
    return encode_mesh(replace(mesh, vertices=vertices), world.name), facts


def _panorama(world: SplatWorld, config: ExportSpaceConfig, height: int = 1024) -> tuple[bytes, dict[str, Any]]:
    """The view all around from a point or the first start, equirectangular, twice as wide as high."""
    pose = world.starts[0] if config.at is None else torch.tensor([*config.at, 1.0, 0.0, 0.0, 0.0])
    if not bool(pose.isfinite().all()):
        raise TerrellaError("--at takes three finite numbers: x y z in metres.")
    seen = rasterise(world.gaussians, pose[None], None, (height, 2 * height)).rgb[0]
    picture = _exposed(seen, config.exposure)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", optimize=True)
    return buffer.getvalue(), {"size": [2 * height, height], "pose": [round(v, 3) for v in pose.tolist()]}


def _film(world: SplatWorld, config: ExportSpaceConfig, drawing: Drawing) -> tuple[bytes, dict[str, Any]]:
    if not 0.5 <= config.seconds <= 600:
        raise TerrellaError("--seconds is from 0.5 to 600.")
    count, height = round(config.seconds * FRAMES_PER_S), 480
    poses = _eased(_stations(world), count) if config.path is None else glide(read_path(config.path), count)
    aspect = config.aspect or world.config.size[1] / world.config.size[0]
    size = (height, round(height * aspect) // 2 * 2)
    wide, _, *middle = world.config.camera
    camera = world.config.camera if config.aspect is None else (wide, wide * aspect, middle[0], middle[1])
    pictures = []
    for pose in poses:
        drawing(len(pictures), count)
        seen = rasterise(world.gaussians, pose[None], camera, size).rgb[0]
        picture = _exposed(seen, config.exposure)
        pictures.append((simplejpeg.encode_jpeg(picture, quality=95, colorspace="RGB", colorsubsampling="444"),))
    return make_clip(pictures, 1 / FRAMES_PER_S), {"pictures": len(pictures), "size": list(size[::-1])}


def _exposed(seen: torch.Tensor, stops: float) -> np.ndarray:
    """A picture [3, H, W] from 0 to 1 as bytes [H, W, 3], `stops` brighter in linear light."""
    bright = (seen * 2 ** (stops / GAMMA)).clamp(0, 1)
    return (bright * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def _stations(world: SplatWorld) -> torch.Tensor:
    """The points and headings [S, 4] (metres, radians) of a look around from each start."""
    stations = []
    for start in world.starts[:6]:
        heading = 2 * math.atan2(float(start[6]), float(start[3]))
        stations += [[*start[:3].tolist(), heading + turn * math.pi / 2] for turn in range(5)]
    return torch.tensor(stations)


def read_path(path: Path) -> torch.Tensor:
    """The views [S, 5] of a file of a camera path: x, y, z in metres, heading and pitch in radians. DatasetError for others."""
    try:
        given = torch.tensor(json.loads(path.read_text()), dtype=torch.float32)
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{path} cannot be read as a path ({error}); give a list of [x, y, z, degrees].") from error
    if given.ndim != 2 or given.shape[1] not in (4, 5) or len(given) < 2 or not bool(given.isfinite().all()):
        raise DatasetError(f"{path} is a list of two or more [x, y, z, degrees]; its shape is {list(given.shape)}.")
    level = torch.zeros(len(given), 5 - given.shape[1])
    return torch.cat([given[:, :3], given[:, 3:].deg2rad(), level], 1)


def glide(views: torch.Tensor, count: int) -> torch.Tensor:
    """`count` poses along a smooth path (Catmull and Rom 1974) through views [S, 5], from rest to rest; as film.js previews it."""
    views = views.double()
    steps = (views[1:, 3] - views[:-1, 3] + math.pi) % (2 * math.pi) - math.pi  # the shorter way around
    views = torch.cat([views[:, :3], (views[0, 3] + F.pad(steps.cumsum(0), (1, 0)))[:, None], views[:, 4:]], 1)
    share = torch.linspace(0, 1, count, dtype=torch.float64)
    rest = 1 - share
    slow = 2 * STARTS * (1 - STARTS)
    along = torch.where(share < STARTS, share**2 / slow, (share - STARTS / 2) / (1 - STARTS))
    at = torch.where(rest < STARTS, 1 - rest**2 / slow, along) * (len(views) - 1)
    first = at.long().clamp_max(len(views) - 2)
    t = (at - first)[:, None]
    around = [views[(first + k).clamp(0, len(views) - 1)] for k in (-1, 0, 1, 2)]
    out, into = (around[2] - around[0]) / 2, (around[3] - around[1]) / 2
    curve = (2 * t**3 - 3 * t**2 + 1) * around[1] + (t**3 - 2 * t**2 + t) * out
    curve += (3 * t**2 - 2 * t**3) * around[2] + (t**3 - t**2) * into
    return tilted_pose(*curve.float().unbind(1))


def _eased(stations: torch.Tensor, count: int) -> torch.Tensor:
    """`count` poses from the first station to the last, easing in and out of each."""
    at = torch.linspace(0, len(stations) - 1, count)
    first = at.long().clamp_max(len(stations) - 2)
    share = at - first
    share = (share * share * (3 - 2 * share))[:, None]
    turn = (stations[1:, 3] - stations[:-1, 3] + math.pi) % (2 * math.pi) - math.pi
    step = torch.cat([stations[1:, :3] - stations[:-1, :3], turn[:, None]], 1)
    return planar_pose(*(stations[first] + share * step[first]).unbind(1))
