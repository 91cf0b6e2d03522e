"""The U-Net that draws a frame from the conditioning and noise (flow matching), and the code of its frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, final

import torch
import torch.nn.functional as F
from torch import nn

from ..core.backend import kernels_do, plus
from ..core.precision import half_precision
from ..space.keyframes import Glimpse
from .carried_frames import PLANES
from .config import THUMBNAIL, GeneratorConfig

Network = TypeVar("Network", bound=nn.Module)
FAR_DEPTH_M, NEAR_DEPTH_M = 60.0, 0.1
AT_ONCE = 16  # frames in a pass on a CPU: the maps of more do not fit its caches
LASTING = 5.0  # added to the logit of the last frame as a source where a thing was


@dataclass(frozen=True)
class Conditioning:
    """What a frame is drawn from.

    glimpse: what the scene knows of the view. last [B, 4, H, W]: the last frame carried into the view, colour in [0, 1] and
    trust; where things move [B, 4 + PLANES, H, W] (carried_frames.py). context [B, n]: thumbnail of the last frame, in some
    worlds also the last actions. familiar [B, 2]: how well the place is known, for the uncertainty (keyframe_scene.py).
    Of a flat world: mosaic uint8 [B, 4, H', W'] (space/mosaic.py); scroll int64 [B], by which of the generator's moves most of
    the picture goes on; kept uint8 [B, K, 3, H, W] and kept_keys [B, K, n] (space/recall.py), earlier frames.
    """

    glimpse: Glimpse
    last: torch.Tensor
    context: torch.Tensor
    familiar: torch.Tensor | None = None
    mosaic: torch.Tensor | None = None
    scroll: torch.Tensor | None = None
    kept: torch.Tensor | None = None
    kept_keys: torch.Tensor | None = None

    def to(self, device) -> Conditioning:
        return self._each(lambda part: part.to(device))

    def at(self, rows: slice) -> Conditioning:
        """The entries `rows` of the batch."""
        return self._each(lambda part: part[rows])

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Conditioning:
        glimpse = self.glimpse.each(change)
        parts = {name: part for name, part in vars(self).items() if isinstance(part, torch.Tensor)}
        return replace(self, glimpse=glimpse, **{name: change(part) for name, part in parts.items()})


@dataclass(frozen=True)
class DrawnFrame:
    """A frame as it was drawn. rgb uint8 [B, 3, H, W]; depth [B, H, W] in metres, None in a world without poses; things
    [B, H, W] in 0..1, where something may move, None where nothing does; instances uint8 [B, H, W], the number of the
    billboard at a pixel (0: none), None without billboards."""

    rgb: torch.Tensor
    depth: torch.Tensor | None = None
    things: torch.Tensor | None = None
    instances: torch.Tensor | None = None


class Block(nn.Module):
    """Two 3x3 convolutions around a SiLU, conditioned on the flow time and the context, with a residual path."""

    def __init__(self, channels: int, context: int):
        super().__init__()
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.context = nn.Linear(context, channels)

    def forward(self, x: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        """x [B, channels, H, W]; shift [B, channels] = `context` of the context, which `UNet` computes for all blocks at once."""
        inner = F.silu(self.first(x) + shift[:, :, None, None])
        return F.silu(x + self.second(inner))


@final
class UNet(nn.Module):
    """Predicts the clean frame from noise and the conditioning (flow matching, x-prediction).

    Each pixel is a mixture of the warped colours, the carried last frame and a colour of the net's own, so that what is known
    stays as sharp as it was seen. With `residual` a frame is the newest one plus the net's change: where few pixels ever change,
    a mixture soon copies, and then no gradient corrects it.
    """

    kind = "unet"

    def __init__(self, config: GeneratorConfig):
        super().__init__()
        self.config = config
        self.slots = config.slots
        self.choices = config.slots + 2  # merged, slots, last frame
        self.moving = config.moving
        inputs = 3 + 4 * config.slots + 4 + 2 + 4 + PLANES * config.moving
        widths = config.channels
        self.enter = nn.Conv2d(4 * inputs, widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.before = nn.ModuleList(Block(width, 1 + config.context) for width in widths)
        self.after = nn.ModuleList(Block(width, 1 + config.context) for width in widths)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.output = nn.Conv2d(widths[0], 4 * (self.choices + 1 + 3 + 1 + config.moving), 3, padding=1)
        nn.init.zeros_(self.output.weight)
        bias = torch.zeros(self.choices + 5 + config.moving)
        bias[0] = 0.0 if config.residual else 3.0  # at first, trust the merged colours
        self.residual = config.residual
        self.output.bias.data = bias.repeat_interleave(4)

    def prepare(self, conditioning: Conditioning) -> Conditioning:
        """The same: it derives nothing from it."""
        return conditioning

    def draw(self, noise: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """See parts.Generator."""
        return generate(self, noise, conditioning, self.config.steps)

    def forward(self, noisy: torch.Tensor, time: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """noisy [B, 4, H, W] = rgb in [-1, 1] and depth code; time [B]. Returns the clean frame in the same code; where things
        move, with a fifth plane, the logit of a thing."""
        glimpse, last = conditioning.glimpse, conditioning.last
        if self.residual:
            noisy, time = torch.zeros_like(noisy), torch.zeros_like(time)
        before, after = self._shifts(torch.cat([time[:, None], conditioning.context], 1))
        colours, trust = plus(-1.0, glimpse.rgb, 2), glimpse.trust
        merged = plus(-1.0, glimpse.merged, 2)
        depth = encode_depth(glimpse.depth)[:, None]
        last_rgb, last_trust = plus(-1.0, last[:, :3], 2), last[:, 3:4]
        lasting = last_trust > 0
        shown = (colours * (trust > 0)[:, :, None]).flatten(1, 2), trust, last_rgb * lasting, last_trust
        parts = [merged, *shown, depth, glimpse.known[:, None], noisy[:, :4]]
        if self.moving:
            carried = encode_depth(last[:, 4:5])
            parts += [carried * lasting, last[:, 5:]]
        fused = self.enter.weight.reshape(self.enter.out_channels, -1, 2, 2)  # pixel-unshuffle and `enter` in one
        x = F.silu(F.conv2d(torch.cat(parts, 1), fused, self.enter.bias, stride=2))
        x, kept = x.contiguous(memory_format=torch.channels_last), []  # like the weights
        for level, block in enumerate(self.before):
            x = block(x, before[level])
            if level < len(self.down):
                kept.append(x)
                x = self.down[level](x)
        x = self.after[-1](x, after[-1])
        for level in reversed(range(len(self.down))):
            x = kept[level] + F.interpolate(self.up[level](x), kept[level].shape[-2:], mode="nearest")
            x = self.after[level](x, after[level])
        out = F.pixel_shuffle(self.output(x), 2)
        votes = out[:, : self.choices + 1]
        if self.moving:  # by default a thing stays as it was; what was not seen is not copied
            thing = LASTING * last[:, 5:6]
            thing = torch.where(lasting, thing, thing - 1e4)
            votes = torch.cat([votes[:, :-2], votes[:, -2:-1] + thing, votes[:, -1:]], 1)
        share = votes.softmax(1)
        own = out[:, self.choices + 1 : self.choices + 4]
        if self.residual:
            rgb = colours[:, 0] + own
        else:
            rgb = torch.addcmul(share[:, :1] * merged, share[:, -2:-1], last_rgb)
            rgb = torch.addcmul(rgb, share[:, -1:], own)
            for slot in range(self.slots):
                rgb = torch.addcmul(rgb, share[:, 1 + slot : 2 + slot], colours[:, slot])
        if self.moving:
            trusted = share[:, -2:-1]  # the last frame's depth has the same share as its colour
            return torch.cat([rgb, torch.addcmul(depth, trusted, carried - depth) + out[:, -2:-1], out[:, -1:]], 1)
        return torch.cat([rgb, depth + out[:, -1:]], 1)

    def _shifts(self, context: torch.Tensor) -> tuple[Sequence[torch.Tensor], Sequence[torch.Tensor]]:
        """What the blocks `before`, and those `after`, make of the context [B, n]."""
        layers: list[Any] = [block.context for blocks in (self.before, self.after) for block in blocks]
        weight, bias = (torch.cat([getattr(layer, name) for layer in layers]) for name in ("weight", "bias"))
        shifts = F.linear(context, weight, bias).split([layer.out_features for layer in layers], 1)
        return shifts[: len(self.before)], shifts[len(self.before) :]


def channels_last(generator: Network) -> Network:
    """The same network with its weights laid out channels last: a third less time on a CPU."""
    for weight in generator.parameters():
        if weight.ndim == 4:
            weight.data = weight.data.contiguous(memory_format=torch.channels_last)
    return generator


def encode_depth(depth: torch.Tensor) -> torch.Tensor:
    """Metres to a logarithmic code of about [-1, 1]."""
    return plus(-0.6, depth.clamp(NEAR_DEPTH_M, FAR_DEPTH_M).log(), 0.5)


def decode_depth(code: torch.Tensor) -> torch.Tensor:
    return plus(1.2, code, 2).exp().clamp(NEAR_DEPTH_M, FAR_DEPTH_M)


def context_thumbnail(rgb: torch.Tensor) -> torch.Tensor:
    """Frames uint8 [B, 3, H, W] as tiny pictures in [-1, 1]: [B, 36]. Where nothing is known of a view, the last frame is the
    best hint of how the place looks."""
    return F.adaptive_avg_pool2d(plus(-1.0, rgb, 1 / 127.5), THUMBNAIL).flatten(1)


def pixels(clean: torch.Tensor) -> torch.Tensor:
    """The colours of a drawn frame [B, 4 or more, H, W] as uint8 [B, 3, H, W]."""
    return plus(128.0, clean[:, :3], 127.5).clamp(0, 255).to(torch.uint8)


def decode(clean: torch.Tensor, posed: bool) -> DrawnFrame:
    """The frame that a generator's `clean` [B, 4 or 5, H, W] stands for; without depth unless the world is `posed`."""
    depth = decode_depth(clean[:, 3]) if posed else None
    return DrawnFrame(pixels(clean), depth, clean[:, 4].sigmoid() if clean.shape[1] > 4 else None)


def parts_of(noise: torch.Tensor) -> list[slice]:
    """The parts of a batch that are drawn one after another, where it is too large for one pass; else none. They are drawn in half
    precision where a CPU computes it natively: a network is 1.6 times as fast, where a frame alone gains a sixth."""
    if not kernels_do(noise) or len(noise) <= AT_ONCE:
        return []
    return [slice(first, first + AT_ONCE) for first in range(0, len(noise), AT_ONCE)]


def generate(generator: nn.Module, noise: torch.Tensor, conditioning: Conditioning, steps: int) -> torch.Tensor:
    """Noise to frame in `steps` Euler steps of the straight flow."""
    if parts := parts_of(noise):
        with half_precision(noise.device):
            return torch.cat([generate(generator, noise[part], conditioning.at(part), steps) for part in parts])
    x = noise
    for step in range(steps):
        now, after = step / steps, (step + 1) / steps
        clean = generator(x, torch.full((len(x),), now, device=x.device), conditioning)
        x = clean if after == 1 else x + (clean[:, :4] - x) * (after - now) / (1 - now)
    return x
