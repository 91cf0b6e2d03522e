"""SuperSplat's compressed PLY: 16 bytes per Gaussian, in blocks of 256 with limits; harmonics a byte per number."""

import numpy as np
import torch

from ..raster import Gaussians
from ..raster.gaussians import Y0
from . import ply

BLOCK = 256
_LIMITS = [f"{end}_{axis}" for kind in ("", "scale_") for end in (f"min_{kind}", f"max_{kind}") for axis in "xyz"]
_LIMITS = [name.replace("__", "_") for name in _LIMITS]
_COLOURS = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]


def decode(elements: dict[str, np.ndarray]) -> Gaussians:
    """The elements `chunk`, `vertex` and, where there is one, `sh`."""
    blocks, rows = elements["chunk"], elements["vertex"]
    if not len(rows) or len(blocks) * BLOCK < len(rows):
        raise ValueError(f"it has {len(blocks)} blocks for {len(rows)} points")
    limits = ply.columns(blocks, *_LIMITS)[torch.arange(len(rows)) // BLOCK]
    packed = {
        name: torch.from_numpy(_whole(rows, f"packed_{name}")) for name in ("position", "rotation", "scale", "color")
    }
    thirds = lambda x: torch.stack([(x >> 21) / 2047, ((x >> 11) & 1023) / 1023, (x & 2047) / 2047], 1)  # noqa: E731
    between = lambda share, first: limits[:, first : first + 3].lerp(limits[:, first + 3 : first + 6], share)  # noqa: E731
    means, scales = between(thirds(packed["position"]), 0), between(thirds(packed["scale"]), 6).exp()
    colour = torch.stack([((packed["color"] >> shift) & 255) / 255 for shift in (24, 16, 8, 0)], 1)
    shades = colour[:, :3]
    if "min_r" in (blocks.dtype.names or ()):
        low, high = ply.columns(blocks, *_COLOURS)[torch.arange(len(rows)) // BLOCK].split(3, 1)
        shades = low.lerp(high, shades)
    sh = ((shades - 0.5) / Y0)[:, None]
    if "sh" in elements:
        rest = elements["sh"]
        width = len(rest.dtype.names or ())
        if len(rest) != len(rows) or width not in (9, 24, 45):
            raise ValueError("its harmonics fit no degree from 1 to 3")
        byte = ply.columns(rest, *(f"f_rest_{k}" for k in range(width)))
        share = torch.where(byte == 0, 0.0, torch.where(byte == 255, 1.0, (byte + 0.5) / 256))
        sh = torch.cat([sh, ((share - 0.5) * 8).view(len(rows), 3, width // 3).transpose(1, 2)], 1)
    return Gaussians(means, unpacked_quats(packed["rotation"]), scales, colour[:, 3].contiguous(), sh.contiguous())


def _whole(rows: np.ndarray, name: str) -> np.ndarray:
    if name not in (rows.dtype.names or ()):
        raise KeyError(name)
    return rows[name].astype(np.int64)


def unpacked_quats(packed: torch.Tensor) -> torch.Tensor:
    """Quaternions w, x, y, z [n, 4] of int64 [n]: the index of the largest component (2 bits), the other three in 10 bits each."""
    three = torch.stack([((packed >> shift) & 1023) / 1023 - 0.5 for shift in (20, 10, 0)], 1) * 2**0.5
    return whole_quats(three, packed >> 30)


def whole_quats(three: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
    """Unit quaternions [n, 4] from their three smaller components [n, 3] and the index of the largest, int64 [n]."""
    whole = torch.zeros(len(three), 4)
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[which]
    largest = (1 - three.square().sum(1, keepdim=True)).clamp_min(0).sqrt()
    return whole.scatter(1, others, three).scatter(1, which[:, None], largest)


def packed_quats(quats: torch.Tensor) -> torch.Tensor:
    """The inverse of `unpacked_quats`."""
    quats = quats / quats.norm(dim=1, keepdim=True)
    which = quats.abs().argmax(1)
    quats = quats * torch.where(quats.gather(1, which[:, None]) < 0, -1.0, 1.0)
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[which]
    three = ((quats.gather(1, others) / 2**0.5 + 0.5).clamp(0, 1) * 1023).round().long()
    return (which << 30) | (three[:, 0] << 20) | (three[:, 1] << 10) | three[:, 2]


def encode(gaussians: Gaussians, axes: str = "rdf") -> bytes:
    """A compressed PLY, with the Gaussians in Morton order, so that blocks are small in space."""
    low = gaussians.means.amin(0)
    cell = (gaussians.means - low) / (gaussians.means.amax(0) - low).clamp_min(1e-9) * 1023
    bits = cell.long().clamp(0, 1023)
    code = sum(((bits[:, axis] >> bit) & 1) << (3 * bit + axis) for axis in range(3) for bit in range(10))
    gaussians = gaussians.at(torch.as_tensor(code).argsort(stable=True))
    count = len(gaussians)
    block = torch.arange(count) // BLOCK
    shades = 0.5 + Y0 * gaussians.sh[:, 0]
    limits, shares = [], []
    for part in (gaussians.means, gaussians.scales.clamp_min(1e-9).log().clamp(-20, 20), shades):
        index = block[:, None].expand(-1, 3)
        least = torch.full((int(block[-1]) + 1, 3), torch.inf).scatter_reduce(0, index, part, "amin")
        most = torch.full_like(least, -torch.inf).scatter_reduce(0, index, part, "amax")
        limits += [least, most]
        shares.append(((part - least[block]) / (most - least)[block].clamp_min(1e-9)).clamp(0, 1))
    byte = (torch.cat([shares[2], gaussians.opacities[:, None]], 1) * 255).round().long()
    colour = (byte[:, 0] << 24) | (byte[:, 1] << 16) | (byte[:, 2] << 8) | byte[:, 3]
    packed = torch.stack([_packed(shares[0]), packed_quats(gaussians.quats), _packed(shares[1]), colour], 1)
    lines = [f"element chunk {int(block[-1]) + 1}", *(f"property float {name}" for name in (*_LIMITS, *_COLOURS))]
    lines += [
        f"element vertex {count}",
        *(f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")),
    ]
    body = torch.cat(limits, 1).numpy().astype("<f4").tobytes() + packed.numpy().astype("<u4").tobytes()
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    if rest.shape[1]:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{k}" for k in range(rest.shape[1]))]
        body += ((rest / 8 + 0.5) * 256).floor().clamp(0, 255).numpy().astype("u1").tobytes()
    return ply.header(lines, axes) + body


def _packed(shares: torch.Tensor) -> torch.Tensor:
    """Three shares in 0..1 [n, 3] in 11, 10 and 11 bits: int64 [n]."""
    whole = (shares * torch.tensor([2047, 1023, 2047])).round().long()
    return (whole[:, 0] << 21) | (whole[:, 1] << 11) | whole[:, 2]
