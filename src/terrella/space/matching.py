"""By which displacement ("move", x and y in whole pixels) of several most of a picture went on to the next."""

import torch

from ..core.backend import constant, derived, kernels_do
from .kernels_numba.matching import edge_shares as edge_shares_kernel
from .mosaic import displaced
from .views import arrays, each_view

SAME, TEXTURED = 16, 12  # differences of 255: of one pixel in two pictures, and of neighbours in one


def edge_shares(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The share of the edges of `after` that each move brings from `before` (uint8 [..., 3, H, W]): 0..1 [..., M], from every
    second pixel with its neighbours above and to the left."""
    if not kernels_do(before):
        return edge_shares_slowly(before, after, moves)
    pictures = [part.flatten(0, -4) if part.ndim > 4 else part for part in (before, after)]
    shares = torch.empty(len(pictures[0]), len(moves))
    each_view(edge_shares_kernel, arrays(*pictures, shares), *arrays(moves), SAME, TEXTURED)
    return shares.view(*after.shape[:-3], len(moves))


def edge_shares_slowly(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The same as `edge_shares`, in plain tensor algebra, also for GPUs."""
    size = after.shape[-2:]
    corners = constant(_corners, after.device, *size)
    now = after.flatten(-2)[..., corners].int()  # [..., 3, corner, n]
    edges = (now[..., 1:, :] - now[..., :1, :]).abs().amax((-3, -2)) > TEXTURED
    was = before.flatten(-2)[..., derived(_came_from, moves, *size)]  # [..., 3, M, corner, n]
    off = (was - now[..., None, :, :]).abs().amax((-4, -2))
    same = (off <= SAME) & derived(_comes_from_inside, moves, *size) & edges[..., None, :]
    return same.sum(-1) / edges.sum(-1, keepdim=True).clamp_min(1)


def _corners(height: int, width: int) -> torch.Tensor:
    """int64 [3, n]: every second pixel, those above, and those to the left."""
    pixels = torch.arange(1, height, 2)[:, None] * width + torch.arange(1, width, 2)
    return torch.stack([pixels.flatten() - step for step in (0, width, 1)])


def _came_from(moves: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """int64 [M, 3, n]: the pixels that each move brings to `_corners`, or the nearest."""
    place = displaced(moves, (height, width), (height, width))[0]
    return place.flatten(1)[:, _corners(height, width).to(moves.device)]


def _comes_from_inside(moves: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """bool [M, n]: whether these lie in the picture."""
    rows, columns = (part[:, 1::2] & part[:, :-1:2] for part in displaced(moves, (height, width), (height, width))[1:])
    return (rows[..., None] & columns[:, None]).flatten(1)


def scroll_index(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The index [B] (int64) of the move that brings most of the edges of `after`; 0, the first move, which is none, unless another
    brings clearly more."""
    return clear_index(edge_shares(before, after, moves))


def clear_index(shares: torch.Tensor) -> torch.Tensor:
    """The index [B] of the largest result of `edge_shares` [B, M]; 0 unless it is clearly larger than the first."""
    most, move = shares.max(1)
    return torch.where(most > 1.25 * shares[:, 0] + 0.01, move, 0)
