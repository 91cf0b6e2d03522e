"""How pictures go on in pictures, by displacements ("moves", x and y in whole pixels): which of them explain a pixel, and by
which most of a picture scrolls."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from .kernels_numba.matching import explained as explained_kernel
from .kernels_numba.matching import explains as explains_kernel
from .kernels_numba.matching import half_a_pixel as half_a_pixel_kernel
from .kernels_numba.matching import voted as voted_kernel
from .views import arrays, each_view

# Differences (of 255): of a pixel, and around it, by which it is explained less by e; and of a pixel that is not explained.
SHARP, NEAR, NEVER = 10.0, 3.0, 60.0
CLEAR = 0.97  # of what is explained already is not left to others
FEW, EQUAL = 0.01, 4  # the share of what has no vote; difference of 255 up to which what is drawn stays as it was
SAME, TEXTURED = 16, 12  # differences of 255: of one pixel in two pictures, and of neighbours in one


def fetched(frames: torch.Tensor, source: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The pixels of `frames` (uint8 [B, slots, 3, H, W]) that the sources [B, H, W] name: uint8 [B, 3, H, W]. The first sources
    are the newest frame displaced by `moves` int64 [M, 2], the others the older frames; beyond an edge lies its own pixel."""
    height, width = frames.shape[-2:]
    slot = (source - len(moves) + 1).clamp_min(0)
    moved = torch.where(slot > 0, 0, source)
    x = (torch.arange(width, device=source.device) - moves[:, 0][moved]).clamp(0, width - 1)
    y = (torch.arange(height, device=source.device)[:, None] - moves[:, 1][moved]).clamp(0, height - 1)
    place = ((slot * height + y) * width + x).flatten(1)
    flat = frames.transpose(1, 2).flatten(2)
    return flat.gather(2, place[:, None].expand(-1, 3, -1)).unflatten(2, (height, width))


def half_a_pixel(frame: torch.Tensor) -> torch.Tensor:
    """The least and the largest colours that each pixel of uint8 [B, 3, H, W] takes when the picture is displaced by up to half a
    pixel: uint8 [B, 2, 3, H, W]. Pictures scroll by parts of pixels, and sources are displaced by whole ones."""
    if frame.device.type != "cpu":
        return half_a_pixel_slowly(frame)
    bounds = torch.empty(len(frame), 2, *frame.shape[1:], dtype=torch.uint8)
    each_view(half_a_pixel_kernel, arrays(frame, bounds))
    return bounds


