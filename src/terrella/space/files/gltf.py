"""glTF 2.0 (.glb, .gltf): its JSON, tables of numbers and pictures; broken and hostile files are rejected."""

import base64
import binascii
import io
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from PIL import Image

GLTF = b"glTF"
MOST_PIXELS, SIDE = 1 << 26, 1024  # of a picture; larger ones are made smaller
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_KNOWN = {
    "KHR_lights_punctual", "KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_mesh_quantization",
    "KHR_texture_transform", "EXT_texture_webp", "KHR_gaussian_splatting",
}  # fmt: skip


@dataclass(frozen=True)
class Gltf:
    """about: the JSON; buffers: its binary data; folder: that of the file, for pictures beside it."""

    about: dict[str, Any]
    buffers: tuple[bytes, ...]
    folder: Path

    def named(self, kind: str, index: Any) -> dict[str, Any]:
        """Entry `index` of a list in the JSON; ValueError where there is none."""
        entries = self.about.get(kind, [])
        if type(index) is not int or not isinstance(entries, list) or not 0 <= index < len(entries):
            raise ValueError(f"it speaks of number {str(index)[:20]} of its {kind}, which it has not")
        if not isinstance(entries[index], dict):
            raise ValueError(f"number {index} of its {kind} is nothing")
        return entries[index]

    def count(self, index: Any) -> int:
        """The number of rows that an accessor states."""
        return _whole(self.named("accessors", index), "count")

    def numbers(self, index: Any, *widths: int) -> np.ndarray:
        """The rows of an accessor, [count, width], with a width among `widths`; normalised integers as float32 in -1..1."""
        about = self.named("accessors", index)
        if "sparse" in about:
            raise ValueError("it has sparse accessors, which are not read")
        if about.get("componentType") not in _TYPES or _WIDTHS.get(str(about.get("type"))) not in widths:
            raise ValueError(f"its accessor {index} is of a type that does not belong there")
        width, kind = _WIDTHS[about["type"]], np.dtype(_TYPES[about["componentType"]])
        view = self.named("bufferViews", about["bufferView"])
        start, count = _whole(view, "byteOffset", 0) + _whole(about, "byteOffset", 0), _whole(about, "count")
        stride = _whole(view, "byteStride", 0) or width * kind.itemsize
        end = min(_whole(view, "byteOffset", 0) + _whole(view, "byteLength"), len(self._buffer(view)))
        if not count or start + stride * (count - 1) + width * kind.itemsize > end:
            raise ValueError(f"it ends before the {count:,} rows of its accessor {index} do")
        rows = np.ndarray((count, width), kind, self._buffer(view), start, (stride, kind.itemsize))
        if about.get("normalized") and kind.kind in "iu":
            return np.maximum(rows.astype(np.float32) / np.iinfo(kind).max, -1)
        return rows

    def picture(self, texture: Any) -> np.ndarray:
        """The picture of a texture: uint8 [height, width, 4], at most SIDE a side; its size is checked before decoding."""
        about = self.named("textures", texture)
        webp = about.get("extensions", {}).get("EXT_texture_webp", {})
        image = self.named("images", webp.get("source", about.get("source")))
        if "uri" in image:
            data = _of_uri(image["uri"], self.folder)
        else:
            view = self.named("bufferViews", image["bufferView"])
            first = _whole(view, "byteOffset", 0)
            data = self._buffer(view)[first : first + _whole(view, "byteLength")]
        with Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"]) as opened:
            if opened.width * opened.height > MOST_PIXELS:
                raise ValueError(f"it has a picture of {opened.width:,} x {opened.height:,} pixels")
            shown = opened.convert("RGBA")
        shown.thumbnail((SIDE, SIDE))
        return np.asarray(shown)

    def _buffer(self, view: dict[str, Any]) -> bytes:
        index = view.get("buffer")
        if type(index) is not int or not 0 <= index < len(self.buffers):
            raise ValueError(f"it speaks of a buffer {index}, which it has not")
        return self.buffers[index]


def open_gltf(path: Path) -> Gltf:
    """The file, with its meshes not decoded; ValueError or KeyError if it is broken, cut short or compressed."""
    data = path.read_bytes()
    text, body = _chunks(data) if data[:4] == GLTF else (data, b"")
    about = json.loads(text)
    if not isinstance(about, dict) or not str(about.get("asset", {}).get("version", "")).startswith("2."):
        raise ValueError("it is no glTF of version 2")
    needed = about.get("extensionsRequired", [])
    if packed := [name for name in _COMPRESSED if name in needed]:
        raise ValueError(f"its meshes are compressed ({packed[0]}), which is not read: export it without compression")
    unknown = sorted(set(map(str, needed)) - _KNOWN)
    if unknown:
        raise ValueError(f"it cannot be read without {', '.join(unknown)[:200]}: export it without")
    buffers = []
    for k, one in enumerate(about.get("buffers", [])):
        content = _of_uri(one["uri"], path.parent) if "uri" in one else body if k == 0 else b""
        if len(content) < _whole(one, "byteLength"):
            raise ValueError(f"it ends before the {one['byteLength']:,} bytes of its buffer {k} do")
        buffers.append(content)
    return Gltf(about, tuple(buffers), path.parent)


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """The JSON of a .glb, and its bytes."""
    chunks, at = {}, 12
    if len(data) < 20:
        raise ValueError("it ends within its header")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ValueError(f"it is glTF of version {version}, which is not 2")
    if length > len(data):
        raise ValueError(f"it should be {length:,} bytes long, and has only {len(data):,}")
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise ValueError("it ends within one of its chunks")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return chunks[b"JSON"], chunks.get(b"BIN\0", b"")


def _of_uri(uri: Any, folder: Path) -> bytes:
    """The data of a buffer or picture outside the .glb: in the JSON, or in a file beside it."""
    if str(uri).startswith("data:"):
        try:
            return base64.b64decode(str(uri).partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(f"what it holds as text is broken ({error})") from error
    name = unquote(str(uri))
    if Path(name).is_absolute() or ".." in Path(name).parts or not (folder / name).is_file():
        raise ValueError(f"it lacks the file {name[:80]!r} beside it; export it as one .glb")
    return (folder / name).read_bytes()


def _whole(about: dict[str, Any], name: str, usual: int | None = None) -> int:
    """A count or length in the JSON."""
    value = about.get(name, usual)
    if type(value) is not int or value < 0:
        raise ValueError(f"its {name} is {str(value)[:20]}, which is no length")
    return value
