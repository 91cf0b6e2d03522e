"""Renders colour, depth, segmentation and camera poses of MuJoCo worlds; graphics are set up at the first picture."""

# pyright: reportAttributeAccessIssue=false

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
from .mujoco_appearance import Appearance, add_geom
from .mujoco_canvas import Canvas, simplify
from .mujoco_model import mujoco
from .mujoco_parameters import SEEN, Models, Parameter

MARKER_RGBA, MARKER_M = (1.0, 0.25, 0.2, 1.0), 0.03  # the marker's colour and radius
HINT = "set MUJOCO_GL=egl or MUJOCO_GL=osmesa before Python starts, and install libegl1 or libosmesa6"


def lens(model: mujoco.MjModel, name: str, size: tuple[int, int], pose: str) -> Camera | None:
    """The intrinsics with which MuJoCo draws pictures of `size` (height, width) from a camera of the model: by its field of view,
    or by its focal length and principal point on a sensor, which fills the picture. None for orthographic cameras, and where the
    optical axis lies left of the picture or above it."""
    data, scene, camera = mujoco.MjData(model), mujoco.MjvScene(model, 1), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
    for derive in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
        derive(model, data)
    mujoco.mjv_updateCamera(model, data, camera, scene)
    view = scene.camera[0]
    if view.orthographic:
        return None
    if not view.frustum_width:
        focal = 0.5 / math.tan(math.radians(float(model.camera(name).fovy[0])) / 2)
        return Camera((focal * size[0] / size[1], focal, 0.5, 0.5), size, pose)
    wide, tall, near = 2 * view.frustum_width, view.frustum_top - view.frustum_bottom, view.frustum_near
    across, down = 0.5 - view.frustum_center / wide, view.frustum_top / tall
    return Camera((near / wide, near / tall, across, down), size, pose) if min(across, down) > 0 else None


class MujocoRenderer:
    """Renders worlds of one model. `changes`: the visible parameters that vary, by their column."""

    def __init__(self, model: mujoco.MjModel, changes: Mapping[int, Parameter], size: tuple[int, int]):
        self.size, self._columns = size, list(changes)
        self._models = Models(copy.copy(model), tuple(changes.values()))
        self._model = model
        self._data = mujoco.MjData(model)
        self._renderers: dict[str, Canvas | mujoco.Renderer] = {}
        self._appearance = Appearance(model, changes)
        self._marker: np.ndarray | None = None
        self._row = np.zeros(0)

    def set_world(self, physics: np.ndarray, row: np.ndarray, marker: np.ndarray | None = None) -> None:
        """Selects the world to render: its physics state, its parameter values, and the marked point [3], m."""
        self._marker, self._row = marker, row
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
        """Renders the world in colour; returns whether the pictures must be `read` before the next one."""
        canvas = self._renderer_for("colour", lambda: Canvas(self._model, self.size))
        canvas.draw(self._data, camera, self._decorate)
        return canvas.full

    def read(self) -> np.ndarray:
        """uint8 [n, H, W, 3]: the pictures since the last `read`."""
        return self._renderers["colour"].read()

    def measure(self, camera: str, kind: str) -> np.ndarray:
        """depth: float32 [H, W], m along the optical axis; segmentation: int32 [H, W], the body's index or -1."""
        renderer = self._renderer_for("measures", lambda: mujoco.Renderer(self._model, *self.size))
        if kind == "depth":
            renderer.enable_depth_rendering()
        else:
            renderer.enable_segmentation_rendering()
        renderer.update_scene(self._data, camera)
        self._decorate(renderer.scene)
        try:
            seen = renderer.render()
        finally:
            renderer.disable_depth_rendering()
            renderer.disable_segmentation_rendering()
        if kind == "depth":
            return seen
        geoms = np.where(seen[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM), seen[..., 0], -1)
        return np.where(geoms >= 0, self._model.geom_bodyid[geoms], -1).astype(np.int32)

    def _decorate(self, scene: mujoco.MjvScene) -> None:
        """Applies the world's appearance to the scene, and adds the marker, which nothing collides with."""
        self._appearance.apply(scene, self._row)
        if self._marker is not None:
            add_geom(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, MARKER_M), self._marker, MARKER_RGBA)

    def close(self) -> None:
        while self._renderers:
            self._renderers.popitem()[1].close()

    def _renderer_for(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._renderers:
            if _lacks_display():
                raise TerrellaError(f"MuJoCo cannot draw without a display: {HINT}.")
            try:
                model = self._model
                if not self._renderers:
                    simplify(model, self.size)
                    model.vis.global_.offheight = max(self.size[0], int(model.vis.global_.offheight))
                    model.vis.global_.offwidth = max(self.size[1], int(model.vis.global_.offwidth))
                self._renderers[name] = make()
                if len(self._renderers) == 1:  # runs before MuJoCo's own exit handler, which ends EGL
                    atexit.register(_close, weakref.ref(self))
            except Exception as error:
                first = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
                raise TerrellaError(f"MuJoCo cannot draw without a display ({first}): {HINT}.") from error
        return self._renderers[name]


def _lacks_display() -> bool:
    """Whether MuJoCo would render with GLFW without a display, because it was imported before EGL was chosen."""
    return mujoco.GLContext.__module__ == "mujoco.glfw" and sys.platform == "linux" and not os.environ.get("DISPLAY")


def _close(reference: weakref.ref[MujocoRenderer]) -> None:
    renderer = reference()
    if renderer is not None:
        with suppress(Exception):  # a rendering thread may still own the context; the end of the process frees it
            renderer.close()
