"""Catch-v0: a ball falls, a paddle catches it (after bsuite's Catch, Osband et al. 2020): pictures that are learned fast
(docs/practice.md).

In this folder: terrella learn gym:catch:Catch-v0 --practise --size 32 32
"""

from __future__ import annotations

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

CELLS, PIXELS = 8, 4  # a side: of the field in cells, of a cell in pixels


class Catch(gymnasium.Env):
    """The ball falls a cell a step from a column drawn at random; the paddle goes left or right or stays. In the last row it pays 1
    caught, -1 missed. Observation: uint8 [32, 32, 3]."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": 5}
    action_space = spaces.Discrete(3)
    observation_space = spaces.Box(0, 255, (CELLS * PIXELS, CELLS * PIXELS, 3), np.uint8)

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode
        self.ball = self.row = self.paddle = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed, options=options)
        self.ball, self.paddle = (int(self.np_random.integers(CELLS)) for _ in range(2))
        self.row = 0
        return self.render(), {}

    def step(self, action):
        self.paddle, self.row = int(np.clip(self.paddle + int(action) - 1, 0, CELLS - 1)), self.row + 1
        over = self.row == CELLS - 1
        reward = (1.0 if self.ball == self.paddle else -1.0) if over else 0.0
        return self.render(), reward, over, False, {}

    def render(self):
        field = np.full((CELLS, CELLS, 3), 30, np.uint8)
        field[CELLS - 1, self.paddle] = (90, 160, 255)
        field[self.row, self.ball] = (250, 200, 60)
        return field.repeat(PIXELS, 0).repeat(PIXELS, 1)


gymnasium.register("Catch-v0", f"{__name__}:Catch")
