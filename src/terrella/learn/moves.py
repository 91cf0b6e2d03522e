"""How pictures of a recording go on: the moves that blocks make most often, the colours of most pixels, and which sources of a
Codec explain a frame."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from ..worlds.codec import Codec
from .kernels_numba import explained as explained_kernel

REACH = 12  # pixels that a block may move in a step
BLOCK = 8  # pixels
DIFFERENT = 4.0  # mean difference (of 255) of blocks above which a block has changed
AWAY = 0.05  # by which each pixel of a move must improve the match
SHARP, NEAR, NEVER = (
    10.0,
    3.0,
    60.0,
)  # differences (of 255): of a pixel, and around it, to which a source explains less by e


def frequent_moves(before: torch.Tensor, after: torch.Tensor, most: int) -> torch.Tensor:
    """The `most` displacements that explain most blocks which change from `before` to `after` (uint8 [N, 3, H, W]), the
    commonest first: int64 [n, 2] = x, y in pixels. Found by block matching, as video codecs do."""
    one, other = before.float(), after.float()
    still = _block_errors(one, other)
    best, found = still.clone(), torch.zeros_like(still, dtype=torch.int64)
    reach = range(-REACH, REACH + 1)
    moves = [(0, 0), *((x, y) for y in reach for x in reach if (x, y) != (0, 0))]
    for number, (x, y) in enumerate(moves[1:], 1):
        error = _block_errors(_shifted(one, x, y), other) + AWAY * (abs(x) + abs(y))
        better = error < best
        best, found = torch.where(better, error, best), torch.where(better, number, found)
    good = (still > DIFFERENT) & (best < 0.5 * still)
    counts = torch.bincount(found[good], minlength=len(moves))
    commonest = [
        number for number in counts.argsort(descending=True, stable=True)[:most].tolist() if counts[number] > 1
    ]
    return torch.tensor([moves[number] for number in commonest], dtype=torch.int64).view(-1, 2)


def palette(frames: torch.Tensor, colours: int, rng: np.random.Generator) -> torch.Tensor:
    """At most so many colours that lie near those of most pixels of `frames` (uint8 [N, 3, H, W]), by k-means: uint8 [n, 3]."""
    pixels = frames.permute(0, 2, 3, 1).reshape(-1, 3)
    pixels = pixels[torch.from_numpy(rng.integers(0, len(pixels), 60_000))]
    shades, counts = torch.unique(pixels // 4, dim=0, return_counts=True)
    shades, weight = shades.float() * 4 + 2, counts.float().sqrt()
    often = weight.double().numpy()
    first = rng.choice(len(shades), min(colours, len(shades)), replace=False, p=often / often.sum())
    centres = shades[torch.from_numpy(first)]
    for _ in range(12):
        nearest = torch.cdist(shades, centres).argmin(1)
        sums = torch.zeros_like(centres).index_add_(0, nearest, shades * weight[:, None])
        whole = torch.zeros(len(centres)).index_add_(0, nearest, weight)[:, None]
        centres = torch.where(whole > 0, sums / whole.clamp_min(1e-9), centres)
    return centres.round().clamp(0, 255).to(torch.uint8)


def explained(codec: Codec, frames: torch.Tensor, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How well each source of `codec` explains each pixel of the next frames `truth` (uint8 [B, 3, H, W]) by `frames` (uint8 [B,
    slots, 3, H, W]): 0..1 [B, sources, H, W], the pixel's own difference and that of 5 x 5 around it counting; and the largest
    difference [B, H, W], of 255, of what stays. Where that is exact, other sources count for half."""
    if frames.device.type != "cpu":
        return explained_slowly(codec, frames, truth)
    share = torch.empty(len(frames), codec.sources, *truth.shape[-2:])
    stays = torch.empty(len(frames), *truth.shape[-2:])
    given = frames.contiguous().numpy(), truth.contiguous().numpy(), codec.moves.numpy()
    explained_kernel(*given, (SHARP, NEAR, NEVER), share.numpy(), stays.numpy())
    return share, stays


def explained_slowly(codec: Codec, frames: torch.Tensor, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `explained`, in plain tensor algebra; the way on a GPU."""
    size = truth.shape[-2:]
    sources = torch.arange(codec.sources, device=truth.device)[:, None, None, None].expand(-1, len(truth), *size)
    error = torch.stack([(codec.pixels(frames, one).int() - truth.int()).abs() for one in sources], 1).float()
    own, around = error.amax(2), F.avg_pool2d(error.mean(2), 5, 1, 2, count_include_pad=False)
    worse = around - around.amin(1, keepdim=True)
    share = torch.exp(-worse / NEAR - (own - 4).clamp_min(0) / SHARP) * (own <= NEVER)
    halved = torch.where(own[:, :1] == 0, 0.5, 1.0).expand(-1, codec.sources - 1, -1, -1)
    return share * torch.cat([torch.ones_like(own[:, :1]), halved], 1), own[:, 0]


def scrolled(codec: Codec, share: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """By which of the codec's moves most of what is not of one colour in `truth` goes on: int64 [B]; 0 unless another explains
    clearly more. share: of `explained`."""
    smooth = F.avg_pool2d(truth.float(), 5, 1, 2, count_include_pad=False)
    textured = (truth.float() - smooth).abs().mean(1) > 3
    explains = ((share[:, : len(codec.moves)] > 0.3) & textured[:, None]).float().mean((2, 3))
    most, move = explains.max(1)
    return torch.where(most > 1.25 * explains[:, 0] + 0.01, move, 0)


def _shifted(pictures: torch.Tensor, x: int, y: int) -> torch.Tensor:
    height, width = pictures.shape[-2:]
    rows, columns = (torch.arange(height) - y).clamp(0, height - 1), (torch.arange(width) - x).clamp(0, width - 1)
    return pictures[..., rows, :][..., columns]


def _block_errors(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return F.avg_pool2d((one - other).abs().mean(1), BLOCK)
