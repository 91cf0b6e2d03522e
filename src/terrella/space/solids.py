"""The collider of a place whose walls are known: axis-aligned boxes. For other places see occupancy.py. World frame, metres, z up.
A walker is an upright cylinder; its place is the position of its eye."""

from dataclasses import dataclass

import torch

from .occupancy import Walker, slide

_FOOT_M = 0.1  # a box this far beside the axis of a walker still supports it
_DEEPEST_M = 8.0  # deeper floors below the feet are ignored


@dataclass(frozen=True)
class Solids:
    """Axis-aligned boxes that stop walkers."""

    boxes: torch.Tensor  # float32 [K, 6], low and high corners; or [B, K, 6], different for each walker

    def depth(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Penetration, in metres sideways, of walkers at `place` [B, 3]: [B], 0 if free. Boxes as low as a step do not count."""
        low, high = self.boxes[..., :3], self.boxes[..., 3:]
        feet, head = place[:, 2] - body.eye_m + body.step_m, place[:, 2] + body.head_m
        level = (feet[:, None] < high[..., 2]) & (head[:, None] > low[..., 2])
        off = torch.maximum(low[..., :2] - place[:, None, :2], place[:, None, :2] - high[..., :2])  # [B, K, 2]
        apart = off.clamp_min(0).norm(dim=2) + off.amax(2).clamp_max(0)
        return torch.where(level, body.radius_m - apart, 0.0).clamp_min(0).amax(1)

    def blocked(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Whether walkers at `place` [B, 3] overlap a box: bool [B]."""
        return self.depth(place, body) > 0

    def floor(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """Height of the floor under walkers [B]: the highest top up to a step above the feet; without one, the feet."""
        top = self.highest(place, body)
        return torch.where(top > -torch.inf, top, place[:, 2] - body.eye_m)

    def highest(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """The same; -inf without a floor."""
        feet = place[:, 2] - body.eye_m
        low, high = self.boxes[..., :3], self.boxes[..., 3:]
        off = torch.maximum(low[..., :2] - place[:, None, :2], place[:, None, :2] - high[..., :2]).amax(2)
        top = high[..., 2]
        bears = (off < _FOOT_M) & (top <= feet[:, None] + body.step_m) & (top > feet[:, None] - _DEEPEST_M)
        return torch.where(bears, top, -torch.inf).amax(1)

    def surface(self, place: torch.Tensor, body: Walker) -> torch.Tensor:
        """The same; nan without a floor."""
        top = self.highest(place, body)
        return torch.where(top > -torch.inf, top, torch.nan)

    def walk(self, place: torch.Tensor, wish: torch.Tensor, body: Walker) -> torch.Tensor:
        """Where walkers at `place` [B, 3] end up that try to move by `wish` [B, 3], sliding along walls: [B, 3]. Those that
        overlap a box may only move towards less penetration."""
        return slide(lambda at: self.depth(at, body), place, wish)
