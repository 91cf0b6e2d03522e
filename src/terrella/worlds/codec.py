"""Codec: a generator for worlds without depth, which fetches pixels before it paints any, as a video codec does.

Each pixel of the next frame stays, comes from a displaced place of the last frame or from an older frame (a choice, never an
average, so nothing fades), or is painted in a colour of the recording's palette where no source has it: a pointer-generator
mixture (See et al. 2017) over the block moves of the recording (learn/moves.py finds them).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch
import torch.nn.functional as F
from torch import nn

from .generator import Block, Conditioning, down_and_up, encode_depth

COARSE = 4  # the network sees squares of so many pixels; what is chosen is chosen for each pixel
PIXEL = 16  # features of each pixel, of the squares and of its own neighbours each


@dataclass(frozen=True)
class CodecConfig:
    """size: (height, width) of the frames; slots: last frames that it sees; context: numbers that it is conditioned on; moves:
    displacements in pixels among which it chooses, beside none; colours: of the palette; channels: at 1/4, 1/8, ... of the
    size."""

    size: tuple[int, int]
    slots: int
    context: int
    moves: int
    colours: int
    channels: tuple[int, ...] = (64, 96, 128)
    steps: int = 1  # a frame is drawn at once
    residual: bool = True


@final
class Codec(nn.Module):
    """`moves` int64 [moves + 1, 2] = x, y, the first of them 0, 0; `palette` uint8 [colours, 3]; `stress` [], how many times as
    much a pixel counted that changed as one that stayed when it was learned: what is drawn takes that back."""

    kind = "codec"
    moves: torch.Tensor
    palette: torch.Tensor
    stress: torch.Tensor

    def __init__(self, config: CodecConfig):
        super().__init__()
        self.config = config
        height, width = config.size
        widths, seen = config.channels, 3 * (config.slots + 1)
        self.register_buffer("moves", torch.zeros(config.moves + 1, 2, dtype=torch.int64))
        self.register_buffer("palette", torch.zeros(config.colours, 3, dtype=torch.uint8))
        self.register_buffer("stress", torch.ones(()))
        self.enter = nn.Conv2d(COARSE**2 * (seen + 2), widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.before = nn.ModuleList(Block(width, config.context) for width in widths)
        self.after = nn.ModuleList(Block(width, config.context) for width in widths)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.leave = nn.Conv2d(widths[0], COARSE**2 * PIXEL, 1)
        self.near = nn.Conv2d(seen, PIXEL, 3, padding=1)
        self.choice = nn.Conv2d(2 * PIXEL, self.sources + 2, 1)  # its last: goes as most of the picture does
        self.colour = nn.Sequential(nn.Linear(2 * PIXEL + 3, 64), nn.SiLU(), nn.Linear(64, config.colours))
        nn.init.zeros_(self.choice.weight)
        bias = torch.full((self.sources + 2,), -1.0)
        bias[0], bias[-1] = 4.0, 2.0  # at first everything stays
        self.choice.bias = nn.Parameter(bias)
        self.glance = nn.Sequential(
            nn.Conv2d(3 * config.slots, 24, 4, stride=4), nn.SiLU(), nn.Conv2d(24, 48, 4, stride=4), nn.SiLU(), nn.Flatten(),
            nn.Linear(48 * (height // 16) * (width // 16), 128), nn.SiLU(),
        )  # fmt: skip
        known = 128 + config.context + min(2, config.slots - 1) * (config.moves + 1)
        self.scrolls = nn.Sequential(nn.Linear(known, 128), nn.SiLU(), nn.Linear(128, config.moves + 1))

    @property
    def sources(self) -> int:
        """Pixels that one may be fetched from: the moves of the last frame, then the older frames."""
        return self.config.moves + self.config.slots

    def forward(self, noisy: torch.Tensor, time: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """The next frame [B, 4, H, W] in the generator's code, the likeliest one; noise and time say nothing to it."""
        frames = (conditioning.glimpse.rgb * 255).round().to(torch.uint8)
        context = conditioning.context
        move = likeliest(self.scroll(frames, context))
        choices, features = self.choices(frames, context, move)
        drawn = self.fetched(frames, choices, features).float() / 127.5 - 1
        return torch.cat([drawn, encode_depth(conditioning.glimpse.depth)[:, None]], 1)

    def scroll(self, frames: torch.Tensor, context: torch.Tensor) -> torch.Tensor:
        """By which of the moves most of the picture goes on: logits [B, moves + 1]. frames: uint8 [B, slots, 3, H, W], the newest
        first."""
        seen = self.glance(frames.flatten(1, 2).float() / 127.5 - 1)
        went = [self.fits(frames[:, age], frames[:, age + 1]) for age in range(min(2, self.config.slots - 1))]
        return self.scrolls(torch.cat([seen, context, *went], 1))

    def fits(self, after: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """How well each of the moves leads from `before` to `after` (uint8 [B, 3, H, W]), 1 for the best: [B, moves + 1]."""
        height, width = self.config.size
        x = (torch.arange(1, width, 2, device=after.device) - self.moves[:, :1]).clamp(0, width - 1)
        y = (torch.arange(1, height, 2, device=after.device) - self.moves[:, 1:]).clamp(0, height - 1)
        place = (y[:, :, None] * width + x[:, None]).flatten()
        there = before.flatten(2)[:, :, place].unflatten(2, (len(self.moves), -1))
        error = (there.float() - after[..., 1::2, 1::2].flatten(2)[:, :, None].float()).abs().mean((1, 3))
        return torch.exp(-(error - error.amin(1, keepdim=True)))

    def choices(
        self, frames: torch.Tensor, context: torch.Tensor, move: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Where each pixel comes from, logits [B, sources + 1, H, W], the last for "painted", where the picture scrolls by `move`
        [B]; and the pixels' features [B, 2 PIXEL, H, W]."""
        batch, (height, width) = len(frames), self.config.size
        scrolled = self.pixels(frames, move[:, None, None].expand(-1, height, width))
        seen = torch.cat([frames.flatten(1, 2), scrolled], 1).float() / 127.5 - 1
        down, across = (torch.linspace(-1, 1, length, device=frames.device) for length in (height, width))
        place = torch.stack([down[:, None].expand(height, width), across.expand(height, width)])
        x = F.pixel_unshuffle(torch.cat([seen, place.expand(batch, -1, -1, -1)], 1), COARSE)
        x = down_and_up(self, F.silu(self.enter(x)), context)
        features = F.silu(torch.cat([F.pixel_shuffle(self.leave(x), COARSE), self.near(seen)], 1))
        choices, scrolls = self.choice(features).split((self.sources + 1, 1), 1)
        along = move[:, None, None, None].expand_as(scrolls)
        return choices.scatter(1, along, torch.logaddexp(choices.gather(1, along), scrolls)), features

    def colours(self, frames: torch.Tensor, features: torch.Tensor, where: torch.Tensor | None = None) -> torch.Tensor:
        """Which colour of the palette the pixels `where` (bool [B, H, W]; None: all) would be painted in: logits [n, colours]."""
        known = torch.cat([features, frames[:, 0].float() / 127.5 - 1], 1).permute(0, 2, 3, 1)
        return self.colour(known.flatten(0, 2) if where is None else known[where])

    def fetched(self, frames: torch.Tensor, choices: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """The likeliest next frames, uint8 [B, 3, H, W]: painted is what more likely is than is fetched from anywhere."""
        choices = torch.cat([choices[:, :1] + self.stress.log(), choices[:, 1:]], 1)
        paints = choices.softmax(1)[:, -1] > 0.5
        drawn = self.pixels(frames, likeliest(choices[:, :-1]))
        if frames.device.type == "cpu" and not torch.onnx.is_in_onnx_export():  # few pixels are painted, in most frames
            drawn = drawn.permute(0, 2, 3, 1).contiguous()
            drawn[paints] = self.palette[self.colours(frames, features, paints).argmax(1)]
            return drawn.permute(0, 3, 1, 2).contiguous()
        colour = self.palette[self.colours(frames, features).argmax(1)].view(*paints.shape, 3).permute(0, 3, 1, 2)
        return torch.where(paints[:, None], colour, drawn)

    def pixels(self, frames: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
        """The pixels of `frames` that the sources [B, H, W] name: uint8 [B, 3, H, W]; beyond an edge lies its own pixel."""
        height, width = self.config.size
        slot = (source - self.config.moves).clamp_min(0)
        moved = torch.where(slot > 0, 0, source)
        x = (torch.arange(width, device=source.device) - self.moves[:, 0][moved]).clamp(0, width - 1)
        y = (torch.arange(height, device=source.device)[:, None] - self.moves[:, 1][moved]).clamp(0, height - 1)
        place = ((slot * height + y) * width + x).flatten(1)
        flat = frames.transpose(1, 2).flatten(2)
        return flat.gather(2, place[:, None].expand(-1, 3, -1)).unflatten(2, (height, width))


def likeliest(logits: torch.Tensor) -> torch.Tensor:
    """Of choices [B, K, ...] the first, to stay, where it is likelier than all others together; else the likeliest of those."""
    if logits.shape[1] == 1:  # nothing ever moves
        return torch.zeros_like(logits[:, 0], dtype=torch.int64)
    return torch.where(logits.softmax(1)[:, 0] > 0.5, 0, 1 + logits[:, 1:].argmax(1))
