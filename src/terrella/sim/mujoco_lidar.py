"""LiDAR by ray casting around the site "lidar" of a MuJoCo model."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence

import numpy as np

from .mujoco_model import mujoco

SITE, MAX_ELEVATION = "lidar", np.radians(15.0)  # several rows span this angle below and above the horizontal


class Lidar:
    """rays: per turn, or (rows, rays per turn). range_m: the largest distance. The first ray points along the site's x axis, the
    next ones turn towards its y axis. The body that carries the site is ignored."""

    def __init__(self, model: mujoco.MjModel, rays: int | Sequence[int], range_m: float):
        shape = (rays,) if isinstance(rays, int) else tuple(rays)
        rows, columns = shape if len(shape) == 2 else (1, shape[0])
        self.shape, self.range_m, self._site = shape, range_m, model.site(SITE).id
        self._body = int(model.site_bodyid[self._site])
        turn = np.arange(columns) / columns * 2 * np.pi
        lift = np.linspace(MAX_ELEVATION, -MAX_ELEVATION, rows)[:, None] if rows > 1 else np.zeros((1, 1))
        flat = np.stack([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift) + 0 * turn], 2)
        self._rays = flat.reshape(-1, 3)

    def scan(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """Distances float32 [rays] or [rows, rays], m, after forward kinematics."""
        count = len(self._rays)
        rays = self._rays @ data.site_xmat[self._site].reshape(3, 3).T
        distances, geoms = np.empty(count), np.empty(count, np.int32)
        at = data.site_xpos[self._site]
        mujoco.mj_multiRay(
            model, data, at, rays.ravel(), None, True, self._body, geoms, distances, None, count, self.range_m
        )
        missed = (geoms < 0) | (distances > self.range_m)
        return np.where(missed, self.range_m, distances).reshape(self.shape).astype(np.float32)
