"""Scenes as files: there and back, and hostile ones."""

from __future__ import annotations

import gzip
import struct

import pytest
import torch

from terrella.core.errors import DatasetError
from terrella.space.camera import rotation
from terrella.space.files import read_scene, write_scene
from terrella.space.raster import rasterise
from terrella.space.raster.move import quaternion, turned

from .test_raster import LENS, POSES, cloud, parts

CLOSE = {"a.ply": 1e-5, "a.spz": 0.12, "compressed.ply": 0.08}


@pytest.mark.parametrize("name", CLOSE)
@pytest.mark.parametrize("degree", [0, 3])
def test_there_and_back(tmp_path, name, degree):
    scene = cloud(600, degree)
    write_scene(scene, tmp_path / name, kind="compressed" if "compressed" in name else "")
    back = read_scene(tmp_path / name)
    assert len(back) == 600 and back.degree == degree and list(tmp_path.iterdir()) == [tmp_path / name]
    one, other = rasterise(scene, POSES, LENS, (40, 48)).rgb, rasterise(back, POSES, LENS, (40, 48)).rgb
    assert (one - other).abs().mean() < CLOSE[name] * one.std()
    if name == "a.ply":
        for a, b in zip(parts(scene), parts(back)):
            assert a.shape == b.shape
        assert torch.allclose(scene.means, back.means, atol=1e-5)


def test_a_turned_scene_looks_the_same_from_a_turned_camera():
    scene, turn = cloud(80, 3), torch.tensor([0.7, 0.3, -0.5, 0.4])
    turn = turn / turn.norm()
    rot = rotation(torch.cat([torch.zeros(3), turn]))
    assert torch.allclose(quaternion(rot), turn, atol=1e-5)
    moved = turned(scene, rot, 2.0, torch.tensor([1.0, 2, 3]))
    pose = torch.cat([torch.tensor([1.0, 2, 3]), turn])[None]
    there, here = rasterise(moved, pose, LENS, (32, 32)), rasterise(scene, POSES[:1], LENS, (32, 32))
    assert (there.rgb - here.rgb).abs().mean() < 1e-3 and torch.allclose(
        there.depth, 2 * here.depth, rtol=0.02, atol=0.05
    )


HEAD = b"ply\nformat binary_little_endian 1.0\n"
BAD = {
    "empty": b"",
    "text": b"hello",
    "no end": HEAD + b"element vertex 3\n",
    "ascii": b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
    "negative": HEAD + b"element vertex -3\nproperty float x\nend_header\n",
    "huge": HEAD + b"element vertex 99999999999\nproperty float x\nend_header\n",
    "cut": HEAD + b"element vertex 100\nproperty float x\nproperty float y\nproperty float z\nend_header\n1234",
    "list": HEAD + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n1234",
    "twice": HEAD + b"element vertex 1\nproperty float x\nproperty float x\nend_header\n12345678",
    "no vertex": HEAD + b"element point 1\nproperty float x\nend_header\n1234",
    "points only": HEAD
    + b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    + bytes(12),
    "gzip": gzip.compress(b"nothing much, but longer than sixteen bytes"),
    "cut gzip": gzip.compress(bytes(1000))[:20],
    "spz 4": gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 4, 1, 0, 12, 0, 0)),
    "many": gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 2**31, 3, 12, 0, 0)),
    "short spz": gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 9, 3, 12, 0, 0)),
}


@pytest.mark.parametrize("name", BAD)
def test_hostile_files_are_one_sentence(tmp_path, name):
    path = tmp_path / "bad.ply"
    path.write_bytes(BAD[name])
    with pytest.raises(DatasetError, match="bad.ply") as said:
        read_scene(path)
    assert "\n" not in str(said.value)


def test_what_is_not_finite_is_left_out(tmp_path):
    scene = cloud(10, 0)
    scene.means[3, 1], scene.scales[5, 0] = float("nan"), float("inf")
    write_scene(scene, tmp_path / "a.ply")
    assert len(read_scene(tmp_path / "a.ply")) == 8
    scene.means[:] = float("nan")
    write_scene(scene, tmp_path / "a.ply")
    with pytest.raises(DatasetError, match="finite"):
        read_scene(tmp_path / "a.ply")
    with pytest.raises(DatasetError, match="ends so"):
        write_scene(scene, tmp_path / "a.glb")
