"""Mechanical energy does not rise where nothing does work; in a system without friction it is constant."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory, once
from .law import SINGLE, occasions, with_last


@once
def energy(motion: Trajectory) -> Tensor:
    """Kinetic and potential energy of the bodies that nothing drives [T + 1, B], J. The speed of a body on a rod without a velocity
    channel is that of the middle of a step, and so is its height."""
    moving = motion.present & ~motion.driven
    kinetic = 0.5 * motion.mass * motion.velocity.square().sum(-1)
    turning = 0.5 * (motion.inertia * motion.spin.square()).sum(-1)
    middle = torch.cat([motion.position[:1] + motion.position[1:2], motion.position[1:] + motion.position[:-1]]) / 2
    measured = torch.tensor([body.velocity is not None for body in motion.system.bodies])
    place = (
        torch.where((motion.tied & ~measured)[:, None], middle, motion.position) if motion.steps else motion.position
    )
    potential = -motion.mass * (place @ motion.gravity)
    return ((kinetic + turning + potential) * moving).sum(-1)


@once
def energy_scale(motion: Trajectory) -> Tensor:
    """The largest kinetic energy so far, and the lift of all bodies by their own size [T + 1, B], J."""
    moving = motion.present & ~motion.driven
    kinetic = 0.5 * (motion.mass * motion.velocity.square().sum(-1) * moving).sum(-1)
    lift = (motion.mass * motion.size * moving).sum(-1) * motion.gravity.norm()
    return (kinetic.cummax(0).values + lift).clamp_min(1e-9)


class Energy:
    """The energy above the lowest since something last did work; without dissipation, its distance to the first one."""

    name, unit = "energy", "share of the kinetic energy"

    def missing(self, system: PhysicalSystem) -> str:
        free = [body for body in system.bodies if not body.driven]
        if not free:
            return "needs a body that nothing drives"
        if system.hidden:
            return f"needs the positions of {', '.join(system.hidden)}, which may do work"
        return ""

    def residual(self, motion: Trajectory) -> Tensor:
        whole, scale, alone = energy(motion), energy_scale(motion), motion.left_alone
        base, excess = whole[0], []
        for step in range(motion.steps):
            base = torch.where(alone[step], base, whole[step + 1])
            above = whole[step + 1] - base
            excess.append((above if motion.system.dissipates else above.abs()) / scale[step + 1])
            base = torch.minimum(base, whole[step + 1]) if motion.system.dissipates else base
        return torch.stack(excess).clamp_min(0) if excess else whole[1:]

    def floor(self, motion: Trajectory) -> float:
        return 10 * SINGLE

    def ceiling(self, motion: Trajectory) -> float:
        return 0.5

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        """Scales the speeds of one instant, so that the energy is `size` above that of the instant before."""
        kinetic = 0.5 * (motion.mass * motion.velocity.square().sum(-1) * ~motion.driven).sum(-1)
        step, _, some = occasions((motion.left_alone & (kinetic[1:] > 1e-9))[..., None], seeds)
        rows = torch.arange(motion.batch)
        whole, scale = energy(motion), energy_scale(motion)
        goal = whole[step, rows] + size * scale[step + 1, rows] - whole[step + 1, rows] + kinetic[step + 1, rows]
        goal = torch.maximum(goal, goal / (1 - min(size, 0.9)))  # the scale grows with the speed
        factor = (goal.clamp_min(0) / kinetic[step + 1, rows].clamp_min(1e-12)).sqrt()
        velocity = motion.velocity.clone()
        free = ~motion.driven
        for row in some.nonzero()[:, 0].tolist():
            velocity[step[row] + 1, row, free] *= factor[row]
        return replace(motion, velocity=velocity), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """Scales the speeds, so that the energy is that before the step; what heights alone exceed it by, bodies sink back."""
        whole, free = energy(motion), ~motion.driven[None, :]
        moving = (motion.present[-1] & free).double()
        turning = 0.5 * (motion.inertia[-1] * motion.spin[-1].square()).sum(-1)
        kinetic = ((0.5 * motion.mass[-1] * motion.velocity[-1].square().sum(-1) + turning) * moving).sum(-1)
        excess = whole[-1] - (whole[:-1].amin(0) if motion.system.dissipates else whole[-2])
        wrong = ((excess > 0) | (not motion.system.dissipates)) & motion.left_alone[-1]
        factor = ((kinetic - excess).clamp_min(0) / kinetic.clamp_min(1e-12)).sqrt()
        factor = torch.where(wrong[:, None] & free, torch.where(kinetic > 1e-9, factor, 1.0)[:, None], 1.0)[..., None]
        rise = (motion.position[-2] - motion.position[-1]) @ motion.gravity
        rise = rise.clamp_min(0) * motion.mass[-1] * moving * ~motion.tied
        share = torch.where(wrong, (excess - kinetic).clamp_min(0) / rise.sum(-1).clamp_min(1e-12), 0.0).clamp_max(1)
        down = motion.gravity / motion.gravity.square().sum().clamp_min(1e-12)
        sunk = (share[:, None] * rise / motion.mass[-1].clamp_min(1e-12))[..., None] * down
        return with_last(
            motion,
            position=motion.position[-1] + sunk,
            velocity=motion.velocity[-1] * factor,
            spin=motion.spin[-1] * factor,
        )
