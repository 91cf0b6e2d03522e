"""Billboards: objects as upright pictures that face the camera, cut out of frames and painted into them. A billboard has the place
of its feet (x, y, z in metres, world frame), a picture [4, *PICTURE] (rgb and cover in [0, 1]) and a box [4], its extent to the
left, to the right, below and above its feet, in metres across the line of sight."""

from typing import NamedTuple

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do, plus, table, where
from .camera import Intrinsics, pixel_intrinsics, project
from .kernels_numba.paint import TOUCHED, paint_views
from .views import arrays, over_views

PICTURE = (48, 32)  # rows and columns of a billboard's picture
NEAREST_M = 0.25  # nearer billboards are not painted
BEHIND_M = 0.4  # a billboard this far behind the visible surface is still painted, because its feet are in the floor


class Cutout(NamedTuple):
    """n billboards that frames show."""

    view: torch.Tensor  # int64 [n], the frame
    row: torch.Tensor  # int64 [n], the row in the frame's list of billboards
    picture: torch.Tensor  # float32 [n, 4, *PICTURE]
    box: torch.Tensor  # float32 [n, 4]
    pixels: torch.Tensor  # int64 [n], how many pixels show it
    whole: torch.Tensor  # bool [n], neither cut off by the frame's edge nor partly hidden


def cut_out(
    rgb: torch.Tensor,
    instances: torch.Tensor,
    depth: torch.Tensor,
    places: torch.Tensor,
    pose: torch.Tensor,
    camera: Intrinsics,
) -> Cutout:
    """The billboards in frames: rgb uint8 [B, 3, H, W]; instances [B, h, w], the number of the place [B, K, 3] seen at a pixel,
    from 1 (0: none); depth [B, h, w] metres; pose [B, 7]."""
    height, width = rgb.shape[-2:]
    numbered, depth = (
        F.interpolate(part[:, None].float(), (height, width), mode="nearest-exact")[:, 0] for part in (instances, depth)
    )
    numbers = torch.arange(1, places.shape[1] + 1, device=rgb.device)
    masks = numbered[:, None] == numbers[:, None, None]
    view, row = masks.flatten(2).any(-1).nonzero(as_tuple=True)
    masks = masks[view, row]
    if not len(view):
        nothing = torch.zeros(0)
        return Cutout(view, row, torch.zeros(0, 4, *PICTURE), torch.zeros(0, 4), nothing.long(), nothing.bool())
    at, ahead = project(places, pose, camera)
    at, ahead = at[view, row], ahead[view, row].clamp_min(NEAREST_M)
    first_column, last_column = _ends(masks.any(1))
    first_row, last_row = _ends(masks.any(2))
    left, right = first_column / width, (last_column + 1) / width
    top, bottom = first_row / height, (last_row + 1) / height
    across, along = ahead / camera[0], ahead / camera[1]
    box = torch.stack(
        [(at[:, 0] - left) * across, (right - at[:, 0]) * across,
         (bottom - at[:, 1]) * along, (at[:, 1] - top) * along], 1
    )  # fmt: skip
    grid = F.affine_grid(_onto(left, right, top, bottom), [len(view), 1, *PICTURE], align_corners=False)
    frames = torch.cat([rgb.float()[view] / 255 * masks[:, None], masks[:, None].float()], 1)
    picture = F.grid_sample(frames, grid, align_corners=False)
    picture[:, :3] = picture[:, :3] / picture[:, 3:].clamp_min(1e-3)
    around = F.max_pool2d(masks[:, None].float(), 5, 1, 2)[:, 0].bool() & ~masks
    hidden = (around & (depth[view] < (ahead - 2 * BEHIND_M)[:, None, None])).flatten(1).any(1)
    cut = (first_column == 0) | (last_column == width - 1) | (first_row == 0) | (last_row == height - 1)
    return Cutout(view, row, picture, box, masks.flatten(1).sum(1), ~(cut | hidden))


