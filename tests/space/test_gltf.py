"""Scenes of triangles of other tools (glTF) as places to walk in, and broken ones."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import torch

from terrella.cli import main
from terrella.core.errors import DatasetError
from terrella.space.camera import planar_pose
from terrella.space.files import read_scene
from terrella.space.files.glb import encode_gaussians
from terrella.space.files.gltf_scene import GltfScene, read_gltf
from terrella.space.layout.mesh_solids import solids_of
from terrella.space.layout.meshes import of_triangles
from terrella.space.occupancy import Walker
from terrella.space.raster import rasterise
from terrella.space.solids import Solids

from .test_raster import cloud

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]]).astype(np.uint32)
BODY = Walker(eye_m=1.65, step_m=0.35)
# a room of 6 x 4 x 3 metres of five walls that are boxes and a ceiling, a pillar, in our frame: low and high corners
WALLS = {
    "floor": (-0.2, -0.2, -0.2, 6.2, 4.2, 0), "ceiling": (-0.2, -0.2, 3, 6.2, 4.2, 3.2), "west": (-0.2, -0.2, 0, 0, 4.2, 3),
    "east": (6, -0.2, 0, 6.2, 4.2, 3), "south": (0, -0.2, 0, 6, 0, 3), "north": (0, 4, 0, 6, 4.2, 3),
    "pillar": (3, 1.5, 0, 3.5, 2, 3),
}  # fmt: skip


def node(name: str, box: tuple, material: int = 0) -> dict:
    """A cube moved and scaled, in glTF's frame: ours is (-z, -x, y) of it."""
    low, high = np.array(box[:3], float), np.array(box[3:], float)
    size, at = (high - low).tolist(), (-float(high[1]), float(low[2]), -float(high[0]))
    return {"name": name, "mesh": material, "translation": list(at), "scale": [size[1], size[2], size[0]]}


def glb(about: dict | None = None, nodes: list | None = None, **more: object) -> bytes:
    """A file of nodes with cubes of two colours (meshes 0 and 1) and a lamp in the middle."""
    body = CUBE.tobytes() + FACES.tobytes()
    lamp = {"name": "lamp", "translation": [-2, 2.6, -1.5], "extensions": {"KHR_lights_punctual": {"light": 0}}}
    nodes = [*(node(name, box, int(name == "pillar")) for name, box in WALLS.items()), lamp] if nodes is None else nodes
    part = {"attributes": {"POSITION": 0}, "indices": 1}
    whole = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes,
        "meshes": [{"primitives": [{**part, "material": k}]} for k in (0, 1)],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": one}} for one in ([0.6, 0.6, 0.6, 1], [0.7, 0.05, 0.05, 1])],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": [{"buffer": 0, "byteLength": 96}, {"buffer": 0, "byteOffset": 96, "byteLength": 144}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"}],
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 40}]}}, **(about or {}), **more,
    }  # fmt: skip
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> GltfScene:
    path = tmp_path_factory.mktemp("glb") / "room.glb"
    path.write_bytes(glb())
    found = read_gltf(path)
    assert isinstance(found, GltfScene)
    return found


def test_nodes_stand_where_they_are_in_our_frame(scene):
    assert scene.names == tuple(WALLS) and len(scene.corners) == 12 * len(WALLS) and len(scene.lights) == 1
    for k, box in enumerate(WALLS.values()):
        mine = scene.corners[scene.things == k + 1][..., :3].reshape(-1, 3)
        assert np.allclose([*mine.min(0), *mine.max(0)], box, atol=1e-5)
    assert np.allclose(scene.lights[0].place, (1.5, 2, 2.6))


def test_boxes_stop_bodies_where_they_are(scene):
    found, truth = solids_of(scene.corners[..., :3], scene.things), torch.tensor(list(WALLS.values()))
    assert found is not None and np.allclose(np.sort(found, 0), np.sort(truth.numpy(), 0), atol=1e-5)
    bent = scene.corners[..., :3].copy()  # no longer boxes: one thing of many triangles, met cell by cell
    cells = solids_of(bent, np.zeros(len(bent), np.int32))
    assert cells is not None and len(cells) < 400
    rng = torch.Generator().manual_seed(0)
    places = torch.rand(4000, 3, generator=rng) * torch.tensor([5.9, 3.9, 0.0]) + torch.tensor([0.05, 0.05, 1.65])
    one, other = Solids(truth).blocked(places, BODY), Solids(torch.from_numpy(cells)).blocked(places, BODY)
    assert (one == other).float().mean() > 0.99 and one.float().mean() > 0.1


def test_a_box_that_holds_others_is_a_room():
    cube = CUBE[FACES.astype(int)] - 0.5
    corners = np.concatenate([cube * 4, cube + [0.5, 0.5, -1.5]])
    solids = solids_of(corners.astype(np.float32), np.repeat([1, 2], 12))
    assert solids is not None
    inside, in_it, in_wall = torch.tensor([[-1.0, -1, -0.35], [0.5, 0.5, -0.35], [-1.95, 0, -0.35]])
    assert Solids(torch.from_numpy(solids)).blocked(torch.stack([inside, in_it, in_wall]), BODY).tolist() == [
        False,
        True,
        True,
    ]


