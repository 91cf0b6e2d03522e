"""Budget: the time that the stages of a training run share, what earlier runs took of it included."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path

from .run_folder import stages_of


class Budget:
    """`hours` for all stages of the run in `folder`, counted from now on and from what its stages say that was spent before.

    shares: stage -> the share of the hours that it may take at most.
    """

    def __init__(self, folder: Path | None = None, hours: float = math.inf, shares: Mapping[str, float] | None = None):
        self.seconds, self._shares = 3600 * hours, shares or {}
        found = () if folder is None else stages_of(folder)
        self._before = max((float(facts.get("spent", 0.0)) for facts in found), default=0.0)
        self._began = time.monotonic()

    @property
    def spent_s(self) -> float:
        return self._before + time.monotonic() - self._began

    @property
    def left_s(self) -> float:
        return self.seconds - self.spent_s

    def most_s(self, stage: str) -> float:
        """Seconds that a stage may take at most."""
        return self._shares[stage] * self.seconds if stage in self._shares else math.inf
