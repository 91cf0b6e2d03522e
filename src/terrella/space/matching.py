"""By which displacement ("move", x and y in whole pixels) of several most of a picture went on to the next."""

import torch

from ..core.backend import constant, kernels_do
from .kernels_numba.matching import edge_shares as edge_shares_kernel
from .views import arrays, each_view

SAME, TEXTURED = 16, 12  # differences of 255: of one pixel in two pictures, and of neighbours in one


def edge_shares(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The share of the edges of `after` that each move brings from `before` (uint8 [B, 3, H, W]): 0..1 [B, M], from every second
    pixel with its neighbours above and to the left."""
    if not kernels_do(before):
        return edge_shares_slowly(before, after, moves)
    shares = torch.empty(len(after), len(moves))
    each_view(edge_shares_kernel, arrays(before, after, shares), *arrays(moves), SAME, TEXTURED)
    return shares


def edge_shares_slowly(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The same as `edge_shares`, in plain tensor algebra, also for GPUs."""
    height, width = after.shape[-2:]
    one, other = before.int(), after.int()
    corner = other[..., 1:, 1:]
    steps = (corner - other[..., :-1, 1:]).abs(), (corner - other[..., 1:, :-1]).abs()
    edges = (torch.maximum(*steps).amax(1) > TEXTURED)[:, ::2, ::2].flatten(1)
    x = constant(torch.arange, after.device, width) - moves[:, :1]
    y = constant(torch.arange, after.device, height) - moves[:, 1:]
    shifted = one[:, :, y.clamp(0, height - 1)[:, :, None], x.clamp(0, width - 1)[:, None]]  # [B, 3, M, H, W]
    off = (shifted - other[:, :, None]).abs().amax(1)
    off = torch.maximum(torch.maximum(off[..., 1:, 1:], off[..., :-1, 1:]), off[..., 1:, :-1])[..., ::2, ::2]
    inside = ((y[:, 1::2] >= 1) & (y[:, 1::2] < height))[:, :, None] & ((x[:, 1::2] >= 1) & (x[:, 1::2] < width))[
        :, None
    ]
    same = ((off <= SAME) & inside).flatten(2) & edges[:, None]
    return same.sum(2) / edges.sum(1, keepdim=True).clamp_min(1)


def scroll_index(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The index [B] (int64) of the move that brings most of the edges of `after`; 0, the first move, which is none, unless another
    brings clearly more."""
    return clear_index(edge_shares(before, after, moves))


def clear_index(shares: torch.Tensor) -> torch.Tensor:
    """The index [B] of the largest result of `edge_shares` [B, M]; 0 unless it is clearly larger than the first."""
    most, move = shares.max(1)
    return torch.where(most > 1.25 * shares[:, 0] + 0.01, move, 0)
