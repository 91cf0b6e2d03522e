"""Parameters that may differ between worlds of one MuJoCo model (masses, friction, gravity, …), and the changed models."""

# pyright: reportAttributeAccessIssue=false

import copy
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import TerrellaError
from ..core.similar import did_you_mean
from .mujoco_model import mujoco

Model = Any  # mujoco.MjModel


@dataclass(frozen=True)
class Parameter:
    """One number of a world."""

    nominal: float  # the file's value
    low: float  # range in which the simulation is stable
    high: float
    unit: str  # "x" for a factor
    what: str  # description
    # change(model, file, value) sets the value in a copy of the file's model. Earlier changes of a physics parameter are kept; for
    # a visual one (`seen`), the fields SEEN have been reset to the file's.
    change: Callable[[Model, Model, float], None]
    seen: bool = False  # affects pictures only


def _scaled(*fields: str, low: float, high: float, what: str) -> Parameter:
    """A factor on the current values, so that `mass`, `mass.BODY` and `inertia` combine in any order."""

    def change(model: Model, file: Model, value: float) -> None:
        for name in fields:
            getattr(model, name)[:] *= value

    return Parameter(1.0, low, high, "x", what, change)


def _sliding(model: Model, file: Model, value: float) -> None:
    """Sliding friction of all geoms and of all explicit pairs."""
    model.geom_friction[:, 0] *= value
    model.pair_friction[:, :2] *= value


def _gravity(model: Model, file: Model, value: float) -> None:
    model.opt.gravity[2] = -value


def _gains(model: Model, file: Model, value: float) -> None:
    """Servos: kp in force = kp (ctrl - q) - kv v. Motors: their gain."""
    servo = file.actuator_biasprm[:, 1] < 0
    model.actuator_gainprm[:, 0] = value * file.actuator_gainprm[:, 0]
    model.actuator_biasprm[:, 1] = np.where(servo, value, 1.0) * file.actuator_biasprm[:, 1]


def _stiff(model: Model, file: Model, value: float) -> None:
    """Springs of hinges and slides towards the reference position."""
    plain = file.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    model.jnt_stiffness[:] = file.jnt_stiffness + value * plain


def _one_mass(at: int) -> Parameter:
    def change(model: Model, file: Model, value: float) -> None:
        model.body_mass[at] = value * model.body_mass[at]
        model.body_inertia[at] = value * model.body_inertia[at]

    return Parameter(1.0, 0.2, 5.0, "x", "mass and inertia of this body", change)


def _camera(axis: int, what: str) -> Parameter:
    def change(model: Model, file: Model, value: float) -> None:
        model.cam_pos[:, axis] = file.cam_pos[:, axis] + value

    return Parameter(0.0, -1.0, 1.0, "m", what, change, True)


def _field_of_view(model: Model, file: Model, value: float) -> None:
    """A factor on the vertical angle, which MuJoCo draws with, or with the focal length of cameras that have a sensor."""
    model.cam_fovy[:] = value * file.cam_fovy
    half = np.radians(file.cam_fovy) / 2
    model.cam_intrinsic[:, :2] = file.cam_intrinsic[:, :2] * (np.tan(half) / np.tan(value * half))[:, None]


def _light(model: Model, file: Model, value: float) -> None:
    model.light_diffuse[:] = np.clip(value * file.light_diffuse, 0, 1)
    model.vis.headlight.diffuse[:] = np.clip(value * file.vis.headlight.diffuse, 0, 1)
    model.vis.headlight.ambient[:] = np.clip(value * file.vis.headlight.ambient, 0, 1)


def _colour(axis: int) -> Parameter:
    def change(model: Model, file: Model, value: float) -> None:
        for field in ("geom_rgba", "mat_rgba"):
            getattr(model, field)[:, axis] = np.clip(getattr(file, field)[:, axis] + value, 0, 1)

    return Parameter(0.0, -1.0, 1.0, "", "added to this channel of all colours", change, True)


def _turned_camera(axis: int) -> Parameter:
    """Rotation of the cameras about their own right, up or view axis."""
    own = np.eye(3)[axis]

    def change(model: Model, file: Model, value: float) -> None:
        turn, after = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, own, value)
        for quat in model.cam_quat:
            mujoco.mju_mulQuat(after, quat, turn)
            quat[:] = after

    return Parameter(0.0, -0.5, 0.5, "rad", "rotated about its own " + ("right", "up", "back")[axis], change, True)


def _turned_lights(axis: int, reach: float, what: str) -> Parameter:
    """Rotation of the fixed lights, position and direction, about the centre of the model."""
    about = np.eye(3)[axis]

    def change(model: Model, file: Model, value: float) -> None:
        turn, after, middle = np.empty(4), np.empty(3), model.stat.center
        mujoco.mju_axisAngle2Quat(turn, about, value)
        for at in _fixed_lights(model):
            mujoco.mju_rotVecQuat(after, model.light_pos[at] - middle, turn)
            model.light_pos[at] = middle + after
            mujoco.mju_rotVecQuat(after, model.light_dir[at], turn)
            model.light_dir[at] = after

    return Parameter(0.0, -reach, reach, "rad", what, change, True)


def _fixed_lights(model: Model) -> np.ndarray:
    fixed = model.light_mode == int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    return np.flatnonzero(fixed & (model.light_bodyid == 0))


