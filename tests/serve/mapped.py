"""A panorama that says what it remembers: keyframes that grow with its age, and the right half of every picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces

from .panorama import Panorama

SLOTS = 8


class Mapped(Panorama):
    def __init__(self, **options):
        super().__init__(**options)
        shown = {
            "known": spaces.Box(0, 1, self.size, np.float32),
            "places": spaces.Box(-np.inf, np.inf, (SLOTS, 4), np.float32),
        }
        self.spec = replace(self.spec, name="mapped-panorama", channels={**self.spec.channels, **shown})

    def _channel(self, state, name):
        batch, (height, width) = state.batch, self.size
        if name == "known":
            return (torch.arange(width) >= width // 2).float().expand(batch, height, width).clone()
        if name == "places":
            slot = torch.arange(SLOTS).expand(batch, -1)
            held = slot <= (state["age"][:, None] // 20).clamp(max=SLOTS - 1)
            row = torch.stack([slot * 0.5, slot * 0.0, slot * 0.7, 1.0 + slot % 3], -1)
            return torch.where(held[..., None], row, 0.0)
        return super()._channel(state, name)
