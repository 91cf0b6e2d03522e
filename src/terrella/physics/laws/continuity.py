"""Bodies move as their velocities say: no jumps."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory, once
from .law import SINGLE, largest, occasions, random_directions, shifted, with_last


@once
def gentle(motion: Trajectory) -> Tensor:
    """bool [T, B, N]: steps in flight, or in which the velocity changes by no more than gravity changes it."""
    change = motion.velocity.diff(dim=0).norm(dim=-1)
    return motion.clear | ((change < motion.gravity.norm() * motion.dt_s) & ~motion.tied)


class Continuity:
    """In flight, and where the velocity hardly changes, the displacement minus that of the mean velocity; in impacts, what it
    exceeds the largest speed by. Of bodies without a velocity: what it exceeds their declared speed by, or else its change."""

    name, unit = "continuity", "m"

    def missing(self, system: PhysicalSystem) -> str:
        return ""

    def residual(self, motion: Trajectory) -> Tensor:
        return largest(self._jumps(motion), motion.both_present)

    def _jumps(self, motion: Trajectory) -> Tensor:
        way, dt_s = motion.position.diff(dim=0), motion.dt_s
        mean = 0.5 * (motion.velocity[1:] + motion.velocity[:-1])
        smooth = (way - mean * dt_s).norm(dim=-1)
        speed = motion.velocity.norm(dim=-1)
        reach = dt_s * torch.maximum(speed[1:], speed[:-1])
        rough = (way.norm(dim=-1) - reach).clamp_min(0)
        fastest = motion.position.new_tensor([body.max_speed_m_s or 0.0 for body in motion.system.bodies])
        change = (way - torch.cat([way[:1], way[:-1]])).norm(dim=-1)
        change = torch.where(fastest > 0, (way.norm(dim=-1) - fastest * dt_s).clamp_min(0), change)
        measured = torch.tensor([body.velocity is not None for body in motion.system.bodies])
        return torch.where(measured, torch.where(gentle(motion), smooth, rough), change)

    def floor(self, motion: Trajectory) -> float:
        return SINGLE * float(motion.position.abs().max().clamp_min(1.0))

    def ceiling(self, motion: Trajectory) -> float:
        return float(motion.size[motion.present].mean())

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        step, body, some = occasions(motion.both_present, seeds)
        rows = torch.arange(motion.batch)
        way = motion.position[step + 1, rows, body] - motion.position[step, rows, body]
        speed = motion.velocity[:, rows, body].norm(dim=-1)
        declared = motion.position.new_tensor([body.max_speed_m_s or 0.0 for body in motion.system.bodies])[body]
        speed = torch.maximum(speed, declared)
        reach = motion.dt_s * torch.maximum(speed[step + 1, rows], speed[step, rows])
        length = way.norm(dim=1)
        ahead = torch.where(
            (length > 1e-9)[:, None], way / length.clamp_min(1e-9)[:, None], random_directions(motion, seeds)
        )
        slack = torch.where(gentle(motion)[step, rows, body], 0.0, (reach - length).clamp_min(0))
        return replace(
            motion, position=shifted(motion.position, step, body, ahead * (slack + size)[:, None], some)
        ), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """In flight, the displacement of the mean velocity; in contact, a displacement that the speed allows."""
        way, dt_s = motion.position[-1] - motion.position[-2], motion.dt_s
        mean = 0.5 * (motion.velocity[-1] + motion.velocity[-2]) * dt_s
        reach = dt_s * torch.maximum(motion.velocity[-1].norm(dim=-1), motion.velocity[-2].norm(dim=-1))
        fastest = motion.position.new_tensor([body.max_speed_m_s or 0.0 for body in motion.system.bodies])
        measured = torch.tensor([body.velocity is not None for body in motion.system.bodies])
        reach = torch.where(measured, reach, torch.where(fastest > 0, fastest * dt_s, way.norm(dim=-1)))
        short = way * (reach / way.norm(dim=-1).clamp_min(1e-12)).clamp_max(1)[..., None]
        smooth = (gentle(motion)[-1] & measured)[..., None]
        return with_last(motion, position=motion.position[-2] + torch.where(smooth, mean, short))
