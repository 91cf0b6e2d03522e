"""Joints, speeds and torques stay within their limits, and rods keep their length."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory
from .law import SINGLE, largest, occasions, random_directions, shifted, with_last


class Limits:
    """The largest excess over a limit, as a share of its range; of a rod, as a share of its length."""

    name, unit = "limits", "share of the range"

    def missing(self, system: PhysicalSystem) -> str:
        any_limit = system.limits or system.rods or any(body.max_speed_m_s for body in system.bodies)
        return "" if any_limit else "needs the range of a joint, a speed or a torque, or a rod"

    def residual(self, motion: Trajectory) -> Tensor:
        worst = motion.position.new_zeros(motion.steps, motion.batch)
        for one in motion.system.limits:
            values = motion.channels[one.slot.channel][1:, :, one.slot.first]
            excess = torch.maximum(one.low - values, values - one.high) / (one.high - one.low)
            worst = torch.maximum(worst, excess)
        names = [body.name for body in motion.system.bodies]
        for rod in motion.system.rods:
            at = names.index(rod.body)
            apart = (motion.position[1:, :, at] - motion.position.new_tensor(rod.pivot_m)).norm(dim=-1)
            worst = torch.maximum(worst, (apart - rod.length_m).abs() / rod.length_m)
        fastest = self._fastest(motion)
        speed = (motion.velocity[1:].norm(dim=-1) - fastest) / fastest
        return torch.maximum(worst, largest(speed, (speed > 0) & motion.present[1:]))

    def _fastest(self, motion: Trajectory) -> Tensor:
        return motion.position.new_tensor([body.max_speed_m_s or 1e9 for body in motion.system.bodies])

    def floor(self, motion: Trajectory) -> float:
        return 10 * SINGLE

    def ceiling(self, motion: Trajectory) -> float:
        return 0.25

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        step, _, _ = occasions(torch.ones(motion.steps, motion.batch, 1, dtype=torch.bool), seeds)
        every, rows, system = torch.ones(motion.batch, dtype=torch.bool), torch.arange(motion.batch), motion.system
        if system.limits:
            one = system.limits[0]
            channel = motion.channels[one.slot.channel].clone()
            channel[step + 1, rows, one.slot.first] = one.high + size * (one.high - one.low)
            return replace(motion, channels={**motion.channels, one.slot.channel: channel}), every
        names = [body.name for body in system.bodies]
        if system.rods:
            rod, at = system.rods[0], torch.full_like(step, names.index(system.rods[0].body))
            arm = motion.position[step + 1, rows, at] - motion.position.new_tensor(rod.pivot_m)
            by = arm / arm.norm(dim=1, keepdim=True) * (rod.length_m * (1 + size) - arm.norm(dim=1, keepdim=True))
            return replace(motion, position=shifted(motion.position, step, at, by, every)), every
        fastest = self._fastest(motion)
        at = torch.full_like(step, int(fastest.argmin()))
        wanted = random_directions(motion, seeds) * float(fastest.min()) * (1 + size)
        by = wanted - motion.velocity[step + 1, rows, at]
        return replace(motion, velocity=shifted(motion.velocity, step, at, by, every)), every

    def correct(self, motion: Trajectory) -> Trajectory:
        """Clips numbers and speeds to their range, and puts bodies back on their rods, without speed along them."""
        position, velocity = motion.position[-1].clone(), motion.velocity[-1].clone()
        names = [body.name for body in motion.system.bodies]
        for rod in motion.system.rods:
            at, pivot = names.index(rod.body), motion.position.new_tensor(rod.pivot_m)
            arm = position[:, at] - pivot
            along = arm / arm.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            position[:, at] = pivot + rod.length_m * along
            velocity[:, at] -= (velocity[:, at] * along).sum(-1, keepdim=True) * along
        speed = velocity.norm(dim=-1)
        velocity = velocity * (self._fastest(motion) / speed.clamp_min(1e-12)).clamp_max(1)[..., None]
        channels = {name: part.clone() for name, part in motion.channels.items()}
        for one in motion.system.limits:
            channels[one.slot.channel][-1, :, one.slot.first].clamp_(one.low, one.high)
        return replace(with_last(motion, position=position, velocity=velocity), channels=channels)
