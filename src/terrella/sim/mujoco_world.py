"""MujocoWorld: thousands of worlds of one MuJoCo model in one State, stepped together by `mujoco.rollout` on threads of the CPU."""

# pyright: reportAttributeAccessIssue=false
# mujoco is a compiled module without declarations

from __future__ import annotations

import getpass
import os
import tempfile
import threading
import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.errors import ObservationError, TerrellaError
from ..core.spec import DONE, POSE, POSE_UNIT, REWARD, Spec, kind_of, suffix_of
from ..core.state import State
from .mujoco_appearance import patterned
from .mujoco_lidar import SITE, Lidar
from .mujoco_model import BALL, FREE, SLIDE, bare, compiled, complete, mujoco, read
from .mujoco_parameters import TEXTURES, checked, parameters_of
from .mujoco_renderer import MujocoRenderer, lens
from .mujoco_robots import Robot, robot_of
from .mujoco_stepping import Stepper
from .mujoco_tasks import MARKER, RobotLayout, RobotTask, numbers, task_of
from .mujoco_warp import WarpStepper

FILES = (".xml", ".mjcf", ".urdf")
FASTEST = 1e4  # m/s or rad/s: a world that moves faster is unstable
MOST_DUMPS = 8
DRAWN, SCANNED = ("rgb", "depth", "segmentation"), ("contacts", SITE)
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


