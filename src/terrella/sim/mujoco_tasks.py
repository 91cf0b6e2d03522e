"""What is wanted of a MuJoCo robot: reward, the end of an episode and what a policy sees, for whole batches at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.errors import TerrellaError
from ..core.similar import did_you_mean

Tensors = Mapping[str, torch.Tensor]
_START, _GOAL = 1, 2  # streams of chance
MARKER = "marker"  # of a state, where a task keeps one: a point [B, 3], m, that pictures show as a ball


@dataclass(frozen=True)
class RobotLayout:
    """What a task knows of the robot. qpos, qvel: slices of the state's columns; hinges: which of those [n] each are of hinges and
    slides, so of no body that moves freely; home: qpos [nq] and ctrl [nu] at rest; low, high:
    [nu] of the controls; sensors: name -> slice of the sensors' columns; step_s: seconds of a control step."""

    qpos: slice
    qvel: slice
    hinges: tuple[torch.Tensor, torch.Tensor]
    home: torch.Tensor
    rest: torch.Tensor
    low: torch.Tensor
    high: torch.Tensor
    sensors: Mapping[str, slice]
    step_s: float


class RobotTask(Protocol):
    """`begin` changes the starts [B, nq], [B, nv] and gives tensors of its own for the state (`marker` is drawn); `judge`
    gives reward [B], fallen bool [B] and its tensors after a step; `channels` says what `see` shows."""

    rewards: bool

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]: ...
    def begin(
        self, robot: RobotLayout, seeds: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> dict[str, torch.Tensor]: ...
    def judge(
        self, robot: RobotLayout, before: Tensors, after: Tensors
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]: ...
    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor: ...


class Free:
    """Nothing is wanted: the robot is as its file says, and its observation is all of its state."""

    rewards = False

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]:
        width = (
            len(robot.home)
            + robot.qvel.stop
            - robot.qvel.start
            + sum(at.stop - at.start for at in robot.sensors.values())
        )
        return {"observation": (numbers(width), "")}

    def begin(
        self, robot: RobotLayout, seeds: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        return {}

    def judge(
        self, robot: RobotLayout, before: Tensors, after: Tensors
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        batch = len(after["physics"])
        return torch.zeros(batch), torch.zeros(batch, dtype=torch.bool), {}

    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor:
        physics = state["physics"]
        return torch.cat([physics[:, robot.qpos], physics[:, robot.qvel], state["sensors"]], 1).float()


@dataclass(frozen=True)
class VelocityTracking:
    """A body that moves freely follows a commanded velocity (Rudin et al. 2021, "Learning to walk in minutes"): `command` is
    forward and sideways in m/s and turning in rad/s, in the body's frame, drawn evenly within the limits when an episode begins.

    fallen: tilt of the body in rad, and share of its height at rest, at which the episode is over. noise: of the joints at first.
    """

    rewards = True
    forward: tuple[float, float] = (0.3, 1.0)
    sideways: tuple[float, float] = (0.0, 0.0)
    turning: tuple[float, float] = (-0.5, 0.5)
    fallen: tuple[float, float] = (1.0, 0.55)
    noise: float = 0.1
    weights: Mapping[str, float] = field(
        default_factory=lambda: {
            "alive": 0.4, "velocity": 1.5, "slow": 0.5, "turning": 0.75, "bounce": 0.5, "roll": 0.02, "tilt": 1.0, "jerk": 0.03,
            "pose": 0.05,
        }
    )  # fmt: skip

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]:
        if len(robot.home) < 7 or len(robot.home) != robot.qvel.stop - robot.qvel.start + 1:
            raise TerrellaError("a velocity is tracked by a body that moves freely: its file begins with a free joint.")
        return {
            "observation": (
                numbers(12 + len(robot.home) - 7 + robot.qvel.stop - robot.qvel.start - 6 + len(robot.rest)),
                "",
            ),
            "command": (numbers(3), "m/s, m/s, rad/s"),
            "velocity": (numbers(3), "m/s, m/s, rad/s"),
        }

    def begin(
        self, robot: RobotLayout, seeds: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        joints = qpos.shape[1] - 7
        drawn = 2 * chance.uniform(seeds, (joints + qvel.shape[1] + 1,), _START).double() - 1
        qpos[:, 7:] += self.noise * drawn[:, :joints]
        qvel += self.noise * drawn[:, joints:-1]
        half = torch.pi / 2 * drawn[:, -1]
        turned = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
        qpos[:, 3:7] = multiplied(turned, qpos[:, 3:7])
        limits = torch.tensor([self.forward, self.sideways, self.turning])
        command = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * chance.uniform(seeds, (3,), _GOAL)
        return {"command": command}

    def judge(
        self, robot: RobotLayout, before: Tensors, after: Tensors
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        height, tilt = self.fallen[1], self.fallen[0]
        up, qpos = motion(robot, after["physics"])[2], after["physics"][:, robot.qpos]
        fallen = (up[:, 2] < np.cos(tilt)) | (qpos[:, 2] < height * robot.home[2])
        return self._worth(robot, before, after).clamp_min(0.0).float(), fallen, {"command": after["command"]}

    def _worth(self, robot: RobotLayout, before: Tensors, after: Tensors) -> torch.Tensor:
        """What a step is worth [B]."""
        physics, command, weights = after["physics"], after["command"], self.weights
        qpos, (velocity, spin, up) = physics[:, robot.qpos], motion(robot, physics)
        missed = (velocity[:, :2] - command[:, :2]).square().sum(1)
        turned = (spin[:, 2] - command[:, 2]).square()
        span = (robot.high - robot.low) / 2
        jerk = ((after["ctrl"] - before["ctrl"]) / span).square().sum(1)
        return (
            weights["alive"] + weights["velocity"] * torch.exp(-missed / 0.25) - weights["slow"] * missed.sqrt()
            + weights["turning"] * torch.exp(-turned / 0.25)
            - weights["bounce"] * velocity[:, 2].square() - weights["roll"] * spin[:, :2].square().sum(1)
            - weights["tilt"] * up[:, :2].square().sum(1) - weights["jerk"] * jerk
            - weights["pose"] * (qpos[:, 7:] - robot.home[7:]).square().sum(1)
        )  # fmt: skip

    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor:
        if name == "command":
            return state["command"]
        velocity, spin, up = motion(robot, state["physics"])
        if name == "velocity":
            return torch.cat([velocity[:, :2], spin[:, 2:]], 1).float()
        qpos, qvel = state["physics"][:, robot.qpos], state["physics"][:, robot.qvel]
        meant = (state["ctrl"] - robot.rest) / ((robot.high - robot.low) / 2)
        away = qpos[:, 7:] - robot.home[7:]
        return torch.cat([velocity, spin, up, state["command"], away, 0.1 * qvel[:, 6:], meant], 1).float()


@dataclass(frozen=True)
class Stepping(VelocityTracking):
    """The same with legs that take turns by a clock that is seen (Siekmann et al. 2021, "Sim-to-real learning of all common
    bipedal gaits via periodic reward composition"): a foot stands for `standing` of each `period_s`, and else is lifted `lift_m`.

    feet: sites, of which the robot has sensors foot_, place_ and speed_, and by which share of the period each is ahead; straight:
    columns of joints that stay as at rest.
    """

    feet: Mapping[str, float] = field(default_factory=lambda: {"left_foot": 0.0, "right_foot": 0.5})
    period_s: float = 0.8
    standing: float = 0.55
    lift_m: float = 0.08
    straight: tuple[int, ...] = (1, 2, 7, 8)

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]:
        found = super().channels(robot)
        wanted = [f"{kind}_{foot}" for foot in self.feet for kind in ("foot", "place", "speed")]
        if missing := [name for name in wanted if name not in robot.sensors]:
            raise TerrellaError(
                f"steps are judged by sensors that the file lacks: {', '.join(missing)} (touch, framepos, framelinvel)."
            )
        return found | {"observation": (numbers(found["observation"][0].shape[0] + 2), "")}

    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor:
        seen = super().see(robot, state, name)
        angle = 2 * torch.pi * self._phase(state)
        return (
            seen if name != "observation" else torch.cat([seen, angle.sin()[:, None], angle.cos()[:, None]], 1).float()
        )

    def _phase(self, state: Tensors) -> torch.Tensor:
        return (state["physics"][:, 0] / self.period_s).remainder(1.0)

    def _worth(self, robot: RobotLayout, before: Tensors, after: Tensors) -> torch.Tensor:
        worth, sensors, phase = super()._worth(robot, before, after), after["sensors"], self._phase(after)
        for foot, ahead in self.feet.items():
            load, place, speed = (sensors[:, robot.sensors[f"{kind}_{foot}"]] for kind in ("foot", "place", "speed"))
            down, stands = load[:, 0] > 1.0, (phase + ahead).remainder(1.0) < self.standing
            lifted = (place[:, 2] - self.lift_m).square()
            steps = 0.6 * (down == stands) - 40.0 * lifted * ~stands - 0.4 * speed.square().sum(1) * down
            worth = worth + steps / len(self.feet)
        joints = (after["physics"][:, robot.qpos][:, 7:] - robot.home[7:])[:, list(self.straight)]
        return worth - joints.square().sum(1)


@dataclass(frozen=True)
class Reach:
    """A hand goes to a point, drawn evenly in a box in front of the arm when an episode begins; reward: minus the distance in m.
    The observation is the arm's own: its joints, their speeds, the goal, and what is between it and the hand."""

    rewards = True
    hand: str = "hand"
    low: tuple[float, float, float] = (0.2, -0.2, 0.1)
    high: tuple[float, float, float] = (0.45, 0.2, 0.4)

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]:
        _check_hand(robot, self.hand)
        return {
            "observation": (numbers(sum(map(len, robot.hinges)) + 6), ""),
            "goal": (numbers(3), "m"),
            "hand": (numbers(3), "m"),
        }

    def begin(
        self, robot: RobotLayout, seeds: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        goal = low + (high - low) * chance.uniform(seeds, (3,), _GOAL)
        return {"goal": goal, MARKER: goal.double()}

    def judge(
        self, robot: RobotLayout, before: Tensors, after: Tensors
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        away = (after["sensors"][:, robot.sensors[self.hand]] - after["goal"]).norm(dim=1)
        return -away.float(), torch.zeros(len(away), dtype=torch.bool), {"goal": after["goal"]}

    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor:
        hand = state["sensors"][:, robot.sensors[self.hand]]
        if name != "observation":
            return state["goal"] if name == "goal" else hand.float()
        physics, goal = state["physics"], state["goal"]
        at, speed = (physics[:, part][:, own] for part, own in zip((robot.qpos, robot.qvel), robot.hinges))
        return torch.cat([at, speed, goal, hand - goal], 1).float()


@dataclass(frozen=True)
class Hold:
    """A hand comes to rest at a point of its plane (x, z), drawn in a ring around the origin when an episode begins, and stays:
    `success` is 1 from `dwell` steps in a row within `within` m on.

    ring: its radii in m; start: by how much joints and their speeds differ at first, rad and rad/s.
    """

    rewards = True
    hand: str = "hand"
    ring: tuple[float, float] = (0.2, 0.45)
    within: float = 0.03
    dwell: int = 25
    start: tuple[float, float] = (1.5, 0.5)

    def channels(self, robot: RobotLayout) -> dict[str, tuple[spaces.Space, str]]:
        _check_hand(robot, self.hand)
        joints = len(robot.home)
        if joints != robot.qvel.stop - robot.qvel.start:
            raise TerrellaError(
                "holding a point is for hinges and slides; the file has a joint that moves freely or a ball."
            )
        return {"observation": (numbers(3 * joints + 4), ""), "success": (numbers(), ""), "away": (numbers(), "m")}

    def begin(
        self, robot: RobotLayout, seeds: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        drawn = chance.uniform(seeds, (qpos.shape[1] + qvel.shape[1],), _START).double()
        angle, radius = chance.uniform(seeds, (2,), _GOAL).double().unbind(1)
        qpos += self.start[0] * (2 * drawn[:, : qpos.shape[1]] - 1)
        qvel += self.start[1] * (2 * drawn[:, qpos.shape[1] :] - 1)
        low, high = self.ring
        length, turn = (low**2 + (high**2 - low**2) * radius).sqrt(), 2 * torch.pi * angle
        goal = torch.stack([length * turn.cos(), length * turn.sin()], 1)
        marker = torch.stack([goal[:, 0], torch.zeros(len(goal)), goal[:, 1]], 1).double()
        return {"goal": goal, MARKER: marker, "held": torch.zeros(len(goal), dtype=torch.int64)}

    def judge(
        self, robot: RobotLayout, before: Tensors, after: Tensors
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        away = self._apart(robot, after).norm(dim=1)
        speed = after["physics"][:, robot.qvel].square().sum(1)
        held = torch.where(away <= self.within, before["held"] + 1, 0)
        reward = torch.exp(-(away / self.within).square()) - 2 * away - 0.002 * speed
        return reward.float(), torch.zeros(len(away), dtype=torch.bool), {"goal": after["goal"], "held": held}

    def see(self, robot: RobotLayout, state: Tensors, name: str) -> torch.Tensor:
        if name == "success":
            return (state["held"] >= self.dwell).float()
        apart = self._apart(robot, state)
        if name == "away":
            return apart.norm(dim=1).float()
        qpos, qvel = state["physics"][:, robot.qpos], state["physics"][:, robot.qvel]
        return torch.cat([qpos.cos(), qpos.sin(), 0.2 * qvel, state["goal"], 10 * apart], 1).float()

    def _apart(self, robot: RobotLayout, state: Tensors) -> torch.Tensor:
        """From the goal to the hand [B, 2], m."""
        return state["sensors"][:, robot.sensors[self.hand]][:, [0, 2]] - state["goal"]


TASKS: Mapping[str, Callable[..., RobotTask]] = {"hold": Hold, "reach": Reach, "velocity": VelocityTracking}
_TOLD = "terrella."  # begins the names of what a file tells


def task_of(spec: Any, name: str) -> RobotTask:
    """The task that an MJCF file tells of itself, none where it tells none, as in

        <custom><text name="terrella.task" data="hold"/><numeric name="terrella.ring" data="0.1 0.3"/></custom>

    TerrellaError, a sentence, for what there is not."""
    kind = next((one.data for one in spec.texts if one.name == f"{_TOLD}task"), None)
    if kind is None:
        return Free()
    if kind not in TASKS:
        raise TerrellaError(
            f"{name} tells the task '{kind}'{did_you_mean(kind, TASKS) or '.'} There are {', '.join(TASKS)}."
        )
    usual: Any = TASKS[kind]()
    known: dict[str, Any] = {one.name: getattr(usual, one.name) for one in fields(usual)}
    known = {name: value for name, value in known.items() if isinstance(value, int | float | tuple)}
    told = {one.name.removeprefix(_TOLD): list(one.data) for one in spec.numerics if one.name.startswith(_TOLD)}
    for key, given in told.items():
        if key not in known:
            likest = did_you_mean(key, known) or "."
            raise TerrellaError(f"the task '{kind}' of {name} has no '{key}'{likest} It has {', '.join(known)}.")
        count = len(known[key]) if isinstance(known[key], tuple) else 1
        if len(given) != count:
            raise TerrellaError(f"'{key}' of the task '{kind}' of {name} is {count} numbers; got {len(given)}.")
    made = {key: tuple(given) if len(given) > 1 else type(known[key])(given[0]) for key, given in told.items()}
    return TASKS[kind](**made)


def _check_hand(robot: RobotLayout, hand: str) -> None:
    if hand not in robot.sensors:
        there = ", ".join(robot.sensors) or "none"
        raise TerrellaError(f"a hand is found by a sensor (framepos) of the name '{hand}'; the file has {there}.")


def motion(robot: RobotLayout, physics: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Velocity in m/s, spin in rad/s and the direction of up, each [B, 3] in the frame of the body that moves freely."""
    turn, velocity = physics[:, robot.qpos][:, 3:7], physics[:, robot.qvel]
    up = torch.zeros_like(velocity[:, :3])
    up[:, 2] = 1
    back = turn * torch.tensor([1.0, -1, -1, -1], dtype=turn.dtype)
    return rotated(back, velocity[:, :3]), velocity[:, 3:6], rotated(back, up)


def rotated(turn: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """[B, 3] vectors turned by quaternions w, x, y, z [B, 4]."""
    w, axis = turn[:, :1], turn[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)


def multiplied(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The turn `other`, then `one`: quaternions w, x, y, z [B, 4]."""
    w = one[:, :1] * other[:, :1] - (one[:, 1:] * other[:, 1:]).sum(1, keepdim=True)
    axis = one[:, :1] * other[:, 1:] + other[:, :1] * one[:, 1:] + torch.linalg.cross(one[:, 1:], other[:, 1:])
    return torch.cat([w, axis], 1)


def numbers(*shape: int) -> spaces.Box:
    """A space of float32 numbers without limits."""
    limit: Any = np.inf
    return spaces.Box(-limit, limit, shape, np.float32)
