"""A picture as two layers of depth, and these as Gaussians: what is seen, and behind its edges what is not."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from ..camera import Intrinsics, project, rays
from ..raster import Gaussians, join
from ..raster.gaussians import plain_sh
from ..raster.move import quaternion_of
from .network import MULTIPLE, LayerCodes, Lifter
from .scenes import rotation_of

SIGMA = 0.62  # standard deviation of a Gaussian as a share of its pixel's width
OPACITY, THIN = 0.97, 0.15
STEEPEST = 5.0  # a pixel's Gaussian is at most this much longer than wide
WINDOW, ALIKE = (
    13,
    0.15,
)  # pixels of the network's picture, and a difference of logarithms, over which depth is smoothed
COLOURS = 0.03  # the squared difference of like colours
EDGE = 0.06  # steps of the logarithm of depth that are edges
HIDES = 0.2  # the probability from which a hidden surface is made
MIRROR = torch.tensor([1.0, 1.0, -1.0, 1.0])  # the view in a mirror: roll turns the other way
FLOOR_M, CELL_M = 0.08, 0.06  # how far from 0 the floor may lie; the spacing of Gaussians that continue it
MOST_TILT = 0.15  # radians
FEWEST_FLOOR = 0.01  # share of pixels that make a floor


@dataclass(frozen=True)
class PictureLayers:
    """Two layers of a picture of H x W pixels by a camera `height_m` above the floor that is tilted by pitch and roll (radians)."""

    rgb: torch.Tensor  # [3, H, W] in 0..1
    depth: torch.Tensor  # [H, W] metres along the optical axis
    behind: torch.Tensor  # [h, w], half of that: depth of the hidden layer
    hides: torch.Tensor  # [h, w], the probability that it shows from near the camera
    behind_rgb: torch.Tensor  # [3, h, w]
    error: torch.Tensor  # [H, W], the expected error of depth, as a share of it
    focal: float  # in longer sides of the picture
    pitch: float
    roll: float
    height_m: float
    opaque: torch.Tensor | None = None  # bool [H, W]: the pixels that become Gaussians; None: all

    @property
    def camera(self) -> Intrinsics:
        height, width = self.depth.shape
        long = self.focal * max(height, width)
        return (long / width, long / height, 0.5, 0.5)

    @property
    def turn(self) -> torch.Tensor:
        """[3, 3], camera to world; the camera looks along x."""
        return torch.from_numpy(rotation_of(0.0, self.pitch, self.roll)).float()

    @property
    def pose(self) -> torch.Tensor:
        """T_world_cam [7], with the floor at 0."""
        return torch.cat([torch.tensor([0.0, 0.0, self.height_m]), quaternion_of(self.turn)])


@torch.inference_mode()
def layers_of(
    picture: np.ndarray, lifter: Lifter, focal: float | None = None, height_m: float | None = None
) -> PictureLayers:
    """The layers of a picture uint8 [H, W, 3]. focal: of its lens in longer sides, and height_m: of the camera, if known."""
    height, width = picture.shape[:2]
    rgb = torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255
    share = lifter.config.longest / max(height, width)
    small = tuple(max(round(side * share), MULTIPLE) for side in (height, width))
    shrunk = Image.fromarray(picture).resize(
        small[::-1], Image.Resampling.BOX if share < 1 else Image.Resampling.BICUBIC
    )
    seen = torch.from_numpy(np.array(shrunk)).permute(2, 0, 1).float()[None] / 255
    codes = _codes(lifter, seen)
    log_focal, pitch, roll, log_height = (float(part) for part in codes.lens[0])
    focal = focal or math.exp(min(max(log_focal, math.log(0.35)), math.log(1.6)))
    near = _sharpened(_smoothed(codes.near[0], codes.spread[0], seen[0]), seen[0], rgb)
    spread = F.interpolate(codes.spread[None], (height, width), mode="bilinear")[0, 0]
    half = (-(-height // 2), -(-width // 2))
    step, hides, behind_rgb = (
        F.interpolate(part, half, mode="bilinear")[0]
        for part in (codes.step[None], codes.hides[None].sigmoid(), codes.rgb)
    )
    depth = near.exp() * focal
    given = (rgb, depth, depth[::2, ::2] * step[0].exp(), hides[0], behind_rgb, spread.exp())
    layers = PictureLayers(*given, focal, pitch, roll, math.exp(log_height))
    layers = levelled(layers)
    if height_m is None:
        return layers
    scale = height_m / layers.height_m
    return replace(layers, depth=scale * layers.depth, behind=scale * layers.behind, height_m=height_m)


def _codes(lifter: Lifter, seen: torch.Tensor) -> LayerCodes:
    """The codes of a picture [1, 3, H, W], and of its mirror image, averaged."""
    height, width = seen.shape[-2:]
    more = [-side % MULTIPLE for side in (height, width)]
    top, left = more[0] // 2 & ~1, more[1] // 2 & ~1
    pad = (left, more[1] - left, top, more[0] - top)
    whole = F.pad(seen, pad, mode="replicate")
    one = lifter(torch.cat([whole, whole.flip(-1)]))
    flipped = [(part[:1] + part[1:].flip(-1)) / 2 for part in one[:5]]
    lens = (one.lens[:1] + one.lens[1:] * MIRROR) / 2
    first = [part[..., top : top + height, left : left + width] for part in flipped[:2]]
    rows, columns = slice(top // 2, top // 2 - (-height // 2)), slice(left // 2, left // 2 - (-width // 2))
    step, hides, rgb = (part[..., rows, columns] for part in flipped[2:])
    return LayerCodes(first[0], first[1], step, hides, rgb, lens)


def _sharpened(near: torch.Tensor, small: torch.Tensor, rgb: torch.Tensor) -> torch.Tensor:
    """Logarithms of depth [h, w] at the size of the picture `rgb` [3, H, W]: interpolated as planes are, and at edges taken from
    those neighbours whose colours in the picture `small` [3, h, w] are like the pixel's."""
    height, width = rgb.shape[-2:]
    wide = max(near.shape) / max(height, width)
    plain = -F.interpolate((-near).exp()[None, None], (height, width), mode="bilinear")[0, 0].log()
    reach = F.max_pool2d(near[None, None], 3, 1, 1) + F.max_pool2d(-near[None, None], 3, 1, 1)
    edges = F.interpolate((reach > EDGE).float(), (height, width), mode="nearest")[0, 0] > 0
    row, column = edges.nonzero(as_tuple=True)
    at = [((part + 0.5) * wide - 0.5) for part in (row, column)]
    base = [part.round().long() for part in at]
    weights, values = [], []
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            a, b = (base[0] + i).clamp(0, near.shape[0] - 1), (base[1] + j).clamp(0, near.shape[1] - 1)
            apart = (at[0] - a).square() + (at[1] - b).square()
            unlike = (small[:, a, b] - rgb[:, row, column]).square().sum(0)
            weights.append((-apart / 0.8 - unlike / 0.008).exp() + 1e-9 * (-apart).exp())
            values.append(near[a, b])
    weight, value = torch.stack(weights), torch.stack(values)
    best = value.gather(0, weight.argmax(0, keepdim=True))
    weight = weight * ((value - best).abs() < EDGE)
    plain[row, column] = (weight * value).sum(0) / weight.sum(0)
    return plain


