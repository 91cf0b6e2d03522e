"""The mosaic: what was seen of a flat world, pictures joined by how they scroll. It is the map of such a world, and its memory.

Its middle is the picture of now. Each of its pixels holds the colour that most pictures had there (a majority vote, Boyer and
Moore 1981), so that what passes in front of a background leaves no trace in it.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from .kernels_numba.matching import remembered as remembered_kernel
from .views import arrays, each_view

PICTURES = (4, 5)  # of the height and of the width of a picture
SAME, MOST = 8, 20  # difference of 255 up to which colours are one; votes that a colour may have


def blank(batch: int, size: tuple[int, int], device: torch.device | str = "cpu") -> torch.Tensor:
    """Mosaics of which nothing was seen, for pictures of `size`: uint8 [B, 4, H', W'], colour and votes."""
    return torch.zeros(batch, 4, PICTURES[0] * size[0], PICTURES[1] * size[1], dtype=torch.uint8, device=device)


def remembered(mosaic: torch.Tensor, frame: torch.Tensor, move: torch.Tensor, over: torch.Tensor) -> torch.Tensor:
    """Mosaics uint8 [B, 4, H', W'] after the next pictures uint8 [B, 3, H, W], to which those before went on by `move` int64
    [B, 2] = x, y in pixels. Pixels `over` bool [H, W] are no part of what scrolls. What leaves the mosaic is forgotten."""
    if frame.device.type != "cpu":
        return remembered_slowly(mosaic, frame, move, over)
    after = torch.empty(mosaic.shape, dtype=torch.uint8)
    each_view(remembered_kernel, arrays(mosaic, frame, move, after), *arrays(over), SAME, MOST)
    return after


def remembered_slowly(
    mosaic: torch.Tensor, frame: torch.Tensor, move: torch.Tensor, over: torch.Tensor
) -> torch.Tensor:
    """The same as `remembered`, in plain tensor algebra; the way on a GPU."""
    size = frame.shape[-2:]
    after = _window(mosaic, move, mosaic.shape[-2:])
    seen = _window(after, torch.zeros_like(move), size)
    votes = seen[:, 3:].int()
    same = (seen[:, :3].int() - frame.int()).abs().amax(1, keepdim=True) <= SAME
    agree, doubt = same & (votes > 0), votes > 1
    colour = torch.where(agree | doubt, seen[:, :3], frame)
    votes = torch.where(agree, (votes + 1).clamp_max(MOST), torch.where(doubt, votes - 1, 1))
    top, left = _corner(mosaic, size)
    joined = torch.where(over, seen, torch.cat([colour, votes.to(torch.uint8)], 1))
    after[..., top : top + size[0], left : left + size[1]] = joined
    return after


def recalled(mosaic: torch.Tensor, size: tuple[int, int], move: torch.Tensor) -> torch.Tensor:
    """What mosaics know of the picture that the one of now goes on to by `move` int64 [B, 2]: uint8 [B, 4, H, W], colour and
    votes, 0 where nothing was seen."""
    return _window(mosaic, move, size)


def _window(mosaic: torch.Tensor, move: torch.Tensor, size) -> torch.Tensor:
    """The middle `size` of mosaics displaced by `move`."""
    tall, wide = mosaic.shape[-2:]
    top, left = _corner(mosaic, size)
    y = torch.arange(top, top + size[0], device=mosaic.device) - move[:, 1:]
    x = torch.arange(left, left + size[1], device=mosaic.device) - move[:, :1]
    inside = ((y >= 0) & (y < tall))[:, :, None] & ((x >= 0) & (x < wide))[:, None]
    place = y.clamp(0, tall - 1)[:, :, None] * wide + x.clamp(0, wide - 1)[:, None]
    found = mosaic.flatten(2).gather(2, place.flatten(1)[:, None].expand(-1, 4, -1)).unflatten(2, tuple(size))
    return found * inside[:, None]


def _corner(mosaic: torch.Tensor, size) -> tuple[int, int]:
    return (mosaic.shape[-2] - size[0]) // 2, (mosaic.shape[-1] - size[1]) // 2


def held_in(mosaic: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """`mosaic` whose middle holds what was seen there, uint8 [B, 4, H, W]."""
    top, left = _corner(mosaic, seen.shape[-2:])
    margin = left, mosaic.shape[-1] - left - seen.shape[-1], top, mosaic.shape[-2] - top - seen.shape[-2]
    return torch.where(F.pad(seen[:, 3:], margin) > 0, F.pad(seen, margin), mosaic)
