"""Patches: a parallelogram in the world for each pixel of posed depth images, rendered into a new view by ray casting.
So slanted and very near surfaces have exact depth without holes. On a CPU, kernels_numba/surfaces.py does both; the slow twins
also run on GPUs."""

import torch

from ..core.backend import constant, kernels_do, table, where
from .camera import FAR_M, NEAR_M, Intrinsics, rotation, unproject
from .kernels_numba.surfaces import lift
from .views import arrays, each_view

# Steps of a cast: of how many patches, those of the largest pictures, how many pixels are tried. In doom-maze some 5,500 of
# 156,000 coarse patches are in view; of 18,000 fine ones 2,000 fill more than 16 pixels, 50 more than 256.
COARSE_CASTS = (16384, 4), (1024, 64), (256, 10**9)
FINE_CASTS = (10**9, 16), (4096, 256), (512, 10**9)
SLANT = 6.0  # patches longer than this many times those of a wall seen head-on are no surface


def patches(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int) -> torch.Tensor:
    """Depth [..., H, W] seen from `pose` [..., 7] -> patches [..., N, 9]: centre, half side across, half side down (metres, world
    frame).

    One patch per stride x stride block, N = (H // stride) * (W // stride). Sides overlap their neighbours' by half, and
    cross(down, across) points towards the camera. At a depth edge a patch covers only its own pixel; one that is too slanted to be
    distinguished from a bridge between two surfaces has size 0."""
    if not kernels_do(depth):
        return patches_slowly(depth, pose, camera, stride)
    height, width = depth.shape[-2:]
    images, turns, positions = arrays(
        depth.float().reshape(-1, height, width), rotation(pose).reshape(-1, 3, 3), pose[..., :3].reshape(-1, 3)
    )
    made = torch.empty(len(images), patch_count((height, width), stride), 9)
    each_view(lift, [images, turns, positions, made.numpy()], camera, stride, SLANT)
    return made.view(*depth.shape[:-2], patch_count((height, width), stride), 9)


