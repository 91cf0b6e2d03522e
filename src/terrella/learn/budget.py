"""Budget: the time that the stages of a training run share, earlier runs included."""

import math
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from .run_folder import stages_of


class Stage(NamedTuple):
    """One stage of a run. share: the part of the run's hours that it may take at most, None for what the others leave; run:
    trains it, or resumes it."""

    name: str
    share: float | None
    run: Callable[[], None]


class Budget:
    """`hours` for all stages of the run in `folder`, counted from now on and from what its saved stages say was spent before.

    shares: stage -> the part of the hours that it may take at most. A stage without one may take them all.
    """

    def __init__(self, folder: Path | None = None, hours: float = math.inf, shares: Mapping[str, float] | None = None):
        self.seconds, self._shares = 3600 * hours, dict(shares or {})
        stages = () if folder is None else stages_of(folder)
        self._before = max((float(facts.get("spent", 0.0)) for facts in stages), default=0.0)
        self._began = time.monotonic()

    def divide(self, stages: Iterable[Stage]) -> None:
        """Gives each stage its share."""
        self._shares |= {stage.name: stage.share for stage in stages if stage.share is not None}

    @property
    def spent_s(self) -> float:
        return self._before + time.monotonic() - self._began

    @property
    def left_s(self) -> float:
        return self.seconds - self.spent_s

    def most_s(self, stage: str) -> float:
        """Seconds that a stage may take at most."""
        return self._shares.get(stage, 1.0) * self.seconds
