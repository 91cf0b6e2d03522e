"""The bodies, walls and limits of a MuJoCo model, for the laws of physics."""

# pyright: reportAttributeAccessIssue=false

from typing import Any

import numpy as np

from ..physics.system import Limit, PhysicalSystem, RigidBody, Slot, Wall
from .mujoco_model import BALL, FREE, mujoco

_BOX, _PLANE, _SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE
_POSITION = mujoco.mjtSensor.mjSENS_FRAMEPOS


def system_of(model: mujoco.MjModel) -> PhysicalSystem | None:
    """The system of a model in the channels `qpos`, `qvel` and `sensor.NAME`; None without a free body or a limited joint.

    Bodies are those with a free joint and one box or sphere, and driven ones whose position a framepos sensor gives. Other parts
    that move and collide are listed as hidden."""
    solid = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    bodies, walls, hidden, data = [], [], [], mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for at in range(1, model.nbody):
        geoms = [one for one in range(model.ngeom) if model.geom_bodyid[one] == at and solid[one]]
        root = model.body_weldid[at]
        if root == 0 or not geoms:
            continue
        shape = _shape(model, geoms[0]) if len(geoms) == 1 else None
        joint = int(model.body_jntadr[at])
        free = joint >= 0 and model.jnt_type[joint] == int(FREE)
        sensor = _sensor_at(model, at, geoms[0])
        name = model.body(at).name or f"body {at}"
        if shape is None or not (free or sensor):
            hidden.append(name)
        elif free:
            bodies.append(_free_body(model, at, name, geoms[0], shape))
        elif sensor:
            bodies.append(RigidBody(name, Slot(f"sensor.{sensor}"), **shape, driven=True))
    for geom in range(model.ngeom):
        if model.body_weldid[model.geom_bodyid[geom]] == 0 and solid[geom]:
            wall = _wall(model, data, geom)
            walls += [wall] if wall else []
            hidden += [] if wall else [model.geom(geom).name or f"geom {geom}"]
    limits = _limits(model)
    if not bodies and limits:  # a robot without free bodies: its limits are judged beside a body that stands still
        bodies = [RigidBody("robot", Slot("qpos"), driven=True)] if model.nq >= 3 else []
    if not bodies:
        return None
    return PhysicalSystem(
        tuple(bodies), tuple(walls), (), tuple(limits), _triple(model.opt.gravity), hidden=tuple(hidden)
    )  # fmt: skip


def _shape(model: mujoco.MjModel, geom: int) -> dict[str, Any] | None:
    centred = np.allclose(model.geom_pos[geom], 0) and np.allclose(model.geom_quat[geom], [1, 0, 0, 0])
    if model.geom_type[geom] == int(_SPHERE) and centred:
        return {"radius_m": float(model.geom_size[geom][0])}
    if model.geom_type[geom] == int(_BOX) and centred:
        return {"half_m": _triple(model.geom_size[geom])}
    return None


def _free_body(model: mujoco.MjModel, at: int, name: str, geom: int, shape: dict[str, Any]) -> RigidBody:
    joint = int(model.body_jntadr[at])
    qpos, qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    friction = max(float(model.geom_friction[one][0]) for one in range(model.ngeom))
    return RigidBody(
        name, Slot("qpos", qpos), Slot("qvel", qvel), Slot("qpos", qpos + 3), Slot("qvel", qvel + 3), **shape,
        mass_kg=float(model.body_mass[at]), inertia_kg_m2=_triple(model.body_inertia[at]), friction=friction,
    )  # fmt: skip


def _wall(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Wall | None:
    turn, centre = np.zeros(4), data.geom_xpos[geom]
    mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
    place = _triple(centre)
    if model.geom_type[geom] == int(_PLANE):
        normal = np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), turn)
        return Wall(place, normal=_triple(normal))
    if model.geom_type[geom] == int(_BOX):
        return Wall(place, _triple(model.geom_size[geom]), _quadruple(turn))
    return None


def _sensor_at(model: mujoco.MjModel, body: int, geom: int) -> str:
    """The framepos sensor of a body, or of a site or geom at its centre; "" without one."""
    for at in range(model.nsensor):
        if model.sensor_type[at] != int(_POSITION):
            continue
        kind, number = int(model.sensor_objtype[at]), int(model.sensor_objid[at])
        centred = {
            int(mujoco.mjtObj.mjOBJ_XBODY): lambda n: n == body,
            int(mujoco.mjtObj.mjOBJ_BODY): lambda n: n == body,
            int(mujoco.mjtObj.mjOBJ_GEOM): lambda n: n == geom,
            int(mujoco.mjtObj.mjOBJ_SITE): lambda n: model.site_bodyid[n] == body and np.allclose(model.site_pos[n], 0),
        }
        if kind in centred and centred[kind](number):
            return model.sensor(at).name
    return ""


def _limits(model: mujoco.MjModel) -> list[Limit]:
    """The ranges of hinges and slides."""
    limits = []
    for at in range(model.njnt):
        if model.jnt_limited[at] and model.jnt_type[at] not in (int(FREE), int(BALL)):
            low, high = map(float, model.jnt_range[at])
            unit = "m" if model.jnt_type[at] == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            limits.append(
                Limit(model.joint(at).name or f"joint {at}", Slot("qpos", int(model.jnt_qposadr[at])), low, high, unit)
            )
    return limits


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _quadruple(values: Any) -> tuple[float, float, float, float]:
    w, x, y, z = map(float, values)
    return w, x, y, z
