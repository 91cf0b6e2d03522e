"""The scene of a glTF file: triangles in the world with colours, pictures and names; lights; or Gaussians."""

import warnings
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
from .gltf_material import Material, MaterialPicture, base_of, material_of, transformed_uv

MOST_FACES, MOST_NODES, MOST_LIGHTS = 2_000_000, 100_000, 64
MOST_JOINTS = 4  # groups of four
GLTF_ENDINGS = (".glb", ".gltf")
SPLATS = "KHR_gaussian_splatting"
_AXES = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])  # a point of glTF [3] times this is ours


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
    """corners float32 [F, 3, 9] of triangles: x y z (world frame, metres), tint red green blue opacity (linear), u v of its
    pictures; int32 [F]: the index in `materials` of each, and in `names`, from 1; left_out: what of the file is not read."""

    corners: np.ndarray
    material: np.ndarray
    things: np.ndarray
    materials: tuple[Material, ...]
    names: tuple[str, ...]
    lights: tuple[Light, ...]
    left_out: tuple[str, ...] = ()


def read_gltf(path: str | Path, scale: float = 1.0) -> GltfScene | Gaussians:
    """The triangles and lights of a .glb or .gltf in its pose at rest, or its Gaussians (KHR_gaussian_splatting; in glTF's own
    frame; a warning names what else there is). scale: metres per unit of the file. DatasetError for a broken, compressed or too
    large file."""
    path = Path(path)
    try:
        file = open_gltf(path)
        placed = list(_nodes(file, np.diag([scale, scale, scale, 1.0])))
        places = {index: matrix for index, _, matrix in placed}
        nodes = [one for _, node, matrix in placed for one in _instances(file, node, matrix)]
        parts = [(node, matrix, part) for node, matrix in nodes for part in _parts(file, node)]
        if len(parts) > MOST_NODES:
            raise ValueError(f"it has {len(parts):,} things, {MOST_NODES:,} is the most")
        splats = [one for one in parts if SPLATS in one[2].get("extensions", {})]
        if not splats:
            return _scene(file, nodes, parts, places)
        if left_out := [*file.unread(), *([f"{len(parts) - len(splats)} meshes"] if len(parts) > len(splats) else [])]:
            warnings.warn(f"beside its Gaussians the file has {', '.join(left_out)}, which are left out.", stacklevel=2)
        return join([_gaussians(file, matrix, part["attributes"]) for _, matrix, part in splats])
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


def _nodes(file: Gltf, whole: np.ndarray) -> Iterator[tuple[int, dict[str, Any], np.ndarray]]:
    """All visible nodes of the shown scene: the number of each, and its matrix [4, 4] to the world, which ends with `whole`. A node
    without a name has that of the one above it."""
    about = file.about
    if len(about.get("nodes", [])) > MOST_NODES:
        raise ValueError(f"it has {len(about['nodes']):,} nodes, {MOST_NODES:,} is the most")
    if about.get("scenes"):
        roots = file.named("scenes", about.get("scene", 0)).get("nodes", [])
    else:
        inner = {child for node in about.get("nodes", []) for child in node.get("children", [])}
        roots = [k for k in range(len(about.get("nodes", []))) if k not in inner]
    waiting, seen = [(root, whole, "") for root in reversed(roots)], set()
    while waiting:
        index, above, name = waiting.pop()
        if index in seen:
            raise ValueError("its nodes go in a circle")
        node = file.named("nodes", index)
        seen.add(index)
        if node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible") is False:
            continue
        matrix, name = above @ _matrix(node), _name(file, node) or name
        yield index, {**node, "name": name}, matrix
        waiting += [(child, matrix, name) for child in reversed(node.get("children", []))]


def _instances(file: Gltf, node: dict[str, Any], matrix: np.ndarray) -> list[tuple[dict[str, Any], np.ndarray]]:
    """The node, or each of its instances (EXT_mesh_gpu_instancing) with its own name."""
    given = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes", {})
    widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
    moves = {name.lower(): file.numbers(given[name], width) for name, width in widths.items() if name in given}
    if not moves or "mesh" not in node:
        return [(node, matrix)]
    name, count = node["name"] or "thing", min(map(len, moves.values()))
    if count > MOST_NODES:
        raise ValueError(f"it has {count:,} instances of {name}, {MOST_NODES:,} is the most")
    bare = {key: value for key, value in node.items() if key not in ("extensions", "skin")}
    return [
        ({**bare, "name": f"{name} {k + 1}"}, matrix @ _matrix({key: rows[k] for key, rows in moves.items()}))
        for k in range(count)
    ]


def _name(file: Gltf, node: dict[str, Any]) -> str:
    mesh = file.named("meshes", node["mesh"]) if "mesh" in node else {}
    return str(node.get("name") or mesh.get("name") or "")[:80]


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


