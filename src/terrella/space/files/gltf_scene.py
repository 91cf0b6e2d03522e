"""The scene of a glTF file: triangles in the world with colours, pictures and names; lights; or Gaussians."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ...core.errors import DatasetError
from ..raster import Gaussians, join
from ..raster.move import transform
from .gltf import Gltf, open_gltf

MOST_FACES, MOST_NODES, MOST_LIGHTS, MOST_PICTURES = 2_000_000, 100_000, 64, 256
GLTF_ENDINGS = (".glb", ".gltf")
SPLATS = "KHR_gaussian_splatting"
_AXES = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])  # a point of glTF [3] times this is ours


@dataclass(frozen=True)
class Material:
    """colour (red, green, blue, opacity) and glow (red, green, blue), linear; picture uint8 [h, w, 4], sRGB; placed: scale and
    offset of its u v; unlit: colours include light; see_through: opacity counts; cut: what is less opaque is invisible."""

    colour: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    glow: tuple[float, ...] = (0.0, 0.0, 0.0)
    picture: np.ndarray | None = None
    placed: tuple[float, ...] = (1.0, 1.0, 0.0, 0.0)
    unlit: bool = False
    see_through: bool = False
    cut: float = 0.0


@dataclass(frozen=True)
class Light:
    """place [3] and direction `towards` [3], world frame; power: red, green, blue in candela (point, spot) or lux (directional);
    cone: cosines of a spot's inner and outer angle."""

    kind: str
    place: np.ndarray
    towards: np.ndarray
    power: np.ndarray
    cone: tuple[float, float] = (1.0, 0.0)


@dataclass(frozen=True)
class GltfScene:
    """corners float32 [F, 3, 9] of triangles: x y z (world frame, metres), tint red green blue opacity (linear), u v; int32 [F]:
    the index in `materials` of each, and in `names`, from 1."""

    corners: np.ndarray
    material: np.ndarray
    things: np.ndarray
    materials: tuple[Material, ...]
    names: tuple[str, ...]
    lights: tuple[Light, ...]


def read_gltf(path: str | Path, scale: float = 1.0) -> GltfScene | Gaussians:
    """The triangles and lights of a .glb or .gltf, or its Gaussians (KHR_gaussian_splatting; in glTF's own frame). scale: metres
    per unit of the file. DatasetError for a broken or too large file."""
    path = Path(path)
    try:
        file = open_gltf(path)
        nodes = list(_nodes(file, np.diag([scale, scale, scale, 1.0])))
        parts = [(node, matrix, part) for node, matrix in nodes for part in _parts(file, node)]
        splats = [one for one in parts if SPLATS in one[2].get("extensions", {})]
        if splats:
            return join([_gaussians(file, matrix, part["attributes"]) for _, matrix, part in splats])
        return _scene(file, nodes, [one for one in parts if one[2].get("mode", 4) == 4])
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        Image.DecompressionBombError,
    ) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise DatasetError(
            f"{path} cannot be opened as glTF: {reason.splitlines()[0].rstrip('.')}; export it again."
        ) from error


def _nodes(file: Gltf, whole: np.ndarray) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """All nodes of the shown scene, each with its matrix [4, 4] to the world, which ends with `whole`."""
    about = file.about
    if "scenes" in about:
        roots = file.named("scenes", about.get("scene", 0)).get("nodes", [])
    else:
        inner = {child for node in about.get("nodes", []) for child in node.get("children", [])}
        roots = [k for k in range(len(about.get("nodes", []))) if k not in inner]
    waiting, seen = [(root, whole) for root in reversed(roots)], set()
    while waiting:
        index, above = waiting.pop()
        if index in seen or len(seen) > MOST_NODES:
            raise ValueError(f"its nodes go in a circle, or are more than {MOST_NODES:,}")
        node = file.named("nodes", index)
        seen.add(index)
        matrix = above @ _matrix(node)
        yield node, matrix
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64).reshape(4)
        turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        matrix = np.eye(4)
        matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not np.isfinite(matrix).all():
        raise ValueError("a node of it is moved by what is no number")
    return matrix


def _parts(file: Gltf, node: dict[str, Any]) -> list[dict[str, Any]]:
    """The primitives of a node."""
    return file.named("meshes", node["mesh"])["primitives"] if "mesh" in node else []


