"""Fuses one posed picture with depth into a scene of Gaussians, without a fit (like the surfels of Keller et al. 2013). The weight
of each Gaussian at each pixel is the gradient of the picture by its colour, so that one rendering gives all sums."""

from dataclasses import replace

import torch
import torch.nn.functional as F

from .camera import FAR_M, SAME, Intrinsics, project, unproject
from .fitting import FADED
from .raster import Gaussians, rasterise
from .raster.gaussians import Y0, plain_sh

SIDES = (4, 2, 1)  # pixels: a new Gaussian covers a square, the largest with similar colours and depths
ALIKE = 0.06  # the largest difference of similar colours in 0..1
ENOUGH = 0.1  # a Gaussian with a smaller sum of weights, in pixels, was not seen
MOST = 400.0  # the largest weight of a colour, so that colours keep following changes
OPACITY, WIDE = 0.9, 0.6  # of new Gaussians; their standard deviation as a share of their square
BEFORE = 0.5  # a Gaussian nearer than this share of the recorded depth is seen through (fits are no more precise)


def fuse(
    scene: Gaussians, weight: torch.Tensor, spare: torch.Tensor, rgb: torch.Tensor, depth: torch.Tensor,
    pose: torch.Tensor, camera: Intrinsics,
) -> tuple[Gaussians, torch.Tensor, torch.Tensor]:  # fmt: skip
    """The scene after a picture rgb float32 [3, H, W] in 0..1 with depth [H, W] in metres (0: unknown, FAR_M: empty) from pose [7];
    the weights [N]; and which Gaussians the picture showed: bool [N].

    weight [N] is the sum of pixels that showed each Gaussian; colours are running means with it. Gaussians that the picture sees
    through fade. New surfaces replace transparent Gaussians among `spare` [S]."""
    size = (rgb.shape[-2], rgb.shape[-1])
    with torch.inference_mode(False), torch.enable_grad():
        bare = torch.zeros(len(scene), 1, 3, requires_grad=True)
        grey = rasterise(replace(scene, sh=bare), pose[None], camera, size)
        with torch.no_grad():
            drawn = rasterise(scene, pose[None], camera, size)
            same, through, new = _classify(drawn.alpha[0], drawn.depth[0], depth)
            sums = torch.stack([same, through, torch.zeros_like(same)]).float()
            off = (rgb - drawn.rgb[0]) * same
        (counts,) = torch.autograd.grad(grey.rgb[0], bare, sums, retain_graph=True)
        (wrong,) = torch.autograd.grad(grey.rgb[0], bare, off)
    agreed, gone = (counts[:, 0, :2] / Y0).unbind(1)
    seen = agreed > ENOUGH
    total = weight + agreed
    step = torch.where(seen[:, None], wrong[:, 0] / Y0 / total.clamp_min(ENOUGH)[:, None], 0.0)
    sh = torch.cat([scene.sh[:, :1] + step[:, None] / Y0, scene.sh[:, 1:]], 1)
    opacities = scene.opacities * (1 - _seen_through(scene, agreed, gone, depth, pose, camera))
    opacities = torch.where((opacities < FADED) & (gone > ENOUGH), 0.0, opacities)
    scene = replace(scene, sh=sh, opacities=opacities)
    fresh, stands = _of_squares(rgb, depth, new, pose, camera)
    free = spare[opacities[spare] < FADED][: len(fresh)]
    some = slice(0, len(free))
    names = "means", "quats", "scales", "opacities"
    parts = {name: getattr(scene, name).index_copy(0, free, getattr(fresh, name)[some]) for name in names}
    extra = fresh.sh.new_zeros(len(free), sh.shape[1] - 1, 3)
    parts["sh"] = sh.index_copy(0, free, torch.cat([fresh.sh[some], extra], 1))
    weight = torch.where(seen, total.clamp_max(MOST), weight).index_copy(0, free, stands[some])
    return Gaussians(**parts), weight, seen.index_fill(0, free, True)


def _classify(alpha: torch.Tensor, depth: torch.Tensor, truth: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """For each pixel [H, W], whether scene and picture show the same surface, the picture one behind it, or one that the scene
    lacks. Edges may be off by a pixel."""
    known, drawn = truth > 0, alpha > 0.5
    mean = depth / alpha.clamp_min(0.5)
    nearest = -_widest(torch.where(drawn, -mean, -FAR_M))
    behind = -_widest(torch.where(known, -truth, -FAR_M))
    new = known & (truth < FAR_M) & (~drawn | (truth < (1 - SAME) * nearest))
    through = known & drawn & (mean < BEFORE * behind)
    return known & drawn & ~new & ~through, through, new


def _widest(picture: torch.Tensor) -> torch.Tensor:
    return F.max_pool2d(picture[None, None], 3, 1, 1)[0, 0]


def _seen_through(scene, agreed, gone, depth, pose, camera) -> torch.Tensor:
    """The share [N] by which Gaussians were seen through, 0 for those behind the recorded surface."""
    height, width = depth.shape
    where, ahead = project(scene.means, pose, camera)
    column = (where[:, 0] * width).clamp(0, width - 1).nan_to_num().long()
    row = (where[:, 1] * height).clamp(0, height - 1).nan_to_num().long()
    before = (ahead > 0) & (ahead < BEFORE * depth[row, column])
    return torch.where(before & (gone > ENOUGH), gone / (gone + agreed).clamp_min(ENOUGH), 0.0)


def _of_squares(rgb, depth, new, pose, camera) -> tuple[Gaussians, torch.Tensor]:
    """Gaussians for the pixels `new` [H, W], the largest squares first, and how many pixels each covers."""
    height, width = depth.shape
    layers = torch.cat([unproject(depth, pose, camera).permute(2, 0, 1), rgb, depth[None]])
    means, sides, left = [], [], new.clone()
    for side in SIDES:
        rows, columns = height // side, width // side
        cut = slice(0, rows * side), slice(0, columns * side)
        squares = layers[:, *cut].reshape(7, rows, side, columns, side).permute(1, 3, 0, 2, 4).flatten(3)
        whole = left[cut].reshape(rows, side, columns, side).permute(0, 2, 1, 3).flatten(2).all(2)
        spread = squares.amax(3) - squares.amin(3)
        whole &= (spread[..., 3:6].amax(2) < ALIKE) & (spread[..., 6] < SAME * squares[..., 6, :].amin(2)) | (side == 1)
        left[cut] &= ~whole.repeat_interleave(side, 0).repeat_interleave(side, 1)
        means.append(squares.mean(3)[whole])
        sides.append(torch.full((len(means[-1]),), float(side)))
    one, side = torch.cat(means), torch.cat(sides)
    scales = (WIDE * side * one[:, 6] / (camera[0] * width)).clamp_min(1e-3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(one), 1)
    fresh = Gaussians(
        one[:, :3], quats, scales[:, None].repeat(1, 3), torch.full((len(one),), OPACITY), plain_sh(one[:, 3:6])
    )
    return fresh, side.square()
