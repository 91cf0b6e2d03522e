"""Memory: what a story has seen and dreamt, as posed RGB-D keyframes in the tensors of its State, within a byte budget.

It keeps a dreamt frame that shows a new view of which much had to be invented; evidence it keeps always, in the place of
what it held of that view. When it is full it forgets the keyframe whose view the others cover best (evidence is covered by
evidence alone), and of equals a dreamt one before an observed one, the oldest first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod

import numpy as np
import torch
from gymnasium import spaces

from ..core.errors import ContractError
from ..core.spec import Spec
from .camera import Intrinsics, yaw
from .floorplan import WALLS
from .keyframes import COARSE, Glimpse, Keyframes, look, retrieve, retrieve_by_overlap, vote
from .patches import patch_count

EMPTY, RECORDED, OBSERVED, DREAMT = range(4)  # kinds of keyframes
PAGE = 16  # keyframes that are kept together: remembering one copies one page, and all others are shared with the past
_EVERY = 11  # every so-manyth coarse patch of a keyframe is a point that another may cover
_ALIKE = 0.02  # views whose covered shares differ by less are covered equally well

_SMALL = ("memory_pose", "memory_kind", "memory_born", "memory_walls")

Held = Mapping[str, torch.Tensor]  # a State, or the part of one that is memory's: the tensors of `Memory.empty`


@dataclass(frozen=True)
class Memory:
    """The rules of a memory; what it holds is in the State. Every tensor leads with the batch axis.

    camera: intrinsics of all keyframes; size: height and width of their pictures; budget_mb: MiB that one story may take;
    new_view: metres and radians from the nearest keyframe, whose sum of shares makes a view new; known_enough: share of a
    dreamt frame that memory knew, above which it is not kept.
    """

    camera: Intrinsics
    size: tuple[int, int] = (96, 128)
    budget_mb: float = 16.0
    new_view: tuple[float, float] = (0.4, 0.2)
    known_enough: float = 0.95

    def __post_init__(self):
        if not 0 <= self.budget_mb < float("inf"):
            raise ContractError(f"a memory's budget is 0 MiB or more; got {self.budget_mb}.")

    @cached_property
    def _parts(self) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """What a page holds of each of its keyframes."""
        height, width = self.size
        return {
            "depth": (torch.float32, (height, width)),
            "turn": (torch.float32, (3, 3)),
            "coarse": (torch.float32, (patch_count(self.size, COARSE), 9)),
            "rgb": (torch.uint8, (3, height, width)),
        }

    @cached_property
    def _row_bytes(self) -> int:
        used = sum(dtype.itemsize * prod(shape) for dtype, shape in self._parts.values())
        return -(-used // 8) * 8  # so that every story's page of floats begins where floats may

    @cached_property
    def keyframe_bytes(self) -> int:
        """Of one keyframe, with its pose, its kind, its age and its walls."""
        return self._row_bytes + 7 * 4 + 1 + 8 + WALLS * 4 * 4

    @cached_property
    def capacity(self) -> int:
        """Keyframes that the budget has room for."""
        room = int(self.budget_mb * 2**20) // self.keyframe_bytes
        return room if room < PAGE else room // PAGE * PAGE

    @property
    def nbytes(self) -> int:
        """Bytes of one story's memory when it is full, and of its tensors always."""
        return self.capacity * self.keyframe_bytes

    def empty(self, batch: int) -> dict[str, torch.Tensor]:
        """The tensors of memories that hold nothing."""
        page = torch.zeros(1, min(PAGE, self.capacity) * self._row_bytes, dtype=torch.uint8)
        return {
            "memory_pose": torch.zeros(batch, self.capacity, 7),
            "memory_kind": torch.zeros(batch, self.capacity, dtype=torch.uint8),
            "memory_born": torch.zeros(batch, self.capacity, dtype=torch.int64),
            "memory_walls": torch.zeros(batch, self.capacity, WALLS, 4),
            **{self._page(slot): page.expand(batch, -1) for slot in range(0, self.capacity, PAGE)},
        }

    def of(self, state: Held) -> dict[str, torch.Tensor]:
        """The tensors of `state` that are memory's."""
        return {name: state[name] for name in self.empty(1)}

    def count(self, held: Held) -> torch.Tensor:
        """Keyframes held by each story: [B]."""
        return (held["memory_kind"] > EMPTY).sum(1)

    def table(self, held: Held) -> torch.Tensor:
        """float32 [B, capacity, 4]: x, y in metres, heading in radians, kind; the channel `keyframes`."""
        return keyframe_table(held["memory_pose"], held["memory_kind"])

    # -- keeping ------------------------------------------------------------------------------------------------------

    def observed(
        self, held: Held, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The tensors that change where evidence is kept: rgb uint8 [B, 3, H, W], depth [B, H, W] metres, pose [B, 7]."""
        return self._keep(held, OBSERVED, rgb, depth, pose, torch.ones(len(rgb), dtype=torch.bool))

    def dreamt(
        self, held: Held, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, known: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The same for dreamt frames of which memory knew `known` [B, H, W] in 0..1: kept if new, and enough invented."""
        return self._keep(held, DREAMT, rgb, depth, pose, known.mean((1, 2)) < self.known_enough)

    def nearest(self, held: Held, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How far [B] the view from `pose` [B, 7] is from the nearest keyframe, above 1 for a new view; its slot [B]."""
        far, turn = self.new_view
        here, kept = pose[:, None], held["memory_pose"]
        away = (kept[..., :3] - here[..., :3]).norm(dim=-1) / far
        angle = yaw(kept) - yaw(here)
        apart = away + torch.atan2(angle.sin(), angle.cos()).abs() / turn
        return torch.where(held["memory_kind"] > EMPTY, apart, torch.inf).min(1)

    def _keep(self, held, kind: int, rgb, depth, pose, which: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.capacity or not which.any():
            return {}
        apart, nearest = self.nearest(held, pose)
        which = which if kind == OBSERVED else which & (apart > 1)
        rows = which.nonzero()[:, 0]
        if not len(rows):
            return {}
        new = Keyframes.of(rgb[rows], depth[rows], pose[rows], self.camera, fine=False)
        changed = {name: held[name].clone() for name in _SMALL}
        for row, view in enumerate(rows.tolist()):
            slot = int(nearest[view]) if apart[view] <= 1 else self._room(held, view)
            changed["memory_pose"][view, slot] = pose[view]
            changed["memory_kind"][view, slot] = kind
            changed["memory_born"][view, slot] = held["memory_born"][view].max() + 1
            changed["memory_walls"][view, slot] = new.walls[row]
            page = self._page(slot)
            if page not in changed:
                changed[page] = held[page].clone(memory_format=torch.contiguous_format)
            for name, part in self._read(changed[page][view]).items():
                part[slot % PAGE] = vars(new)[name][row]
        return changed

    def _room(self, held: Held, view: int) -> int:
        """The slot for a new keyframe of one story: a free one, or that of the one which is forgotten."""
        kind, born = held["memory_kind"][view], held["memory_born"][view]
        if (kind == EMPTY).any():
            return int((kind == EMPTY).int().argmax())
        covered = self.covered(held, view)
        best = (covered > covered.max() - _ALIKE).nonzero()[:, 0].tolist()
        return min(best, key=lambda slot: (kind[slot] != DREAMT, born[slot]))

    def covered(self, held: Held, view: int) -> torch.Tensor:
        """How well the others cover the view of each keyframe of one story, 0..1: [n]. At points of the surfaces that it
        saw, the best vote of another (keyframes.vote: did it see them too, from as near?)."""
        pages = self.keyframes(held, view)
        points = torch.cat([page.coarse[:, ::_EVERY, :3] for page in pages])
        ahead = torch.cat([page.turn[:, :, 0] for page in pages])
        eyes = torch.cat([page.pose[:, :3] for page in pages])
        distance = ((points - eyes[:, None]) * ahead[:, None]).sum(-1)
        flat = points.flatten(0, 1), distance.flatten()
        votes = torch.cat([vote(page, *flat, self.camera) for page in pages]).unflatten(1, (len(points), -1))
        dreamt = held["memory_kind"][view, : len(points)] == DREAMT
        others = ~torch.eye(len(points), dtype=torch.bool) & (dreamt[None, :] | ~dreamt[:, None])
        return (votes * others[:, :, None]).amax(0).mean(1)

    # -- recalling ----------------------------------------------------------------------------------------------------

    def keyframes(self, held: Held, view: int) -> list[Keyframes]:
        """The keyframes of one story, page by page, without fine patches; nothing is copied."""
        count = int((held["memory_kind"][view] > EMPTY).sum())
        pages = []
        for first in range(0, count, PAGE):
            parts = {name: part[: count - first] for name, part in self._read(held[self._page(first)][view]).items()}
            some = slice(first, min(first + PAGE, count))
            pose, walls = held["memory_pose"][view, some], held["memory_walls"][view, some]
            pages.append(Keyframes(pose=pose, walls=walls, fine=pose.new_zeros(len(pose), 0, 9), **parts))
        return pages

    def walls(self, held: Held, view: int) -> torch.Tensor:
        """The walls [n, 4] that the keyframes of one story saw (floorplan.py)."""
        count = int((held["memory_kind"][view] > EMPTY).sum())
        return held["memory_walls"][view, :count].flatten(0, 1)

    def look(
        self,
        held: Held,
        pose: torch.Tensor,
        sources: int = 6,
        slots: int = 3,
        recorded: Keyframes | None = None,
        overlap: bool = False,
    ) -> Glimpse:
        """What memory, and `recorded` keyframes that all stories share, know of the views from `pose` [B, 7].

        `sources` keyframes are found for a view by their votes on its surfaces, or by `overlap` of fields of view alone,
        where depth is not to be trusted; `slots` of them show at each pixel.
        """
        chosen = []
        for view in range(len(pose)):
            own = self.keyframes(held, view)
            memories = ([recorded] if recorded is not None and len(recorded) else []) + own
            if overlap:
                picks = retrieve_by_overlap(memories, pose[view], self.camera, sources)
            else:
                picks = retrieve(memories, pose[view], self.camera, self.size, sources)
            shared = len(memories) - len(own)
            found = [keys.at(pick) for keys, pick in zip(memories[:shared], picks) if pick]
            mine = [keys.at(pick) for keys, pick in zip(own, picks[shared:]) if pick]
            found += [Keyframes.joined(mine).unfolded(self.camera)] if mine else []
            chosen.append(Keyframes.joined(found) if found else None)
        return look(chosen, pose, self.camera, self.size, slots)

    # -- pages --------------------------------------------------------------------------------------------------------

    def _page(self, slot: int) -> str:
        return f"memory_{slot // PAGE:02d}"

    def _read(self, page: torch.Tensor) -> dict[str, torch.Tensor]:
        """The bytes [n] of one story's page as its parts, each [PAGE, ...]: views, through which it can be written."""
        number, parts, at = min(PAGE, self.capacity), {}, 0
        for name, (dtype, shape) in self._parts.items():
            size = number * dtype.itemsize * prod(shape)
            parts[name] = page[at : at + size].view(dtype).view(number, *shape)
            at += size
        return parts


def keyframe_table(pose: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
    """Poses [..., 7] and kinds [...] as float32 [..., 4] = x, y in metres, heading in radians, kind; zeros where empty."""
    told = torch.cat([pose[..., :2], yaw(pose)[..., None], kind[..., None].float()], -1)
    return torch.where((kind > EMPTY)[..., None], told, 0.0)


def remembering_spec(spec: Spec, size: tuple[int, int], keyframes: int) -> Spec:
    """The spec of a world that remembers, with the channels of that: `known` [H, W], 1 where memory reconstructs what is
    shown and 0 where it is invented, and `keyframes` [N, 4] (keyframe_table), in which memory can be inspected."""
    shown: dict[str, spaces.Space] = {"known": spaces.Box(0, 1, size, np.float32)}
    if keyframes:
        shown["keyframes"] = spaces.Box(-np.inf, np.inf, (keyframes, 4), np.float32)
    channels = {name: space for name, space in spec.channels.items() if name != "keyframes"}
    units = {name: unit for name, unit in spec.units.items() if name != "keyframes"}
    units |= {"keyframes": "x and y in m, heading in rad, kind"} if keyframes else {}
    return replace(spec, channels={**channels, **shown}, units=units)
