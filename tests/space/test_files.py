"""Scenes as files: there and back, and hostile ones."""

from __future__ import annotations

import gzip
import struct
import tracemalloc

import numpy as np
import pyarrow as pa
import pytest
import torch

from terrella.core.errors import DatasetError
from terrella.space.camera import rotation
from terrella.space.files import read_scene, spz, write_scene
from terrella.space.raster import rasterise
from terrella.space.raster.move import quaternion_of, transform

from .test_raster import LENS, POSES, cloud, parts


@pytest.mark.parametrize("kind", ["", "compressed"])
@pytest.mark.parametrize("axes", ["rdf", "rub", "flu"])
def test_a_ply_names_its_axes(tmp_path, kind, axes):
    scene = cloud(300, 0)
    write_scene(scene, tmp_path / "a.ply", axes, kind)
    assert f"\ncomment axes {axes} (x ".encode() in (tmp_path / "a.ply").read_bytes()[:200]
    read = read_scene(tmp_path / "a.ply").means
    assert torch.allclose(read.sort(0).values, scene.means.sort(0).values, atol=0.05)
    content = (tmp_path / "a.ply").read_bytes().replace(f"axes {axes} ".encode(), b"axes xyz ")
    (tmp_path / "foreign.ply").write_bytes(content)  # as if nothing were said
    assert torch.equal(read_scene(tmp_path / "foreign.ply").means, read_scene(tmp_path / "a.ply", "rdf").means)


CLOSE = {"a.ply": 1e-5, "a.spz": 0.12, "a.4.spz": 0.12, "compressed.ply": 0.08}


@pytest.mark.parametrize("name", CLOSE)
@pytest.mark.parametrize("degree", [0, 3])
def test_there_and_back(tmp_path, name, degree):
    scene = cloud(600, degree)
    write_scene(
        scene, tmp_path / name, kind="compressed" if "compressed" in name else "", version=4 if ".4." in name else 3
    )
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
    assert torch.allclose(quaternion_of(rot), turn, atol=1e-5)
    moved = transform(scene, rot, 2.0, torch.tensor([1.0, 2, 3]))
    pose = torch.cat([torch.tensor([1.0, 2, 3]), turn])[None]
    there, here = rasterise(moved, pose, LENS, (32, 32)), rasterise(scene, POSES[:1], LENS, (32, 32))
    assert (there.rgb - here.rgb).abs().mean() < 1e-3 and torch.allclose(
        there.depth, 2 * here.depth, rtol=0.02, atol=0.05
    )


def spz_4(count: int, degree: int, streams: list[bytes], lie: int = 0) -> bytes:
    """A file of version 4; the table says that each stream unpacks to `lie` bytes more than it does."""
    zstd = pa.Codec("zstd")
    packed = [zstd.compress(part, asbytes=True) for part in streams]
    table = b"".join(struct.pack("<QQ", len(small), len(part) + lie) for small, part in zip(packed, streams))
    return struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(streams), 32) + table + b"".join(packed)


def test_harmonics_of_degree_4_are_left_out():
    data = spz.encode(cloud(50, 3), 4)
    *_, body = spz._streams(data)
    ends = [50 * end for end in (0, 9, 10, 13, 16, 20, 65)]
    *streams, sh = (body[a:b] for a, b in zip(ends, ends[1:]))
    more = np.pad(np.frombuffer(sh, np.uint8).reshape(50, 45), ((0, 0), (0, 27)))
    with pytest.warns(UserWarning, match="degree 4"):
        found = spz.decode(spz_4(50, 4, [*streams, more.tobytes()]))
    assert found.degree == 3 and all(map(torch.equal, parts(found), parts(spz.decode(data))))


