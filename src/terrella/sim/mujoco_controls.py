"""The controls of a MuJoCo model: their kind and unit, their limits where the file states none, and their values at rest."""

# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import numpy as np

from ..core.errors import TerrellaError
from .mujoco_model import BALL, FREE, SLIDE, home_key, mujoco

POSITION, VELOCITY, FORCE, MUSCLE = "position", "velocity", "force", "muscle"
TURN_RAD, SLIDE_M = float(np.pi), 1.0  # reach of a position servo to either side, where nothing limits it
SPIN, SLIDE_SPEED = 10 * float(np.pi), 1.0  # rad/s and m/s of a velocity servo, where nothing limits it
_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TENDON, _SITE = int(mujoco.mjtTrn.mjTRN_TENDON), int(mujoco.mjtTrn.mjTRN_SITE)


@dataclass(frozen=True)
class ControlLimits:
    """low, high and rest: float64 [nu], in the units of the controls; act: activations at rest, float64 [na]; chosen: the limits
    that the file does not state, as text; clipped: the controls at rest that are outside of the file's limits, as text."""

    low: np.ndarray
    high: np.ndarray
    rest: np.ndarray
    act: np.ndarray
    chosen: tuple[str, ...]
    clipped: tuple[str, ...]


def controls_of(model: mujoco.MjModel, qpos: np.ndarray) -> ControlLimits:
    """The controls of a model whose pose at rest is `qpos` [nq]. Limits that the file does not state hold the pose at rest, and
    whatever the servo's joint, tendon or force can reach. TerrellaError for actuators that take several numbers."""
    if len(model.actuator_gainprm) != model.nu:
        raise TerrellaError("actuators of several controls (pid, SO3) are not read; use position or motor.")
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    kinds = [kind_of_control(model, at) for at in range(model.nu)]
    servo = np.array([kind == POSITION for kind in kinds], bool)
    hold = np.array([_control_at(model, at, float(data.actuator_length[at])) for at in range(model.nu)]).reshape(-1)
    key = home_key(model)
    rest = np.where(servo, hold, 0.0) if key is None or not model.key_ctrl[key].any() else model.key_ctrl[key].copy()
    limits, chosen = model.actuator_ctrlrange.copy(), []
    for at in np.flatnonzero(~model.actuator_ctrllimited.astype(bool)).tolist():
        why = "its range, which the file does not enforce"
        if limits[at, 0] == limits[at, 1]:
            limits[at], why = _limits(model, data, at, kinds[at])
        low, high = limits[at] = min(limits[at, 0], rest[at]), max(limits[at, 1], rest[at])
        about = f"{control_name(model, at)} {low:.4g} to {high:.4g} {control_unit(model, at)}"
        chosen.append(f"{about.rstrip()} ({why})")
    low, high = limits[:, 0], limits[:, 1]
    outside = np.flatnonzero((rest < low - 1e-6) | (rest > high + 1e-6)).tolist()
    clipped = tuple(f"{control_name(model, at)} {rest[at]:.4g} of {low[at]:.4g} to {high[at]:.4g}" for at in outside)
    rest = np.clip(rest, low, high)
    return ControlLimits(low, high, rest, _activations(model, kinds, rest, hold), tuple(chosen), clipped)


def kind_of_control(model: mujoco.MjModel, at: int) -> str:
    """What a control asks for: POSITION, VELOCITY, FORCE or MUSCLE (an excitation)."""
    if model.actuator_gaintype[at] == int(mujoco.mjtGain.mjGAIN_MUSCLE):
        return MUSCLE
    _, position, velocity = model.actuator_biasprm[at, :3]
    if model.actuator_biastype[at] != int(mujoco.mjtBias.mjBIAS_AFFINE) or (position >= 0 and velocity >= 0):
        return FORCE
    integrated = model.actuator_dyntype[at] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
    return POSITION if position < 0 and not integrated else VELOCITY


def control_name(model: mujoco.MjModel, at: int) -> str:
    """The name of an actuator, else of the joint that it alone drives, else its number."""
    driven = [model.actuator_trnid[one, 0] for one in range(model.nu) if model.actuator_trntype[one] in _JOINT]
    joint = int(model.actuator_trnid[at, 0])
    alone = model.actuator_trntype[at] in _JOINT and driven.count(joint) == 1
    return model.actuator(at).name or (alone and model.joint(joint).name) or f"actuator {at + 1}"


def control_unit(model: mujoco.MjModel, at: int) -> str:
    """The unit of a control: rad, rad/s or N m for hinges; m, m/s or N for slides; else ""."""
    if model.actuator_trntype[at] not in _JOINT:
        return ""
    slides = model.jnt_type[model.actuator_trnid[at, 0]] == int(SLIDE)
    kind = kind_of_control(model, at)
    if kind in (POSITION, VELOCITY):
        return ("m" if slides else "rad") + ("" if kind == POSITION else "/s")
    if kind == MUSCLE:
        return ""
    gear = abs(float(model.actuator_gear[at, 0] * model.actuator_gainprm[at, 0]))
    force = "N" if slides else "N m"
    return "" if not gear else force if gear == 1 else f"{gear:g} {force}"


def control_mode(model: mujoco.MjModel) -> str:
    """The action mode of the Spec: position, torque, or axes for mixed kinds."""
    kinds = {kind_of_control(model, at) for at in range(model.nu)}
    return {(POSITION,): "position", (FORCE,): "torque", (): "torque"}.get(tuple(kinds), "axes")


