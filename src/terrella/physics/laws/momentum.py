"""Bodies that touch only each other keep their common momentum, but for gravity."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory, once
from .law import SINGLE, largest, occasions, random_directions, shifted, with_last


@once
def closed_groups(motion: Trajectory) -> tuple[Tensor, Tensor]:
    """(bool [T, B, N, N]: bodies of one group, which touch each other in a chain; bool [T, B, N]: the body's group has two
    members or more, and nothing else touches it)."""
    group = motion.bodies_touched | torch.eye(motion.position.shape[2], dtype=torch.bool)
    for _ in range(max(1, motion.position.shape[2].bit_length())):
        group = (group.double() @ group.double()) > 0
    outside = motion.walls_touched.any(-1) | motion.driven | motion.tied | ~motion.both_present
    return group, ~(group & outside[..., None, :]).any(-1) & (group.sum(-1) > 1)


class Momentum:
    """The change of a group's velocity that gravity does not explain."""

    name, unit = "momentum", "m/s"

    def missing(self, system: PhysicalSystem) -> str:
        free = [body for body in system.bodies if not body.driven]
        if len(free) < 2:
            return "needs two bodies that nothing drives"
        return f"needs the positions of {', '.join(system.hidden)}, which may push" if system.hidden else ""

    def residual(self, motion: Trajectory) -> Tensor:
        group, closed = closed_groups(motion)
        mass = motion.mass[1:]
        impulse = mass[..., None] * (motion.velocity.diff(dim=0) - motion.gravity * motion.dt_s)
        sums = torch.einsum("tbij,tbjk->tbik", group.double(), impulse)
        masses = torch.einsum("tbij,tbj->tbi", group.double(), mass).clamp_min(1e-12)
        return largest(sums.norm(dim=-1) / masses, closed)

    def floor(self, motion: Trajectory) -> float:
        return SINGLE * float(motion.velocity.abs().max().clamp_min(1.0))

    def ceiling(self, motion: Trajectory) -> float:
        return 0.5 * float(motion.velocity.norm(dim=-1).mean().clamp_min(1e-6))

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        group, closed = closed_groups(motion)
        step, body, some = occasions(closed, seeds)
        rows = torch.arange(motion.batch)
        mass = motion.mass[step + 1, rows]
        share = (group[step, rows, body] * mass).sum(1) / mass[rows, body]
        by = random_directions(motion, seeds) * (size * share)[:, None]
        return replace(motion, velocity=shifted(motion.velocity, step, body, by, some)), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """The group's excess is taken from the velocity of each of its bodies."""
        group, closed = (part[-1] for part in closed_groups(motion))
        mass = motion.mass[-1]
        impulse = mass[..., None] * (motion.velocity[-1] - motion.velocity[-2] - motion.gravity * motion.dt_s)
        excess = torch.einsum("bij,bjk->bik", group.double(), impulse)
        excess = excess / torch.einsum("bij,bj->bi", group.double(), mass).clamp_min(1e-12)[..., None]
        return with_last(
            motion, velocity=torch.where(closed[..., None], motion.velocity[-1] - excess, motion.velocity[-1])
        )
