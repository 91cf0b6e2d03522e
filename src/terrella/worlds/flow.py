"""Flow: a generator for worlds of frames alone, which draws a sample of the next frame by flow matching.

A U-Net in two halves. The first sees the last frames and the actions, once a frame; the second is run for each drawing step, and
sees its features, the noisy frame x_t and what memory knows of the picture. The network predicts the clean frame x_1 from
x_t = (1 - t) noise + t x_1 (x-prediction). Its first step, t = 0, needs no noise: the draft is the mean of all that may follow.
Where pictures scroll, it draws the change of the last frame carried along (global motion compensation), and a mosaic remembers
what left the picture. Where pictures change as a whole, the steps after the draft see the earlier frame that is most like it.
Where several cameras overlap, their pictures are made to agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import torch
import torch.nn.functional as F
from torch import nn

from ..core.backend import constant, plus
from ..core.precision import half_precision
from ..space.mosaic import displaced, read_mosaic
from ..space.overlap import Blend, MountedCamera
from ..space.recall import most_alike
from .generator import Conditioning, encode_depth, parts_of
from .scroll import Scroll, predicted_scroll

SQUARE = 4  # side in pixels of the squares that the U-Net sees
WIDE = 128  # numbers of the embedding of actions and flow time
DETAIL = 16  # features of each pixel from its square
HEADS = 4  # of the attention over the coarsest map
LATEST = 0.9  # the largest flow time, in training and in drawing
STAYS = 0.04  # a colour that would change by less, of -1 to 1, stays as it is
RECALLED = 0.15  # a colour that differs by less from the remembered one is as remembered
FREQUENCIES = 8  # of the sines and cosines of the flow time


@dataclass(frozen=True)
class FlowConfig:
    """Of the flow network."""

    size: tuple[int, int]  # height and width of a frame, pixels
    slots: int  # last frames that it sees
    context: int  # numbers that it is conditioned on beside maps
    moves: int = 0  # displacements by which pictures scroll, beside (0, 0); 0: no memory either
    channels: tuple[int, ...] = (64, 112, 160)  # at 1/4, 1/8 and 1/16 of the size
    steps: int = 3  # drawing steps a frame, the draft included
    recalls: bool = False  # it sees an earlier frame that is like the draft
    views: tuple[MountedCamera, ...] = ()  # cameras whose pictures lie side by side in a frame, from the left; (): one
    normed: bool = False  # the last layers see normalised maps; not in worlds of earlier releases


class FlowFeatures(NamedTuple):
    """What the first half of the network makes of a history."""

    maps: tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # at 1/4, 1/8 and 1/16 of the size
    embedding: torch.Tensor  # [B, WIDE] of the actions
    base: torch.Tensor  # [B, 3, H, W] in -1..1: the last frame, or `carry` of it where pictures scroll
    older: torch.Tensor  # [B, 3, H, W]: the frame before
    remembered: torch.Tensor | None  # [B, 4, H, W]: memory relative to the base, 0 where unknown, and whether known


Modulation = tuple[torch.Tensor, torch.Tensor]  # by which a block scales and shifts its maps [B, C, 1, 1]


class AdaptiveBlock(nn.Module):
    """A residual block whose normalised maps are scaled and shifted by an embedding (AdaGN, Dhariwal and Nichol 2021)."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.embedding = nn.Linear(WIDE, 2 * channels)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: torch.Tensor, embedding: torch.Tensor) -> torch.Tensor:
        return self.modulated(x, modulations((self,), embedding)[0])

    def modulated(self, x: torch.Tensor, by: Modulation) -> torch.Tensor:
        scale, shift = by
        return x + self.second(F.silu(self.first(F.silu(torch.addcmul(shift, self.norm(x), scale)))))


def modulations(blocks: Sequence[AdaptiveBlock], embedding: torch.Tensor) -> list[Modulation]:
    """Of each block by an embedding [B, WIDE]."""
    weight, bias = (torch.cat([getattr(block.embedding, name) for block in blocks]) for name in ("weight", "bias"))
    widths = [len(block.embedding.bias) for block in blocks]
    parts = F.linear(embedding, weight, bias)[..., None, None].split(widths, -3)
    halves = [part.chunk(2, -3) for part in parts]
    scales = torch._foreach_add([scale for scale, _ in halves], 1.0)
    return [(scale, shift) for scale, (_, shift) in zip(scales, halves)]