def _scene(file: Gltf, nodes: list, parts: list) -> GltfScene:
    many = sum(file.count(part.get("indices", part["attributes"]["POSITION"])) // 3 for *_, part in parts)
    if many > MOST_FACES:
        raise ValueError(f"it has {many:,} triangles, {MOST_FACES:,} is the most: decimate it")
    names: list[str] = []
    numbers: dict[int, int] = {}
    corners, material, things = [], [], []
    for node, matrix, part in parts:
        one = _triangles(file, matrix, part)
        if id(node) not in numbers:
            name = node.get("name") or file.named("meshes", node["mesh"]).get("name") or f"thing {len(names) + 1}"
            names.append(str(name)[:80])
            numbers[id(node)] = len(names)
        corners.append(one)
        material.append(np.full(len(one), part.get("material", -1), np.int32))
        things.append(np.full(len(one), numbers[id(node)], np.int32))
    if not sum(map(len, corners)):
        raise ValueError("it has no triangles")
    which, abouts = np.concatenate(material), file.about.get("materials", [])
    if which.max() >= len(abouts) or which.min() < -1:
        raise ValueError("it speaks of a material which it has not")
    used, which = np.unique(which, return_inverse=True)
    pictures: dict[int, np.ndarray] = {}
    looks = tuple(_material(file, abouts[k] if k >= 0 else {}, pictures) for k in used.tolist())
    tables = np.concatenate(corners), which.astype(np.int32), np.concatenate(things)
    return GltfScene(*tables, looks, tuple(names), _lights(file, nodes))


def _triangles(file: Gltf, matrix: np.ndarray, part: dict[str, Any]) -> np.ndarray:
    """Corners [F, 3, 9] of a primitive, without triangles that have no area or are not finite."""
    given = part["attributes"]
    places = file.numbers(given["POSITION"], 3)
    count = len(places)
    rows = np.zeros((count, 9), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        rows[:, :3] = (places @ matrix[:3, :3].T + matrix[:3, 3]) @ _AXES
    rows[:, 3:7] = 1
    for name, first, widths in (("COLOR_0", 3, (3, 4)), ("TEXCOORD_0", 7, (2,))):
        if name in given:
            values = file.numbers(given[name], *widths)
            if len(values) != count:
                raise ValueError(f"its {name} are {len(values):,} and its points {count:,}")
            rows[:, first : first + values.shape[1]] = values
    index = file.numbers(part["indices"], 1)[:, 0].astype(np.int64) if "indices" in part else np.arange(count)
    if len(index) and not 0 <= index.min() <= index.max() < count:
        raise ValueError("a triangle of it has a corner which it has not")
    index = index[: len(index) // 3 * 3].reshape(-1, 3)
    corners = rows[index[:, [0, 2, 1]] if np.linalg.det(matrix[:3, :3]) < 0 else index]
    with np.errstate(over="ignore", invalid="ignore"):
        first, second = corners[:, 1, :3] - corners[:, 0, :3], corners[:, 2, :3] - corners[:, 0, :3]
        area = np.linalg.norm(np.cross(first, second), axis=1)
    return corners[np.isfinite(corners).all((1, 2)) & np.isfinite(area) & (area > 1e-12)]


def _material(file: Gltf, about: dict[str, Any], pictures: dict[int, np.ndarray]) -> Material:
    """The material of an entry; `pictures` caches decoded pictures."""
    surface, more = about.get("pbrMetallicRoughness", {}), about.get("extensions", {})
    texture = surface.get("baseColorTexture", {})
    index, bent = texture.get("index"), texture.get("extensions", {}).get("KHR_texture_transform", {})
    if index is not None and index not in pictures:
        if len(pictures) == MOST_PICTURES:
            raise ValueError(f"it has more than {MOST_PICTURES} pictures: join some")
        pictures[index] = file.picture(index)
    strength = float(more.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    mode = about.get("alphaMode", "OPAQUE")
    return Material(
        tuple(map(float, surface.get("baseColorFactor", (1, 1, 1, 1)))),
        tuple(strength * float(part) for part in about.get("emissiveFactor", (0, 0, 0))),
        None if index is None else pictures[index],
        (*map(float, bent.get("scale", (1, 1))), *map(float, bent.get("offset", (0, 0)))),
        "KHR_materials_unlit" in more,
        mode == "BLEND",
        float(about.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.0,
    )


def _lights(file: Gltf, nodes: list) -> tuple[Light, ...]:
    known, lights = file.about.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", []), []
    for node, matrix in nodes:
        which = node.get("extensions", {}).get("KHR_lights_punctual", {}).get("light")
        if which is None:
            continue
        about = known[which] if type(which) is int and 0 <= which < len(known) else {}
        power = float(about.get("intensity", 1.0)) * np.array(about.get("color", (1, 1, 1)), np.float64).reshape(3)
        towards = -matrix[:3, 2] @ _AXES
        spot = about.get("spot", {})
        edges = float(spot.get("innerConeAngle", 0.0)), float(spot.get("outerConeAngle", np.pi / 4))
        if about.get("type") not in ("point", "spot", "directional") or not np.isfinite(power).all():
            raise ValueError("one of its lights is none")
        cone = float(np.cos(edges[0])), float(np.cos(edges[1]))
        towards = towards / max(float(np.linalg.norm(towards)), 1e-9)
        lights.append(Light(about["type"], matrix[:3, 3] @ _AXES, towards, power, cone))
    return tuple(lights[:MOST_LIGHTS])


def _gaussians(file: Gltf, matrix: np.ndarray, attributes: dict[str, Any]) -> Gaussians:
    """The Gaussians of a primitive, transformed by its node, in glTF's frame."""
    given = {name.rpartition(":")[2]: index for name, index in attributes.items()}
    take = lambda name, width: torch.from_numpy(file.numbers(given[name], width).astype(np.float32))  # noqa: E731
    orders = [f"SH_DEGREE_{degree}_COEF_{at}" for degree in range(4) for at in range(2 * degree + 1)]
    many = max((n for n in (1, 4, 9, 16) if set(orders[:n]) <= given.keys()), default=1)
    sh = torch.stack([take(name, 3) for name in orders[:many]], 1)
    places, turns, sizes = take("POSITION", 3), take("ROTATION", 4)[:, [3, 0, 1, 2]], take("SCALE", 3)
    scene = Gaussians(places, turns, sizes, take("OPACITY", 1)[:, 0], sh)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rot = matrix[:3, :3] / max(scale, 1e-9)
    if not np.allclose(rot @ rot.T, np.eye(3), atol=1e-3):
        raise ValueError("its Gaussians are mirrored, or scaled by another factor along each axis")
    return transform(scene, torch.from_numpy(rot).float(), scale, torch.from_numpy(matrix[:3, 3]).float())
