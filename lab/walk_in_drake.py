"""A policy of a walking MuJoCo robot, in Drake: the same masses, joints, servos and touching geoms; other solver, other contacts.

    pip install drake
    python lab/walk_in_drake.py runs/go1 runs/rough idle random --episodes 60 --steps 500

The compiled model is rebuilt body by body, and steps by `--step-s` (at 5 ms Drake's servos lag behind what smaller steps agree
on); starts, commands, observations and the end of an episode are those of our task.
For each policy, in both engines from the same starts: how many did not fall, whose mean velocity was within 20% of the
command, and both.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Cylinder,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import terrella
from terrella.core import make_rng
from terrella.core.policy import Policy
from terrella.core.state import State
from terrella.measure.policy_evaluation import percent
from terrella.measure.statistics import clopper_pearson
from terrella.sim.mujoco_model import FREE, mujoco
from terrella.sim.mujoco_world import MujocoConfig, MujocoWorld

SETTLING = 50  # control steps whose velocity does not count: a second
GEOM = mujoco.mjtGeom
SHAPES = {
    GEOM.mjGEOM_SPHERE: lambda size: Sphere(size[0]),
    GEOM.mjGEOM_CAPSULE: lambda size: Capsule(size[0], 2 * size[1]),
    GEOM.mjGEOM_CYLINDER: lambda size: Cylinder(size[0], 2 * size[1]),
    GEOM.mjGEOM_BOX: lambda size: Box(*(2 * size)),
}


class Walker:
    """The robot on a floor. model: of one free body with hinges that position servos drive."""

    def __init__(self, model, step_s: float):
        self.model, builder = model, DiagramBuilder()
        config = MultibodyPlantConfig(time_step=step_s, discrete_contact_approximation="lagged")
        self.plant, graph = AddMultibodyPlant(config, builder)
        self.bodies = [self.plant.world_body(), *(self._body(at) for at in range(1, model.nbody))]
        self.joints = {}
        for at in range(1, model.nbody):
            self._join(at)
        for at in range(model.nu):
            self._drive(at)
        self.plant.RegisterCollisionGeometry(self.bodies[0], RigidTransform(), HalfSpace(), "floor", _rough(0.8))
        for at in range(model.ngeom):
            self._touch(at)
        self.plant.Finalize()
        own = GeometrySet([one for body in self.bodies[1:] for one in self.plant.GetCollisionGeometriesForBody(body)])
        graph.collision_filter_manager().Apply(
            CollisionFilterDeclaration().ExcludeWithin(own)
        )  # the floor alone is touched
        self.diagram = builder.Build()

    def begin(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        self.simulator = Simulator(self.diagram)
        self.context, model = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context()), self.model
        pose = _placed(qpos[:3], qpos[3:7])
        self.plant.SetFreeBodyPose(self.context, self.bodies[1], pose)
        speed = SpatialVelocity(pose.rotation() @ qvel[3:6], qvel[:3])
        self.plant.SetFreeBodySpatialVelocity(context=self.context, body=self.bodies[1], V_JpJc=speed)
        for at, joint in self.joints.items():
            joint.set_angle(self.context, qpos[model.jnt_qposadr[at]])
            joint.set_angular_rate(self.context, qvel[model.jnt_dofadr[at]])
        self.simulator.Initialize()

    def move(self, ctrl: np.ndarray, until_s: float) -> tuple[np.ndarray, np.ndarray]:
        """qpos and qvel, as MuJoCo orders them, after the servos went for `ctrl`."""
        model, port = self.model, self.plant.get_desired_state_input_port(self.bodies[1].model_instance())
        port.FixValue(self.context, np.concatenate([ctrl, np.zeros(model.nu)]))
        self.simulator.AdvanceTo(until_s)
        pose = self.plant.EvalBodyPoseInWorld(self.context, self.bodies[1])
        speed = self.plant.EvalBodySpatialVelocityInWorld(self.context, self.bodies[1])
        qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
        qpos[:3], qpos[3:7] = pose.translation(), pose.rotation().ToQuaternion().wxyz()
        qvel[:3], qvel[3:6] = speed.translational(), pose.rotation().transpose() @ speed.rotational()
        for at, joint in self.joints.items():
            qpos[model.jnt_qposadr[at]] = joint.get_angle(self.context)
            qvel[model.jnt_dofadr[at]] = joint.get_angular_rate(self.context)
        return qpos, qvel

    def _body(self, at: int):
        model = self.model
        turned = _placed(np.zeros(3), model.body_iquat[at]).rotation()
        inertia = RotationalInertia(*model.body_inertia[at]).ReExpress(turned)
        mass = SpatialInertia.MakeFromCentralInertia(float(model.body_mass[at]), model.body_ipos[at], inertia)
        return self.plant.AddRigidBody(f"body {at}", mass)

    def _join(self, at: int) -> None:
        model, plant = self.model, self.plant
        parent, child = self.bodies[model.body_parentid[at]].body_frame(), self.bodies[at].body_frame()
        place, joint = _placed(model.body_pos[at], model.body_quat[at]), int(model.body_jntadr[at])
        if not model.body_jntnum[at]:
            plant.WeldFrames(parent, child, place)
        elif model.jnt_type[joint] != int(FREE):
            here = RigidTransform(model.jnt_pos[joint])
            ends = [(f"p{at}", parent, place @ here), (f"c{at}", child, here)]
            frames = [plant.AddFrame(FixedOffsetFrame(*end)) for end in ends]
            damping = float(model.dof_damping[model.jnt_dofadr[joint]])
            self.joints[joint] = plant.AddJoint(
                RevoluteJoint(f"joint {joint}", *frames, model.jnt_axis[joint], damping)
            )

    def _drive(self, at: int) -> None:
        model, joint = self.model, int(self.model.actuator_trnid[at, 0])
        limit = float(model.actuator_forcerange[at, 1])
        made = self.plant.AddJointActuator(f"servo {at}", self.joints[joint], limit)
        made.set_default_rotor_inertia(float(model.dof_armature[model.jnt_dofadr[joint]]))
        made.set_default_gear_ratio(1.0)
        gains = PdControllerGains(p=float(model.actuator_gainprm[at, 0]), d=float(-model.actuator_biasprm[at, 2]))
        made.set_controller_gains(gains)

    def _touch(self, at: int) -> None:
        model, kind = self.model, GEOM(self.model.geom_type[at])
        if kind not in SHAPES or not model.geom_conaffinity[at]:
            return
        body, place = self.bodies[model.geom_bodyid[at]], _placed(model.geom_pos[at], model.geom_quat[at])
        rough = _rough(float(model.geom_friction[at, 0]))
        self.plant.RegisterCollisionGeometry(body, place, SHAPES[kind](model.geom_size[at]), f"geom {at}", rough)


def _placed(place, turn) -> RigidTransform:
    return RigidTransform(Quaternion(np.asarray(turn) / np.linalg.norm(turn)), place)


def _rough(friction: float) -> ProximityProperties:
    found = ProximityProperties()
    AddContactMaterial(
        dissipation=None, point_stiffness=None, friction=CoulombFriction(friction, friction), properties=found
    )
    return found


@dataclass(frozen=True)
class Walk:
    """What became of an episode: whether it did not fall, and whether its mean velocity after the first second, as far as it
    came, was within 20% of the command."""

    stood: bool
    followed: bool


@torch.no_grad()
def in_drake(walker: Walker, world: MujocoWorld, policy: Policy, starts: State, steps: int) -> Iterator[Walk]:
    task, layout = world.task, world.layout
    for at in range(len(starts["physics"])):
        state, rng, seen, fell = starts.at(torch.tensor([at])), make_rng(at), [], False
        memory, physics = policy.begin(1, rng), state["physics"]
        walker.begin(physics[0, layout.qpos].numpy(), physics[0, layout.qvel].numpy())
        for step in range(steps):
            action, memory = policy.act({"observation": task.render(layout, state, "observation")}, memory, rng)
            now_s = (step + 1) * world.spec.dt_s
            qpos, qvel = walker.move(action.double().numpy()[0], now_s)
            physics = physics.clone()
            physics[0, 0] = now_s
            physics[0, layout.qpos], physics[0, layout.qvel] = torch.from_numpy(qpos), torch.from_numpy(qvel)
            after = state.replace(physics=physics, ctrl=action.double())
            fell = bool(task.evaluate(layout, dict(state.items()), dict(after.items()))[1])
            state = after
            if fell:
                break
            seen.append(task.render(layout, state, "velocity")[0, :2])
        yield walk(fell, seen, state["command"][0, :2])


@torch.no_grad()
def in_mujoco(world: MujocoWorld, policy: Policy, starts: State, steps: int) -> Iterator[Walk]:
    state, rng, seen, alive = starts, make_rng(0), [], []
    memory = policy.begin(len(starts["physics"]), rng)
    for _ in range(steps):
        action, memory = policy.act(world.render(state, ("observation",)), memory, rng)
        state = world.imagine(state, action, rng)
        seen.append(world.render(state, ("velocity",))["velocity"][:, :2])
        alive.append(~state["done"])
    for at in range(len(starts["physics"])):
        lived = sum(int(one[at]) for one in alive)
        yield walk(lived < steps, [one[at] for one in seen[:lived]], state["command"][at, :2])


def walk(fell: bool, seen: list[torch.Tensor], wanted: torch.Tensor) -> Walk:
    """seen: velocities [2] of each step before a fall."""
    if len(seen) <= SETTLING:
        return Walk(not fell, False)
    missed = torch.stack(seen[SETTLING:]).mean(0) - wanted
    return Walk(not fell, bool(missed.norm() < 0.2 * wanted.norm()))


def told(walks: list[Walk]) -> str:
    counts = {
        "no fall": sum(one.stood for one in walks),
        "within 20%": sum(one.followed for one in walks),
        "both": sum(one.stood and one.followed for one in walks),
    }
    shares = (f"{what} {count}, {percent(clopper_pearson(count, len(walks)))}" for what, count in counts.items())
    return f"{'; '.join(shares)} of {len(walks)}"


def main(
    policies: tyro.conf.Positional[list[str]],
    /,
    robot: str = "go1",
    episodes: int = 100,
    steps: int = 1000,
    step_s: float = 0.001,
    seed: int = 12345,
) -> None:
    torch.set_num_threads(1)
    world = MujocoWorld(robot, MujocoConfig(cameras=()))
    walker, starts = Walker(world.file, step_s), world.start(episodes, make_rng(seed))
    for name in policies:
        policy = terrella.load_policy(name, world.spec)
        print(f"{name} in MuJoCo: {told(list(in_mujoco(world, policy, starts, steps)))}", flush=True)
        print(f"{name} in Drake: {told(list(in_drake(walker, world, policy, starts, steps)))}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
