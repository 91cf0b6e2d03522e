"""Objects: things as billboards, each with a place and a look that change as in recordings.

Looks (space/billboards.py) and moves of the recording are sampled, never averaged, so that a figure stays sharp.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from ..core import chance
from ..core.backend import constant, table, where
from ..core.errors import ObservationError
from ..core.spec import EVENT
from ..core.state import State
from ..space.billboards import PICTURE, Cutout, cut_out, paint_billboards
from ..space.camera import Intrinsics, yaw
from ..space.floorplan import NOWHERE
from .body import rotate
from .generator import DrawnFrame
from .parts import GOES, LOOKS, MOVES, Absent, Channels, Evidence, Tensors, Walls

# Columns of a billboard: number (0: none), place (x, y, z), look (NONE: unknown), steps with that look, the look before, last
# move (x, y), steps since that move, and brightness relative to its look's own.
NUMBER, PLACE, LOOK, AGE, BEFORE, GOING, RESTED, LIGHT = 0, slice(1, 4), 4, 5, 6, slice(7, 9), 9, 10
COLUMNS = 11
LOOKS_SEEN, COUNTED = slice(LOOK, BEFORE + 1, BEFORE - LOOK), slice(AGE, RESTED + 1, RESTED - AGE)
NONE = -1
ALIKE = 0.6  # distance of marks up to which two looks are the same
STICKS = 0.2  # how much nearer another look must be for a thing to change to it
STOREY_M = 2.0  # height between feet and viewer above which a billboard is on another floor
ROWS = 16  # most billboards of a place
STARTS = 32  # sets of billboards with which episodes begin
AGES = 24  # steps are counted up to this
WIDE_M = 0.65  # beside its middle, where a thing is aimed at by 1/e
UNLIKELY = 0.01  # less likely looks are never sampled: over many steps they would fell a figure by chance
CAUSED = 4.5  # log ratio of probabilities, under the actions and without them, from which a new look is due to them
CHAIN = 24  # most looks of a movement, such as a fall
FINE = (8, 6)  # rows and columns of the pictures that looks are compared by


@dataclass(frozen=True)
class BillboardsConfig:
    """Of the billboards."""

    actions: int  # numbers of an encoded action
    history: int  # last actions that it sees, the present one among them
    looks: int = 160  # that it has room for
    moves: int = 33  # that it has room for; move 0 is none
    rows: int = ROWS  # billboards of a place
    starts: int = STARTS  # sets of billboards with which episodes begin
    hidden: int = 192  # width of the network


class BillboardLogits(NamedTuple):
    """Logits of the next look [n, looks], the move [n, moves] and the end of a billboard [n]."""

    look: torch.Tensor
    move: torch.Tensor
    gone: torch.Tensor


@final
class Billboards(nn.Module):
    """The looks of the things of a place, and a network of what they do next."""

    kind = "billboards"

    pictures: torch.Tensor  # uint8 [looks, 4, *PICTURE]
    boxes: torch.Tensor  # [looks, 4]
    solid: torch.Tensor  # [looks] metres along x or y to which a body can come near; 0: it passes through
    follows: torch.Tensor  # bool [looks + 1, looks], which look followed which; the first row is that of NONE
    moves: torch.Tensor  # [moves, 3] metres
    begun: torch.Tensor  # [starts, rows, COLUMNS], billboards with which episodes begin

    def __init__(self, config: BillboardsConfig):
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
        """No billboards: [batch, rows, COLUMNS]."""
        return self.begun.new_zeros(batch, self.config.rows, COLUMNS)

    # -- as a part of a world -----------------------------------------------------------------------------------------

    def channels(self, size: tuple[int, int]) -> Channels:
        rows = self.config.rows
        shows: dict[str, spaces.Space] = {"instances": spaces.Box(0, rows, size, np.uint8)}
        shows["objects"] = spaces.Box(-np.inf, np.inf, (rows, 4), np.float32)
        return Channels({**shows, "hit": EVENT, "fallen": EVENT}, may_observe=tuple(shows))

    def start(self, pick: torch.Tensor, state: State) -> Tensors:
        """The billboards of the starts `pick` [B], in place of the things in their pictures, which would never move."""
        billboards = self.begun[pick]
        shown = state["things"].to(torch.uint8)
        return {"billboards": billboards, "billboards_before": billboards, "instances": shown}

    def observe(
        self, prior: State | None, evidence: Evidence, observation: Mapping, camera: Intrinsics | None
    ) -> Tensors:
        """The billboards of the evidence and their pixels, where it tells things apart; else there is no billboard."""
        depth, batch = evidence.seen["depth"], evidence.batch
        none = self.empty(batch)
        if not {"objects", "instances"} <= set(observation):
            nothing = torch.zeros_like(depth, dtype=torch.uint8)
            return {"billboards": none, "billboards_before": none, "instances": nothing}
        assert camera is not None and evidence.pose is not None
        listed = torch.as_tensor(observation["objects"]).float().to(depth.device)
        instances = torch.as_tensor(observation["instances"]).to(depth.device)
        fits = listed.shape == (batch, self.config.rows, 4) and instances.ndim == 3 and len(instances) == batch
        if not fits or instances.dtype != torch.uint8 or not torch.isfinite(listed).all():
            raise ObservationError(
                f"objects is finite float [B, {self.config.rows}, 4] and instances uint8 [B, h, w]; got "
                f"{tuple(listed.shape)} and {instances.dtype} {tuple(instances.shape)}."
            )
        # pixels with the number of no listed object belong to none
        named = F.pad((listed[..., 0] > 0).to(torch.uint8), (1, 255 - self.config.rows))
        instances = instances * named.gather(1, instances.flatten(1).long()).view(instances.shape)
        instances = F.adaptive_max_pool2d(instances[:, None].float(), depth.shape[-2:])[:, 0].to(torch.uint8)
        cut = cut_out(evidence.seen["rgb"], instances, depth, listed[..., 1:], evidence.pose, camera)
        billboards = self.match_evidence(cut, listed, none if prior is None else prior["billboards_before"])
        return {"billboards": billboards, "billboards_before": billboards, "instances": instances}

    @property
    def draws(self) -> Mapping[int, Sequence[int]]:
        """See parts.Objects."""
        return dict.fromkeys((LOOKS, MOVES, GOES), (self.config.rows,))

    def step(self, before: State, after: State, chances: Mapping[int, torch.Tensor]) -> Tensors:
        """The billboards of `after`, a step after `before`: those that were in sight have acted."""
        billboards = self.act(before["billboards"], in_sight(before), after["pose"], after["actions"], chances)
        return {"billboards": billboards, "billboards_before": before["billboards"]}

    def add_walls(self, walls: Walls, state: State, half_m: float) -> Walls:
        """The walls, and the sides of those billboards that stop a body of half width `half_m`."""
        return walls._replace(own=torch.cat([walls.own, self.bodies(state, half_m)], 1))

    def paint(self, state: State, frame: DrawnFrame, camera: Intrinsics | None) -> DrawnFrame:
        """The frame with the state's billboards in it."""
        assert camera is not None and frame.depth is not None and frame.things is not None
        rgb = frame.rgb / 255
        rgb, depth, instances = self.painted(state["billboards"], rgb, frame.depth, state["pose"], camera)
        things = torch.maximum(frame.things, instances > 0)
        return DrawnFrame((rgb * 255).round().to(torch.uint8), depth, things, instances)

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        shown: Tensors = {}
        if "objects" in channels:
            shown["objects"] = state["billboards"][..., :4] * in_sight(state)[..., None]
        if {"hit", "fallen"} & set(channels):
            hit, fallen = self.struck(state)
            shown |= {"hit": hit, "fallen": fallen}
        return {name: shown[name] for name in channels if name in shown}

    # -- what happens -------------------------------------------------------------------------------------------------

    def struck(self, state: State) -> tuple[torch.Tensor, torch.Tensor]:
        """Whether the last step hit something, and whether something fell: bool [B] each. A hit is a change of look that the
        actions caused, or a fall."""
        before, after = state["billboards_before"], state["billboards"]
        rows, look = after.shape[1], after[..., LOOK].long().clamp_min(0)
        flat, pose, acts = (
            before.flatten(0, 1),
            *(state[name].repeat_interleave(rows, 0) for name in ("pose", "actions")),
        )
        logits = self.next_logits(flat.repeat(2, 1), pose.repeat(2, 1), torch.cat([acts, 0 * acts])).look
        with_them, without = logits.log_softmax(1).chunk(2)
        likelier = (with_them - without).gather(1, look.flatten()[:, None]).view(look.shape)
        changed = (after[..., LOOK] != before[..., LOOK]) & (after[..., NUMBER] > 0) & (before[..., NUMBER] > 0)
        down, stood = self.down, before[..., LOOK].long().clamp_min(0)
        fell = (changed & down[look] & ~down[stood]).any(1)
        return (changed & (likelier > CAUSED)).any(1) | fell, fell

    @property
    def down(self) -> torch.Tensor:
        """bool [looks]: of a thing that was solid and never will be again, such as a figure that has fallen."""
        follows, solid = self.follows[1:].float(), (self.solid > 0).float()
        later = before = solid  # looks that follow a solid one, and looks that a solid one follows, within CHAIN steps
        for _ in range(CHAIN):
            later, before = (later + later @ follows).clamp_max(1.0), (before + follows @ before).clamp_max(1.0)
        return (later > 0) & (before == 0)

    def next_logits(self, billboards: torch.Tensor, pose: torch.Tensor, acts: torch.Tensor) -> BillboardLogits:
        """Of billboards [n, COLUMNS], seen from `pose` [n, 7] after the actions [n, history, A], the newest last."""
        apart = billboards[:, PLACE] - pose[:, :3]
        along = rotate(apart[:, :2], -yaw(pose))  # how far ahead, and how far aside
        ahead, aside = along.split(1, 1)
        far = torch.linalg.vector_norm(apart[:, :2], dim=1, keepdim=True).clamp_min(0.1)
        before = ahead > 0
        at = [
            ahead / 10, torch.tanh(aside / constant(torch.tensor, aside.device, (0.4, 1.0, 4.0))), far.log() / 2,
            aside.abs() < ahead, before, (apart[:, 2:] / 2).clamp(-2, 2), apart[:, :2] / far, 8 * billboards[:, GOING],
        ]  # fmt: skip
        look, earlier = (billboards[:, LOOKS_SEEN].long() + 1).unbind(1)  # NONE comes first
        age, rested = billboards[:, COUNTED].long().clamp(0, AGES).unbind(1)
        aimed = torch.exp(-((aside / WIDE_M).square())) * before  # how straight it is aimed at
        parts = [self.look(look), self.before(earlier), self.age(age), self.rested(rested), *at, aimed]
        known = self.think(torch.cat([*parts, acts.flatten(1), aimed * acts.flatten(1)], 1))
        next_look = self.next_look(known).masked_fill(~self.follows[look], -1e9)  # no figure becomes another
        return BillboardLogits(next_look, self.next_move(known), self.goes(known)[:, 0])

    def act(
        self,
        billboards: torch.Tensor,
        seen: torch.Tensor,
        pose: torch.Tensor,
        acts: torch.Tensor,
        chances: Mapping[int, torch.Tensor],
    ) -> torch.Tensor:
        """The billboards [B, K, COLUMNS] one step later, sampled by random numbers of `draws`. seen bool [B, K]: the others wait;
        pose [B, 7] and acts [B, history, A] as for `next_logits`."""
        rows = billboards.shape[1]
        flat = billboards.flatten(0, 1)
        logits = self.next_logits(flat, pose.repeat_interleave(rows, 0), acts.repeat_interleave(rows, 0))
        likely = logits.look.softmax(1)
        likely = likely.masked_fill(likely < likely.amax(1, keepdim=True).clamp_max(UNLIKELY), 0.0)
        drawn = [
            chance.chosen(chances[stream], part.unflatten(0, (-1, rows))).flatten()
            for part, stream in ((likely, LOOKS), (logits.move.softmax(1), MOVES))
        ]
        gone = chances[GOES] < logits.gone.sigmoid().unflatten(0, (-1, rows))
        after = update_billboards(flat, flat[:, PLACE] + self.moves[drawn[1]], drawn[0].float())
        after = after.unflatten(0, (-1, rows)).masked_fill(gone[..., None], 0.0)
        return torch.where((seen & (billboards[..., NUMBER] > 0))[..., None], after, billboards)

    def painted(
        self, billboards: torch.Tensor, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Frames with billboards [B, K, COLUMNS] in them, as space/billboards.paint_billboards gives them."""
        look = billboards[..., LOOK].long()
        visible = (billboards[..., NUMBER] > 0) & (look != NONE)
        look = look.clamp_min(0)
        cover, colour = (
            constant(torch.tensor, rgb.device, part) for part in ((0.0, 0.0, 0.0, 1 / 255), (1 / 255,) * 3 + (0.0,))
        )
        lit = torch.addcmul(cover, billboards[..., LIGHT, None], colour)[..., None, None]
        pictures = (self.pictures[look] * lit).clamp_max(1)
        return paint_billboards(rgb, depth, (billboards[..., PLACE], pictures, self.boxes[look]), visible, pose, camera)

    def bodies(self, state: State, half_m: float) -> torch.Tensor:
        """The sides [B, 4 K, 4] of those billboards that stop a body of half width `half_m` at the pose of `state`, as walls
        (space/floorplan.py); NOWHERE for the others."""
        billboards, position = state["billboards"], state["pose"][:, None, :3]
        known = (billboards[..., NUMBER] > 0) & (billboards[..., LOOK] != NONE)
        reach = self.solid[billboards[..., LOOK].long().clamp_min(0)]
        apart = (billboards[..., PLACE] - position).abs()
        level = apart[..., 2] < STOREY_M
        outside = apart[..., :2].amax(-1) >= reach - 0.02  # a body inside of one may leave it
        stops = known & level & (reach > half_m) & outside
        half, places = (reach - half_m)[..., None, None], billboards[..., PLACE][..., None, :2]
        corners = constant(table, reach.device, *_SIDES).view(4, 1, 2, 2)
        walls = torch.addcmul(places[:, None], half[:, None], corners)
        return where(stops[:, None, :, None, None], walls, NOWHERE).view(len(walls), -1, 4)

    def match_evidence(self, cut: Cutout, listed: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """The billboards [B, K, COLUMNS] of evidence, in the rows of `listed` [B, K, 4] = number and place. Those `before`
        [B, K, COLUMNS] that it does not list wait where they were, in rows that are free."""
        batch, rows = listed.shape[:2]
        pictures = self.pictures.float() / 255
        off = before.new_full((batch, rows, self.config.looks), torch.inf)  # unseen: unlike any look
        off[cut.view, cut.row] = torch.cdist(look_features(cut.picture, cut.box), look_features(pictures, self.boxes))
        bright, whole = before.new_zeros(batch, rows), torch.zeros(batch, rows, dtype=torch.bool, device=before.device)
        bright[cut.view, cut.row], whole[cut.view, cut.row] = brightness(cut.picture), cut.whole
        usual = brightness(pictures).clamp_min(1e-3)
        number, shown = listed[..., 0], listed[..., 0] > 0
        same = (number[:, :, None] == before[:, None, :, NUMBER]) & shown[:, :, None]  # [B, K of now, K of before]
        known = same.any(2)
        old = before.gather(1, same.float().argmax(2)[..., None].expand(-1, -1, COLUMNS))
        was = torch.where(known, old[..., LOOK].long(), NONE)
        look = torch.where(whole, nearest_look(off, was), NONE)
        guess = torch.where((was != NONE) | off.isinf().all(-1), was, off.argmin(-1))
        # seen in part or unlike any look: as before, else the nearest look
        look, place = torch.where(look == NONE, guess, look), listed[..., 1:]
        again = update_billboards(old, place, look.float())
        now = torch.where(known[..., None], again, new_billboards(number, place, look))
        light = (bright / usual[look.clamp_min(0)]).clamp(0.25, 4)
        lit = (look != NONE) & (~known | whole)
        now = torch.cat([now[..., :LIGHT], torch.where(lit, light, now[..., LIGHT])[..., None]], -1)
        rest = (before[..., NUMBER] > 0) & ~same.any(1)
        place, turn = (~shown).cumsum(1), rest.cumsum(1)
        fills = (~shown & (place <= turn[:, -1:]))[:, :, None] & rest[:, None] & (place[:, :, None] == turn[:, None])
        waiting = before.gather(1, fills.float().argmax(2)[..., None].expand(-1, -1, COLUMNS))
        waiting = torch.where(fills.any(2)[..., None], waiting, 0.0)
        return torch.where(shown[..., None], now, waiting)


@final
class NoObjects(Absent):
    """Of a world whose things, if it has any, are drawn like the rest."""

    def start(self, pick: torch.Tensor, state: State) -> Tensors:
        return {}

    def observe(
        self, prior: State | None, evidence: Evidence, observation: Mapping, camera: Intrinsics | None
    ) -> Tensors:
        return {}

    def step(self, before: State, after: State, chances: Mapping[int, torch.Tensor]) -> Tensors:
        return {}

    def add_walls(self, walls: Walls, state: State, half_m: float) -> Walls:
        return walls

    def paint(self, state: State, frame: DrawnFrame, camera: Intrinsics | None) -> DrawnFrame:
        return frame

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        return {}


def in_sight(state: State) -> torch.Tensor:
    """bool [B, K]: whether the last frame shows each billboard."""
    rows = constant(torch.arange, state["instances"].device, 1, state["billboards"].shape[1] + 1)
    return (state["instances"].flatten(1)[:, None] == rows[:, None]).any(-1)


def nearest_look(off: torch.Tensor, was: torch.Tensor | int) -> torch.Tensor:
    """The look [...] of a thing, from its distances `off` [..., looks] and its look before, `was` [...]: the same, unless another
    is clearly nearer; NONE where all are far."""
    least, best = off.min(-1)
    before = torch.as_tensor(was, device=off.device)
    stays = (before != NONE) & (off.gather(-1, before.clamp_min(0)[..., None])[..., 0] < least + STICKS)
    return torch.where(least > ALIKE, NONE, torch.where(stays, before, best))


def new_billboards(number: torch.Tensor | float, place: torch.Tensor, look: torch.Tensor | int) -> torch.Tensor:
    """New billboards [..., COLUMNS]: number and look [...], place [..., 3]."""
    billboards = place.new_zeros(*place.shape[:-1], COLUMNS)
    billboards[..., NUMBER], billboards[..., PLACE], billboards[..., LOOK] = number, place, look
    billboards[..., BEFORE], billboards[..., LIGHT] = NONE, 1.0
    billboards[..., AGE], billboards[..., RESTED] = AGES, AGES
    return billboards


def update_billboards(billboards: torch.Tensor, place: torch.Tensor, look: torch.Tensor) -> torch.Tensor:
    """Billboards [..., COLUMNS] one step later at place [..., 3] with look [...], their ages and last moves updated."""
    was = billboards[..., LOOK]
    move, other = place - billboards[..., PLACE], look != was
    went = torch.linalg.vector_norm(move[..., :2], dim=-1) > 1e-3
    counted = (billboards[..., COUNTED] + 1).clamp_max(AGES).masked_fill(torch.stack([other, went], -1), 0.0)
    before = torch.where(other, was, billboards[..., BEFORE])
    going = torch.where(went[..., None], move[..., :2], billboards[..., GOING])
    parts = [look[..., None], counted[..., :1], before[..., None], going, counted[..., 1:], billboards[..., LIGHT:]]
    return torch.cat([billboards[..., :1], place, *parts], -1)


# how the corners of a side of a body lie around its middle: x, y, x, y
_SIDES = (-1.0, -1.0, 1.0, -1.0), (-1.0, 1.0, 1.0, 1.0), (-1.0, -1.0, -1.0, 1.0), (1.0, -1.0, 1.0, 1.0)


def brightness(picture: torch.Tensor) -> torch.Tensor:
    """Mean colour [n] of pictures [n, 4, h, w] where they cover."""
    cover = picture[:, 3]
    return (picture[:, :3].mean(1) * cover).sum((1, 2)) / cover.sum((1, 2)).clamp_min(1e-3)


def look_features(picture: torch.Tensor, box: torch.Tensor) -> torch.Tensor:
    """What looks are compared by: pictures [n, 4, h, w], small and at one brightness, and their boxes [n, 4]: [n, D]."""
    cover = picture[:, 3:]
    colour = 0.3 * picture[:, :3] / brightness(picture).clamp_min(0.02)[:, None, None, None]
    small = F.adaptive_avg_pool2d(torch.cat([colour * cover, 0.5 * cover], 1), FINE)
    return torch.cat([3 * small.flatten(1) / (FINE[0] * FINE[1]) ** 0.5, box], 1)
