"""Distortions of pictures for recipes/frame_encoder.py: twelve that its training uses, and six others that test it.

Each takes pictures float [N, 3, H, W] in 0..255, a strength in 0..1 for each, and a generator.
"""

from __future__ import annotations

import functools
import io
import math

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image


def _uniform(shape, low, high, rng) -> torch.Tensor:
    return low + (high - low) * torch.rand(shape, generator=rng)


def _blur_by(x: torch.Tensor, sigma: float) -> torch.Tensor:
    if sigma < 0.15:
        return x
    reach = max(1, math.ceil(2.5 * sigma))
    taps = torch.exp(-((torch.arange(-reach, reach + 1).float() / sigma) ** 2) / 2)
    taps = taps / taps.sum()
    channels = x.shape[1]
    x = F.pad(x, (reach,) * 4, mode="reflect")
    x = F.conv2d(x, taps.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    return F.conv2d(x, taps.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)


def _each(spoil):
    """Lifts spoil(picture [1, 3, H, W], strength, rng) to a batch."""

    @functools.wraps(spoil)
    def over(x, strength, rng):
        return torch.cat([spoil(x[k : k + 1], float(s), rng) for k, s in enumerate(strength)])

    return over


@_each
def blur(x, strength, rng):
    return _blur_by(x, 3 * strength)


def noise(x, strength, rng):
    return x + 40 * strength.view(-1, 1, 1, 1) * torch.randn(x.shape, generator=rng)


@_each
def jpeg(x, strength, rng):
    picture = Image.fromarray(x[0].permute(1, 2, 0).clamp(0, 255).byte().numpy())
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=round(60 * (1 - strength) ** 1.5 + 3))
    return torch.from_numpy(np.array(Image.open(buffer))).permute(2, 0, 1)[None].float()


@_each
def coarse(x, strength, rng):
    """Down and up again, hard (pixels) or soft."""
    small = (max(4, round(x.shape[2] / (1 + 4 * strength))), max(4, round(x.shape[3] / (1 + 4 * strength))))
    mode = "nearest" if torch.rand((), generator=rng) < 0.5 else "bilinear"
    return F.interpolate(F.interpolate(x, small, mode="area"), x.shape[2:], mode=mode)


def colour(x, strength, rng):
    """A cast: each channel its own offset and gain."""
    s = strength.view(-1, 1, 1, 1)
    tint = torch.randn((len(x), 3, 1, 1), generator=rng)
    return x * (1 + 0.25 * s * torch.randn((len(x), 3, 1, 1), generator=rng)) + 35 * s * tint


def contrast(x, strength, rng):
    """Paler or harsher about the mean, darker or lighter."""
    s = strength.view(-1, 1, 1, 1)
    sign = torch.where(torch.rand((len(x), 1, 1, 1), generator=rng) < 0.6, -1.0, 1.0)
    mean = x.mean((1, 2, 3), keepdim=True)
    return mean + (x - mean) * (1 + 0.8 * s * sign) + 40 * s * torch.randn((len(x), 1, 1, 1), generator=rng)


@_each
def holes(x, strength, rng):
    """Things gone: boxes filled from their left and right edges."""
    x, (h, w) = x.clone(), x.shape[2:]
    for _ in range(1 + int(5 * strength)):
        high, wide = (int(_uniform((), 0.08, 0.12 + 0.3 * strength, rng) * side) + 2 for side in (h, w))
        top, left = int(_uniform((), 0, h - high, rng)), int(_uniform((), 1, max(2, w - wide - 1), rng))
        right = min(left + wide, w - 1)
        share = torch.linspace(0, 1, right - left)
        a, b = x[:, :, top : top + high, left - 1, None], x[:, :, top : top + high, right, None]
        x[:, :, top : top + high, left:right] = a * (1 - share) + b * share
    return x


