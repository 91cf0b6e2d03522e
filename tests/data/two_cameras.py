"""A world of two cameras, axes and all sorts of channels, made for the tests of this room."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Camera, Spec, State
from terrella.core.errors import ObservationError

MOUNT = (0.1, 0.0, -0.2, 1.0, 0.0, 0.0, 0.0)
SIZE, WRIST = (16, 32), (8, 12)


def _box(low, high, shape, dtype=np.float32) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


class TwoCameras:
    """An arm that is where its action says; every channel is a function of the step and the action."""

    def __init__(self, **more: spaces.Space):
        channels = {
            "rgb": _box(0, 255, (*SIZE, 3), np.uint8),
            "rgb.wrist": _box(0, 255, (*WRIST, 3), np.uint8),
            "depth.wrist": _box(0, np.inf, (4, 6)),
            "pose": _box(-np.inf, np.inf, (7,)),
            "pose.wrist": _box(-np.inf, np.inf, (7,)),
            "state": _box(-np.inf, np.inf, (3,), np.float64),
            "count": _box(0, 2**40, (), np.int64),
            "mask": _box(0, 1, (4, 6), np.bool_),
            "voxels": _box(-9, 9, (2, 3, 4, 2)),
            "instruction": _box(-1, 1, (5,)),
            "observation": _box(-1, 1, (2,)),
            "reward": _box(-np.inf, np.inf, ()),
            "done": _box(0, 1, (), np.bool_),
            **more,
        }
        self.spec = Spec(
            name="two cameras",
            action=_box(-1, 1, (2,)),
            channels=channels,
            observes=(),
            dt_s=0.1,
            units={"state": "rad", "voxels": "N"},
            cameras={
                "rgb": Camera((0.5, 1.0, 0.5, 0.5), SIZE),
                "rgb.wrist": Camera((0.7, 0.9, 0.5, 0.4), WRIST, "pose.wrist", MOUNT),
            },
            action_names=("lift", "turn"),
            action_units=("m", "rad"),
            action_mode="position",
            action_frame="tool",
            max_batch=1,
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        if batch != 1:
            raise ObservationError("two cameras are one arm; start one.")
        return State({"step": torch.zeros(batch, dtype=torch.int64), "at": torch.zeros(batch, 2)})

    def observe(self, observation, prior, rng) -> State:
        if observation:
            raise ObservationError("two cameras take no evidence; pass an empty mapping.")
        return prior if prior is not None else self.start(1, rng)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        return State({"step": state["step"] + 1, "at": self.spec.check_action(action, state.batch)})

    def render(self, state: State, channels) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        return {
            name: torch.from_numpy(self.truth(name, int(state["step"][0]), state["at"][0]))[None] for name in channels
        }

    def truth(self, name: str, step: int, at) -> np.ndarray:
        space = self.spec.channels[name]
        shape, dtype = space.shape, np.dtype(space.dtype)
        if name == "done":
            return np.array(False)
        if name.startswith("pose"):
            return np.array([step, *np.asarray(at), 1, 0, 0, 0], np.float32)
        if name == "count":
            return np.array(2**33 + step)
        numbers = np.arange(int(np.prod(shape)), dtype=np.float64).reshape(shape) + step
        if dtype == np.uint8:
            return np.full(shape, 40 + 10 * step, np.uint8)
        if dtype.kind == "b":
            return numbers % 2 == 0
        return np.asarray(numbers / 64 if name.startswith("depth") else np.tanh(numbers / 9), dtype)
