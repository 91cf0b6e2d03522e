"""How pictures of a recording go on: the moves that blocks make most often, the colours of most pixels, and mosaics of clips."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ..core.files import write_json
from ..space.matching import fetched, half_a_pixel, scrolled
from ..space.mosaic import blank, remembered

REACH, NEAR = 24, 5  # pixels that a block may move in a step; up to NEAR, all moves are tried at the full size
BLOCK = 8  # pixels
DIFFERENT = 4.0  # mean difference (of 255) of blocks above which a block has changed
AWAY = 0.05  # by which each pixel of a move must improve the match
SAME = 8  # difference of 255 up to which a pixel is the same
FEWEST = 32  # pairs that scroll, which tell what lies over the rest
LOOKS = "looks.json"  # of a run


@dataclass(frozen=True)
class Looks:
    """What a run finds once in its recording: moves int64 [n, 2], palette uint8 [n, 3], stress, how many times as much pixels
    count that change; over bool [H, W], what stays while the picture scrolls (see overlay)."""

    moves: torch.Tensor
    palette: torch.Tensor
    stress: float
    over: torch.Tensor

    @staticmethod
    def read(run: Path, recipe: Mapping) -> Looks | None:
        """What the folder of a run of this recipe keeps; None where it keeps nothing sound: then the same is found again."""
        try:
            found = json.loads((run / LOOKS).read_text(encoding="utf-8"))
            moves = torch.tensor(found["moves"], dtype=torch.int64).view(-1, 2)
            colours = torch.tensor(found["palette"], dtype=torch.int64).view(-1, 3)
            stress, same = float(found["stress"]), found["recipe"] == json.loads(json.dumps(recipe))
            over = torch.tensor([[{".": False, "#": True}[pixel] for pixel in row] for row in found["over"]])
        except (OSError, ValueError, LookupError, TypeError, RuntimeError):
            return None
        sound = same and (moves.abs() <= REACH).all() and ((colours >= 0) & (colours < 256)).all() and len(colours)
        sound = sound and 0 < stress < float("inf") and over.ndim == 2
        return Looks(moves, colours.to(torch.uint8), stress, over) if sound else None

    def write(self, run: Path, recipe: Mapping) -> None:
        run.mkdir(parents=True, exist_ok=True)
        found = {"moves": self.moves.tolist(), "palette": self.palette.tolist(), "stress": self.stress}
        found["over"] = ["".join(".#"[pixel] for pixel in row) for row in self.over.int().tolist()]
        write_json(run / LOOKS, {"recipe": dict(recipe), **found})


def frequent_moves(before: torch.Tensor, after: torch.Tensor, most: int) -> torch.Tensor:
    """The `most` displacements that explain most blocks which change from `before` to `after` (uint8 [N, 3, H, W]), the
    commonest first: int64 [n, 2] = x, y in pixels. Found by block matching, as video codecs do, far ones at half the size first."""
    one, other = before.float(), after.float()
    halves = F.avg_pool2d(one, 2), F.avg_pool2d(other, 2)
    far = _commonest(*halves, _within(REACH // 2), most, BLOCK // 2)
    tried = {(2 * x + i, 2 * y + j) for x, y in far for i, j in _within(1)} | set(_within(NEAR))
    tried = sorted(move for move in tried if max(map(abs, move)) <= REACH)
    moves = _commonest(one, other, tried, most, BLOCK)
    return torch.tensor(moves, dtype=torch.int64).view(-1, 2)


def _within(reach: int) -> list[tuple[int, int]]:
    """All moves of up to so many pixels each way."""
    return [(x, y) for y in range(-reach, reach + 1) for x in range(-reach, reach + 1)]


def _commonest(
    one: torch.Tensor, other: torch.Tensor, tried: list[tuple[int, int]], most: int, block: int
) -> list[tuple[int, int]]:
    """Of the moves `tried` those that explain most blocks which change."""
    moves = [(0, 0), *(move for move in tried if move != (0, 0))]
    still = _block_errors(one, other, block)
    best, found = still.clone(), torch.zeros_like(still, dtype=torch.int64)
    for number, (x, y) in enumerate(moves[1:], 1):
        error = _block_errors(_shifted(one, x, y), other, block) + AWAY * (abs(x) + abs(y))
        better = error < best
        best, found = torch.where(better, error, best), torch.where(better, number, found)
    good = (still > DIFFERENT) & (best < 0.5 * still)
    counts = torch.bincount(found[good], minlength=len(moves))
    order = counts.argsort(descending=True, stable=True)[:most].tolist()
    return [moves[number] for number in order if counts[number] > 1]


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


def overlay(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The pixels bool [H, W] that stay while the picture scrolls from `before` to `after` (uint8 [N, 3, H, W]): a status line, the
    walker in the middle. They stay where they would not have gone along more often than the reverse, with those around them; holes
    are filled."""
    scroll = scrolled(before, after, moves)
    scrolls = scroll > 0
    if scrolls.sum() < FEWEST:
        return torch.zeros(before.shape[-2:], dtype=torch.bool)
    lies = goes_along = torch.zeros(before.shape[-2:])
    for part in scrolls.nonzero().flatten().split(256):
        stays, goes = _ways(before[part], after[part], moves, scroll[part])
        lies, goes_along = lies + (stays & ~goes).sum(0), goes_along + (goes & ~stays).sum(0)
    lies, goes_along = lies / scrolls.sum(), goes_along / scrolls.sum()
    found = lies + _around(lies) > 2 * (goes_along + _around(goes_along)) + 0.02
    return found | (_around(found.float()) > 0.5)


def _ways(
    before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor, scroll: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which pixels of `after` stayed, and which went along with the `scroll` [N]: bool [N, H, W] each."""
    along = scroll[:, None, None].expand(-1, *before.shape[-2:])
    least, most = (fetched(bound[:, None], along, moves).int() for bound in half_a_pixel(before).unbind(1))
    goes = torch.maximum(least - after.int(), after.int() - most).amax(1) <= SAME
    return (before.int() - after.int()).abs().amax(1) <= SAME, goes


def mosaics(frames: torch.Tensor, moves: torch.Tensor, over: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """Mosaics [B, 4, H', W'] of frames uint8 [B, T, 3, H, W], the oldest first, those that are `real` bool [B, T] alone, without
    the pixels `over` [H, W]."""
    mosaic = blank(len(frames), (frames.shape[-2], frames.shape[-1]), frames.device)
    for step in range(frames.shape[1]):
        before, now = frames[:, max(step - 1, 0)], frames[:, step]
        joined = remembered(mosaic, now, moves[scrolled(before, now, moves)], over)
        mosaic = torch.where(real[:, step, None, None, None], joined, mosaic)
    return mosaic


def _around(plane: torch.Tensor) -> torch.Tensor:
    """Means of the 5 x 5 pixels around each of a plane [H, W], as far as they lie in it."""
    return F.avg_pool2d(plane[None], 5, 1, 2, count_include_pad=False)[0]


def _shifted(pictures: torch.Tensor, x: int, y: int) -> torch.Tensor:
    height, width = pictures.shape[-2:]
    rows, columns = (torch.arange(height) - y).clamp(0, height - 1), (torch.arange(width) - x).clamp(0, width - 1)
    return pictures[..., rows, :][..., columns]


def _block_errors(one: torch.Tensor, other: torch.Tensor, block: int) -> torch.Tensor:
    return F.avg_pool2d((one - other).abs().mean(1), block)
