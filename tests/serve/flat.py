"""A panorama without places: its map is the mosaic of what was seen while it turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces

from .panorama import PIXELS_PER_STEP, Panorama


class Flat(Panorama):
    def __init__(self, **options):
        super().__init__(**options)
        height, width = self.size
        shown = {"mosaic": spaces.Box(0, 255, (3 * height, 4 * width, 4), np.uint8)}
        self.spec = replace(self.spec, name="flat-panorama", channels={**self.spec.channels, **shown})

    def _ticketed(self, state):
        """It turned by `at` pixels, and at the most to `low` and `high`."""
        zero = torch.zeros(state.batch, dtype=torch.int64)
        return super()._ticketed(state if "at" in state else state.replace(at=zero, low=zero, high=zero))

    def imagine(self, state, action, rng):
        after, turn = super().imagine(state, action, rng), torch.as_tensor(action).long()
        at = state["at"] + (turn[:, 5] - turn[:, 4]) * PIXELS_PER_STEP
        return after.replace(at=at, low=torch.minimum(state["low"], at), high=torch.maximum(state["high"], at))

    def _channel(self, state, name):
        if name != "mosaic":
            return super()._channel(state, name)
        (height, width), wide = self.size, self.picture.shape[1]
        across = torch.arange(4 * width) - 3 * width // 2
        place = state["at"][:, None] + across
        seen = (place >= state["low"][:, None]) & (place < state["high"][:, None] + width)
        rgb = self.picture[:, (state["column"][:, None] + across) % wide].permute(1, 0, 2, 3)
        whole = torch.zeros(state.batch, 3 * height, 4 * width, 4, dtype=torch.uint8)
        middle = torch.cat([rgb, torch.full_like(rgb[..., :1], 255)], -1) * seen[:, None, :, None]
        whole[:, height : 2 * height] = middle
        return whole
