"""One floor and one picture, stored in every way that glTF has: the same triangles and colours; what is not read is named."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from terrella.cli import main
from terrella.core.errors import DatasetError
from terrella.space.files.gltf_scene import GltfScene, read_gltf
from terrella.space.layout.meshes import of_triangles

# a floor of 4 x 2 metres in glTF's frame (x right, y up, z back), and its two triangles
FLOOR = np.array([[-2, 0, -1], [2, 0, -1], [2, 0, 1], [-2, 0, 1]], np.float32)
FACES = np.array([0, 2, 1, 0, 3, 2], np.uint16)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
CODES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class File:
    """A .gltf that grows: `add` stores an array as an accessor, `view` bytes as a buffer view."""

    def __init__(self) -> None:
        self.body, self.views, self.accessors = b"", [], []

    def view(self, data: bytes, **more: object) -> int:
        self.body += b"\0" * (-len(self.body) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data), **more})
        self.body += data
        return len(self.views) - 1

    def add(self, rows: np.ndarray, **more: object) -> int:
        width = 1 if rows.ndim == 1 else rows.shape[1]
        about = {"componentType": CODES[rows.dtype.name], "count": len(rows), "type": KINDS[width], **more}
        self.accessors.append(about | ({} if "sparse" in more else {"bufferView": self.view(rows.tobytes())}))
        return len(self.accessors) - 1

    def floor(self, **more: object) -> dict:
        given = {"POSITION": self.add(FLOOR), **more.pop("attributes", {})}
        return {"attributes": given, "indices": self.add(FACES), "material": 0, **more}

    def picture(self, pixels: np.ndarray, kind: str = "PNG") -> int:
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, kind, **({"lossless": True} if kind == "WEBP" else {}))
        return self.view(data.getvalue())

    def read(self, folder, primitive: dict, **more: object) -> GltfScene:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        whole = {
            "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "floor"}],
            "meshes": [{"primitives": [primitive]}], "materials": [{}], "bufferViews": self.views, "accessors": self.accessors,
            "buffers": [{"byteLength": len(self.body), "uri": uri}, *more.pop("more_buffers", [])], **more,
        }  # fmt: skip
        (folder / "a.gltf").write_text(json.dumps(whole))
        scene = read_gltf(folder / "a.gltf")
        assert isinstance(scene, GltfScene)
        return scene


def triangles(scene: GltfScene) -> set:
    """Corners in our frame, in turn, whichever comes first."""
    rounded = [[tuple((np.round(corner, 3) + 0.0).tolist()) for corner in face] for face in scene.corners[..., :3]]
    return {min(tuple(face[k:] + face[:k]) for k in range(3)) for face in rounded}


def unindexed(file: File) -> dict:
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR[FACES])}}}


def strip(file: File) -> dict:
    order = file.add(np.array([1, 0, 2, 3], np.uint8))
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR)}, "indices": order, "mode": 5}}


def unindexed_strip(file: File) -> dict:
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR[[1, 0, 2, 3]])}, "mode": 5}}


def fan(file: File) -> dict:
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR[[0, 3, 2, 1]])}, "mode": 6}}


def sparse(file: File) -> dict:
    """All corners of a plain accessor at 0 but one; and an accessor without a buffer view."""
    wrong = FLOOR.copy()
    wrong[2] = 9
    at, right = file.view(np.array([2], np.uint16).tobytes()), file.view(FLOOR[2].tobytes())
    changed = {"count": 1, "indices": {"bufferView": at, "componentType": 5123}, "values": {"bufferView": right}}
    first = file.add(wrong)
    file.accessors[first]["sparse"] = changed
    return {"primitive": {"attributes": {"POSITION": first}, "indices": file.add(FACES)}}


def sparse_alone(file: File) -> dict:
    at, right = file.view(np.arange(4, dtype=np.uint8).tobytes()), file.view(FLOOR.tobytes())
    changed = {"count": 4, "indices": {"bufferView": at, "componentType": 5121}, "values": {"bufferView": right}}
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR, sparse=changed)}, "indices": file.add(FACES)}}


def quantised(file: File) -> dict:
    position = file.add(np.round(FLOOR / 2 * 32767).astype(np.int16), normalized=True)
    node = {"mesh": 0, "name": "floor", "scale": [2, 2, 2]}
    required = ["KHR_mesh_quantization"]
    primitive = {"attributes": {"POSITION": position}, "indices": file.add(FACES)}
    return {"primitive": primitive, "nodes": [node], "extensionsUsed": required, "extensionsRequired": required}


def whole_numbers(file: File) -> dict:
    return {"primitive": {"attributes": {"POSITION": file.add(FLOOR.astype(np.int8))}, "indices": file.add(FACES)}}


def morphed(file: File) -> dict:
    low, up = FLOOR - [0, 3, 0], np.tile(np.array([0, 6, 0], np.float32), (4, 1))
    target = [{"POSITION": file.add(up)}, {"POSITION": file.add(up)}]
    primitive = {
        "attributes": {"POSITION": file.add(low.astype(np.float32))},
        "indices": file.add(FACES),
        "targets": target,
    }
    return {"primitive": primitive, "meshes": [{"primitives": [primitive], "weights": [0.5, 0]}]}


def skinned(file: File) -> dict:
    """Two corners hang on one bone, two on another; the node's own place does not count."""
    back = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    back[1, 3, :3] = [0, -5, 0]  # columns first
    apart = FLOOR + np.array([[0, 0, 0], [0, 5, 0], [0, 5, 0], [0, 0, 0]], np.float32)
    which = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], np.uint8)
    weight = np.tile(np.array([255, 0, 0, 0], np.uint8), (4, 1))
    given = {"POSITION": file.add(apart), "JOINTS_0": file.add(which), "WEIGHTS_0": file.add(weight, normalized=True)}
    skin = {"joints": [1, 2], "inverseBindMatrices": file.add(back.reshape(2, 16))}
    nodes = [{"mesh": 0, "skin": 0, "translation": [7, 7, 7], "name": "floor"}, {}, {}]
    primitive = {"attributes": given, "indices": file.add(FACES)}
    return {"primitive": primitive, "nodes": nodes, "skins": [skin], "scenes": [{"nodes": [0, 1, 2]}]}


