"""Moves, rotates and scales scenes of Gaussians, with their harmonics."""

from dataclasses import replace

import torch

from .gaussians import Gaussians
from .slow import harmonics


def transform(
    gaussians: Gaussians, rot: torch.Tensor, scale: float = 1.0, shift: torch.Tensor | None = None
) -> Gaussians:
    """Every point p becomes scale * rot p + shift; rot [3, 3] a rotation, shift [3]."""
    if scale == 1 and shift is None and torch.equal(rot, torch.eye(3)):
        return gaussians
    means = scale * gaussians.means @ rot.T
    if shift is not None:
        means = means + shift
    spun = multiply_quaternions(quaternion_of(rot), gaussians.quats)
    return replace(
        gaussians, means=means, quats=spun, scales=gaussians.scales * scale, sh=_turned_sh(gaussians.sh, rot)
    )


def multiply_quaternions(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The rotation `one` [4] after each of `other` [N, 4], as quaternions w, x, y, z."""
    a, b, c, d = one.unbind(-1)
    w, x, y, z = other.unbind(-1)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(parts, -1)


def quaternion_of(rot: torch.Tensor) -> torch.Tensor:
    """The quaternion [4] w, x, y, z of a rotation matrix, by the largest of its squares (Shepperd 1978)."""
    m = rot.double()
    t = m.trace()
    k = int(torch.stack([t, *m.diagonal()]).argmax())
    if k == 0:
        q = [1 + t, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    else:
        i, j, n = k - 1, k % 3, (k + 1) % 3
        q = [m[n, j] - m[j, n], torch.tensor(0.0), torch.tensor(0.0), torch.tensor(0.0)]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[n, n]
        q[1 + j], q[1 + n] = m[i, j] + m[j, i], m[i, n] + m[n, i]
    value = torch.stack([torch.as_tensor(part).double() for part in q])
    return (value / value.norm()).float()


def _turned_sh(sh: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """Harmonics [N, K, 3] of a rotated scene, whose values along rot d equal those of `sh` along d, by least squares."""
    many = sh.shape[1]
    if many == 1:
        return sh
    rng = torch.Generator().manual_seed(0)
    ways = torch.randn(256, 3, generator=rng, dtype=torch.float64)
    ways = ways / ways.norm(dim=1, keepdim=True)
    degree = round(many**0.5) - 1
    change = torch.linalg.lstsq(harmonics(ways @ rot.double().T, degree), harmonics(ways, degree)).solution
    return torch.einsum("jk,nkc->njc", change.float(), sh)