def paint_billboards(
    rgb: torch.Tensor,
    depth: torch.Tensor,
    billboards: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    present: torch.Tensor,
    pose: torch.Tensor,
    camera: Intrinsics,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Frames with billboards painted behind nearer surfaces: rgb [B, 3, H, W] in [0, 1], depth [B, H, W] metres, and the number of
    the billboard at each pixel, from 1 (uint8 [B, H, W], 0: none).

    rgb and depth are the background; billboards = places [B, K, 3], pictures [B, K, 4, *PICTURE], boxes [B, K, 4]; present [B, K]
    bool."""
    if not kernels_do(rgb):
        return paint_billboards_slowly(rgb, depth, billboards, present, pose, camera)
    order, present, sides, far = _placed(billboards, present, pose, camera, depth.shape[-2:])
    rgb, onto, instances = rgb.clone(), depth.clone(), torch.zeros(depth.shape, dtype=torch.uint8)
    given = arrays(order, present, billboards[1], sides.double(), far.double(), depth + BEHIND_M)
    parts = [*given, *arrays(rgb, onto, instances)]
    over_views(len(rgb), lambda first, last: paint_views(first, last, *parts))
    return rgb, onto, instances


def _placed(billboards, present, pose, camera, size) -> tuple[torch.Tensor, ...]:
    """Billboards in pictures of `size`: their order [B, K], the nearest last; which are in front of the camera [B, K]; the sides
    of their boxes [B, K, 4] in pixels (left, right, top, bottom); and their depths [B, K]."""
    places, _, boxes = billboards
    at, ahead = project(places, pose, lens := pixel_intrinsics(camera, size))
    present = present & (ahead > NEAREST_M)
    far = where(present, ahead, 1.0)
    order = constant(torch.tensor, pose.device, (0, 1, 3, 2))
    focal = constant(table, pose.device, (-lens[0], lens[0]), (-lens[1], lens[1])) / far[..., None, None]
    sides = torch.addcmul(at[..., None], boxes.index_select(2, order).unflatten(2, (2, 2)), focal).flatten(2)
    return far.argsort(dim=1, descending=True, stable=True), present, sides, far


def paint_billboards_slowly(
    rgb, depth, billboards, present, pose, camera
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The same as `paint_billboards`, in plain tensor algebra, all billboards of all views at once; also for GPUs."""
    (batch, height, width), count = depth.shape, billboards[0].shape[1]
    farthest, present, sides, far = _placed(billboards, present, pose, camera, (height, width))
    pictures = billboards[1].flatten(0, 1)
    quarters = constant(_quarters, rgb.device, 2 * max(height, width))
    first, last = sides.clamp(-1e6, 1e6).view(batch, count, 2, 2, 1).unbind(3)
    at = plus(-1.0, (quarters - first) / (last - first).clamp_min(1e-6), 2)
    across, down = at[:, :, 0, : 2 * width], at[:, :, 1, : 2 * height]
    grid = torch.stack(torch.broadcast_tensors(across[:, :, None], down[..., None]), -1)
    drawn = F.grid_sample(pictures, grid.flatten(0, 1), padding_mode="border", align_corners=False)
    within = torch.linalg.vector_norm(grid, torch.inf, dim=-1) <= 1
    mask = (drawn[:, 3:] > 0.5) & within.flatten(0, 1)[:, None]
    small = F.avg_pool2d(torch.cat([drawn[:, :3] * mask, mask], 1), 2).unflatten(0, (batch, count))
    shown = (far[..., None, None] < (depth + BEHIND_M)[:, None]) & present[..., None, None]
    small = small * shown[:, :, None]
    # the nearest first; what is left of each after those before it
    order = farthest.flip(1)
    small = small.gather(1, order[..., None, None, None].expand_as(small))
    colour, cover = small[:, :, :3], small[:, :, 3]
    left = F.pad((1 - cover).cumprod(1), (0, 0, 0, 0, 1, 0), value=1.0)
    rgb = torch.addcmul((colour * left[:, :-1, None]).sum(1), rgb, left[:, -1:])
    ranks = constant(torch.arange, rgb.device, count, 0, -1)[:, None, None]
    least = constant(torch.tensor, rgb.device, (0.5, TOUCHED))[:, None, None, None, None]
    ranked = ((cover > least) * ranks).amax(2)  # by how near they are, 0 for none
    listed = F.pad(torch.stack([far.gather(1, farthest), farthest + 1]), (1, 0))  # depths and numbers, none first
    nearest, instances = listed.gather(2, ranked.flatten(2)).view_as(ranked)
    return rgb, torch.where(ranked[0] > 0, nearest, depth), instances.to(torch.uint8)


def _quarters(count: int) -> torch.Tensor:
    """Two samples along each side of a pixel."""
    return torch.arange(count) / 2 + 0.25


def _ends(line: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The indices of the first and the last True in each row of [n, L]: [n] each."""
    whole = line.float()
    return whole.argmax(1), line.shape[1] - 1 - whole.flip(1).argmax(1)


def _onto(left, right, top, bottom) -> torch.Tensor:
    """The affine map [n, 2, 3] from [-1, 1] to a box of the image with sides in 0..1."""
    zero = torch.zeros_like(left)
    across = torch.stack([right - left, zero, right + left - 1], 1)
    along = torch.stack([zero, bottom - top, bottom + top - 1], 1)
    return torch.stack([across, along], 1).float()
