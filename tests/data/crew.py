"""Worlds and policies that workers open by name, and players that end their process."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

from corridor import Corridor

from terrella.core.errors import TerrellaError
from terrella.core.policy import Random

STEPS = 12


def opened():
    world = Corridor()
    world.spec = replace(world.spec, max_episode_steps=STEPS)
    return world, lambda: Random(world.spec)


class Dies(Random):
    """Ends its process, without a word, at the eighth step of an episode, `times` times in all (a file in `folder` for each)."""

    def __init__(self, spec, folder: Path, times: int):
        super().__init__(spec)
        self.folder, self.times, self.step = folder, times, 0

    def act(self, observation, memory, rng):
        self.step += 1
        before = len(list(self.folder.iterdir()))
        if self.step == 8 and before < self.times:
            (self.folder / f"{before}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().act(observation, memory, rng)


def dying(folder: Path, times: int):
    world, _ = opened()
    return world, lambda: Dies(world.spec, folder, times)


def failing():
    def policy():
        raise TerrellaError("this policy fails.")

    return opened()[0], policy
