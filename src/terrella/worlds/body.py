"""Body: how an action moves the viewer of a world with poses: learned motion, walls that stop it, steps up and down."""

from __future__ import annotations

import copy
import math
from typing import final

import torch
from torch import nn

from ..core.backend import constant, derived, where
from ..core.spec import POSE, POSE_UNIT
from ..core.state import State
from ..space.camera import planar_pose, yaw
from ..space.floorplan import slide
from .config import MotionConfig
from .parts import Absent, Channels, Evidence, Tensors, Walls

FASTEST_M = 1.0  # a step; a viewer that evidence moves further was put there, and has no speed


class Motion(nn.Module):
    """How a viewer moves where nothing is in its way: it turns by the actions, and glides by drag and thrust in its own
    frame. Walls come after (space/floorplan.slide)."""

    middle: torch.Tensor  # of the recorded places, and how far they reach, in metres
    span: torch.Tensor

    def __init__(self, config: MotionConfig):
        super().__init__()
        self.config = config
        acts = config.actions * (config.history + 1)
        self.turn = nn.Sequential(nn.Linear(acts, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1))
        inputs = 2 + config.actions
        self.glide = nn.Linear(inputs, 2)
        self.ending = nn.Sequential(nn.Linear(inputs, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1))
        self.register_buffer("middle", torch.zeros(2))
        self.register_buffer("span", torch.ones(()))

    def forward(self, heading, speed, actions):
        """heading [B] radians; speed [B, 2] metres a step, world frame; actions [B, history + 1, A], the newest last.
        Returns the new heading [B] and the displacement that this step wishes for [B, 2]."""
        heading = torch.add(heading, self.turn(actions.flatten(1))[:, 0], alpha=0.1)
        glide = self.glide(torch.cat([10 * rotate(speed, -heading), actions[:, -1]], -1))
        return heading, 0.1 * rotate(glide, heading)

    def ends(self, place: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Logit that the episode ends at `place` [B, 2]: [B]."""
        at = 2 * (place - self.middle) / self.span
        logit = self.ending(torch.cat([at, action], -1))[:, 0]
        known = torch.linalg.vector_norm(at, torch.inf, dim=1) < 1.2
        return where(known, logit, -20.0)  # what lies further away was never seen to end


@final
class MotionBody:
    """The viewer as an upright box that `motion` moves, and walls stop."""

    kind = "motion"

    def __init__(self, motion: Motion, config: MotionConfig | None = None):
        self.motion, self.config = motion.eval().requires_grad_(False), config or motion.config
        self.history, self.half_m = self.config.history, self.config.body_m

    def to(self, device) -> MotionBody:
        return MotionBody(copy.deepcopy(self.motion).to(device), self.config)

    def channels(self) -> Channels:
        return Channels({"pose": POSE}, {"pose": POSE_UNIT}, ("pose",))

    def observe(self, prior: State | None, evidence: Evidence) -> Tensors:
        """The body at the pose of the evidence, as fast as it was imagined plus the error of that; without a prior it stands."""
        pose = evidence.pose
        assert pose is not None
        still = torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
        if prior is None:
            return {"pose": pose, "speed": pose.new_zeros(len(pose), 2), "dreamt": still}
        speed = pose[:, :2] - prior["pose"][:, :2] + torch.where(prior["dreamt"][:, None], prior["speed"], 0.0)
        speed = torch.where((speed.norm(dim=-1) < FASTEST_M)[:, None], speed, 0.0)
        return {"pose": pose, "speed": speed, "dreamt": still}

    def step(self, state: State, actions: torch.Tensor, walls: Walls, levels: torch.Tensor) -> Tensors:
        """The body one step on; parameters as in parts.Body."""
        pose = state["pose"]
        heading, wish = self.motion(yaw(pose), state["speed"], actions)
        shift, speed = slide(walls.shared, pose[:, :2], wish, self.config.body_m, self.config.short, walls.own)
        place, height = pose[:, :2] + shift, pose[:, 2]
        if self.config.stairs and len(levels):
            height = follow_stairs(levels, pose[:, :2], place, height)
        return {
            "pose": planar_pose(place[:, 0], place[:, 1], height, heading),
            "speed": speed,
            "dreamt": constant(torch.tensor, pose.device, True).expand(len(pose)),
        }

    def ends(self, after: State, action: torch.Tensor) -> torch.Tensor:
        """Whether an episode ends where a step led, bool [B]."""
        return self.motion.ends(after["pose"][:, :2], action) > 0


@final
class NoBody(Absent):
    """Of a frames-only world: where its pictures were taken is unknown."""

    history: int = 0
    half_m: float = 0.0

    def observe(self, prior: State | None, evidence: Evidence) -> Tensors:
        return {}

    def step(self, state: State, actions: torch.Tensor, walls: Walls, levels: torch.Tensor) -> Tensors:
        return {}

    def ends(self, after: State, action: torch.Tensor) -> torch.Tensor:
        return constant(torch.tensor, action.device, False).expand(len(action))


def follow_stairs(levels: torch.Tensor, before: torch.Tensor, after: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """The viewer's height [B] after a step from place `before` to `after` [B, 2], coming from `z` [B]: it rises as the recorded
    places around, `levels` [K, 3], do, as far as a step up or down leads there, and leans towards them as it walks."""
    near = torch.cdist(torch.stack([before, after]), levels[:, :2])  # [2, B, K]
    level = (levels[:, 2] - z[:, None]).abs() < 1.5
    weight = torch.addcmul(constant(torch.tensor, z.device, 0.01), near, near).pow(-2) * ((near < 2.5) & level)
    total, high = (weight @ derived(_ones_and_heights, levels)).unbind(2)
    reached = torch.add(high, z, alpha=1e-9) / (total + 1e-9)  # where nothing is near, z
    lean = torch.linalg.vector_norm(after - before, dim=-1).clamp_max(2)
    return z + torch.addcmul(reached[1] - reached[0], lean, reached[1] - z, value=0.5).clamp(-0.3, 0.3)


def _ones_and_heights(levels: torch.Tensor) -> torch.Tensor:
    return torch.stack([torch.ones_like(levels[:, 2]), levels[:, 2]], 1)


def rotate(vector: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """[B, 2] rotated counter-clockwise by [B] radians."""
    turn = (angle[:, None] + constant(torch.tensor, vector.device, _TURNED)).cos().view(-1, 2, 2)
    return (vector[:, None] @ turn)[:, 0]


_TURNED = 0.0, -math.pi / 2, math.pi / 2, 0.0  # the cosines of an angle and these are the matrix of its rotation
