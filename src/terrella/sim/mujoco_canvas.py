"""Renders many MuJoCo worlds as tiles of one image, read at once; and simplifies models for small pictures."""

# pyright: reportAttributeAccessIssue=false

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from .mujoco_model import mujoco

TILES = 8  # pictures per side of the tiled image
SMALL = 128  # pixels per side up to which a picture is rendered in a simpler way
_SLICES, _STACKS = 12, 8  # of round geoms in small pictures
_PLAIN = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)  # disabled: they take most of the time
_HIDDEN = 5  # a group of geoms that is not drawn
_FINEST = 0.3  # radius in pixels of the smallest geoms that are drawn
_WIDE_M, _GRID_M = 32.0, 0.5  # half width of an infinite floor, and size of its separately lit cells


class Canvas:
    """Renders worlds of one model at `size` (height, width), up to TILES x TILES pictures before a `read`."""

    def __init__(self, model: Any, size: tuple[int, int]):
        self._gl: Any = None
        self._model, self._size, self._drawn = model, size, 0
        tiles = self._tiles = TILES if max(size) <= SMALL else 1
        height, width = tiles * size[0], tiles * size[1]
        model.vis.global_.offheight, model.vis.global_.offwidth = height, width
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._gl = mujoco.GLContext(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene, self._camera = mujoco.MjvScene(model, 10_000), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()

    @property
    def full(self) -> bool:
        return self._drawn == self._tiles**2

    def draw(self, data: Any, camera: str, decorate: Callable[[Any], None]) -> None:
        """Renders a world onto the next tile, after `decorate` has changed the scene."""
        height, width = self._size
        self._camera.fixedcamid = self._model.camera(camera).id
        every, groups = mujoco.mjtCatBit.mjCAT_ALL, self._model.geom_group.copy()
        self._model.geom_group[~_within(self._model, data, self._camera.fixedcamid, self._size)] = _HIDDEN
        mujoco.mjv_updateScene(self._model, data, self._option, self._perturb, self._camera, every, self._scene)
        self._model.geom_group[:] = groups
        decorate(self._scene)
        for flag in _PLAIN:
            self._scene.flags[flag] = 0
        row, column = divmod(self._drawn, self._tiles)
        self._gl.make_current()
        mujoco.mjr_render(mujoco.MjrRect(column * width, row * height, width, height), self._scene, self._context)
        self._drawn += 1

    def read(self) -> np.ndarray:
        """uint8 [n, H, W, 3]: the pictures since the last `read`, in order."""
        height, width = self._size
        rows = -(-self._drawn // self._tiles)
        pixels = self._pixels[: rows * height]
        self._gl.make_current()
        mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, pixels.shape[1], len(pixels)), self._context)
        tiles = pixels.reshape(rows, height, self._tiles, width, 3)[:, ::-1].transpose(0, 2, 1, 3, 4)
        pictures = tiles.reshape(-1, height, width, 3)[: self._drawn]
        self._drawn = 0
        return np.ascontiguousarray(pictures)

    def close(self) -> None:
        if self._gl is None:
            return
        gl, self._gl = self._gl, None
        gl.make_current()  # otherwise this would free the resources of another canvas
        self._context.free()
        gl.free()

    def __del__(self):
        with suppress(Exception):
            self.close()


def _within(model: Any, data: Any, camera: int, size: tuple[int, int]) -> np.ndarray:
    """bool [ngeom]: geoms whose bounding sphere is within a camera's view and not tiny, for each costs time (culling)."""
    radius, bounded = model.geom_rbound, model.geom_rbound > 0
    if model.cam_sensorsize[camera].any() or model.cam_projection[camera] != int(
        mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    ):
        return np.ones_like(bounded)
    across, up, back = ((data.geom_xpos - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
    half = math.tan(math.radians(float(model.cam_fovy[camera])) / 2)
    seen = radius * size[0] >= 2 * half * _FINEST * -back
    for offset, slope in ((across, half * size[1] / size[0]), (up, half)):
        seen &= np.abs(offset) <= slope * -back + radius * math.hypot(1, slope)
    return seen | ~bounded


def simplify(model: Any, size: tuple[int, int]) -> None:
    """Makes a model cheap to render in small pictures, in place: finite floors (infinite ones are many times slower), no details
    of meshes finer than a pixel, fewer faces of round geoms, no antialiasing."""
    if max(size) > SMALL:
        return
    endless = (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & (model.geom_size[:, :2] == 0).all(1)
    plain = np.array([at < 0 or bool(model.mat_texuniform[at]) for at in model.geom_matid], bool)
    model.geom_size[endless & plain] = [_WIDE_M, _WIDE_M, _GRID_M]
    quality = model.vis.quality
    quality.offsamples, quality.numslices, quality.numstacks = 0, _SLICES, _STACKS
    for mesh in range(model.nmesh):
        _thin(model, mesh, float(model.stat.extent) / max(size))


def _thin(model: Any, mesh: int, cell_m: float) -> None:
    """Merges the vertices of a mesh in each cell, and removes degenerate and duplicate faces (Rossignac & Borrel 1993)."""
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    where = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    cells = np.floor(vertices / cell_m).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = first[cell.ravel()][model.mesh_face[where]]
    whole = (faces != np.roll(faces, 1, axis=1)).all(1).nonzero()[0]
    _, kept = np.unique(np.sort(faces[whole], 1), axis=0, return_index=True)
    kept = whole[np.sort(kept)]
    for name in ("mesh_facenormal", "mesh_facetexcoord"):
        part = getattr(model, name)[where]
        part[: len(kept)] = part[kept]
    model.mesh_face[where][: len(kept)] = faces[kept]
    model.mesh_facenum[mesh] = len(kept)
