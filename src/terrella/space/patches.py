"""Patches: a parallelogram in the world for each pixel of posed depth images, rendered into a new view by ray casting.
So slanted and very near surfaces have exact depth without holes. On a CPU, kernels_numba/surfaces.py does both; the slow twins
also run on GPUs."""

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do, table, where
from .camera import NEAR_M, OUTSIDE, Intrinsics, cells_outside, rotation, unproject
from .kernels_numba.surfaces import lift
from .views import arrays, each_view

# Steps of a cast: of how many patches, those of the largest pictures, how many pixels are tried. In doom-maze some 5,500 of
# 156,000 coarse patches are in view; of 18,000 fine ones 2,000 fill more than 16 pixels, 50 more than 256.
# In 16 views of both bundled worlds no pixel differs from that of twice as many patches and pixels. Pictures larger than USUAL have
# more large patches, in proportion.
COARSE_CASTS = (16384, 4), (1024, 10**9)
FINE_CASTS = (10**9, 64), (160, 10**9)
USUAL = 96 * 128  # pixels
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


def patches_slowly(
    depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, stride: int, turn: torch.Tensor | None = None
) -> torch.Tensor:
    """The same as `patches`, in plain tensor algebra, also for GPUs; `turn` [..., 3, 3]: the rotations of the poses."""
    points, (height, width) = unproject(depth, pose, camera, turn), depth.shape[-2:]
    kept, images = (..., *[slice(stride // 2, None, stride)] * 2), depth.reshape(-1, height * width)
    ends = constant(_steps, depth.device, height, width, stride)
    steps = points.view(-1, height * width, 3)[:, ends].diff(dim=1)
    steps = steps.view(*depth.shape[:-2], *ends.shape[1:], 3)  # [..., h, w, axis, before or after, 3]
    long = torch.linalg.vector_norm(steps, dim=-1)
    sides = torch.where((long[..., 0] < long[..., 1])[..., None], steps[..., 0, :], steps[..., 1, :])
    flat = _is_flat(images, height, width, stride).view(*depth.shape[:-2], *ends.shape[1:3])
    reach = where(flat, constant(torch.tensor, depth.device, 0.75 * stride), 0.5)
    reach = reach * (long.amin(-1).amax(-1) <= depth[kept] * (SLANT / (camera[0] * width)))
    whole = torch.cat([points[(*kept, slice(None))], (reach[..., None, None] * sides).flatten(-2)], -1)
    return whole.flatten(-3, -2)


def _steps(height: int, width: int, stride: int) -> torch.Tensor:
    """int64 [2, h, w, 2, 2]: the pixels from which, and to which, the steps before and after a patch's pixel lead, to the right and
    down. At a rim both are the one that there is."""
    first, before = stride // 2, torch.tensor([-1, 0])
    rows, columns = torch.arange(first, height, stride)[:, None, None], torch.arange(first, width, stride)[:, None]
    right = rows * width + (columns + before).clamp(0, width - 2)
    down = (rows + before).clamp(0, height - 2) * width + columns
    return torch.stack([torch.stack([right, down], 2), torch.stack([right + 1, down + width], 2)])


def _is_flat(images: torch.Tensor, height: int, width: int, stride: int) -> torch.Tensor:
    """True where 1 / depth is a plane out to a patch's rim, as on any flat surface: of depth images [K, H W], bool [K, n] for each
    patch."""
    inverse = images.clamp_min(NEAR_M).reciprocal()[:, constant(_around, images.device, height, width, stride)]
    bend = constant(_bends, images.device) @ inverse
    return torch.linalg.vector_norm(bend, torch.inf, dim=1) < inverse[:, -1]


def _bends() -> torch.Tensor:
    """[4, 9]: of what lies `_around`, opposite pixels less twice the middle, in shares of 0.05."""
    return torch.cat([torch.eye(4), torch.eye(4), torch.full((4, 1), -2.0)], 1) / 0.05


def _middles(height: int, width: int, stride: int) -> torch.Tensor:
    """int64 [n]: the pixels of patches."""
    first = stride // 2
    return (torch.arange(first, height, stride)[:, None] * width + torch.arange(first, width, stride)).flatten()


def _around(height: int, width: int, stride: int) -> torch.Tensor:
    """int64 [9, n]: the four pixels at the rims of patches, the opposite ones, and the middle; at the picture's rim its own."""
    middles, rim = _middles(height, width, stride), max(1, round(0.75 * stride))
    steps = rim * torch.tensor([[0, 1], [1, 0], [1, 1], [1, -1]])[:, :, None]
    ways = torch.cat([steps, -steps, 0 * steps[:1]])
    rows, columns = middles // width + ways[:, 0], middles % width + ways[:, 1]
    return rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1)


def cast_inverse(
    patch: torch.Tensor,
    pose: torch.Tensor,
    camera: Intrinsics,
    size: tuple[int, int],
    steps=FINE_CASTS,
    turn: torch.Tensor | None = None,
) -> torch.Tensor:
    """1 / depth [B, H, W] of `patch` [B, N, 9] from `pose` [B, 7], whose rotations are `turn` [B, 3, 3], 0 where there is none: in
    plain tensor algebra, for all devices.

    Patches are tried at the first pixels of the boxes around their pictures, in `steps` of fixed sizes, so that no shape depends on
    a value: few pixels of all, more of the largest, all of the very largest. What does not fit is left out."""
    batch, count = patch.shape[:2]
    height, width = size
    taken, *ends_ = _pixels_of_camera(camera, size)
    middle, limits = (constant(table, patch.device, *rows) for rows in ends_)
    corners_of = constant(_corners_of_sides, patch.device, taken)  # one large product: a GPU does small ones one by one
    edges_of, edges = (constant(make, patch.device, camera, size) for make in (_edges_of_normals, _edges))
    apart = patch - F.pad(pose[:, None, :3], (0, 6))
    turn = rotation(pose) if turn is None else turn
    sides = (apart.view(batch, -1, 3) @ turn).view(batch, count, 3, 3)  # centre, across, down
    one, other = sides.index_select(2, constant(torch.tensor, patch.device, (1, 0, 1, 2, 2, 0))).split(3, 2)
    normals = torch.linalg.cross(one, other)
    lift = (normals[:, :, 0] * sides[:, :, 0]).sum(-1)
    lines = torch.addcdiv(edges, normals.flatten(2) @ edges_of, lift[..., None])
    corners = (sides.flatten(2) @ corners_of).unflatten(2, (4, 5))
    places = torch.addcdiv(middle, corners[..., 1:], corners[..., :1].clamp_min(NEAR_M))
    ends = torch.maximum(places.amin(2).ceil(), limits)  # the first column and row, and minus those after the last
    shape = (ends @ constant(table, patch.device, *_SHAPE_OF_ENDS)).clamp_min(0)
    shape = shape * ((lift > 0) & (sides[:, :, 0, 0] > NEAR_M))[..., None]
    level, across, down = lines.split(EDGES, 2)
    begin = torch.addcmul(torch.addcmul(level, across, ends[..., :1]), down, ends[..., 1:2])
    parts = begin[..., :-1], shape[..., 1:], lines[..., EDGES:], shape[..., :1]
    boxes = torch.cat([part.mT for part in parts], 1)
    canvas = pose.new_zeros(batch, height * width + OUTSIDE)
    steps = [(many * max(1, round(height * width / USUAL)), tried) for many, tried in steps]
    most = max((many for many, _ in steps if many < count), default=0)
    largest = shape.prod(-1).topk(most, dim=1).indices[:, None].expand(-1, boxes.shape[1], -1)
    for many, tried in steps:
        part = boxes if many >= count else boxes.gather(2, largest[..., :many])
        _cast_boxes(part, min(tried, height * width), canvas)
    return canvas[:, :-OUTSIDE].view(batch, height, width)


# Linear functions of a pixel: its number, 1 / depth of the plane there, then those that are above 0 in the patch and in its box.
EDGES = 8


def _cast_boxes(boxes: torch.Tensor, pixels: int, canvas: torch.Tensor) -> None:
    """Raises `canvas` [B, H * W + OUTSIDE], 1 / depth, at the first `pixels` pixels of the boxes of patches [B, 3 EDGES + 1, n]:
    the EDGES functions at the first pixel, what they gain by a column and by a row, and how wide the box is."""
    number = constant(torch.arange, boxes.device, float(pixels))
    *functions, wide = boxes[..., None].split((EDGES, EDGES, EDGES, 1), 1)
    begin, across, down = functions
    row = torch.div(number, wide[:, 0], rounding_mode="floor")
    column = torch.addcmul(number, row, wide[:, 0], value=-1)
    lines = torch.addcmul(begin, across, column[:, None]).addcmul_(down, row[:, None])  # in place: the largest tensor
    hit = lines[:, 2:].amin(1) > 0
    aside = constant(cells_outside, boxes.device, hit.shape[1] * pixels, float(canvas.shape[1])).view(hit.shape[1:])
    pixel = torch.where(hit, lines[:, 0], aside).long()
    canvas.scatter_reduce_(1, pixel.flatten(1), lines[:, 1].flatten(1), "amax")


def _edges_of_normals(camera: Intrinsics, size: tuple[int, int]) -> torch.Tensor:
    """[9, 3 EDGES], by which three normals [9] are multiplied for the EDGES functions at the first pixel, and what they gain by a
    column and by a row, times `lift`. A ray meets a plane at centre + s across + t down: by Cramer's rule lift / depth, and this
    times s and t, are the products of the normals with it."""
    ratios = torch.tensor([(0, 1, 1, 1, 1, 1, -1, 0), (0, 0, -1, 1, 0, 0, 0, 0), (0, 0, 0, 0, -1, 1, 0, 0)])
    rays = table(*_ray_of_pixel(camera, size))
    return (ratios[:, None, None] * rays[..., None]).reshape(9, 3 * EDGES)


def _edges(camera: Intrinsics, size: tuple[int, int]) -> torch.Tensor:
    """[3 EDGES], what is added to these: a pixel's number is column + width * row, the plane is not too near, and the row in the
    box."""
    level, across, down = (0.0,) * 6 + (1 / NEAR_M, 0.0), (1.0,) + (0.0,) * 7, (float(size[1]),) + (0.0,) * 6 + (-1.0,)
    return table(*level, *across, *down)


_SHAPE_OF_ENDS = (-1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, -1.0)
_CORNERS = (1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (1.0, -1.0, -1.0)


def _corners_of_sides(taken: tuple[tuple[float, ...], ...]) -> torch.Tensor:
    """[9, 20], by which centre, half side across and down [9] are multiplied for what the matrix `taken` [3, 5] makes of the four
    corners."""
    made = (
        torch.tensor(_CORNERS).mT[:, None, :, None] * torch.tensor(taken)[:, None]
    )  # [centre or side, axis, corner, made]
    return made.reshape(9, 20)


def _ray_of_pixel(camera: Intrinsics, size: tuple[int, int]) -> tuple[tuple[float, ...], ...]:
    """[3, 3], by which a vector is multiplied for its products with the ray through column u and row v: a + b u + c v."""
    (fx, fy, cx, cy), (height, width) = camera, size
    return (
        (1.0, 0.0, 0.0),
        ((cx - 0.5 / width) / fx, -1 / (fx * width), 0.0),
        ((cy - 0.5 / height) / fy, 0.0, -1 / (fy * height)),
    )


def _pixels_of_camera(camera: Intrinsics, size: tuple[int, int]) -> tuple[tuple, tuple[float, ...], tuple[float, ...]]:
    """A matrix [3, 5] and numbers [4] that project a vector: after the matrix, numbers + (last four) / first = u, v, -u - 1, -v - 1
    for the pixel u, v, counted from the middle of the first one. And the least that these four are in a picture."""
    (fx, fy, cx, cy), (height, width) = camera, size
    (u, v), (x, y) = (fx * width, fy * height), (cx * width - 0.5, cy * height - 0.5)
    taken = (1.0, 0.0, 0.0, 0.0, 0.0), (0.0, -u, 0.0, u, 0.0), (0.0, 0.0, -v, 0.0, v)
    return taken, (x, y, -x - 1, -y - 1), (0.0, 0.0, -float(width), -float(height))
