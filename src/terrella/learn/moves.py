"""How the pictures of a recording scroll: by which moves, what does not, and what was scrolled over."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ..core.files import write_json
from ..space.ground import cropped, window
from ..space.matching import scroll_index
from ..space.mosaic import empty_mosaic, middle, update_mosaic
from ..worlds.flow import carry
from .recording import Recording

REACH, NEAR = 24, 5  # pixels of the longest move in a step, and those up to which all moves are tried at full size
BLOCK = 8  # pixels
DIFFERENT = 4.0  # mean difference (of 255) above which a block has changed
MOVE_COST = 0.05  # by which each pixel of a move must reduce the error
SAME = 8  # difference of 255 up to which a pixel is unchanged
GROUND = 9  # height and width of the canvas on which an episode's pictures are stitched, in pictures
STITCHED = 20_000  # frames at most
FEWEST = 32  # scrolling pairs needed to find the overlay
MOVES = 24  # of blocks, by which pictures may scroll
SCROLLS, HALF = 0.01, 0.5  # see `Scrolling.of`
PAIRS = 2000  # of successive pictures, in which scrolls are looked for
STATISTICS = "looks.json"  # in the folder of a run


@dataclass(frozen=True)
class Scrolling:
    """What a run computes once: moves int64 [n, 2] by which whole pictures scroll, (0, 0) first, and over bool [H, W], what does
    not scroll (see overlay)."""

    moves: torch.Tensor
    over: torch.Tensor

    @staticmethod
    def of(recording: Recording, seed: int, pixels: int) -> Scrolling:
        """Of a recording, whose moves of blocks are searched in `pixels` of pairs that change. Whole pictures scroll by those moves
        that lead from SCROLLS of the pictures or more to the next, and after which at most HALF as many pixels differ: a paddle
        that moves does not scroll the picture."""
        rng = np.random.default_rng(seed)
        rows = recording.rows_within(1, 0)
        rows = np.sort(rng.choice(rows, min(len(rows), PAIRS), replace=False))
        before, after = recording.rgb(rows - 1), recording.rgb(rows)
        still = changed_pixels(before, after).mean((1, 2))
        change = still.numpy() + 1e-4
        most = max(32, pixels // before[0, 0].numel())  # pairs: each is matched at 625 displacements
        some = rng.choice(len(rows), min(len(rows), most), replace=False, p=change / change.sum())
        moves = F.pad(frequent_moves(before[some], after[some], MOVES), (0, 0, 1, 0))
        while True:  # until each holds for the pictures that the kept ones are chosen for
            index, over, kept = scroll_index(before, after, moves), overlay(before, after, moves), [0]
            for number in range(1, len(moves)):
                at = (index == number).nonzero().flatten()
                if len(at) >= SCROLLS * len(rows):
                    carried = [carry(before[part], index[part], moves, over) for part in at.split(256)]
                    if changed_pixels(torch.cat(carried), after[at]).mean() <= HALF * still[at].mean():
                        kept.append(number)
            if len(kept) == len(moves):
                return Scrolling(moves, over & (len(moves) > 1))
            moves = moves[kept]

    @staticmethod
    def read(run: Path, recipe: Mapping) -> Scrolling | None:
        """Those in the folder of a run of this recipe; None if there are none, or they are damaged: then they are computed
        again."""
        try:
            saved = json.loads((run / STATISTICS).read_text(encoding="utf-8"))
            moves = torch.tensor(saved["moves"], dtype=torch.int64).view(-1, 2)
            same = saved["recipe"] == json.loads(json.dumps(recipe))
            over = torch.tensor([[{".": False, "#": True}[pixel] for pixel in row] for row in saved["over"]])
        except (OSError, ValueError, LookupError, TypeError, RuntimeError):
            return None
        valid = same and len(moves) and not moves[0].any() and (moves.abs() <= REACH).all() and over.ndim == 2
        return Scrolling(moves, over) if valid else None

    def write(self, run: Path, recipe: Mapping) -> None:
        run.mkdir(parents=True, exist_ok=True)
        over = ["".join(".#"[pixel] for pixel in row) for row in self.over.int().tolist()]
        write_json(run / STATISTICS, {"recipe": dict(recipe), "moves": self.moves.tolist(), "over": over})


def frequent_moves(before: torch.Tensor, after: torch.Tensor, most: int) -> torch.Tensor:
    """The `most` displacements that explain most of the blocks that change from `before` to `after` (uint8 [N, 3, H, W]), the
    commonest first: int64 [n, 2] = x, y in pixels. By block matching, as in video codecs; long moves at half the size first."""
    one, other = before.float(), after.float()
    halves = F.avg_pool2d(one, 2), F.avg_pool2d(other, 2)
    far = _commonest(*halves, _within(REACH // 2), most, BLOCK // 2)
    tried = {(2 * x + i, 2 * y + j) for x, y in far for i, j in _within(1)} | set(_within(NEAR))
    tried = sorted(move for move in tried if max(map(abs, move)) <= REACH)
    moves = _commonest(one, other, tried, most, BLOCK)
    return torch.tensor(moves, dtype=torch.int64).view(-1, 2)


def _within(reach: int) -> list[tuple[int, int]]:
    """All moves of at most `reach` pixels each way."""
    return [(x, y) for y in range(-reach, reach + 1) for x in range(-reach, reach + 1)]


def _commonest(
    one: torch.Tensor, other: torch.Tensor, tried: list[tuple[int, int]], most: int, block: int
) -> list[tuple[int, int]]:
    """Those of the moves `tried` that explain most of the blocks that change."""
    moves = [(0, 0), *(move for move in tried if move != (0, 0))]
    still = _block_errors(one, other, block)
    best, best_move = still.clone(), torch.zeros_like(still, dtype=torch.int64)
    for number, (x, y) in enumerate(moves[1:], 1):
        error = _block_errors(_shifted(one, x, y), other, block) + MOVE_COST * (abs(x) + abs(y))
        better = error < best
        best, best_move = torch.where(better, error, best), torch.where(better, number, best_move)
    good = (still > DIFFERENT) & (best < 0.5 * still)
    counts = torch.bincount(best_move[good], minlength=len(moves))
    order = counts.argsort(descending=True, stable=True)[:most].tolist()
    return [moves[number] for number in order if counts[number] > 1]


def overlay(before: torch.Tensor, after: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The pixels bool [H, W] that stay while the picture scrolls from `before` to `after` (uint8 [N, 3, H, W]), such as a status
    line or a player in the middle: those which, with their neighbourhood, are better explained by staying than by scrolling more
    often than the reverse. Holes are filled."""
    scroll = scroll_index(before, after, moves)
    scrolls = (scroll > 0).nonzero().flatten()
    none = torch.zeros(before.shape[-2:], dtype=torch.bool)
    if len(scrolls) < FEWEST:
        return none
    stayed = scrolled_along = none.float()
    for part in scrolls.split(256):
        one, other = before[part], after[part].int()
        least, most = (carry(bound, scroll[part], moves, none) for bound in half_pixel_bounds(one))
        goes = torch.maximum(least - other, other - most).amax(1) <= SAME
        stays = changed_pixels(one, other) == 0
        stayed, scrolled_along = stayed + (stays & ~goes).sum(0), scrolled_along + (goes & ~stays).sum(0)
    stayed, scrolled_along = stayed / len(scrolls), scrolled_along / len(scrolls)
    over = stayed + _around(stayed) > 2 * (scrolled_along + _around(scrolled_along)) + 0.02
    return over | (_around(over.float()) > 0.5)


