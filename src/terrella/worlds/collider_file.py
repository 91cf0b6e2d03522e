"""What stops bodies in a place of Gaussians, kept beside it: computing it takes seconds."""

import hashlib
import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from ..core.files import replacing
from ..space.enclosure import ColliderKind, enclosed
from ..space.occupancy import Occupancy, Walker
from ..space.raster import Gaussians

COLLIDER_FILE, EDITED_FILE = (
    "world.collider.safetensors",
    "world.edited-collider.safetensors",
)  # without and after its edits
VERSION = 4  # changes with what `enclosed` computes


def kept_collider(
    gaussians: Gaussians, eyes: torch.Tensor, kind: ColliderKind, body: Walker, file: Path | None
) -> Occupancy:
    """`enclosed` of these arguments: read from `file` if that was written for the same ones, else computed and written there. A
    file that cannot be read or written is ignored; None: none is kept."""
    if file is None:
        return enclosed(gaussians, eyes, kind, body)
    digest = _digest(gaussians, eyes, kind, body)
    with suppress(OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError):
        return _read(file, digest)
    place = enclosed(gaussians, eyes, kind, body)
    if file.parent.is_dir():
        with suppress(OSError), replacing(file, durable=False) as staged:
            staged.write_bytes(_packed(place, digest))
    return place


def _digest(gaussians: Gaussians, eyes: torch.Tensor, kind: ColliderKind, body: Walker) -> str:
    """SHA-256 of all that a collider depends on."""
    whole = hashlib.sha256(json.dumps([VERSION, kind, vars(body)]).encode())
    for part in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, eyes):
        whole.update(str(tuple(part.shape)).encode())
        whole.update(part.detach().float().contiguous().numpy().tobytes())
    return whole.hexdigest()


def _packed(place: Occupancy, digest: str) -> bytes:
    """A grid as a safetensors file: a bit for each cell, the height of the surface in each solid one."""
    parts = {
        "origin": place.origin,
        "cell_m": torch.tensor(place.cell_m, dtype=torch.float64),
        "size": torch.tensor(place.solid.shape),
        "solid": torch.from_numpy(np.packbits(place.solid.numpy())),
        "top": place.top[place.solid],
    }
    return save(parts, {"digest": digest})


def _read(file: Path, digest: str) -> Occupancy:
    """The grid of such a file; ValueError where it was written for other arguments."""
    with safe_open(file, "pt") as parts:
        if parts.metadata()["digest"] != digest:
            raise ValueError("it belongs to another place")
        origin, cell_m, size, bits, top = (
            parts.get_tensor(name) for name in ("origin", "cell_m", "size", "solid", "top")
        )
    shape = tuple(size.tolist())
    solid = torch.from_numpy(np.unpackbits(bits.numpy(), count=int(size.prod())).astype(bool)).view(shape)
    return Occupancy(origin, float(cell_m), solid, torch.zeros(shape).masked_scatter_(solid, top))
