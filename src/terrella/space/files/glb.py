"""GLB (binary glTF 2.0): meshes with vertex colours, and Gaussians as KHR_gaussian_splatting has them.
glTF is right-handed, in metres, y up, and looks along -z: our x forward, y left, z up becomes (-y, z, -x), the axes "rub"."""

import json
import struct
from typing import Any

import numpy as np

from ..mesh import Mesh
from ..raster import Gaussians

_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_TYPES = {"float32": 5126, "uint32": 5125, "uint8": 5121}
_VERTICES, _INDICES = 34962, 34963


def encode_mesh(mesh: Mesh, name: str) -> bytes:
    """A mesh in glTF's own axes, with its sRGB colours made linear, as glTF requires."""
    linear = (mesh.colours.numpy() / 255) ** 2.2
    colours = np.concatenate([linear, np.ones((len(linear), 1))], 1).astype(np.float32)
    parts = {"POSITION": mesh.vertices.numpy().astype(np.float32), "COLOR_0": colours}
    plain = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}
    shown = {**plain, "extensions": {"KHR_materials_unlit": {}}}  # colours include light
    doc = {"materials": [shown], "extensionsUsed": ["KHR_materials_unlit"]}
    return _glb(doc, parts, {"mode": 4, "material": 0}, name, mesh.faces.numpy().astype(np.uint32).reshape(-1))


def encode_gaussians(gaussians: Gaussians, name: str) -> bytes:
    """Gaussians in glTF's own axes: scales linear, opacities 0..1, quaternions x, y, z, w of length 1, harmonics by degree."""
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True).clamp_min(1e-12)
    own = "KHR_gaussian_splatting:"
    parts = {
        "POSITION": gaussians.means.numpy(),
        f"{own}ROTATION": quats[:, [1, 2, 3, 0]].numpy(),
        f"{own}SCALE": gaussians.scales.numpy(),
        f"{own}OPACITY": gaussians.opacities.numpy(),
    }
    for degree in range(gaussians.degree + 1):
        for at in range(2 * degree + 1):
            parts[f"{own}SH_DEGREE_{degree}_COEF_{at}"] = gaussians.sh[:, degree * degree + at].numpy()
    about = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension = {"extensions": {"KHR_gaussian_splatting": about}}
    return _glb({"extensionsUsed": ["KHR_gaussian_splatting"]}, parts, {"mode": 0, **extension}, name)


def _glb(
    doc: dict[str, Any],
    parts: dict[str, np.ndarray],
    primitive: dict[str, Any],
    name: str,
    indices: np.ndarray | None = None,
) -> bytes:
    """One node with one primitive of attributes [N] or [N, k], float32."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    chunks: list[bytes] = []
    attributes: dict[str, int] = {}
    for label, part in [*parts.items(), *([("", indices)] if indices is not None else [])]:
        data = np.ascontiguousarray(part)
        width = 1 if data.ndim == 1 else data.shape[1]
        limits = {"min": data.min(0).tolist(), "max": data.max(0).tolist()} if label == "POSITION" else {}
        about = {
            "bufferView": len(views),
            "componentType": _TYPES[str(data.dtype)],
            "count": len(data),
            "type": _SHAPES[width],
        }
        target = {"target": _VERTICES if label else _INDICES} if indices is not None else {}
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": data.nbytes, **target})
        chunks.append(data.tobytes() + b"\0" * (-data.nbytes % 4))
        if label:
            attributes[label] = len(accessors)
        else:
            primitive = {**primitive, "indices": len(accessors)}
        accessors.append({**about, **limits})
    body = b"".join(chunks)
    whole = {
        "asset": {"version": "2.0", "generator": "Terrella"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}], "meshes": [{"name": name, "primitives": [{"attributes": attributes, **primitive}]}],
        "buffers": [{"byteLength": len(body)}], "bufferViews": views, "accessors": accessors, **doc,
    }  # fmt: skip
    text = json.dumps(whole, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