def _smoothed(near: torch.Tensor, spread: torch.Tensor, small: torch.Tensor) -> torch.Tensor:
    """Logarithms of depth [h, w] without ripples: at each pixel a plane through its neighbourhood (inverse depth is linear on
    planes), weighted by how sure and how alike their depths are, and by how
    alike the colours of the picture `small` [3, h, w] are."""
    reach, (height, width) = WINDOW // 2, near.shape
    inverse, sure = (-near).exp(), (-2 * spread.clamp_min(-4)).exp()
    padded = [F.pad(part[None, None], (reach,) * 4, mode="replicate") for part in (inverse, near, sure)]
    value, log, sure = (F.unfold(part, WINDOW)[0] for part in padded)
    offset = torch.arange(WINDOW) - reach
    v, u = (part.reshape(-1, 1).float() for part in torch.meshgrid(offset, offset, indexing="ij"))
    spot, colours = near.flatten(), F.pad(small[None], (reach,) * 4, mode="replicate")
    colours = F.unfold(colours, WINDOW)[0].view(3, WINDOW**2, -1)
    sure = sure * (-(colours - small.flatten(1)[:, None]).square().sum(0) / COLOURS).exp()
    plane = inverse.flatten()
    for _ in range(2):
        weight = sure * (-((log - spot) / ALIKE).square() - (u.square() + v.square()) / (2 * (reach / 1.5) ** 2)).exp()
        basis = torch.stack([torch.ones_like(u), u, v]).expand(3, -1, 1)
        moments = torch.einsum("ikn,jkn,kp->pij", basis, basis, weight)
        sums = torch.einsum("ikn,kp->pi", basis, weight * value)
        ridge = moments[:, :1, :1] * 1e-3 * torch.diag(torch.tensor([0.0, 1.0, 1.0]))
        plane = torch.linalg.solve(moments + ridge, sums)[:, 0].clamp_min(0.2 * inverse.min())
        spot = -plane.log()
    return -plane.log().view(height, width)