def changed_pixels(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """1 where pictures uint8 [B, 3, H, W] differ by more than SAME, else 0: float [B, H, W]."""
    return ((before.int() - after.int()).abs().amax(1) > SAME).float()


def half_pixel_bounds(frame: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The minimum and the maximum colour int16 [B, 3, H, W] of each pixel of uint8 [B, 3, H, W] when the picture is displaced by up
    to half a pixel: pictures scroll by fractions of pixels, but moves are whole."""
    return _half_pixel_bound(frame, torch.minimum), _half_pixel_bound(frame, torch.maximum)


def _half_pixel_bound(frame: torch.Tensor, least: Callable[..., torch.Tensor]) -> torch.Tensor:
    bound = frame.to(torch.int16) * 16
    for x, y in ((0, 1), (1, 0)):
        near = least(_shifted(bound, x, y), _shifted(bound, -x, -y))
        bound = least(bound, (bound + near) // 2)
    return bound // 16


def mosaics(frames: torch.Tensor, moves: torch.Tensor, over: torch.Tensor, real: torch.Tensor) -> torch.Tensor:
    """Mosaics [B, 4, H', W'] of frames uint8 [B, T, 3, H, W], the oldest first; only of frames that are `real` bool [B, T], and
    without the pixels `over` [H, W]."""
    mosaic = empty_mosaic(len(frames), (frames.shape[-2], frames.shape[-1]), frames.device)
    for step in range(frames.shape[1]):
        before, now = frames[:, max(step - 1, 0)], frames[:, step]
        joined = update_mosaic(mosaic, now, moves[scroll_index(before, now, moves)], over)
        mosaic = torch.where(real[:, step, None, None, None], joined, mosaic)
    return mosaic


@dataclass(frozen=True)
class StitchedEpisodes:
    """What the episodes of a recording scrolled over: `grounds` uint8 [4, H', W'], by episode, and the `place` int64 [N, 2], x and
    y, of each row's picture on the ground of its `episode` int64 [N]; -1 where an episode is not stitched."""

    grounds: Mapping[int, torch.Tensor]
    place: torch.Tensor
    episode: torch.Tensor

    def memory(self, rows: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
        """What their grounds know of the pictures of `rows` int64 [B]: uint8 [B, 4, H, W], colour and votes."""
        known = torch.zeros(len(rows), 4, *size, dtype=torch.uint8)
        for number, row in enumerate(rows.tolist()):
            ground = self.grounds.get(int(self.episode[row]))
            if ground is not None:
                known[number] = window(ground, self.place[row : row + 1], size)[0]
        return known


def stitch_episodes(recording: Recording, moves: torch.Tensor, over: torch.Tensor) -> StitchedEpisodes:
    """The pictures of the episodes for training, stitched by how they scroll."""
    length, left = recording.cache.length, STITCHED
    place, number = torch.zeros(length, 2, dtype=torch.int64), torch.full((length,), -1)
    grounds = {}
    for episode in recording.seen:
        first, last = recording.cache.episodes[episode]
        last, whole, before = min(last, first + left), None, recording.rgb([first])
        left -= last - first
        for row in range(first, last):
            frame = recording.rgb([row])
            if whole is None:
                whole = torch.zeros(1, 4, *(GROUND * side for side in frame.shape[-2:]), dtype=torch.uint8)
            move = moves[scroll_index(before, frame, moves)]
            whole = update_mosaic(whole, frame, move, over)
            place[row], number[row] = place[max(row - 1, first)] - move[0], episode
            before = frame
        if whole is not None:  # the last picture lies in the middle
            centre = torch.tensor(middle(whole, before.shape[-2:])[::-1])
            y, x = (torch.nonzero((whole[0, 3] > 0).any(dim))[:1].sum() for dim in (1, 0))  # of the upper left corner
            place[first:last] += centre - place[last - 1] - torch.stack([x, y])
            grounds[episode] = cropped(whole[0])
    return StitchedEpisodes(grounds, place, number)


def _around(plane: torch.Tensor) -> torch.Tensor:
    """Means of the 5 x 5 pixels around each pixel of a plane [H, W], as far as they lie within it."""
    return F.avg_pool2d(plane[None], 5, 1, 2, count_include_pad=False)[0]


def _shifted(pictures: torch.Tensor, x: int, y: int) -> torch.Tensor:
    height, width = pictures.shape[-2:]
    rows, columns = (torch.arange(height) - y).clamp(0, height - 1), (torch.arange(width) - x).clamp(0, width - 1)
    return pictures[..., rows, :][..., columns]


def _block_errors(one: torch.Tensor, other: torch.Tensor, block: int) -> torch.Tensor:
    return F.avg_pool2d((one - other).abs().mean(1), block)
