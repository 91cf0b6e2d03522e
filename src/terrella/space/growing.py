"""Growing a place: a camera that sees known and unknown together, what fills the unknown, and Gaussians where nothing was."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from .camera import Intrinsics, directions, project, rays, rotation
from .lifting.layers import of_pixels
from .lifting.scenes import rotation_of
from .raster import Drawing, Gaussians, rasterise
from .raster.move import quaternion_of
from .room_planes import RoomPlanes

KNOWN = 0.5  # alpha from which a pixel is known
CAMERA: Intrinsics = (0.5, 0.5, 0.5, 0.5)
SIDE, LOOK = 192, 12  # pixels of a step's view, and of its trial
ROWS = 64  # of panoramas that measure coverage
YAWS, PITCHES = 12, (-1.2, -0.6, 0.0, 0.6, 1.2)
LEAST_KNOWN = 0.4  # share of a view
BEHIND = 0.01  # share of its depth by which what is added at the edge of the known lies behind it
FREE_M, FREE = 0.1, 0.05  # what lies this much before a known surface would cover it: metres, and a share

Fill = Callable[[Drawing, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


@dataclass(frozen=True)
class GrowthView:
    """A camera of a step."""

    pose: torch.Tensor  # [7]
    unknown: float  # share of its pixels


def known_around(gaussians: Gaussians, eyes: torch.Tensor) -> torch.Tensor:
    """Whether anything is known in each direction of panoramas from `eyes` [E, 3]: bool [E, ROWS, 2 ROWS]."""
    poses = torch.cat([eyes, torch.tensor([1.0, 0, 0, 0]).expand(len(eyes), 4)], 1)
    with torch.no_grad():
        return torch.cat([rasterise(gaussians, pose[None], None, (ROWS, 2 * ROWS)).alpha for pose in poses]) >= KNOWN


def coverage(known: torch.Tensor) -> float:
    """The share of all directions that are known, of the worst of panoramas [E, ROWS, 2 ROWS]."""
    solid = directions(ROWS)[..., :2].norm(dim=-1)
    return float(((known * solid).sum((1, 2)) / solid.sum()).min())


def next_view(known: torch.Tensor, eyes: torch.Tensor) -> GrowthView:
    """The camera at one of `eyes` [E, 3] from which most is unknown and LEAST_KNOWN known. known: as `known_around` gives it."""
    ways = rays(CAMERA, LOOK, LOOK).reshape(-1, 3)
    best, score = GrowthView(torch.zeros(7), 0.0), -1.0
    for eye, around in zip(eyes, known):
        for pitch in PITCHES:
            for k in range(YAWS):
                turn = torch.from_numpy(rotation_of(2 * math.pi * k / YAWS, pitch, 0.0)).float()
                way = F.normalize(ways @ turn.T, dim=1)
                row = ((0.5 - way[:, 2].asin() / math.pi) * ROWS).long().clamp(0, ROWS - 1)
                column = ((1 - torch.atan2(way[:, 1], way[:, 0]) / math.pi) * ROWS).long() % (2 * ROWS)
                unknown = 1 - float(around[row, column].float().mean())
                value = unknown if 1 - unknown >= LEAST_KNOWN else 0.5 * (1 - unknown)
                if value > score:
                    best, score = GrowthView(torch.cat([eye, quaternion_of(turn)]), unknown), value
    return best


def planar_fill(planes: RoomPlanes) -> Fill:
    """Fills with the walls, floor and ceiling of a room."""

    def fill(drawn: Drawing, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        size = drawn.alpha.shape[-2:]
        ways = (rays(CAMERA, *size) @ rotation(pose).T).reshape(-1, 3)
        depth, colour = planes.hit(pose[:3], ways)
        return depth.view(size), colour.T.reshape(3, *size)

    return fill


@dataclass(frozen=True)
class Grown:
    """What a step adds; seam: the median relative difference of depth between known and fill where both are."""

    gaussians: Gaussians
    seam: float


def grow_step(gaussians: Gaussians, view: GrowthView, fill: Fill, seen: list[tuple[torch.Tensor, Intrinsics]]) -> Grown:
    """The Gaussians that a view adds where nothing was, none where they would cover what the cameras `seen` (pose [7],
    intrinsics) see."""
    pose = view.pose
    with torch.no_grad():
        drawn = rasterise(gaussians, pose[None], CAMERA, (SIDE, SIDE))
    known = drawn.alpha[0] >= KNOWN
    depth, rgb = fill(drawn, pose)
    surface = drawn.depth[0] / drawn.alpha[0].clamp_min(1e-3)
    edge = known & (F.max_pool2d((~known).float()[None, None], 9, 1, 4)[0, 0] > 0)
    seam = float((depth[edge] / surface[edge] - 1).abs().median()) if bool(edge.any()) else 0.0
    turn = rotation(pose)
    some = (
        F.max_pool2d((~known).float()[None, None], 3, 1, 1)[0, 0] > 0
    )  # and a pixel more, else seams show as dark lines
    depth = torch.where(known, torch.maximum(depth, surface * (1 + BEHIND)), depth)
    points = depth[..., None] * rays(CAMERA, SIDE, SIDE) @ turn.T
    some &= ~_covers(gaussians, points + pose[:3], seen)
    added = of_pixels(points, depth, depth / (CAMERA[0] * SIDE), rgb, some, (-turn[:, 1], -turn[:, 2]), 0.0)
    return Grown(replace(added, means=added.means + pose[:3]), seam)


def _covers(gaussians: Gaussians, points: torch.Tensor, seen: list[tuple[torch.Tensor, Intrinsics]]) -> torch.Tensor:
    """Which of points [H, W, 3] lie before a surface that a camera sees: bool [H, W]."""
    covering = torch.zeros(points.shape[:2], dtype=torch.bool)
    for pose, camera in seen:
        with torch.no_grad():
            drawn = rasterise(gaussians, pose[None], camera, (SIDE, SIDE))
        at, ahead = (part.view(*points.shape[:2], -1) for part in project(points.reshape(-1, 3), pose, camera))
        row, column = ((at[..., k] * SIDE).long() for k in (1, 0))
        inside = (ahead[..., 0] > 0.05) & (at > 0).all(-1) & (at < 1).all(-1)
        row, column = row.clamp(0, SIDE - 1), column.clamp(0, SIDE - 1)
        alpha = drawn.alpha[0][row, column]
        surface = drawn.depth[0][row, column] / alpha.clamp_min(1e-3)
        before = ahead[..., 0] < (surface - FREE_M).minimum(surface * (1 - FREE))
        covering |= inside & (alpha >= KNOWN) & before
    return covering


def psnr_of(one: torch.Tensor, other: torch.Tensor, some: torch.Tensor) -> float:
    """PSNR in dB of pictures [3, H, W] on the pixels `some` [H, W]; at most 99."""
    off = float((one - other)[:, some].square().mean()) if bool(some.any()) else 0.0
    return -10 * math.log10(max(off, 10**-9.9))
