"""Laws of physics as a part of the loss of a latent world whose vectors are the motion of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ...physics import PhysicalSystem, Tolerance, calibrate, trajectory_of
from ...worlds.latent_network import LatentNetwork
from ..recording import Recording

TRUTH = 400  # true rollouts from which tolerances are taken
FEWEST = 99  # with fewer tolerances mean little
MOST = 10.0  # tolerances: a violation beyond it counts as this one


@dataclass(frozen=True)
class LawLoss:
    """The mean violation of the laws in rollouts, beyond their tolerances and in units of them."""

    system: PhysicalSystem
    dt_s: float
    tolerances: Sequence[Tolerance]
    vectors: tuple[tuple[str, int], ...]

    @staticmethod
    def of(recording: Recording, network: LatentNetwork, steps: int) -> LawLoss | None:
        """With the tolerances of true rollouts of `steps` steps. None where the recording describes no bodies, the world does
        not predict their channels, or no law applies."""
        cache, vectors = recording.cache, network.config.vectors
        facts, names = cache.world.get("system"), [name for name, _ in vectors]
        system = PhysicalSystem.from_json(facts) if facts else None
        rows = recording.rows_within(0, steps)
        if system is None or not set(system.channels) <= set(names) or len(rows) < FEWEST:
            return None
        rows = rows[:: max(1, len(rows) // TRUTH)] + np.arange(steps + 1)[:, None]
        arrays = {name: cache.arrays[cache.keys.get(name, name)] for name in system.channels}
        truth = {name: torch.from_numpy(np.array(array[rows], np.float32)) for name, array in arrays.items()}
        dt_s = cache.world.get("dt_s", 1 / cache.fps)
        tolerances = [one for one in calibrate(trajectory_of(system, truth, dt_s)) if not one.wrong_here]
        return LawLoss(system, dt_s, tolerances, vectors) if tolerances else None

    def __call__(self, numbers: torch.Tensor) -> torch.Tensor:
        """Of rollouts [B, T + 1, V] of all vectors, in their own units."""
        if numbers.requires_grad:
            numbers.register_hook(lambda gradient: gradient.nan_to_num(0.0, 0.0, 0.0))  # of norms of nothing
        parts = numbers.transpose(0, 1).split([width for _, width in self.vectors], 2)
        motion = trajectory_of(self.system, dict(zip((name for name, _ in self.vectors), parts)), self.dt_s)
        beyond = [(one.law.residual(motion) / one.value - 1).clamp(0, MOST).mean() for one in self.tolerances]
        return torch.stack(beyond).mean().to(numbers)
