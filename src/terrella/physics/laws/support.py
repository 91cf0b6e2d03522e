"""What rests or slides on a floor is pushed by it alone: never pulled, and sideways by the friction coefficient at most."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory
from .law import SINGLE, largest, occasions, shifted, with_last


def floor_forces(motion: Trajectory) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(bool [T, B, N]: the body may have touched one plane and nothing else; the force from it by mass, along its normal
    [T, B, N] and sideways [T, B, N, 3], m/s2; the normals [T, B, N, 3])."""
    walls = motion.system.walls
    planes = [at for at, wall in enumerate(walls) if wall.normal is not None]
    normals = motion.position.new_tensor([walls[at].normal for at in planes])
    touched = motion.walls_touched
    alone = (touched.sum(-1) == 1) & touched[..., planes].any(-1) & ~motion.bodies_touched.any(-1)
    alone = alone & motion.both_present & ~motion.driven & ~motion.tied
    normal = normals[touched[..., planes].double().argmax(-1)]
    force = motion.velocity.diff(dim=0) / motion.dt_s - motion.gravity
    along = (force * normal).sum(-1)
    return alone, along, force - along[..., None] * normal, normal


class Support:
    """The force on a body beyond the friction cone of its floor, by mass."""

    name, unit = "support and friction", "m/s2"

    def missing(self, system: PhysicalSystem) -> str:
        if not any(wall.normal is not None for wall in system.walls):
            return "needs a floor (a wall with a normal)"
        tied = {rod.body for rod in system.rods}
        if not [body for body in system.bodies if not body.driven and body.name not in tied]:
            return "needs a body that nothing drives or holds"
        return f"needs the positions of {', '.join(system.hidden)}, which may push" if system.hidden else ""

    def residual(self, motion: Trajectory) -> Tensor:
        alone, along, sideways, _ = floor_forces(motion)
        beyond = (sideways.norm(dim=-1) - self._cone(motion) * along.clamp_min(0)).clamp_min(0)
        return largest(torch.maximum((-along).clamp_min(0), beyond), alone)

    def _cone(self, motion: Trajectory) -> Tensor:
        """The friction coefficient of each body [N], infinite where it is unknown."""
        known = [body.friction for body in motion.system.bodies]
        return motion.position.new_tensor([1e9 if value is None else value for value in known])

    def floor(self, motion: Trajectory) -> float:
        return SINGLE * float(motion.velocity.abs().max().clamp_min(1.0)) / motion.dt_s

    def ceiling(self, motion: Trajectory) -> float:
        return float(motion.gravity.norm()) or 1.0

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        """The floor pulls the body by `size`."""
        alone, along, _, normal = floor_forces(motion)
        step, body, some = occasions(alone, seeds)
        rows = torch.arange(motion.batch)
        by = -(along[step, rows, body] + size)[:, None] * normal[step, rows, body] * motion.dt_s
        return replace(motion, velocity=shifted(motion.velocity, step, body, by, some)), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """The force is projected onto the friction cone."""
        alone, along, sideways, normal = (part[-1] for part in floor_forces(motion))
        push = along.clamp_min(0)
        share = (self._cone(motion) * push / sideways.norm(dim=-1).clamp_min(1e-12)).clamp_max(1)
        force = push[..., None] * normal + share[..., None] * sideways
        velocity = motion.velocity[-2] + (force + motion.gravity) * motion.dt_s
        return with_last(motion, velocity=torch.where(alone[..., None], velocity, motion.velocity[-1]))
