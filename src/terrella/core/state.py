"""State: a frozen, batched value that can be indexed, stacked, forked, saved and restored."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from .arena import Arena
from .deferred import Deferred, Pick
from .errors import CheckpointError, ContractError

_ARENA = "arena:"  # prefix of the names of an arena's parts in a file


class State(Mapping):
    """Named tensors that lead with one batch axis; a value that never changes.

        state["pose"]                read a tensor
        state.at(i)                  batch entries i (an int, a slice or an index tensor); the batch axis stays
        state.replace(pose=...)      a new state with other tensors
        state.fork(n)                each entry n times
        State.stack([a, b])          states joined along the batch axis

    arenas:   pointer tensor (int64 row numbers, 0 for none) -> the Arena that holds the rows.
    deferred: further tensors, computed when one of them is first read.
    """

    __slots__ = ("_tensors", "_arenas", "_deferred", "_names", "__weakref__")

    def __init__(
        self,
        tensors: Mapping[str, torch.Tensor],
        arenas: Mapping[str, Arena] | None = None,
        deferred: Deferred | None = None,
    ):
        late = () if deferred is None else tuple(name for name in deferred.names if name not in tensors)
        sizes = {name: (tensor.shape[0] if tensor.ndim else None) for name, tensor in tensors.items()}
        sizes |= {name: deferred.batch for name in late if deferred is not None}
        if not sizes:
            raise ValueError("a State needs at least one tensor")
        if None in sizes.values() or len(set(sizes.values())) != 1:
            raise ValueError(f"every tensor of a State leads with the same batch axis; got {sizes}")
        arenas = {name: arena for name, arena in (arenas or {}).items() if name in sizes}
        for name, arena in arenas.items():
            if name in tensors:
                arena.hold(tensors[name])
        object.__setattr__(self, "_tensors", MappingProxyType(dict(tensors)))
        object.__setattr__(self, "_arenas", MappingProxyType(arenas))
        object.__setattr__(self, "_deferred", deferred if late else None)
        object.__setattr__(self, "_names", tuple(sizes))

    def __setattr__(self, name, value):
        raise AttributeError("a State is a value: use state.replace(name=tensor)")

    def __getitem__(self, name: str) -> torch.Tensor:
        if name in self._tensors:
            return self._tensors[name]
        if name not in self._names:
            raise KeyError(name)
        return self._deferred.values()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __eq__(self, other) -> bool:
        """Whether both have the same names and tensors, bit for bit; pointers are compared by the rows that they point at."""
        return (
            isinstance(other, State)
            and set(self) == set(other)
            and all(_same(self[name], other[name]) for name in self if name not in self._arenas)
            and all(_same_rows(self, other, name) for name in self._arenas)
        )

    __hash__ = None

    def __repr__(self) -> str:
        shown = [f"{name}{list(tensor.shape)}" for name, tensor in self._tensors.items()]
        shown += [f"{name}[{self.batch}, not yet computed]" for name in self._names if name not in self._tensors]
        return f"State({', '.join(shown)})"

    @property
    def batch(self) -> int:
        """The number of batch entries."""
        return len(next(iter(self._tensors.values()))) if self._tensors else self._deferred.batch

    @property
    def device(self) -> torch.device:
        """The device of the tensors, also of those that are deferred."""
        return next(iter(self._tensors.values())).device if self._tensors else self._deferred.device

    @property
    def arenas(self) -> Mapping[str, Arena]:
        """Pointer tensor -> the arena that it points into."""
        return self._arenas

    @property
    def deferred(self) -> Deferred | None:
        """The plan of the tensors that have not been computed; None where all have."""
        return None if self._deferred is None or self._deferred.done else self._deferred

    @property
    def nbytes(self) -> int:
        """Bytes of the computed tensors, without the arenas; an axis expanded by `fork` counts once."""
        ready = [self[name] for name in self._names if name in self._tensors or self.deferred is None]
        sizes = ([n for n, stride in zip(part.shape, part.stride()) if stride or not n] for part in ready)
        return sum(part.element_size() * int(np.prod(size, dtype=np.int64)) for part, size in zip(ready, sizes))

    def replace(self, **tensors: torch.Tensor) -> State:
        """A state with these tensors in place of its own, or beside them."""
        return State({**self._tensors, **tensors}, self._arenas, self._deferred)

    def at(self, index) -> State:
        """The batch entries `index` (int, slice, list, bool or int64 tensor), as a State with a batch axis."""
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        elif isinstance(index, torch.Tensor) and index.ndim == 0:
            index = index.reshape(1)
        return self._combined([self], lambda tensor: tensor[index], lambda rows: rows[index])

    def fork(self, n: int) -> State:
        """Each batch entry n times in a row: [a, b].fork(2) is [a, a, b, b]. Copies of a single entry take no memory."""
        if self.batch == 1:
            expand = lambda tensor: tensor.expand(n, *tensor.shape[1:])  # noqa: E731
            return self._combined([self], expand, expand)
        return self._combined([self], *[lambda tensor: tensor.repeat_interleave(n, dim=0)] * 2)

    def where(self, which: torch.Tensor, other: State) -> State:
        """Entries of this state where `which` (bool [B]) is True, entries of `other` elsewhere."""
        other = other.into(self._arenas)

        def choose(mine: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
            return torch.where(which.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)

        return self._combined([self, other], choose, choose)

    def put(self, index, fresh: State) -> State:
        """This state with its entries `index` (int64 [n], or bool [B]) replaced by the n entries of `fresh`."""
        where = torch.as_tensor(index, device=self.device)
        where = where.nonzero()[:, 0] if where.dtype == torch.bool else where.long()
        if fresh.batch != len(where) or set(fresh) != set(self):
            raise ValueError(f"put takes {len(where)} fresh entries of the same world; got {fresh}")

        def put(mine: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
            return mine.index_copy(0, where, theirs)

        return self._combined([self, fresh.into(self._arenas)], put, put)

    def mixed(self, where: torch.Tensor, other: State) -> State:
        """This state with its entries `where` (bool [B]) replaced by those of `other` [B]: `put` without waiting for how many."""
        if set(other) != set(self) or self.deferred is not None or self._arenas:
            raise ValueError("mixed takes two states of tensors alone, of the same world")

        def mix(mine: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
            return mine if mine is theirs else torch.where(where.view(-1, *[1] * (mine.ndim - 1)), theirs, mine)

        return State({name: mix(mine, other[name]) for name, mine in self.items()})

    @staticmethod
    def stack(states: Sequence[State]) -> State:
        """States joined along the batch axis."""
        if not states:
            raise ValueError("nothing to stack")
        first = states[0]
        adopted = [first, *(state.into(first.arenas) for state in states[1:])]
        return first._combined(adopted, *[lambda *tensors: torch.cat(tensors)] * 2)

    def into(self, arenas: Arena | Mapping[str, Arena]) -> State:
        """The same state with its rows in the given arenas (one for all pointers, or by pointer); copies rows of other arenas.
        ContractError where an arena has another layout."""
        changed = {}
        for name, mine in self._arenas.items():
            arena = arenas if isinstance(arenas, Arena) else arenas.get(name, mine)
            if arena is not mine:
                changed[name] = arena, arena.adopt(self[name], mine)
        if not changed:
            return self
        held = {**self._arenas, **{name: arena for name, (arena, _) in changed.items()}}
        tensors = {**self._tensors, **{name: pointer for name, (_, pointer) in changed.items()}}
        return State(tensors, held, self._deferred)

    def to(self, device) -> State:
        """The state on another device, with its rows in arenas there."""
        target = torch.device(device)
        away = {name: arena for name, arena in self._arenas.items() if arena.device != target}
        state = self.into({name: Arena(arena.parts, target) for name, arena in away.items()})
        return State({name: tensor.to(target) for name, tensor in state.items()}, state.arenas)

    def narrowed(self, rows: torch.Tensor) -> State:
        """`at(rows)` that plans deferred tensors for these entries alone, without a reference to the whole state."""
        deferred = self.deferred
        if deferred is None:
            return self.at(rows)
        return State(
            {name: tensor[rows] for name, tensor in self._tensors.items()},
            self._arenas,
            deferred.at(rows, self._arenas),
        )

    def save(self, path: str | Path) -> None:
        """Writes one safetensors file that includes the rows pointed at."""
        tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in self.items()}
        for name, arena in self._arenas.items():
            with_zero = torch.cat([tensors[name].new_zeros(1), tensors[name].flatten()])
            rows, place = torch.unique(with_zero, return_inverse=True)
            tensors[name] = place[1:].view(tensors[name].shape)
            for part in arena.parts:
                tensors[f"{_ARENA}{name}:{part}"] = arena.read(part)[rows[1:].to(arena.device)].cpu()
        about = {"kind": "state", "arenas": {name: list(arena.parts) for name, arena in self._arenas.items()}}
        save_file(tensors, str(path), metadata={"terrella": json.dumps(about)})

    @staticmethod
    def load(path: str | Path) -> State:
        """Reads a file of `save`, into new arenas; CheckpointError where it is missing or no saved state."""
        try:
            with safe_open(str(path), framework="pt") as file:
                meta = json.loads((file.metadata() or {}).get("terrella", "{}"))
                if not isinstance(meta, dict) or meta.get("kind") != "state":
                    raise CheckpointError(f"{path} is a safetensors file but holds no Terrella state.")
                tensors = {name: file.get_tensor(name) for name in file.keys() if not name.startswith(_ARENA)}
                arenas = {}
                for name, parts in meta.get("arenas", {}).items():
                    rows = {part: file.get_tensor(f"{_ARENA}{name}:{part}") for part in parts}
                    kinds = {part: (value.dtype, tuple(value.shape[1:])) for part, value in rows.items()}
                    arenas[name] = Arena(kinds, room=1 + max(len(value) for value in rows.values()))
                    held = arenas[name].keep(rows)  # in an arena without a past they are numbered from 1
                    if int(tensors[name].max()) > len(held) or int(tensors[name].min()) < 0:
                        raise CheckpointError(f"{path} points at rows that it does not hold.")
                    tensors[name] = torch.cat([held.new_zeros(1), held])[tensors[name]]
                return State(tensors, arenas)
        except (OSError, SafetensorError, ValueError, KeyError, ContractError) as error:
            raise CheckpointError(f"{path} is not a saved state ({error}); write one with state.save(path).") from error

    # -- inside -------------------------------------------------------------------------------------------------------

    def _combined(
        self, states: Sequence[State], combine: Callable[..., torch.Tensor], pick: Callable[..., torch.Tensor]
    ) -> State:
        """`combine` of the computed tensors; for tensors deferred in any state, a Pick of the entries that `pick` selects."""
        if any(set(state) != set(self) for state in states):
            raise ValueError("only states of the same world can be stacked, put or mixed")
        for name in self._tensors:
            kinds = {tuple(state[name].shape[1:]) for state in states if name in state._tensors}
            if len(kinds) > 1:
                raise ContractError(f"'{name}' has the shapes {sorted(kinds)} here; join states of one world.")
        late = {name for state in states if state.deferred is not None for name in state if name not in state._tensors}
        tensors = {name: combine(*(state[name] for state in states)) for name in self if name not in late}
        if not late:
            return State(tensors, self._arenas)
        ends = np.cumsum([state.batch for state in states]).tolist()
        numbers = [torch.arange(end - state.batch, end, device=self.device) for state, end in zip(states, ends)]
        plan = Pick(tuple(states), pick(*numbers))
        return State(tensors, self._arenas, Deferred([name for name in self if name in late], plan))


def memory_of(states: Sequence[State]) -> dict[Hashable, int]:
    """The bytes of each storage of a tensor (by address) and of each arena row that the states keep alive, each once."""
    held: dict[Hashable, int] = {}
    for state in states:
        for tensor in state.values():
            storage = tensor.untyped_storage()
            held[storage.data_ptr()] = storage.nbytes()
        for name, arena in state.arenas.items():
            rows = torch.unique(state[name]).tolist()
            held |= {(id(arena), row): arena.row_bytes for row in rows if row}  # row 0 is empty
    return held


def _same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


def _same_rows(one: State, other: State, name: str) -> bool:
    """Whether two pointer tensors are 0 at the same places and point at equal rows elsewhere."""
    if name not in other.arenas or not one.arenas[name].same_layout(other.arenas[name]):
        return False
    mine, theirs = one[name], other[name]
    if mine.shape != theirs.shape or not torch.equal(mine > 0, theirs > 0):
        return False
    some = mine > 0
    pairs = ((one.arenas[name].read(part)[mine[some]], other.arenas[name].read(part)[theirs[some]])
             for part in one.arenas[name].parts)  # fmt: skip
    return all(_same(a, b) for a, b in pairs)
