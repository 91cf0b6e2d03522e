"""The hand's velocity as joint targets, by damped least squares, and a gripper that opens and closes."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping

import numpy as np
import torch

from .mujoco_model import mujoco
from .mujoco_tasks import RobotLayout, Tensors

SPEED = 0.25  # m/s along each axis, at most
DAMPING, ROUNDS, KEPT = (
    0.03,
    3,
    0.02,
)  # of least squares: damping, iterations, and the pull of spare joints to their rest
SLACK_M = 0.04  # by which the target may be ahead of the hand
REACH = ((-0.17, -0.29, 0.012), (0.17, 0.26, 0.26))  # corners of the space of the tip, m
SWITCH = 0.3  # of the last action: below minus this the gripper closes, above this it opens


class TableHand:
    """Turns actions into controls: velocities x, y, z of the tip in m/s in the table's frame, and the gripper: 1 opens it, -1
    closes it, 0 leaves it. The hand keeps pointing down (damped least squares: Wampler 1986)."""

    names, units, frame = ("x", "y", "z", "grip"), ("m/s", "m/s", "m/s", ""), "world"
    high = (SPEED, SPEED, SPEED, 1.0)
    keys: Mapping[str, list[float]] = {  # as the front camera sees it
        "KeyW": [-SPEED, 0, 0, 0], "KeyS": [SPEED, 0, 0, 0], "KeyA": [0, -SPEED, 0, 0], "KeyD": [0, SPEED, 0, 0],
        "ArrowUp": [0, 0, SPEED, 0], "ArrowDown": [0, 0, -SPEED, 0], "ArrowLeft": [0, 0, 0, -1], "ArrowRight": [0, 0, 0, 1],
    }  # fmt: skip

    def __init__(self, model: mujoco.MjModel):
        """model: an arm at a table (sim/table_scene.py), whose last actuator is the gripper."""
        self._model, self._data = model, mujoco.MjData(model)
        self._tip = int(model.sensor_objid[model.sensor("hand").id])
        joints = model.actuator_trnid[: model.nu - 1, 0]
        self._at, self._dof, self._limits = model.jnt_qposadr[joints], model.jnt_dofadr[joints], model.jnt_range[joints]
        self._turn: np.ndarray | None = None  # of the tip at rest

    def __call__(self, layout: RobotLayout, state: Tensors, action: torch.Tensor) -> torch.Tensor:
        """Controls [B, nu] from a state with physics, sensors and the last ctrl, and actions [B, 4]."""
        rest = layout.home.numpy()[self._at]
        if self._turn is None:
            self._turn = self._forward(rest)[1]
        ctrl = state["ctrl"].clone()
        hands, moves = state["sensors"][:, layout.sensors["hand"]].numpy(), action[:, :3].numpy() * layout.step_s
        for row, hand, move in zip(ctrl.numpy(), hands, moves):
            joints = row[:-1].copy()
            ahead = np.clip(self._forward(joints)[0] + move - hand, -SLACK_M, SLACK_M)
            row[:-1] = self._solve(joints, np.clip(hand + ahead, *REACH), rest)
        grip = torch.where(action[:, 3] > SWITCH, layout.high[-1], ctrl[:, -1])
        ctrl[:, -1] = torch.where(action[:, 3] < -SWITCH, layout.low[-1], grip)
        return ctrl.clamp(layout.low, layout.high)

    def _forward(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The tip's place [3] and turn [3, 3] at these joints."""
        self._data.qpos[self._at] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[self._tip].copy(), self._data.site_xmat[self._tip].reshape(3, 3).copy()

    def _solve(self, joints: np.ndarray, target: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """The joints with the tip at `target`, turned as at rest, from nearby joints."""
        across, about = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        for _ in range(ROUNDS):
            place, turn = self._forward(joints)
            mujoco.mj_comPos(self._model, self._data)
            mujoco.mj_jacSite(self._model, self._data, across, about, self._tip)
            jacobian = np.concatenate([across[:, self._dof], about[:, self._dof]])
            tilt = 0.5 * sum(np.cross(one, other) for one, other in zip(turn.T, self._turn.T))
            inverse = np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(6), jacobian).T
            step = inverse @ np.concatenate([target - place, tilt])
            step += KEPT * (np.eye(len(joints)) - inverse @ jacobian) @ (rest - joints)
            joints = np.clip(joints + step, *self._limits.T)
        return joints
