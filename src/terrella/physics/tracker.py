"""Tracker: things in pictures, by their difference from the background, followed from frame to frame.

A thing is a connected area of one colour. Its place is the mean of its pixels, weighted by how much of a pixel it covers, which is
exact to a few hundredths of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..core.errors import TerrellaError

DIFFERENCE = 32.0  # of 255, from the background: the least that counts
COLOURS, NEAR, SHARE = 6, 48.0, 0.02  # at most; colours nearer than this are one; the least share of all peaks
THINGS = 12  # in one picture, at most: the largest
RING = 2  # pixels around a thing that it may cover in part
SMALL = 0.3  # of the smallest thing of the recording: below it, an area is noise
REACH = 0.25  # of the picture's width: farther off is another thing
CHUNK = 512  # pictures at once


@dataclass(frozen=True)
class Tracks:
    """N things of B rollouts of T + 1 pictures."""

    place: Tensor  # [T + 1, B, N, 2], pixels to the right and down from the picture's corner
    area: Tensor  # [T + 1, B, N], pixels
    present: Tensor  # bool [T + 1, B, N]
    cut: Tensor  # bool [T + 1, B, N]: the thing reaches the picture's edge, so its place is not to be trusted
    others: Tensor  # int64 [T + 1, B]: things that were not there in the first picture


@dataclass(frozen=True)
class Followed:
    """N things of B pictures, as far as they were followed."""

    place: Tensor  # [B, N, 2], pixels
    speed: Tensor  # [B, N, 2], pixels a step
    area: Tensor  # [B, N], pixels
    usual: Tensor  # [B, N], the area of late
    colour: Tensor  # [B, N], number of the colour
    here: Tensor  # bool [B, N]
    cut: Tensor  # bool [B, N]
    others: Tensor  # int64 [B]

    def step(self, areas: Tensor, reach: float) -> Followed:
        """One picture on, whose areas are [B, M, 5]. reach: pixels that a thing may go beyond its speed."""
        place, area, here, cut, others = _matched(
            self.place + self.speed, self.usual, self.colour, self.here, areas, reach
        )
        speed = torch.where(here[..., None], place - self.place, self.speed)
        usual = torch.where(here, 0.7 * self.usual + 0.3 * area, self.usual)
        return Followed(place, speed, area, usual, self.colour, here, cut, others)


@dataclass(frozen=True)
class Tracker:
    """Finds and follows the things that differ from a background."""

    background: Tensor  # float32 [H, W, 3], 0 to 255
    colours: Tensor  # float32 [K, 3], of pixels that a thing covers
    smallest: float  # area of a thing, pixels

    def follow(self, pictures: Tensor) -> Tracks:
        """Tracks of uint8 [T + 1, B, H, W, 3]: of the things in the first picture of each rollout."""
        steps, batch = pictures.shape[:2]
        areas = self.areas(pictures.flatten(0, 1)).unflatten(0, (steps, batch))
        rows = [begin(areas[0])]
        for row in areas[1:]:
            rows.append(rows[-1].step(row, REACH * pictures.shape[3]))
        every = [
            torch.stack(part) for part in zip(*((row.place, row.area, row.here, row.cut, row.others) for row in rows))
        ]
        return Tracks(*every)

    def areas(self, pictures: Tensor) -> Tensor:
        """The largest things of each picture [F, THINGS, 5]: size in pixels, x, y, colour, whether it reaches the edge; 0 where
        there are fewer, or where they are too small."""
        areas = torch.cat([self._areas(part) for part in pictures.split(CHUNK)])
        return torch.where(areas[..., :1] > SMALL * self.smallest, areas, 0.0)

    def cover(self, values: Tensor, behind: Tensor) -> tuple[Tensor, Tensor]:
        """(how much of each pixel [P, K] a thing of each colour would cover, 0 to 1; the error that leaves, of 255).
        values, behind: float [P, 3], the pixels and their background."""
        way = self.colours - behind[:, None]
        length, apart = way.square().sum(-1), (values - behind)[:, None]
        share = ((apart * way).sum(-1) / length.clamp_min(1.0)).clamp(0, 1)
        error = (apart - share[..., None] * way).norm(dim=-1)
        blind = length < DIFFERENCE**2  # where a thing looks like the background
        return share.masked_fill(blind, 0.0), error.masked_fill(blind, 1e6)

    def _areas(self, pictures: Tensor) -> Tensor:
        frames, height, width = pictures.shape[:3]
        (frame, y, x), label, weight, colour = self._labels(pictures)
        held = label >= 0
        y, x, weight, label = y[held], x[held], weight[held], label[held]
        unique, which = label.unique(return_inverse=True)
        edge = (x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)
        parts = torch.stack([weight, weight * (x + 0.5), weight * (y + 0.5), (edge & (weight > 0.25)).double()], 1)
        sums = torch.zeros(len(unique), 4, dtype=torch.float64).index_add_(0, which, parts)
        size = sums[:, 0].clamp_min(1e-9)
        mean = sums[:, 1:3] / size[:, None]
        rows = torch.cat([sums[:, :1], mean, colour[unique][:, None].double(), sums[:, 3:].clamp_max(1)], 1)
        owner = frame[unique]
        order = (owner.double() * 1e7 - sums[:, 0]).argsort()
        rows, owner = rows[order], owner[order]
        rank = torch.arange(len(owner)) - torch.searchsorted(owner, torch.arange(frames))[owner]
        kept = torch.zeros(frames, THINGS, 5, dtype=torch.float64)
        kept[owner[rank < THINGS], rank[rank < THINGS]] = rows[rank < THINGS]
        return kept

    def _labels(self, pictures: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor, Tensor, Tensor]:
        """P pixels that may show things: (frame, y, x) of each; the connected area of one colour to which it belongs, with a ring
        around it, as the number of one of its pixels, -1 for none; its cover; the colour of the pixel of each number. Pixels at
        which two areas meet come twice, once for each."""
        differs = (pictures.short() - self.background.short()).abs().amax(-1) > DIFFERENCE
        near = F.max_pool2d(differs[:, None].float(), 2 * RING + 1, 1, RING)[:, 0] > 0
        frame, y, x = near.nonzero(as_tuple=True)
        count = len(frame)
        share, error = self.cover(pictures[frame, y, x].float(), self.background[y, x])
        colour = error.argmin(1)
        core = differs[near] & (share.gather(1, colour[:, None])[:, 0] > 0.5)
        table = torch.full((len(pictures), pictures.shape[1] + 2, pictures.shape[2] + 2), count)
        table[frame, y + 1, x + 1] = torch.arange(count)
        beside = torch.stack([table[frame, y + dy, x + dx] for dy in range(3) for dx in range(3)], 1)
        none = torch.tensor([-1])
        kinds = torch.cat([torch.where(core, colour, -1), none])
        alike = (kinds[beside] == colour[:, None]) & core[:, None]
        label = torch.where(core, torch.arange(count), -1)
        while True:  # each area takes its largest number
            grown = torch.where(alike, torch.cat([label, none])[beside], -1).amax(1)
            grown = torch.where(core, grown[grown.clamp_min(0)], -1)
            if torch.equal(grown, label):
                break
            label = grown
        touched = torch.cat([label, none])[beside]
        for _ in range(RING):
            label = torch.where(label < 0, torch.cat([label, none])[beside].amax(1), label)
        other = touched.masked_fill(touched == label[:, None], -1).amax(1)
        weight = share.gather(1, colour[label.clamp_min(0)][:, None])[:, 0]
        both = ((other >= 0) & (colour[other.clamp_min(0)] != colour[label.clamp_min(0)])).nonzero()[:, 0]
        values, behind = pictures[frame, y, x].float()[both], self.background[y, x][both]
        pair = self.colours[torch.stack([colour[label[both]], colour[other[both]]], 1)] - behind[:, None]  # [Q, 2, 3]
        mixed = torch.linalg.lstsq(pair.transpose(1, 2), (values - behind)[..., None]).solution[..., 0].clamp(0, 1)
        weight[both] = mixed[:, 0]
        frame, y, x = (torch.cat([part, part[both]]) for part in (frame, y, x))
        return (frame, y, x), torch.cat([label, other[both]]), torch.cat([weight, mixed[:, 1]]).double(), colour


def begin(areas: Tensor) -> Followed:
    """The things of first pictures, whose areas are [B, M, 5], by colour, then from left to right. TerrellaError without any."""
    held = areas[..., 0] > 0
    count = int(held.sum(1).max())
    if count == 0:
        raise TerrellaError("the first pictures show no thing that differs from the background; is anything in view?")
    order = (~held).double().mul(1e9).add(1e4 * areas[..., 3] + areas[..., 1]).argsort(1)[:, :count]
    size, x, y, colour, cut = areas.gather(1, order[..., None].expand(-1, -1, 5)).unbind(-1)
    place = torch.stack([x, y], -1)
    none = torch.zeros(len(areas), dtype=torch.long)
    return Followed(place, torch.zeros_like(place), size, size, colour, size > 0, cut > 0, none)


def fit_tracker(pictures: Tensor) -> Tracker:
    """A tracker of what moves in uint8 [F, H, W, 3], pictures of many moments from one camera that stands still. TerrellaError
    where nothing moves, or all does."""
    some = pictures[torch.linspace(0, len(pictures) - 1, min(len(pictures), 256)).long()].float()
    background = _floored(some, some.median(0).values)
    differs = (some - background).abs().amax(-1)
    moving = float((differs > DIFFERENCE).float().mean())
    if moving > 0.5:
        raise TerrellaError(
            f"{moving:.0%} of the pixels differ from the background: does the camera move? Things are tracked where it "
            "stands still."
        )
    peaks = (differs > DIFFERENCE) & (differs >= F.max_pool2d(differs[:, None], 3, 1, 1)[:, 0] - 4)
    seen = some[peaks]
    if not len(seen):
        raise TerrellaError("nothing moves in the pictures, so there is nothing to track.")
    colours: list[Tensor] = []
    left = seen
    while len(left) > SHARE * len(seen) and len(colours) < COLOURS:
        middle = common_colour(left)
        near = (left - middle).norm(dim=1) < NEAR
        if int(near.sum()) > SHARE * len(seen):
            colours.append(left[near].median(0).values)
        left = left[~near] if bool(near.any()) else left[1:]
    tracker = Tracker(background, torch.stack(colours or [seen.median(0).values]), 1.0)
    sizes = tracker.areas(some.to(torch.uint8))[..., 0]
    sizes = sizes[sizes > 0]
    return Tracker(background, tracker.colours, float(sizes.quantile(0.1)) if len(sizes) else 1.0)


def common_colour(colours: Tensor) -> Tensor:
    """The commonest of colours [P, 3], 0 to 255, to within 32: [3]."""
    bins = (colours / 32).long() @ torch.tensor([64, 8, 1])
    return colours[bins == bins.mode().values].median(0).values


def _floored(some: Tensor, background: Tensor) -> Tensor:
    """The background, with its commonest colour wherever that is seen now and then: what mostly lies there is a thing."""
    flat = background.flatten(0, 1)
    floor = common_colour(flat)
    seen = ((some - floor).abs().amax(-1) < DIFFERENCE / 2).float().mean(0) > SHARE
    return torch.where(seen[..., None], floor, background)


def _matched(
    goal: Tensor, size: Tensor, colour: Tensor, here: Tensor, areas: Tensor, reach: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(place, area, present, cut of each thing, number of others): each thing takes the nearest area of its colour, in order of
    distance; an area that is large enough is shared by things that touch. goal [B, N, 2]; areas [B, M, 5]."""
    batch, things = size.shape
    room, rows = areas[..., 0].clone(), torch.arange(batch)
    apart = torch.cdist(goal, areas[..., 1:3])
    cost = apart + torch.where(colour[..., None] == areas[:, None, :, 3], 0.0, 0.5 * reach)
    pick = torch.full((batch, things), -1)
    for _ in range(things):
        open_ = (pick < 0)[..., None] & here[..., None] & (room[:, None, :] > 0.6 * size[..., None].clamp_min(1e-9))
        best, flat = torch.where(open_ & (cost < reach), cost, torch.inf).flatten(1).min(1)
        some, thing, area = best.isfinite(), flat // areas.shape[1], flat % areas.shape[1]
        pick[rows[some], thing[some]] = area[some]
        taken = torch.where(
            room == areas[..., 0],
            torch.maximum(size[rows, thing], 0.6 * room[rows, area])[:, None],
            size[rows, thing][:, None],
        )
        room[rows[some], area[some]] -= taken[rows, area][some]
    radius = (areas[..., 0] / torch.pi).sqrt()[:, None] + 0.5
    inside, over = torch.where(cost < radius.clamp_max(0.5 * reach), apart, torch.inf).min(2)
    pick = torch.where((pick < 0) & here & inside.isfinite(), over, pick)  # behind another one of its colour
    present = pick >= 0
    mine = areas.gather(1, pick.clamp_min(0)[..., None].expand(-1, -1, 5))
    shared = (pick[:, :, None] == pick[:, None, :]) & present[:, :, None] & present[:, None, :]
    share = shared * size[:, None, :]
    total = share.sum(-1).clamp_min(1e-9)
    middle = torch.einsum("bij,bjc->bic", share, goal) / total[..., None]
    alone = shared.sum(-1) < 2
    place = torch.where(alone[..., None], mine[..., 1:3], mine[..., 1:3] + goal - middle)
    area = torch.where(alone, mine[..., 0], size)
    free = (areas[..., 0] > 0) & (areas[..., 4] == 0)
    used = torch.zeros(batch, areas.shape[1], dtype=torch.bool)
    used[rows[:, None].expand_as(pick)[present], pick[present]] = True
    place = torch.where(present[..., None], place, goal)
    return place, torch.where(present, area, size), present, present & (mine[..., 4] > 0), (free & ~used).sum(1)
