"""Odd scenes through `space import`: what goes in comes out, or is left out by name."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from terrella.cli import main
from terrella.space.files import ply, spz
from terrella.space.files.glb import encode_gaussians

from .test_files import spz_4
from .test_gltf_forms import File
from .test_raster import cloud


def lost_gaussians(folder) -> None:
    scene = cloud(20, 0)
    scene.means[3, 1], scene.scales[5, 0], scene.means[6, 0] = float("nan"), float("inf"), 1e30
    (folder / "odd.ply").write_bytes(ply.encode(scene))


def mesh_as_ply(folder) -> None:
    names = ("x", "y", "z", "r", "g", "b")
    head = "ply\nformat ascii 1.0\nelement vertex 20\n" + "".join(f"property float {name}\n" for name in names)
    rows = "".join(f"{k} {k % 3} {k % 5} 0.5 0.5 0.5\n" for k in range(20))
    more = "element face 2\nproperty list uchar int vertex_indices\nelement edge 1\nproperty int vertex1\nend_header\n"
    (folder / "odd.ply").write_text(head + more + rows + "3 0 1 2\n3 1 2 3\n7\n")


def harmonics_of_degree_4(folder) -> None:
    *_, body = spz._streams(spz.encode(cloud(20, 3), 4))
    ends = [20 * end for end in (0, 9, 10, 13, 16, 20, 65)]
    *streams, sh = (body[a:b] for a, b in zip(ends, ends[1:]))
    more = np.pad(np.frombuffer(sh, np.uint8).reshape(20, 45), ((0, 0), (0, 27)))
    (folder / "odd.spz").write_bytes(spz_4(20, 4, [*streams, more.tobytes()]))


def gaussians_beside_a_mesh(folder) -> None:
    data = encode_gaussians(cloud(20, 0), "a")
    (size,) = struct.unpack_from("<I", data, 12)
    whole = json.loads(data[20 : 20 + size])
    position = whole["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    whole["meshes"][0]["primitives"].append({"attributes": {"POSITION": position}})
    whole["extensionsUsed"].append("EXT_lights_ies")
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON")
    (folder / "odd.glb").write_bytes(head + text + rest)


def gltf(change):
    """The floor of two triangles, changed."""

    def make(folder) -> None:
        file = File()
        floor = file.floor()
        file.read(folder, floor, **change(file, floor))
        (folder / "a.gltf").rename(folder / "odd.gltf")

    return make


def points_and_lines(file: File, floor: dict) -> dict:
    others = [{"attributes": floor["attributes"], "mode": mode} for mode in (0, 1, 3)]
    return {"meshes": [{"primitives": [floor, *others]}]}


def absent_pictures(file: File, floor: dict) -> dict:
    surfaces = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in (0, 1)]
    more = {"images": [{"uri": "a.png"}, {"uri": "b.jpg"}], "textures": [{"source": 0}, {"source": 1}]}
    return {"materials": surfaces, "meshes": [{"primitives": [floor, {**floor, "material": 1}]}], **more}


LOOKS = ["KHR_materials_transmission", "KHR_materials_variants"]
ODD = {
    # kind: (how it is made, the figure of what came out, its number, words for each thing that is left out)
    "Gaussians that are no numbers": (lost_gaussians, "gaussians", 17, ["3 of its 20 Gaussians"]),
    "a mesh": (mesh_as_ply, "gaussians", 20, ["2 faces, 1 edge"]),
    "harmonics of degree 4": (harmonics_of_degree_4, "gaussians", 20, ["degree 4"]),
    "Gaussians beside a mesh": (gaussians_beside_a_mesh, "gaussians", 20, ["EXT_lights_ies, 1 meshes"]),
    "points and lines": (gltf(points_and_lines), "triangles", 2, ["3 meshes of points or lines"]),
    "animations": (gltf(lambda file, floor: {"animations": [{}]}), "triangles", 2, ["animations"]),
    "other scenes": (gltf(lambda file, floor: {"scenes": [{"nodes": [0]}, {"nodes": []}]}), "triangles", 2, ["1 scenes"]),
    "absent pictures": (gltf(absent_pictures), "triangles", 4, ["a.png", "b.jpg"]),
    "looks": (gltf(lambda file, floor: {"extensionsUsed": LOOKS}), "triangles", 2, LOOKS),
    "nothing odd": (gltf(lambda file, floor: {}), "triangles", 2, []),
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD)
def test_what_goes_in_comes_out_or_is_named(tmp_path, kind, capsys, monkeypatch):
    monkeypatch.setattr("terrella.workflows.build_space.BuildSpaceConfig.gaussians", 1000)
    make, figure, number, names = ODD[kind]
    make(tmp_path)
    (file,) = tmp_path.iterdir()
    flags = ["--out", str(tmp_path / "out"), "--size", "24", "32"]
    assert main(["space", "import", str(file), *flags, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts[figure] == number and len(facts["left_out"]) == len(names)
    assert all(name in said for name, said in zip(names, facts["left_out"]))
    assert main(["space", "import", str(file), *flags]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in names) and ("left out" in shown) == bool(names)