def half_a_pixel_slowly(frame: torch.Tensor) -> torch.Tensor:
    """The same as `half_a_pixel`, in plain tensor algebra; the way on a GPU."""
    both = []
    for least in (torch.minimum, torch.maximum):
        bound = frame.to(torch.int16) * 16
        for dim in (2, 3):
            length = bound.shape[dim]
            before = bound.index_select(dim, torch.arange(-1, length - 1, device=frame.device).clamp_min(0))
            after = bound.index_select(dim, torch.arange(1, length + 1, device=frame.device).clamp_max(length - 1))
            bound = least(bound, (bound + least(before, after)) // 2)
        both.append(bound // 16)
    return torch.stack(both, 1).to(torch.uint8)


def explained(frames: torch.Tensor, truth: torch.Tensor, moves: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How well each source (see `fetched`) explains each pixel of the next frames `truth` (uint8 [B, 3, H, W]): 0..1 [B, sources,
    H, W], the pixel's own difference and that of 5 x 5 around it counting, up to half a pixel of what is displaced; and the
    largest difference [B, H, W], of 255, of what stays."""
    if frames.device.type != "cpu":
        return explained_slowly(frames, truth, moves)
    share = torch.empty(len(frames), len(moves) + frames.shape[1] - 1, *truth.shape[-2:])
    stays = torch.empty(len(frames), *truth.shape[-2:])
    views = arrays(frames, half_a_pixel(frames[:, 0]), truth, share, stays)
    each_view(explained_kernel, views, *arrays(moves), (SHARP, NEAR, NEVER))
    return share, stays


def explained_slowly(
    frames: torch.Tensor, truth: torch.Tensor, moves: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `explained`, in plain tensor algebra; the way on a GPU."""
    size = truth.shape[-2:]
    sources = torch.arange(len(moves) + frames.shape[1] - 1, device=truth.device)
    each = sources[:, None, None, None].expand(-1, len(truth), *size)
    error = [(fetched(frames, one, moves).int() - truth.int()).abs() for one in each]
    bounds = half_a_pixel_slowly(frames[:, 0]).transpose(0, 1)[:, :, None]
    for number in range(1, len(moves)):
        least, most = (fetched(bound, each[number], moves).int() for bound in bounds)
        error[number] = torch.maximum(least - truth.int(), truth.int() - most).clamp_min(0)
    error = torch.stack(error, 1).float()
    own, near = error.amax(2), F.avg_pool2d(error.mean(2), 5, 1, 2, count_include_pad=False)
    worse = near - near.amin(1, keepdim=True)
    share = torch.exp(-worse / NEAR - (own - 4).clamp_min(0) / SHARP) * (own <= NEVER) * (worse <= 8 * NEAR)
    return share, own[:, 0]


def preferred(share: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
    """What `explained` found [B, sources, H, W], where the first that explains a pixel leaves little to others: the move `along`
    [B, H, W], by which the picture scrolls there, what stays, then all the rest. Else what is of one colour would come from
    anywhere."""
    index = along[:, None]
    scrolled, stays = share.gather(1, index), share[:, :1]
    left = share * (1 - CLEAR * scrolled) * (1 - CLEAR * stays)
    left = torch.cat([stays * (1 - CLEAR * scrolled), left[:, 1:]], 1)
    return left.scatter(1, index, scrolled)


def voted(
    frames: torch.Tensor, share: torch.Tensor, painted: torch.Tensor, moves: torch.Tensor, stress: float | torch.Tensor
) -> torch.Tensor:
    """Of the colours that the sources (see `fetched`) of shares [B, sources + 1, H, W] give each pixel, and of `painted` uint8 [B,
    3, H, W], the last of them, the one that most are like (mean shift's mode, but taken whole): uint8 [B, 3, H, W]. Many sources
    of one background outvote one of a thing before it. What stays counts `stress` times."""
    if frames.device.type != "cpu":
        return voted_slowly(frames, share, painted, moves, stress)
    drawn = torch.empty(painted.shape, dtype=torch.uint8)
    each_view(voted_kernel, arrays(frames, share, painted, drawn), *arrays(moves), (SAME, FEW, EQUAL, float(stress)))
    return drawn


def voted_slowly(
    frames: torch.Tensor, share: torch.Tensor, painted: torch.Tensor, moves: torch.Tensor, stress: float | torch.Tensor
) -> torch.Tensor:
    """The same as `voted`, in plain tensor algebra; the way on a GPU."""
    size, device = share.shape[-2:], share.device
    sources = torch.arange(share.shape[1] - 1, device=device)[:, None, None, None].expand(-1, len(share), *size)
    colours = torch.stack([*(fetched(frames, one, moves) for one in sources), painted], 1).int()
    voting = torch.cat([share[:, :1], torch.where(share[:, 1:] < FEW, 0.0, share[:, 1:])], 1)
    totals = []
    for one in range(share.shape[1]):
        off = (colours - colours[:, one : one + 1]).abs().amax(2)
        total = (voting * (off <= SAME)).sum(1) * torch.where(off[:, 0] <= EQUAL, stress, 1.0)
        totals.append(torch.where(voting[:, one] > 0, total, -1.0))
    best, most = colours[:, 0], totals[0]
    for one, total in enumerate(totals[1:], 1):
        better = total > most * 1.001
        best, most = torch.where(better[:, None], colours[:, one], best), torch.where(better, total, most)
    return best.to(torch.uint8)


def explains(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The share of the edges of `after` that each of the moves brings from `before` (uint8 [B, 3, H, W]): 0..1 [B, M]. Every
    second pixel is looked at, with its neighbours above and to the left."""
    if before.device.type != "cpu":
        return explains_slowly(before, after, moves)
    found = torch.empty(len(after), len(moves))
    each_view(explains_kernel, arrays(before, after, found), *arrays(moves), SAME, TEXTURED)
    return found


def explains_slowly(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The same as `explains`, in plain tensor algebra; the way on a GPU."""
    height, width = after.shape[-2:]
    one, other = before.int(), after.int()
    steps = (other[..., 1:, 1:] - other[..., :-1, 1:]).abs(), (other[..., 1:, 1:] - other[..., 1:, :-1]).abs()
    edges = (torch.maximum(*steps).amax(1) > TEXTURED)[:, ::2, ::2].flatten(1)
    x = torch.arange(width, device=after.device) - moves[:, :1]
    y = torch.arange(height, device=after.device) - moves[:, 1:]
    there = one[:, :, y.clamp(0, height - 1)[:, :, None], x.clamp(0, width - 1)[:, None]]  # [B, 3, M, H, W]
    off = (there - other[:, :, None]).abs().amax(1)
    off = torch.maximum(torch.maximum(off[..., 1:, 1:], off[..., :-1, 1:]), off[..., 1:, :-1])[..., ::2, ::2]
    inside = ((y[:, 1::2] >= 1) & (y[:, 1::2] < height))[:, :, None] & ((x[:, 1::2] >= 1) & (x[:, 1::2] < width))[
        :, None
    ]
    same = ((off <= SAME) & inside).flatten(2) & edges[:, None]
    return same.sum(2) / edges.sum(1, keepdim=True).clamp_min(1)


def scrolled(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """By which of the moves, the first being none, most of the edges of `after` go on: int64 [B]; 0 unless another explains
    clearly more."""
    return clearest(explains(before, after, moves))


def clearest(found: torch.Tensor) -> torch.Tensor:
    """Of what `explains` found [B, M]: the move [B] that explains most, 0 unless that is clearly more than what stays."""
    most, move = found.max(1)
    return torch.where(most > 1.25 * found[:, 0] + 0.01, move, 0)
