"""Bodies do not overlap, neither each other nor walls."""

from dataclasses import replace

import torch
from torch import Tensor

from ..gaps import rotated
from ..system import PhysicalSystem, Wall
from ..trajectory import SKIN, Trajectory
from .law import SINGLE, largest, occasions, shifted, with_last

PUSHES = 3  # of a correction
APPROACHES = 8  # of an injected overlap to its depth


def begins_inside(motion: Trajectory, allowed: float) -> str:
    """A sentence on the body that is deepest inside another one or a wall at the first instant, by more than `allowed` m; "" where
    none is."""
    names = [body.name for body in motion.system.bodies]
    gaps = torch.cat([motion.body_gaps[0], motion.wall_gaps[0]], 2)  # [B, N, N + W]
    depth = (-gaps).masked_fill(~motion.present[0][..., None], 0.0)
    deep = depth.flatten(1).amax(1)
    if not float(deep.max()) > allowed:
        return ""
    body, other = divmod(int(depth[deep.argmax()].argmax()), gaps.shape[2])
    what = names[other] if other < len(names) else "a wall"
    return (
        f"{names[body]} begins {float(deep.max()):.2g} m inside {what}, and {int((deep > allowed).sum())} of {len(deep)} true "
        "rollouts begin with such an overlap: describe sizes, positions and walls as they are."
    )


class NonPenetration:
    """The depth of the deepest overlap at the end of each step."""

    name, unit = "non-penetration", "m"

    def missing(self, system: PhysicalSystem) -> str:
        alone = len(system.bodies) < 2 and not system.walls
        return "needs a wall or a second body" if alone else ""

    def residual(self, motion: Trajectory) -> Tensor:
        here = motion.present[1:]
        walls = largest((-motion.wall_gaps[1:]).clamp_min(0), here[..., None].expand_as(motion.wall_gaps[1:]))
        gaps = -motion.body_gaps[1:]
        return torch.maximum(walls, largest(gaps.clamp_min(0), gaps > 0))

    def floor(self, motion: Trajectory) -> float:
        seen = 2 * SKIN * self.ceiling(motion) if motion.system.tracked else 0.0  # pictures show places no better
        return max(seen, SINGLE * float(motion.position.abs().max().clamp_min(1.0)))

    def ceiling(self, motion: Trajectory) -> float:
        return 0.5 * float(motion.size[motion.present].amin())

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        step, body, some = occasions(motion.both_present, seeds)
        rows = torch.arange(motion.batch)
        at = motion.position[step + 1, rows, body]
        gaps = torch.cat([motion.wall_gaps[step + 1, rows, body], motion.body_gaps[step + 1, rows, body]], 1)
        nearest, which = gaps.min(1)
        some = some & nearest.isfinite()
        goals = torch.stack(
            [self._goal(motion, int(step[row]) + 1, row, at[row], int(which[row])) for row in range(motion.batch)]
        )
        way = (goals - at) / (goals - at).norm(dim=1, keepdim=True).clamp_min(1e-9)
        by = torch.zeros_like(way)
        for _ in range(APPROACHES):  # the gap is at most the distance
            moving = replace(motion.instants(step + 1), position=(motion.position[step + 1, rows]).clone()[None])
            moving.position[0, rows, body] += by
            depth = torch.cat([moving.wall_gaps[0, rows, body], moving.body_gaps[0, rows, body]], 1)
            by = by + way * (depth[rows, which] + size).clamp_min(0)[:, None]
        return replace(motion, position=shifted(motion.position, step, body, by, some)), some

    def _goal(self, motion: Trajectory, instant: int, row: int, at: Tensor, number: int) -> Tensor:
        """The point to which a body is pushed: behind a wall, or another body's centre."""
        walls = motion.system.walls
        if number >= len(walls):
            return motion.position[instant, row, number - len(walls)]
        wall = walls[number]
        if wall.normal is not None:
            return at - at.new_tensor(wall.normal)
        turn, half = rotated(at.new_tensor(wall.rotation)), at.new_tensor(wall.half_m)
        local = turn.T @ (at - at.new_tensor(wall.centre_m))
        return at.new_tensor(wall.centre_m) + turn @ torch.minimum(torch.maximum(local, -half), half)

    def correct(self, motion: Trajectory) -> Trajectory:
        """Pushes bodies out of walls and of each other, the lighter ones more; bodies that something drives stay."""
        for _ in range(PUSHES):
            position, last = motion.position[-1].clone(), motion.instants(torch.full((motion.batch,), motion.steps))
            for number, wall in enumerate(motion.system.walls):
                depth = (-last.wall_gaps[0, ..., number]).clamp_min(0)
                if (depth > 0).any():
                    position = position + depth[..., None] * self._out_of(wall, position)
            mass = torch.where(motion.driven, 1e9, motion.mass[-1])
            overlap = (-last.body_gaps[0]).clamp_min(0)
            apart = position[:, :, None] - position[:, None, :]
            away = apart / apart.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            share = mass[:, None, :] / (mass[:, None, :] + mass[:, :, None])
            position = position + (overlap * share)[..., None].mul(away).sum(2)
            motion = with_last(motion, position=position)
        return motion

    def _out_of(self, wall: Wall, position: Tensor) -> Tensor:
        """Unit vectors [B, N, 3] away from a wall."""
        if wall.normal is not None:
            return position.new_tensor(wall.normal).expand_as(position)
        turn, half = rotated(position.new_tensor(wall.rotation)), position.new_tensor(wall.half_m)
        local = (position - position.new_tensor(wall.centre_m)) @ turn
        outside = local - torch.minimum(torch.maximum(local, -half), half)
        face = torch.nn.functional.one_hot((half - local.abs()).argmin(-1), 3) * torch.where(local < 0, -1.0, 1.0)
        inside = outside.norm(dim=-1, keepdim=True) < 1e-9
        return torch.where(inside, face.double(), outside / outside.norm(dim=-1, keepdim=True).clamp_min(1e-9)) @ turn.T
