"""A scene of triangles as a place to walk in: flat lit Gaussians on pieces of triangles, and boxes that stop walkers."""

import numpy as np
import torch

from ..camera import rotation
from ..edits import REVEALED
from ..files.gltf_scene import GltfScene
from ..raster import Gaussians
from ..raster.gaussians import plain_sh
from ..raster.move import multiply_quaternions
from .cells import THIN_M
from .mesh_light import exposed, falling
from .mesh_solids import solids_of
from .pieces import pieces

FINEST_M = 0.006
_WIDE = 2.4  # deviations of a Gaussian beside those of the piece that it stands for
_INNER = (
    np.array([[i + 1 / 3, j + 1 / 3, 4 - i - j - 2 / 3] for i in range(4) for j in range(4 - i)]) / 4
)  # in a triangle
_SEEN = 0.02  # opacity
_DARK = 1e-3  # a surface that glows less than this does not


def of_triangles(scene: GltfScene, count: int = 120_000) -> tuple[Gaussians, torch.Tensor, torch.Tensor | None]:
    """Gaussians, about `count` and at least one per triangle; int32 [N], the object of each; and boxes float32 [S, 6] that stop
    walkers, or None if there would be too many: then an occupancy grid is used."""
    corners, face = pieces(scene.corners, count, 2 * FINEST_M)
    colours, opacities, glow, unlit = _surface(scene, corners, face)
    kept = opacities > _SEEN
    corners, face = corners[kept], face[kept]
    normals = np.cross(corners[:, 1, :3] - corners[:, 0, :3], corners[:, 2, :3] - corners[:, 0, :3])
    areas = np.linalg.norm(normals, axis=1)
    normals = normals / areas[:, None]
    bare = _flat(corners[..., :3], normals, opacities[kept])
    falls = falling(scene.lights, bare, normals, areas / 2, glow[kept])
    glows = glow[kept].sum(1) > 0
    own = np.clip(np.where(glows[:, None], np.maximum(glow, colours)[kept], colours[kept]), 0, 1) ** (1 / 2.2)
    shown = torch.from_numpy(exposed(own, falls, glows | unlit[kept]).astype(np.float32))
    lit = Gaussians(bare.means, bare.quats, bare.scales, bare.opacities, plain_sh(shown))
    solids = solids_of(scene.corners[..., :3], scene.things)
    return lit, torch.from_numpy(scene.things[face]), None if solids is None else torch.from_numpy(solids)


def _surface(
    scene: GltfScene, corners: np.ndarray, face: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour, opacity and emission of each piece (all linear), and whether it is unlit."""
    tint, glow = corners[..., 3:7].mean(1), np.zeros((len(face), 3), np.float32)
    unlit, which = np.zeros(len(face), np.bool_), scene.material[face]
    for k, material in enumerate(scene.materials):
        rows = np.flatnonzero(which == k)
        tint[rows] *= np.array(material.colour, np.float32)
        glow[rows], unlit[rows] = material.glow, material.unlit
        if len(rows) and (material.picture or material.glow_picture):
            u, v = np.moveaxis(_INNER.astype(np.float32) @ corners[rows, :, 7:9], -1, 0)
            if material.picture:
                tint[rows] *= material.picture.sample(u, v).mean(1)
            if material.glow_picture:
                glow[rows] *= material.glow_picture.sample(u, v)[..., :3].mean(1)
        if material.cut:
            tint[rows, 3] = tint[rows, 3] >= material.cut
        elif not material.see_through:
            tint[rows, 3] = 1
    tint, glow = np.clip(np.nan_to_num(tint), 0, 1), np.where(glow < _DARK, 0, glow)
    return tint[:, :3], tint[:, 3], np.clip(np.nan_to_num(glow), 0, 1e6), unlit


def _flat(corners: np.ndarray, normals: np.ndarray, opacities: np.ndarray) -> Gaussians:
    """A grey Gaussian for each triangle [P, 3, 3], with its extent in the plane."""
    places, way = torch.from_numpy(corners).float(), torch.from_numpy(normals).float()
    middle = places.mean(1)
    up = torch.where(way[:, 2:] < 0, -way, way)
    zero = torch.zeros(len(up))
    lying = torch.stack([1 + up[:, 2], -up[:, 1], up[:, 0], zero], 1)  # turns z to `up`
    lying = lying / lying.norm(dim=1, keepdim=True)
    x, y, _ = ((places - middle[:, None]) @ rotation(torch.cat([middle, lying], 1))).unbind(2)
    xx, xy, yy = ((a * b).sum(1) / 12 for a, b in ((x, x), (x, y), (y, y)))
    half = torch.atan2(2 * xy, xx - yy) / 4
    mean, off = (xx + yy) / 2, (((xx - yy) / 2).square() + xy.square()).sqrt()
    wide = _WIDE * torch.stack([mean + off, (mean - off).clamp_min(0)], 1).sqrt()
    scales = torch.cat([wide.clamp_min(THIN_M), torch.full((len(up), 1), THIN_M)], 1)
    quats = multiply_quaternions(lying, torch.stack([half.cos(), zero, zero, half.sin()], 1))
    grey = plain_sh(torch.full((len(up), 3), 0.5))
    return Gaussians(middle - THIN_M * way, quats, scales, REVEALED * torch.from_numpy(opacities).float(), grey)
