"""Codec: a generator for worlds without depth, which fetches pixels before it paints any, as a video codec does.

Each pixel is taken from the last frame, as it is or displaced by a move of the recording (learn/moves.py), from an older frame
or the mosaic, or is painted in a colour of the recording's palette: a pointer-generator mixture (See et al. 2017).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, final

import torch
import torch.nn.functional as F
from torch import nn

from ..space.matching import (
    FEW,
    SAME,
    clear_index,
    edge_shares,
    gather_sources,
    majority_colours,
    prefer_scroll,
    source_shares,
)
from ..space.mosaic import read_mosaic
from .generator import Block, Conditioning, down_and_up, encode_depth, generate
from .scroll import Scroll, frames_of, predicted_scroll

COARSE = 4  # side in pixels of the squares that the trunk sees; choices are made for each pixel
PIXEL = 16  # features of each pixel from its square, and as many from its neighbours
HIDDEN = 32  # features of each pixel that its choice is read from
CHANCE = 0.25  # temperature: 1 samples frames by their probability, 0 takes the likeliest
THING = 23  # side in pixels of a square, larger than most of the things before a ground
AROUND = 8  # side in pixels of the squares in and around which colours are counted
UNKNOWN = -1e4  # logit of a source that does not exist


@dataclass(frozen=True)
class CodecConfig:
    """Of the codec."""

    size: tuple[int, int]  # height and width of a frame, pixels
    slots: int  # last frames that it sees
    context: int  # numbers that it is conditioned on beside maps
    moves: int  # displacements among which it chooses, beside (0, 0)
    colours: int  # of the palette
    channels: tuple[int, ...] = (48, 64, 96)  # at 1/4, 1/8, ... of the size
    steps: int = 1  # a frame is drawn in one step
    residual: bool = True


class CodecInputs(NamedTuple):
    """What a frame is made from."""

    sources: torch.Tensor  # uint8 [B, slots + 1, 3, H, W]: the last frames, the newest first, and the mosaic
    scrolled: torch.Tensor  # uint8 [B, 3, H, W]: the newest frame displaced by `along`
    known: torch.Tensor  # [B, 1, H, W]: where the mosaic knows the next frame
    along: torch.Tensor  # int64 [B, H, W]: the move by which a pixel scrolls, 0 where something lies over the picture
    over: torch.Tensor  # bool [B, H, W]: what lies over the picture and does not scroll with it
    went: torch.Tensor  # [B, moves + 1, H, W]: how well each move that leads to a pixel explained the last step there
    common: torch.Tensor  # [B, h, w, colours, 2]: share of each colour in all of `scrolled` and around each square


@final
class Codec(nn.Module):
    """`moves` int64 [moves + 1, 2] = x, y in pixels, (0, 0) first; `palette` uint8 [colours, 3]; `stress` []: the factor by which
    the probability to stay is raised, since changing pixels were given more weight in training."""

    kind = "codec"
    moves: torch.Tensor
    palette: torch.Tensor
    stress: torch.Tensor

    def __init__(self, config: CodecConfig):
        super().__init__()
        self.config = config
        height, width = config.size
        widths, seen, moves = config.channels, 3 * (config.slots + 2) + 1, config.moves + 1
        self.register_buffer("moves", torch.zeros(moves, 2, dtype=torch.int64))
        self.register_buffer("palette", torch.zeros(config.colours, 3, dtype=torch.uint8))
        self.register_buffer("stress", torch.ones(()))
        self.enter = nn.Conv2d(COARSE**2 * (seen + 2) + moves, widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.before = nn.ModuleList(Block(width, config.context) for width in widths)
        self.after = nn.ModuleList(Block(width, config.context) for width in widths)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.leave = nn.Conv2d(widths[0], COARSE**2 * PIXEL, 1)
        self.near = nn.Conv2d(seen, PIXEL, 3, padding=1)
        self.going = nn.Conv2d(moves, PIXEL, 1)
        self.nearby = nn.Conv2d(PIXEL, PIXEL, 3, padding=3, dilation=3)
        self.mixed = nn.Conv2d(2 * PIXEL, HIDDEN, 1)
        # its last two logits: goes on as most of the picture does, and as before
        self.choice = nn.Conv2d(HIDDEN, self.sources + 3, 1)
        self.colour = nn.Sequential(nn.Linear(HIDDEN + 6, 64), nn.SiLU(), nn.Linear(64, config.colours))
        self.common = nn.Parameter(torch.tensor([0.3, 0.3]))  # weights of colours in the picture, and near
        nn.init.zeros_(self.choice.weight)
        bias = torch.full((self.sources + 3,), -1.0)
        bias[0], bias[-2], bias[-1] = 3.0, 6.0, 2.0  # at first everything goes as most of the picture does
        self.choice.bias = nn.Parameter(bias)
        self.scrolling = Scroll(config)

    @property
    def sources(self) -> int:
        """Sources of a pixel: the moves of the last frame, then the older frames, then the mosaic."""
        return self.config.moves + self.config.slots + 1

    def forward(self, noisy: torch.Tensor, time: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """The next frame [B, 4, H, W] in the generator's code; `noisy` is its source of chance, the time is not used."""
        mosaic, over, scroll = conditioning.mosaic, conditioning.over, conditioning.scroll
        assert mosaic is not None and over is not None and scroll is not None
        seen = self.seen(frames_of(conditioning), mosaic, over, scroll)
        choices, features = self.choices(seen, conditioning.context)
        if conditioning.evidence:  # what scrolls into the picture is as it was seen
            comes = (self._beyond(seen.over) & seen.known).gather(1, seen.along[:, None])
            memory = torch.full_like(choices[:1, :, :1, :1], UNKNOWN)
            memory[:, -2] = 0
            choices = torch.where(comes, memory, choices)
        drawn = self.drawn(seen, choices + CHANCE * shared_chance(noisy, choices), features)
        if conditioning.evidence:
            drawn = without_smears(drawn, seen)
        drawn = drawn.float() / 127.5 - 1
        return torch.cat([drawn, encode_depth(conditioning.glimpse.depth)[:, None]], 1)

    def draw(self, noise: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
        """See parts.Generator."""
        return generate(self, noise, conditioning, 1)

    def prepare(self, conditioning: Conditioning) -> Conditioning:
        """With `scroll`, the move by which most of the picture goes on, where there is a mosaic; and with what that mosaic then
        knows of the picture, if it holds evidence alone."""
        if conditioning.mosaic is None:
            return conditioning
        scroll = predicted_scroll(self.scrolling, conditioning, self.moves)
        if not conditioning.evidence or conditioning.over is None:
            return replace(conditioning, scroll=scroll)
        votes = read_mosaic(conditioning.mosaic, self.config.size, self.moves[scroll])[:, 3]
        known = ((votes > 0) | conditioning.over).float()
        return replace(conditioning, scroll=scroll, glimpse=replace(conditioning.glimpse, known=known))

    def seen(self, frames: torch.Tensor, mosaic: torch.Tensor, over: torch.Tensor, move: torch.Tensor) -> CodecInputs:
        """The inputs where most of the picture goes on by `move` [B]. mosaic: as of frames[:, 0]; over bool [B, H, W]: pixels that
        are no part of it."""
        memory = read_mosaic(mosaic, self.config.size, self.moves[move])
        known = (memory[:, 3:] > 0) & ~over[:, None]
        last = clear_index(edge_shares(frames[:, 1], frames[:, 0], self.moves))
        along, last = (torch.where(over, 0, one[:, None, None]) for one in (move, last))
        scrolled = gather_sources(frames, along, self.moves)
        sources = torch.cat([frames, torch.where(known, memory[:, :3], scrolled)[:, None]], 1)
        went, _ = source_shares(frames[:, 1:2], frames[:, 0], self.moves)
        went = self._carried(prefer_scroll(went, last))
        return CodecInputs(sources, scrolled, known, along, over, went, self.common_colours(scrolled))

    def choices(self, seen: CodecInputs, context: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits [B, sources + 1, H, W] of each pixel's source, the last for "painted"; the pixels' features [B, HIDDEN, H, W]."""
        batch, (height, width), last = len(seen.known), self.config.size, torch.channels_last
        shown = torch.cat([seen.sources.flatten(1, 2), seen.scrolled], 1).float() / 127.5 - 1
        shown = torch.cat([shown, seen.known.float()], 1)
        down, across = (torch.linspace(-1, 1, length, device=shown.device) for length in (height, width))
        place = torch.stack([down[:, None].expand(height, width), across.expand(height, width)])
        squares = F.pixel_unshuffle(torch.cat([shown, place.expand(batch, -1, -1, -1)], 1), COARSE)
        x = F.silu(self.enter(torch.cat([squares, F.avg_pool2d(seen.went, COARSE)], 1)))
        x = down_and_up(self, x, context)
        near = F.silu(self.near(shown.contiguous(memory_format=last)) + self.going(seen.went))
        near = near + self.nearby(near)
        features = torch.cat([F.pixel_shuffle(self.leave(x), COARSE), near], 1)
        features = F.silu(self.mixed(F.silu(features).contiguous(memory_format=last)))
        choices, scrolls, goes = self.choice(features).split((self.sources + 1, 1, 1), 1)
        displaced, others, memory, painted = choices.split((len(self.moves), self.config.slots - 1, 1, 1), 1)
        displaced = displaced + goes * seen.went
        along = seen.along[:, None]
        displaced = displaced.scatter(1, along, torch.logaddexp(displaced.gather(1, along), scrolls))
        beyond = self._beyond(seen.over) & seen.known  # not in the last frame, but in the mosaic: taken from there
        memory = torch.where(seen.known, memory, UNKNOWN)
        memory = torch.logaddexp(memory, torch.where(beyond, displaced, UNKNOWN).logsumexp(1, keepdim=True))
        displaced = torch.where(beyond, UNKNOWN, displaced)
        comes = beyond.gather(1, along)  # and not painted either
        memory = torch.logaddexp(memory, torch.where(comes, painted, UNKNOWN))
        painted = torch.where(comes, UNKNOWN, painted)
        return torch.cat([displaced, others, memory, painted], 1), features

    def colours(self, seen: CodecInputs, features: torch.Tensor, where: torch.Tensor | None = None) -> torch.Tensor:
        """Logits [n, colours] of the palette colour in which the pixels `where` (bool [B, H, W]; None: all) would be painted."""
        near = torch.cat([seen.sources[:, 0], seen.scrolled], 1)
        often = (seen.common + 1e-3).log() @ self.common
        if where is None:
            known = torch.cat([features, near.float() / 127.5 - 1], 1).permute(0, 2, 3, 1)
            often = often.repeat_interleave(AROUND, 1).repeat_interleave(AROUND, 2)
            return (self.colour(known) + often).flatten(0, 2)
        batch, v, u = where.nonzero(as_tuple=True)
        known = features.permute(0, 2, 3, 1)[batch, v, u], near.permute(0, 2, 3, 1)[batch, v, u].float() / 127.5 - 1
        return self.colour(torch.cat(known, 1)) + often[batch, v // AROUND, u // AROUND]

    def common_colours(self, frame: torch.Tensor) -> torch.Tensor:
        """Share of the pixels of uint8 [B, 3, H, W] whose nearest palette colour is each, in the whole picture and in and around
        each square: [B, H / AROUND, W / AROUND, colours, 2]."""
        every = frame[..., ::2, ::2].permute(0, 2, 3, 1)
        nearest = torch.cdist(every.flatten(1, 2).float(), self.palette.float()).argmin(2)
        each = F.one_hot(nearest, len(self.palette)).float().transpose(1, 2).unflatten(2, every.shape[1:3])
        around = F.avg_pool2d(F.avg_pool2d(each, AROUND // 2), 3, 1, 1, count_include_pad=False).permute(0, 2, 3, 1)
        return torch.stack([around.mean((1, 2), keepdim=True).expand_as(around), around], -1)

    def drawn(self, seen: CodecInputs, choices: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """The next frames, uint8 [B, 3, H, W]: each pixel in its likeliest colour, summed over sources of that colour."""
        share = choices.softmax(1)
        if share.device.type == "cpu":  # in most frames few pixels are painted
            paints = share[:, -1] >= FEW
            painted = torch.zeros(*paints.shape, 3, dtype=torch.uint8)
            painted[paints] = self.palette[self.colours(seen, features, paints).argmax(1)]
        else:
            painted = self.palette[self.colours(seen, features).argmax(1)].view(*share[:, -1].shape, 3)
        return majority_colours(seen.sources, share, painted.permute(0, 3, 1, 2), self.moves, self.stress)

    def _beyond(self, over: torch.Tensor) -> torch.Tensor:
        """bool [B, moves + 1, H, W]: pixels that each move would fetch from outside of the last frame, or from what lies `over` it
        (bool [B, H, W])."""
        height, width = self.config.size
        x = torch.arange(width, device=over.device) - self.moves[:, :1]
        y = torch.arange(height, device=over.device) - self.moves[:, 1:]
        outside = ((y < 0) | (y >= height))[:, :, None] | ((x < 0) | (x >= width))[:, None]
        return outside | self._carried(over[:, None].expand(-1, len(self.moves), -1, -1))

    def _carried(self, went: torch.Tensor) -> torch.Tensor:
        """Maps of the moves [B, moves + 1, H, W], each displaced by its move."""
        height, width = self.config.size
        x = (torch.arange(width, device=went.device) - self.moves[:, :1]).clamp(0, width - 1)
        y = (torch.arange(height, device=went.device) - self.moves[:, 1:]).clamp(0, height - 1)
        place = (y[:, :, None] * width + x[:, None]).flatten(1)
        return went.flatten(2).gather(2, place.expand(len(went), -1, -1)).unflatten(2, (height, width))


def without_smears(drawn: torch.Tensor, seen: CodecInputs) -> torch.Tensor:
    """Frames uint8 [B, 3, H, W] as they were remembered where most of a square of THING pixels differs from that: things are
    smaller, so it is a smear."""
    ground = seen.sources[:, -1]
    other = ((drawn.int() - ground.int()).abs().amax(1, keepdim=True) > SAME) & seen.known
    (down, across), (above, before) = ((THING, 1), (1, THING)), ((THING // 2, 0), (0, THING // 2))
    votes = F.avg_pool2d(2.0 * other - 1, down, 1, above, divisor_override=1)  # sums of +1 and -1, exact
    smears = F.avg_pool2d(votes, across, 1, before, divisor_override=1) > 0
    smears = F.max_pool2d(F.max_pool2d(smears.float(), down, 1, above), across, 1, before) > 0
    return torch.where(other & smears, ground, drawn)


def shared_chance(noise: torch.Tensor, choices: torch.Tensor) -> torch.Tensor:
    """Gumbel noise [B, K, 1, 1] for choices [B, K, H, W], from normal `noise`. It is the same for all pixels of a picture: where
    they are uncertain they choose alike, and a thing stays whole (a maximal coupling)."""
    uniform = torch.special.ndtr(noise.flatten(1)[:, : choices.shape[1]]).clamp(1e-6, 1 - 1e-6)
    return -(-uniform.log()).log()[:, :, None, None]
