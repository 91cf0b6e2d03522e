"""A body that touches nothing accelerates with gravity alone."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory, once
from .law import SINGLE, largest, occasions, random_directions, shifted, with_last


@once
def ballistic(motion: Trajectory) -> Tensor:
    """bool [T, B, N]: steps in which the acceleration of a body is that of gravity. Velocities that are differences of positions
    need two such steps."""
    measured = torch.tensor([body.velocity is not None for body in motion.system.bodies])
    before = torch.cat([torch.zeros_like(motion.clear[:1]), motion.clear[:-1]])
    return motion.clear & (measured | before)


class FreeFall:
    """The acceleration in flight minus gravity."""

    name, unit = "free fall", "m/s2"

    def missing(self, system: PhysicalSystem) -> str:
        tied = {rod.body for rod in system.rods}
        if not [body for body in system.bodies if not body.driven and body.name not in tied]:
            return "needs a body that nothing drives or holds"
        return f"needs the positions of {', '.join(system.hidden)}, which may push" if system.hidden else ""

    def residual(self, motion: Trajectory) -> Tensor:
        acceleration = motion.velocity.diff(dim=0) / motion.dt_s
        return largest((acceleration - motion.gravity).norm(dim=-1), ballistic(motion))

    def floor(self, motion: Trajectory) -> float:
        return SINGLE * float(motion.velocity.abs().max().clamp_min(1.0)) / motion.dt_s

    def ceiling(self, motion: Trajectory) -> float:
        least = 0.25 * float(motion.gravity.norm())
        return least or 0.25 * float(motion.velocity.norm(dim=-1).mean()) / motion.dt_s

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        step, body, some = occasions(ballistic(motion), seeds)
        by = random_directions(motion, seeds) * size * motion.dt_s
        return replace(motion, velocity=shifted(motion.velocity, step, body, by, some)), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """Flight from the instant before."""
        flies, dt_s, pull = ballistic(motion)[-1][..., None], motion.dt_s, motion.gravity
        before, speed = motion.position[-2], motion.velocity[-2]
        position = torch.where(flies, before + speed * dt_s + 0.5 * pull * dt_s**2, motion.position[-1])
        return with_last(
            motion, position=position, velocity=torch.where(flies, speed + pull * dt_s, motion.velocity[-1])
        )
