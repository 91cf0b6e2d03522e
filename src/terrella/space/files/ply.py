"""PLY: its header and tables (hostile ones are rejected), and Gaussians as in 3D Gaussian Splatting's code and gsplat."""

import numpy as np
import torch

from ..raster import Gaussians
from ..raster.gaussians import plain_sh

LONGEST_HEADER, MOST = 1 << 16, 1 << 24
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


def parse(data: bytes) -> dict[str, np.ndarray]:
    """The elements of a binary PLY as structured arrays; ValueError for anything else."""
    end = data.find(b"end_header\n", 0, LONGEST_HEADER)
    windows = data.find(b"end_header\r\n", 0, LONGEST_HEADER)
    if end < 0 and windows < 0:
        raise ValueError("its header has no end")
    body = end + 11 if end >= 0 else windows + 12
    lines = [line.split() for line in data[:body].decode("ascii", "replace").splitlines()]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise ValueError("it is not binary_little_endian")
    tables: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in lines:
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or not int(words[2]) <= MOST:
                raise ValueError(f"its element line '{' '.join(words)[:80]}' counts no sensible number")
            tables.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _TYPES or not tables or len(tables[-1][2]) >= 1000:
                raise ValueError(f"its property line '{' '.join(words)[:80]}' is not understood")
            tables[-1][2].append((words[2], _TYPES[words[1]]))
    elements = {}
    for name, count, columns in tables:
        kind = np.dtype(columns)  # ValueError for columns of one name
        if body + count * kind.itemsize > len(data):
            raise ValueError(f"it ends before its {count:,} rows of '{name}' do")
        elements[name] = np.frombuffer(data, kind, count, body)
        body += count * kind.itemsize
    return elements


def decode(elements: dict[str, np.ndarray]) -> Gaussians:
    """The element `vertex` of a scene; a cloud of coloured points becomes small round Gaussians."""
    rows = elements["vertex"]
    if not len(rows):
        raise ValueError("it holds no points")
    means = columns(rows, "x", "y", "z")
    if "scale_0" not in (rows.dtype.names or ()):
        colours = columns(rows, "red", "green", "blue") / 255
        spread = (means.amax(0) - means.amin(0)).norm() / max(len(rows), 1) ** 0.5
        scales = torch.full((len(rows), 3), float(spread) * 0.4)
        quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(rows), 1)
        return Gaussians(means, quats, scales, torch.full((len(rows),), 0.9), plain_sh(colours))
    rest = [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    many = {0: 1, 9: 4, 24: 9, 45: 16}.get(len(rest))
    if many is None:
        raise ValueError(f"it has {len(rest)} numbers of harmonics besides the first, and not 0, 9, 24 or 45")
    sh = columns(rows, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        more = columns(rows, *(f"f_rest_{k}" for k in range(len(rest)))).view(len(rows), 3, many - 1).transpose(1, 2)
        sh = torch.cat([sh, more], 1)
    scales, opacities = columns(rows, "scale_0", "scale_1", "scale_2").exp(), columns(rows, "opacity")[:, 0].sigmoid()
    return Gaussians(means, columns(rows, "rot_0", "rot_1", "rot_2", "rot_3"), scales, opacities, sh.contiguous())


def columns(rows: np.ndarray, *names: str) -> torch.Tensor:
    """float32 [n, names]; KeyError for one that is missing."""
    missing = [name for name in names if name not in (rows.dtype.names or ())]
    if missing:
        raise KeyError(", ".join(missing))
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(np.stack([rows[name].astype(np.float32) for name in names], 1))


def encode(gaussians: Gaussians) -> bytes:
    """As 3D Gaussian Splatting's code writes a scene."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    parts = [
        gaussians.means, torch.zeros_like(gaussians.means), gaussians.sh[:, 0], rest,
        gaussians.opacities.clamp(1e-6, 1 - 1e-6).logit()[:, None], gaussians.scales.clamp_min(1e-9).log(), gaussians.quats,
    ]  # fmt: skip
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(rest.shape[1])] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in names)]
    return header(lines) + torch.cat(parts, 1).numpy().astype("<f4").tobytes()


def header(lines: list[str]) -> bytes:
    """A header with these lines of elements and properties."""
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode()
