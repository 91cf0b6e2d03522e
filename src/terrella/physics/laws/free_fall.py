"""A body that touches nothing accelerates with gravity alone."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem, Rod
from ..trajectory import Trajectory, once
from .law import SINGLE, largest, occasions, random_directions, shifted, with_last

SUBSTEPS = 4  # of a swing


@once
def ballistic(motion: Trajectory) -> Tensor:
    """bool [T, B, N]: steps in which the acceleration of a body is that of gravity. Velocities that are differences of positions
    need two such steps."""
    measured = torch.tensor([body.velocity is not None for body in motion.system.bodies])
    before = torch.cat([torch.zeros_like(motion.clear[:1]), motion.clear[:-1]])
    return motion.clear & (measured | before)


@once
def swinging(motion: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
    """(bool [T, B, N]: the body hangs on one rod alone and touches nothing; its position and its velocity after the step
    [T, B, N, 3], by the classical Runge-Kutta method)."""
    system, names = motion.system, [body.name for body in motion.system.bodies]
    hangs = torch.zeros_like(motion.both_present)
    place, velocity = motion.position[1:].clone(), motion.velocity[1:].clone()
    touched = motion.walls_touched.any(-1) | motion.bodies_touched.any(-1) | ~motion.both_present | motion.driven
    for rod in rods_alone(system):
        at, pivot = names.index(rod.body), motion.position.new_tensor(rod.pivot_m)
        hangs[:, :, at] = ~touched[:, :, at]
        arm, speed = motion.position[:-1, :, at] - pivot, motion.velocity[:-1, :, at]
        for _ in range(SUBSTEPS):
            arm, speed = _swung(arm, speed, motion.gravity, motion.dt_s / SUBSTEPS)
        place[:, :, at], velocity[:, :, at] = pivot + arm, speed
    return hangs, place, velocity


def rods_alone(system: PhysicalSystem) -> list[Rod]:
    """The rods that alone hold a body whose velocity is in a channel."""
    held = [rod.body for rod in system.rods]
    measured = {body.name for body in system.bodies if body.velocity is not None and not body.driven}
    return [rod for rod in system.rods if held.count(rod.body) == 1 and rod.body in measured]


def _swung(arm: Tensor, speed: Tensor, gravity: Tensor, dt_s: float) -> tuple[Tensor, Tensor]:
    """The arm and the speed [..., 3] of a body on a rod after `dt_s` seconds."""

    def slope(arm: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        pull = (speed.square().sum(-1, keepdim=True) + (arm @ gravity)[..., None]) / arm.square().sum(-1, keepdim=True)
        return speed, gravity - pull * arm

    first = slope(arm, speed)
    second = slope(arm + 0.5 * dt_s * first[0], speed + 0.5 * dt_s * first[1])
    third = slope(arm + 0.5 * dt_s * second[0], speed + 0.5 * dt_s * second[1])
    fourth = slope(arm + dt_s * third[0], speed + dt_s * third[1])
    sums = [one + 2 * two + 2 * three + four for one, two, three, four in zip(first, second, third, fourth)]
    return arm + dt_s / 6 * sums[0], speed + dt_s / 6 * sums[1]


class FreeFall:
    """The acceleration in flight minus gravity; of a body on a rod, minus that of its swing."""

    name, unit = "free fall", "m/s2"

    def missing(self, system: PhysicalSystem) -> str:
        tied = {rod.body for rod in system.rods} - {rod.body for rod in rods_alone(system)}
        if not [body for body in system.bodies if not body.driven and body.name not in tied]:
            return "needs a body that nothing drives or holds"
        return f"needs the positions of {', '.join(system.hidden)}, which may push" if system.hidden else ""

    def residual(self, motion: Trajectory) -> Tensor:
        acceleration = motion.velocity.diff(dim=0) / motion.dt_s
        hangs, _, velocity = swinging(motion)
        missed = (motion.velocity[1:] - velocity).norm(dim=-1) / motion.dt_s
        missed = torch.where(hangs, missed, (acceleration - motion.gravity).norm(dim=-1))
        return largest(missed, ballistic(motion) | hangs)

    def floor(self, motion: Trajectory) -> float:
        return SINGLE * float(motion.velocity.abs().max().clamp_min(1.0)) / motion.dt_s

    def ceiling(self, motion: Trajectory) -> float:
        least = 0.25 * float(motion.gravity.norm())
        return least or 0.25 * float(motion.velocity.norm(dim=-1).mean()) / motion.dt_s

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        step, body, some = occasions(ballistic(motion) | swinging(motion)[0], seeds)
        by = random_directions(motion, seeds) * size * motion.dt_s
        return replace(motion, velocity=shifted(motion.velocity, step, body, by, some)), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """Flight, or the swing on a rod, from the instant before."""
        flies, dt_s, pull = ballistic(motion)[-1][..., None], motion.dt_s, motion.gravity
        before, speed = motion.position[-2], motion.velocity[-2]
        hangs, place, velocity = (part[-1] for part in swinging(motion))
        hangs = hangs[..., None]
        place, velocity = (
            torch.where(hangs, place, motion.position[-1]),
            torch.where(hangs, velocity, motion.velocity[-1]),
        )
        return with_last(
            motion,
            position=torch.where(flies, before + speed * dt_s + 0.5 * pull * dt_s**2, place),
            velocity=torch.where(flies, speed + pull * dt_s, velocity),
        )
