"""Pictures of many MuJoCo worlds as tiles of one large one, which is read once; and models that are cheap to draw small."""

# pyright: reportAttributeAccessIssue=false
# mujoco is a compiled module without declarations

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from .mujoco_model import mujoco

TILES = 8  # a side: so many pictures are drawn before they are read
SMALL = 128  # pixels a side up to which pictures are drawn plainly
_SLICES, _STACKS = 12, 8  # of round things in small pictures
_PLAIN = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)  # left out: they cost most of the time
_WIDE_M, _GRID_M = 32.0, 0.5  # half of the width of a floor without end, and of its parts, which are lit each


class Canvas:
    """Draws worlds of one model in pictures of `size` (height, width), up to TILES x TILES of them before `read`."""

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
        self._scene, self._eye = mujoco.MjvScene(model, 10_000), mujoco.MjvCamera()
        self._eye.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._option, self._touched = mujoco.MjvOption(), mujoco.MjvPerturb()

    @property
    def full(self) -> bool:
        return self._drawn == self._tiles**2

    def draw(self, data: Any, camera: str, furnish: Callable[[Any], None]) -> None:
        """Draws what the camera sees of a world, and what `furnish` adds to the scene, onto the next tile."""
        height, width = self._size
        self._eye.fixedcamid = self._model.camera(camera).id
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, self._touched, self._eye, every, self._scene)
        furnish(self._scene)
        for flag in _PLAIN:
            self._scene.flags[flag] = 0
        row, column = divmod(self._drawn, self._tiles)
        self._gl.make_current()
        mujoco.mjr_render(mujoco.MjrRect(column * width, row * height, width, height), self._scene, self._context)
        self._drawn += 1

    def read(self) -> np.ndarray:
        """uint8 [n, H, W, 3]: what was drawn since it was last read, in order."""
        height, width = self._size
        rows = -(-self._drawn // self._tiles)
        pixels = self._pixels[: rows * height]
        self._gl.make_current()
        mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, pixels.shape[1], len(pixels)), self._context)
        tiles = pixels.reshape(rows, height, self._tiles, width, 3)[:, ::-1].transpose(0, 2, 1, 3, 4)
        found = tiles.reshape(-1, height, width, 3)[: self._drawn]
        self._drawn = 0
        return np.ascontiguousarray(found)

    def close(self) -> None:
        if self._gl is None:
            return
        gl, self._gl = self._gl, None
        gl.make_current()  # else it would free what another canvas holds
        self._context.free()
        gl.free()

    def __del__(self):
        with suppress(Exception):
            self.close()


def simplify(model: Any, size: tuple[int, int]) -> None:
    """Makes a model cheap to draw in small pictures, in place: floors without end get one, for MuJoCo draws those many times as
    slowly; meshes lose what is finer than a pixel; round things are made of fewer parts, and edges are not smoothed."""
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
    """Lets all vertices of a mesh in one cell be one of them; faces that then have no area, or are there already, are left out
    (Rossignac & Borrel 1993)."""
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
