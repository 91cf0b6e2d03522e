"""The autopilot of a multirotor: thrusts from commanded velocities."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch

from .mujoco_model import mujoco
from .mujoco_tasks import RobotLayout, Tensors, motion, rotate

VELOCITY, CLIMB, LEVEL, TURN = 2.0, 4.0, (60.0, 14.0), 6.0  # gains, 1/s, 1/s, (1/s², 1/s), 1/s
MAX_PUSH, MAX_LIFT = 4.0, 6.0  # m/s²; a tilt of 22 degrees


class Pilot(Protocol):
    """Turns actions of its own into the controls of a model. names, units, high: of the axes, which reach from -high to high."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    frame: str
    high: tuple[float, ...]
    keys: Mapping[str, list[float]]

    def __call__(self, layout: RobotLayout, state: Tensors, action: torch.Tensor) -> torch.Tensor:
        """Controls [B, nu] from a state with physics, sensors and the last ctrl, and actions [B, n]."""
        ...


class Multirotor:
    """A cascaded controller: velocity, tilt, thrusts (Lee et al. 2010, "Geometric tracking control of a quadrotor", without its
    feed-forward). Actions: velocities forward, left and up in m/s in the level frame that turns with the body; turning in rad/s."""

    names, units = ("forward", "left", "up", "turn"), ("m/s", "m/s", "m/s", "rad/s")
    frame, high = "body", (3.0, 3.0, 1.5, 2.0)
    keys: Mapping[str, list[float]] = {
        "KeyW": [3, 0, 0, 0], "KeyS": [-3, 0, 0, 0], "KeyA": [0, 3, 0, 0], "KeyD": [0, -3, 0, 0],
        "ArrowUp": [0, 0, 1.5, 0], "ArrowDown": [0, 0, -1.5, 0], "ArrowLeft": [0, 0, 0, 2], "ArrowRight": [0, 0, 0, -2],
    }  # fmt: skip

    def __init__(self, model: mujoco.MjModel):
        """model: one free body whose actuators are thrusts at sites."""
        sites = model.actuator_trnid[:, 0]
        place, gear = model.site_pos[sites] - model.body_ipos[1], model.actuator_gear
        wrench = np.stack(
            [gear[:, 2], *(np.cross(place, gear[:, :3]) + gear[:, 3:]).T]
        )  # thrust and torques of each rotor
        self._mix = torch.from_numpy(np.linalg.pinv(wrench))
        self._mass, self._inertia = float(model.body_mass[1]), torch.from_numpy(model.body_inertia[1].copy())
        self._gravity = -float(model.opt.gravity[2])

    def __call__(self, layout: RobotLayout, state: Tensors, action: torch.Tensor) -> torch.Tensor:
        """Thrusts [B, rotors] in N from the physics [B, n] of a state and actions [B, 4]."""
        physics = state["physics"]
        velocity, spin, up = motion(layout, physics)
        turn = physics[:, layout.qpos][:, 3:7]
        w, x, y, z = turn.unbind(1)
        heading = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        half = torch.stack([(heading / 2).cos(), 0 * w, 0 * w, -(heading / 2).sin()], 1)
        level = rotate(half, physics[:, layout.qvel][:, :3])  # in the frame that turns with the body alone
        push = (VELOCITY * (action[:, :2] - level[:, :2])).clamp(-MAX_PUSH, MAX_PUSH)
        lift = self._gravity + (CLIMB * (action[:, 2] - level[:, 2])).clamp(-MAX_LIFT, MAX_LIFT)
        wanted = torch.cat([push, torch.full_like(lift, self._gravity)[:, None]], 1)
        wanted = rotate(
            turn * turn.new_tensor([1, -1, -1, -1]), rotate(half * half.new_tensor([1, -1, -1, -1]), wanted)
        )
        wanted = wanted / wanted.norm(dim=1, keepdim=True)  # where up should point, in the body's frame
        torque = LEVEL[0] * torch.stack([-wanted[:, 1], wanted[:, 0], 0 * w], 1) - LEVEL[1] * spin
        torque[:, 2] = TURN * (action[:, 3] - spin[:, 2])
        thrust = self._mass * lift / up[:, 2].clamp_min(0.5)
        thrusts = torch.cat([thrust[:, None], torque * self._inertia], 1) @ self._mix.T
        return thrusts.clamp(layout.low, layout.high)
