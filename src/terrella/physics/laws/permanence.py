"""Bodies neither appear nor vanish, and stay within the bounds of their world."""

from dataclasses import replace

import torch
from torch import Tensor

from ..system import PhysicalSystem
from ..trajectory import Trajectory
from .law import occasions, with_last

_PLACE = ("position", "velocity", "rotation", "spin", "radius")
MERGED = 0.1  # of the sum of two sizes: nearer centres are one body


class Permanence:
    """The number of bodies that are missing, new, out of bounds, or at one place with another."""

    name, unit = "permanence", "bodies"

    def missing(self, system: PhysicalSystem) -> str:
        counted = any(body.present for body in system.bodies) or len(system.bodies) > 1 or system.bounds_m
        return "" if counted else "needs bounds, a channel that says which bodies are present, or a second body"

    def residual(self, motion: Trajectory) -> Tensor:
        changed = (motion.present[1:] != motion.present[:1]).sum(-1)
        lost = torch.zeros_like(changed)
        if motion.system.bounds_m is not None:
            low, high = motion.position.new_tensor(motion.system.bounds_m)
            outside = (motion.position[1:] < low).any(-1) | (motion.position[1:] > high).any(-1)
            lost = (outside & motion.present[1:]).sum(-1)
        apart = torch.cdist(motion.position[1:], motion.position[1:])
        near = apart < MERGED * (motion.size[1:, :, :, None] + motion.size[1:, :, None, :])
        here = motion.present[1:, :, :, None] & motion.present[1:, :, None, :]
        merged = (near & here).triu(1).sum((-1, -2))
        return (changed + lost + merged).double()

    def floor(self, motion: Trajectory) -> float:
        return 0.5

    def ceiling(self, motion: Trajectory) -> float:
        return 0.75

    def violate(self, motion: Trajectory, size: float, seeds: Tensor) -> tuple[Trajectory, Tensor]:
        """One body vanishes (`size` is 1 at twice the tolerance)."""
        step, body, some = occasions(motion.both_present, seeds)
        instants = torch.arange(motion.steps + 1)[:, None] > step[None, :]
        gone = (instants & some)[..., None] & (torch.arange(motion.present.shape[2]) == body[:, None])[None]
        return replace(motion, present=motion.present & ~gone), some

    def correct(self, motion: Trajectory) -> Trajectory:
        """Bodies that vanished go on as they went; those that left the bounds are where they were; new ones go."""
        was, vanished = motion.present[-2], motion.present[-2] & ~motion.present[-1]
        parts = {name: _before(motion, name, vanished, getattr(motion, name)[-1]) for name in _PLACE}
        parts["position"] = parts["position"] + vanished[..., None] * motion.velocity[-2] * motion.dt_s
        if motion.system.bounds_m is not None:
            low, high = motion.position.new_tensor(motion.system.bounds_m)
            lost = ((parts["position"] < low) | (parts["position"] > high)).any(-1)
            parts = {name: _before(motion, name, lost, part) for name, part in parts.items()}
        return with_last(motion, present=was, **parts)


def _before(motion: Trajectory, name: str, rows: Tensor, last: Tensor) -> Tensor:
    """`last` [B, N, ...], with the instant before in the bodies `rows` (bool [B, N])."""
    return torch.where(rows[..., None] if last.ndim > 2 else rows, getattr(motion, name)[-2], last)
