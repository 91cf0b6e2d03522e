"""A game for policies of robots: a point in a square goes to the middle; a picture and two numbers are seen."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces

NAME = "gym:tests.act.reach:TerrellaReach-v0"


class Reach(gymnasium.Env):
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space = spaces.Dict(
        {"picture": spaces.Box(0, 255, (64, 64, 3), np.uint8), "state": spaces.Box(-4, 4, (2,), np.float32)}
    )
    metadata = {"render_modes": ["ansi"], "render_fps": 10}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = self.np_random.uniform(-4, 4, 2), 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = np.clip(self.at + 0.5 * np.asarray(action), -4, 4), self.steps + 1
        return self.seen(), -float(np.abs(self.at).sum()), False, self.steps >= 10, {}

    def seen(self):
        picture = np.full((64, 64, 3), 60, np.uint8)
        row, column = (32 + 7 * self.at).astype(int)
        picture[row - 3 : row + 3, column - 3 : column + 3] = (220, 180, 40)
        return {"picture": picture, "state": self.at.astype(np.float32)}


if "TerrellaReach-v0" not in gymnasium.registry:
    gymnasium.register("TerrellaReach-v0", Reach)
