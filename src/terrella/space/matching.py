"""Motion between consecutive pictures by displacements ("moves", x and y in whole pixels): of pixels, and of the whole picture."""

import torch
import torch.nn.functional as F

from ..core.backend import kernels_do
from .kernels_numba.matching import edge_shares as edge_shares_kernel
from .kernels_numba.matching import half_pixel_bounds as half_pixel_bounds_kernel
from .kernels_numba.matching import majority_colours as majority_colours_kernel
from .kernels_numba.matching import source_shares as source_shares_kernel
from .views import arrays, each_view

# Differences (of 255) that scale a source's share by 1/e: of the pixel, of its surroundings. Beyond NEVER the share is 0.
SHARP, NEAR, NEVER = 10.0, 3.0, 60.0
CLEAR = 0.97  # how much of a source's share is taken from the sources behind it
FEW, EQUAL = (
    0.01,
    4,
)  # the smallest share that votes; the largest difference (of 255) from the unchanged pixel that counts as equal
SAME, TEXTURED = 16, 12  # differences of 255: of one pixel in two pictures, and of neighbours in one


def gather_sources(frames: torch.Tensor, source: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The pixels of `frames` (uint8 [B, slots, 3, H, W]) that the sources [B, H, W] name: uint8 [B, 3, H, W]. The first M sources
    are the newest frame displaced by `moves` int64 [M, 2], the others the older frames. Edge pixels are replicated."""
    height, width = frames.shape[-2:]
    slot = (source - len(moves) + 1).clamp_min(0)
    move = torch.where(slot > 0, 0, source)
    x = (torch.arange(width, device=source.device) - moves[:, 0][move]).clamp(0, width - 1)
    y = (torch.arange(height, device=source.device)[:, None] - moves[:, 1][move]).clamp(0, height - 1)
    place = ((slot * height + y) * width + x).flatten(1)
    flat = frames.transpose(1, 2).flatten(2)
    return flat.gather(2, place[:, None].expand(-1, 3, -1)).unflatten(2, (height, width))


def half_pixel_bounds(frame: torch.Tensor) -> torch.Tensor:
    """The minimum and maximum colour of each pixel of uint8 [B, 3, H, W] when the picture is displaced by up to half a pixel:
    uint8 [B, 2, 3, H, W]. Pictures scroll by fractions of pixels, but sources are displaced by whole pixels."""
    if not kernels_do(frame):
        return half_pixel_bounds_slowly(frame)
    bounds = torch.empty(len(frame), 2, *frame.shape[1:], dtype=torch.uint8)
    each_view(half_pixel_bounds_kernel, arrays(frame, bounds))
    return bounds


def half_pixel_bounds_slowly(frame: torch.Tensor) -> torch.Tensor:
    """The same as `half_pixel_bounds`, in plain tensor algebra, also for GPUs."""
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


def source_shares(frames: torch.Tensor, truth: torch.Tensor, moves: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How well each source (see `gather_sources`) explains each pixel of the next frames `truth` (uint8 [B, 3, H, W]): shares in
    0..1 [B, sources, H, W], from the 5 x 5 pixels around it, displaced with a tolerance of half a pixel; and the largest
    difference (of 255) from the unchanged pixel [B, H, W]."""
    if not kernels_do(frames):
        return source_shares_slowly(frames, truth, moves)
    share = torch.empty(len(frames), len(moves) + frames.shape[1] - 1, *truth.shape[-2:])
    stays = torch.empty(len(frames), *truth.shape[-2:])
    views = arrays(frames, half_pixel_bounds(frames[:, 0]), truth, share, stays)
    each_view(source_shares_kernel, views, *arrays(moves), (SHARP, NEAR, NEVER))
    return share, stays


def source_shares_slowly(
    frames: torch.Tensor, truth: torch.Tensor, moves: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `source_shares`, in plain tensor algebra, also for GPUs."""
    size = truth.shape[-2:]
    sources = torch.arange(len(moves) + frames.shape[1] - 1, device=truth.device)
    each = sources[:, None, None, None].expand(-1, len(truth), *size)
    error = [(gather_sources(frames, one, moves).int() - truth.int()).abs() for one in each]
    bounds = half_pixel_bounds_slowly(frames[:, 0]).transpose(0, 1)[:, :, None]
    for number in range(1, len(moves)):
        least, most = (gather_sources(bound, each[number], moves).int() for bound in bounds)
        error[number] = torch.maximum(least - truth.int(), truth.int() - most).clamp_min(0)
    error = torch.stack(error, 1).float()
    own, near = error.amax(2), F.avg_pool2d(error.mean(2), 5, 1, 2, count_include_pad=False)
    worse = near - near.amin(1, keepdim=True)
    share = torch.exp(-worse / NEAR - (own - 4).clamp_min(0) / SHARP) * (own <= NEVER) * (worse <= 8 * NEAR)
    return share, own[:, 0]


def prefer_scroll(share: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
    """The result of `source_shares` [B, sources, H, W], reduced by what preferred sources explain: first the move `along` [B, H,
    W] by which the picture scrolls there, then the unchanged pixel. Otherwise every source would explain a plain surface."""
    index = along[:, None]
    scroll_index, stays = share.gather(1, index), share[:, :1]
    left = share * (1 - CLEAR * scroll_index) * (1 - CLEAR * stays)
    left = torch.cat([stays * (1 - CLEAR * scroll_index), left[:, 1:]], 1)
    return left.scatter(1, index, scroll_index)


def majority_colours(
    frames: torch.Tensor, share: torch.Tensor, painted: torch.Tensor, moves: torch.Tensor, stress: float | torch.Tensor
) -> torch.Tensor:
    """The colour of each pixel that most votes support, uint8 [B, 3, H, W]: mean shift's mode, but one of the given colours, those
    of sources (see `gather_sources`) with shares [B, sources + 1, H, W] and, last, of `painted` uint8 [B, 3, H, W]. Sources of one
    background outvote one of an object before it. The unchanged pixel counts `stress` times."""
    if not kernels_do(frames):
        return majority_colours_slowly(frames, share, painted, moves, stress)
    drawn = torch.empty(painted.shape, dtype=torch.uint8)
    each_view(
        majority_colours_kernel,
        arrays(frames, share, painted, drawn),
        *arrays(moves),
        (SAME, FEW, EQUAL, float(stress)),
    )
    return drawn


def majority_colours_slowly(
    frames: torch.Tensor, share: torch.Tensor, painted: torch.Tensor, moves: torch.Tensor, stress: float | torch.Tensor
) -> torch.Tensor:
    """The same as `majority_colours`, in plain tensor algebra, also for GPUs."""
    size, device = share.shape[-2:], share.device
    sources = torch.arange(share.shape[1] - 1, device=device)[:, None, None, None].expand(-1, len(share), *size)
    colours = torch.stack([*(gather_sources(frames, one, moves) for one in sources), painted], 1).int()
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
    steps = (other[..., 1:, 1:] - other[..., :-1, 1:]).abs(), (other[..., 1:, 1:] - other[..., 1:, :-1]).abs()
    edges = (torch.maximum(*steps).amax(1) > TEXTURED)[:, ::2, ::2].flatten(1)
    x = torch.arange(width, device=after.device) - moves[:, :1]
    y = torch.arange(height, device=after.device) - moves[:, 1:]
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