def _scene(file: Gltf, nodes: list, parts: list, places: dict[int, np.ndarray]) -> GltfScene:
    solid = [one for one in parts if one[2].get("mode", 4) in _CORNERS]
    many = sum(_count(file, part) for *_, part in solid)
    if many > MOST_FACES:
        raise ValueError(f"it has {many:,} triangles, {MOST_FACES:,} is the most: decimate it")
    left_out = file.unread()
    if len(parts) > len(solid):
        left_out.append(f"{len(parts) - len(solid)} meshes of points or lines")
    if file.about.get("animations"):
        left_out.append("animations")
    if (others := len(file.about.get("scenes", [])) - 1) > 0:
        left_out.append(f"{others} scenes that are not shown at first")
    abouts, names, numbers = file.about.get("materials", []), list[str](), dict[int, int]()
    corners, material, things = [], [], []
    for node, matrix, part in solid:
        which = part.get("material", -1)
        if type(which) is not int or not -1 <= which < len(abouts):
            raise ValueError("it uses a material that it does not have")
        one = _triangles(file, node, matrix, part, base_of(abouts[which] if which >= 0 else {})[1], places)
        if id(node) not in numbers:
            names.append(node["name"] or f"thing {len(names) + 1}")
            numbers[id(node)] = len(names)
        corners.append(one)
        material.append(np.full(len(one), which, np.int32))
        things.append(np.full(len(one), numbers[id(node)], np.int32))
    if not sum(map(len, corners)):
        raise ValueError("it has no triangles")
    used, which = np.unique(np.concatenate(material), return_inverse=True)
    pictures: dict[int, MaterialPicture | None] = {}
    looks = tuple(material_of(file, abouts[k] if k >= 0 else {}, pictures, left_out) for k in used.tolist())
    tables = np.concatenate(corners), which.astype(np.int32), np.concatenate(things)
    return GltfScene(*tables, looks, tuple(names), _lights(file, nodes), tuple(left_out))


def _count(file: Gltf, part: dict[str, Any]) -> int:
    """Triangles of a primitive."""
    rows = file.count(part.get("indices", part["attributes"]["POSITION"]))
    return rows // 3 if part.get("mode", 4) == 4 else max(rows - 2, 0)


def _triangles(
    file: Gltf,
    node: dict[str, Any],
    matrix: np.ndarray,
    part: dict[str, Any],
    texture: dict[str, Any],
    places: dict[int, np.ndarray],
) -> np.ndarray:
    """Corners [F, 3, 9] of a primitive, without triangles that have no area or are not finite."""
    file.check_uncompressed(part)
    given = part["attributes"]
    points = _points(file, node, part)
    rows = np.zeros((len(points), 9), np.float32)
    if "skin" in node and "JOINTS_0" in given:
        points, matrix = _skinned(file, node, given, points, places), np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):
        rows[:, :3] = (points @ matrix[:3, :3].T + matrix[:3, 3]) @ _AXES
    rows[:, 3:7] = 1
    transform_uv = texture.get("extensions", {}).get("KHR_texture_transform", {})
    uv = f"TEXCOORD_{transform_uv.get('texCoord', texture.get('texCoord', 0))}"
    for name, first, widths in (("COLOR_0", 3, (3, 4)), (uv, 7, (2,))):
        if name in given:
            values = file.numbers(given[name], *widths)
            if len(values) != len(points):
                raise ValueError(f"its {name} are {len(values):,} and its points {len(points):,}")
            if first == 3 and values.dtype.kind in "iu":  # colours that lack the mark "normalized"
                values = values / np.iinfo(values.dtype).max
            rows[:, first : first + values.shape[1]] = values
    rows[:, 7:] = transformed_uv(rows[:, 7:], transform_uv)
    index = file.numbers(part["indices"], 1)[:, 0].astype(np.int64) if "indices" in part else np.arange(len(points))
    if len(index) and not 0 <= index.min() <= index.max() < len(points):
        raise ValueError("a triangle uses a corner that the file does not have")
    index = index[_CORNERS[part.get("mode", 4)](np.arange(_count(file, part)))]
    corners = rows[index[:, [0, 2, 1]] if np.linalg.det(matrix[:3, :3]) < 0 else index]
    with np.errstate(over="ignore", invalid="ignore"):
        first, second = corners[:, 1, :3] - corners[:, 0, :3], corners[:, 2, :3] - corners[:, 0, :3]
        area = np.linalg.norm(np.cross(first, second), axis=1)
    return corners[np.isfinite(corners).all((1, 2)) & np.isfinite(area) & (area > 1e-12)]


# mode of a primitive (triangles, strip, fan) -> the rows of its corners [F, 3] by the number of the triangle [F]
_CORNERS = {
    4: lambda k: np.stack([3 * k, 3 * k + 1, 3 * k + 2], 1),
    5: lambda k: np.stack([k, k + 1 + k % 2, k + 2 - k % 2], 1),
    6: lambda k: np.stack([k + 1, k + 2, 0 * k], 1),
}


def _points(file: Gltf, node: dict[str, Any], part: dict[str, Any]) -> np.ndarray:
    """The places [N, 3] of a primitive's corners, with the morph targets of its pose at rest."""
    points = file.numbers(part["attributes"]["POSITION"], 3)
    weights = node.get("weights", file.named("meshes", node["mesh"]).get("weights", []))
    for weight, target in zip(weights, part.get("targets", [])):
        if weight and "POSITION" in target:
            points = points + float(weight) * file.numbers(target["POSITION"], 3)
    return points


def _skinned(
    file: Gltf, node: dict[str, Any], given: dict[str, Any], points: np.ndarray, places: dict[int, np.ndarray]
) -> np.ndarray:
    """The points [N, 3] as the joints of the node's skin hold them, in the world."""
    skin = file.named("skins", node["skin"])
    joints = np.stack([places[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = file.numbers(skin["inverseBindMatrices"], 16)[: len(joints)]
        joints = joints @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
    whole, total = np.concatenate([points, np.ones((len(points), 1))], 1), np.zeros((len(points), 4))
    for group in range(MOST_JOINTS):
        if f"JOINTS_{group}" not in given:
            break
        which, weights = file.numbers(given[f"JOINTS_{group}"], 4), file.numbers(given[f"WEIGHTS_{group}"], 4)
        if which.max() >= len(joints) or len(which) != len(points):
            raise ValueError("its skin uses a joint that it does not have")
        for joint, weight in zip(which.T, weights.T):
            total += weight[:, None] * (joints[joint] @ whole[..., None])[..., 0]
    return total[:, :3] / np.where(total[:, 3:] > 0, total[:, 3:], 1)


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