def floor_height(layers: PictureLayers) -> float | None:
    """The height of the camera above the lowest level surface that fills enough of the picture, if there is one: metres."""
    return lowest_level(level_points(_points(layers.depth, layers) @ layers.turn.T), layers.depth.numel())


def lowest_level(level: torch.Tensor, count: int) -> float | None:
    """How far below the camera the lowest of level points [N, 3] lie that are enough of `count` pixels: metres."""
    deep = -level[level[:, 2] < -0.15, 2]
    if len(deep) < FEWEST_FLOOR * count:
        return None
    low, high = math.log(0.15), math.log(6.0)
    counts = F.avg_pool1d(F.pad(torch.histc(deep.log(), 60, low, high)[None], (1, 1)), 3, 1)[0]
    enough = (counts > max(0.35 * float(counts.max()), 0.3 * FEWEST_FLOOR * count)).nonzero()[:, 0]
    if not len(enough):
        return None
    edges = torch.linspace(low, high, 61).exp()
    within = (deep >= edges[max(int(enough[-1]) - 1, 0)]) & (deep <= edges[min(int(enough[-1]) + 2, 60)])
    return float(deep[within].median())


def levelled(layers: PictureLayers) -> PictureLayers:
    """The layers with pitch, roll and height by which their floor is level and lies at 0, where they show one; the camera's tilt is
    corrected by MOST_TILT at most."""
    now = layers
    for band in (0.12, 0.08, 0.05):
        height = floor_height(now)
        if height is None:
            return layers
        level = level_points(_points(now.depth, now) @ now.turn.T)
        near = level[(level[:, 2] + height).abs() < band * height]
        flat = torch.cat([near[:, :2], torch.ones(len(near), 1)], 1)
        a, b, _ = torch.linalg.lstsq(flat, near[:, 2:]).solution[:, 0].tolist()
        x, y, z = (F.normalize(torch.tensor([-a, -b, 1.0]), dim=0) @ now.turn).tolist()  # what is up, for the camera
        now = replace(now, pitch=math.asin(x), roll=math.atan2(y, z))
        if max(abs(now.pitch - layers.pitch), abs(now.roll - layers.roll)) > MOST_TILT:
            return replace(layers, height_m=floor_height(layers) or layers.height_m)
    return replace(now, height_m=floor_height(now) or now.height_m)


def level_points(points: torch.Tensor) -> torch.Tensor:
    """Of points [h, w, 3] of neighbouring pixels, along the world's axes, those of level surfaces: [N, 3]."""
    normal = torch.cross(points.diff(dim=1)[:-1], points.diff(dim=0)[:, :-1], dim=-1)
    return points[:-1, :-1][normal[..., 2].abs() > 0.94 * normal.norm(dim=-1)]


def _points(depth: torch.Tensor, layers: PictureLayers) -> torch.Tensor:
    """[h, w, 3] in the camera's frame."""
    return depth[..., None] * rays(layers.camera, *depth.shape)


