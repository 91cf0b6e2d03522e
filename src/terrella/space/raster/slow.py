"""The slow twin of rasterise.py, for tests: every Gaussian at every pixel, in plain tensor algebra."""

import math

import torch

from ..camera import NEAR_M, Intrinsics, rotation
from ..kernels_numba.splats import BLUR, FAINTEST
from ..kernels_numba.tiles import OPAQUE
from .gaussians import Gaussians
from .rasterise import Drawing


def rasterise_slowly(
    gaussians: Gaussians,
    pose: torch.Tensor,
    camera: Intrinsics | None,
    size: tuple[int, int],
    near_m: float = NEAR_M,
) -> Drawing:
    """The same as `rasterise`, in the precision of the Gaussians; needs B H W N numbers at once."""
    views = [_view(gaussians, one.to(gaussians.means), camera, size, near_m) for one in pose]
    return Drawing(*(torch.stack(parts) for parts in zip(*views)))


def _view(gaussians: Gaussians, pose: torch.Tensor, camera: Intrinsics | None, size: tuple[int, int], near_m: float):
    height, width = size
    turn, offset = rotation(pose), gaussians.means - pose[:3]
    local = offset @ turn
    lens = None if camera is None else (camera[0] * width, camera[1] * height, camera[2] * width, camera[3] * height)
    at, far, slopes = _pinhole(local, lens, size) if lens is not None else _panorama(local, size)
    axes = _matrices(gaussians.quats) * gaussians.scales[:, None]
    spread = slopes @ turn.mT @ axes
    covariance = spread @ spread.mT + float(BLUR) * torch.eye(2).to(spread)
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    off = torch.stack([columns, rows], -1).to(at).view(-1, 1, 2) - at
    if camera is None:
        off = torch.stack([off[..., 0] - width * torch.floor(off[..., 0] / width + 0.5).detach(), off[..., 1]], -1)
    q = ((off[..., None, :] @ covariance.inverse())[..., 0, :] * off).sum(-1) / 2
    shown = _in_sight(gaussians, local, lens, size, near_m) & (gaussians.opacities > float(FAINTEST))
    most = (gaussians.opacities.clamp_min(1e-9) / float(FAINTEST)).log()
    alpha = (gaussians.opacities * (-q).exp()).clamp_max(float(OPAQUE)) * ((q <= most) & shown)
    order = torch.where(shown, far, torch.inf).argsort(stable=True)
    alpha, colours = alpha[:, order], _colours(gaussians, offset)[order]
    left = torch.cat([torch.ones_like(alpha[:, :1]), (1 - alpha).cumprod(1)], 1)
    weight = alpha * left[:, :-1]
    best, place = weight.max(1)
    ids = torch.where(best > 0, order[place], -1).view(size).int()
    rgb, depth = (weight @ colours).T.view(3, *size), (weight @ far[order]).view(size)
    return rgb, depth, 1 - left[:, -1].view(size), ids


def _pinhole(local: torch.Tensor, lens, size: tuple[int, int]):
    """Pixels [N, 2], depth [N] and how the pixels change with the point [N, 2, 3]; held linear far outside of the image."""
    (fx, fy, cx, cy), (height, width) = lens, size
    ahead = torch.where(local[:, 0] > 1e-4, local[:, 0], 1.0)
    a, b = local[:, 1] / ahead, local[:, 2] / ahead
    at = torch.stack([cx - fx * a, cy - fy * b], 1)
    wide, tall = 1.3 * max(cx, width - cx) / fx, 1.3 * max(cy, height - cy) / fy
    a, b, zero = a.clamp(-wide, wide), b.clamp(-tall, tall), torch.zeros_like(a)
    slopes = torch.stack([fx * a, -fx + zero, zero, fy * b, zero, -fy + zero], 1).view(-1, 2, 3) / ahead[:, None, None]
    return at, local[:, 0], slopes


def _panorama(local: torch.Tensor, size: tuple[int, int]):
    """The same for a picture of all directions."""
    height, width = size
    d, left, up = local.unbind(1)
    flat2 = d * d + left * left
    flat, r2 = flat2.sqrt(), flat2 + up * up
    wide, tall = width / (2 * math.pi), height / math.pi
    at = torch.stack([width / 2 - wide * torch.atan2(left, d), height / 2 - tall * torch.atan2(up, flat)], 1)
    s = tall * up / (flat * r2)
    slopes = torch.stack([wide * left / flat2, -wide * d / flat2, 0 * d, s * d, s * left, -tall * flat / r2], 1)
    return at, r2.sqrt(), slopes.view(-1, 2, 3)


def _in_sight(gaussians: Gaussians, local: torch.Tensor, lens, size: tuple[int, int], near_m: float) -> torch.Tensor:
    d, left, up = local.unbind(1)
    if lens is None:
        flat2 = d * d + left * left
        return (flat2 + up * up >= near_m**2) & (flat2 >= 1e-6 * up * up)
    reach, (fx, fy, cx, cy), (height, width) = 3.34 * gaussians.scales.amax(1), lens, size
    wide, tall = max(cx, width - cx) / fx, max(cy, height - cy) / fy
    beside = left.abs() - wide * 1.02 * d > reach * math.sqrt(1 + wide * wide) + 2 / fx * d
    above = up.abs() - tall * 1.02 * d > reach * math.sqrt(1 + tall * tall) + 2 / fy * d
    return (d >= near_m) & ~beside & ~above


def _matrices(quats: torch.Tensor) -> torch.Tensor:
    """[N, 4] -> rotation matrices [N, 3, 3]."""
    return rotation(torch.cat([torch.zeros_like(quats[:, :3]), quats], 1))


def _colours(gaussians: Gaussians, offset: torch.Tensor) -> torch.Tensor:
    values = harmonics(offset / offset.norm(dim=1, keepdim=True).clamp_min(1e-12), gaussians.degree)
    return (0.5 + (values[..., None] * gaussians.sh).sum(1)).clamp_min(0)


def harmonics(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Real spherical harmonics of unit vectors [N, 3] up to a degree of 0 to 3: [N, (degree + 1)^2]."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    parts = [torch.full_like(x, 0.28209479177387814), -0.4886025119029199 * y, 0.4886025119029199 * z,
             -0.4886025119029199 * x, 1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
             0.31539156525252005 * (2 * zz - xx - yy), -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
             -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
             -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
             -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
             -0.5900435899266435 * x * (xx - 3 * yy)]  # fmt: skip
    return torch.stack(parts[: (degree + 1) ** 2], -1)
