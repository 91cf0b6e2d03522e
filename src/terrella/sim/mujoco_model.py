"""Loads MJCF and URDF files as MuJoCo models, and adds missing servos, floor and camera."""

# pyright: reportAttributeAccessIssue=false

import os
import sys
from pathlib import Path

if "MUJOCO_GL" not in os.environ and sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ["MUJOCO_GL"] = "egl"  # read when mujoco is imported; its default cannot render without a display

import mujoco
import numpy as np
from mujoco import rollout as rollout

from ..core.errors import TerrellaError

SERVO_HZ, SERVO_DAMPING = 3.0, 1.0  # least natural frequency and damping ratio of added servos
SERVO_SAG = {True: 0.001, False: 0.005}  # under the weight that a servo carries: slides in m, hinges in rad
SERVO_STEPS = 0.3  # radians of a servo's swing in a physics step, at most
FREE, BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


def read(path: str | Path) -> mujoco.MjSpec:
    """The MjSpec of an MJCF or URDF file. TerrellaError where it is missing or broken, with element and line."""
    path = Path(path)
    if not path.is_file():
        raise TerrellaError(f"there is no file {path}; give an MJCF (.xml) or a URDF (.urdf).")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, RuntimeError) as error:
        raise TerrellaError(f"{path} cannot be read: {_sentence(error)}") from error


def compiled(spec: mujoco.MjSpec, name: str) -> mujoco.MjModel:
    """The model of a spec. TerrellaError where it does not compile, with the element or the missing file."""
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        raise TerrellaError(f"{name} cannot be built: {_sentence(error)}") from error


def bare(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> mujoco.MjModel:
    """The model without visual geoms, which is smaller and faster; unchanged where that would change the physics."""
    small = spec.copy()
    small.compiler.discardvisual = True
    try:
        reduced = compiled(small, name)
    except TerrellaError:
        return model
    same = reduced.nbody == model.nbody and reduced.nq == model.nq and np.allclose(reduced.body_mass, model.body_mass)
    return reduced if same and reduced.nsensordata == model.nsensordata else model


def complete(spec: mujoco.MjSpec, name: str) -> mujoco.MjSpec:
    """Adds missing parts to `spec`: a position servo for each joint if there are no actuators, a floor if the world is empty, and a
    camera that shows the whole model if there is none."""
    spec.compiler.discardvisual = False  # URDF files set it
    if not spec.actuators and any(joint.type not in (FREE, BALL) for joint in spec.joints):
        _name_joints(spec)
        add_servos(spec, compiled(spec.copy(), name))
    if not spec.worldbody.geoms and not spec.hfields:
        add_floor(spec)
    if not spec.cameras:
        _add_camera(spec, compiled(spec.copy(), name))
    return spec


def add_floor(spec: mujoco.MjSpec, sky: bool = True) -> None:
    """Adds a chequered plane "floor" at height 0 with a light, and a sky if there is none."""
    texture = spec.add_texture(
        name="terrella_floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.25, 0.3, 0.35], rgb2=[0.4, 0.45, 0.5], width=64, height=64,
    )  # fmt: skip
    material = spec.add_material(name="terrella_floor", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], material="terrella_floor"
    )
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0.2, 0.2, -1], castshadow=False)
    if sky and not any(one.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for one in spec.textures):
        spec.add_texture(
            name="terrella_sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.42, 0.53, 0.64], rgb2=[0.8, 0.84, 0.87], width=64, height=384,
        )  # fmt: skip
        spec.visual.headlight.ambient = [0.5, 0.5, 0.5]


def _name_joints(spec: mujoco.MjSpec) -> None:
    """Names unnamed joints "joint 1", "joint 2", …, because servos refer to joints by name."""
    taken, number = {joint.name for joint in spec.joints}, 0
    for joint in spec.joints:
        while not joint.name:
            number += 1
            joint.name = "" if f"joint {number}" in taken else f"joint {number}"