def to_gaussians(layers: PictureLayers, two: bool = True) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians of a picture, and which were seen: bool [N]. Of the hidden layer (if `two`) only what shows once the camera
    moves. Each covers its pixel, tilted as the surface is."""
    shown = torch.ones_like(layers.depth, dtype=torch.bool) if layers.opaque is None else layers.opaque
    first = _of_pixels(layers.depth, layers.rgb, shown, layers)
    if not two:
        return first, torch.ones(len(first), dtype=torch.bool)
    more = _of_pixels(layers.behind, layers.behind_rgb, (layers.hides > HIDES) & shown[::2, ::2], layers)
    return join([first, more]), torch.arange(len(first) + len(more)) < len(first)


def floor_below(seen: Gaussians, layers: PictureLayers) -> Gaussians:
    """Invented Gaussians of the floor from below the camera, which stands at x = y = 0, to where the picture shows it, in the
    colours of the nearest part that it shows; none where it shows no floor."""
    near = seen.means[:, 2].abs() < FLOOR_M
    floor = seen.at(near.nonzero()[:: max(int(near.sum()) // 4000, 1), 0])
    if int(near.sum()) < FEWEST_FLOOR * len(seen):
        return seen.at(torch.zeros(0, dtype=torch.long))
    first = float(floor.means[:, 0].quantile(0.02))
    x, y = torch.meshgrid(
        torch.arange(-1.0, min(first, 6.0) + 0.2, CELL_M), torch.arange(-1.2, 1.2, CELL_M), indexing="ij"
    )
    spots = torch.stack([x.flatten(), y.flatten()], 1)
    apart, nearest = torch.cdist(spots, floor.means[:, :2]).min(1)
    spots = torch.cat([spots, torch.full((len(spots), 1), float(floor.means[:, 2].median()))], 1)
    where, ahead = project(spots, layers.pose, layers.camera)
    framed = (ahead > 0) & ((where - 0.5).abs() < 0.52).all(1)  # it must not cover the picture
    spots, nearest = (part[(apart > CELL_M) & ~framed] for part in (spots, nearest))
    count, flat = len(spots), torch.tensor([0.6 * CELL_M, 0.6 * CELL_M, 0.005])
    turn = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(spots, turn, flat.expand(count, 3), torch.full((count,), OPACITY), floor.sh[nearest])


def _of_pixels(depth: torch.Tensor, rgb: torch.Tensor, some: torch.Tensor, layers: PictureLayers) -> Gaussians:
    """One Gaussian for each pixel of `some` [h, w]."""
    turn, size = layers.turn, depth / (layers.camera[0] * depth.shape[1])
    return of_pixels(
        _points(depth, layers) @ turn.T, depth, size, rgb, some, (-turn[:, 1], -turn[:, 2]), layers.height_m
    )


def of_pixels(
    points: torch.Tensor,
    depth: torch.Tensor,
    size: torch.Tensor,
    rgb: torch.Tensor,
    some: torch.Tensor,
    axes: tuple[torch.Tensor, torch.Tensor],
    height_m: float,
    stretch: torch.Tensor | float = 1.0,
) -> Gaussians:
    """One Gaussian for each pixel of `some` [h, w], tilted as its surface is. points [h, w, 3]: from the camera, along the world's
    axes; depth [h, w]; size [h, w]: of a pixel, in metres; rgb [3, h, w]; axes: right and down where the surface is not known, [3]
    or [h, w, 3]; stretch: how many pixels beside each other one stands for."""
    slopes = [_slope(points, depth, axis) for axis in (1, 0)]
    across, along = (
        torch.where(slope.norm(dim=-1, keepdim=True) > 0, slope, size[..., None] * axis)
        for slope, axis in zip(slopes, axes)
    )
    across, along, points = (across * stretch)[some], along[some], points[some]
    one = F.normalize(across, dim=1)
    normal = F.normalize(torch.linalg.cross(one, along), dim=1)
    two = torch.linalg.cross(normal, one)
    size = size[some]
    first = across.norm(dim=1).clamp(max=STEEPEST).minimum(STEEPEST * size)
    second = (along * two).sum(1).abs().minimum(STEEPEST * size)
    scales = SIGMA * torch.stack([first.maximum(size), second.maximum(size), THIN * size], 1)
    quats = _quaternions(torch.stack([one, two, normal], 2))
    means = points + torch.tensor([0.0, 0.0, height_m])
    return Gaussians(means, quats, scales, torch.full((len(means),), OPACITY), plain_sh(rgb[:, some].T))


def _slope(points: torch.Tensor, depth: torch.Tensor, axis: int) -> torch.Tensor:
    """From each pixel to the next along an axis on the same surface [h, w, 3]; zeros where its neighbours lie on others."""
    step, log = points.diff(dim=axis), depth.log().diff(dim=axis).abs()
    same = (log < EDGE)[..., None].float()
    pad = (0, 0, 0, 0, 1, 0) if axis == 0 else (0, 0, 1, 0)
    after = (0, 0, 0, 0, 0, 1) if axis == 0 else (0, 0, 0, 1)
    total = F.pad(step * same, pad) + F.pad(step * same, after)
    return total / (F.pad(same, pad) + F.pad(same, after)).clamp_min(1)


def _quaternions(frames: torch.Tensor) -> torch.Tensor:
    """Rotations [N, 3, 3] as quaternions w, x, y, z [N, 4]."""
    m = frames
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = torch.stack([1 + trace, *(1 + 2 * m[:, k, k] - trace for k in range(3))], 1)
    rows = torch.stack(
        [
            torch.stack([squares[:, 0], m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1),
            torch.stack([m[:, 2, 1] - m[:, 1, 2], squares[:, 1], m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0]], 1),
            torch.stack([m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] + m[:, 0, 1], squares[:, 2], m[:, 2, 1] + m[:, 1, 2]], 1),
            torch.stack([m[:, 1, 0] - m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2], squares[:, 3]], 1),
        ],
        1,
    )
    best = squares.argmax(1)
    return F.normalize(rows[torch.arange(len(m)), best], dim=1)