FORMS: list[Callable[[File], dict]] = [
    unindexed, strip, unindexed_strip, fan, sparse, sparse_alone, quantised, whole_numbers, morphed, skinned,
]  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_geometry_is_the_same_in_every_form(tmp_path, form):
    plain = File()
    expected = triangles(plain.read(tmp_path, plain.floor()))
    assert len(expected) == 2
    file = File()
    about = form(file)
    scene = file.read(tmp_path, **about)
    assert triangles(scene) == expected and scene.names == ("floor",) and not scene.left_out


def test_instances_are_things_of_their_own(tmp_path):
    file = File()
    half = 32767 * 0.5**0.5
    turn = np.array([[0, 0, 0, 32767], [0, round(half), 0, round(half)]], np.int16)
    moves = {
        "TRANSLATION": file.add(np.array([[0, 0, 0], [10, 1, 0]], np.float32)),
        "ROTATION": file.add(turn, normalized=True),
    }
    node = {
        "mesh": 0,
        "name": "tree",
        "translation": [0, 0, 5],
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": moves}},
    }
    hidden = {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
    needed = ["EXT_mesh_gpu_instancing"]
    more = {"extensionsUsed": [*needed, "KHR_node_visibility"], "extensionsRequired": needed}
    nodes = [node, hidden, {"mesh": 0}]
    scene = file.read(tmp_path, file.floor(), nodes=nodes, scenes=[{"nodes": [0, 1]}], **more)
    assert scene.names == ("tree 1", "tree 2") and not scene.left_out
    for number, low, high in ((1, [-6, -2, 0], [-4, 2, 0]), (2, [-7, -11, 1], [-3, -9, 1])):
        mine = scene.corners[scene.things == number][..., :3].reshape(-1, 3)
        assert np.allclose(mine.min(0), low, atol=1e-3) and np.allclose(mine.max(0), high, atol=1e-3)


RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
FOUR = np.array([[RED, GREEN], [BLUE, WHITE]], np.uint8)  # red at u v 0 0, green at the right, blue below


def colour_at(scene: GltfScene, u: float, v: float) -> list[int]:
    """0 or 1 of each channel of the floor at a share of its width (from x = -2) and depth (from z = -1): flat triangles."""
    target = np.array([1 - 2 * v, 2 - 4 * u])  # x, y of ours
    for face, which in zip(scene.corners.astype(float), scene.material):
        share = np.linalg.solve(np.vstack([face[:, :2].T, np.ones(3)]), [*target, 1])
        if (share > -1e-6).all():
            at, material = share @ face, scene.materials[which]
            colour = at[3:6] * material.colour[:3]
            if material.picture is not None:
                colour = colour * material.picture.sample(at[7:8], at[8:9])[0, :3]
            return np.round(colour).astype(int).tolist()
    raise AssertionError("no triangle is there")


def textured(folder, info: dict | None = None, uv: dict[str, np.ndarray] | None = None, **more) -> GltfScene:
    """The floor with the picture FOUR."""
    file = File()
    sets = {name: file.add(rows) for name, rows in (uv or {"TEXCOORD_0": UV}).items()}
    view = file.picture(FOUR, more.pop("kind", "PNG"))
    surface = {"baseColorTexture": {"index": 0, **(info or {})}}
    images = {"images": [{"bufferView": view, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    about = {"materials": [{"pbrMetallicRoughness": surface}], **images, **more}
    return file.read(folder, file.floor(attributes=sets), **about)


def moved(**how: object) -> dict:
    return {"extensions": {"KHR_texture_transform": how}}


def sampler(**how: int) -> dict:
    return {"samplers": [how], "textures": [{"source": 0, "sampler": 0}]}


QUARTERS = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
PLAIN, NONE, WEBP, KTX2 = [RED, GREEN, BLUE, WHITE], UV * 0, "EXT_texture_webp", "KHR_texture_basisu"
TURN = {"rotation": np.pi / 2, "offset": [0, 1]}  # u' = v, v' = 1 - u
PLACED = {  # how the picture is stored, and what the four quarters of the floor show
    "plainly": ({}, PLAIN),
    "by the second set": (
        {"info": {"texCoord": 1}, "uv": {"TEXCOORD_0": NONE, "TEXCOORD_1": UV[:, ::-1].copy()}},
        [RED, BLUE, GREEN, WHITE],
    ),
    "by the transform's set": (
        {"info": {"texCoord": 1, **moved(texCoord=0)}, "uv": {"TEXCOORD_0": UV, "TEXCOORD_1": NONE}},
        PLAIN,
    ),
    "turned": ({"info": moved(**TURN)}, [BLUE, RED, WHITE, GREEN]),
    "turned and stretched": ({"info": moved(**TURN, scale=[0.5, 1])}, [BLUE, BLUE, WHITE, WHITE]),
    "upside down": ({"info": moved(offset=[0, 1], scale=[1, -1])}, [BLUE, WHITE, RED, GREEN]),
    "repeated": ({"info": moved(offset=[1.5, 0])}, [GREEN, RED, WHITE, BLUE]),
    "clamped": ({"info": moved(offset=[1.5, 0]), **sampler(wrapS=33071)}, [GREEN, GREEN, WHITE, WHITE]),
    "mirrored": ({"info": moved(offset=[1, 0]), **sampler(wrapS=33648)}, [GREEN, RED, WHITE, BLUE]),
    "in bytes": ({"uv": {"TEXCOORD_0": (UV * 2).astype(np.uint8)}, "info": moved(scale=[0.5, 0.5])}, PLAIN),
    "as WebP": ({"kind": "WEBP", "textures": [{"extensions": {WEBP: {"source": 0}}}]}, PLAIN),
    "as PNG beside KTX2": (
        {"textures": [{"source": 0, "extensions": {KTX2: {"source": 0}}}], "extensionsUsed": [KTX2]},
        PLAIN,
    ),
}


@pytest.mark.parametrize("way", PLACED)
def test_a_picture_lies_as_its_material_says(tmp_path, way):
    how, shown = PLACED[way]
    scene = textured(tmp_path, **how)
    assert [colour_at(scene, u, v) for u, v in QUARTERS] == [[channel // 255 for channel in colour] for colour in shown]
    assert not scene.left_out


COLOURS = {
    "float": (np.tile(np.array([1, 0, 0], np.float32), (4, 1)), {}),
    "bytes": (np.tile(np.array([255, 0, 0, 255], np.uint8), (4, 1)), {"normalized": True}),
    "bytes without a mark": (np.tile(np.array([255, 0, 0, 255], np.uint8), (4, 1)), {}),
    "16 bits": (np.tile(np.array([65535, 0, 0], np.uint16), (4, 1)), {"normalized": True}),
}


def test_a_picture_beside_the_file_may_differ_in_capitals_and_scenes_may_be_absent(tmp_path):
    (tmp_path / "Tex").mkdir()
    Image.fromarray(FOUR).save(tmp_path / "Tex" / "A.PNG")
    more = {"images": [{"uri": "tex\\a.png"}], "scenes": []}
    scene = textured(tmp_path, **more)
    assert [colour_at(scene, *quarter) for quarter in QUARTERS] == [[round(c / 255) for c in one] for one in PLAIN]
    assert scene.names == ("floor",) and not scene.left_out


@pytest.mark.parametrize("kind", COLOURS)
def test_vertex_colours_of_every_type(tmp_path, kind):
    file = File()
    rows, how = COLOURS[kind]
    scene = file.read(tmp_path, file.floor(attributes={"COLOR_0": file.add(rows, **how)}))
    assert np.allclose(scene.corners[..., 3:7], [1, 0, 0, 1])


def glossy(**how: object) -> list:
    plain = {"baseColorFactor": [0, 0, 1, 1]}
    return [{"pbrMetallicRoughness": plain, "extensions": {"KHR_materials_pbrSpecularGlossiness": how}}]


def test_specular_glossiness_has_its_own_base_colour(tmp_path):
    used = ["KHR_materials_pbrSpecularGlossiness"]
    file = File()
    materials = glossy(diffuseFactor=[0, 1, 0, 1], specularFactor=[1, 1, 1])
    scene = file.read(tmp_path, file.floor(), materials=materials, extensionsUsed=used, extensionsRequired=used)
    assert scene.materials[0].colour == (0, 1, 0, 1) and not scene.left_out
    scene = textured(tmp_path, materials=glossy(diffuseTexture={"index": 0}), extensionsUsed=used)
    assert [colour_at(scene, u, v) for u, v in QUARTERS[:2]] == [[1, 0, 0], [0, 1, 0]]


def test_a_grey_picture_of_16_bits_keeps_its_brightness(tmp_path):
    file = File()
    about = {"images": [{"bufferView": file.picture(np.full((8, 8), 40000, np.uint16))}], "textures": [{"source": 0}]}
    about |= {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]}
    picture = file.read(tmp_path, file.floor(attributes={"TEXCOORD_0": file.add(UV)}), **about).materials[0].picture
    assert picture is not None and np.unique(picture.pixels).tolist() == [155, 255]  # and opaque


def test_only_what_shines_in_the_picture_of_its_glow_glows(tmp_path):
    """A panel that is half dark: an emissive picture multiplies the emissive factor."""
    half = {
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": {"index": 0},
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
    }
    file = File()
    view = file.picture(np.array([[[0, 0, 0], [255, 255, 255]]], np.uint8))
    about = {"images": [{"bufferView": view}], "textures": [{"source": 0}], "materials": [half]}
    scene = file.read(tmp_path, file.floor(attributes={"TEXCOORD_0": file.add(UV)}), **about)
    gaussians, *_ = of_triangles(scene, 2000)
    right = gaussians.means[:, 1] < -0.2  # x of glTF goes to the right, our y to the left
    left = gaussians.means[:, 1] > 0.2
    assert gaussians.colours[right].min() > 0.9 and gaussians.colours[left].max() < 0.3


def test_compression_is_named_and_its_plain_copy_is_read(tmp_path):
    name = "KHR_draco_mesh_compression"
    for plain in (True, False):
        file = File()
        primitive = file.floor(extensions={name: {"bufferView": 0, "attributes": {"POSITION": 0}}})
        if not plain:
            file.accessors[primitive["indices"]].pop("bufferView")
            with pytest.raises(DatasetError, match=f"compressed .{name}.*without compression"):
                file.read(tmp_path, primitive, extensionsUsed=[name])
        else:
            assert len(file.read(tmp_path, primitive, extensionsUsed=[name]).corners) == 2


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_meshopt_without_a_plain_copy_is_named(tmp_path, name):
    file = File()
    primitive = file.floor()
    position = file.accessors[primitive["attributes"]["POSITION"]]
    view = file.views[position["bufferView"]]
    view["extensions"] = {name: {"buffer": 0, "byteLength": 9, "byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}}
    assert len(file.read(tmp_path, primitive, extensionsUsed=[name]).corners) == 2  # the buffer holds the plain copy
    view["buffer"], view["byteOffset"] = 1, 0
    empty = {"byteLength": 48, "extensions": {name: {"fallback": True}}}
    with pytest.raises(DatasetError, match=f"compressed .{name}"):
        file.read(tmp_path, primitive, extensionsUsed=[name], more_buffers=[empty])


@pytest.mark.parametrize("name", ["KHR_texture_basisu", "EXT_texture_avif", "MSFT_texture_dds"])
def test_pictures_of_other_kinds_are_named(tmp_path, name):
    with pytest.raises(DatasetError, match=f"{name}.*PNG or JPEG"):
        textured(tmp_path, textures=[{"extensions": {name: {"source": 0}}}], extensionsUsed=[name])
    file = File()
    ktx = file.view(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(64))
    surface = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    images = [{"bufferView": ktx, "mimeType": "image/ktx2"}]
    with pytest.raises(DatasetError, match="image/ktx2.*PNG, JPEG or WebP"):
        file.read(tmp_path, file.floor(), materials=surface, images=images, textures=[{"source": 0}])


def test_what_is_not_read_is_named(tmp_path, capsys):
    file = File()
    floor = file.floor()
    points = {"attributes": {"POSITION": file.add(FLOOR)}, "mode": 0}
    surface = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    used = ["KHR_materials_transmission", "KHR_materials_unlit", "KHR_texture_transform"]
    more = {
        "meshes": [{"primitives": [floor, points]}], "animations": [{"channels": [], "samplers": []}], "extensionsUsed": used,
        "extensionsRequired": used[:1], "materials": surface, "images": [{"uri": "gone\\wood.png"}], "textures": [{"source": 0}],
    }  # fmt: skip
    scene = file.read(tmp_path, floor, **more)
    transmission, others, animations, picture = scene.left_out
    assert len(scene.corners) == 2 and scene.materials[0].picture is None
    assert (transmission, others, animations) == (
        "KHR_materials_transmission",
        "1 meshes of points or lines",
        "animations",
    )
    assert "wood.png" in picture
    (tmp_path / "gone").mkdir()
    Image.fromarray(FOUR).save(tmp_path / "gone" / "wood.png")
    assert read_gltf(tmp_path / "a.gltf").materials[0].picture is not None
    small = ["--gaussians", "1000", "--size", "24", "32"]
    assert main(["space", "build", str(tmp_path / "a.gltf"), "--out", str(tmp_path / "out"), *small]) == 0
    assert "left out: KHR_materials_transmission, 1 meshes of points or lines, animations" in capsys.readouterr().out


def test_a_thing_without_a_name_has_that_of_the_node_above(tmp_path):
    file = File()
    nodes = [{"name": "table", "children": [1, 2]}, {"children": [3]}, {"mesh": 0, "name": "leaf"}, {"mesh": 0}]
    assert file.read(tmp_path, file.floor(), nodes=nodes).names == ("table", "leaf")
