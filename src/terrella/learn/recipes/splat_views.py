"""Inputs of `space fit`: a recording or pictures, with or without poses and depth, as posed views with depth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ...core.errors import DatasetError
from ...data import Dataset
from ...data.format import INFO
from ...space.camera import FAR_M
from ...space.enclosure import ColliderChoice
from ...space.files import replace_whole
from ...space.fitting import FitConfig, PosedViews
from ...space.lifting.network import load_lifter
from ...space.lifting.prior import with_prior
from ...space.pictures import is_pictures, posed_pictures
from ...space.pictures.posed import FEWEST, to_views
from ...space.stereo import with_depth

DEPTH_FILE, PICTURES = "depth.safetensors", "pictures"
FEW = 40  # pictures: with fewer, the lifter gives depth where stereo gives none
AGREEMENT = 0.08  # share of pixels whose depth agrees between views: with less the poses are wrong, or nothing overlaps


@dataclass(frozen=True)
class SplatFit:
    """Settings of a fit."""

    name: str = ""  # Name of the world. Default: that of the data.
    frames: int = 300  # Pictures taken from the recording, the folder or the video, evenly spread.
    # Number of episodes to use, from the first. Default: all.
    episodes: int | None = None
    # Corners x0 y0 x1 y1 in metres: only pictures taken within, such as those of one room.
    box: tuple[float, float, float, float] | None = None
    # Metres per unit of the poses. Poses from COLMAP have no scale: they are first scaled to a median depth of 3 m.
    scale: float = 1.0
    # Pixels of the longer side of pictures; larger ones are scaled down. Recordings keep their size.
    longest: int = 480
    save_every_s: float = 20.0  # Seconds between saves.
    collider: ColliderChoice = "auto"
    """How what stops walkers is closed: indoor, outdoor, object (see `space import --help`), or open: only what the Gaussians
    fill. auto chooses by what surrounds the first camera."""
    # A point in free space (x y z in metres), from which inside and outside are distinguished. Default: the first camera.
    inside: tuple[float, float, float] | None = None
    fit: FitConfig = field(default_factory=FitConfig)
    """The fit itself."""


def read_views(data: str | Path, out: Path, config: SplatFit) -> tuple[PosedViews, Mapping[str, Any], list[str]]:
    """Views with depth, the facts of a recording's world, and the pictures that were left out; DatasetError if they are no views of
    one place. Estimated depth and poses are cached in `out`."""
    path, spec, left_out = Path(data), {}, []
    if is_pictures(path):
        shots, unplaced = posed_pictures(path, out / PICTURES, config.frames)
        views, dull = to_views(shots, config.longest)
        points, left_out = shots.points * config.scale, sorted({*unplaced, *dull})
    else:
        if "://" not in str(data) and not path.is_dir():
            problem = (
                "is one file; of a single picture `terrella space lift` makes a place, and videos end in .mp4, .mov or .webm"
                if path.exists()
                else "does not exist; check the path"
            )
            raise DatasetError(f"{data} {problem}.")
        if path.is_dir() and not (path / INFO).exists():
            raise DatasetError(
                f"{data} is no recording (it has no {INFO}) and no folder of pictures: those lie in it themselves, or a "
                "transforms.json names them (nerfstudio's ns-process-data makes one of exports of Polycam and Record3D), or "
                "COLMAP's model."
            )
        views, spec = _recorded(data, config)
        points = None
    pose = torch.cat([views.pose[:, :3] * config.scale, views.pose[:, 3:]], 1)
    depth = torch.where(views.depth < FAR_M, views.depth * config.scale, FAR_M)
    views = replace(views, pose=pose, depth=depth)
    rows = torch.from_numpy(_within(pose.numpy(), config.box)).nonzero()[:, 0]
    if len(rows) < FEWEST:
        raise DatasetError(
            f"{data} has {len(rows)} pictures there, and a fit needs {FEWEST} or more; ask for more of it."
        )
    views = views.at(rows)
    if not bool((views.depths(torch.arange(0, len(views), max(len(views) // 20, 1))) > 0).any()):
        views = _with_depth(views, points, out / DEPTH_FILE, f"{data} {depth_settings(config)}")
        if float((views.depth < FAR_M).float().mean()) < AGREEMENT:
            raise DatasetError(
                f"the pictures of {data} do not agree on any surface: their poses are wrong, or they overlap too little, or they "
                "were all taken from one spot."
            )
        if len(views) < FEW:
            views = with_prior(views, load_lifter())
    return views, spec, left_out


def depth_settings(config: SplatFit) -> SplatFit:
    """The settings on which estimated depth depends; the others as they are by default."""
    return replace(config, fit=FitConfig(), collider="auto", inside=None)


def _with_depth(views: PosedViews, points: torch.Tensor | None, path: Path, key: str) -> PosedViews:
    """The views with depth by stereo, cached in the file `path` under `key`."""
    try:
        with safe_open(str(path), "pt") as file:
            if key in (file.metadata() or {}).values() and len(depth := file.get_tensor("depth")) == len(views):
                return replace(views, depth=depth)
    except (OSError, SafetensorError):
        pass  # not cached yet
    estimated = with_depth(views, points)
    replace_whole(path, lambda file: save_file({"depth": estimated.depth}, file, metadata={"settings": key}))
    return estimated


def _recorded(data: str | Path, config: SplatFit) -> tuple[PosedViews, Mapping[str, Any]]:
    """Pictures of a recording, and the facts of its world; DatasetError if it has no poses or lens."""
    dataset = Dataset(data)
    missing = [name for name in ("rgb", "pose") if not dataset.has(name)]
    lens = dataset.camera_models.get("rgb")
    if missing or lens is None:
        raise DatasetError(
            f"{data} has no {', '.join(missing) or 'lens of its camera'}: a place is fitted to pictures with poses. Of a folder of "
            "plain pictures, or a video, poses are found."
        )
    names = ["rgb", "pose", *(["depth"] if dataset.has("depth") else [])]
    arrays: dict[str, list[np.ndarray]] = {name: [] for name in names}
    episodes = range(len(dataset.episodes))[: config.episodes]
    poses = [dataset.episode(number, ["pose"])["pose"] for number in episodes]
    inside = [np.flatnonzero(_within(pose * config.scale, config.box)) for pose in poses]
    total = sum(map(len, inside))
    if total < FEWEST:
        raise DatasetError(f"{data} has {total} pictures there, and a fit needs {FEWEST} or more; ask for more of it.")
    chosen = np.linspace(0, total - 1, min(config.frames, total)).round().astype(int)
    first = 0
    for number, rows in zip(episodes, inside):
        some = rows[chosen[(chosen >= first) & (chosen < first + len(rows))] - first]
        first += len(rows)
        if len(some):
            episode = dataset.episode(number, names)
            for name, parts in arrays.items():
                parts.append(episode[name][some])
    whole = {name: torch.from_numpy(np.concatenate(parts)) for name, parts in arrays.items()}
    rgb, pose = whole["rgb"], whole["pose"]
    depth = whole["depth"].float() if "depth" in whole else torch.full((len(rgb), 1, 1), FAR_M)
    depth = torch.where(depth.isfinite() & (depth < 65), depth, FAR_M)
    return PosedViews(rgb.permute(0, 3, 1, 2).contiguous(), depth, pose.float(), lens.intrinsics), dataset.world


def _within(pose: np.ndarray, box: tuple[float, float, float, float] | None) -> np.ndarray:
    if box is None:
        return np.ones(len(pose), bool)
    x0, y0, x1, y1 = box
    return (pose[:, 0] >= x0) & (pose[:, 0] <= x1) & (pose[:, 1] >= y0) & (pose[:, 1] <= y1)
