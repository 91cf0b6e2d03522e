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


@once
def impacts(motion: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
    """(bool [T, B, N]: the body is one of two spheres that nothing else touches, in a system that keeps its energy; its position
    and its velocity after the step [T, B, N, 3], by flight and one impact along the line of centres at most)."""
    group, closed = closed_groups(motion)
    count, system, dt_s = motion.position.shape[2], motion.system, motion.dt_s
    smooth = torch.tensor([max(body.half_m) == 0 and body.spin is None for body in system.bodies])
    pair = closed & (group.sum(-1) == 2) & ~(group & ~smooth).any(-1)
    place, speed, fall = motion.position[:-1], motion.velocity[:-1], motion.gravity * dt_s
    if system.dissipates or system.tracked or not pair.any():
        return torch.zeros_like(pair), motion.position[1:], motion.velocity[1:]
    other = (group & ~torch.eye(count, dtype=torch.bool)).double().argmax(-1)
    vectors = other[..., None].expand_as(place)
    apart, closing = place.gather(2, vectors) - place, speed.gather(2, vectors) - speed
    reach = motion.radius[:-1] + motion.radius[:-1].gather(2, other)
    a, b, c = closing.square().sum(-1), (apart * closing).sum(-1), apart.square().sum(-1) - reach.square()
    root = b * b - a * c
    until = (-b - root.clamp_min(0).sqrt()) / a.clamp_min(1e-12)
    hits = (b < 0) & (root > 0) & (until <= dt_s)
    until = torch.where(hits, until.clamp_min(0), dt_s)[..., None]
    normal = apart + closing * until
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    mass = motion.mass[:-1]
    share = 2 * mass.gather(2, other) / (mass + mass.gather(2, other)).clamp_min(1e-12)
    kick = torch.where(hits, share * (closing * normal).sum(-1), 0.0)[..., None] * normal
    return pair, place + (speed + 0.5 * fall) * dt_s + kick * (dt_s - until), speed + fall + kick


class Momentum:
    """The change of a group's velocity that gravity does not explain; of two spheres that keep their energy, what an impact or
    flight leaves out of the velocity of each."""

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
        pair, _, velocity = impacts(motion)
        missed = (motion.velocity[1:] - velocity).norm(dim=-1)
        return torch.maximum(largest(sums.norm(dim=-1) / masses, closed), largest(missed, pair))

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
        """The group's excess is taken from the velocity of each of its bodies; two spheres move as `impacts` says."""
        group, closed = (part[-1] for part in closed_groups(motion))
        mass = motion.mass[-1]
        impulse = mass[..., None] * (motion.velocity[-1] - motion.velocity[-2] - motion.gravity * motion.dt_s)
        excess = torch.einsum("bij,bjk->bik", group.double(), impulse)
        excess = excess / torch.einsum("bij,bj->bi", group.double(), mass).clamp_min(1e-12)[..., None]
        velocity = torch.where(closed[..., None], motion.velocity[-1] - excess, motion.velocity[-1])
        pair, place, speed = (part[-1] for part in impacts(motion))
        return with_last(
            motion,
            position=torch.where(pair[..., None], place, motion.position[-1]),
            velocity=torch.where(pair[..., None], speed, velocity),
        )