def _scene_parameter(high: float, what: str) -> Parameter:
    """A change of the rendered scene, made by sim/mujoco_appearance.py; the model is unchanged."""
    return Parameter(0.0, 0.0, high, "", what, lambda model, file, value: None, True)


SEEN = (
    "cam_pos", "cam_quat", "cam_fovy", "cam_intrinsic", "light_pos", "light_dir", "light_diffuse", "geom_rgba", "mat_rgba",
)  # fmt: skip
TEXTURES = _scene_parameter(1.0, "share of the surfaces with a random texture; the value's bits seed the choice")
COLOURS = _scene_parameter(1.0, "blend of each surface's colour towards a random one; the value's bits seed the choice")
DISTRACTORS = _scene_parameter(20.0, "number of added balls and boxes; the value's bits seed their places and colours")


def parameters_of(model: Model) -> Mapping[str, Parameter]:
    """The parameters of a model, by name; `mass.NAME` is that of one body."""
    gravity = -float(model.opt.gravity[2])
    parameters = {
        "mass": _scaled("body_mass", "body_inertia", low=0.3, high=3.0, what="mass and inertia of all bodies"),
        "inertia": _scaled("body_inertia", low=0.5, high=2.0, what="inertia of all bodies, at the same mass"),
        "friction": Parameter(1.0, 0.05, 3.0, "x", "sliding friction", _sliding),
        "gravity": Parameter(gravity, 0.0, 30.0, "m/s²", "downwards", _gravity),
        "damping": _scaled("dof_damping", low=0.0, high=10.0, what="damping of the joints"),
        "armature": _scaled("dof_armature", low=0.2, high=5.0, what="rotor inertia of the joints"),
        "joint_friction": _scaled("dof_frictionloss", low=0.0, high=10.0, what="dry friction of the joints"),
        "spring": Parameter(0.0, 0.0, 100.0, "N m/rad or N/m", "springs in the joints towards 0, added to the file's", _stiff),
        "gain": Parameter(1.0, 0.3, 2.0, "x", "gain of the servos, or force of the motors", _gains),
        "strength": _scaled("actuator_forcerange", low=0.1, high=2.0, what="limit of the actuators' forces"),
        "camera.x": _camera(0, "moved along its body's x"),
        "camera.y": _camera(1, "moved along its body's y"),
        "camera.z": _camera(2, "moved along its body's z"),
        "camera.fov": Parameter(1.0, 0.3, 1.8, "x", "field of view", _field_of_view, True),
        "light": Parameter(1.0, 0.0, 3.0, "x", "brightness of the lights", _light, True),
        "camera.pitch": _turned_camera(0), "camera.yaw": _turned_camera(1), "camera.roll": _turned_camera(2),
        "light.turn": _turned_lights(2, float(np.pi), "rotation of the lights about the vertical"),
        "light.tilt": _turned_lights(0, 0.8, "rotation of the lights about the world's x"),
        "red": _colour(0), "green": _colour(1), "blue": _colour(2),
        "textures": TEXTURES, "colours": COLOURS, "distractors": DISTRACTORS,
    }  # fmt: skip
    fields = {
        "damping": "dof_damping", "armature": "dof_armature", "joint_friction": "dof_frictionloss",
        "strength": "actuator_forcerange", "gain": "actuator_gainprm",
    }  # fmt: skip
    for name, field in fields.items():
        if not np.any(getattr(model, field)):  # a factor on zeros has no effect
            del parameters[name]
    if not _fixed_lights(model).size:
        del parameters["light.turn"], parameters["light.tilt"]
    bodies = {model.body(at).name: at for at in range(1, model.nbody) if model.body_mass[at] > 0}
    return parameters | {f"mass.{name}": _one_mass(at) for name, at in bodies.items() if name}


def checked(known: Mapping[str, Parameter], names: Sequence[str]) -> None:
    """TerrellaError for unknown names."""
    for name in names:
        if name not in known:
            plain = [one for one in known if not one.startswith("mass.")]
            likest = did_you_mean(name, known) or "."
            raise TerrellaError(
                f"there is no parameter '{name}'{likest} There are {', '.join(plain)}, and mass.BODY for each body."
            )


class Models:
    """The models of the worlds of a batch: one per row of values, cached."""

    def __init__(self, file: Model, changes: Sequence[Parameter]):
        self.file, self.changes = file, tuple(changes)
        self._made: OrderedDict[bytes, Model] = OrderedDict()
        self._most = 0  # rows of the largest batch, whose models must stay in the cache
        self._data = mujoco.MjData(file)

    def of(self, values: np.ndarray) -> list[Model]:
        """The models for values float64 [B, parameters]. A returned model never changes."""
        if not self.changes:
            return [self.file] * len(values)
        models = []
        for row in values:
            key = row.tobytes()
            model = self._made.get(key)
            if model is None:
                model = self._made[key] = self.changed(copy.copy(self.file), row)
            else:
                self._made.move_to_end(key)
            models.append(model)
        self._most = max(self._most, len(values))
        while len(self._made) > 2 * self._most + 64:
            self._made.popitem(last=False)
        return models

    def changed(self, model: Model, row: np.ndarray) -> Model:
        """Applies the values of one world to a model, and updates what MuJoCo derives from them."""
        for change, value in zip(self.changes, row.tolist()):
            change.change(model, self.file, value)
        mujoco.mj_setConst(model, self._data)
        return model
