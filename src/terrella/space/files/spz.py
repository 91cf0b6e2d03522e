"""SPZ, versions 1 to 4 (github.com/nianticlabs/spz): fixed-point places, bytes for other numbers; gzip, or zstd streams (4)."""

import gzip
import io
import struct
import warnings
import zlib
from typing import Literal

import numpy as np
import pyarrow as pa
import torch

from ..raster import Gaussians

Version = Literal[3, 4]  # that can be written
MAGIC, MOST = b"NGSP", 1 << 24
_SH_WIDTH = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}
_FRACTION = 12  # bits of a metre
_HEAD, _HEAD_4, _STREAM = struct.Struct("<4sIIBBBB"), struct.Struct("<4sIIBBBBI12x"), struct.Struct("<QQ")
_LEVEL, _PIECE = 12, 1 << 20  # of zstd: that of the reference; bytes that are unpacked at once


def decode(data: bytes) -> Gaussians:
    """ValueError for what is not whole, too large, or of another version; warns where harmonics above degree 3 are left out."""
    version, count, degree, fraction, body = _streams(data) if data[:4] == MAGIC else _unzipped(data)
    parts, at = [], 0
    for size in _sizes(version, degree):
        parts.append(np.frombuffer(body, np.uint8, count * size, at).reshape(count, size))
        at += count * size
    if degree > 3:
        warnings.warn("Its harmonics of degree 4 are left out; those up to degree 3 are kept.", stacklevel=2)
    bytes_of = [torch.from_numpy(part.astype(np.float32)) for part in (*parts[:5], parts[5][:, : 3 * _SH_WIDTH[3]])]
    sh = ((bytes_of[2] / 255 - 0.5) / 0.15)[:, None]
    if degree:
        sh = torch.cat([sh, ((bytes_of[5] - 128) / 128).view(count, -1, 3)], 1)
    means = _floats(parts[0]) if version == 1 else _fixed(parts[0], fraction)
    quats = _smallest_three(parts[4]) if version >= 3 else _first_three(bytes_of[4])
    return Gaussians(means, quats, (bytes_of[3] / 16 - 10).exp(), bytes_of[1][:, 0] / 255, sh.contiguous())


def _sizes(version: int, degree: int) -> list[int]:
    """Bytes per Gaussian of place, opacity, colour, scales, quaternion and harmonics, in the order of the file."""
    return [6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * _SH_WIDTH[degree]]


