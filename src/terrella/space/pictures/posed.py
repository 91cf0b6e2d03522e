"""Posed pictures of any lenses as views of one ideal pinhole camera, whose view is common to all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError
from ..camera import FAR_M, rotation
from ..fitting import PosedViews
from ..raster.move import multiply_quaternions, quaternion_of
from .reading import ENDINGS, blurred, read_picture, sharpness

FEWEST = 8  # pictures of a fit
FAR = 1e6  # units that a camera is away at most
MIDDLE_M = 3.0  # how far away the middle point lies where nothing says how long a unit is


@dataclass(frozen=True)
class Lens:
    """width and height in pixels; focal: fx, fy, cx, cy in pixels; `pixels`: from tangents [N, 2] (right and down of the optical
    axis) to pixels [N, 2], with distortion."""

    width: int
    height: int
    focal: tuple[float, float, float, float]
    pixels: Callable[[np.ndarray], np.ndarray]

    def extent(self) -> np.ndarray:
        """Tangents left, top, right, bottom of a rectangle that is wholly in the lens's view."""
        fx, fy, cx, cy = self.focal
        box = np.array([-cx / fx, -cy / fy, (self.width - cx) / fx, (self.height - cy) / fy])
        for _ in range(200):
            side = np.linspace(0, 1, 33)[:, None]
            low, high = box[:2], box[2:]
            corners = np.array([[low[0], low[1]], [high[0], low[1]], high, [low[0], high[1]]])
            border = np.concatenate([a + (b - a) * side for a, b in zip(corners, np.roll(corners, -1, 0))])
            at = self.pixels(border)
            if (at >= -0.5).all() and (at <= np.array([self.width, self.height]) + 0.5).all():
                break
            box = box * 0.99
        return box


@dataclass(frozen=True)
class Shots:
    """files and lenses of pictures; pose [T, 7], our frame; known points float32 [N, 3]; metric: whether the unit is a metre;
    left_out: what of the files was absent or is not read."""

    files: list[Path]
    lenses: list[Lens]
    pose: torch.Tensor
    points: torch.Tensor
    metric: bool
    left_out: tuple[str, ...] = ()

    def at(self, rows: list[int]) -> Shots:
        files, lenses = [self.files[k] for k in rows], [self.lenses[k] for k in rows]
        return replace(self, files=files, lenses=lenses, pose=self.pose[rows])


def absent(name: str) -> str:
    """The name of a listed file that is absent, for people."""
    return f"{name} (absent)"


def shown_name(file: Path) -> str:
    """The name of a picture for people: of a copy, such as a.jpg.png, that of its source."""
    return file.stem if Path(file.stem).suffix.lower() in ENDINGS else file.name


def pose_of(rot: np.ndarray, place: np.ndarray, where: str) -> torch.Tensor:
    """The pose [7] of a rotation with columns forward, left and up, and a place; DatasetError if it is none."""
    good = np.isfinite(rot).all() and np.isfinite(place).all() and np.abs(place).max() < FAR
    if not good or np.abs(rot.T @ rot - np.eye(3)).max() > 0.01 or np.linalg.det(rot) < 0:
        raise DatasetError(f"{where}: its pose is no rotation and a place of finite numbers; mend or remove it.")
    return torch.cat([torch.from_numpy(place).float(), quaternion_of(torch.from_numpy(rot))])


def levelled(shots: Shots) -> Shots:
    """The same with z up, the average up direction of the pictures, and with the median point MIDDLE_M away."""
    up = rotation(shots.pose)[..., 2].mean(0)
    up = up / up.norm().clamp_min(1e-6)
    side = torch.linalg.cross(torch.eye(3)[up.abs().argmin()], up)
    side = side / side.norm()
    rot = torch.stack([side, torch.linalg.cross(up, side), up])
    place, points = shots.pose[:, :3] @ rot.T, shots.points @ rot.T
    some = points[:: max(len(points) // 2000, 1)] if len(points) else place
    scale = MIDDLE_M / max(float(torch.cdist(place, some).median()), 1e-6)
    middle = place.median(0).values
    pose = torch.cat([(place - middle) * scale, multiply_quaternions(quaternion_of(rot), shots.pose[:, 3:])], 1)
    return replace(shots, pose=pose, points=(points - middle) * scale, metric=False)


def to_views(shots: Shots, longest: int) -> tuple[PosedViews, list[str]]:
    """The pictures as one pinhole camera sees them, at most `longest` pixels a side, without depth; and the names of blurred ones
    that were left out."""
    if len(shots.files) < FEWEST:
        lost = f" (left out: {', '.join(shots.left_out[:5])})" if shots.left_out else ""
        raise DatasetError(f"there are {len(shots.files)} posed pictures{lost}; take {FEWEST} or more.")
    boxes = np.stack([lens.extent() for lens in set(shots.lenses)])
    left, top, right, bottom = *boxes[:, :2].max(0), *boxes[:, 2:].min(0)
    if right - left < 0.05 or bottom - top < 0.05:
        raise DatasetError("the cameras of these pictures have too little of their view in common; fit them apart.")
    density = min(longest / max(right - left, bottom - top), max(max(one.focal[:2]) for one in shots.lenses))
    width, height = (max(round(side * density / 4) * 4, 8) for side in (right - left, bottom - top))
    across, down = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    ways = np.stack(np.meshgrid(left + (right - left) * across, top + (bottom - top) * down), -1).reshape(-1, 2)
    grids = {
        lens: torch.from_numpy(lens.pixels(ways) / [lens.width, lens.height] * 2 - 1).float().view(1, height, width, 2)
        for lens in set(shots.lenses)
    }
    pictures, clear = [], []
    for file, lens in zip(shots.files, shots.lenses):
        source = _as_taken(file, lens, round(1.2 * longest * max(lens.width / lens.focal[0] / (right - left), 1)))
        clear.append(sharpness(source))
        whole = torch.from_numpy(source.copy()).permute(2, 0, 1)[None].float()
        seen = F.grid_sample(whole, grids[lens], mode="bicubic", padding_mode="border", align_corners=False)
        pictures.append(seen[0].round().clamp(0, 255).to(torch.uint8))
    out = blurred(clear)
    rows = [k for k, bad in enumerate(out) if not bad]
    wide, tall = right - left, bottom - top
    camera = float(1 / wide), float(1 / tall), float(-left / wide), float(-top / tall)
    depth = torch.full((len(rows), 1, 1), FAR_M)
    views = PosedViews(torch.stack([pictures[k] for k in rows]), depth, shots.pose[rows], camera)
    return views, [shown_name(shots.files[k]) for k, bad in enumerate(out) if bad]


def _as_taken(file: Path, lens: Lens, longest: int) -> np.ndarray:
    """The picture, rotated by EXIF or not, whichever fits its lens."""
    for upright in (True, False):
        picture = read_picture(file, upright, longest)
        if abs(picture.shape[1] / picture.shape[0] / (lens.width / lens.height) - 1) < 0.03:
            return picture
    raise DatasetError(
        f"{file} is {picture.shape[1]} x {picture.shape[0]}, its camera {lens.width} x {lens.height}; they are of other shapes."
    )
