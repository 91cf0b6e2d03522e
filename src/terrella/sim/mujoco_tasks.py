"""Tasks of MuJoCo robots: initial states, reward, termination and observations, for whole batches at once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from ..core import chance
from ..core.backend import constant, table
from ..core.errors import TerrellaError
from ..core.similar import did_you_mean

Tensors = Mapping[str, Tensor]
Evaluation = tuple[Tensor, Tensor, dict[str, Tensor]]  # reward [B], terminated bool [B], the task's tensors
Spaces = dict[str, tuple[spaces.Space, str]]  # channel -> (space, unit)
_START, _GOAL = 1, 2  # streams of random numbers
MARKER = "marker"  # optional tensor of a state: a point [B, 3], m, that is rendered as a ball


@dataclass(frozen=True)
class RobotLayout:
    """Where a robot's quantities are in the state, its rest pose and its limits."""

    qpos: slice  # columns of the physics state
    qvel: slice
    hinges: tuple[Tensor, Tensor]  # indices in qpos and in qvel of hinges and slides, without free and ball joints
    home: Tensor  # qpos [nq] at rest
    rest: Tensor  # ctrl [nu] at rest
    low: Tensor  # limits of ctrl [nu]
    high: Tensor
    sensors: Mapping[str, slice]  # sensor -> columns of the sensor data
    step_s: float  # seconds of a control step

    def to(self, device: torch.device, dtype: torch.dtype) -> "RobotLayout":
        """The same on a device, for states of a type."""
        own, place = self.hinges
        numbers = {name: getattr(self, name).to(device, dtype) for name in ("home", "rest", "low", "high")}
        return replace(self, hinges=(own.to(device), place.to(device)), **numbers)


class RobotTask(Protocol):
    """channels: those that `render` shows; initialise: changes the initial qpos [B, nq] and qvel [B, nv] in place and returns the
    task's own tensors of the state; evaluate: reward, termination and the task's tensors after a step. A task whose `on_device` is
    True computes where the state lies, in its type; another on the CPU in float64."""

    rewards: bool  # whether `reward` is a channel

    def channels(self, layout: RobotLayout) -> Spaces: ...
    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]: ...
    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation: ...
    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor: ...


class Free:
    """No task: the robot starts as in its file, and observes qpos, qvel and its sensors."""

    rewards, on_device = False, True

    def __repr__(self) -> str:  # of a world's fingerprint
        return "Free()"

    def channels(self, layout: RobotLayout) -> Spaces:
        width = (
            len(layout.home)
            + layout.qvel.stop
            - layout.qvel.start
            + sum(at.stop - at.start for at in layout.sensors.values())
        )
        return {"observation": (numbers(width), "")}

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        return {}

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        reward = torch.zeros(len(after["physics"]), device=after["physics"].device)
        return reward, torch.zeros_like(reward, dtype=torch.bool), {}

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        physics = state["physics"]
        return torch.cat([physics[:, layout.qpos], physics[:, layout.qvel], state["sensors"]], 1).float()


