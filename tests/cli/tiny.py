"""A game for tests: a bar that is pushed left and right over a striped picture; 60 steps are an episode."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces

NAME = "gym:tests.cli.tiny:TerrellaTiny-v0"
FAILS = NAME.replace("Tiny-", "Fails-")


class Tiny(gymnasium.Env):
    action_space = spaces.Discrete(3)
    observation_space = spaces.Box(0, 255, (16, 24, 3), np.uint8)
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = int(self.np_random.integers(0, 20)), 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = int(np.clip(self.at + int(action) - 1, 0, 20)), self.steps + 1
        return self.seen(), float(self.at == 20), False, self.steps >= 60, {}

    def seen(self):
        picture = np.full((16, 24, 3), 60, np.uint8)
        picture[::4] = 90
        picture[4:12, self.at : self.at + 4] = (220, 180, 40)
        return picture


class Blind(Tiny):
    observation_space = spaces.Box(0, 24, (1,), np.float32)

    def seen(self):
        return np.array([self.at], np.float32)


class Fails(Tiny):
    """Fails for ever, from some step on, in whatever episode that is."""

    taken = [0]

    def step(self, action):
        self.taken[0] += 1
        if self.taken[0] > 600:
            raise OSError("the engine is off")
        return super().step(action)


for name, kind in (("TerrellaTiny-v0", Tiny), ("TerrellaBlind-v0", Blind), ("TerrellaFails-v0", Fails)):
    if name not in gymnasium.registry:
        gymnasium.register(name, kind)
