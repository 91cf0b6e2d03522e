"""Training pictures of the lifter: colour, depth, and what lies behind, of random scenes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..kernels_numba import shapes as kernels
from .scenes import ShapeScene, Shot, random_scene, random_shot

RAYS = 4  # of each pixel for the light from all sides, smoothed over 16 pixels
# Places from which the second layer is seen, in metres: forward, left, up.
OFFSETS = ((0, 0.6, 0), (0, -0.6, 0), (0, 0.25, 0), (0, -0.25, 0), (0, 0, 0.35), (0, 0, -0.35), (0.6, 0, 0))
PER_SCENE = 4


@dataclass(frozen=True)
class LayeredPicture:
    """What a camera sees, and what lies behind it."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    depth: np.ndarray  # float32 [H, W], metres along the optical axis, 0: nothing
    behind: (
        np.ndarray
    )  # float32 [h, w] of every second pixel, depth of the second layer, 0: none can be seen from near the camera
    behind_rgb: np.ndarray  # uint8 [h, w, 3]


@dataclass(frozen=True)
class Exposure:
    """From radiance to bytes."""

    gain: float
    curve: float
    cast: np.ndarray  # [3]

    def bytes_of(self, radiance: np.ndarray) -> np.ndarray:
        shown = radiance * (self.gain * self.cast)
        shown = shown * (1 + shown / 6) / (1 + shown)
        return (255 * np.clip(shown, 0, 1) ** self.curve + 0.5).astype(np.uint8)


def exposure_of(radiance: np.ndarray, rng: np.random.Generator) -> Exposure:
    """A random exposure that suits a picture."""
    middle = float(np.exp(np.log(radiance.mean(2) + 1e-3).mean()))
    cast = np.exp(rng.normal(0, 0.06, 3))
    return Exposure(float(np.exp(rng.normal(-0.7, 0.35))) / middle, 1 / rng.uniform(1.8, 2.6), cast)


def render(
    scene: ShapeScene,
    shot: Shot,
    atlas: np.ndarray,
    size: tuple[int, int],
    exposure: Exposure | np.random.Generator,
    layers: bool = True,
) -> tuple[LayeredPicture, Exposure] | None:
    """The picture of a camera; None if it sees too little or is too near a surface. exposure: a generator draws one."""
    height, width = size
    camera, world = shot.camera(*size), (scene.shapes, scene.bounds)
    depth, which = np.empty(size, np.float32), np.empty(size, np.int32)
    normal, radiance = (np.empty((*size, 3), np.float32) for _ in range(2))
    light = np.empty(((height + 1) // 2, (width + 1) // 2, 3), np.float32)
    kernels.surfaces(*world, camera, depth, which, normal)
    if isinstance(exposure, np.random.Generator) and not _useful(depth, which, scene, exposure):
        return None
    kernels.lit(*world, scene.lamps, scene.sky, camera, depth, which, normal, RAYS, light)
    kernels.coloured(*world, atlas, camera, depth, which, normal, light, scene.sky, radiance)
    if isinstance(exposure, np.random.Generator):
        exposure = exposure_of(radiance, exposure)
    half = light.shape[:2]
    behind, behind_rgb = np.zeros(half, np.float32), np.zeros((*half, 3), np.float32)
    if layers:
        kernels.hidden(*world, scene.lamps, scene.sky, atlas, camera, _places(scene, shot), depth, behind, behind_rgb)
    shown = LayeredPicture(exposure.bytes_of(radiance), depth, behind, exposure.bytes_of(behind_rgb))
    return shown, exposure


def _useful(depth: np.ndarray, which: np.ndarray, scene: ShapeScene, rng: np.random.Generator) -> bool:
    if np.quantile(depth, 0.02) < 0.25 or np.median(depth) < 0.5 or (depth == 0).mean() > 0.2:
        return False
    seen, counts = np.unique(scene.shapes[which[which >= 0], 18], return_counts=True)
    return (counts > 0.005 * depth.size).sum() > 4 or rng.random() < 0.25


def _places(scene: ShapeScene, shot: Shot) -> np.ndarray:
    """Where the camera may move: float32 [V, 3]."""
    ways = np.array(OFFSETS) @ shot.turn.T
    free = [scene.is_free(shot.place, way) for way in ways]
    return (shot.place + ways[free]).astype(np.float32).reshape(-1, 3)


def random_pictures(
    rng: np.random.Generator, atlas: np.ndarray, size: tuple[int, int]
) -> Iterator[tuple[LayeredPicture, ShapeScene, Shot, Exposure]]:
    """Pictures without end, PER_SCENE of each scene."""
    while True:
        scene, made = random_scene(rng), 0
        for _ in range(10 * PER_SCENE if len(scene.rooms) else 0):
            shot = random_shot(scene, rng)
            shown = render(scene, shot, atlas, size, rng) if shot else None
            if shot and shown:
                yield shown[0], scene, shot, shown[1]
                made += 1
            if made == PER_SCENE:
                break
