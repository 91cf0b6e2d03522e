"""Memory: the posed RGB-D keyframes that an episode has observed and imagined, within a byte budget.

Observations are always kept, imagined frames only if their view is new and mostly invented. A full memory drops the keyframe whose
view the others cover best (an observation is covered by observations only), imagined ones and old ones first."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch

from ..core.arena import Arena
from ..core.backend import constant, kernels_do, where
from ..core.errors import ContractError
from ..core.state import State
from .camera import Intrinsics, turn_between, yaw
from .floorplan import NOWHERE, WALLS
from .kernels_numba import recall as kernels
from .keyframes import COARSE, Glimpse, Keyframes, LastFrames, look_and_carry, retrieve, vote_slowly
from .patches import patch_count
from .views import arrays, over_views

EMPTY, RECORDED, OBSERVED, DREAMT = range(4)  # kinds of keyframes
PAGE = 16  # the capacity of a memory is a multiple of this, if it is larger
_EVERY = 11  # coverage is measured at every 11th coarse patch of a keyframe
_ALIKE = 0.02  # smaller differences of coverage do not count

ROWS = "memory_rows"  # the pointer into the arena: where an episode's keyframes lie
Held = Mapping[str, torch.Tensor]  # a State, or the part of one that is memory's: the tensors of `Memory.empty`


@dataclass(frozen=True)
class Memory:
    """The rules of a memory; the keyframes of an episode are rows of an arena, to which its State points.

    camera: intrinsics of all keyframes; size: height and width of their pictures; budget_mb: MiB of one episode; new_view: metres
    and radians: a view is new if its distances from each keyframe, in these units, add up to more than 1; known_enough: imagined
    frames of which memory knows a larger share are not kept; device: where the arena lies."""

    camera: Intrinsics
    size: tuple[int, int] = (96, 128)
    budget_mb: float = 16.0
    new_view: tuple[float, float] = (0.4, 0.2)
    known_enough: float = 0.95
    device: str = "cpu"

    def __post_init__(self):
        if not 0 <= self.budget_mb < float("inf"):
            raise ContractError(f"a memory's budget is 0 MiB or more; got {self.budget_mb}.")

    @cached_property
    def _arena(self) -> Arena:
        height, width = self.size
        parts = {
            "rgb": (torch.uint8, (3, height, width)), "depth": (torch.float32, (height, width)),
            "pose": (torch.float32, (7,)), "turn": (torch.float32, (3, 3)), "walls": (torch.float32, (WALLS, 4)),
            "coarse": (torch.float32, (patch_count(self.size, COARSE), 9)),
        }  # fmt: skip
        return Arena(parts, self.device)

    @property
    def arenas(self) -> dict[str, Arena]:
        """For the State that is made of `empty`."""
        return {ROWS: self._arena}

    @cached_property
    def keyframe_bytes(self) -> int:
        """Bytes of a keyframe: its row of the arena, and its pose, kind, age and row number in the state."""
        return self._arena.row_bytes + 7 * 4 + 1 + 8 + 8

    @cached_property
    def capacity(self) -> int:
        """Keyframes that the budget has room for."""
        room = int(self.budget_mb * 2**20) // self.keyframe_bytes
        return room if room < PAGE else room // PAGE * PAGE

    @property
    def nbytes(self) -> int:
        """Bytes of one episode's memory when it is full."""
        return self.capacity * self.keyframe_bytes

    def empty(self, batch: int) -> dict[str, torch.Tensor]:
        """The tensors of empty memories."""
        kinds = {"pose": torch.float32, "kind": torch.uint8, "born": torch.int64, "rows": torch.int64}
        shape = batch, self.capacity
        return {
            f"memory_{name}": torch.zeros(*shape, *([7] if name == "pose" else []), dtype=dtype, device=self.device)
            for name, dtype in kinds.items()
        }

    def of(self, state: Held) -> dict[str, torch.Tensor]:
        """The tensors of memory in `state`."""
        return {name: state[name] for name in self.empty(0)}

    def adopted(self, state: State) -> State:
        """`state` with its keyframes in this memory's arena. ContractError for another layout."""
        arena = state.arenas.get(ROWS)
        if arena is self._arena or (arena is None and ROWS in state):
            return state
        if arena is None:
            raise ContractError("the state has no memory, so it is not of this world; begin with start or observe.")
        slots = state[ROWS].shape[1]
        if slots != self.capacity or not arena.same_layout(self._arena):
            raise ContractError(
                f"the state's memory ({slots} keyframes) has another layout than the world's ({self.capacity} of "
                f"{self.size[0]} x {self.size[1]} pixels); give it to a world with the memory that it was made with."
            )
        return state.into(self.arenas)

    def count(self, held: Held) -> torch.Tensor:
        """Keyframes held by each episode: [B]."""
        return (held["memory_kind"] > EMPTY).sum(1)

    def table(self, held: Held) -> torch.Tensor:
        """float32 [B, capacity, 4]: x, y in metres, heading in radians, kind; the channel `places`."""
        return keyframe_table(held["memory_pose"], held["memory_kind"])

    # -- keeping ------------------------------------------------------------------------------------------------------

    def observed(
        self, held: Held, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The changed tensors after an observation: rgb uint8 [B, 3, H, W], depth [B, H, W] metres, pose [B, 7]."""
        return self._keep(held, OBSERVED, rgb, depth, pose, torch.ones(len(rgb), dtype=torch.bool, device=rgb.device))

    def dreamt(
        self, held: Held, rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, known: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The same for imagined frames, `known` [B, H, W] in 0..1 of memory: only new and mostly invented ones are kept."""
        return self._keep(held, DREAMT, rgb, depth, pose, known.mean((1, 2)) < self.known_enough)

    def nearest(self, held: Held, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The distance [B] from `pose` [B, 7] to the nearest keyframe, above 1 for a new view, and that keyframe's slot [B]."""
        far, turn = self.new_view
        kept = held["memory_pose"]
        away = torch.linalg.vector_norm(kept[..., :3] - pose[:, None, :3], dim=-1)
        away = torch.add(away, turn_between(pose, kept), alpha=far / turn)
        least, slot = where(held["memory_kind"] > EMPTY, away, torch.inf).min(1)
        return least / far, slot

    def _keep(self, held: Held, kind: int, rgb, depth, pose, which: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.capacity:
            return {}
        apart, nearest = self.nearest(held, pose)
        new = apart > 1
        which = which if kind == OBSERVED else which & new
        parts = held["memory_kind"], held["memory_born"], held[ROWS], apart, nearest, new, rgb, depth, pose
        views = None
        if kernels_do(pose):  # elsewhere it costs less to write all rows than to ask how many there are
            views = which.nonzero()[:, 0]
            if not len(views):
                return {}
            parts = tuple(part[views] for part in parts)
        kinds, born, rows, _, nearest, new, rgb, depth, pose = parts
        made = Keyframes.of(rgb, depth, pose, self.camera, fine=False)
        arena = self._arena_of(held)
        slot = torch.where(new, self._room(held, kinds, born, rows, new), nearest)
        rows = arena.keep({name: vars(made)[name] for name in arena.parts})
        fresh = {
            "memory_pose": pose, "memory_kind": constant(_kind, pose.device, kind).expand(len(slot)),
            "memory_born": born.amax(1) + 1, ROWS: rows,
        }  # fmt: skip
        if views is not None:
            changed = {name: held[name].index_put((views, slot), value) for name, value in fresh.items()}
        else:
            here = (constant(torch.arange, pose.device, self.capacity) == slot[:, None]) & which[:, None]
            changed = {
                name: torch.where(here if value.ndim == 1 else here[..., None], value[:, None], held[name])
                for name, value in fresh.items()
            }
        arena.hold(changed[ROWS])
        return changed

    def _room(
        self, held: Held, kind: torch.Tensor, born: torch.Tensor, rows: torch.Tensor, wanted: torch.Tensor
    ) -> torch.Tensor:
        """A slot for a new keyframe of each of n memories, of which kind, born and rows [n, capacity] are the tensors: a free one
        or, where `wanted` [n], that of the keyframe to drop."""
        lowest, slot = kind.min(1)  # EMPTY is the lowest kind
        full = wanted & (lowest != EMPTY)
        some = None
        if kernels_do(kind):
            some = full.nonzero()[:, 0]
            if not len(some):
                return slot
            kind, born, rows = kind[some], born[some], rows[some]
        dreamt = kind == DREAMT
        covered = self.covered(held, rows, dreamt)
        best = covered > covered.amax(1, keepdim=True) - _ALIKE
        age = torch.where(dreamt, born, born + 2**62)
        forgotten = where(best, age, 2**63 - 1).argmin(1)
        return torch.where(full, forgotten, slot) if some is None else slot.index_put((some,), forgotten)

    def covered(self, held: Held, rows: torch.Tensor, dreamt: torch.Tensor) -> torch.Tensor:
        """The share [n, capacity] of the view of each keyframe that others cover, in full memories whose keyframes are `rows`
        [n, capacity], imagined ones where `dreamt` [n, capacity]: the mean over points of its surfaces of the best vote of
        another keyframe."""
        if not kernels_do(rows):
            return self.covered_slowly(held, rows, dreamt)
        keys, share = self._keyframes(held), torch.zeros(rows.shape)
        given = arrays(keys.coarse, keys.depth, keys.turn, keys.pose, rows, dreamt)
        parts = [*given, self.camera, _EVERY, share.numpy()]
        over_views(len(rows), lambda first, last: kernels.covered(first, last, *parts))
        return share

    def covered_slowly(self, held: Held, rows: torch.Tensor, dreamt: torch.Tensor) -> torch.Tensor:
        """The same as `covered`, in plain tensor algebra, also for GPUs."""
        keys, count = self._keyframes(held), self.capacity
        points = keys.coarse[:, ::_EVERY, :3][rows].flatten(1, 2)
        votes = vote_slowly(None, keys, rows, points, None, self.camera)
        others = (dreamt[:, None, :] >= dreamt[:, :, None]) > constant(_itself, rows.device, count)
        return (votes.unflatten(2, (count, -1)) * others[..., None]).amax(1).mean(2)

    # -- recalling ----------------------------------------------------------------------------------------------------

    def keyframes(self, held: Held, view: int) -> Keyframes:
        """A copy of the keyframes of one episode, without fine patches."""
        return self._keyframes(held).at(held[ROWS][view][held["memory_kind"][view] > EMPTY])

    def walls(self, held: Held, dreamt: bool = True) -> torch.Tensor:
        """The walls [B, n, 4] in the keyframes (floorplan.py), NOWHERE in empty rows; `dreamt`: with imagined keyframes."""
        rows, kind = held[ROWS], held["memory_kind"]
        counts = kind > EMPTY if dreamt else (kind > EMPTY) & (kind != DREAMT)
        return where(counts[..., None, None], self._arena_of(held).read("walls")[rows], NOWHERE).flatten(1, 2)

    def look(
        self, held: Held, pose: torch.Tensor, sources: int = 6, slots: int = 3, recorded: Keyframes | None = None
    ) -> Glimpse:
        """What is known of the views from `pose` [B, 7], by memory and by `recorded` keyframes that all episodes share. At most
        `sources` keyframes are used for a view, and at most `slots` for a pixel."""
        return self.look_and_carry(held, pose, None, sources, slots, recorded)[0]

    def look_and_carry(
        self, held: Held, pose: torch.Tensor, last: LastFrames, sources: int, slots: int,
        recorded: Keyframes | None,
    ) -> tuple[Glimpse, torch.Tensor | None]:  # fmt: skip
        """`look`, and what the last frames show (see keyframes.look_and_carry)."""
        shared = Keyframes.none(self.size, pose.device) if recorded is None else recorded
        rows = held[ROWS]  # before the arena is read: what waits may be written there
        own = self._keyframes(held)
        picks = retrieve(shared, pose, self.camera, self.size, sources, own, rows)
        return look_and_carry(shared, picks, pose, self.camera, self.size, slots, own, last)

    def _arena_of(self, held: Held) -> Arena:
        return held.arenas.get(ROWS, self._arena) if isinstance(held, State) else self._arena

    def _keyframes(self, held: Held) -> Keyframes:
        """All rows of the arena, without fine patches; nothing is copied."""
        arena = self._arena_of(held)
        parts = {name: arena.read(name) for name in arena.parts}
        return Keyframes(fine=parts["coarse"][:, :0], **parts)


def keyframe_table(pose: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
    """float32 [..., 4] = x, y in metres, heading in radians, kind, from poses [..., 7] and kinds [...]; zeros in empty slots."""
    row = torch.cat([pose[..., :2], yaw(pose)[..., None], kind[..., None].float()], -1)
    return torch.where((kind > EMPTY)[..., None], row, 0.0)


def _kind(number: int) -> torch.Tensor:
    return torch.tensor(number, dtype=torch.uint8)


def _itself(count: int) -> torch.Tensor:
    return torch.eye(count, dtype=torch.bool)
