"""Scenes of Gaussians as files of other tools: PLY, SuperSplat's compressed PLY, SPZ, SOG, GLB (written by glb.py)."""

import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from ...core.errors import DatasetError
from ...core.files import not_written, replacing
from ..edits import FARTHEST_M
from ..raster import Gaussians
from ..raster.move import transform
from . import compressed, ply, sog, spz
from .gltf_scene import GLTF_ENDINGS, read_gltf

# Axes of a file as ours (x forward, y left, z up); "rdf" is x right, y down, z forward, as training code writes PLY.
AXES = {
    "rdf": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    "rub": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
    "flu": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
_USUAL = {".ply": "rdf", ".spz": "rub"}


def read_scene(path: str | Path, axes: str | None = None) -> Gaussians:
    """The Gaussians of a .ply (plain or compressed), .spz (versions 1 to 4), .sog (or its folder) or .glb
    (KHR_gaussian_splatting). `axes`: the file's, default rub for SPZ and GLB, else those that its header names, else rdf. Gaussians
    that are not finite or farther than 10 km are left out with a warning. DatasetError for a broken file."""
    path = Path(path)
    if path.suffix.lower() in GLTF_ENDINGS:
        scene = read_gltf(path)
        if not isinstance(scene, Gaussians):
            raise DatasetError(f"{path} holds triangles and no Gaussians; `terrella space build` makes a world of it.")
        return _valid_part(scene, path, axes or "rub")
    try:
        data = b"" if path.is_dir() else path.read_bytes()
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read ({error.strerror}); give a .ply, .spz, .sog or .glb file."
        ) from error
    try:
        if data[:3] == b"ply":
            elements = ply.parse(data)
            scene = compressed.decode(elements) if "chunk" in elements else ply.decode(elements)
            if others := ply.other_elements(data):
                warnings.warn(f"its points become Gaussians; left out: {', '.join(others)}.", stacklevel=2)
            if "chunk" not in elements and (others := ply.other_columns(elements["vertex"])):
                warnings.warn(f"left out: its columns {', '.join(others)}.", stacklevel=2)
            usual = ply.stated_axes(data) or "rdf"
        elif data[:2] == b"\x1f\x8b" or data[:4] == spz.MAGIC:
            scene, usual = spz.decode(data), "rub"
        elif data[:2] == b"PK":
            scene, usual = sog.zipped(data), "rdf"
        elif path.is_dir() or path.name == sog.META:
            scene, usual = sog.unzipped(path if path.is_dir() else path.parent), "rdf"
        else:
            raise ValueError("it is neither PLY nor SPZ nor SOG")
    except (ValueError, KeyError, OverflowError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DatasetError(f"{path} cannot be opened as Gaussians: {reason}; export it again as PLY or SPZ.") from error
    return _valid_part(scene, path, axes or usual)


def _valid_part(scene: Gaussians, path: Path, axes: str) -> Gaussians:
    """The Gaussians with finite numbers and sensible places, in our axes."""
    valid = torch.stack(
        [part.flatten(1).isfinite().all(1) if part.ndim > 1 else part.isfinite() for part in vars(scene).values()]
    )
    valid = valid.all(0) & (scene.quats.norm(dim=1) > 0) & (scene.means.abs() < FARTHEST_M).all(1)
    if not valid.any():
        raise DatasetError(f"{path} has no Gaussian with finite numbers within 10 km; export it again.")
    if lost := int((~valid).sum()):
        warnings.warn(
            f"{lost:,} of its {len(valid):,} Gaussians are left out: not finite, farther than 10 km, or with a quaternion of 0.",
            stacklevel=3,
        )
    return transform(scene.at(valid), _axes(axes).T)


def write_scene(
    gaussians: Gaussians, path: str | Path, axes: str | None = None, kind: str = "", version: spz.Version = 3
) -> None:
    """Writes a .ply or .spz (of `version`); kind "compressed" makes the .ply SuperSplat's. The file is replaced whole."""
    path = Path(path)
    if path.suffix.lower() not in _USUAL:
        raise DatasetError(
            f"{path}: a place is written as .ply, .spz, .glb, .png, .mp4 or .html; give a name that ends so."
        )
    if not len(gaussians):
        raise DatasetError(f"{path} was not written: there is no Gaussian left to write.")
    if kind == "compressed" and path.suffix.lower() != ".ply":
        raise DatasetError(f"{path}: the compressed kind is one of .ply; SPZ is compressed by itself.")
    axes = axes or _USUAL[path.suffix.lower()]
    exported = transform(gaussians, _axes(axes))
    if path.suffix.lower() == ".spz":
        data = spz.encode(exported, version)
    else:
        data = compressed.encode(exported, axes) if kind == "compressed" else ply.encode(exported, axes)
    replace_whole(path, lambda staged: staged.write_bytes(data))


def replace_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Writes a temporary neighbour of `path`, then renames it; DatasetError where it cannot be written."""
    try:
        with replacing(path) as staged:
            write(staged)
    except OSError as error:
        raise not_written(path, error) from error


def _axes(name: str) -> torch.Tensor:
    if name not in AXES:
        raise DatasetError(f"there are no axes '{name}'; they are {', '.join(AXES)}.")
    return torch.tensor(AXES[name], dtype=torch.float32)
