"""PLY: its header and tables (hostile ones are rejected), and Gaussians as in 3D Gaussian Splatting's code and gsplat."""

import re
from itertools import takewhile

import numpy as np
import torch

from ..raster import Gaussians
from ..raster.gaussians import plain_sh

LONGEST_HEADER, MOST = 1 << 16, 1 << 24
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_COLUMN = re.compile(r"[xyz]|(diffuse_)?(red|green|blue)|[rgb]|alpha|opacity|(f_dc|f_rest|scale|rot)_\d+")
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_SPELT = {
    "rdf": "x right, y down, z forward", "rub": "x right, y up, z back", "flu": "x forward, y left, z up",
}  # fmt: skip


def parse(data: bytes) -> dict[str, np.ndarray]:
    """The elements of a PLY (binary or ASCII) as structured arrays, up to the first one with lists (faces); ValueError for anything
    else."""
    form, tables, body = _header(data)
    plain = takewhile(lambda table: all(kind for _, kind in table[2]), tables)
    kinds = [(name, count, np.dtype(columns)) for name, count, columns in plain]  # ValueError for columns of one name
    if "vertex" in {name for name, *_ in tables} - {name for name, *_ in kinds}:
        raise ValueError(
            "its points hold lists, or come after lists (faces), which are not read: save the points first"
        )
    return _rows_of_text(data[body:], kinds) if form == "ascii" else _rows(data, body, kinds)


def other_elements(data: bytes) -> list[str]:
    """Elements of a PLY beside points and what belongs to Gaussians, such as the faces of a mesh, with their numbers."""
    others = [(name, count) for name, count, _ in _header(data)[1] if name not in ("vertex", "chunk", "sh")]
    return [f"{count:,} {name}{'s' * (count > 1)}" for name, count in others if count]


def other_columns(rows: np.ndarray) -> list[str]:
    """Columns of the element `vertex` that no Gaussian is made of, such as labels; of Gaussians the normals, always 0, are none."""
    names = rows.dtype.names or ()
    return [
        name
        for name in names
        if not _COLUMN.fullmatch(name) and not ("scale_0" in names and name in ("nx", "ny", "nz"))
    ]


def _header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """The format; name, number and columns of each element, with types ("" for lists); and where the header ends."""
    mark = re.search(rb"end_header[ \t]*\r?\n?", data[:LONGEST_HEADER])
    if mark is None:
        raise ValueError("its header has no end")
    lines = [line.split() for line in data[: mark.start()].decode("ascii", "replace").splitlines()]
    form = next((words[1] for words in lines if len(words) == 3 and words[0] == "format"), "")
    if form not in _ORDERS:
        raise ValueError("it states no format of PLY")
    tables: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in lines:
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or not int(words[2]) <= MOST:
                raise ValueError(f"its element line '{' '.join(words)[:80]}' counts no sensible number")
            tables.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"] and tables and len(words) == 5:
            tables[-1][2].append((words[4], ""))
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _TYPES or not tables or len(tables[-1][2]) >= 1000:
                raise ValueError(f"its property line '{' '.join(words)[:80]}' is not understood")
            tables[-1][2].append((words[2], _ORDERS[form] + _TYPES[words[1]]))
    return form, [(name, count, _in_small_letters(columns)) for name, count, columns in tables], mark.end()


