"""Steps batches of physics states with `mujoco.rollout`, on threads, each row with its own model."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping

import numpy as np
import torch

from .mujoco_model import mujoco, rollout
from .mujoco_parameters import Models, Parameter

_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Stepper:
    """Worlds of one model. `changes`: the varying parameters, by their column in the values."""

    def __init__(self, file: mujoco.MjModel, changes: Mapping[int, Parameter], threads: int):
        self.file, self._columns = file, list(changes)
        self._models = Models(file, tuple(changes.values()))
        self._threads = threads
        self._datas = [mujoco.MjData(file) for _ in range(threads)]
        self._pool: rollout.Rollout | None = None

    def step(
        self, physics: torch.Tensor, warmstart: torch.Tensor, ctrl: torch.Tensor, values: torch.Tensor, steps: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """`steps` steps from float64 physics [B, n], the solver's warmstart [B, nv] and controls [B, nu]. Returns the physics, the
        sensors [B, n] at the start of the last step, and the next warmstart: the acceleration over the last step."""
        batch, model = len(physics), self.file
        controls = ctrl[:, None].expand(batch, steps, model.nu).contiguous().numpy()
        states = np.empty((batch, steps, physics.shape[1]))
        sensed = np.empty((batch, steps, model.nsensordata))
        models = self._models.of(values.numpy()[:, self._columns] if self._columns else np.empty((batch, 0)))
        if self._pool is None:
            self._pool = rollout.Rollout(nthread=self._threads if self._threads > 1 else 0)
        self._pool.rollout(
            models, self._datas, np.ascontiguousarray(physics.numpy()), controls, skip_checks=True, nstep=steps,
            initial_warmstart=np.ascontiguousarray(warmstart.numpy()), state=states, sensordata=sensed,
        )  # fmt: skip
        velocity = slice(1 + model.nq, 1 + model.nq + model.nv)
        before = states[:, -2, velocity] if steps > 1 else physics.numpy()[:, velocity]
        acceleration = (states[:, -1, velocity] - before) / model.opt.timestep
        return tuple(
            torch.from_numpy(np.ascontiguousarray(part)) for part in (states[:, -1], sensed[:, -1], acceleration)
        )  # pyright: ignore[reportReturnType]

    def contacts(self, physics: np.ndarray, ctrl: np.ndarray, values: np.ndarray) -> np.ndarray:
        """float32 [bodies]: the sum of the normal contact forces on each body of one world, N."""
        model, data = self._models.of(values[None, self._columns])[0], self._datas[0]
        mujoco.mj_setState(model, data, physics, _FULL)
        data.ctrl[:], data.qacc_warmstart[:] = ctrl, 0.0
        mujoco.mj_forward(model, data)
        forces, force = np.zeros(model.nbody, np.float32), np.zeros(6)
        for at in range(data.ncon):
            mujoco.mj_contactForce(model, data, at, force)
            for geom in data.contact[at].geom:
                forces[model.geom_bodyid[geom]] += force[0]
        return forces

    def placed(self, physics: np.ndarray, values: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The model and data of one world after forward kinematics."""
        model, data = self._models.of(values[None, self._columns])[0], self._datas[0]
        mujoco.mj_setState(model, data, physics, _FULL)
        mujoco.mj_kinematics(model, data)
        return model, data

    def close(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None
