"""The mosaic: the map and the memory of a flat world, its pictures stitched by how they scroll, with the current one in the middle.
A pixel holds its most frequent colour (a majority vote, Boyer and Moore 1981), so that objects in front leave no trace."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from ..core.backend import constant, kernels_do
from .kernels_numba.matching import update_mosaic as update_mosaic_kernel
from .views import arrays, each_view

PICTURES = (4, 5)  # height and width of a mosaic, in pictures
SAME, MOST = 8, 20  # the largest difference (of 255) of equal colours; the most votes of a colour


def empty_mosaic(batch: int, size: tuple[int, int], device: torch.device | str = "cpu") -> torch.Tensor:
    """Empty mosaics for pictures of `size`: uint8 [B, 4, H', W'], colour and votes."""
    return torch.zeros(batch, 4, PICTURES[0] * size[0], PICTURES[1] * size[1], dtype=torch.uint8, device=device)


def update_mosaic(mosaic: torch.Tensor, frame: torch.Tensor, move: torch.Tensor, over: torch.Tensor) -> torch.Tensor:
    """Mosaics uint8 [B, 4, H', W'] after the next pictures uint8 [B, 3, H, W], which scrolled by `move` int64 [B, 2] = x, y in
    pixels. The overlay, pixels `over` bool [H, W], does not scroll. What leaves the mosaic is forgotten."""
    if not kernels_do(frame):
        return update_mosaic_slowly(mosaic, frame, move, over)
    after = torch.empty(mosaic.shape, dtype=torch.uint8)
    each_view(update_mosaic_kernel, arrays(mosaic, frame, move, after), *arrays(over), SAME, MOST)
    return after


def update_mosaic_slowly(
    mosaic: torch.Tensor, frame: torch.Tensor, move: torch.Tensor, over: torch.Tensor
) -> torch.Tensor:
    """The same as `update_mosaic`, in plain tensor algebra, also for GPUs."""
    size = frame.shape[-2:]
    after = _window(mosaic, move, mosaic.shape[-2:])
    top, left = middle(mosaic, size)
    seen = after[..., top : top + size[0], left : left + size[1]]
    colours, votes = seen.split([3, 1], 1)
    same = (colours.int() - frame).abs().amax(1, keepdim=True) <= SAME
    colour = torch.where(votes + same > 1, colours, frame)  # else outvoted, or new
    votes = torch.add(votes, same, alpha=2).clamp_(2, MOST + 1).sub_(1)
    after[..., top : top + size[0], left : left + size[1]] = torch.where(over, seen, torch.cat([colour, votes], 1))
    return after


def read_mosaic(mosaic: torch.Tensor, size: tuple[int, int], move: torch.Tensor) -> torch.Tensor:
    """The part of mosaics that the next picture shows after scrolling by `move` int64 [B, 2]: uint8 [B, 4, H, W], colour and
    votes, 0 where nothing was seen."""
    return _window(mosaic, move, size)


def _window(mosaic: torch.Tensor, move: torch.Tensor, size) -> torch.Tensor:
    """The middle `size` of mosaics displaced by `move`."""
    place, rows, columns = displaced(move, mosaic.shape[-2:], size, middle(mosaic, size))
    window = mosaic.flatten(2).gather(2, place.flatten(1)[:, None].expand(-1, 4, -1)).unflatten(2, tuple(size))
    return window * (rows[..., None] & columns[:, None])[:, None]


def displaced(
    move: torch.Tensor, whole: Sequence[int], size: Sequence[int], corner: Sequence[int] = (0, 0)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where the pixels of windows of `size`, at `corner` (row and column) of `whole` pictures, come from if these went on by `move`
    int64 [n, 2] = x, y: the pixels int64 [n, H, W], counted along rows, or the nearest; and which rows [n, H] and which columns
    [n, W] come from inside."""
    place = constant(_lines, move.device, tuple(size), tuple(corner)) - move[:, None]  # [n, line, column or row]
    near = torch.clamp(place, *constant(_ends, move.device, tuple(whole)).unbind(0))
    inside, columns, rows = place == near, near[:, : size[1], 0], near[:, : size[0], 1]
    return (
        torch.add(columns[:, None], rows[..., None], alpha=whole[1]),
        inside[:, : size[0], 1],
        inside[:, : size[1], 0],
    )


def _lines(size: tuple[int, int], corner: tuple[int, int]) -> torch.Tensor:
    """int64 [n, 2]: the columns and the rows of a window, as many of both."""
    return torch.arange(max(size))[:, None] + torch.tensor(corner[::-1])


def _ends(whole: tuple[int, int]) -> torch.Tensor:
    """int64 [2, 2]: the first and the last column and row."""
    return torch.tensor([[0, 0], [whole[1] - 1, whole[0] - 1]])


def middle(mosaic: torch.Tensor, size) -> tuple[int, int]:
    """Row and column of a mosaic at which the picture in its middle begins."""
    return (mosaic.shape[-2] - size[0]) // 2, (mosaic.shape[-1] - size[1]) // 2


def write_mosaic(mosaic: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """`mosaic` with the seen pixels of `seen`, uint8 [B, 4, H, W], written to its middle."""
    top, left = middle(mosaic, seen.shape[-2:])
    margin = left, mosaic.shape[-1] - left - seen.shape[-1], top, mosaic.shape[-2] - top - seen.shape[-2]
    return torch.where(F.pad(seen[:, 3:], margin) > 0, F.pad(seen, margin), mosaic)
