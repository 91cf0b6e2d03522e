"""Boxes that are dropped on each other, in MuJoCo: the family of phyworld's kind that has no formula."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ..core import chance
from .mujoco_tasks import Free, RobotLayout
from .mujoco_world import MujocoConfig, MujocoWorld

_OFFSET_M, _DROP_M, _STREAM = ((0.0, 0.06), (0.08, 0.14)), ((0.0, 0.05), (0.1, 0.2)), 21
STEPS, DT_S = 64, 0.025


@dataclass(frozen=True)
class Stack(Free):
    """Draws how far each box is off the one below, and how far it falls."""

    out: bool = False  # beyond the ranges of training

    def initialise(self, layout: RobotLayout, seeds: Tensor, qpos: Tensor, qvel: Tensor) -> dict[str, Tensor]:
        drawn = chance.uniform(seeds, (3, 3), _STREAM).double()
        (near, far), (low, high) = _OFFSET_M[self.out], _DROP_M[self.out]
        x = torch.zeros(len(qpos), dtype=torch.float64)
        z = torch.zeros_like(x)
        for at in range(3):
            sign = (drawn[:, at, 0] > 0.5).double() * 2 - 1
            x = x + sign * (near + (far - near) * drawn[:, at, 1]) * (at > 0)
            z = z + (low + (high - low) * drawn[:, at, 2]) * (at > 0)
            qpos[:, 7 * at] += x
            qpos[:, 7 * at + 2] += z
        return {}


def stacking(split: str = "in", pictures: bool = True) -> MujocoWorld:
    """The world of three boxes; `split` as in sim/bodies.py."""
    cameras = None if pictures else ()
    config = MujocoConfig(Stack(split == "out"), DT_S, (64, 64), cameras, threads=1)
    world = MujocoWorld(Path(__file__).parent / "models" / "stack.xml", config)
    return world.named(f"physics:stacking{':out' if split == 'out' else ''}", STEPS)