@_each
def strange(x, strength, rng):
    """Wrong texture: boxes filled with a turned, scaled piece from elsewhere in the picture, or with noise alike."""
    x, (h, w), source = x.clone(), x.shape[2:], x
    for _ in range(1 + int(5 * strength)):
        high, wide = (int(_uniform((), 0.1, 0.15 + 0.35 * strength, rng) * side) + 3 for side in (h, w))
        top, left = int(_uniform((), 0, h - high, rng)), int(_uniform((), 0, w - wide, rng))
        from_top, from_left = int(_uniform((), 0, h - high, rng)), int(_uniform((), 0, w - wide, rng))
        piece = source[:, :, from_top : from_top + high, from_left : from_left + wide]
        if torch.rand((), generator=rng) < 0.5:
            piece = F.interpolate(piece.transpose(2, 3).flip(3), (high, wide), mode="bilinear")
        else:
            size = int(torch.randint(1, 5, (), generator=rng))
            grain = torch.randn((1, 3, high // size + 1, wide // size + 1), generator=rng)
            grain = F.interpolate(grain, scale_factor=size, mode="nearest")[:, :, :high, :wide]
            piece = piece.mean((2, 3), keepdim=True) + piece.std((2, 3), keepdim=True) * grain
        x[:, :, top : top + high, left : left + wide] = piece
    return x


def bent(x, strength, rng):
    """Wrong geometry: straight lines become wavy."""
    n, _, h, w = x.shape
    field = F.interpolate(torch.randn((n, 2, 5, 6), generator=rng), (h, w), mode="bicubic", align_corners=True)
    ys, xs = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    grid = torch.stack([xs, ys], -1) + 0.12 * strength.view(-1, 1, 1, 1) * field.permute(0, 2, 3, 1)
    return F.grid_sample(x, grid, mode="bicubic", padding_mode="reflection", align_corners=True)


@_each
def ghost(x, strength, rng):
    """A second, shifted picture shines through: what an average of two futures looks like."""
    shift = [
        int(torch.randint(2, 9, (), generator=rng)) * (1 - 2 * int(torch.randint(2, (), generator=rng))) for _ in "yx"
    ]
    return (1 - 0.5 * strength) * x + 0.5 * strength * torch.roll(x, shift, (2, 3))


@_each
def ringing(x, strength, rng):
    return x + 2.5 * strength * (x - _blur_by(x, 1.2))


@_each
def tiles(x, strength, rng):
    """Squares lose their detail, or their place: what a coarse tokenizer does."""
    side = (4, 8, 16)[int(torch.randint(3, (), generator=rng))]
    h, w = x.shape[2] // side * side, x.shape[3] // side * side
    mean = F.interpolate(F.avg_pool2d(x[:, :, :h, :w], side), scale_factor=side, mode="nearest")
    some = (torch.rand((1, 1, h // side, w // side), generator=rng) < strength).float()
    some = F.interpolate(some, scale_factor=side, mode="nearest")
    x = x.clone()
    x[:, :, :h, :w] = x[:, :, :h, :w] * (1 - some) + (0.2 * x[:, :, :h, :w] + 0.8 * mean) * some
    return x


WAYS = (blur, noise, jpeg, coarse, colour, contrast, holes, strange, bent, ghost, ringing, tiles)


def spoil(pictures: torch.Tensor, way: torch.Tensor, strength: torch.Tensor, rng) -> torch.Tensor:
    """Each picture in its own way (-1 none), rounded to bytes as a screen would."""
    out = pictures.clone()
    for number, spoiler in enumerate(WAYS):
        mine = (way == number).nonzero()[:, 0]
        if len(mine):
            out[mine] = spoiler(pictures[mine], strength[mine], rng)
    return out.clamp(0, 255).round()


@_each
def smeared(x, strength, rng):
    """Motion blur along a line."""
    reach = 1 + int(10 * strength)
    angle = float(_uniform((), 0, math.pi, rng))
    steps = [(round(k * math.sin(angle)), round(k * math.cos(angle))) for k in range(reach + 1)]
    return torch.stack([torch.roll(x, step, (2, 3)) for step in steps]).mean(0)


@_each
def median(x, strength, rng):
    size = 3 + 2 * round(3 * strength)
    windows = F.unfold(F.pad(x, (size // 2,) * 4, mode="reflect").transpose(0, 1), size)
    return windows.median(1).values.reshape(x.shape)


def pepper(x, strength, rng):
    hit = torch.rand((len(x), 1, *x.shape[2:]), generator=rng) < 0.08 * strength.view(-1, 1, 1, 1)
    return torch.where(hit, 255.0 * (torch.rand(hit.shape, generator=rng) < 0.5), x)


def posters(x, strength, rng):
    step = (8 + 80 * strength).view(-1, 1, 1, 1)
    return (x / step).round() * step


@_each
def shuffled(x, strength, rng):
    """Squares of 16 pixels change places."""
    h, w = x.shape[2] // 16, x.shape[3] // 16
    squares = x.unfold(2, 16, 16).unfold(3, 16, 16).flatten(2, 3).clone()
    some = torch.randperm(h * w, generator=rng)[: max(2, round(strength * h * w))]
    squares[:, :, some] = squares[:, :, some.roll(1)]
    return squares.reshape(1, 3, h, w, 16, 16).permute(0, 1, 2, 4, 3, 5).reshape(1, 3, h * 16, w * 16)


def hue(x, strength, rng):
    """Colours turned about grey by up to a third of the circle, one way for all."""
    angle = (2 * math.pi / 3 * strength).view(-1, 1, 1, 1)
    grey, across = x.mean(1, keepdim=True), (x.roll(1, 1) - x.roll(2, 1)) / math.sqrt(3)
    return grey + (x - grey) * angle.cos() + across * angle.sin()


NEW_WAYS = (smeared, median, pepper, posters, shuffled, hue)
LEVELS = (0.1, 0.3, 0.6, 1.0)
