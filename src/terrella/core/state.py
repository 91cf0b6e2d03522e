"""State: a frozen, batched value that can be indexed, stacked, forked, saved and restored."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from .errors import CheckpointError


class State(Mapping):
    """Named tensors that all lead with the same batch axis; never changed in place.

    `state["pose"]` reads one tensor, `state.at(i)` picks batch entries (int, slice or index tensor; the batch
    axis stays), `state.replace(pose=...)` makes a new value, `state.fork(n)` repeats each entry n times.
    """

    __slots__ = ("_tensors",)

    def __init__(self, tensors: Mapping[str, torch.Tensor]):
        if not tensors:
            raise ValueError("a State needs at least one tensor")
        sizes = {name: (tensor.shape[0] if tensor.ndim else None) for name, tensor in tensors.items()}
        if None in sizes.values() or len(set(sizes.values())) != 1:
            raise ValueError(f"every tensor of a State leads with the same batch axis; got {sizes}")
        object.__setattr__(self, "_tensors", MappingProxyType(dict(tensors)))

    def __setattr__(self, name, value):
        raise AttributeError("a State is a value: use state.replace(name=tensor)")

    def __getitem__(self, name: str) -> torch.Tensor:
        return self._tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)

    def __eq__(self, other) -> bool:
        """The same names with the same tensors, bit for bit."""
        return (
            isinstance(other, State)
            and set(self) == set(other)
            and all(_same(self[name], other[name]) for name in self)
        )

    __hash__ = None

    def __repr__(self) -> str:
        inside = ", ".join(f"{name}{list(tensor.shape)}" for name, tensor in self.items())
        return f"State({inside})"

    @property
    def batch(self) -> int:
        return next(iter(self._tensors.values())).shape[0]

    @property
    def nbytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self.values())

    def replace(self, **tensors: torch.Tensor) -> State:
        return State({**self._tensors, **tensors})

    def at(self, index) -> State:
        """Batch entries `index` (int, slice, list or index tensor) as a State that still has a batch axis."""
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        elif isinstance(index, torch.Tensor) and index.ndim == 0:
            index = index.reshape(1)
        return State({name: tensor[index] for name, tensor in self.items()})

    def fork(self, n: int) -> State:
        """Each batch entry n times in a row: [a, b].fork(2) = [a, a, b, b]."""
        return State({name: tensor.repeat_interleave(n, dim=0) for name, tensor in self.items()})

    def put(self, index: torch.Tensor, fresh: State) -> State:
        """This state with its entries `index` (int64 [n]) replaced by those of `fresh` (a batch of n)."""
        if fresh.batch != len(index) or set(fresh) != set(self):
            raise ValueError(f"put takes {len(index)} fresh entries of the same world; got {fresh}")
        return State({name: tensor.index_copy(0, index, fresh[name]) for name, tensor in self.items()})

    def where(self, which: torch.Tensor, other: State) -> State:
        """This state's entries where `which` (bool [B]), the other's elsewhere."""
        flags = {name: which.view(-1, *[1] * (tensor.ndim - 1)) for name, tensor in other.items()}
        return State({name: torch.where(flags[name], self[name], tensor) for name, tensor in other.items()})

    @staticmethod
    def stack(states: Sequence[State]) -> State:
        """States joined along the batch axis."""
        if not states:
            raise ValueError("nothing to stack")
        names = set(states[0])
        if any(set(state) != names for state in states):
            raise ValueError("only states of the same world can be stacked")
        return State({name: torch.cat([state[name] for state in states]) for name in states[0]})

    def to(self, device) -> State:
        return State({name: tensor.to(device) for name, tensor in self.items()})

    def save(self, path: str | Path) -> None:
        """Writes one safetensors file."""
        tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in self.items()}
        save_file(tensors, str(path), metadata={"terrella": json.dumps({"kind": "state"})})

    @staticmethod
    def load(path: str | Path) -> State:
        """Reads what `save` wrote; CheckpointError where the file is missing or foreign."""
        try:
            with safe_open(str(path), framework="pt") as file:
                meta = json.loads((file.metadata() or {}).get("terrella", "{}"))
                if not isinstance(meta, dict) or meta.get("kind") != "state":
                    raise CheckpointError(f"{path} is a safetensors file but holds no Terrella state.")
                return State({name: file.get_tensor(name) for name in file.keys()})
        except (OSError, SafetensorError, ValueError) as error:
            raise CheckpointError(f"{path} is not a saved state ({error}); write one with state.save(path).") from error


def _same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)
