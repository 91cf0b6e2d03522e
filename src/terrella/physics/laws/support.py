"""What rests or slides on a floor is pushed by it alone: never pulled, and sideways by the friction coefficient at most."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory, once
from .law import SINGLE, largest, occasions, shifted, with_last

FAST = 5.0  # times what gravity changes in a step: slower arrivals may bounce twice in it


@once
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


@once
def bounces(motion: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
    """(bool [T, B, N]: the body hits one plane within the step, by its flight; the height above contact, m, and the speed along the
    normal, m/s, that a bounce with the body's restitution gives, each [T, B, N])."""
    walls, dt_s = motion.system.walls, motion.dt_s
    planes = [at for at, wall in enumerate(walls) if wall.normal is not None]
    alone, _, _, normal = floor_forces(motion)
    which = motion.walls_touched[..., planes].double().argmax(-1, keepdim=True)
    gap = motion.wall_gaps[:-1][..., planes].gather(-1, which)[..., 0].clamp_min(0)
    speed, pull = (motion.velocity[:-1] * normal).sum(-1), -(motion.gravity * normal).sum(-1)
    falls = (speed + (speed.square() + 2 * pull * gap).clamp_min(0).sqrt()) / pull.clamp_min(1e-9)
    until = torch.where(pull > 1e-9, falls, gap / (-speed).clamp_min(1e-9))
    arrives, left = pull * until - speed, (dt_s - until).clamp_min(0)
    known = [body.restitution for body in motion.system.bodies]
    leaves = arrives * motion.position.new_tensor([value or 0.0 for value in known])
    fast = arrives > FAST * (motion.gravity.norm() * dt_s).clamp_min(0.02)
    hits = alone & fast & (until <= dt_s) & torch.tensor([value is not None for value in known])
    return hits, leaves * left - 0.5 * pull * left**2, leaves - pull * left


class Support:
    """The force on a body beyond the friction cone of its floor, by mass; of bodies with a known restitution, what a bounce leaves
    out."""

    name, unit = "support and friction", "m/s2"

    def missing(self, system: PhysicalSystem) -> str:
        if not any(wall.normal is not None for wall in system.walls):
            return "needs a floor (a wall with a normal)"
        if system.tracked:
            return "needs velocities in a channel: those of tracks do not say in which step a bounce was"
        tied = {rod.body for rod in system.rods}
        if not [body for body in system.bodies if not body.driven and body.name not in tied]:
            return "needs a body that nothing drives or holds"
        return f"needs the positions of {', '.join(system.hidden)}, which may push" if system.hidden else ""

    def residual(self, motion: Trajectory) -> Tensor:
        alone, along, sideways, _ = floor_forces(motion)
        beyond = (sideways.norm(dim=-1) - self._cone(motion) * along.clamp_min(0)).clamp_min(0)
        excess = torch.maximum((-along).clamp_min(0), beyond)
        hits, _, speed = bounces(motion)
        normal = floor_forces(motion)[3]
        missed = ((motion.velocity[1:] * normal).sum(-1) - speed).abs() / motion.dt_s
        return largest(torch.where(hits, torch.maximum(excess, missed), excess), alone)

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
        """The force is projected onto the friction cone; a bounce has the known restitution."""
        alone, along, sideways, normal = (part[-1] for part in floor_forces(motion))
        push = along.clamp_min(0)
        share = (self._cone(motion) * push / sideways.norm(dim=-1).clamp_min(1e-12)).clamp_max(1)
        force = push[..., None] * normal + share[..., None] * sideways
        velocity = motion.velocity[-2] + (force + motion.gravity) * motion.dt_s
        hits, height, speed = (part[-1][..., None] for part in bounces(motion))
        velocity = torch.where(hits, velocity + (speed - (velocity * normal).sum(-1, keepdim=True)) * normal, velocity)
        place = motion.position[-1] + (height - self._gap(motion)) * normal
        position = torch.where(hits, place, motion.position[-1])
        return with_last(
            motion, position=position, velocity=torch.where(alone[..., None], velocity, motion.velocity[-1])
        )

    def _gap(self, motion: Trajectory) -> Tensor:
        """The gap [B, N, 1] to the touched plane at the last instant."""
        planes = [at for at, wall in enumerate(motion.system.walls) if wall.normal is not None]
        which = motion.walls_touched[-1][..., planes].double().argmax(-1, keepdim=True)
        return motion.wall_gaps[-1][..., planes].gather(-1, which)
