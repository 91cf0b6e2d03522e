"""Uncertainty: how wrong a world expects the frame that it has just drawn to be, learned from its own dreams.

One small network beside the generator, no ensemble: it reads what memory knew, what was drawn, and how far the dream has
gone since it last saw anything, and answers with the mean absolute error that such frames had.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from ..core.state import State
from ..space.camera import yaw
from ..space.keyframes import merge
from .generator import Conditioning
from .parts import Absent, Channels

# Of an episode: steps since a picture was seen, the way and the turns since a pose was, whether it began with a lone picture
# of elsewhere, and how strange that was (0..1).
GONE = ("steps", "metres", "radians", "lone", "strange")
SITUATION = len(GONE) - 1 + 2  # the last is replaced by how far the next recorded keyframe is, and how many it holds
CLUES = 15  # maps of `clues`
CELLS = 4  # pixels a side of one of its cells; the error is expected in cells of twice that
KNOTS = 17


@dataclass(frozen=True)
class UncertaintyConfig:
    """situation: numbers that say in what situation a frame was drawn; channels: of the network's maps."""

    situation: int = SITUATION
    channels: tuple[int, int] = (24, 40)


@final
class UncertaintyNetwork(nn.Module):
    """The network, and a monotone map (isotonic regression on other dreams) from its answer to the error that was found."""

    kind = "network"
    found: torch.Tensor  # KNOTS answers of the network, ascending
    meant: torch.Tensor  # the mean error at each
    sure: torch.Tensor  # the error usual where memory knows the place
    invents: torch.Tensor  # the error usual where it does not

    def __init__(self, config: UncertaintyConfig):
        super().__init__()
        self.config = config
        first, second = config.channels
        self.enter = nn.Conv2d(CLUES, first, 3, 2, 1)
        self.situate = nn.Sequential(nn.Linear(config.situation, 32), nn.SiLU(), nn.Linear(32, 2 * second))
        self.wide = nn.Conv2d(first, second, 3, 1, 1)
        self.wider = nn.Conv2d(second, second, 3, 1, 2, 2)
        self.output = nn.Conv2d(second, 1, 1)
        self.output.bias = nn.Parameter(torch.tensor([-3.0]))
        self.register_buffer("found", torch.linspace(0, 1, KNOTS))
        self.register_buffer("meant", torch.linspace(0, 1, KNOTS))
        self.register_buffer("sure", torch.tensor(0.02))
        self.register_buffer("invents", torch.tensor(0.08))

    def channels(self) -> Channels:
        unit = "expected mean absolute error of the picture, intensity 0..1"
        return Channels({"uncertainty": spaces.Box(0, 1, (), np.float32)}, {"uncertainty": unit})

    def forward(self, maps: torch.Tensor, situation: torch.Tensor) -> torch.Tensor:
        """maps [B, CLUES, h, w] of `clues`; situation [B, S] -> expected error of each cell, 0..1: [B, h/2, w/2]."""
        gain, shift = self.situate(situation)[:, :, None, None].chunk(2, 1)
        x = F.silu(self.wide(F.silu(self.enter(maps))) * (1 + gain) + shift)
        x = F.silu(x + self.wider(x))
        return F.softplus(self.output(x)[:, 0]) + 1e-4

    def expected(
        self, conditioning: Conditioning, clean: torch.Tensor, situation: torch.Tensor, strange: torch.Tensor
    ) -> torch.Tensor:
        """The calibrated mean absolute error expected of the frames `clean` [B, 4, H, W] that were drawn from `conditioning`, in
        units of intensity from 0 to 1: [B]. Of an episode that began with a picture unlike the recordings (`strange` [B], 0..1)
        no less is expected than of invention."""
        learned = self.calibrated(self(clues(conditioning, clean), situation).mean((1, 2)))
        return torch.maximum(learned, self.invents * strange)

    def calibrated(self, answer: torch.Tensor) -> torch.Tensor:
        """Linear between the knots; beyond them in proportion."""
        at = torch.searchsorted(self.found, answer).clamp(1, KNOTS - 1)
        low, high = self.found[at - 1], self.found[at]
        share = ((answer - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
        inside = torch.lerp(self.meant[at - 1], self.meant[at], share)
        below, above = answer / self.found[0].clamp_min(1e-6), answer / self.found[-1].clamp_min(1e-6)
        return (inside * below.clamp_max(1) * above.clamp_min(1)).clamp(0, 1)


@final
class NoUncertainty(Absent):
    """Of a world that does not say how wrong it expects to be."""

    def expected(self, conditioning, clean, situation, strange) -> torch.Tensor:
        return torch.zeros_like(strange)


@final
class UncertaintyProbe(Absent):
    """In the place of an uncertainty: notes what one would be asked, for those who teach it."""

    def __init__(self, note: Callable[[Conditioning, torch.Tensor, torch.Tensor], None]):
        self.note = note

    def __bool__(self) -> bool:
        return True

    def expected(self, conditioning, clean, situation, strange) -> torch.Tensor:
        self.note(conditioning, clean, situation)
        return torch.zeros_like(strange)


def gone_on(before: State, after: State, led: bool) -> torch.Tensor:
    """`gone` [B, len(GONE)] of `after`, one step further from its evidence than `before`; `led`: its pose was given."""
    gone = before["gone"]
    steps, way = gone[:, :1] + 1, gone[:, 1:3]
    if led:
        way = torch.zeros_like(way)
    elif "pose" in after:
        turn = yaw(after["pose"]) - yaw(before["pose"])
        moved = (after["pose"] - before["pose"])[:, :2].norm(dim=-1)
        way = way + torch.stack([moved, torch.atan2(turn.sin(), turn.cos()).abs()], 1)
    return torch.cat([steps, way, gone[:, 3:]], 1)


def clues(conditioning: Conditioning, clean: torch.Tensor) -> torch.Tensor:
    """What a drawn frame and its sources look like, in cells of CELLS pixels: [B, CLUES, H / CELLS, W / CELLS]."""
    glimpse, last = conditioning.glimpse, conditioning.last
    drawn, merged = clean[:, :3].clamp(-1, 1), merge(glimpse) * 2 - 1
    trust = glimpse.trust[:, :2] if glimpse.trust.shape[1] > 1 else glimpse.trust.repeat(1, 2, 1, 1)
    second = glimpse.rgb[:, min(1, glimpse.rgb.shape[1] - 1)]
    apart = ((glimpse.rgb[:, 0] - second).abs().mean(1, keepdim=True)) * (trust[:, 1:] > 0)
    edges = F.pad(drawn.diff(dim=3).abs().mean(1, keepdim=True), (0, 1))
    own = ((drawn - merged).abs() * glimpse.known[:, None]).mean(1, keepdim=True)
    maps = [drawn, merged, own, glimpse.known[:, None], trust, last[:, 3:4], apart, clean[:, 3:4], edges]
    whole = torch.cat(maps, 1)
    soft = F.avg_pool2d(whole, CELLS)
    here = soft[:, :3] - F.avg_pool2d(F.pad(soft[:, :3], (1, 1, 1, 1), mode="replicate"), 3, 1)
    return torch.cat([soft, here.abs().mean(1, keepdim=True)], 1)
