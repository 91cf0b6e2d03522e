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
from PIL import Image, UnidentifiedImageError

GLTF = b"glTF"
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648  # how a texture goes on
MOST_PIXELS, SIDE = 1 << 26, 1024  # of a picture; larger ones are made smaller
MOST_ROWS = 1 << 26  # of an accessor
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_DRACO, _MESHOPT = "KHR_draco_mesh_compression", ("EXT_meshopt_compression", "KHR_meshopt_compression")
_TEXTURES = ("KHR_texture_basisu", "EXT_texture_avif", "MSFT_texture_dds")  # not read, unless there is another picture
_READ = {
    "KHR_lights_punctual", "KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization", "KHR_node_visibility", "KHR_texture_transform", "EXT_mesh_gpu_instancing", "EXT_texture_webp",
    "KHR_gaussian_splatting",
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
            raise ValueError(f"it uses number {str(index)[:20]} of its {kind}, which it does not have")
        if not isinstance(entries[index], dict):
            raise ValueError(f"number {index} of its {kind} is nothing")
        return entries[index]

    def count(self, index: Any) -> int:
        """The number of rows that an accessor states."""
        return _whole(self.named("accessors", index), "count")

    def numbers(self, index: Any, *widths: int) -> np.ndarray:
        """The rows of an accessor, [count, width], with a width among `widths`; normalised integers as float32 in -1..1."""
        about = self.named("accessors", index)
        if about.get("componentType") not in _TYPES or _WIDTHS.get(str(about.get("type"))) not in widths:
            raise ValueError(f"its accessor {index} is of a type that does not belong there")
        width, kind, count = _WIDTHS[about["type"]], np.dtype(_TYPES[about["componentType"]]), _whole(about, "count")
        if count > MOST_ROWS:
            raise ValueError(f"its accessor {index} has {count:,} rows, {MOST_ROWS:,} is the most")
        bare = "bufferView" not in about
        rows = np.zeros((count, width), kind) if bare else self._rows(about, count, width, kind)
        if "sparse" in about:
            sparse, rows = about["sparse"], rows.copy()
            some = _whole(sparse, "count")
            where = self._rows(sparse["indices"], some, 1, np.dtype(_TYPES[sparse["indices"]["componentType"]]))[:, 0]
            if where.max() >= count:
                raise ValueError(f"its sparse accessor {index} changes a row that it does not have")
            rows[where] = self._rows(sparse["values"], some, width, kind)
        if about.get("normalized") and kind.kind in "iu":
            return np.maximum(rows.astype(np.float32) / np.iinfo(kind).max, -1)
        return rows

    def _rows(self, about: dict[str, Any], count: int, width: int, kind: np.dtype) -> np.ndarray:
        """Rows [count, width] of a buffer view, from an offset on."""
        view = self.named("bufferViews", about["bufferView"])
        packed = [name for name in _MESHOPT if name in view.get("extensions", {})]
        data = self._buffer(view)
        if packed and not data:
            raise ValueError(compressed(packed[0]))
        start = _whole(view, "byteOffset", 0) + _whole(about, "byteOffset", 0)
        stride = _whole(view, "byteStride", 0) or width * kind.itemsize
        end = min(_whole(view, "byteOffset", 0) + _whole(view, "byteLength"), len(data))
        if not count or start + stride * (count - 1) + width * kind.itemsize > end:
            raise ValueError(f"it ends before {count:,} rows of one of its accessors do")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def check_uncompressed(self, part: dict[str, Any]) -> None:
        """ValueError for a primitive whose numbers are in Draco's form alone."""
        used = [*part["attributes"].values(), *([part["indices"]] if "indices" in part else [])]
        if _DRACO in part.get("extensions", {}) and any("bufferView" not in self.named("accessors", k) for k in used):
            raise ValueError(compressed(_DRACO))

    def picture(self, texture: Any) -> np.ndarray:
        """The picture of a texture: uint8 [height, width, 4], at most SIDE a side; its size is checked before decoding.
        FileNotFoundError where its file is absent."""
        about = self.named("textures", texture)
        more = about.get("extensions", {})
        source = more.get("EXT_texture_webp", {}).get("source", about.get("source"))
        if source is None:
            raise ValueError(
                f"it has a picture as {', '.join(more) or 'nothing'}, which is not read: export PNG or JPEG"
            )
        image = self.named("images", source)
        if "uri" in image:
            data = _of_uri(image["uri"], self.folder)
        else:
            view = self.named("bufferViews", image["bufferView"])
            first = _whole(view, "byteOffset", 0)
            data = self._buffer(view)[first : first + _whole(view, "byteLength")]
        try:
            with Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"]) as opened:
                if opened.width * opened.height > MOST_PIXELS:
                    raise ValueError(f"it has a picture of {opened.width:,} x {opened.height:,} pixels")
                deep = np.asarray(opened) // 257 if opened.mode.startswith("I") else None  # of 16 bits
                shown = (opened if deep is None else Image.fromarray(deep.astype(np.uint8))).convert("RGBA")
        except UnidentifiedImageError as error:
            kind = ", ".join([str(image.get("mimeType", image.get("name", "")))[:40], *more]).strip(", ")
            raise ValueError(f"its picture {source} ({kind}) is no PNG, JPEG or WebP: export it as one") from error
        shown.thumbnail((SIDE, SIDE))
        return np.asarray(shown)

    def wrap(self, texture: Any) -> tuple[int, int]:
        """How a texture goes on beyond 0..1 along u and v: REPEAT, CLAMP or MIRROR."""
        about = self.named("textures", texture)
        sampler = self.named("samplers", about["sampler"]) if "sampler" in about else {}
        return int(sampler.get("wrapS", REPEAT)), int(sampler.get("wrapT", REPEAT))

    def unread(self) -> list[str]:
        """Extensions that the file uses and that are not read; of compressed data without a plain copy, reading fails instead."""
        plain = {*_READ, _DRACO, *_MESHOPT, *_TEXTURES}
        return sorted(set(map(str, self.about.get("extensionsUsed", []))) - plain)

    def _buffer(self, view: dict[str, Any]) -> bytes:
        index = view.get("buffer")
        if type(index) is not int or not 0 <= index < len(self.buffers):
            raise ValueError(f"it uses a buffer {index} that it does not have")
        return self.buffers[index]


def open_gltf(path: Path) -> Gltf:
    """The file, with its meshes not decoded; ValueError or KeyError if it is broken, cut short or compressed."""
    data = path.read_bytes()
    text, body = _chunks(data) if data[:4] == GLTF else (data, b"")
    about = json.loads(text)
    if not isinstance(about, dict) or not str(about.get("asset", {}).get("version", "")).startswith("2."):
        raise ValueError("it is no glTF of version 2")
    needed = list(map(str, about.get("extensionsRequired", [])))
    if packed := [name for name in (_DRACO, *_MESHOPT) if name in needed]:
        raise ValueError(compressed(packed[0]))
    unknown = sorted(one for one in set(needed) - _READ if not one.startswith("KHR_materials_"))  # only looks
    if unknown:
        raise ValueError(f"it cannot be read without {', '.join(unknown)[:200]}: export it without")
    buffers = []
    for k, one in enumerate(about.get("buffers", [])):
        if "uri" not in one and any(one.get("extensions", {}).get(name, {}).get("fallback") for name in _MESHOPT):
            buffers.append(b"")  # what is compressed has no plain copy
            continue
        content = _of_uri(one["uri"], path.parent) if "uri" in one else body if k == 0 else b""
        if len(content) < _whole(one, "byteLength"):
            raise ValueError(f"it ends before the {one['byteLength']:,} bytes of its buffer {k} do")
        buffers.append(content)
    return Gltf(about, tuple(buffers), path.parent)


def compressed(name: str) -> str:
    """The error for compressed meshes."""
    return f"its meshes are compressed ({name}), which is not read: export it without compression"


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
    for name in dict.fromkeys([unquote(str(uri)), str(uri), unquote(str(uri)).replace("\\", "/")]):
        if not Path(name).is_absolute() and ".." not in Path(name).parts and (file := _beside(folder, name)):
            return file.read_bytes()
    raise FileNotFoundError(f"it lacks the file {str(uri)[:80]!r} beside it; export it as one .glb")


def _beside(folder: Path, name: str) -> Path | None:
    """The file of that name in a folder; where there is none, one whose name differs in capitals alone."""
    if (folder / name).is_file():
        return folder / name
    here = [folder]
    for part in Path(name).parts:
        inside = (one for at in here if at.is_dir() for one in sorted(at.iterdir()))
        here = [one for one in inside if one.name.casefold() == part.casefold()]
    return next((one for one in here if one.is_file()), None)


def _whole(about: dict[str, Any], name: str, usual: int | None = None) -> int:
    """A count or length in the JSON."""
    value = about.get(name, usual)
    if type(value) is not int or value < 0:
        raise ValueError(f"its {name} is {str(value)[:20]}, which is no length")
    return value
