"""LiDAR by ray casting: how far it is, all around a site of a MuJoCo model that is named "lidar"."""

# pyright: reportAttributeAccessIssue=false
# mujoco is a compiled module without declarations

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .mujoco_model import mujoco

SITE, TALLEST = "lidar", np.radians(15.0)  # several rows look from so far below the level to so far above it


class Lidar:
    """rays: of a turn, or (rows, rays of a turn). range_m: what is further away is as far as this. The first ray looks along the
    site's x, the next ones go round to its y. The body that carries the site is not seen."""

    def __init__(self, model: mujoco.MjModel, rays: int | Sequence[int], range_m: float):
        shape = (rays,) if isinstance(rays, int) else tuple(rays)
        rows, columns = shape if len(shape) == 2 else (1, shape[0])
        self.shape, self.range_m, self._site = shape, range_m, model.site(SITE).id
        self._body = int(model.site_bodyid[self._site])
        turn = np.arange(columns) / columns * 2 * np.pi
        lift = np.linspace(TALLEST, -TALLEST, rows)[:, None] if rows > 1 else np.zeros((1, 1))
        flat = np.stack([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift) + 0 * turn], 2)
        self._rays = flat.reshape(-1, 3)

    def scan(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """float32 [rays] or [rows, rays], m, of a world whose bodies are in place."""
        count = len(self._rays)
        rays, found, geoms = (
            self._rays @ data.site_xmat[self._site].reshape(3, 3).T,
            np.empty(count),
            np.empty(count, np.int32),
        )
        at = data.site_xpos[self._site]
        mujoco.mj_multiRay(
            model, data, at, rays.ravel(), None, True, self._body, geoms, found, None, count, self.range_m
        )
        return (
            np.where((geoms < 0) | (found > self.range_m), self.range_m, found).reshape(self.shape).astype(np.float32)
        )