def test_the_room_is_closed_and_has_its_colours(scene):
    gaussians, objects, _ = of_triangles(scene, 6000)
    assert 5500 < len(gaussians) <= 6000 and set(objects.tolist()) == set(range(1, 8))
    again, *_ = of_triangles(scene, 6000)
    assert all(torch.equal(a, b) for a, b in zip(vars(gaussians).values(), vars(again).values()))
    pose = planar_pose(*(torch.tensor([v]) for v in (1.0, 1.0, 1.6, 0.35)))
    seen = rasterise(gaussians, pose, None, (64, 128))
    assert seen.alpha.min() > 0.9 and seen.alpha.mean() > 0.99
    red, green, _ = gaussians.colours[objects == 7].mean(0).tolist()
    assert red > 2 * green
    floor = (objects == 1) & (gaussians.means[:, 2] > -0.05)
    bright = gaussians.colours[floor].mean(1)
    away = (gaussians.means[floor, :2] - torch.tensor([1.5, 2.0])).norm(dim=1)
    hidden = (gaussians.means[floor, 0] > 4.2) & ((gaussians.means[floor, 1] - 1.75).abs() < 0.2)
    open_ = (away > 2.7) & (away < 4.4) & (gaussians.means[floor, 1] > 3)
    assert (
        bright[away < 1].mean() > bright[open_].mean() + 0.1 > bright[hidden].mean() + 0.1
    )  # a lamp, and a shadow behind the pillar


def test_commands_make_worlds_of_it(tmp_path, capsys):
    (tmp_path / "room.glb").write_bytes(glb())
    small = ["--size", "24", "32", "--json"]
    for command in (["build", "--gaussians", "3000"], ["import", "--scale", "2"]):
        out = tmp_path / command[0]
        assert main(["space", command[0], str(tmp_path / "room.glb"), *command[1:], "--out", str(out), *small]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["objects"] == list(WALLS) and facts["boxes"] == 7 and facts["lights"] == 1
    from terrella.core import check_world, make_rng
    from terrella.worlds.folder import open_world
    from terrella.worlds.splat import SplatWorld

    world = open_world(tmp_path / "build")
    assert isinstance(world, SplatWorld) and world.card["objects"] == list(WALLS)
    check_world(world, steps=3)
    assert torch.allclose(world.solids[:, 3:].amax(0), torch.tensor([6.2, 4.2, 3.2]), atol=1e-4)
    state, rng = world.start(64, make_rng(0)), torch.Generator().manual_seed(0)
    for step in range(60):
        if step % 6 == 0:
            action = (torch.rand(64, len(world.spec.action_names), generator=rng) < 0.4).to(torch.int8)
        state = world.imagine(state, action, make_rng(0))
    assert Solids(world.solids).depth(state["pose"], BODY).max() < 0.03
    place = state["pose"][:, :3]
    assert ((place > 0) & (place < torch.tensor([6.0, 4, 3]))).all()


def test_its_gaussians_come_back(tmp_path):
    ours = cloud(60, 3)
    (tmp_path / "a.glb").write_bytes(encode_gaussians(ours, "a"))
    back = read_scene(tmp_path / "a.glb", "flu")
    assert back.degree == 3 and torch.allclose(ours.means, back.means) and torch.allclose(ours.sh, back.sh, atol=1e-5)
    assert main(["space", "import", str(tmp_path / "a.glb"), "--out", str(tmp_path / "w"), "--size", "24", "32"]) == 0
    assert main(["space", "build", str(tmp_path / "a.glb"), "--out", str(tmp_path / "no")]) == 2


ONE = [{"mesh": 0}]
BAD = {
    "empty": b"",
    "cut": glb()[:-40],
    "cut early": glb()[:15],
    "version 1": struct.pack("<4sII", b"glTF", 1, 20) + bytes(8),
    "no JSON": struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"{{{{",
    "compressed": glb(extensionsRequired=["KHR_draco_mesh_compression"]),
    "of an unknown kind": glb(extensionsRequired=["CESIUM_RTC"]),
    "no triangles": glb(nodes=[{"name": "nothing"}]),
    "a circle": glb(nodes=[{"children": [0]}]),
    "many": glb(nodes=ONE, accessors=[{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
                                      {"bufferView": 1, "componentType": 5125, "count": 30_000_000, "type": "SCALAR"}]),
    "many at once": glb(nodes=[{"mesh": 0}] * 200_000),
    "long": glb(nodes=ONE, accessors=[{"bufferView": 0, "componentType": 5126, "count": 9, "type": "VEC3"},
                                      {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"}]),
    "negative": glb(nodes=ONE, bufferViews=[{"buffer": 0, "byteOffset": -8, "byteLength": 96}] * 2),
    "corners that are not there": glb(nodes=ONE, bufferViews=[{"buffer": 0, "byteLength": 96}, {"buffer": 0, "byteLength": 144}]),
    "another file": glb(buffers=[{"byteLength": 240, "uri": "../../etc/passwd"}]),
    "no material": glb(materials=[]),
    "no number": glb(nodes=[{"mesh": 0, "translation": [float("nan"), 0, 0]}]),
    "sparse": glb(accessors=[{"count": 3, "sparse": {}}] * 2),
    "sparse without end": glb(accessors=[{"componentType": 5126, "count": 1 << 40, "type": "VEC3"}] * 2),
    "instances without end": glb(
        nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"SCALE": 2}}}}],
        accessors=[{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
                   {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
                   {"componentType": 5126, "count": 1 << 24, "type": "VEC3"}],
    ),
}  # fmt: skip
SAID = {
    "compressed": "without compression",
    "many": "10,000,000 triangles",
    "no triangles": "no triangles",
    "cut": "long",
}


@pytest.mark.parametrize("name", BAD)
def test_broken_ones_are_one_sentence(tmp_path, name, capsys):
    path = tmp_path / "bad.glb"
    path.write_bytes(BAD[name])
    with pytest.raises(DatasetError, match=SAID.get(name, "bad.glb")) as said:
        read_gltf(path)
    assert "\n" not in str(said.value)
    assert main(["space", "build", str(path), "--out", str(tmp_path / "w")]) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["bad.glb"]
