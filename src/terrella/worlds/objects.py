"""Objects: the things of a place as cards that stand in it, each with a place and a look that change as they did in recordings.

A look is one of those that the recording showed (space/cards.py), a move one of those that it saw, and which comes next is
drawn by chance from what a small network tells: a figure is never the mean of what it could do, so it stays sharp and whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import nn

from ..space.billboards import PICTURE, Cutout, painted
from ..space.camera import Intrinsics, yaw

# A card: its number (0: none), place (x, y, z), look (NONE: not known), steps since it looks so, the look before, its last
# move (x, y), steps since that, and its light, of its look's own.
NUMBER, PLACE, LOOK, AGE, BEFORE, GOING, RESTED, LIGHT = 0, slice(1, 4), 4, 5, 6, slice(7, 9), 9, 10
COLUMNS = 11
NONE = -1
ALIKE = 0.6  # how far marks may lie from a look's to be taken for it
STICKS = 0.2  # how much nearer another look must be for a thing to be seen to change
STOREY_M = 2.0  # between feet and eye, above which a card is on another floor
ROWS = 16  # cards of a place at most
STARTS = 32  # casts with which stories begin
AGES = 24  # steps that are counted; more are as many
WIDE_M = 0.65  # beside its middle, where a thing counts as looked at by 1/e
UNLIKELY = 0.01  # a look less likely than that in a step does not come: so many of them would fell a man now and then
FINE = (8, 6)  # rows and columns of the pictures by which looks are told apart


@dataclass(frozen=True)
class ObjectsConfig:
    """actions: numbers in an action; history: of the last actions that it is told, the present one among them; looks and
    moves: that it has room for (move 0 is none); hidden: width of the network."""

    actions: int
    history: int
    looks: int = 160
    moves: int = 33
    rows: int = ROWS
    starts: int = STARTS
    hidden: int = 192


class Told(NamedTuple):
    """Logits of the next look [n, looks], of the move [n, moves] and of its being gone [n]."""

    look: torch.Tensor
    move: torch.Tensor
    gone: torch.Tensor


class Objects(nn.Module):
    """What the things of a place look like, and what they do next."""

    pictures: torch.Tensor  # uint8 [looks, 4, *PICTURE]
    boxes: torch.Tensor  # [looks, 4]
    solid: torch.Tensor  # [looks] metres to which an eye can come near along x or y; 0: it can walk through
    follows: torch.Tensor  # bool [looks + 1, looks], which look was seen to follow which; the first row is that of NONE
    moves: torch.Tensor  # [moves, 3] metres
    begun: torch.Tensor  # [starts, rows, COLUMNS], the cards with which stories begin

    def __init__(self, config: ObjectsConfig):
        super().__init__()
        self.config = config
        self.register_buffer("pictures", torch.zeros(config.looks, 4, *PICTURE, dtype=torch.uint8))
        self.register_buffer("boxes", torch.zeros(config.looks, 4))
        self.register_buffer("solid", torch.zeros(config.looks))
        self.register_buffer("follows", torch.ones(config.looks + 1, config.looks, dtype=torch.bool))
        self.register_buffer("moves", torch.zeros(config.moves, 3))
        self.register_buffer("begun", torch.zeros(config.starts, config.rows, COLUMNS))
        self.look, self.before = nn.Embedding(config.looks + 1, 32), nn.Embedding(config.looks + 1, 16)
        self.age, self.rested = nn.Embedding(AGES + 1, 16), nn.Embedding(AGES + 1, 16)
        inputs = 32 + 3 * 16 + 13 + 2 * config.actions * config.history
        hidden = config.hidden
        layers = [nn.Linear(inputs, hidden), nn.SiLU(), nn.Dropout(0.1), nn.Linear(hidden, hidden), nn.SiLU()]
        self.think = nn.Sequential(*layers, nn.Dropout(0.1))
        self.next_look, self.next_move = nn.Linear(hidden, config.looks), nn.Linear(hidden, config.moves)
        self.goes = nn.Linear(hidden, 1)

    def empty(self, batch: int) -> torch.Tensor:
        """No cards: [batch, rows, COLUMNS]."""
        return torch.zeros(batch, self.config.rows, COLUMNS)

    def tell(self, billboards: torch.Tensor, pose: torch.Tensor, acts: torch.Tensor) -> Told:
        """What comes next of cards [n, COLUMNS], seen from `pose` [n, 7] to which the actions [n, history, A], the newest
        last, have led."""
        apart, heading = billboards[:, PLACE] - pose[:, :3], yaw(pose)
        c, s = heading.cos(), heading.sin()
        ahead, aside = apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s
        far = apart[:, :2].norm(dim=1).clamp_min(0.1)
        where = [
            ahead / 10, torch.tanh(aside / 0.4), torch.tanh(aside), torch.tanh(aside / 4), far.log() / 2,
            (aside.abs() < ahead).float(), (ahead > 0).float(), (apart[:, 2] / 2).clamp(-2, 2),
            apart[:, 0] / far, apart[:, 1] / far, *(8 * billboards[:, GOING]).unbind(1),
        ]  # fmt: skip
        look, before = ((billboards[:, column].long() + 1) for column in (LOOK, BEFORE))  # NONE comes first
        age, rested = (billboards[:, column].long().clamp(0, AGES) for column in (AGE, RESTED))
        aimed = (
            torch.exp(-((aside / WIDE_M) ** 2))[:, None] * (ahead > 0)[:, None]
        )  # how straight the eye looks at it now
        parts = [self.look(look), self.before(before), self.age(age), self.rested(rested), torch.stack(where, 1), aimed]
        known = self.think(torch.cat([*parts, acts.flatten(1), aimed * acts.flatten(1)], 1))
        next_look = self.next_look(known).masked_fill(~self.follows[look], -1e9)  # no figure becomes another by chance
        return Told(next_look, self.next_move(known), self.goes(known)[:, 0])

    @torch.no_grad()
    def step(
        self, billboards: torch.Tensor, seen: torch.Tensor, pose: torch.Tensor, acts: torch.Tensor, rng: torch.Generator
    ) -> torch.Tensor:
        """The cards [B, K, COLUMNS] one step later, by chance; seen [B, K] bool: the others wait; pose [B, 7] and acts
        [B, history, A] as for `tell`."""
        view, row = (seen & (billboards[..., NUMBER] > 0)).nonzero(as_tuple=True)
        if not len(view):
            return billboards
        some = billboards[view, row]
        told = self.tell(some, pose[view], acts[view])
        chance = told.look.softmax(1)
        chance = torch.where(chance < chance.amax(1, keepdim=True).clamp_max(UNLIKELY), 0.0, chance)
        look = torch.multinomial(chance, 1, generator=rng)[:, 0]
        move = torch.multinomial(told.move.softmax(1), 1, generator=rng)[:, 0]
        gone = torch.rand(len(some), generator=rng) < told.gone.sigmoid()
        after = noted(some, some[:, PLACE] + self.moves[move], look.float())
        after[gone] = 0.0
        return billboards.index_put((view, row), after)

    def paint(
        self, billboards: torch.Tensor, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Frames with cards [B, K, COLUMNS] in them: see space/cards.painted."""
        look = billboards[..., LOOK].long()
        there = (billboards[..., NUMBER] > 0) & (look != NONE)
        look = look.clamp_min(0)
        light = billboards[..., LIGHT, None].expand(-1, -1, 3)
        lit = torch.cat([light, torch.ones_like(light[..., :1])], -1)[..., None, None]
        pictures = (self.pictures[look].float() / 255 * lit).clamp_max(1)
        return painted(rgb, depth, (billboards[..., PLACE], pictures, self.boxes[look]), there, pose, camera)

    def bodies(self, billboards: torch.Tensor, position: torch.Tensor, half_m: float) -> torch.Tensor:
        """The sides [S, 4] of those cards [K, COLUMNS] that stop a body of half width `half_m` with its eye at `eye` [3], as
        walls (space/floorplan.py)."""
        known = (billboards[:, NUMBER] > 0) & (billboards[:, LOOK] != NONE)
        reach = self.solid[billboards[:, LOOK].long().clamp_min(0)]
        apart = (billboards[:, PLACE] - position).abs()
        level = apart[:, 2] < STOREY_M
        stops = known & level & (reach > half_m) & (apart[:, :2].amax(1) >= reach - 0.02)  # who stands in one may leave
        (x, y), half = billboards[stops][:, PLACE][:, :2].unbind(1), reach[stops] - half_m
        left, right, low, high = x - half, x + half, y - half, y + half
        sides = ((left, low, right, low), (left, high, right, high), (left, low, left, high), (right, low, right, high))
        return torch.cat([torch.stack(side, 1) for side in sides])

    def recognised(self, cut: Cutout, told: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """The cards [B, K, COLUMNS] that evidence shows, each in its row of told [B, K, 4] = number and place; of those `before`
        [B, K, COLUMNS] that it does not tell of, as many as there is room for wait where they were."""
        batch, rows = told.shape[:2]
        pictures = self.pictures.float() / 255
        off = torch.full((batch, rows, self.config.looks), torch.inf)  # what is not seen is like nothing
        off[cut.view, cut.row] = torch.cdist(marks(cut.picture, cut.box), marks(pictures, self.boxes))
        bright, whole = torch.zeros(batch, rows), torch.zeros(batch, rows, dtype=torch.bool)
        bright[cut.view, cut.row], whole[cut.view, cut.row] = brightness(cut.picture), cut.whole
        usual = brightness(pictures).clamp_min(1e-3)
        billboards = self.empty(batch)
        for story in range(batch):
            kept = {float(billboard[NUMBER]): billboard for billboard in before[story] if billboard[NUMBER] > 0}
            for row in (told[story, :, 0] > 0).nonzero()[:, 0].tolist():
                number, place, away = float(told[story, row, 0]), told[story, row, 1:], off[story, row]
                old = kept.pop(number, None)
                was = NONE if old is None else int(old[LOOK])
                look = likest(away, was) if whole[story, row] else NONE
                if look == NONE:  # what is seen in part, or is like none, looks as it did, or else as it may
                    look = was if was != NONE or bool(away.isinf().all()) else int(away.argmin())
                billboard = (
                    fresh(number, place, look)
                    if old is None
                    else noted(old[None], place[None], torch.tensor([float(look)]))[0]
                )
                if look != NONE and (old is None or whole[story, row]):
                    billboard[LIGHT] = (bright[story, row] / usual[look]).clamp(0.25, 4)
                billboards[story, row] = billboard
            free = (billboards[story, :, NUMBER] == 0).nonzero()[:, 0].tolist()
            for row, billboard in zip(free, kept.values()):
                billboards[story, row] = billboard
        return billboards


def likest(off: torch.Tensor, was: int) -> int:
    """Of looks `off` [looks] away the one that a thing has which looked like `was`: that one, unless another is clearly nearer;
    NONE where all are far."""
    best = int(off.argmin())
    if off[best] > ALIKE:
        return NONE
    return was if was != NONE and off[was] < off[best] + STICKS else best


def fresh(number: float, place: torch.Tensor, look: torch.Tensor | float) -> torch.Tensor:
    """A card [COLUMNS] that is seen for the first time, at place [3]."""
    billboard = torch.zeros(COLUMNS)
    billboard[NUMBER], billboard[PLACE], billboard[LOOK], billboard[BEFORE] = number, place, look, NONE
    billboard[AGE] = billboard[RESTED] = AGES
    billboard[LIGHT] = 1.0
    return billboard


def noted(billboards: torch.Tensor, place: torch.Tensor, look: torch.Tensor) -> torch.Tensor:
    """Cards [n, COLUMNS] one step later, at place [n, 3] with look [n]: their ages and last moves go on."""
    after = billboards.clone()
    moved = place - billboards[:, PLACE]
    went, other = moved[:, :2].norm(dim=1) > 1e-3, look != billboards[:, LOOK]
    after[:, PLACE], after[:, LOOK] = place, look
    after[:, BEFORE] = torch.where(other, billboards[:, LOOK], billboards[:, BEFORE])
    after[:, AGE] = torch.where(other, 0.0, (billboards[:, AGE] + 1).clamp_max(AGES))
    after[:, GOING] = torch.where(went[:, None], moved[:, :2], billboards[:, GOING])
    after[:, RESTED] = torch.where(went, 0.0, (billboards[:, RESTED] + 1).clamp_max(AGES))
    return after


def brightness(picture: torch.Tensor) -> torch.Tensor:
    """Mean of the colours [n] where pictures [n, 4, h, w] cover."""
    cover = picture[:, 3]
    return (picture[:, :3].mean(1) * cover).sum((1, 2)) / cover.sum((1, 2)).clamp_min(1e-3)


def marks(picture: torch.Tensor, box: torch.Tensor) -> torch.Tensor:
    """By which looks are told apart: pictures [n, 4, h, w], small and at one brightness, and their boxes [n, 4]: [n, D]."""
    cover = picture[:, 3:]
    colour = 0.3 * picture[:, :3] / brightness(picture).clamp_min(0.02)[:, None, None, None]
    small = F.adaptive_avg_pool2d(torch.cat([colour * cover, 0.5 * cover], 1), FINE)
    return torch.cat([3 * small.flatten(1) / (FINE[0] * FINE[1]) ** 0.5, box], 1)