def _about(head: bytes, versions: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Version, count, degree and bits of a header."""
    if len(head) < _HEAD.size:
        raise ValueError("it ends within its header")
    magic, version, count, degree, fraction, _, _ = _HEAD.unpack_from(head)
    if magic != MAGIC:
        raise ValueError("it is gzip, but no SPZ")
    if version not in versions:
        raise ValueError(f"it is SPZ of version {version}, which here is not {' or '.join(map(str, versions))}")
    if not 0 < count < MOST or degree not in _SH_WIDTH or fraction > 23:
        raise ValueError(f"its header speaks of {count:,} points of degree {degree}")
    return version, count, degree, fraction


def _unzipped(data: bytes) -> tuple[int, int, int, int, bytes]:
    """Version, count, degree, bits and all parts of versions 1 to 3."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            version, count, degree, fraction = _about(file.read(_HEAD.size), (1, 2, 3))
            size = count * sum(_sizes(version, degree))
            body = file.read(size + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"its gzip is broken ({error})") from error
    if len(body) < size:
        raise ValueError(f"it ends before its {count:,} points do")
    return version, count, degree, fraction, body


def _streams(data: bytes) -> tuple[int, int, int, int, bytes]:
    """The same for version 4: a table of streams, each compressed. Extensions before the table are ignored."""
    version, count, degree, fraction = _about(data, (4,))
    sizes = [count * size for size in _sizes(version, degree) if size]
    if len(data) < _HEAD_4.size:
        raise ValueError("it ends within its header")
    *_, many, table = _HEAD_4.unpack_from(data)
    at = table + many * _STREAM.size
    if many != len(sizes) or table < _HEAD_4.size or at > len(data):
        raise ValueError(f"its table of {many} streams is not that of {count:,} points of degree {degree}")
    parts = []
    for k, size in enumerate(sizes):
        packed, unpacked = _STREAM.unpack_from(data, table + k * _STREAM.size)
        if unpacked != size or packed > len(data) - at:
            raise ValueError(
                f"its stream {k + 1} is not as long as its {count:,} points want, or the file ends within it"
            )
        parts.append(_unpacked(data[at : at + packed], size))
        at += packed
    return version, count, degree, fraction, b"".join(parts)


def _unpacked(data: bytes, size: int) -> bytes:
    """`size` bytes of a zstd stream, in pieces, so that a false size takes no memory."""
    parts = []
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), "zstd") as stream:
            while size and (part := stream.read(min(size, _PIECE))):
                parts.append(part)
                size -= len(part)
    except OSError as error:
        raise ValueError(f"a stream of it is broken ({error})") from error
    if size:
        raise ValueError("a stream of it ends before its points do")
    return b"".join(parts)


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
    """Quaternions of the index of the largest of x, y, z, w (2 bits) and the others from the last on: 9 bits and a sign each."""
    packed = np.ascontiguousarray(part).view("<u4")[:, 0].astype(np.int64)
    which, quats = packed >> 30, np.zeros((len(packed), 4), np.float32)
    for axis in (3, 2, 1, 0):
        here = which != axis
        value = (packed & 511) / 511 * 0.5**0.5 * np.where(packed & 512, -1, 1)
        quats[here, axis] = value[here]
        packed = np.where(here, packed >> 10, packed)
    quats[np.arange(len(quats)), which] = np.sqrt(np.maximum(1 - (quats**2).sum(1), 0))
    return torch.from_numpy(quats[:, [3, 0, 1, 2]])


def encode(gaussians: Gaussians, version: Version = 3) -> bytes:
    """Places are exact to a quarter of a millimetre up to 2,048 m, and less exact for larger scenes."""
    far = float(gaussians.means.abs().amax().clamp_min(1e-6))
    fraction = int(np.clip(np.floor(np.log2((2**23 - 1) / far)), 0, _FRACTION))
    whole = (gaussians.means.double() * 2**fraction).round().clamp(-(2**23), 2**23 - 1).long().numpy() & 0xFFFFFF
    places = np.stack([whole & 255, whole >> 8 & 255, whole >> 16], -1).astype(np.uint8)
    byte = lambda part: part.round().clamp(0, 255).numpy().astype(np.uint8).tobytes()  # noqa: E731
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    body = [places.tobytes(), byte(gaussians.opacities * 255), byte((gaussians.sh[:, 0] * 0.15 + 0.5) * 255),
            byte((gaussians.scales.clamp_min(1e-9).log() + 10) * 16), _packed(quats[:, [1, 2, 3, 0]].numpy()),
            byte(gaussians.sh[:, 1:].flatten(1) * 128 + 128)]  # fmt: skip
    about = MAGIC, version, len(gaussians), gaussians.degree, fraction, 0
    if version == 3:
        return gzip.compress(_HEAD.pack(*about, 0) + b"".join(body), mtime=0)
    zstd = pa.Codec("zstd", _LEVEL)
    streams = [(zstd.compress(part, asbytes=True), len(part)) for part in body if part]
    table = [_STREAM.pack(len(packed), size) for packed, size in streams]
    return b"".join([_HEAD_4.pack(*about, len(streams), _HEAD_4.size), *table, *(packed for packed, _ in streams)])


def _packed(xyzw: np.ndarray) -> bytes:
    which = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[np.arange(len(xyzw)), which] < 0, -1, 1)[:, None]
    packed = which.astype(np.int64)
    for axis in range(4):
        here = which != axis
        size = np.rint(np.clip(np.abs(xyzw[:, axis]) * 2**0.5, 0, 1) * 511).astype(np.int64)
        packed = np.where(here, packed << 10 | (xyzw[:, axis] < 0).astype(np.int64) << 9 | size, packed)
    return packed.astype("<u4").tobytes()