def add_servos(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Adds a position servo to each hinge and slide that no other joint drives, with a stiffness for the inertia and weight that it
    moves. Euler's method, with which damping makes light joints of long chains unstable, is replaced."""
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    groups = coupled_joints(model)
    driven = {joint for group in groups for joint in list(group)[1:]} | set(_held_joints(model, groups))
    driven |= {
        one for one, other, data in _joint_equalities(model) if other >= 0 and not data[1] and any(data[2:5])
    }  # by a curve
    moves = {next(iter(group)): group for group in groups}
    inertias, weights = model.dof_M0[model.jnt_dofadr], _weights(model)
    loose = 1 / np.maximum(model.dof_invweight0[model.jnt_dofadr], 1e-9)  # inertias while all other joints are loose
    for joint in spec.joints:
        at = model.joint(joint.name).id if joint.type not in (FREE, BALL) else -1
        if at < 0 or at in driven:
            continue
        ratios = {one: abs(ratio) for one, (ratio, _) in moves.get(at, {at: (1.0, 0.0)}).items()}
        inertia = max(sum(ratio**2 * float(inertias[one]) for one, ratio in ratios.items()), 1e-6)
        weight = sum(ratio * weights[one] for one, ratio in ratios.items())
        firm = min(weight / SERVO_SAG[joint.type == SLIDE], float(loose[at]) * (SERVO_STEPS / model.opt.timestep) ** 2)
        stiff = max(inertia * (2 * np.pi * SERVO_HZ) ** 2, firm)
        servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(stiff, kv=2 * SERVO_DAMPING * float(np.sqrt(stiff * inertia)))
        servo.gear, servo.forcelimited = [1, 0, 0, 0, 0, 0], False  # the file's defaults may say otherwise
        servo.ctrllimited = bool(model.jnt_limited[at])
        servo.ctrlrange = model.jnt_range[at] if servo.ctrllimited else [0, 0]


def home_key(model: mujoco.MjModel) -> int | None:
    """The keyframe of the pose at rest: the one called home, else the first; None without keyframes."""
    named = [at for at in range(model.nkey) if model.key(at).name.lower() == "home"]
    return (named or range(model.nkey) or [None])[0]


def _weights(model: mujoco.MjModel) -> list[float]:
    """The largest force or torque with which gravity pulls each joint around the reference pose, N or N m; 0 across gravity."""
    data, weights = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for at, body in enumerate(model.jnt_bodyid):
        pull, axis = model.body_subtreemass[body] * model.opt.gravity, data.xaxis[at]
        arm = np.cross(axis, data.subtree_com[body] - data.xanchor[at])
        slides = model.jnt_type[at] == int(SLIDE)
        turns = np.linalg.norm(arm) * np.linalg.norm(np.cross(axis, pull))
        weights.append(float(abs(pull @ axis) if slides else turns))
    return weights


def coupled_joints(model: mujoco.MjModel) -> list[dict[int, tuple[float, float]]]:
    """Groups of joints that equality constraints move together (URDF's mimic), in chains too: joint -> (ratio, offset) of its
    displacement from the reference pose to that of the first, which drives: one that follows no other, where there is one."""
    links: dict[int, list[tuple[int, float, float]]] = {}
    followers = set()
    for one, other, data in _joint_equalities(model):
        if other >= 0 and data[1]:  # one = offset + ratio other, to first order
            followers.add(one)
            links.setdefault(other, []).append((one, data[1], data[0]))
            links.setdefault(one, []).append((other, 1 / data[1], -data[0] / data[1]))
    groups: list[dict[int, tuple[float, float]]] = []
    for first in sorted(links, key=lambda joint: (joint in followers, joint)):
        if any(first in group for group in groups):
            continue
        group, waiting = {first: (1.0, 0.0)}, [first]
        while waiting:
            joint = waiting.pop(0)
            for other, ratio, offset in links[joint]:
                if other not in group:
                    group[other] = ratio * group[joint][0], offset + ratio * group[joint][1]
                    waiting.append(other)
        groups.append(group)
    return groups


def _joint_equalities(model: mujoco.MjModel) -> list[tuple[int, int, list[float]]]:
    """Active equality constraints of joints, or of fixed tendons of one or two joints: the joint, the one that it follows (-1:
    none), and the polynomial."""
    equalities = []
    for at in np.flatnonzero(model.eq_active0):
        one, other, data = int(model.eq_obj1id[at]), int(model.eq_obj2id[at]), model.eq_data[at, :5]
        if model.eq_type[at] == int(mujoco.mjtEq.mjEQ_JOINT):
            equalities.append((one, other, data.tolist()))
        if model.eq_type[at] != int(mujoco.mjtEq.mjEQ_TENDON):
            continue
        parts, others = _tendon_joints(model, one), _tendon_joints(model, other) if other >= 0 else []
        if len(parts) == 1 and len(others) == (other >= 0):
            driver, coefficient = others[0] if others else (-1, 0.0)
            equalities.append((parts[0][0], driver, (data * coefficient ** np.arange(5) / parts[0][1]).tolist()))
        elif len(parts) == 2 and other < 0:  # the sum of both is constant
            (joint, first), (driver, second) = reversed(parts)
            equalities.append((joint, driver, [data[0] / first, -second / first, 0.0, 0.0, 0.0]))
    return equalities


def _tendon_joints(model: mujoco.MjModel, tendon: int) -> list[tuple[int, float]]:
    """Joints of a fixed tendon and their coefficients; [] of a spatial one."""
    parts = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    fixed = all(model.wrap_type[part] == int(mujoco.mjtWrap.mjWRAP_JOINT) for part in parts)
    joints = [(int(model.wrap_objid[part]), float(model.wrap_prm[part])) for part in parts] if fixed else []
    return [(joint, coefficient) for joint, coefficient in joints if coefficient]


def _held_joints(model: mujoco.MjModel, groups: list[dict[int, tuple[float, float]]]) -> list[int]:
    """Joints that a constraint holds at a constant, with those that are coupled to them."""
    held = {one for one, other, data in _joint_equalities(model) if other < 0 or not any(data[1:5])}
    return [*held, *(joint for group in groups if held & group.keys() for joint in group)]


def _add_camera(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Adds a camera "view" that shows the whole model, and tracks a free body."""
    free = next((joint.parent for joint in spec.joints if joint.type == FREE), None)
    far = 1.6 * max(float(model.stat.extent), 0.1)
    forward, right = np.array([-0.7, -0.55, -0.45]), np.array([-0.55, 0.7, 0.0])
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    axes = [*right, *np.cross(right, forward)]
    if free is None:
        camera = spec.worldbody.add_camera(name="view", pos=model.stat.center - far * forward)
    else:
        mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
        camera = free.add_camera(name="view", pos=-far * forward, mode=mode)
    camera.alt.type, camera.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, axes


def _sentence(error: Exception) -> str:
    """MuJoCo's message on one line."""
    words = " ".join(str(error).replace("XML Error:", "").replace("Error:", "").split()).rstrip(".")
    return f"{words or type(error).__name__}; mend the file."
