"""Where a robot of MuJoCo is at rest, and where its quantities are in the state."""

# pyright: reportAttributeAccessIssue=false

import numpy as np
import torch

from .mujoco_controls import ControlLimits
from .mujoco_model import BALL, FREE, coupled_joints, home_key, mujoco
from .mujoco_robots import Robot
from .mujoco_tasks import RobotLayout


def pose_at_rest(model: mujoco.MjModel, robot: Robot | None) -> np.ndarray:
    """qpos [nq] at rest: the robot's pose, the file's keyframe, or the reference pose with coupled joints in their places."""
    key = home_key(model)
    qpos = (model.qpos0 if key is None else model.key_qpos[key]).copy()
    if robot is not None and robot.pose:
        for at in range(model.njnt):
            if model.jnt_type[at] not in (int(FREE), int(BALL)):
                qpos[model.jnt_qposadr[at]] = robot.rest(model.joint(at).name)
    elif key is None:
        for joint, (_, offset) in ((joint, one) for group in coupled_joints(model) for joint, one in group.items()):
            qpos[model.jnt_qposadr[joint]] += offset
    if robot is not None and robot.height is not None:
        qpos[2] = robot.height
    return qpos


def layout_of(model: mujoco.MjModel, home: np.ndarray, controls: ControlLimits, steps: int) -> RobotLayout:
    """Of a model at rest at qpos `home` [nq], with `steps` physics steps in a control step."""
    ends = 1 + model.nq, 1 + model.nq + model.nv
    sensors = {
        model.sensor(at).name or f"sensor{at + 1}": slice(
            int(model.sensor_adr[at]), int(model.sensor_adr[at] + model.sensor_dim[at])
        )
        for at in range(model.nsensor)
    }
    own = (model.jnt_type != int(FREE)) & (model.jnt_type != int(BALL))
    hinges = torch.from_numpy(model.jnt_qposadr[own]).long(), torch.from_numpy(model.jnt_dofadr[own]).long()
    numbers_of = (home, controls.rest, controls.low, controls.high)
    at_home, at_rest, lowest, highest = (torch.from_numpy(np.asarray(part, np.float64)) for part in numbers_of)
    step_s = steps * float(model.opt.timestep)
    return RobotLayout(slice(1, ends[0]), slice(*ends), hinges, at_home, at_rest, lowest, highest, sensors, step_s)
