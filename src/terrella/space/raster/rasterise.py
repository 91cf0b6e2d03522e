"""Renders Gaussians on all cores with gradients, by compiled kernels: projected, sorted by depth once for the whole picture,
assigned to tiles, and painted from front to back until a tile is opaque. slow.py is the same in plain tensor algebra."""

from typing import Any, NamedTuple

import numpy as np
import torch

from ...core.errors import ContractError
from ..camera import NEAR_M, Intrinsics, rotation
from ..kernels_numba import splats as kernels
from ..kernels_numba import tiles
from ..views import arrays, over_views
from .gaussians import Gaussians

MOST = 1 << 24  # Gaussians of a scene: their numbers are painted as float32


class Drawing(NamedTuple):
    """rgb float32 [B, 3, H, W], black where empty; depth [B, H, W] metres, weighted as the colours are (divide by alpha for the
    mean); alpha [B, H, W] in 0..1; ids int32 [B, H, W], the Gaussian with the largest weight, -1 for none."""

    rgb: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor
    ids: torch.Tensor


def rasterise(
    gaussians: Gaussians,
    pose: torch.Tensor,
    camera: Intrinsics | None,
    size: tuple[int, int],
    near_m: float = NEAR_M,
) -> Drawing:
    """The Gaussians from `pose` [B, 7] (T_world_cam) through a pinhole camera, or without one in all directions (equirectangular:
    the middle is forward, the left edge backward, depth is the distance). size: height, width. Gradients flow to the Gaussians,
    not to the poses. ContractError for more than 2**24 Gaussians."""
    if len(gaussians) >= MOST:
        raise ContractError(f"a scene has fewer than {MOST:,} Gaussians; this one has {len(gaussians):,}: thin it out.")
    parts = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
    views = [_Draw.apply(*parts, one, camera, size, near_m) for one in pose.detach()]
    if not views:
        nothing = gaussians.means.new_zeros(0, *size)
        return Drawing(nothing[:, None].expand(0, 3, *size), nothing, nothing, nothing.int())
    picture, ids = views[0][0][None], views[0][1][None]
    if len(views) > 1:
        picture, ids = (torch.stack(parts) for parts in zip(*views))
    return Drawing(picture[:, :3], picture[:, 3], picture[:, 4], ids)


class _Draw(torch.autograd.Function):
    """One view: the picture [5, H, W] = red, green, blue, depth and alpha, and ids [H, W]."""

    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh, pose, camera, size, near_m):
        parts = arrays(*(part.float() for part in (means, quats, scales, opacities, sh)))
        view = _View(pose, camera, size, near_m)
        splats, which = _project(parts, view)
        starts, items = _tiles(splats, view)
        picture = np.empty((5, *size), np.float32)
        ids, ends = np.empty(size, np.int32), np.empty(len(starts) - 1, np.int64)
        count = torch.get_num_threads()

        def paint(first: int, last: int) -> None:
            for part in range(first, last):
                tiles.paint_tiles(part, count, splats, which, starts, items, view.around, picture, ids, ends)

        over_views(count, paint)
        ctx.kept = parts, view, splats, which, starts, items, ends, picture
        given = torch.from_numpy(picture), torch.from_numpy(ids)
        ctx.mark_non_differentiable(given[1])
        return given

    @staticmethod
    def backward(ctx: Any, g_picture, g_ids):  # pyright: ignore[reportIncompatibleMethodOverride]
        parts, view, splats, which, starts, items, ends, picture = ctx.kept
        means, quats, scales, _, sh = parts
        count = torch.get_num_threads()
        grads = np.zeros((count, len(splats), 10), np.float32)
        slopes = g_picture.float().contiguous().numpy()

        def paint(first: int, last: int) -> None:
            for part in range(first, last):
                tiles.paint_back(part, count, splats, starts, items, ends, view.around, picture, slopes, grads[part])

        over_views(count, paint)
        given = [np.zeros_like(part) for part in parts]
        rest = [grads, splats, which, means, quats, scales, sh, *view.lens, view.panorama, *given]
        over_views(len(splats), lambda first, last: kernels.project_back(first, last, *rest))
        return *(torch.from_numpy(part) for part in given), None, None, None, None


class _View:
    """A camera for the kernels: `lens` = its place [3], rotation [3, 3], and fx, fy, cx, cy in pixels, width, height."""

    def __init__(self, pose: torch.Tensor, camera: Intrinsics | None, size: tuple[int, int], near_m: float):
        height, width = self.size = size
        fx, fy, cx, cy = camera or (1.0, 1.0, 0.5, 0.5)
        numbers = np.array([fx * width, fy * height, cx * width, cy * height, width, height], np.float32)
        (turn,) = arrays(rotation(pose.double()).float())
        self.lens: list[Any] = [*arrays(pose[:3].float()), turn, numbers]
        self.panorama, self.near = camera is None, np.float32(near_m)
        self.around = width if self.panorama else 0


def _project(parts, view: _View) -> tuple[np.ndarray, np.ndarray]:
    """The visible splats [V, SPLAT], nearest first, and the indices of their Gaussians [V]."""
    total, threads = len(parts[0]), torch.get_num_threads()
    splats = np.empty((total, kernels.SPLAT), np.float32)
    which, depths = np.empty(total, np.int32), np.empty(total, np.float32)
    bounds = [total * part // threads for part in range(threads + 1)]
    counts = [0] * threads

    given = [*parts, *view.lens, view.panorama, view.near, splats, which, depths]

    def project(first: int, last: int) -> None:
        for part in range(first, last):
            counts[part] = kernels.project(bounds[part], bounds[part + 1], *given)

    over_views(threads, project)
    order = np.concatenate([np.arange(first, first + n, dtype=np.int32) for first, n in zip(bounds, counts)])
    keys = depths[order].view(np.uint32)
    order = tiles.depth_order(keys, order, np.empty_like(keys), np.empty_like(order))
    near = np.empty((len(order), kernels.SPLAT), np.float32), np.empty(len(order), np.int32)
    over_views(len(order), lambda first, last: tiles.gather(first, last, order, splats, which, *near))
    return near


def _tiles(splats: np.ndarray, view: _View) -> tuple[np.ndarray, np.ndarray]:
    """The splats of each tile, nearest first: `items`, those of tile t from starts[t] to starts[t + 1]."""
    (height, width), threads = view.size, torch.get_num_threads()
    many = -(-height // tiles.TILE) * -(-width // tiles.TILE)
    bounds = [len(splats) * part // threads for part in range(threads + 1)]
    counts, items = np.zeros((threads, many), np.int64), np.empty(0, np.int32)

    def share(fill: bool) -> None:
        def work(first: int, last: int) -> None:
            for part in range(first, last):
                ends = bounds[part], bounds[part + 1]
                tiles.bin_splats(*ends, splats, width, height, view.around, counts[part], items, fill)

        over_views(threads, work)

    share(False)
    ends = counts.T.reshape(-1).cumsum()  # of each tile the parts one after the other
    starts = np.concatenate([[0], ends[threads - 1 :: threads]])
    items = np.empty(int(ends[-1]) if len(ends) else 0, np.int32)
    counts = np.ascontiguousarray(np.concatenate([[0], ends[:-1]]).reshape(many, threads).T)
    share(True)
    return starts, items
