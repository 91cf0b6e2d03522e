"""Flow: a generator for worlds of frames alone, which draws a sample of the next frame by flow matching.

A U-Net in two halves. The first sees the last frames and the actions, once a frame; the second is run for each drawing step, and
sees its features, the noisy frame x_t and what memory knows of the picture. The network predicts the clean frame x_1 from
x_t = (1 - t) noise + t x_1 (x-prediction). Its first step, t = 0, needs no noise: the draft is the mean of all that may follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

import torch
import torch.nn.functional as F
from torch import nn

from ..space.matching import scroll_index
from ..space.mosaic import read_mosaic
from .generator import AT_ONCE, Conditioning, encode_depth, pixels

SQUARE = 4  # side in pixels of the squares that the U-Net sees
WIDE = 128  # numbers of the embedding of actions and flow time
DETAIL = 16  # features of each pixel from its square
HEADS = 4  # of the attention over the coarsest map
STAYS = 0.04  # a colour that would change by less, of -1 to 1, stays as it is
FREQUENCIES = 8  # of the sines and cosines of the flow time


@dataclass(frozen=True)
class FlowConfig:
    """Of the flow network."""

    size: tuple[int, int]  # height and width of a frame, pixels
    slots: int  # last frames that it sees
    context: int  # numbers that it is conditioned on beside maps
    moves: int = 0  # displacements by which pictures scroll, beside (0, 0); 0: no memory
    channels: tuple[int, ...] = (64, 112, 160)  # at 1/4, 1/8 and 1/16 of the size
    steps: int = 3  # drawing steps a frame, the draft included


class FlowFeatures(NamedTuple):
    """What the first half of the network makes of a history."""

    maps: tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # at 1/4, 1/8 and 1/16 of the size
    embedding: torch.Tensor  # [B, WIDE] of the actions
    last: torch.Tensor  # [B, 3, H, W] in -1..1
    older: torch.Tensor  # [B, 3, H, W]: the frame before


class AdaptiveBlock(nn.Module):
    """A residual block whose normalised maps are scaled and shifted by an embedding (AdaGN, Dhariwal and Nichol 2021)."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.embedding = nn.Linear(WIDE, 2 * channels)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: torch.Tensor, embedding: torch.Tensor) -> torch.Tensor:
        scale, shift = self.embedding(embedding)[:, :, None, None].chunk(2, 1)
        return x + self.second(F.silu(self.first(F.silu(self.norm(x) * (1 + scale) + shift))))