def _in_small_letters(columns: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Columns with names in small letters (X, Red), where these differ."""
    small = [(name.lower(), kind) for name, kind in columns]
    return small if len(dict(small)) == len(small) else columns


def _rows(data: bytes, at: int, kinds: list[tuple[str, int, np.dtype]]) -> dict[str, np.ndarray]:
    elements = {}
    for name, count, kind in kinds:
        if at + count * kind.itemsize > len(data):
            raise ValueError(f"it ends before its {count:,} rows of '{name}' do")
        elements[name] = np.frombuffer(data, kind, count, at)
        at += count * kind.itemsize
    return elements


def _rows_of_text(data: bytes, kinds: list[tuple[str, int, np.dtype]]) -> dict[str, np.ndarray]:
    lines = [line for line in data.decode("ascii", "replace").splitlines() if line.strip()]
    elements, first = {}, 0
    for name, count, kind in kinds:
        if first + count > len(lines):
            raise ValueError(f"it ends before its {count:,} rows of '{name}' do")
        rows = np.loadtxt(lines[first : first + count], kind, ndmin=1) if count else np.empty(0, kind)
        elements[name], first = rows, first + count
    return elements


def decode(elements: dict[str, np.ndarray]) -> Gaussians:
    """The element `vertex` of a scene; a cloud of coloured points becomes small round Gaussians."""
    rows = elements["vertex"]
    if not len(rows):
        raise ValueError("it holds no points")
    means = columns(rows, "x", "y", "z")
    if "scale_0" not in (rows.dtype.names or ()):
        colours = _colours(rows)
        solid = shares(rows, "alpha")[:, 0] if "alpha" in (rows.dtype.names or ()) else torch.ones(len(rows))
        solid = solid if solid.any() else torch.ones(len(rows))  # some tools leave it 0
        finite = means[means.isfinite().all(1)] if means.isfinite().all(1).any() else torch.zeros(1, 3)
        spread = (finite.amax(0) - finite.amin(0)).norm() / max(len(rows), 1) ** 0.5
        scales = torch.full((len(rows), 3), float(spread) * 0.4)
        quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(rows), 1)
        return Gaussians(means, quats, scales, 0.9 * solid, plain_sh(colours))
    rest = [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    many = {0: 1, 9: 4, 24: 9, 45: 16}.get(len(rest))
    if many is None:
        raise ValueError(f"it has {len(rest)} numbers of harmonics besides the first, and not 0, 9, 24 or 45")
    bare = "f_dc_0" not in (rows.dtype.names or ())
    sh = plain_sh(_colours(rows)) if bare else columns(rows, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]
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


def _colours(rows: np.ndarray) -> torch.Tensor:
    """Colours of points in 0..1 [n, 3]; KeyError where there are none."""
    return shares(rows, *next((three for three in _COLOURS if set(three) <= set(rows.dtype.names or ())), _COLOURS[0]))


def shares(rows: np.ndarray, *names: str) -> torch.Tensor:
    """Colours or opacities [n, names] in 0..1, whatever their type."""
    values = columns(rows, *names)
    return (values / full_scale(rows.dtype[names[0]], float(values.nan_to_num(0, 0, 0).amax()))).clamp(0, 1)


def full_scale(kind: np.dtype, most: float) -> float:
    """The number that stands for full brightness where `most` is the largest: the first that is as large of 1, 255 and 65,535
    (floats), or of 255, 65,535 and the largest number of the type (integers)."""
    if kind.kind == "f":
        return next((level for level in (1.0, 255.0, 65535.0) if most <= 1.5 * level), most)  # highlights
    largest = float(np.iinfo(kind).max)
    return next(level for level in (255.0, min(65535.0, largest), largest) if most <= level)


def encode(gaussians: Gaussians, axes: str = "rdf") -> bytes:
    """As 3D Gaussian Splatting's code writes a scene; its header names the axes."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    parts = [
        gaussians.means, torch.zeros_like(gaussians.means), gaussians.sh[:, 0], rest,
        gaussians.opacities.clamp(1e-6, 1 - 1e-6).logit()[:, None], gaussians.scales.clamp_min(1e-9).log(), gaussians.quats,
    ]  # fmt: skip
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(rest.shape[1])] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in names)]
    return header(lines, axes) + torch.cat(parts, 1).numpy().astype("<f4").tobytes()


def header(lines: list[str], axes: str) -> bytes:
    """A header with these lines of elements and properties, which names the axes."""
    comment = f"comment axes {axes} ({_SPELT.get(axes, axes)}), metres"
    return "\n".join(["ply", "format binary_little_endian 1.0", comment, *lines, "end_header", ""]).encode()


def stated_axes(data: bytes) -> str | None:
    """The axes that the header of a file names; None where it names none of ours."""
    stated = re.search(rb"^comment axes (\w+)", data[: _header(data)[2]], re.MULTILINE)
    name = stated[1].decode() if stated else ""
    return name if name in _SPELT else None
