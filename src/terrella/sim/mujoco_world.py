"""MujocoWorld: thousands of worlds of one MuJoCo model in one State, stepped in parallel by `mujoco.rollout` on CPU threads."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import getpass
import os
import tempfile
import threading
import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.backend import constant
from ..core.errors import ObservationError, TerrellaError
from ..core.spec import DONE, POSE, POSE_UNIT, REWARD, Spec, kind_of, suffix_of
from ..core.state import State
from .mujoco_appearance import patterned
from .mujoco_controls import control_mode, control_name, control_unit, controls_of
from .mujoco_layout import layout_of, pose_at_rest
from .mujoco_lidar import SITE, Lidar
from .mujoco_model import bare, compiled, complete, mujoco, read
from .mujoco_parameters import TEXTURES, checked, parameters_of
from .mujoco_renderer import MujocoRenderer, lens
from .mujoco_robots import Robot, robot_of
from .mujoco_stepping import Stepper
from .mujoco_system import system_of
from .mujoco_tasks import MARKER, RobotTask, numbers, task_of
from .mujoco_warp import WarpStepper, torch_device

FILES = (".xml", ".mjcf", ".urdf")
MAX_SPEED = 1e4  # m/s or rad/s; a faster world is unstable
MAX_DUMPS = 8
DRAWN, SCANNED = ("rgb", "depth", "segmentation"), ("contacts", SITE)
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class MujocoConfig:
    """The settings of a MujocoWorld."""

    # Reward and termination (sim/mujoco_tasks.py), or the name of one of the robot's tasks: "road" or "road:SEED" of the car.
    # Default: the robot's own, or the one that the file declares.
    task: RobotTask | str | None = None
    # Seconds of a control step, rounded to physics steps. Default: the robot's own, else 0.02.
    control_s: float | None = None
    # (height, width) of pictures. Default: the robot's own, else 96 x 128.
    size: tuple[int, int] | None = None
    # Names of cameras of the model: the first is `rgb`, others are `rgb.NAME`. Default: the robot's own, else the model's first; ()
    # for none.
    cameras: Sequence[str] | None = None
    # Show depth for each camera.
    depth: bool = False
    # Show segmentation for each camera.
    segmentation: bool = False
    # Rays per turn, or (rows, rays), of a LiDAR at the site named "lidar".
    lidar: int | Sequence[int] = 72
    # Range of the LiDAR, m.
    lidar_m: float = 20.0
    # False: actions are the actuators' controls, even if the robot has an autopilot (the drone).
    pilot: bool = True
    # Threads that step worlds. Default: the processors of this process.
    threads: int | None = None
    # "cuda" steps on a GPU with mujoco-warp in float32 (sim/mujoco_warp.py), where states stay; "warp:cpu" does so on a CPU, for
    # tests.
    device: str = ""
    # Names in `parameters_of` whose values differ between worlds: `state["parameters"]` [B, n].
    parameters: Sequence[str] = ()
    # Folder for states before an unstable step. Default: terrella-unstable-USER in the temporary folder.
    dumps: str | Path | None = None


class MujocoWorld:
    """`MujocoWorld("go1")`, a ready robot (sim/mujoco_robots.py), or `MujocoWorld("FILE.xml")`, an MJCF or URDF file.

    Actions are the actuators' controls, in their units, or one, to wait, where there is no actuator. Channels: observation, qpos,
    qvel, sensor.NAME for each sensor, contacts (the sum of normal forces on each body, N), reward, done, those of the task, and
    rgb, pose, depth and segmentation of each camera. After `done` a world stands still with reward 0. Only `start` uses `rng`.

    State, all [B, ...]: physics float64 is MuJoCo's full physics state (time, qpos, qvel, act); warmstart [B, nv] of the solver;
    ctrl [B, nu] of the last step; sensors; done; reward; the tensors of the task.

    TerrellaError for missing or broken files. An unstable world ends with a warning, and the state before is saved with its
    action: imagine(state, state["action"], rng) repeats the step.

    On a device all tensors lie there and numbers are float32. Nothing waits for a value: actions are not checked, and an unstable
    world just ends.
    """

    def __init__(self, name: str | Path | Robot, config: MujocoConfig = MujocoConfig()):
        label = name.file if isinstance(name, Robot) else str(name)
        robot = name if isinstance(name, Robot) else None if label.endswith(FILES) else robot_of(label)
        self._embodiment = f"mujoco:{label}"
        task = config.task
        if isinstance(task, str):
            if robot is None:
                raise TerrellaError(f"only ready robots have tasks by name; {label} declares its own.")
            label, robot, task = f"{label}:{task}", robot.with_task(task), None
        spec = complete(read(label) if robot is None else robot.spec(label), label)
        self._source, self._seen = spec, compiled(spec, label)
        self.file = bare(spec, self._seen, label)
        # otherwise an unstable simulation would restart without a warning
        self.file.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.name = f"mujoco:{label}"
        self._steps = max(1, round((config.control_s or (robot.control_s if robot else 0.02)) / self.file.opt.timestep))
        self._threads, self._device = config.threads or _cores(), "" if config.device == "cpu" else config.device
        self.device, self._dtype = torch_device(self._device), torch.float32 if self._device else torch.float64
        self._dumped = 0
        self._dumps = Path(config.dumps or Path(tempfile.gettempdir()) / f"terrella-unstable-{getpass.getuser()}")
        home = pose_at_rest(self.file, robot)
        self._controls = controls_of(self.file, home)
        self.task: RobotTask = task or (robot.task if robot else task_of(spec, label))
        self.layout = layout_of(self.file, home, self._controls, self._steps).to(self.device, self._dtype)
        wanted = config.cameras if config.cameras is not None or robot is None else robot.cameras or None
        self._cameras = _cameras(self._seen, wanted)
        shown = (("depth", config.depth), ("segmentation", config.segmentation))
        self._kinds = ("rgb", *(kind for kind, wanted in shown if wanted))
        height, width = config.size or (robot.size if robot else (96, 128))
        self._size, self._limit = (int(height), int(width)), robot.max_steps if robot else None
        self._pilot = robot.pilot(self.file) if robot and robot.pilot and config.pilot else None
        has_lidar = SITE in {site.name for site in spec.sites}
        self._lidar = Lidar(self.file, config.lidar, config.lidar_m) if has_lidar else None
        self._keys, self._units = (dict(robot.keys), robot.units) if robot else ({}, ())
        self._hides = robot.hides if robot else ()
        self.parameters = parameters_of(self._seen)
        system = system_of(self.file)
        self._system = system.to_json() if system else {}
        self._what = robot.what if robot else f"the model {Path(label).name}"
        self._lock = threading.Lock()
        self._vary(tuple(config.parameters))

    def named(self, name: str, max_steps: int) -> MujocoWorld:
        """The same world under another name, with a limit of steps."""
        other = copy(self)
        other.name, other._limit, other._lock = name, max_steps, threading.Lock()
        other.spec = other._describe()
        return other

    def _vary(self, names: Sequence[str]) -> None:
        """Makes these parameters differ between worlds, and builds the stepper and the renderer for them."""
        checked(self.parameters, names)
        self.varied, changes = tuple(names), [self.parameters[name] for name in names]
        seen = {names.index(name): one for name, one in self.parameters.items() if name in names and one.seen}
        stepped = {at: one for at, one in enumerate(changes) if not one.seen}
        if self._device:
            self._check_device(stepped)
            self._stepper = WarpStepper(self.file, self._device)
        else:
            self._stepper = Stepper(self.file, stepped, self._threads)
        drawn = patterned(self._source, self.name) if TEXTURES in changes else copy(self._seen)
        self._renderer = MujocoRenderer(drawn, seen, self._size)
        self.spec = self._describe()

    def _check_device(self, stepped: Mapping[int, Any]) -> None:
        """TerrellaError for what needs the CPU."""
        task = type(self.task).__name__
        lacks = ["physics that differs between worlds"] if stepped else []
        lacks += [f"the task {task}"] if not getattr(self.task, "on_device", False) else []
        lacks += ["the autopilot"] if self._pilot is not None else []
        if lacks:
            raise TerrellaError(f"{' and '.join(lacks)} of {self.name} needs the CPU; leave device out.")

    def varying(self, names: Sequence[str]) -> MujocoWorld:
        """The same world with these parameters differing between the worlds of a batch: see `adjusted`."""
        other = copy(self)
        other._lock, other._dumped = threading.Lock(), 0
        other._vary(tuple(names))
        return other

    def adjusted(self, state: State, values: torch.Tensor) -> State:
        """The state with these values [B, n] of the varying parameters. TerrellaError for unsafe values."""
        for at, name in enumerate(self.varied):
            one, column = self.parameters[name], values[:, at]
            if not ((column >= one.low) & (column <= one.high)).all():
                raise TerrellaError(
                    f"the parameter '{name}' of {self.name} must be within {one.low:g} to {one.high:g} {one.unit}; got "
                    f"{float(column.min()):g} to {float(column.max()):g}."
                )
        return state.replace(parameters=values.to(self.device, torch.float64))

    def with_joints(self, before: State, state: State, qpos: torch.Tensor, qvel: torch.Tensor) -> State:
        """`state`, the result of a step from `before`, with qpos [B, nq] and qvel [B, nv] replaced; sensors, reward and done are
        computed again."""
        physics = state["physics"].clone()
        physics[:, self.layout.qpos], physics[:, self.layout.qvel] = qpos.to(physics), qvel.to(physics)
        values = state["parameters"] if self.varied else torch.zeros(state.batch, 0)
        with self._lock:
            _, sensors, _ = self._stepper.step(physics, state["warmstart"], state["ctrl"], values, 1)
        after = {"physics": physics, "sensors": sensors}
        reward, fallen, kept = self.task.evaluate(self.layout, before, {**dict(state.items()), **after})
        reward = reward.masked_fill(before["done"], 0.0)
        return state.replace(**{**after, **kept}, reward=reward, done=state["done"] | fallen)

    def fingerprint(self) -> str:
        """The model, the task and the version of MuJoCo as text: worlds with the same text are the same world."""
        engine = "MuJoCo Warp with " * bool(self._device)
        return f"{engine}MuJoCo {mujoco.__version__}, {self._steps} steps a control step, {self.task}\n{self._source.to_xml()}"

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` worlds at rest, changed by the task's initialisation."""
        if batch < 1:
            raise TerrellaError(f"start needs a batch of 1 or more; got {batch}.")
        layout, seeds = self.layout, chance.seeds(batch, rng, self.device)
        physics = layout.home.new_zeros(batch, mujoco.mj_stateSize(self.file, _FULL))
        qpos, qvel = layout.home.repeat(batch, 1), physics.new_zeros(batch, self.file.nv)
        kept = self.task.initialise(layout, seeds, qpos, qvel)
        physics[:, layout.qpos], physics[:, layout.qvel] = qpos, qvel
        physics[:, layout.qvel.stop : layout.qvel.stop + self.file.na] = constant(
            _numbers, self.device, *self._controls.act
        )
        ctrl = layout.rest.repeat(batch, 1)
        nominal = constant(_numbers, self.device, *(float(self.parameters[name].nominal) for name in self.varied))
        values = nominal.repeat(batch, 1)
        none = torch.zeros_like(qvel)
        with self._lock:
            _, sensors, _ = self._stepper.step(physics, none, ctrl, values, 1)  # the sensors before the first step
        held = {"physics": physics, "warmstart": none, "ctrl": ctrl, "sensors": sensors, **kept}
        held |= {"parameters": values} if self.varied else {}
        reward = torch.zeros(batch, device=self.device)
        return State({**held, "reward": reward, "done": torch.zeros_like(reward, dtype=torch.bool)})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The prior, or a start: a simulator cannot be set from an observation."""
        if observation:
            raise ObservationError(f"{self.name} is a simulator and accepts no observation; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One control step of every world that is not done."""
        if "physics" not in state or state["physics"].shape[1] != mujoco.mj_stateSize(self.file, _FULL):
            raise TerrellaError(f"this is not a state of {self.name}: {state}.")
        done = state["done"]
        if self._device:
            given = action.to(self.device) if torch.is_tensor(action) else action
            after = self._stepped(state, self.spec.check_action(given, state.batch).to(self._dtype))
            return after.mixed(done, state).replace(reward=after["reward"].masked_fill(done, 0.0))
        ctrl = self.spec.check_action(action, state.batch).double()
        if done.all():
            return state.replace(reward=torch.zeros(state.batch))
        if done.any():
            live = (~done).nonzero()[:, 0]
            return state.replace(reward=torch.zeros(state.batch)).put(live, self._stepped(state.at(live), ctrl[live]))
        return self._stepped(state, ctrl)

    def _stepped(self, state: State, action: torch.Tensor) -> State:
        values = state["parameters"] if self.varied else torch.zeros(state.batch, 0)
        with self._lock:
            ctrl = action if self._pilot is None else self._pilot(self.layout, state, action)
            ctrl = ctrl if self.file.nu else state["ctrl"]
            result = self._stepper.step(state["physics"], state["warmstart"], ctrl, values, self._steps)
        physics, sensors, warmstart = result
        unstable = ~(physics.isfinite().all(1) & (physics[:, self.layout.qvel].abs() < MAX_SPEED).all(1))
        if self._device or unstable.any():
            if not self._device:
                self._dump(state.at(unstable.nonzero()[:, 0]), action[unstable])
            keep = {"physics": state["physics"], "sensors": state["sensors"], "warmstart": state["warmstart"]}
            physics, sensors, warmstart = (
                torch.where(unstable[:, None], keep[name], one)
                for name, one in zip(keep, (physics, sensors, warmstart))
            )
        after = {"physics": physics, "sensors": sensors, "warmstart": warmstart, "ctrl": ctrl}
        reward, fallen, kept = self.task.evaluate(self.layout, state, {**dict(state.items()), **after})
        return state.replace(**{**after, **kept}, reward=reward.masked_fill(unstable, 0.0), done=fallen | unstable)

    def _dump(self, state: State, action: torch.Tensor) -> None:
        """Saves the states before an unstable step with their actions, and warns."""
        self._dumped += 1
        if self._dumped > MAX_DUMPS:
            return
        stem = "".join(letter if letter.isalnum() else "-" for letter in self.name)
        file = self._dumps / f"{stem}-{os.getpid()}-{self._dumped}.safetensors"
        try:
            self._dumps.mkdir(parents=True, exist_ok=True)
            state.replace(action=action.float()).save(file)
            kept = f"the previous states and their actions are in {file}"
        except OSError as error:
            kept = f"the previous states could not be saved ({error})"
        warnings.warn(
            f"{state.batch} worlds of {self.name} became unstable at {float(state['physics'][0, 0]):.2f} s and have ended; {kept}: "
            "use a smaller timestep or weaker servos.",
            RuntimeWarning,
            stacklevel=4,
        )

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        single = [name for name in channels if kind_of(name) in (*DRAWN, *SCANNED, "pose")]
        rendered = self._rendered(state, single) if single else {}
        return {name: rendered[name] if name in rendered else self._read(state, name) for name in channels}

    def close(self) -> None:
        self._renderer.close()
        self._stepper.close()

    def _read(self, state: State, name: str) -> torch.Tensor:
        if name in ("reward", "done"):
            return state[name]
        if name in ("qpos", "qvel"):
            return state["physics"][:, getattr(self.layout, name)].float()
        if kind_of(name) == "sensor":
            return state["sensors"][:, self.layout.sensors[suffix_of(name)]].float()
        return self.task.render(self.layout, state, name)

    def _rendered(self, state: State, names: Sequence[str]) -> dict[str, torch.Tensor]:
        """Channels that are computed world by world: pictures, poses, contacts, LiDAR."""
        rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
        physics, ctrl = (state[name].double().cpu().numpy() for name in ("physics", "ctrl"))
        values = state["parameters"].cpu().numpy() if self.varied else np.zeros((state.batch, 0))
        markers = state[MARKER].cpu().numpy() if MARKER in state else [None] * state.batch
        posed = [name for name in names if kind_of(name) not in SCANNED and kind_of(name) != "rgb"]
        with self._lock:
            for name in names:
                if kind_of(name) == "rgb":
                    rows[name] = self._coloured(self._camera_of(name), physics, values, markers)
            for row, control, value, marker in zip(physics, ctrl, values, markers):
                if posed:
                    self._renderer.set_world(row, value, marker)
                for name in names:
                    kind, camera = kind_of(name), self._camera_of(name)
                    if kind == "contacts":
                        rows[name].append(self._stepper.contacts(row, control, value))
                    elif kind == SITE and self._lidar:
                        rows[name].append(self._lidar.scan(*self._stepper.placed(row, value)))
                    elif kind == "pose":
                        rows[name].append(self._renderer.pose(camera))
                    elif kind != "rgb":
                        rows[name].append(self._renderer.measure(camera, kind))
        return {name: torch.from_numpy(np.stack(values)).to(self.device) for name, values in rows.items()}

    def _camera_of(self, channel: str) -> str:
        return suffix_of(channel) or (self._cameras or [""])[0]

    def _coloured(self, camera: str, physics: np.ndarray, values: np.ndarray, markers: Any) -> list[np.ndarray]:
        """The colour picture of each world from a camera."""
        pictures: list[np.ndarray] = []
        for at, (row, value, marker) in enumerate(zip(physics, values, markers)):
            self._renderer.set_world(row, value, marker)
            if self._renderer.draw(camera) or at == len(physics) - 1:
                pictures += list(self._renderer.read())
        return pictures

    def _describe(self) -> Spec:
        model, layout = self.file, self.layout
        suffix = {camera: f".{camera}" if at else "" for at, camera in enumerate(self._cameras)}
        height, width = self._size
        spaces_of = {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, np.inf, (height, width), np.float32),
            "segmentation": spaces.Box(-1, model.nbody, (height, width), np.int32),
        }
        own = self.task.channels(layout)
        channels = {name: space for name, (space, _) in own.items()}
        units = {name: unit for name, (_, unit) in own.items() if unit}
        channels |= {"qpos": numbers(model.nq), "qvel": numbers(model.nv)}
        channels |= {f"sensor.{name}": numbers(at.stop - at.start) for name, at in layout.sensors.items()}
        channels |= {"contacts": numbers(model.nbody), "done": DONE}
        channels |= {"reward": REWARD} if self.task.rewards else {}
        if self._lidar:
            channels[SITE], units[SITE] = spaces.Box(0, self._lidar.range_m, self._lidar.shape, np.float32), "m"
        for end in suffix.values():
            channels |= {f"{kind}{end}": spaces_of[kind] for kind in self._kinds} | {f"pose{end}": POSE}
            units |= {f"pose{end}": POSE_UNIT} | ({f"depth{end}": "m"} if "depth" in self._kinds else {})
        channels = {name: space for name, space in channels.items() if kind_of(name) not in self._hides}
        lenses = {camera: lens(self._seen, camera, self._size, f"pose{end}") for camera, end in suffix.items()}
        cameras = {f"rgb{suffix[camera]}": one for camera, one in lenses.items() if one is not None}
        notes = [f"camera {name} is no pinhole: it has no intrinsics" for name, one in lenses.items() if one is None]
        if chosen := self._controls.chosen:
            notes.append(f"limits of controls that the file does not state: {', '.join(chosen)}")
        if clipped := self._controls.clipped:
            notes.append(f"controls of the pose at rest beyond the file's limits, which hold: {', '.join(clipped)}")
        return Spec(
            name=self.name,
            **self._action_fields(),
            channels=channels,
            observes=(),
            dt_s=self._steps * float(model.opt.timestep),
            units={name: unit for name, unit in (units | {"contacts": "N"}).items() if name in channels},
            # Where the field of view differs between worlds, the Spec has no intrinsics, because one set would be wrong.
            cameras={} if "camera.fov" in self.varied else cameras,
            max_episode_steps=self._limit,
            system=self._system,
            embodiment=self._embodiment,
            card={
                "what": self._what, "kind": "simulator", "physics": _physics_text(model, self._steps), "varied": list(self.varied),
                "together": True, **({"notes": notes} if notes else {}),
            },
        )  # fmt: skip

    def _action_fields(self) -> dict[str, Any]:
        """The action fields of the Spec: the pilot's, or the actuators' controls."""
        model, limits, pilot = self.file, self._controls, self._pilot
        if pilot is not None:
            high = np.array(pilot.high, np.float32)
            named = {
                "action_names": pilot.names,
                "action_units": pilot.units,
                "action_mode": "velocity",
                "action_frame": pilot.frame,
            }
            return {"action": spaces.Box(-high, high), "keys": dict(pilot.keys), "idle": (0.0,) * len(high), **named}
        if not model.nu:
            return {"action": spaces.Discrete(1), "action_names": ("wait",), "keys": {}}
        low, high, rest = (np.asarray(limit, np.float32) for limit in (limits.low, limits.high, limits.rest))
        return {
            "action": spaces.Box(low, high),
            "action_names": tuple(control_name(model, at) for at in range(model.nu)),
            "action_units": self._units or tuple(control_unit(model, at) for at in range(model.nu)),
            "action_mode": control_mode(model),
            "keys": self._keys,
            "idle": tuple(rest.tolist()),
        }


def _numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _cores() -> int:
    """The number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cameras(model: mujoco.MjModel, wanted: Sequence[str] | None) -> list[str]:
    known = [model.camera(at).name for at in range(model.ncam) if model.camera(at).name]
    unknown = sorted(set(wanted or ()) - set(known))
    if unknown:
        raise TerrellaError(f"there is no camera {', '.join(unknown)}; there are {', '.join(known)}.")
    return known[:1] if wanted is None else list(wanted)


def _physics_text(model: mujoco.MjModel, steps: int) -> str:
    """The settings that a simulation speed depends on: step, decimation, integrator, solver, cone."""
    integrator = mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
    solver, cone = mujoco.mjtSolver(model.opt.solver).name, mujoco.mjtCone(model.opt.cone).name
    kinds = f"{integrator}, {solver.removeprefix('mjSOL_')}, {cone.removeprefix('mjCONE_')} cone"
    return f"steps of {1e3 * model.opt.timestep:g} ms, {steps} a control step, {kinds}".lower()