class MujocoWorld:
    """`MujocoWorld("go1")`, a robot that is ready to use (sim/mujoco_robots.py), or `MujocoWorld("FILE.xml")`, an MJCF or URDF.

    task:       what is wanted (sim/mujoco_tasks.py); default: the robot's own, or what a file tells.
    control_s:  seconds of a control step, of which physics takes as many of its own as fit.
    size:       (height, width) of pictures.
    cameras:    names of cameras of the model, the first is `rgb`, others `rgb.NAME`; default: the first that there is; () for none.
    depth, segmentation: show these beside each rgb.
    lidar:      rays of a turn, or (rows, rays), that a site named "lidar" in the file sends out; lidar_m: how far, in m.
    pilot:      False for the controls themselves of a robot that has an autopilot (the drone's thrusts).
    threads:    that step worlds; default: as many as there are processors for this process.
    device:     "cuda" steps on a GPU, by mujoco-warp in float32 (sim/mujoco_warp.py); states stay tensors of the CPU.
    parameters: names of `parameters_of` that each world has values of its own of: `state["parameters"]` [B, n].
    dumps:      folder for states that led to an unstable simulation; default: terrella-unstable-USER among temporary files.

    Actions are the actuators' controls, in their units. Channels: observation, qpos, qvel, sensor.NAME for each sensor, contacts
    (N on each body, of the normal forces on it), reward, done, those of the task, and of each camera rgb, pose and what is asked
    for. After `done` a world stands still with reward 0. Chance comes from `rng` at `start` alone.
    State (tensors of rows): physics [B, n] float64 is MuJoCo's full physics state, time first, then qpos, qvel, act; warmstart
    [B, nv] of the solver; ctrl [B, nu] of the last step; sensors; done; reward; what the task keeps.
    TerrellaError, a sentence, for files that are missing or broken. Where a simulation is unstable, that world ends, a
    warning says so, and the state before is saved with its action: imagine(state, state["action"], rng) repeats it.
    """

    def __init__(
        self,
        name: str | Path | Robot,
        *,
        task: RobotTask | None = None,
        control_s: float | None = None,
        size: tuple[int, int] = (96, 128),
        cameras: Sequence[str] | None = None,
        depth: bool = False,
        segmentation: bool = False,
        lidar: int | Sequence[int] = 72,
        lidar_m: float = 20.0,
        pilot: bool = True,
        threads: int | None = None,
        device: str = "",
        parameters: Sequence[str] = (),
        dumps: str | Path | None = None,
    ):
        label = name.file if isinstance(name, Robot) else str(name)
        robot = name if isinstance(name, Robot) else None if label.endswith(FILES) else robot_of(label)
        spec = complete(read(label) if robot is None else robot.spec(label), label)
        self._source, self._seen = spec, compiled(spec, label)
        self.file = bare(spec, self._seen, label)
        self.file.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # else it would begin anew in silence
        self.name = f"mujoco:{label}"
        self._steps = max(1, round((control_s or (robot.control_s if robot else 0.02)) / self.file.opt.timestep))
        self._threads, self._device = threads or _cores(), device
        self._dumps, self._dumped = (
            Path(dumps or Path(tempfile.gettempdir()) / f"terrella-unstable-{getpass.getuser()}"),
            0,
        )
        self._home = _home(self.file, robot)
        self.task: RobotTask = task or (robot.task if robot else task_of(spec, label))
        self.body = _body(self.file, self._home, self._steps)
        self._cameras = _cameras(self._seen, cameras)
        self._kinds = ("rgb", *(kind for kind, asked in (("depth", depth), ("segmentation", segmentation)) if asked))
        self._size, self._limit = (int(size[0]), int(size[1])), robot.max_steps if robot else None
        self._pilot = robot.pilot(self.file) if robot and robot.pilot and pilot else None
        self._lidar = Lidar(self.file, lidar, lidar_m) if SITE in {site.name for site in spec.sites} else None
        self._keys, self._units = (dict(robot.keys), robot.units) if robot else ({}, ())
        self.parameters = parameters_of(self._seen)
        self._what = robot.what if robot else f"the model {Path(label).name}"
        self._lock = threading.Lock()
        self._vary(tuple(parameters))

    def _vary(self, names: Sequence[str]) -> None:
        """Lets worlds differ by these parameters, and makes what steps and draws them."""
        checked(self.parameters, names)
        self.varied, changes = tuple(names), [self.parameters[name] for name in names]
        seen = {names.index(name): one for name, one in self.parameters.items() if name in names and one.seen}
        stepped = {at: one for at, one in enumerate(changes) if not one.seen}
        on_gpu = self._device not in ("", "cpu")
        if on_gpu and stepped:
            raise TerrellaError("physics that differs from world to world is for the CPU; leave device out.")
        self._stepper = WarpStepper(self.file, self._device) if on_gpu else Stepper(self.file, stepped, self._threads)
        drawn = patterned(self._source, self.name) if TEXTURES in changes else copy(self._seen)
        self._pictures = MujocoRenderer(drawn, seen, self._size)
        self.spec = self._describe()

    def varying(self, names: Sequence[str]) -> MujocoWorld:
        """The same world, in which these parameters differ from world to world: see `adjusted`."""
        other = copy(self)
        other._lock, other._dumped = threading.Lock(), 0
        other._vary(tuple(names))
        return other

    def adjusted(self, state: State, values: torch.Tensor) -> State:
        """The state with values [B, n] of the parameters that vary. TerrellaError for values that are not safe."""
        for at, name in enumerate(self.varied):
            one, column = self.parameters[name], values[:, at]
            if not ((column >= one.low) & (column <= one.high)).all():
                raise TerrellaError(
                    f"the parameter '{name}' of {self.name} stays within {one.low:g} to {one.high:g} {one.unit}; got "
                    f"{float(column.min()):g} to {float(column.max()):g}."
                )
        return state.replace(parameters=values.double())

    def replaced(self, before: State, state: State, qpos: torch.Tensor, qvel: torch.Tensor) -> State:
        """`state`, to which a step from `before` has led, with other qpos [B, nq] and qvel [B, nv]: sensed and judged anew."""
        physics = state["physics"].clone()
        physics[:, self.body.qpos], physics[:, self.body.qvel] = qpos.double(), qvel.double()
        values = state["parameters"] if self.varied else torch.zeros(state.batch, 0)
        with self._lock:
            _, sensors, _ = self._stepper.step(physics, state["warmstart"], state["ctrl"], values, 1)
        after = {"physics": physics, "sensors": sensors}
        reward, fallen, kept = self.task.judge(self.body, before, {**dict(state.items()), **after})
        over = before["done"]
        return state.replace(**after, **kept, reward=reward.masked_fill(over, 0.0), done=state["done"] | fallen)

    def fingerprint(self) -> str:
        """All that its physics and its task are made of, as text: two worlds of the same text are the same world."""
        return f"MuJoCo {mujoco.__version__}, {self._steps} steps a control step, {self.task}\n{self._source.to_xml()}"

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` worlds at rest, changed as the task has it."""
        if batch < 1:
            raise TerrellaError("start needs a batch of one or more.")
        body, seeds = self.body, chance.seeds(batch, rng)
        physics = torch.zeros(batch, mujoco.mj_stateSize(self.file, _FULL), dtype=torch.float64)
        qpos, qvel = body.home.repeat(batch, 1), torch.zeros(batch, self.file.nv, dtype=torch.float64)
        kept = self.task.begin(body, seeds, qpos, qvel)
        physics[:, body.qpos], physics[:, body.qvel] = qpos, qvel
        ctrl = body.rest.repeat(batch, 1)
        nominal = torch.tensor([self.parameters[name].nominal for name in self.varied], dtype=torch.float64)
        values = nominal.repeat(batch, 1)
        none = torch.zeros(batch, self.file.nv, dtype=torch.float64)
        with self._lock:
            _, sensors, _ = self._stepper.step(physics, none, ctrl, values, 1)  # what is sensed before the first step
        held = {"physics": physics, "warmstart": none, "ctrl": ctrl, "sensors": sensors, **kept}
        held |= {"parameters": values} if self.varied else {}
        return State({**held, "reward": torch.zeros(batch), "done": torch.zeros(batch, dtype=torch.bool)})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A simulator cannot be put into a state from what is seen of it: gives the prior, or a start."""
        if observation:
            raise ObservationError(f"{self.name} is a simulator and takes no evidence; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One control step of all worlds that are not done."""
        if "physics" not in state or state["physics"].shape[1] != mujoco.mj_stateSize(self.file, _FULL):
            raise TerrellaError(f"this is not a state of {self.name}: {state}.")
        ctrl = self.spec.check_action(action, state.batch).double()
        done = state["done"]
        if done.all():
            return state.replace(reward=torch.zeros(state.batch))
        if done.any():
            live = (~done).nonzero()[:, 0]
            return state.replace(reward=torch.zeros(state.batch)).put(live, self._moved(state.at(live), ctrl[live]))
        return self._moved(state, ctrl)

    def _moved(self, state: State, action: torch.Tensor) -> State:
        ctrl = action if self._pilot is None else self._pilot(self.body, state["physics"], action)
        values = state["parameters"] if self.varied else torch.zeros(state.batch, 0)
        with self._lock:
            moved = self._stepper.step(state["physics"], state["warmstart"], ctrl, values, self._steps)
        physics, sensors, warmstart = moved
        wild = ~(physics.isfinite().all(1) & (physics[:, self.body.qvel].abs() < FASTEST).all(1))
        if wild.any():
            self._dump(state.at(wild.nonzero()[:, 0]), action[wild])
            keep = {"physics": state["physics"], "sensors": state["sensors"], "warmstart": state["warmstart"]}
            physics, sensors, warmstart = (
                torch.where(wild[:, None], keep[name], one) for name, one in zip(keep, (physics, sensors, warmstart))
            )
        after = {"physics": physics, "sensors": sensors, "warmstart": warmstart, "ctrl": ctrl}
        reward, fallen, kept = self.task.judge(self.body, state, {**dict(state.items()), **after})
        return state.replace(**after, **kept, reward=reward.masked_fill(wild, 0.0), done=fallen | wild)

    def _dump(self, state: State, action: torch.Tensor) -> None:
        """Saves the states before a simulation became unstable, with the actions; says so."""
        self._dumped += 1
        if self._dumped > MOST_DUMPS:
            return
        stem = "".join(letter if letter.isalnum() else "-" for letter in self.name)
        file = self._dumps / f"{stem}-{os.getpid()}-{self._dumped}.safetensors"
        try:
            self._dumps.mkdir(parents=True, exist_ok=True)
            state.replace(action=action.float()).save(file)
            kept = f"the states before and their actions are in {file}"
        except OSError as error:
            kept = f"the states before could not be saved ({error})"
        warnings.warn(
            f"{state.batch} worlds of {self.name} became unstable at {float(state['physics'][0, 0]):.2f} s and have ended; {kept}: "
            "make the timestep smaller or servos weaker.",
            RuntimeWarning,
            stacklevel=4,
        )

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        drawn = [name for name in channels if kind_of(name) in (*DRAWN, *SCANNED, "pose")]
        found = self._drawn(state, drawn) if drawn else {}
        return {name: found[name] if name in found else self._read(state, name) for name in channels}

    def close(self) -> None:
        self._pictures.close()
        self._stepper.close()

    def _read(self, state: State, name: str) -> torch.Tensor:
        if name in ("reward", "done"):
            return state[name]
        if name in ("qpos", "qvel"):
            return state["physics"][:, getattr(self.body, name)].float()
        if kind_of(name) == "sensor":
            return state["sensors"][:, self.body.sensors[suffix_of(name)]].float()
        return self.task.see(self.body, state, name)

    def _drawn(self, state: State, names: Sequence[str]) -> dict[str, torch.Tensor]:
        """What is worked out world by world: pictures, poses, contacts, LiDAR."""
        found: dict[str, list[np.ndarray]] = {name: [] for name in names}
        physics, ctrl = state["physics"].numpy(), state["ctrl"].numpy()
        values = state["parameters"].numpy() if self.varied else np.zeros((state.batch, 0))
        marks = state[MARKER].numpy() if MARKER in state else [None] * state.batch
        looked = [name for name in names if kind_of(name) not in SCANNED and kind_of(name) != "rgb"]
        with self._lock:
            for name in names:
                if kind_of(name) == "rgb":
                    found[name] = self._pictured(self._camera_of(name), physics, values, marks)
            for row, control, value, mark in zip(physics, ctrl, values, marks):
                if looked:
                    self._pictures.put(row, value, mark)
                for name in names:
                    kind, camera = kind_of(name), self._camera_of(name)
                    if kind == "contacts":
                        found[name].append(self._stepper.contacts(row, control, value))
                    elif kind == SITE and self._lidar:
                        found[name].append(self._lidar.scan(*self._stepper.standing(row, value)))
                    elif kind == "pose":
                        found[name].append(self._pictures.pose(camera))
                    elif kind != "rgb":
                        found[name].append(self._pictures.measure(camera, kind))
        return {name: torch.from_numpy(np.stack(rows)) for name, rows in found.items()}

    def _camera_of(self, channel: str) -> str:
        return suffix_of(channel) or (self._cameras or [""])[0]

    def _pictured(self, camera: str, physics: np.ndarray, values: np.ndarray, marks: Any) -> list[np.ndarray]:
        """What a camera sees of each world, in colour."""
        found: list[np.ndarray] = []
        for at, (row, value, mark) in enumerate(zip(physics, values, marks)):
            self._pictures.put(row, value, mark)
            if self._pictures.draw(camera) or at == len(physics) - 1:
                found += list(self._pictures.read())
        return found

    def _describe(self) -> Spec:
        model, body = self.file, self.body
        suffix = {camera: f".{camera}" if at else "" for at, camera in enumerate(self._cameras)}
        height, width = self._size
        spaces_of = {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, np.inf, (height, width), np.float32),
            "segmentation": spaces.Box(-1, model.nbody, (height, width), np.int32),
        }
        told = self.task.channels(body)
        channels = {name: space for name, (space, _) in told.items()}
        units = {name: unit for name, (_, unit) in told.items() if unit}
        channels |= {"qpos": numbers(model.nq), "qvel": numbers(model.nv)}
        channels |= {f"sensor.{name}": numbers(at.stop - at.start) for name, at in body.sensors.items()}
        channels |= {"contacts": numbers(model.nbody), "done": DONE}
        channels |= {"reward": REWARD} if self.task.rewards else {}
        if self._lidar:
            channels[SITE], units[SITE] = spaces.Box(0, self._lidar.range_m, self._lidar.shape, np.float32), "m"
        for end in suffix.values():
            channels |= {f"{kind}{end}": spaces_of[kind] for kind in self._kinds} | {f"pose{end}": POSE}
            units |= {f"pose{end}": POSE_UNIT} | ({f"depth{end}": "m"} if "depth" in self._kinds else {})
        cameras = {f"rgb{end}": lens(self._seen, camera, self._size, f"pose{end}") for camera, end in suffix.items()}
        return Spec(
            name=self.name,
            **self._acts(),
            channels=channels,
            observes=(),
            dt_s=self._steps * float(model.opt.timestep),
            units=units | {"contacts": "N"},
            # Where lenses vary from world to world, none is told: pictures of a false one would mislead whoever trusts it.
            cameras={} if "camera.fov" in self.varied else cameras,
            max_episode_steps=self._limit,
            card={
                "what": self._what, "kind": "simulator", "physics": _told(model, self._steps), "varied": list(self.varied),
                "together": True,
            },
        )  # fmt: skip

    def _acts(self) -> dict[str, Any]:
        """What the Spec says of actions: the pilot's, or the actuators' controls."""
        model, body, pilot = self.file, self.body, self._pilot
        if pilot is not None:
            high = np.array(pilot.high, np.float32)
            named = {
                "action_names": pilot.names,
                "action_units": pilot.units,
                "action_mode": "velocity",
                "action_frame": "body",
            }
            return {"action": spaces.Box(-high, high), "keys": dict(pilot.keys), "idle": (0.0,) * len(high), **named}
        low, high = (limit.numpy().astype(np.float32) for limit in (body.low, body.high))
        return {
            "action": spaces.Box(low, high),
            "action_names": tuple(model.actuator(at).name or f"actuator {at + 1}" for at in range(model.nu)),
            "action_units": self._units or tuple(_unit(model, at) for at in range(model.nu)),
            "action_mode": _mode(model),
            "keys": self._keys,
            "idle": tuple(body.rest.float().tolist()),
        }


def _cores() -> int:
    """Of this machine, those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _home(model: mujoco.MjModel, robot: Robot | None) -> tuple[np.ndarray, np.ndarray]:
    """qpos [nq] and ctrl [nu] at rest: the robot's pose, the file's first keyframe, or as it is built."""
    qpos, ctrl = (model.key_qpos[0], model.key_ctrl[0]) if model.nkey else (model.qpos0, np.zeros(model.nu))
    qpos, ctrl = qpos.copy(), ctrl.copy()
    if robot is not None and robot.pose:
        for at in range(model.njnt):
            if model.jnt_type[at] not in (int(FREE), int(BALL)):
                qpos[model.jnt_qposadr[at]] = robot.rest(model.joint(at).name)
    if robot is not None and robot.height is not None:
        qpos[2] = robot.height
    servo = (model.actuator_biasprm[:, 1] < 0) & (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    for at in np.flatnonzero(servo):
        if not model.nkey:
            ctrl[at] = qpos[model.jnt_qposadr[model.actuator_trnid[at, 0]]]
    return qpos, ctrl


def _body(model: mujoco.MjModel, home: tuple[np.ndarray, np.ndarray], steps: int) -> RobotLayout:
    limited = model.actuator_ctrllimited.astype(bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(limited, model.actuator_ctrlrange[:, 1], 1.0)
    rest = np.clip(home[1], low, high)
    ends = 1 + model.nq, 1 + model.nq + model.nv
    sensors = {
        model.sensor(at).name or f"sensor{at + 1}": slice(
            int(model.sensor_adr[at]), int(model.sensor_adr[at] + model.sensor_dim[at])
        )
        for at in range(model.nsensor)
    }
    own = (model.jnt_type != int(FREE)) & (model.jnt_type != int(BALL))
    hinges = torch.from_numpy(model.jnt_qposadr[own]).long(), torch.from_numpy(model.jnt_dofadr[own]).long()
    plain = (torch.from_numpy(np.asarray(part, np.float64)) for part in (home[0], rest, low, high))
    at_home, at_rest, lowest, highest = plain
    return RobotLayout(
        slice(1, ends[0]),
        slice(*ends),
        hinges,
        at_home,
        at_rest,
        lowest,
        highest,
        sensors,
        steps * float(model.opt.timestep),
    )


def _cameras(model: mujoco.MjModel, asked: Sequence[str] | None) -> list[str]:
    known = [model.camera(at).name for at in range(model.ncam) if model.camera(at).name]
    strangers = sorted(set(asked or ()) - set(known))
    if strangers:
        raise TerrellaError(f"there is no camera {', '.join(strangers)}; there are {', '.join(known)}.")
    return known[:1] if asked is None else list(asked)


def _unit(model: mujoco.MjModel, at: int) -> str:
    """Of a control: rad, rad/s or N m of hinges, m, m/s or N of slides; "" of what has no unit of its own."""
    joint = model.actuator_trnid[at, 0]
    if model.actuator_trntype[at] != int(mujoco.mjtTrn.mjTRN_JOINT):
        return ""
    slides = model.jnt_type[joint] == int(SLIDE)
    position, velocity = model.actuator_biasprm[at, 1] < 0, model.actuator_biasprm[at, 2] < 0
    if position or velocity:
        return ("m" if slides else "rad") + ("" if position else "/s")
    gear = abs(float(model.actuator_gear[at, 0] * model.actuator_gainprm[at, 0]))
    force = "N" if slides else "N m"
    return force if gear == 1 else f"{gear:g} {force}"


def _mode(model: mujoco.MjModel) -> str:
    servo = model.actuator_biasprm[:, 1] < 0
    if model.nu and servo.all():
        return "position"
    return "axes" if servo.any() or (model.actuator_biasprm[:, 2] < 0).any() else "torque"


def _told(model: mujoco.MjModel, steps: int) -> str:
    """What a figure of speed means: step, decimation, integrator, solver, cone."""
    integrator = mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
    solver, cone = mujoco.mjtSolver(model.opt.solver).name, mujoco.mjtCone(model.opt.cone).name
    kinds = f"{integrator}, {solver.removeprefix('mjSOL_')}, {cone.removeprefix('mjCONE_')} cone"
    return f"steps of {1e3 * model.opt.timestep:g} ms, {steps} a control step, {kinds}".lower()
