"""What stops bodies where a place's walls are known: upright boxes, met exactly. Where they are not, see occupancy.py.

World frame, metres, z up. A body is an upright round column; its place is where its eye is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .occupancy import Walker, slide

_FOOT_M = 0.1  # what lies so far beside the middle of a body still bears it
_DEEPEST_M = 8.0  # floors lower than this below the feet are not looked for


@dataclass(frozen=True)
class Solids:
    """boxes float32 [K, 6]: low and high corners; or [B, K, 6], each body's own."""

    boxes: torch.Tensor

    def depth(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """How deep, in metres sideways, bodies at `place` [B, 3] are in something: [B], 0 for free. What is as low as a step does
        not count."""
        low, high = self.boxes[..., :3], self.boxes[..., 3:]
        feet, head = place[:, 2] - body.eye_m + body.step_m, place[:, 2] + body.head_m
        level = (feet[:, None] < high[..., 2]) & (head[:, None] > low[..., 2])
        off = torch.maximum(low[..., :2] - place[:, None, :2], place[:, None, :2] - high[..., :2])  # [B, K, 2]
        apart = off.clamp_min(0).norm(dim=2) + off.amax(2).clamp_max(0)
        return torch.where(level, body.radius_m - apart, 0.0).clamp_min(0).amax(1)

    def blocked(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Whether a body at `place` [B, 3] stands in something: bool [B]."""
        return self.depth(place, body) > 0

    def floor(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """How high the floor under a body is [B]: the highest top up to a step above its feet; its feet where there is none."""
        found = self.highest(place, body)
        return torch.where(found > -torch.inf, found, place[:, 2] - body.eye_m)

    def highest(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """The same, and -inf where there is none."""
        feet = place[:, 2] - body.eye_m
        low, high = self.boxes[..., :3], self.boxes[..., 3:]
        off = torch.maximum(low[..., :2] - place[:, None, :2], place[:, None, :2] - high[..., :2]).amax(2)
        top = high[..., 2]
        bears = (off < _FOOT_M) & (top <= feet[:, None] + body.step_m) & (top > feet[:, None] - _DEEPEST_M)
        return torch.where(bears, top, -torch.inf).amax(1)

    def surface(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """The same, and nan where there is none."""
        found = self.highest(place, body)
        return torch.where(found > -torch.inf, found, torch.nan)

    def moved(self, place: torch.Tensor, wish: torch.Tensor, body: Walker) -> torch.Tensor:
        """Where bodies at `place` [B, 3] come that wish to go by `wish` [B, 3]: along walls, through nothing; [B, 3]. Whoever
        stands in something already may only come less deep into it."""
        return slide(lambda there: self.depth(there, body), place, wish)
