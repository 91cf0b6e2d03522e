"""Pinhole cameras and rigid poses: pixels to rays, depth to points, points to pixels.

Frames: world z up; camera x forward, y left, z up. A pose is float32 [..., 7]: x, y, z in metres, then the quaternion
w, x, y, z of T_world_cam. Depth is metres along the optical axis. Intrinsics are (fx/W, fy/H, cx/W, cy/H)."""

import math
from collections.abc import Sequence

import torch

from ..core.backend import constant, table

Intrinsics = tuple[float, float, float, float]

NEAR_M = 0.05  # nearer surfaces are not drawn
OUTSIDE = 1024  # cells of a z-buffer that take what is out of view
FAR_M = 100.0  # the depth of pixels where nothing is known
SAME = 0.06  # depths that differ by less than this share belong to one surface

_STAY = torch.eye(3).flatten()
_TURN = torch.tensor(  # from the products ww, wx, wy, wz, xw, ... of a quaternion to its rotation minus the identity
    [
        [[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, -2], [0, 2, 0]],
         [[0, 0, 2], [0, 0, 0], [-2, 0, 0]], [[0, -2, 0], [2, 0, 0], [0, 0, 0]]],
        [[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, -2, 0], [0, 0, -2]],
         [[0, 2, 0], [2, 0, 0], [0, 0, 0]], [[0, 0, 2], [0, 0, 0], [2, 0, 0]]],
        [[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
         [[-2, 0, 0], [0, 0, 0], [0, 0, -2]], [[0, 0, 0], [0, 0, 2], [0, 2, 0]]],
        [[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
         [[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[-2, 0, 0], [0, -2, 0], [0, 0, 0]]],
    ],
    dtype=torch.float32,
).view(16, 9)  # fmt: skip
_TURN = torch.cat([_TURN, torch.eye(4).view(16, 1)], 1)  # times its squared length, which comes last
_ABOVE_0 = torch.tensor([0.0] * 9 + [1e-24])  # added to that
_HEADING = torch.zeros(16, 2)  # sine and cosine of the heading, less (0, 1/2)
_AHEAD = torch.tensor([0.0, 0.5])
_HEADING[[3, 6], 0], _HEADING[[10, 15], 1] = 1.0, -1.0


def rays(camera: Intrinsics, height: int, width: int, device=None) -> torch.Tensor:
    """Directions through the pixel centres in the camera frame, scaled so that x (forward) is 1: float32 [H, W, 3]."""
    return constant(_rays, torch.device(device or "cpu"), tuple(camera), height, width)


def _rays(camera: Intrinsics, height: int, width: int) -> torch.Tensor:
    fx, fy, cx, cy = camera
    u, v = (torch.arange(width) + 0.5) / width, (torch.arange(height) + 0.5) / height
    left, up = -(u - cx) / fx, -(v - cy) / fy
    return torch.stack([torch.ones(height, width), left.expand(height, width), up[:, None].expand(height, width)], -1)


def rotation(pose: torch.Tensor) -> torch.Tensor:
    """Rotation matrices of T_world_cam: [..., 7] -> [..., 3, 3]."""
    turn, stay, above = (constant(part.to, pose.device, pose.dtype) for part in (_TURN, _STAY, _ABOVE_0))
    turned = torch.addmm(above, _products(pose).reshape(-1, 16), turn)
    return torch.addcdiv(stay, turned[:, :9], turned[:, 9:]).view(*pose.shape[:-1], 3, 3)


def _products(pose: torch.Tensor) -> torch.Tensor:
    """ww, wx, wy, wz, xw, ... of the quaternions [..., 16]."""
    quaternion = pose[..., 3:]
    return (quaternion[..., :, None] * quaternion[..., None, :]).flatten(-2)


def unproject(
    depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, turn: torch.Tensor | None = None
) -> torch.Tensor:
    """Depth [..., H, W] seen from `pose` [..., 7], whose rotations are `turn` [..., 3, 3] -> world points [..., H, W, 3]; of V
    depth images from each pose, [..., V, H, W], points [..., V, H, W, 3]."""
    points = (depth[..., None] * rays(camera, *depth.shape[-2:], device=depth.device)).flatten(pose.ndim - 1, -2)
    turn = rotation(pose) if turn is None else turn
    eye, turn = pose[..., None, :3].reshape(-1, 1, 3), turn.mT.reshape(-1, 3, 3)
    return torch.baddbmm(eye, points.reshape(-1, *points.shape[-2:]), turn).view(*depth.shape, 3)


def project(
    points: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, turn: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """World points [..., N, 3] into the view of `pose` [..., 7], whose rotations are `turn` [..., 3, 3]: image coordinates in
    [0, 1] [..., N, 2], depth [..., N]. Points behind the camera have depth <= 0 and meaningless coordinates."""
    turn = rotation(pose) if turn is None else turn
    scale, middle = (constant(table, pose.device, *row) for row in ((1.0, -camera[0], -camera[1]), camera[2:]))
    local = (points - pose[..., None, :3]) @ (turn * scale)
    depth = local[..., 0]
    return torch.addcdiv(middle, local[..., 1:], depth.clamp_min(1e-4)[..., None]), depth


def pixel_intrinsics(camera: Intrinsics, size: Sequence[int]) -> Intrinsics:
    """Those by which `project` gives pixels, [0, W] x [0, H]."""
    (fx, fy, cx, cy), (height, width) = camera, size
    return fx * width, fy * height, cx * width, cy * height


def grid_intrinsics(camera: Intrinsics) -> Intrinsics:
    """Those by which `project` gives [-1, 1], as torch's `grid_sample` wants it."""
    fx, fy, cx, cy = camera
    return 2 * fx, 2 * fy, 2 * cx - 1, 2 * cy - 1


def pixels_at(places: torch.Tensor, size: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor]:
    """The pixel at each of `places` [..., 2], counted along rows, or the nearest: int64 [...]; and whether it lies in the picture,
    bool [...]."""
    inside = torch.fmax(places, constant(torch.tensor, places.device, 0.0))  # fmax and fmin pass over nan
    inside = torch.fmin(inside, constant(_last, places.device, *size))
    column, row = inside.long().unbind(-1)
    return torch.add(column, row, alpha=size[1]), (inside == places).all(-1)


def _last(height: int, width: int) -> torch.Tensor:
    """The largest coordinates that lie in a picture."""
    return torch.nextafter(torch.tensor([float(width), float(height)]), torch.zeros(2))


def cells_outside(count: int, end: float) -> torch.Tensor:
    """For each of `count` points one of the OUTSIDE last cells before `end`, which takes the point if it is out of view. All in a
    single cell would be taken by a GPU one after the other."""
    return end - 1 - torch.arange(count) % OUTSIDE


def relative_pose(body: torch.Tensor, camera: torch.Tensor) -> torch.Tensor:
    """T_body_cam [..., 7] of T_world_body and T_world_cam [..., 7]."""
    place = ((camera[..., :3] - body[..., :3])[..., None, :] @ rotation(body))[..., 0, :]
    w, axis, turned, toward = body[..., 3:4], -body[..., 4:], camera[..., 3:4], camera[..., 4:]
    real = w * turned - (axis * toward).sum(-1, keepdim=True)
    turn = torch.cat([real, w * toward + turned * axis + torch.linalg.cross(axis, toward)], -1)
    return torch.cat([place, turn / turn.norm(dim=-1, keepdim=True)], -1)


def yaw(pose: torch.Tensor) -> torch.Tensor:
    """Heading in radians, counter-clockwise from world x: [..., 7] -> [...]."""
    facing, ahead = (constant(part.to, pose.device, pose.dtype) for part in (_HEADING, _AHEAD))
    return torch.atan2(
        *torch.addmm(ahead, _products(pose).reshape(-1, 16), facing).view(*pose.shape[:-1], 2).unbind(-1)
    )


def turn_between(pose: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """The angle in radians, 0 or more, between the heading of `pose` [B, 7] and those of `others` [B, n, 7]: [B, n]."""
    facing, ahead, turned = (constant(part.to, pose.device, pose.dtype) for part in (_HEADING, _AHEAD, _RELATIVE))
    products = _products(torch.cat([pose[:, None], others], 1))
    headings = torch.addmm(ahead, products.view(-1, 16), facing).view(*products.shape[:-1], 2)
    sides = headings[:, 1:] @ (headings[:, 0] @ turned).view(-1, 2, 2)  # sine and cosine of the angle
    return torch.atan2(*sides.unbind(-1)).abs()


_RELATIVE = torch.tensor(
    [[0.0, 1.0, -1.0, 0.0], [1.0, 0.0, 0.0, 1.0]]
)  # a sine and cosine to the matrix that turns back by it


def tilted_pose(
    x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, heading: torch.Tensor, pitch: torch.Tensor
) -> torch.Tensor:
    """A pose at (x, y, z) metres that looks along `heading` and `pitch` (upwards) radians: [...] each -> [..., 7]."""
    c, s, cp, sp = torch.cos(heading / 2), torch.sin(heading / 2), torch.cos(pitch / 2), -torch.sin(pitch / 2)
    return torch.stack([x, y, z, c * cp, -s * sp, c * sp, s * cp], -1)


def planar_pose(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
    """A level pose at (x, y, z) metres that looks along `heading` radians: [...] each -> [..., 7]."""
    half = heading / 2
    zero = constant(torch.tensor, half.device, 0.0).expand_as(half)
    return torch.stack([x, y, z, torch.cos(half), zero, zero, torch.sin(half)], -1)


def directions(height: int) -> torch.Tensor:
    """Unit vectors [H, 2H, 3] through the pixels of a panorama: x forward in its middle, y left, z up."""
    lon = math.pi * (1 - (torch.arange(2 * height) + 0.5) / height)
    lat = math.pi * (0.5 - (torch.arange(height) + 0.5) / height)[:, None]
    level = lat.cos()
    return torch.stack([level * lon.cos(), level * lon.sin(), lat.sin().expand(height, 2 * height)], -1)