@final
class FlowNetwork(nn.Module):
    """`moves` int64 [moves + 1, 2] = x, y in pixels, (0, 0) first: by which pictures scroll."""

    kind = "flow"
    moves: torch.Tensor

    def __init__(self, config: FlowConfig):
        super().__init__()
        self.config = config
        fine, middle, coarse = config.channels
        self.register_buffer("moves", torch.zeros(config.moves + 1, 2, dtype=torch.int64))
        self.actions = nn.Sequential(nn.Linear(config.context, WIDE), nn.SiLU(), nn.Linear(WIDE, WIDE), nn.SiLU())
        self.time = nn.Sequential(nn.Linear(2 * FREQUENCIES, WIDE), nn.SiLU(), nn.Linear(WIDE, WIDE))
        self.enter = nn.Conv2d(3 * config.slots * SQUARE**2, fine, 3, padding=1)
        self.enter_drawn = nn.Conv2d((3 + 4 * (config.moves > 0)) * SQUARE**2, fine, 3, padding=1)
        self.before = nn.ModuleList(AdaptiveBlock(width) for width in config.channels)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in ((fine, middle), (middle, coarse)))
        self.attention = nn.MultiheadAttention(coarse, HEADS, batch_first=True)
        self.drawn = AdaptiveBlock(fine)
        self.down_drawn = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in ((fine, middle), (middle, coarse)))
        self.after = nn.ModuleList(AdaptiveBlock(width) for width in (coarse, middle, fine, fine))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in ((middle, coarse), (fine, middle)))
        self.detail = nn.Conv2d(fine, DETAIL * SQUARE**2, 3, padding=1)
        self.near = nn.Conv2d(DETAIL + 9, 24, 3, padding=1)
        self.output = nn.Conv2d(24, 3, 3, padding=1)
        nn.init.zeros_(self.output.weight)  # untrained, the last frame stays
        self.output.bias = nn.Parameter(torch.zeros(3))

    def encode(self, frames: torch.Tensor, context: torch.Tensor) -> FlowFeatures:
        """Of frames [B, slots, 3, H, W] in -1..1, the newest first, and the context [B, n]."""
        embedding = self.actions(context)
        fine = self.before[0](self.enter(self._squares(frames.flatten(1, 2))), embedding)
        middle = self.before[1](self.down[0](fine), embedding)
        coarse = self.before[2](self.down[1](middle), embedding)
        tokens = coarse.flatten(2).transpose(1, 2)
        attended = self.attention(tokens, tokens, tokens, need_weights=False)[0]
        coarse = coarse + attended.transpose(1, 2).unflatten(2, coarse.shape[-2:])
        return FlowFeatures((fine, middle, coarse), embedding, frames[:, 0], frames[:, min(1, frames.shape[1] - 1)])

    def clean(
        self, seen: FlowFeatures, noisy: torch.Tensor, time: torch.Tensor, memory: torch.Tensor | None
    ) -> torch.Tensor:
        """The clean frame [B, 3, H, W] in -1..1 by `noisy` of the same shape at flow time [B]. memory uint8 [B, 4, H, W]: colours
        of the next frame and whether (over 0) they are known; None: nothing is."""
        (fine, middle, coarse), embedding, last, older = seen
        angle = time[:, None] * (2.0 ** torch.arange(FREQUENCIES, device=time.device)) * (math.pi / 2)
        embedding = embedding + self.time(torch.cat([angle.sin(), angle.cos()], 1))
        shown = noisy - last
        entering = shown if not self.config.moves else torch.cat([shown, self._remembered(memory, last)], 1)
        fine = self.drawn(fine + self.enter_drawn(self._squares(entering)), embedding)
        middle = middle + self.down_drawn[0](fine)
        x = self.after[0](coarse + self.down_drawn[1](middle), embedding)
        x = self.after[1](middle + F.pixel_shuffle(self.up[0](x), 2), embedding)
        x = self.after[3](self.after[2](fine + F.pixel_shuffle(self.up[1](x), 2), embedding), embedding)
        height, width = self.config.size
        detail = F.pixel_shuffle(self.detail(x), SQUARE)[..., :height, :width]
        near = torch.cat([detail, shown, last, older], 1).contiguous(memory_format=torch.channels_last)
        return last + self.output(F.silu(self.near(near))).float()

    def draw(self, noise: torch.Tensor, conditioning: Conditioning, steps: int | None = None) -> torch.Tensor:
        """The next frame in the generator's code [B, 4, H, W], drawn from `noise` [B, 4, H, W] in `steps` steps, by default
        config.steps. From the draft follows how the picture scrolls, and with that where the mosaic knows it."""
        steps = steps or self.config.steps
        if noise.device.type == "cpu" and len(noise) > AT_ONCE:
            parts = [slice(first, first + AT_ONCE) for first in range(0, len(noise), AT_ONCE)]
            return torch.cat([self.draw(noise[part], conditioning.at(part), steps) for part in parts])
        frames = conditioning.glimpse.rgb * 2 - 1
        seen, memory = self.encode(frames, conditioning.context), None
        time = torch.zeros(len(noise), device=noise.device)
        x = self.clean(seen, seen.last, time, None)
        if conditioning.mosaic is not None and self.config.moves:
            memory = self.recall(pixels(seen.last), pixels(x), conditioning.mosaic, conditioning.over)
        for step in range(1, steps):
            t = step / steps
            x = self.clean(seen, (1 - t) * noise[:, :3] + t * x.clamp(-1, 1), time + t, memory)
        still = (x - seen.last).abs().amax(1, keepdim=True) < STAYS
        x = torch.where(still, seen.last, x)
        return torch.cat([x, encode_depth(conditioning.glimpse.depth)[:, None]], 1)

    def prepare(self, conditioning: Conditioning) -> Conditioning:
        """The same: what it derives from it depends on the draft."""
        return conditioning

    def recall(
        self, last: torch.Tensor, draft: torch.Tensor, mosaic: torch.Tensor, over: torch.Tensor | None
    ) -> torch.Tensor:
        """What mosaics, as of the frames `last`, know of the frames `draft` (uint8 [B, 3, H, W]): uint8 [B, 4, H, W]."""
        move = self.moves[scroll_index(last, draft, self.moves)]
        known = read_mosaic(mosaic, self.config.size, move)
        return known if over is None else known * ~over[:, None]

    def _remembered(self, memory: torch.Tensor | None, last: torch.Tensor) -> torch.Tensor:
        """Memory as maps [B, 4, H, W]: colours relative to the last frame, 0 where unknown, and whether known."""
        if memory is None:
            return last.new_zeros(len(last), 4, *last.shape[-2:])
        known = (memory[:, 3:] > 0).float()
        return torch.cat([(memory[:, :3].float() / 127.5 - 1 - last) * known, known], 1)

    def _squares(self, maps: torch.Tensor) -> torch.Tensor:
        """Maps [B, C, H, W] as squares [B, C * SQUARE**2, h, w], with replicated edges where a side is no multiple of 16."""
        height, width = self.config.size
        below, right = -height % (4 * SQUARE), -width % (4 * SQUARE)
        if below or right:
            maps = F.pad(maps, (0, right, 0, below), mode="replicate")
        return F.pixel_unshuffle(maps, SQUARE).contiguous(memory_format=torch.channels_last)
