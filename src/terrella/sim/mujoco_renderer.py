"""Pictures, depth, segmentation and poses of MuJoCo worlds: made when the first is asked for."""

# pyright: reportAttributeAccessIssue=false
# mujoco is a compiled module without declarations

from __future__ import annotations

import atexit
import copy
import math
import os
import sys
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from ..core.errors import TerrellaError
from ..core.spec import Camera
from .mujoco_appearance import Appearance, put
from .mujoco_canvas import Canvas, simplify
from .mujoco_model import mujoco
from .mujoco_parameters import SEEN, Models, Parameter

MARK, MARK_M = (1.0, 0.25, 0.2, 1.0), 0.03  # the marker's colour and radius
HINT = "set MUJOCO_GL=egl or MUJOCO_GL=osmesa before Python starts, and install libegl1 or libosmesa6"


def lens(model: mujoco.MjModel, name: str, size: tuple[int, int], pose: str) -> Camera:
    """The pinhole of a camera of the model, for pictures of `size` (height, width)."""
    focal = 0.5 / math.tan(math.radians(float(model.camera(name).fovy[0])) / 2)
    return Camera((focal * size[0] / size[1], focal, 0.5, 0.5), size, pose)


class MujocoRenderer:
    """Draws worlds of one model. `changes` are those of its parameters that are seen, by their column."""

    def __init__(self, model: mujoco.MjModel, changes: Mapping[int, Parameter], size: tuple[int, int]):
        self.size, self._columns = size, list(changes)
        self._models = Models(copy.copy(model), tuple(changes.values()))
        self._model = model
        self._data = mujoco.MjData(model)
        self._made: dict[str, Canvas | mujoco.Renderer] = {}
        self._looks = Appearance(model, changes)
        self._mark: np.ndarray | None = None
        self._row = np.zeros(0)

    def put(self, physics: np.ndarray, row: np.ndarray, mark: np.ndarray | None = None) -> None:
        """Stands at a world: its state, its values of the parameters, and the point [3], m, that is marked."""
        self._mark, self._row = mark, row
        if self._columns:
            for name in SEEN:
                getattr(self._model, name)[:] = getattr(self._models.file, name)
            self._models.changed(self._model, row[self._columns])
        mujoco.mj_setState(self._model, self._data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for derive in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_tendon):
            derive(self._model, self._data)

    def pose(self, camera: str) -> np.ndarray:
        """x, y, z and quaternion w, x, y, z of T_world_cam: float32 [7]. MuJoCo's cameras look along -z, with y up."""
        at = self._data.camera(camera)
        right, up, back = at.xmat.reshape(3, 3).T
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, np.stack([-back, -right, up], 1).ravel())
        return np.concatenate([at.xpos, turn]).astype(np.float32)

    def draw(self, camera: str) -> bool:
        """Draws the world in colour, and says whether it must be `read` before the next."""
        canvas = self._maker("colour", lambda: Canvas(self._model, self.size))
        canvas.draw(self._data, camera, self._furnish)
        return canvas.full

    def read(self) -> np.ndarray:
        """uint8 [n, H, W, 3]: what was drawn since it was last read."""
        return self._made["colour"].read()

    def measure(self, camera: str, kind: str) -> np.ndarray:
        """depth: float32 [H, W], m along the optical axis; segmentation: int32 [H, W], the body or -1."""
        renderer = self._maker("measures", lambda: mujoco.Renderer(self._model, *self.size))
        if kind == "depth":
            renderer.enable_depth_rendering()
        else:
            renderer.enable_segmentation_rendering()
        renderer.update_scene(self._data, camera)
        self._furnish(renderer.scene)
        try:
            seen = renderer.render()
        finally:
            renderer.disable_depth_rendering()
            renderer.disable_segmentation_rendering()
        if kind == "depth":
            return seen
        geoms = np.where(seen[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM), seen[..., 0], -1)
        return np.where(geoms >= 0, self._model.geom_bodyid[geoms], -1).astype(np.int32)

    def _furnish(self, scene: mujoco.MjvScene) -> None:
        """Dresses the scene as the world has it, and puts the marker into it, which is looked at and touched by nobody."""
        self._looks.dress(scene, self._row)
        if self._mark is not None:
            put(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, MARK_M), self._mark, MARK)

    def close(self) -> None:
        while self._made:
            self._made.popitem()[1].close()

    def _maker(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._made:
            if _blind():
                raise TerrellaError(f"MuJoCo cannot draw without a display: {HINT}.")
            try:
                model = self._model
                if not self._made:
                    simplify(model, self.size)
                    model.vis.global_.offheight = max(self.size[0], int(model.vis.global_.offheight))
                    model.vis.global_.offwidth = max(self.size[1], int(model.vis.global_.offwidth))
                self._made[name] = make()
                if len(self._made) == 1:  # before what MuJoCo has registered by now, which ends EGL
                    atexit.register(_closed, weakref.ref(self))
            except Exception as error:
                first = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
                raise TerrellaError(f"MuJoCo cannot draw without a display ({first}): {HINT}.") from error
        return self._made[name]


def _blind() -> bool:
    """Whether MuJoCo would draw with GLFW and there is no display: it was imported before anybody chose EGL."""
    return mujoco.GLContext.__module__ == "mujoco.glfw" and sys.platform == "linux" and not os.environ.get("DISPLAY")


def _closed(pictures: weakref.ref[MujocoRenderer]) -> None:
    held = pictures()
    if held is not None:
        with suppress(Exception):  # a thread that drew may still hold it: then the end of the process frees it
            held.close()