def _control_at(model: mujoco.MjModel, at: int, value: float) -> float:
    """The control at which a servo rests at this length (position) or speed (velocity) of its transmission."""
    gain, (bias, position, velocity) = float(model.actuator_gainprm[at, 0]), model.actuator_biasprm[at, :3].tolist()
    stiffness = position if position < 0 else velocity
    return value * (-stiffness / gain) - bias / gain if gain else 0.0


def _limits(model: mujoco.MjModel, data: mujoco.MjData, at: int, kind: str) -> tuple[tuple[float, float], str]:
    """Limits of a control without any, and where they come from."""
    if kind == MUSCLE:
        return (0.0, 1.0), "a muscle's excitation"
    if kind == FORCE:
        return _force_limits(model, at)
    lengths, own = _lengths(model, data, at)
    if kind == POSITION:
        ends = sorted(_control_at(model, at, length) for length in lengths)
        return (ends[0], ends[1]), "its range" if own else "nothing limits it"
    speed = lengths[1] - lengths[0] if own else _spin(model, at)
    force = np.abs(model.actuator_forcerange[at]).max() if model.actuator_forcelimited[at] else 0.0
    damping = abs(model.actuator_biasprm[at, 2])
    if model.actuator_dyntype[at] != int(mujoco.mjtDyn.mjDYN_INTEGRATOR) and damping and force / damping > speed:
        return _both_sides(_control_at(model, at, force / damping)), "its force range over its gain"
    return _both_sides(_control_at(model, at, speed)), "its range in a second" if own else "nothing limits it"


def _force_limits(model: mujoco.MjModel, at: int) -> tuple[tuple[float, float], str]:
    gain, gear, target = model.actuator_gainprm[at, 0], model.actuator_gear[at, 0], model.actuator_trnid[at, 0]
    force = np.zeros(2)
    if model.actuator_forcelimited[at]:
        force = model.actuator_forcerange[at] / (gain or 1)
    elif model.actuator_trntype[at] in _JOINT and model.jnt_actfrclimited[target]:
        force = model.jnt_actfrcrange[target] / (gain * gear or 1)
    elif model.actuator_trntype[at] == _TENDON and model.tendon_actfrclimited[target]:
        force = model.tendon_actfrcrange[target] / (gain * gear or 1)
    if force[0] != force[1]:
        return (float(force.min()), float(force.max())), "its force range"
    return (-1.0, 1.0), "its gear"


def _lengths(model: mujoco.MjModel, data: mujoco.MjData, at: int) -> tuple[tuple[float, float], bool]:
    """The lengths of an actuator's transmission that can be reached, and whether the file limits them."""
    kind, target, gear = model.actuator_trntype[at], int(model.actuator_trnid[at, 0]), model.actuator_gear[at]
    if kind in _JOINT and model.jnt_type[target] not in (int(FREE), int(BALL)):
        ends, own = _joint_range(model, target)
    elif kind == _TENDON:
        ends, own = _tendon_range(model, target)
    else:  # sites and balls: a direction, and turns about it
        moves = kind == _SITE and gear[:3].any()
        reach = SLIDE_M * float(np.linalg.norm(gear[:3])) if moves else TURN_RAD * float(np.linalg.norm(gear))
        return (float(data.actuator_length[at]) - reach, float(data.actuator_length[at]) + reach), False
    low, high = sorted(float(gear[0]) * end for end in ends)
    return (low, high), own


def _joint_range(model: mujoco.MjModel, joint: int) -> tuple[tuple[float, float], bool]:
    if model.jnt_limited[joint]:
        return (float(model.jnt_range[joint, 0]), float(model.jnt_range[joint, 1])), True
    return _both_sides(SLIDE_M if model.jnt_type[joint] == int(SLIDE) else TURN_RAD), False


def _tendon_range(model: mujoco.MjModel, tendon: int) -> tuple[tuple[float, float], bool]:
    """A tendon's own range; else of a fixed one those of its joints together, of a spatial one up to twice its length."""
    if model.tendon_limited[tendon]:
        return (float(model.tendon_range[tendon, 0]), float(model.tendon_range[tendon, 1])), True
    parts = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if (model.wrap_type[parts] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return (0.0, 2 * float(model.tendon_length0[tendon])), False
    ranges = [_joint_range(model, joint) for joint in model.wrap_objid[parts]]
    ends = [sorted(coef * end for end in ends) for coef, (ends, _) in zip(model.wrap_prm[parts], ranges)]
    return (float(sum(low for low, _ in ends)), float(sum(high for _, high in ends))), all(own for _, own in ranges)


def _spin(model: mujoco.MjModel, at: int) -> float:
    """Speed of the transmission of a velocity servo that nothing limits."""
    gear, joint = float(np.abs(model.actuator_gear[at]).max()), model.actuator_trnid[at, 0]
    hinge = model.actuator_trntype[at] in _JOINT and model.jnt_type[joint] != int(SLIDE)
    return gear * (SPIN if hinge else SLIDE_SPEED)


def _both_sides(reach: float) -> tuple[float, float]:
    return -abs(reach), abs(reach)


def _activations(model: mujoco.MjModel, kinds: list[str], rest: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """Activations at rest: the file's, or those at which servos hold their pose."""
    if (key := home_key(model)) is not None and model.key_act[key].any():
        return model.key_act[key].copy()
    act = np.zeros(model.na)
    for at, first in enumerate(model.actuator_actadr):
        if first >= 0 and kinds[at] in (POSITION, VELOCITY):
            act[first + model.actuator_actnum[at] - 1] = rest[at] if kinds[at] == POSITION else hold[at]
    return act
