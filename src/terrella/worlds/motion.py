"""Motion: how an eye moves by what is done, where nothing is in its way."""

from __future__ import annotations

import torch
from torch import nn

from .generator import VideoConfig


class Motion(nn.Module):
    """How the eye moves where nothing is in its way: it turns by the actions, and glides by drag and thrust in its own
    frame. Walls come after (space/floorplan.slide)."""

    middle: torch.Tensor  # of the recorded places, and how far they reach, in metres
    span: torch.Tensor

    def __init__(self, config: VideoConfig):
        super().__init__()
        acts = config.actions * (config.history + 1)
        self.turn = nn.Sequential(nn.Linear(acts, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1))
        self.glide = nn.Linear(2 + config.actions, 2)
        self.ending = nn.Sequential(
            nn.Linear(2 + config.actions, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1)
        )
        self.register_buffer("middle", torch.zeros(2))
        self.register_buffer("span", torch.ones(()))

    def forward(self, heading, speed, actions):
        """heading [B] radians; speed [B, 2] metres a step, world frame; actions [B, history + 1, A], the newest last.
        Returns the new heading [B] and the displacement that this step wishes for [B, 2]."""
        heading = heading + 0.1 * self.turn(actions.flatten(1))[:, 0]
        glide = self.glide(torch.cat([10 * turned(speed, -heading), actions[:, -1]], -1))
        return heading, 0.1 * turned(glide, heading)

    def ends(self, place: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Logit that the episode ends at `place` [B, 2]: [B]."""
        where = 2 * (place - self.middle) / self.span
        logit = self.ending(torch.cat([where, action], -1))[:, 0]
        return torch.where(where.abs().amax(1) < 1.2, logit, -20.0)  # what lies further away was never seen to end


def turned(vector: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """[B, 2] rotated counter-clockwise by [B] radians."""
    c, s = angle.cos(), angle.sin()
    return torch.stack([vector[:, 0] * c - vector[:, 1] * s, vector[:, 0] * s + vector[:, 1] * c], -1)
