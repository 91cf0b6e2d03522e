"""Policies of `mujoco:arm` in Bullet: the same masses, joints and motors; another integrator, another solver and
friction, and the rotors' inertia put into the links.

    pip install pybullet
    python lab/arm_in_bullet.py transfers/arm/seed-0/nominal transfers/arm/seed-0/randomised --episodes 300

Starts, goals, observations and success are those of our task. Prints the successes here and in MuJoCo, from the same starts.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet
import torch
import tyro

import terrella
from terrella.core import make_rng
from terrella.core.policy import Policy
from terrella.measure.policy_evaluation import percent
from terrella.measure.statistics import clopper_pearson
from terrella.sim.mujoco_model import mujoco
from terrella.sim.mujoco_world import MujocoConfig, MujocoWorld


class Arm:
    """A chain of hinges that motors turn, each body the child of the one before, as MuJoCo compiled it."""

    def __init__(self, model, step_s: float):
        self.model, self.client = model, pybullet.connect(pybullet.DIRECT)
        bodies, dof = range(1, model.nbody), model.jnt_dofadr
        turns = [_bullet(model.body_iquat[at]) for at in bodies]
        hinges = [int(model.body_jntadr[at]) if model.body_jntnum[at] else -1 for at in bodies]
        self.arm = pybullet.createMultiBody(
            baseMass=0.0,
            linkMasses=[float(model.body_mass[at]) for at in bodies],
            linkCollisionShapeIndices=[-1 for _ in bodies],
            linkVisualShapeIndices=[-1 for _ in bodies],
            linkPositions=[list(model.body_pos[at]) for at in bodies],
            linkOrientations=[_bullet(model.body_quat[at]) for at in bodies],
            linkInertialFramePositions=[list(model.body_ipos[at]) for at in bodies],
            linkInertialFrameOrientations=turns,
            linkParentIndices=[int(model.body_parentid[at]) for at in bodies],
            linkJointTypes=[pybullet.JOINT_FIXED if hinge < 0 else pybullet.JOINT_REVOLUTE for hinge in hinges],
            linkJointAxis=[[0, 0, 1] if hinge < 0 else list(model.jnt_axis[hinge]) for hinge in hinges],
        )
        self.links = [link for link, hinge in enumerate(hinges) if hinge >= 0]
        self.gear = model.actuator_gear[:, 0].copy()
        pybullet.setTimeStep(step_s)
        pybullet.setGravity(*model.opt.gravity)
        for at in bodies:
            inertia = model.body_inertia[at].copy()
            if hinges[at - 1] >= 0:  # Bullet has no rotor: its inertia is the link's
                axis = np.empty(3)
                mujoco.mju_rotVecQuat(axis, model.jnt_axis[hinges[at - 1]], model.body_iquat[at] * [1, -1, -1, -1])
                inertia += float(model.dof_armature[dof[hinges[at - 1]]]) * axis**2
            pybullet.changeDynamics(
                self.arm, at - 1, linearDamping=0, angularDamping=0, localInertiaDiagonal=list(inertia),
                jointDamping=0.0 if hinges[at - 1] < 0 else float(model.dof_damping[dof[hinges[at - 1]]]),
            )  # fmt: skip
        losses = [float(model.dof_frictionloss[dof[hinges[link]]]) for link in self.links]
        pybullet.setJointMotorControlArray(
            self.arm, self.links, pybullet.VELOCITY_CONTROL, targetVelocities=[0.0] * len(losses), forces=losses
        )

    def begin(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        for link, place, speed in zip(self.links, qpos, qvel):
            pybullet.resetJointState(self.arm, link, place, speed)

    def move(self, ctrl: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """qpos and qvel after so many steps."""
        force = list(self.gear * np.clip(ctrl, -1, 1))
        for _ in range(steps):
            pybullet.setJointMotorControlArray(self.arm, self.links, pybullet.TORQUE_CONTROL, forces=force)
            pybullet.stepSimulation()
        found = pybullet.getJointStates(self.arm, self.links)
        return np.array([one[0] for one in found]), np.array([one[1] for one in found])


def _bullet(turn) -> list[float]:
    """A quaternion w, x, y, z as x, y, z, w."""
    return [*map(float, turn[1:]), float(turn[0])]


@torch.inference_mode()
def successes(world: MujocoWorld, policy: Policy, episodes: int, seed: int, arm: Arm | None) -> int:
    """Of episodes in Bullet's arm, or without one in MuJoCo's."""
    rng, steps = make_rng(seed), round(world.spec.dt_s / float(world.file.opt.timestep))
    whole, count = world.start(episodes, rng), 0
    for at in range(episodes):
        state = whole.at(torch.tensor([at]))
        memory, physics = policy.begin(1, rng), state["physics"]
        if arm is not None:
            arm.begin(physics[0, world.layout.qpos].numpy(), physics[0, world.layout.qvel].numpy())
        for _ in range(world.spec.max_episode_steps or 200):
            action, memory = policy.act(world.render(state, ("observation",)), memory, rng)
            if arm is None:
                state = world.imagine(state, action, rng)
            else:
                qpos, qvel = (torch.from_numpy(found)[None] for found in arm.move(action.double().numpy()[0], steps))
                state = world.with_joints(state, state, qpos, qvel)
            if bool(world.render(state, ("success",))["success"] > 0):
                count += 1
                break
    return count


def main(policies: tyro.conf.Positional[list[Path]], /, episodes: int = 300, seed: int = 1_000_003) -> None:
    torch.set_num_threads(1)
    world = MujocoWorld("arm", MujocoConfig(cameras=(), threads=1))
    arm = Arm(world.file, float(world.file.opt.timestep))
    for folder in policies:
        policy = terrella.load_policy(str(folder), world.spec)
        told = [
            percent(clopper_pearson(successes(world, policy, episodes, seed, one), episodes)) for one in (arm, None)
        ]
        print(f"{folder}: {told[0]} of {episodes} episodes in Bullet, {told[1]} in MuJoCo", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
