"""A tiny robot for tests: axes as actions, two cameras, and a pose; its picture shows where it is and how it is turned."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Spec, State
from terrella.core.errors import TerrellaError
from terrella.core.spec import Camera

NAMES, UNITS = ("forward", "turn", "gripper"), ("m/s", "rad/s", "")
LOW, HIGH = np.array([-1.0, -2.0, 0.0], np.float32), np.array([2.0, 2.0, 1.0], np.float32)


class Robot:
    """x in 0..1 is the brightness of the main picture; the wrist camera's redness is the gripper."""

    def __init__(self, mode: str = "velocity", dt_s: float = 1 / 50, keys: dict | None = None):
        intrinsics = (0.6, 0.8, 0.5, 0.5)
        self.spec = Spec(
            name="robot",
            action=spaces.Box(LOW, HIGH),
            channels={
                "rgb": spaces.Box(0, 255, (48, 64, 3), np.uint8),
                "rgb.wrist": spaces.Box(0, 255, (32, 32, 3), np.uint8),
                "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
            },
            observes=(),
            dt_s=dt_s,
            action_names=NAMES,
            action_units=UNITS,
            action_mode=mode,
            action_frame="body",
            keys=keys or {},
            cameras={"rgb": Camera(intrinsics, (48, 64)), "rgb.wrist": Camera(intrinsics, (32, 32), None)},
            card={"what": "a robot with two cameras"},
        )

    def start(self, batch, rng) -> State:
        if batch < 1:
            raise TerrellaError(f"a robot cannot start a batch of {batch}.")
        return State({"x": torch.zeros(batch), "yaw": torch.zeros(batch), "grip": torch.zeros(batch)})

    def observe(self, observation, prior, rng) -> State:
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state, action, rng) -> State:
        action = self.spec.check_action(action, state.batch).float()
        dt_s = self.spec.dt_s
        return State(
            {
                "x": state["x"] + dt_s * action[:, 0],
                "yaw": state["yaw"] + dt_s * action[:, 1],
                "grip": action[:, 2],
            }
        )

    def render(self, state, channels):
        self.spec.check_channels(channels)
        return {name: self._channel(state, name) for name in channels}

    def _channel(self, state, name):
        batch = state.batch
        if name == "pose":
            half, zero = state["yaw"] / 2, torch.zeros(batch)
            return torch.stack([state["x"], zero, zero, half.cos(), zero, zero, half.sin()], 1)
        height, width = self.spec.channels[name].shape[:2]
        seen = torch.zeros(batch, height, width, 3)
        if name == "rgb":
            seen += (40 + 200 * state["x"].clamp(0, 1))[:, None, None, None]
        else:
            seen[..., 0] = (40 + 200 * state["grip"])[:, None, None]
        return seen.to(torch.uint8)
