"""Constants of nature estimated from motion: gravity, restitution, friction."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from .laws.free_fall import ballistic
from .laws.support import floor_forces
from .trajectory import Trajectory

SLIDES = 0.05  # m/s at the point of contact, above which friction is kinetic
IMPACT = 5.0  # times what gravity changes in a step: approaching speeds of which a bounce is measured


@dataclass(frozen=True)
class PhysicalConstant:
    """A constant and how it is estimated: motion -> one value for each rollout [B], NaN where it shows none."""

    name: str
    unit: str
    estimate: Callable[[Trajectory], Tensor]


def gravity(motion: Trajectory) -> Tensor:
    """The median over steps in flight of the acceleration along gravity [B], m/s2. A bounce in mid-air, as predictions have them,
    counts as flight, and one of them would move a mean by as much as gravity."""
    down = motion.gravity / motion.gravity.norm().clamp_min(1e-12)
    pull = (motion.velocity.diff(dim=0) @ down) / motion.dt_s
    return _median(pull, ballistic(motion) & bool(motion.gravity.norm() > 0))


def restitution(motion: Trajectory) -> Tensor:
    """The median over bounces from walls of the normal speed after over that before [B], corrected for gravity. Speeds are those
    one step clear of the bounce at either side: predictions blur it over two steps."""
    values, masks = [], []
    speed_of_fall = motion.gravity.norm() * motion.dt_s
    for at, wall in enumerate(motion.system.walls):
        if wall.normal is None or motion.steps < 3:
            continue
        normal = motion.position.new_tensor(wall.normal)
        speed, gap, pull = motion.velocity @ normal, motion.wall_gaps[1:-2, ..., at], motion.gravity @ normal
        turns = (speed[1:-2] < 0) & (speed[2:-1] > 0) & motion.walls_touched[1:-1, ..., at]
        share = (gap.clamp_min(0) / -speed[1:-2].clamp_max(-1e-9) / motion.dt_s).clamp(
            0, 1
        )  # of the step, before the bounce
        arrives = -speed[:-3] - pull * (1 + share) * motion.dt_s
        leaves = speed[3:] - pull * (2 - share) * motion.dt_s
        alone = (
            motion.both_present
            & (motion.walls_touched.sum(-1) <= motion.walls_touched[..., at])
            & ~motion.bodies_touched.any(-1)
        )
        fast = (-speed[:-3] > IMPACT * speed_of_fall.clamp_min(0.02)) & (speed[3:] > 0)
        values.append(leaves / arrives.clamp_min(1e-9))
        masks.append(turns & fast & alone.unfold(0, 3, 1).all(-1) & ~motion.driven & ~motion.tied)
    if not values:
        return motion.position.new_full((motion.batch,), math.nan)
    return _median(torch.stack(values, -1).flatten(2), torch.stack(masks, -1).flatten(2))


def friction(motion: Trajectory) -> Tensor:
    """The median force sideways over that along the normal, of bodies that slide on a floor [B]."""
    if not any(wall.normal is not None for wall in motion.system.walls):
        return motion.position.new_full((motion.batch,), math.nan)
    alone, along, sideways, normal = floor_forces(motion)
    arm = -normal * motion.size[:-1, ..., None]
    slip = motion.velocity[:-1] + torch.linalg.cross(motion.spin[:-1], arm)
    slip = slip - (slip * normal).sum(-1, keepdim=True) * normal
    later = motion.velocity[1:] + torch.linalg.cross(motion.spin[1:], arm)
    later = later - (later * normal).sum(-1, keepdim=True) * normal
    slides = (slip.norm(dim=-1) > SLIDES) & (later.norm(dim=-1) > SLIDES) & (along > 0.5 * motion.gravity.norm())
    resting = (motion.velocity * 1.0).diff(dim=0).mul(normal).sum(-1).abs() < 0.2 * motion.gravity.norm() * motion.dt_s
    return _median(sideways.norm(dim=-1) / along.clamp_min(1e-9), alone & slides & resting)


CONSTANTS: Mapping[str, PhysicalConstant] = {
    "gravity": PhysicalConstant("gravity", "m/s2", gravity),
    "restitution": PhysicalConstant("restitution", "", restitution),
    "friction": PhysicalConstant("friction", "", friction),
}


def _median(values: Tensor, mask: Tensor) -> Tensor:
    """The median of values [T, B, N] where the mask is set [B], NaN where it is nowhere."""
    return torch.where(mask, values, math.nan).transpose(0, 1).flatten(1).nanmedian(1).values
