"""The ground of a flat world: all that its recordings scrolled over as one picture, and where other pictures lie on it.

A ground is a mosaic (mosaic.py) of any size: uint8 [4, H, W], colour and votes, 0 where nothing was seen.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from ..core.backend import constant
from .mosaic import SAME, middle, read_mosaic

LEAST = 0.5  # share of a picture that must lie on the ground
ALIKE = 0.6  # share of equal pixels from which a picture is recognised
NOWHERE = -(10**6)  # x and y of a picture whose place is unknown


def locate(pictures: torch.Tensor, shown: torch.Tensor, ground: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where pictures uint8 [B, 3, h, w], of which the pixels `shown` bool [B, h, w] count, lie on the ground: x and y of their
    upper left corners, int64 [B, 2], with the least squared error; and the share of pixels that are equal there [B], 0 where
    less than half of the pixels would lie on the ground."""
    (height, width), (tall, wide) = pictures.shape[-2:], ground.shape[-2:]
    size = height + tall - 1, width + wide - 1
    seen, mask = (ground[3] > 0).float(), shown.float()
    colour, other = ground[:3].float() / 255 * seen, pictures.float() / 255 * mask[:, None]

    def across(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
        """Correlation of [B, c, h, w] with [c, H, W] at all offsets, summed over c: [B, *size], the offsets modulo the size."""
        return torch.fft.irfft2((torch.fft.rfft2(two, size) * torch.fft.rfft2(one, size).conj()).sum(1), size)

    count = across(mask[:, None], seen[None])
    error = across(other.square().sum(1, keepdim=True), seen[None]) - 2 * across(other, colour)
    error = error + across(mask[:, None], colour.square().sum(0, keepdim=True))
    enough = count >= LEAST * mask.sum((1, 2)).clamp_min(1)[:, None, None]
    best = torch.where(enough, error / count.clamp_min(1), torch.inf).flatten(1).min(1)
    y, x = best.indices // size[1], best.indices % size[1]
    place = torch.stack([torch.where(x >= wide, x - size[1], x), torch.where(y >= tall, y - size[0], y)], 1)
    under = window(ground, place, (height, width))
    both = (under[:, 3] > 0) & shown
    same = ((under[:, :3].int() - pictures.int()).abs().amax(1) <= SAME) & both
    share = same.sum((1, 2)) / both.sum((1, 2)).clamp_min(1)
    return place, torch.where(best.values < torch.inf, share, 0.0)


def window(ground: torch.Tensor, place: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """The part of a ground with its upper left corners at `place` int64 [B, 2] (x, y): uint8 [B, 4, *size], 0 beyond the ground."""
    at = constant(torch.tensor, place.device, middle(ground, size)[::-1])
    return read_mosaic(ground.expand(len(place), -1, -1, -1), size, at - place)


def joined(grounds: Sequence[torch.Tensor]) -> torch.Tensor:
    """One ground of several, each put where it lies on the largest; those that lie nowhere on it are left out."""
    left = sorted((cropped(one) for one in grounds), key=lambda one: int((one[3] > 0).sum()))
    whole, put = left.pop(), True
    while put:
        put = False
        for one in left[::-1]:
            place, share = locate(one[None, :3], one[None, 3] > 0, whole)
            if share[0] < ALIKE:
                continue
            x, y = place[0].tolist()
            high, broad = one.shape[-2:]
            edges = max(0, -x), max(0, x + broad - whole.shape[2]), max(0, -y), max(0, y + high - whole.shape[1])
            whole = F.pad(whole, edges)
            part = whole[:, max(y, 0) : max(y, 0) + high, max(x, 0) : max(x, 0) + broad]
            part.copy_(torch.where(part[3] > 0, part, one))
            left, put = [rest for rest in left if rest is not one], True
    return whole


def cropped(ground: torch.Tensor) -> torch.Tensor:
    """Without empty rows and columns around it; one pixel of an empty ground."""
    rows, columns = (torch.nonzero((ground[3] > 0).any(dim))[:, 0].tolist() or [0] for dim in (1, 0))
    return ground[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].clone()
