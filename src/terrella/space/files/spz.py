"""SPZ, versions 1 to 3 (github.com/nianticlabs/spz): gzip around fixed-point places and a byte for nearly every other number."""

from __future__ import annotations

import gzip
import io
import struct
import zlib

import numpy as np
import torch

from ..raster import Gaussians

MAGIC, MOST = 0x5053474E, 1 << 24
_SH_WIDTH = {0: 0, 1: 3, 2: 8, 3: 15}
_FRACTION = 12  # bits of a metre


def decode(data: bytes) -> Gaussians:
    """ValueError for what is not whole, too large, or of another version."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            head = file.read(16)
            if len(head) < 16:
                raise ValueError("it ends within its header")
            magic, version, count, degree, fraction, _, _ = struct.unpack("<IIIBBBB", head)
            if magic != MAGIC or version not in (1, 2, 3):
                raise ValueError(
                    f"it is SPZ of version {version}, which is not 1, 2 or 3"
                    if magic == MAGIC
                    else "it is gzip, but no SPZ"
                )
            if not 0 < count < MOST or degree not in _SH_WIDTH or fraction > 23:
                raise ValueError(f"its header speaks of {count:,} points of degree {degree}")
            sizes = [6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * _SH_WIDTH[degree]]
            body = file.read(count * sum(sizes) + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"its gzip is broken ({error})") from error
    if len(body) < count * sum(sizes):
        raise ValueError(f"it ends before its {count:,} points do")
    parts, at = [], 0
    for size in sizes:
        parts.append(np.frombuffer(body, np.uint8, count * size, at).reshape(count, size))
        at += count * size
    bytes_of = [torch.from_numpy(part.astype(np.float32)) for part in parts]
    sh = ((bytes_of[2] / 255 - 0.5) / 0.15)[:, None]
    if degree:
        sh = torch.cat([sh, ((bytes_of[5] - 128) / 128).view(count, _SH_WIDTH[degree], 3)], 1)
    means = _floats(parts[0]) if version == 1 else _fixed(parts[0], fraction)
    quats = _smallest_three(parts[4]) if version == 3 else _first_three(bytes_of[4])
    return Gaussians(means, quats, (bytes_of[3] / 16 - 10).exp(), bytes_of[1][:, 0] / 255, sh.contiguous())


def _floats(part: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(part).view("<f2").astype(np.float32))


def _fixed(part: np.ndarray, fraction: int) -> torch.Tensor:
    """Signed 24 bit numbers with `fraction` bits behind the point: [n, 3]."""
    three = part.reshape(-1, 3, 3).astype(np.int32)
    whole = three[..., 0] | three[..., 1] << 8 | three[..., 2] << 16
    return torch.from_numpy(np.where(whole >= 1 << 23, whole - (1 << 24), whole).astype(np.float32) / (1 << fraction))


def _first_three(part: torch.Tensor) -> torch.Tensor:
    xyz = part / 127.5 - 1
    return torch.cat([(1 - xyz.square().sum(1, keepdim=True)).clamp_min(0).sqrt(), xyz], 1)


def _smallest_three(part: np.ndarray) -> torch.Tensor:
    """Of x, y, z, w which is largest (2 bits), the others from the last one on: 9 bits and a sign each."""
    packed = np.ascontiguousarray(part).view("<u4")[:, 0].astype(np.int64)
    which, found = packed >> 30, np.zeros((len(packed), 4), np.float32)
    for axis in (3, 2, 1, 0):
        here = which != axis
        value = (packed & 511) / 511 * 0.5**0.5 * np.where(packed & 512, -1, 1)
        found[here, axis] = value[here]
        packed = np.where(here, packed >> 10, packed)
    rest = np.sqrt(np.maximum(1 - (found**2).sum(1), 0))
    found[np.arange(len(found)), which] = rest
    return torch.from_numpy(found[:, [3, 0, 1, 2]])


def encode(gaussians: Gaussians) -> bytes:
    """Version 3; places as far as 2,048 m to a quarter of a millimetre, farther ones less exactly."""
    far = float(gaussians.means.abs().amax().clamp_min(1e-6))
    fraction = int(np.clip(np.floor(np.log2((2**23 - 1) / far)), 0, _FRACTION))
    whole = (gaussians.means.double() * 2**fraction).round().clamp(-(2**23), 2**23 - 1).long().numpy() & 0xFFFFFF
    places = np.stack([whole & 255, whole >> 8 & 255, whole >> 16], -1).astype(np.uint8)
    byte = lambda part: part.round().clamp(0, 255).numpy().astype(np.uint8).tobytes()  # noqa: E731
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    body = [places.tobytes(), byte(gaussians.opacities * 255), byte((gaussians.sh[:, 0] * 0.15 + 0.5) * 255),
            byte((gaussians.scales.clamp_min(1e-9).log() + 10) * 16), _packed(quats[:, [1, 2, 3, 0]].numpy()),
            byte(gaussians.sh[:, 1:].flatten(1) * 128 + 128)]  # fmt: skip
    head = struct.pack("<IIIBBBB", MAGIC, 3, len(gaussians), gaussians.degree, fraction, 0, 0)
    return gzip.compress(head + b"".join(body), mtime=0)


def _packed(xyzw: np.ndarray) -> bytes:
    which = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[np.arange(len(xyzw)), which] < 0, -1, 1)[:, None]
    packed = which.astype(np.int64)
    for axis in range(4):
        here = which != axis
        size = np.rint(np.clip(np.abs(xyzw[:, axis]) * 2**0.5, 0, 1) * 511).astype(np.int64)
        packed = np.where(here, packed << 10 | (xyzw[:, axis] < 0).astype(np.int64) << 9 | size, packed)
    return packed.astype("<u4").tobytes()
