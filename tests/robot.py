"""A robot in a painted room, computed exactly: two cameras, axes as actions, an instruction. It needs no simulator."""

from __future__ import annotations

import math

import numpy as np
import torch
from gymnasium import spaces

from terrella.core import Camera, Spec, State
from terrella.core.errors import ObservationError, TerrellaError
from terrella.core.spec import DONE, POSE, POSE_UNIT, REWARD
from terrella.space.camera import planar_pose, rays, rotation, unproject

INTRINSICS, SIZE, HALF_M = (0.5, 0.75, 0.5, 0.5), (32, 48), 3.0
LEFT = (0.0, 0.1, 0.0, math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))  # 10 cm to the left, looking left
PICTURE, DEPTH = spaces.Box(0, 255, (*SIZE, 3), np.uint8), spaces.Box(0, 100, SIZE, np.float32)


class Robot:
    """Drives at up to 1 m/s and turns at up to 2 rad/s; reward is how far it came, and it is done at the room's edge."""

    def __init__(self):
        self.spec = Spec(
            name="robot",
            action=spaces.Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32)),
            channels={
                "rgb": PICTURE, "rgb.left": PICTURE, "depth": DEPTH, "depth.left": DEPTH, "pose": POSE,
                "instruction": spaces.Box(-1, 1, (4,), np.float32), "reward": REWARD, "done": DONE,
            },
            observes=("pose",),
            dt_s=0.1,
            units={"depth": "m", "depth.left": "m", "pose": POSE_UNIT, "reward": "m"},
            cameras={"rgb": Camera(INTRINSICS, SIZE), "rgb.left": Camera(INTRINSICS, SIZE, "pose", LEFT)},
            action_names=("drive", "turn"),
            action_units=("m/s", "rad/s"),
            action_mode="velocity",
            action_frame="body",
        )  # fmt: skip

    def start(self, batch, rng):
        if batch < 1:
            raise TerrellaError("a batch of one or more")
        chance = torch.rand((batch, 3), generator=rng)
        return self._at(torch.cat([2 * chance[:, :2] - 1, 6 * chance[:, 2:]], 1))

    def observe(self, observation, prior, rng):
        if "pose" not in observation:
            raise ObservationError("robot observes pose")
        pose = torch.as_tensor(observation["pose"]).float()
        heading = 2 * torch.atan2(pose[:, 6], pose[:, 3])
        return self._at(torch.cat([pose[:, :2], heading[:, None]], 1))

    def imagine(self, state, action, rng):
        drive, turn = self.spec.check_action(action, state.batch).unbind(1)
        x, y, heading = state["place"].unbind(1)
        heading = heading + 0.1 * turn
        moved = torch.stack([x + 0.1 * drive * heading.cos(), y + 0.1 * drive * heading.sin(), heading], 1)
        still = state["done"]
        moved = torch.where(still[:, None], state["place"], moved)
        gone = (moved[:, :2] - state["place"][:, :2]).norm(dim=1)
        return State({"place": moved, "reward": gone, "done": still | (moved[:, :2].abs().amax(1) > HALF_M - 0.3)})

    def render(self, state, channels):
        self.spec.check_channels(channels)
        x, y, heading = state["place"].unbind(1)
        pose = planar_pose(x, y, torch.full_like(x, 1.0), heading)
        mounted = planar_pose(
            x - 0.1 * heading.sin(), y + 0.1 * heading.cos(), torch.full_like(x, 1.0), heading + math.pi / 2
        )
        show = {
            "pose": lambda: pose,
            "instruction": lambda: torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(x), 1),
            "depth": lambda: _depth(pose),
            "depth.left": lambda: _depth(mounted),
            "rgb": lambda: _picture(pose),
            "rgb.left": lambda: _picture(mounted),
        }
        return {name: show[name]() if name in show else state[name] for name in channels}

    def _at(self, place):
        return State(
            {"place": place, "reward": torch.zeros(len(place)), "done": torch.zeros(len(place), dtype=torch.bool)}
        )


def _depth(pose):
    """Exact depth [B, H, W] in a box room of 6 by 6 by 2.5 metres."""
    beam = rays(INTRINSICS, *SIZE) @ rotation(pose)[:, None].mT
    low, high = torch.tensor([-HALF_M, -HALF_M, 0.0]), torch.tensor([HALF_M, HALF_M, 2.5])
    origin = pose[:, None, None, :3]
    return torch.where(beam > 0, (high - origin) / beam.clamp_min(1e-9), (low - origin) / beam.clamp_max(-1e-9)).amin(
        -1
    )


def _picture(pose):
    """Smooth colours of the surfaces seen: uint8 [B, H, W, 3]."""
    points = unproject(_depth(pose), pose, INTRINSICS)
    return (127 + 120 * torch.sin(1.7 * points + torch.tensor([0.0, 1.0, 2.0]))).round().to(torch.uint8)