def patch_count(size: tuple[int, int], stride: int) -> int:
    """Patches of a depth image of `size`."""
    return len(range(stride // 2, size[0], stride)) * len(range(stride // 2, size[1], stride))


def patches_slowly(depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int) -> torch.Tensor:
    """The same as `patches`, in plain tensor algebra, also for GPUs."""
    points = unproject(depth, pose, camera)
    across, down = _shorter_difference(points, -2), _shorter_difference(points, -3)
    first = stride // 2
    reach = where(_is_flat(depth, stride), constant(torch.tensor, depth.device, 0.75 * stride), 0.5)[..., None]
    head_on = depth[..., None] / (camera[0] * depth.shape[-1])
    longest = torch.maximum(across.norm(dim=-1, keepdim=True), down.norm(dim=-1, keepdim=True))
    reach = reach * (longest <= SLANT * head_on)
    whole = torch.cat([points, reach * across, reach * down], -1)
    return whole[..., first::stride, first::stride, :].flatten(-3, -2)


def _shorter_difference(points: torch.Tensor, axis: int) -> torch.Tensor:
    """The shorter of the backward and the forward difference along `axis`, which stays on one surface."""
    count = points.shape[axis]
    step = points.diff(dim=axis).index_select(axis, constant(_clamped, points.device, count - 1, 1))
    long = step.square().sum(-1, keepdim=True)
    before, after = (lambda part: part.narrow(axis, 0, count)), (lambda part: part.narrow(axis, 1, count))
    return torch.where(before(long) < after(long), before(step), after(step))


def _is_flat(depth: torch.Tensor, stride: int) -> torch.Tensor:
    """True where 1 / depth is a plane out to a patch's rim, as on any flat surface: [..., H, W]."""
    inverse = 1 / depth.clamp_min(NEAR_M)
    rim = max(1, round(0.75 * stride))
    height, width = depth.shape[-2:]
    images = inverse.reshape(-1, height, width)
    rows, columns = (constant(_clamped, depth.device, length, rim) for length in (height, width))
    padded = images.index_select(1, rows).index_select(2, columns)
    around = ((0, rim), (rim, 0), (rim, rim), (rim, -rim))
    ahead = torch.stack([padded[:, rim + v : rim + v + height, rim + u : rim + u + width] for v, u in around])
    behind = torch.stack([padded[:, rim - v : rim - v + height, rim - u : rim - u + width] for v, u in around])
    bend = (ahead + behind - 2 * images).abs().amax(0)
    return (bend < 0.05 * images).view(depth.shape)


def _clamped(length: int, rim: int) -> torch.Tensor:
    """Indices of `length` pixels and of `rim` more at both ends, which repeat the outermost."""
    return torch.arange(-rim, length + rim).clamp(0, length - 1)


def cast(
    patch: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, size: tuple[int, int], steps=FINE_CASTS
) -> torch.Tensor:
    """Depth [B, H, W] of `patch` [B, N, 9] from `pose` [B, 7], FAR_M where there is none: in plain tensor algebra, for all devices.

    Patches are tried at the first pixels of the boxes around their pictures, in `steps` of fixed sizes, so that no shape depends on
    a value: few pixels of all, more of the largest, all of the very largest. What does not fit is left out."""
    batch, count = patch.shape[:2]
    height, width = size
    rays_, signs = (constant(table, patch.device, *rows) for rows in (_ray_of_pixel(camera, size), _CORNERS))
    turned = torch.cat([patch[..., :3] - pose[:, None, :3], patch[..., 3:]], -1).view(batch, -1, 3) @ rotation(pose)
    sides = turned.view(batch, count, 3, 3)
    centre, across, down = sides.unbind(2)
    normal = torch.linalg.cross(down, across)
    # a ray meets the plane at centre + s across + t down: the depth, s and t by Cramer's rule are ratios of such products
    # with the ray of a pixel, which is linear in its column and row
    products = torch.stack([normal, torch.linalg.cross(centre, down), torch.linalg.cross(across, centre)], 2) @ rays_
    lift = (normal * centre).sum(-1)
    corners = signs @ sides
    ahead = corners[..., :1].clamp_min(NEAR_M)
    focal, middle = (constant(table, patch.device, *pair) for pair in _pixels_of_camera(camera, size))
    places = middle - focal * corners[..., 1:] / ahead
    limits = constant(table, patch.device, width, height)
    first = places.amin(2).ceil().clamp_min(0)
    shape = torch.minimum(places.amax(2).floor() + 1, limits) - first
    seen = (shape.amin(-1) > 0) & (lift < 0) & (centre[..., 0] > NEAR_M)
    area = shape.prod(-1) * seen
    anchored = products[..., 0] + (products[..., 1:] * first[..., None, :]).sum(-1)
    start = first[..., 1:] * width + first[..., :1]
    boxes = torch.cat([anchored, products.flatten(2), lift[..., None], start, shape[..., :1], area[..., None]], -1)
    canvas = pose.new_full((batch, height * width + 1), FAR_M)
    most = max((many for many, _ in steps if many < count), default=0)
    largest = area.topk(most, dim=1).indices[..., None].expand(-1, -1, boxes.shape[2])
    for many, pixels in steps:
        part = boxes if many >= count else boxes.gather(1, largest[:, :many])
        _cast_boxes(part, width, min(pixels, height * width), canvas)
    return canvas[:, :-1].view(batch, height, width)


def _cast_boxes(boxes: torch.Tensor, width: int, pixels: int, canvas: torch.Tensor) -> None:
    """Lowers `canvas` [B, H * W + 1] at the first `pixels` pixels of the boxes [B, n, 16] of patches."""
    number = constant(torch.arange, boxes.device, float(pixels))
    lift, start, wide, area = boxes[..., 12:].unsqueeze(3).unbind(2)
    row = (number / wide).floor()
    column = torch.addcmul(number, row, wide, value=-1)
    anchored, products = boxes[..., :3, None], boxes[..., 3:12].unflatten(2, (3, 3))[..., None]
    along = torch.addcmul(anchored, products[:, :, :, 1], column[:, :, None])
    ratios = torch.addcmul(along, products[:, :, :, 2], row[:, :, None])
    sizes = ratios.abs()
    far = lift / ratios[:, :, 0]
    hit = (sizes[:, :, 1:].amax(2) <= sizes[:, :, 0]) & (far > NEAR_M) & (number < area)
    pixel = where(hit, torch.add(column, row, alpha=width) + start, canvas.shape[1] - 1.0).long()
    canvas.scatter_reduce_(1, pixel.flatten(1), far.flatten(1), "amin")


_CORNERS = (1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (1.0, -1.0, -1.0)


def _ray_of_pixel(camera: Intrinsics, size: tuple[int, int]) -> tuple[tuple[float, ...], ...]:
    """[3, 3], by which a vector is multiplied for its products with the ray through column u and row v: a + b u + c v."""
    (fx, fy, cx, cy), (height, width) = camera, size
    return (
        (1.0, 0.0, 0.0),
        ((cx - 0.5 / width) / fx, -1 / (fx * width), 0.0),
        ((cy - 0.5 / height) / fy, 0.0, -1 / (fy * height)),
    )


def _pixels_of_camera(camera: Intrinsics, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point in pixels, counted from the middle of the first."""
    (fx, fy, cx, cy), (height, width) = camera, size
    return (fx * width, fy * height), (cx * width - 0.5, cy * height - 0.5)