def test_a_long_count_in_a_short_file_asks_for_no_memory():
    """Sixteen million points, as the table says, too; a megabyte at a time is unpacked."""
    count = spz.MOST - 1
    table = b"".join(struct.pack("<QQ", 20 if k < 4 else 0, count * size) for k, size in enumerate((9, 1, 3, 3, 4)))
    data = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32) + table
    data += 4 * pa.Codec("zstd").compress(bytes(1000), asbytes=True)[:20].ljust(20, b"\0")
    tracemalloc.start()
    with pytest.raises(ValueError, match="stream"):
        spz.decode(data)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10_000_000


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
    "spz 4 in gzip": gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 4, 1, 0, 12, 0, 0)),
    "many": gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 2**31, 3, 12, 0, 0)),
    "4 short": b"NGSP",
    "4 without table": spz_4(3, 0, [])[:32],
    "4 of no version": struct.pack("<4sIIBBBBI12x", b"NGSP", 9, 1, 0, 12, 0, 5, 32),
    "4 too many": struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 2**31, 0, 12, 0, 5, 32),
    "4 of other streams": spz_4(1, 0, [bytes(9), bytes(1)]),
    "4 whose streams are short": spz_4(1, 0, [bytes(n) for n in (9, 1, 3, 3, 4)], lie=3),
    "4 of too many bytes": spz_4(1, 0, [bytes(n) for n in (9, 1, 3, 3, 400)]),
    "4 cut": spz_4(1, 0, [bytes(n) for n in (9, 1, 3, 3, 4)])[:-5],
    "4 that is no zstd": spz_4(1, 0, [bytes(n) for n in (9, 1, 3, 3, 4)])[:112] + bytes(80),
    "4 that lies": spz_4(2, 0, [bytes(n) for n in (9, 1, 3, 3, 4)], lie=9),
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
    scene.means[3, 1], scene.scales[5, 0], scene.means[6, 0] = float("nan"), float("inf"), 1e30
    write_scene(scene, tmp_path / "a.ply")
    with pytest.warns(UserWarning, match="3 of its 10 Gaussians are left out"):
        assert len(read_scene(tmp_path / "a.ply")) == 7
    scene.means[:] = float("nan")
    write_scene(scene, tmp_path / "a.ply")
    with pytest.raises(DatasetError, match="finite"):
        read_scene(tmp_path / "a.ply")
    with pytest.raises(DatasetError, match="ends so"):
        write_scene(scene, tmp_path / "a.glb")


COLOURS = {
    "floats to 1": ("red green blue", "<f8", [0.8, 0.4, 0.2]),
    "floats to 255": ("r g b", "<f4", [204.0, 102.0, 51.0]),
    "16 bits": ("diffuse_red diffuse_green diffuse_blue", ">u2", [52428, 26214, 13107]),
    "bytes": ("red green blue", "u1", [204, 102, 51]),
    "integers to 255": ("Red Green Blue", "<i4", [204, 102, 51]),
}


@pytest.mark.parametrize("kind", COLOURS)
def test_colours_of_points_of_any_type(tmp_path, kind):
    names, dtype, colour = COLOURS[kind]
    dtype = np.dtype(dtype)
    order = ">" if dtype.byteorder == ">" else "<"
    axes = [(axis, f"{order}f4") for axis in "xyz"]
    rows = np.zeros(50, [*axes, *((name, dtype) for name in names.split()), ("alpha", "u1")])
    for axis in "xyz":
        rows[axis] = np.random.default_rng(ord(axis)).normal(size=50)
    for name, value in zip(names.split(), colour):
        rows[name] = value
    rows["alpha"], rows["alpha"][0] = 255, 51
    types = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
    head = f"ply\nformat binary_{'big' if order == '>' else 'little'}_endian 1.0\nelement vertex 50\n"
    head += "".join(f"property {types[rows.dtype[name].str[1:]]} {name}\n" for name in rows.dtype.names)
    (tmp_path / "a.ply").write_bytes(head.encode() + b"end_header\n" + rows.tobytes())
    scene = read_scene(tmp_path / "a.ply")
    assert torch.allclose(scene.colours, torch.tensor([0.8, 0.4, 0.2]).expand(50, 3), atol=1e-4)
    assert scene.opacities[1] == pytest.approx(0.9) and scene.opacities[0] == pytest.approx(0.18)


def test_the_faces_of_a_mesh_are_left_out_by_name(tmp_path):
    points = b"0 0 0 255 0 0\n1 0 0 255 0 0\n0 1 0 255 0 0\n"
    columns = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
        f"property uchar {c}\n" for c in ("red", "green", "blue")
    )
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{columns}{faces}end_header\n"
    (tmp_path / "mesh.ply").write_bytes(head.encode() + points + b"3 0 1 2\n")
    with pytest.warns(UserWarning, match="left out: 1 face[.]"):
        assert len(read_scene(tmp_path / "mesh.ply")) == 3


@pytest.mark.parametrize(
    "lists", ["property list uchar int tracks\n", "element face 0\nproperty list uchar int corners\n"]
)
def test_points_with_lists_are_refused_by_that_reason(tmp_path, lists):
    points = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    head = points + lists if "tracks" in lists else lists + points
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{head}end_header\n0 0 0 0\n")
    with pytest.raises(DatasetError, match="points hold lists, or come after lists"):
        read_scene(tmp_path / "a.ply")
