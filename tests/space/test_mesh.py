"""Meshes and GLB: surfaces where they are, faces that look into the open, axes that other tools understand."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import torch

from terrella.cli import main
from terrella.core.errors import ContractError
from terrella.space.camera import planar_pose
from terrella.space.files import AXES
from terrella.space.files.glb import encode_gaussians, encode_mesh
from terrella.space.mesh import Mesh, collider_mesh, fused
from terrella.space.occupancy import Occupancy
from terrella.space.raster.move import transform
from terrella.space.solids import Solids

from .test_fitting import room

# How importers turn glTF's axes (x right, y up, z back; metres): Blender's, Unreal's (centimetres), Unity's glTFast.
IMPORTERS = {
    "Blender": (lambda x, y, z: (x, -z, y), {"forward": (0, 1, 0), "left": (-1, 0, 0), "up": (0, 0, 1)}),
    "Unreal": (lambda x, y, z: (100 * x, 100 * z, 100 * y), {"forward": (0, -100, 0), "left": (-100, 0, 0), "up": (0, 0, 100)}),
    "Unity": (lambda x, y, z: (-x, y, z), {"forward": (0, 0, -1), "left": (1, 0, 0), "up": (0, 1, 0)}),
}  # fmt: skip


def parts(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """A GLB's JSON and its attributes."""
    magic, version, size = struct.unpack_from("<4sII", data)
    length = struct.unpack_from("<I", data, 12)[0]
    assert (magic, version, size) == (b"glTF", 2, len(data)) and length % 4 == 0
    doc, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    found = {}
    primitive = doc["meshes"][0]["primitives"][0]
    for name, at in {**primitive["attributes"], "faces": primitive.get("indices", 0)}.items():
        about = doc["accessors"][at]
        kind = {5126: np.float32, 5125: np.uint32}[about["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[about["type"]]
        start = doc["bufferViews"][about["bufferView"]]["byteOffset"]
        found[name] = np.frombuffer(body, kind, about["count"] * width, start).reshape(-1, width)
    return doc, found


@pytest.mark.parametrize("tool", IMPORTERS)
def test_axes_come_out_as_the_guide_says(tool):
    ways = torch.eye(3)  # forward, left, up
    mesh = Mesh(
        ways @ torch.tensor(AXES["rub"]).float().T, torch.tensor([[0, 1, 2]]), torch.zeros(3, 3, dtype=torch.uint8)
    )
    convert, expected = IMPORTERS[tool]
    got = [
        tuple(round(float(v), 4) + 0.0 for v in convert(*row)) for row in parts(encode_mesh(mesh, "m"))[1]["POSITION"]
    ]
    assert dict(zip(("forward", "left", "up"), got)) == expected


def test_gaussians_keep_what_they_are():
    some = room(count=50)
    doc, found = parts(encode_gaussians(transform(some, torch.tensor(AXES["rub"]).float()), "g"))
    assert doc["extensionsUsed"] == ["KHR_gaussian_splatting"] and doc["meshes"][0]["primitives"][0]["mode"] == 0
    own = "KHR_gaussian_splatting:"
    assert np.allclose(found[f"{own}SCALE"], some.scales) and np.allclose(found[f"{own}OPACITY"][:, 0], some.opacities)
    assert np.allclose(found[f"{own}SH_DEGREE_0_COEF_0"], some.sh[:, 0]) and len(found["POSITION"]) == 50
    assert np.allclose(np.linalg.norm(found[f"{own}ROTATION"], axis=1), 1, atol=1e-5)


def outward(mesh: Mesh) -> float:
    """The volume that faces enclose, seen from outside."""
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_a_collider_is_closed_and_faces_outwards():
    boxes = torch.tensor([[0.0, 0, 0, 1, 2, 3], [5, 5, 5, 6, 6, 6.5]])
    assert abs(outward(collider_mesh(Solids(boxes))) - 7.5) < 1e-5
    solid = torch.zeros(4, 4, 4, dtype=torch.bool)
    solid[1:3, 1, 1:4] = True
    mesh = collider_mesh(Occupancy(torch.tensor([1.0, 2, 3]), 0.5, solid, torch.zeros(4, 4, 4)))
    assert abs(outward(mesh) - 6 * 0.125) < 1e-5 and len(mesh.faces) == 2 * 22


def test_a_room_is_fused_where_its_walls_are():
    pytest.importorskip("skimage", reason="scikit-image is not installed: pip install 'terrella[mesh]'")
    eye = planar_pose(*(torch.tensor([v]) for v in (2.0, 2.0, 1.4, 0.5)))
    place = room(count=6000)
    mesh = fused(place, eye, 0.1)
    low, high = place.means.amin(0), place.means.amax(0)
    off = torch.minimum((mesh.vertices - low).abs(), (mesh.vertices - high).abs()).amin(1)
    assert len(mesh.faces) > 2000 and off.median() < 0.11  # a cell
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    towards = (torch.linalg.cross(b - a, c - a) * (eye[0, :3] - a)).sum(1)
    assert (towards > 0).float().mean() > 0.9  # faces look at who sees them


def test_without_scikit_image_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "skimage.measure", None)
    with pytest.raises(ContractError, match=r"terrella\[mesh\]"):
        fused(room(count=500), planar_pose(*(torch.tensor([v]) for v in (2.0, 2.0, 1.4, 0.5))), 0.5)


@pytest.mark.parametrize("name, option", [("a.glb", ["--axes", "rub"]), ("a.png", ["--compressed"]), ("a.spz", ["--compressed"]),
                                          ("a.html", ["--cell", "0.2"]),
                                          ("a.glb", ["--cell", "0.2", "--kind", "collider"]),
                                          ("a.ply", ["--seconds", "3"])])  # fmt: skip
def test_options_of_other_files_are_refused(tmp_path, capsys, name, option):
    assert main(["space", "export", str(tmp_path / "none"), str(tmp_path / name), *option]) == 2
    assert option[0] in capsys.readouterr().err and not (tmp_path / name).exists()