@final
class FlowNetwork(nn.Module):
    """`moves` int64 [moves + 1, 2] = x, y in pixels, (0, 0) first: by which pictures scroll. over bool [H, W]: what does not."""

    kind = "flow"
    moves: torch.Tensor
    over: torch.Tensor

    def __init__(self, config: FlowConfig):
        super().__init__()
        self.config = config
        fine, middle, coarse = config.channels
        remembers = config.moves > 0 or config.recalls
        self.register_buffer("moves", torch.zeros(config.moves + 1, 2, dtype=torch.int64))
        self.register_buffer("over", torch.zeros(config.size, dtype=torch.bool))
        self.scrolling = Scroll(config.size, config.slots, config.context, config.moves) if config.moves else None
        views, (height, width) = [MountedCamera(*view) for view in config.views], config.size
        self.blend = Blend(views, (height, width // len(views))) if len(views) > 1 else None
        self.actions = nn.Sequential(nn.Linear(config.context, WIDE), nn.SiLU(), nn.Linear(WIDE, WIDE), nn.SiLU())
        self.time = nn.Sequential(nn.Linear(2 * FREQUENCIES, WIDE), nn.SiLU(), nn.Linear(WIDE, WIDE))
        self.enter = nn.Conv2d(3 * config.slots, fine, SQUARE, stride=SQUARE)
        self.enter_drawn = nn.Conv2d(6 + 4 * remembers, fine, SQUARE, stride=SQUARE)
        self.before = nn.ModuleList(AdaptiveBlock(width) for width in config.channels)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in ((fine, middle), (middle, coarse)))
        self.attention = nn.MultiheadAttention(coarse, HEADS, batch_first=True)
        self.drawn = AdaptiveBlock(fine)
        self.down_drawn = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in ((fine, middle), (middle, coarse)))
        self.after = nn.ModuleList(AdaptiveBlock(width) for width in (coarse, middle, fine, fine))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in ((middle, coarse), (fine, middle)))
        self.norm = nn.GroupNorm(8, fine) if config.normed else None
        self.detail = nn.Conv2d(fine, DETAIL * SQUARE**2, 1)
        self.near = nn.Conv2d(DETAIL + 9 + 4 * config.recalls, 24, 3, padding=1)
        self.output = nn.Conv2d(24, 3, 3, padding=1)
        nn.init.zeros_(self.output.weight)  # untrained, the last frame stays
        self.output.bias = nn.Parameter(torch.zeros(3))

    def encode(
        self,
        frames: torch.Tensor,
        context: torch.Tensor,
        scroll: torch.Tensor | None = None,
        memory: torch.Tensor | None = None,
        noise: torch.Tensor | None = None,
    ) -> FlowFeatures:
        """Of frames [B, slots, 3, H, W] in -1..1, the newest first, the context [B, n], by which move int64 [B] most of the picture
        goes on, and memory uint8 [B, 4, H, W]: colours of the next frame and whether (over 0) they are known. noise, of the shape
        of the frames: added to what the U-Net sees of them, not to the frame that it changes."""
        history = frames if noise is None else frames + noise
        embedding = self.actions(context)
        first, second, third = self._blocks("before")
        by = modulations((first, second, third), embedding)
        fine = first.modulated(self.enter(self._padded(history.flatten(1, 2))), by[0])
        middle = second.modulated(self.down[0](fine), by[1])
        coarse = third.modulated(self.down[1](middle), by[2])
        tokens = coarse.flatten(2).transpose(1, 2)
        coarse = coarse + self._attended(tokens).transpose(1, 2).unflatten(2, coarse.shape[-2:])
        base = frames[:, 0] if scroll is None else carry(frames[:, 0], scroll, self.moves, self.over, memory)
        remembered = self._remembered(memory, base) if self.config.moves or self.config.recalls else None
        older = frames[:, min(1, frames.shape[1] - 1)]
        return FlowFeatures((fine, middle, coarse), embedding, base, older, remembered)

    def _attended(self, tokens: torch.Tensor) -> torch.Tensor:
        """Self-attention of tokens [B, n, C]."""
        projected = F.linear(tokens, self.attention.in_proj_weight, self.attention.in_proj_bias)
        query, key, value = projected.unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        heads = F.scaled_dot_product_attention(query, key, value)
        return self.attention.out_proj(heads.transpose(1, 2).flatten(2))

    def clean(self, seen: FlowFeatures, noisy: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """The clean frame [B, 3, H, W] in -1..1 by `noisy` of the same shape at flow time [B]."""
        return self._cleaned(seen, noisy, modulations(self._drawing, seen.embedding + self.time(_waves(time))))

    def _cleaned(self, seen: FlowFeatures, noisy: torch.Tensor, by: Sequence[Modulation]) -> torch.Tensor:
        """`clean` with the modulations of its blocks at a flow time."""
        (fine, middle, coarse), _, base, older, remembered = seen
        drawn, *after = self._drawing
        change = noisy - base
        entering = [change, base, *([] if remembered is None else [remembered])]
        fine = drawn.modulated(fine + self.enter_drawn(self._padded(torch.cat(entering, 1))), by[0])
        middle = middle + self.down_drawn[0](fine)
        x = after[0].modulated(coarse + self.down_drawn[1](middle), by[1])
        x = after[1].modulated(middle + F.pixel_shuffle(self.up[0](x), 2), by[2])
        x = after[2].modulated(fine + F.pixel_shuffle(self.up[1](x), 2), by[3])
        x = after[3].modulated(x, by[4])
        x = x if self.norm is None else F.silu(self.norm(x))
        height, width = self.config.size
        detail = F.pixel_shuffle(self.detail(x), SQUARE)[..., :height, :width]
        recalled = [remembered] if self.config.recalls and remembered is not None else []
        near = self.near(torch.cat([detail, change, base, older, *recalled], 1))
        return base + self.output(F.silu(near)).float()

    def draw(self, noise: torch.Tensor, conditioning: Conditioning, steps: int | None = None) -> torch.Tensor:
        """The next frame in the generator's code [B, 4, H, W], drawn from `noise` [B, 4, H, W] in `steps` steps, by default
        config.steps."""
        steps = steps or self.config.steps
        if parts := parts_of(noise):
            with half_precision(noise.device):
                return torch.cat([self.draw(noise[part], conditioning.at(part), steps) for part in parts])
        mosaic, scroll, memory = conditioning.mosaic, conditioning.scroll, None
        if mosaic is not None and scroll is not None:
            memory = read_mosaic(mosaic, self.config.size, self.moves[scroll]).masked_fill(self.over, 0)
        rgb = plus(-1.0, conditioning.glimpse.rgb, 2)
        given = conditioning.context, scroll, memory, noise[:, :3], steps, conditioning.kept, conditioning.kept_keys
        x = self.sample(rgb, *given)
        return torch.cat([x, constant(_no_depth, x.device, *self.config.size).expand(len(x), -1, -1, -1)], 1)

    def recalling(
        self, seen: FlowFeatures, kept: torch.Tensor, keys: torch.Tensor, draft: torch.Tensor
    ) -> FlowFeatures:
        """The features with the kept frame that is most like the draft [B, 3, H, W] as memory."""
        return seen._replace(remembered=self._remembered(most_alike(kept, keys, draft), seen.base))

    def sample(self, frames, context, scroll, memory, noise: torch.Tensor, steps: int, kept=None, kept_keys=None):
        """The next frame [B, 3, H, W] in -1..1, drawn from `noise` of that shape in `steps` steps. kept uint8
        [B, K, 3, H, W], kept_keys [B, K, n]: earlier frames (space/recall.py). The rest: as in `encode`."""
        seen = self.encode(frames, context, scroll, memory)
        noise = noise if self.blend is None else self.blend.noise(noise)
        when = times_of(steps, self.config.recalls)
        times = self.time(constant(_waves_of_times, noise.device, when))
        whole = modulations(self._drawing, seen.embedding[:, None] + times)  # of all steps
        x = seen.base
        for step, time in enumerate(when):
            if step == 1 and kept is not None and kept_keys is not None:
                seen = self.recalling(seen, kept, kept_keys, x)
            noisy = torch.lerp(noise, x.clamp(-1, 1), time) if time else seen.base
            x = self._agreed(self._cleaned(seen, noisy, [(scale[:, step], shift[:, step]) for scale, shift in whole]))
        return self._settled(x, seen.base, memory)

    def shown(self, x: torch.Tensor, seen: FlowFeatures, memory: torch.Tensor | None) -> torch.Tensor:
        """The frame [B, 3, H, W] that is shown where `clean` gives x."""
        return self._settled(self._agreed(x), seen.base, memory)

    def _agreed(self, x: torch.Tensor) -> torch.Tensor:
        """After each drawing step the cameras are made to agree, as in MultiDiffusion (Bar-Tal et al. 2023)."""
        return x if self.blend is None else self.blend(x)

    def _settled(self, x: torch.Tensor, base: torch.Tensor, memory: torch.Tensor | None) -> torch.Tensor:
        """x with the colours of the base, or of memory, where it hardly differs from them."""
        x = torch.where(_alike(x, base, STAYS), base, x)
        if memory is not None:
            known = plus(-1.0, memory[:, :3], 1 / 127.5)
            x = torch.where(_alike(x, known, RECALLED) & (memory[:, 3:] > 0), known, x)
        return x

    @property
    def _drawing(self) -> tuple[AdaptiveBlock, ...]:
        """The blocks of a drawing step, in their order."""
        return (self.drawn, *self._blocks("after"))

    def _blocks(self, name: str) -> tuple[AdaptiveBlock, ...]:
        return tuple(getattr(self, name))

    def prepare(self, conditioning: Conditioning) -> Conditioning:
        """With `scroll`, the move by which most of the picture goes on, where pictures scroll."""
        if self.scrolling is None:
            return conditioning
        return replace(conditioning, scroll=predicted_scroll(self.scrolling, conditioning, self.moves))

    def _remembered(self, memory: torch.Tensor | None, base: torch.Tensor) -> torch.Tensor:
        """Memory as maps [B, 4, H, W]: colours relative to the base, 0 where unknown, and whether known."""
        if memory is None:
            return base.new_zeros(len(base), 4, *base.shape[-2:])
        known = (memory[:, 3:] > 0).float()
        return torch.cat([(plus(-1.0, memory[:, :3], 1 / 127.5) - base) * known, known], 1)

    def _padded(self, maps: torch.Tensor) -> torch.Tensor:
        """Maps [B, C, H, W] with replicated edges where a side is no multiple of 16."""
        height, width = self.config.size
        below, right = -height % (4 * SQUARE), -width % (4 * SQUARE)
        if below or right:
            maps = F.pad(maps, (0, right, 0, below), mode="replicate")
        return maps


def _waves(time: torch.Tensor) -> torch.Tensor:
    """Flow times [B] as sines and cosines [B, 2 * FREQUENCIES]."""
    angle = time[:, None] * (2.0 ** torch.arange(FREQUENCIES, device=time.device)) * (math.pi / 2)
    return torch.cat([angle.sin(), angle.cos()], 1)


def times_of(steps: int, recalls: bool) -> tuple[float, ...]:
    """Flow times of drawing steps. They end at the latest of training: what is drawn earlier is nearly a mean of what may follow,
    in which things slow down. With a frame that is recalled by the draft the next step is a draft again, which sees it; a late
    last step is further from the truth there (MiniWorld's rooms)."""
    if recalls and steps > 1:
        return (0.0, *(step / (steps - 1) for step in range(steps - 1)))
    return tuple(LATEST * step / max(1, steps - 1) for step in range(steps))


def _waves_of_times(times: tuple[float, ...]) -> torch.Tensor:
    return _waves(torch.tensor(times))


def _no_depth(height: int, width: int) -> torch.Tensor:
    """The code of the depth of a world of frames alone, 1 m everywhere."""
    return encode_depth(torch.ones(1, 1, height, width))


def carry(
    last: torch.Tensor,
    scroll: torch.Tensor,
    moves: torch.Tensor,
    over: torch.Tensor,
    memory: torch.Tensor | None = None,
) -> torch.Tensor:
    """Frames [B, 3, H, W] in -1..1 that went on by `moves` int64 [n, 2] of index `scroll` int64 [B]; what lies over them, bool
    [H, W], stays. What was outside of them, or under what lies over them, is as it is remembered (memory: as in `encode`), else as
    at the nearest edge."""
    place, rows, columns = displaced(moves[scroll], last.shape[-2:], last.shape[-2:])
    carried = last.flatten(2).gather(2, place.flatten(1)[:, None].expand(-1, 3, -1)).view_as(last)
    carried = torch.where(over, last, carried)
    if memory is None:
        return carried
    new = over.flatten()[place] >= (rows[..., None] & columns[:, None])
    return torch.where((new > over)[:, None] & (memory[:, 3:] > 0), plus(-1.0, memory[:, :3], 1 / 127.5), carried)


def _alike(one: torch.Tensor, other: torch.Tensor, most: float) -> torch.Tensor:
    """bool [B, 1, H, W]: where colours [B, 3, H, W] differ by less than `most`."""
    return torch.linalg.vector_norm(one - other, torch.inf, dim=1, keepdim=True) < most