@dataclass(frozen=True)
class VelocityTracking:
    """A free body follows a commanded velocity (Rudin et al. 2021, "Learning to walk in minutes"). `command` is forward and
    sideways in m/s and turning in rad/s, in the body's frame, drawn uniformly within these limits when an episode starts."""

    rewards, on_device = True, True
    forward: tuple[float, float] = (0.3, 1.0)  # m/s
    sideways: tuple[float, float] = (0.0, 0.0)  # m/s
    turning: tuple[float, float] = (-0.5, 0.5)  # rad/s
    fallen: tuple[float, float] = (
        1.0,
        0.55,
    )  # the episode ends at this tilt, rad, or below this share of the height at rest
    noise: float = 0.1  # of the initial joints and speeds, rad and rad/s
    weights: Mapping[str, float] = field(
        default_factory=lambda: {
            "alive": 0.4, "velocity": 1.5, "slow": 0.5, "turning": 0.75, "bounce": 0.5, "roll": 0.02, "tilt": 1.0, "jerk": 0.03,
            "pose": 0.05,
        }
    )  # fmt: skip

    def channels(self, layout: RobotLayout) -> Spaces:
        if len(layout.home) < 7 or len(layout.home) != layout.qvel.stop - layout.qvel.start + 1:
            raise TerrellaError(
                "velocity tracking needs a free body: the first joint of the file must be a free joint."
            )
        return {
            "observation": (
                numbers(12 + len(layout.home) - 7 + layout.qvel.stop - layout.qvel.start - 6 + len(layout.rest)),
                "",
            ),
            "command": (numbers(3), "m/s, m/s, rad/s"),
            "velocity": (numbers(3), "m/s, m/s, rad/s"),
        }

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        joints = qpos.shape[1] - 7
        drawn = 2 * chance.uniform(seeds, (joints + qvel.shape[1] + 1,), _START).to(qpos) - 1
        qpos[:, 7:] += self.noise * drawn[:, :joints]
        qvel += self.noise * drawn[:, joints:-1]
        half = torch.pi / 2 * drawn[:, -1]
        heading = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
        qpos[:, 3:7] = quaternion_product(heading, qpos[:, 3:7])
        limits = constant(table, seeds.device, self.forward, self.sideways, self.turning)
        command = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * chance.uniform(seeds, (3,), _GOAL)
        return {"command": command}

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        height, tilt = self.fallen[1], self.fallen[0]
        up, qpos = motion(layout, after["physics"])[2], after["physics"][:, layout.qpos]
        fallen = (up[:, 2] < float(np.cos(tilt))) | (qpos[:, 2] < height * layout.home[2])
        return self._reward(layout, before, after).clamp_min(0.0).float(), fallen, {"command": after["command"]}

    def _reward(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Tensor:
        """The reward of a step [B], before clamping."""
        physics, command, weights = after["physics"], after["command"], self.weights
        qpos, (velocity, spin, up) = physics[:, layout.qpos], motion(layout, physics)
        velocity_error = (velocity[:, :2] - command[:, :2]).square().sum(1)
        turning_error = (spin[:, 2] - command[:, 2]).square()
        half_range = (layout.high - layout.low) / 2
        jerk = ((after["ctrl"] - before["ctrl"]) / half_range).square().sum(1)
        return (
            weights["alive"] + weights["velocity"] * torch.exp(-velocity_error / 0.25) - weights["slow"] * velocity_error.sqrt()
            + weights["turning"] * torch.exp(-turning_error / 0.25)
            - weights["bounce"] * velocity[:, 2].square() - weights["roll"] * spin[:, :2].square().sum(1)
            - weights["tilt"] * up[:, :2].square().sum(1) - weights["jerk"] * jerk
            - weights["pose"] * (qpos[:, 7:] - layout.home[7:]).square().sum(1)
        )  # fmt: skip

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        if name == "command":
            return state["command"]
        velocity, spin, up = motion(layout, state["physics"])
        if name == "velocity":
            return torch.cat([velocity[:, :2], spin[:, 2:]], 1).float()
        qpos, qvel = state["physics"][:, layout.qpos], state["physics"][:, layout.qvel]
        control = (state["ctrl"] - layout.rest) / ((layout.high - layout.low) / 2)
        joints = qpos[:, 7:] - layout.home[7:]
        return torch.cat([velocity, spin, up, state["command"], joints, 0.1 * qvel[:, 6:], control], 1).float()


@dataclass(frozen=True)
class Stepping(VelocityTracking):
    """Velocity tracking with a periodic gait, whose phase is observed (Siekmann et al. 2021, "Sim-to-real learning of all common
    bipedal gaits via periodic reward composition")."""

    # Site of each foot, with sensors foot_SITE, place_SITE and speed_SITE -> its phase offset, as a share of the period.
    feet: Mapping[str, float] = field(default_factory=lambda: {"left_foot": 0.0, "right_foot": 0.5})
    period_s: float = 0.8
    standing: float = 0.55  # share of the period in stance
    lift_m: float = 0.08  # height of a foot in swing
    straight: tuple[int, ...] = (1, 2, 7, 8)  # joints that should stay at rest, as columns after the free joint

    def channels(self, layout: RobotLayout) -> Spaces:
        channels = super().channels(layout)
        wanted = [f"{kind}_{foot}" for foot in self.feet for kind in ("foot", "place", "speed")]
        if missing := [name for name in wanted if name not in layout.sensors]:
            raise TerrellaError(
                f"the task needs sensors that the file lacks: {', '.join(missing)} (touch, framepos, framelinvel)."
            )
        return channels | {"observation": (numbers(channels["observation"][0].shape[0] + 2), "")}

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        value = super().render(layout, state, name)
        if name != "observation":
            return value
        angle = 2 * torch.pi * self._phase(state)
        return torch.cat([value, angle.sin()[:, None], angle.cos()[:, None]], 1).float()

    def _phase(self, state: Tensors) -> Tensor:
        return (state["physics"][:, 0] / self.period_s).remainder(1.0)

    def _reward(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Tensor:
        reward, sensors, phase = super()._reward(layout, before, after), after["sensors"], self._phase(after)
        for foot, offset in self.feet.items():
            load, place, speed = (sensors[:, layout.sensors[f"{kind}_{foot}"]] for kind in ("foot", "place", "speed"))
            contact, stance = load[:, 0] > 1.0, (phase + offset).remainder(1.0) < self.standing
            lift_error = (place[:, 2] - self.lift_m).square()
            gait = 0.6 * (contact == stance) - 40.0 * lift_error * ~stance - 0.4 * speed.square().sum(1) * contact
            reward = reward + gait / len(self.feet)
        straight = constant(_columns, sensors.device, *self.straight)
        joints = (after["physics"][:, layout.qpos][:, 7:] - layout.home[7:])[:, straight]
        return reward - joints.square().sum(1)


@dataclass(frozen=True)
class Reach:
    """The hand reaches a goal, drawn uniformly in a box when an episode starts. Reward: minus the distance in m. Observation:
    joints, their speeds, the goal, and the vector from the goal to the hand."""

    rewards, on_device = True, True
    hand: str = "hand"  # sensor of the hand's position
    low: tuple[float, float, float] = (0.2, -0.2, 0.1)  # corners of the box, m
    high: tuple[float, float, float] = (0.45, 0.2, 0.4)

    def channels(self, layout: RobotLayout) -> Spaces:
        _check_hand(layout, self.hand)
        return {
            "observation": (numbers(sum(map(len, layout.hinges)) + 6), ""),
            "goal": (numbers(3), "m"),
            "hand": (numbers(3), "m"),
        }

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        low, high = constant(table, seeds.device, self.low, self.high).unbind(0)
        goal = low + (high - low) * chance.uniform(seeds, (3,), _GOAL)
        return {"goal": goal, MARKER: goal.double()}

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        distance = (after["sensors"][:, layout.sensors[self.hand]] - after["goal"]).norm(dim=1)
        return -distance.float(), torch.zeros_like(distance, dtype=torch.bool), {"goal": after["goal"]}

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        hand = state["sensors"][:, layout.sensors[self.hand]]
        if name != "observation":
            return state["goal"] if name == "goal" else hand.float()
        physics, goal = state["physics"], state["goal"]
        at, speed = (physics[:, part][:, own] for part, own in zip((layout.qpos, layout.qvel), layout.hinges))
        return torch.cat([at, speed, goal, hand - goal], 1).float()


@dataclass(frozen=True)
class Hold:
    """The hand reaches a goal in its plane (x, z), drawn in a ring around the origin when an episode starts, and holds it:
    `success` is 1 after `dwell` consecutive steps within `within` m."""

    rewards, on_device = True, True
    hand: str = "hand"  # sensor of the hand's position
    ring: tuple[float, float] = (0.2, 0.45)  # radii, m
    within: float = 0.03  # m
    dwell: int = 25  # control steps
    start: tuple[float, float] = (1.5, 0.5)  # range of initial joints and speeds around rest, rad and rad/s

    def channels(self, layout: RobotLayout) -> Spaces:
        _check_hand(layout, self.hand)
        joints = len(layout.home)
        if joints != layout.qvel.stop - layout.qvel.start:
            raise TerrellaError(
                "holding a goal needs hinges and slides only; the file has a free joint or a ball joint."
            )
        return {"observation": (numbers(3 * joints + 4), ""), "success": (numbers(), ""), "away": (numbers(), "m")}

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        drawn = chance.uniform(seeds, (qpos.shape[1] + qvel.shape[1],), _START).to(qpos)
        angle, radius = chance.uniform(seeds, (2,), _GOAL).to(qpos).unbind(1)
        qpos += self.start[0] * (2 * drawn[:, : qpos.shape[1]] - 1)
        qvel += self.start[1] * (2 * drawn[:, qpos.shape[1] :] - 1)
        low, high = self.ring
        length, turn = (low**2 + (high**2 - low**2) * radius).sqrt(), 2 * torch.pi * angle
        goal = torch.stack([length * turn.cos(), length * turn.sin()], 1)
        marker = torch.stack([goal[:, 0], 0 * goal[:, 0], goal[:, 1]], 1).double()
        return {"goal": goal, MARKER: marker, "held": torch.zeros_like(goal[:, 0], dtype=torch.int64)}

    def evaluate(self, layout: RobotLayout, before: Tensors, after: Tensors) -> Evaluation:
        distance = self._from_goal(layout, after).norm(dim=1)
        speed = after["physics"][:, layout.qvel].square().sum(1)
        held = (before["held"] + 1) * (distance <= self.within)
        reward = torch.exp(-(distance / self.within).square()) - 2 * distance - 0.002 * speed
        return reward.float(), torch.zeros_like(distance, dtype=torch.bool), {"goal": after["goal"], "held": held}

    def render(self, layout: RobotLayout, state: Tensors, name: str) -> Tensor:
        if name == "success":
            return (state["held"] >= self.dwell).float()
        offset = self._from_goal(layout, state)
        if name == "away":
            return offset.norm(dim=1).float()
        qpos, qvel = state["physics"][:, layout.qpos], state["physics"][:, layout.qvel]
        return torch.cat([qpos.cos(), qpos.sin(), 0.2 * qvel, state["goal"], 10 * offset], 1).float()

    def _from_goal(self, layout: RobotLayout, state: Tensors) -> Tensor:
        """The vector from the goal to the hand [B, 2], m."""
        return state["sensors"][:, layout.sensors[self.hand]][:, ::2] - state["goal"]


TASKS: Mapping[str, Callable[..., RobotTask]] = {"hold": Hold, "reach": Reach, "velocity": VelocityTracking}
_PREFIX = "terrella."  # of the custom texts and numbers in a file that declare its task


def task_of(spec: Any, name: str) -> RobotTask:
    """The task that an MJCF file declares, else Free, as in

        <custom><text name="terrella.task" data="hold"/><numeric name="terrella.ring" data="0.1 0.3"/></custom>

    TerrellaError for an unknown task or setting."""
    kind = next((one.data for one in spec.texts if one.name == f"{_PREFIX}task"), None)
    if kind is None:
        return Free()
    if kind not in TASKS:
        raise TerrellaError(
            f"{name} declares the task '{kind}'{did_you_mean(kind, TASKS) or '.'} There are {', '.join(TASKS)}."
        )
    default: Any = TASKS[kind]()
    known: dict[str, Any] = {one.name: getattr(default, one.name) for one in fields(default)}
    known = {name: value for name, value in known.items() if isinstance(value, int | float | tuple)}
    settings = {one.name.removeprefix(_PREFIX): list(one.data) for one in spec.numerics if one.name.startswith(_PREFIX)}
    for key, given in settings.items():
        if key not in known:
            likest = did_you_mean(key, known) or "."
            raise TerrellaError(f"the task '{kind}' of {name} has no '{key}'{likest} It has {', '.join(known)}.")
        count = len(known[key]) if isinstance(known[key], tuple) else 1
        if len(given) != count:
            raise TerrellaError(f"'{key}' of the task '{kind}' of {name} takes {count} numbers; got {len(given)}.")
    made = {key: tuple(given) if len(given) > 1 else type(known[key])(given[0]) for key, given in settings.items()}
    return TASKS[kind](**made)


def _check_hand(layout: RobotLayout, hand: str) -> None:
    if hand not in layout.sensors:
        sensors = ", ".join(layout.sensors) or "none"
        raise TerrellaError(f"the task needs a framepos sensor named '{hand}'; the file has {sensors}.")


def motion(layout: RobotLayout, physics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity in m/s, angular velocity in rad/s and the up direction, each [B, 3] in the free body's frame."""
    turn, velocity = physics[:, layout.qpos][:, 3:7], physics[:, layout.qvel]
    up = torch.zeros_like(velocity[:, :3])
    up[:, 2] = 1
    back = turn * constant(table, turn.device, 1.0, -1.0, -1.0, -1.0).to(turn.dtype)
    return rotate(back, velocity[:, :3]), velocity[:, 3:6], rotate(back, up)


def _columns(*columns: int) -> Tensor:
    return torch.tensor(columns, dtype=torch.int64)


def rotate(turn: Tensor, vector: Tensor) -> Tensor:
    """Vectors [B, 3] rotated by quaternions w, x, y, z [B, 4]."""
    w, axis = turn[:, :1], turn[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)


def quaternion_product(one: Tensor, other: Tensor) -> Tensor:
    """The rotation by `other`, then by `one`: quaternions w, x, y, z [B, 4]."""
    w = one[:, :1] * other[:, :1] - (one[:, 1:] * other[:, 1:]).sum(1, keepdim=True)
    axis = one[:, :1] * other[:, 1:] + other[:, :1] * one[:, 1:] + torch.linalg.cross(one[:, 1:], other[:, 1:])
    return torch.cat([w, axis], 1)


def numbers(*shape: int) -> spaces.Box:
    """An unbounded space of float32 numbers."""
    limit: Any = np.inf
    return spaces.Box(-limit, limit, shape, np.float32)
