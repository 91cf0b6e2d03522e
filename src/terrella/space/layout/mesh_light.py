"""Light on a scene of triangles from lamps, the sun and emissive surfaces, with shadow maps (Williams 1978)."""

from collections.abc import Sequence

import numpy as np
import torch

from ..camera import project
from ..files.gltf_scene import Light
from ..mesh import seen
from ..raster import Gaussians, rasterise

GLOWING = 24  # points that stand for all that glows
AMBIENT = 0.3  # of the mean light falls everywhere
_SLACK, _SLACK_M = 0.03, 0.08  # what is so little farther than what a lamp sees is seen
_SUN_SIZE, _SUN_FAR = 1024, 20.0  # pixels of the picture that the sun sees, and from how many radii of the scene
_USUAL = np.array([0.36, 0.48, 0.8])  # the direction that is brightest where there are no lamps


def falling(
    lights: Sequence[Light], gaussians: Gaussians, normals: np.ndarray, areas: np.ndarray, glow: np.ndarray
) -> np.ndarray:
    """Irradiance of the visible sides of flat Gaussians [N, 3]; normals [N, 3], areas [N] (square metres), emission `glow` [N, 3].
    Without any light, surfaces that face up or down are brighter."""
    glowing = _glowing(gaussians.means.numpy(), normals, areas, glow)
    if not lights and not glowing:
        return np.repeat(0.6 + 0.4 * np.abs(normals @ _USUAL)[:, None], 3, 1)
    total, points = np.zeros((len(normals), 3)), gaussians.means
    for light, own in [*((one, None) for one in lights), *glowing]:
        if light.kind == "directional":
            lit, way, far = _sunlit(gaussians, light.towards), light.towards[None], np.ones(len(normals))
        else:
            eye = torch.tensor([*light.place, 1.0, 0, 0, 0], dtype=torch.float32)
            nearest, _, distance = seen(rasterise(gaussians, eye[None], None, (256, 512)), eye, points)
            far = np.maximum(distance.numpy(), 0.1)
            way = (points.numpy() - light.place) / far[:, None]
            slack = _SLACK / np.maximum(
                np.abs((normals * way).sum(1)), 0.1
            )  # a pixel is deep where the side is seen edgewise
            lit = (nearest.numpy() == 0) | (far < nearest.numpy() * (1 + slack) + _SLACK_M)
        share = np.abs((normals * way).sum(1)) / far**2 * lit
        if own is not None:
            share = share * np.maximum(way @ own, 0)
        elif light.kind == "spot":
            inner, outer = light.cone
            share = share * np.clip((way @ light.towards - outer) / max(inner - outer, 1e-4), 0, 1)
        total += share[:, None] * light.power
    return total + AMBIENT * total.mean(0) + 1e-6


def _glowing(
    places: np.ndarray, normals: np.ndarray, areas: np.ndarray, glow: np.ndarray
) -> list[tuple[Light, np.ndarray]]:
    """Lamps that approximate all emissive surfaces, and their directions, sampled by power."""
    weight = areas * glow.sum(1)
    if not weight.sum() > 0:
        return []
    many = min(GLOWING, int((weight > 0).sum()))
    picked = np.searchsorted(np.cumsum(weight) / weight.sum(), (np.arange(many) + 0.5) / many).clip(0, len(weight) - 1)
    power = glow[picked] / glow[picked].sum(1, keepdims=True) * weight.sum() / many
    return [
        (Light("point", places[k] + 0.05 * normals[k], normals[k], one), normals[k]) for k, one in zip(picked, power)
    ]


def _sunlit(gaussians: Gaussians, towards: np.ndarray) -> np.ndarray:
    """Whether sunlight from this direction reaches each Gaussian: bool [N]."""
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    middle, radius = (low + high) / 2, float((high - low).norm() / 2 + 0.1)
    ahead = torch.from_numpy(np.ascontiguousarray(towards)).float()
    turn = torch.tensor([1 + float(ahead[0]), 0.0, -float(ahead[2]), float(ahead[1])])  # turns x to `ahead`
    turn = turn / turn.norm() if turn.norm() > 1e-3 else torch.tensor([0.0, 0, 0, 1])
    pose = torch.cat([middle - _SUN_FAR * radius * ahead, turn])
    camera = (_SUN_FAR / 2, _SUN_FAR / 2, 0.5, 0.5)
    view = rasterise(gaussians, pose[None], camera, (_SUN_SIZE, _SUN_SIZE))
    at, deep = project(gaussians.means, pose, camera)
    u, v = (at * _SUN_SIZE).long().clamp(0, _SUN_SIZE - 1).unbind(-1)
    depth, alpha = view.depth[0][v, u], view.alpha[0][v, u]
    return ((alpha < 0.5) | (deep < depth / alpha.clamp_min(0.5) + _SLACK * radius / 3 + _SLACK_M)).numpy()


def exposed(own: np.ndarray, falls: np.ndarray, shines: np.ndarray) -> np.ndarray:
    """Colours [N, 3] as a camera shows them: surfaces of the colours `own` under the light `falls` [N, 3]; light sources, `shines`
    bool [N], keep their colours."""
    shown = own**2.2 * falls
    middle = np.exp(np.log(np.maximum(falls[~shines].mean(1), 1e-4)).mean()) if not shines.all() else 1.0
    shown = shown * (0.62 / middle)
    mapped = shown * (1 + shown / 9) / (1 + shown * 0.78)  # Reinhard's curve with a white point
    pictured = np.clip(mapped, 0, 1) ** (1 / 2.2)
    pictured[shines] = own[shines]
    return pictured
