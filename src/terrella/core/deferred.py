"""Deferred tensors of a state: computed once, when one of them is first read.

A plan says how: a `Step` computes them from an earlier state (which may have deferred tensors itself) and from tensors at
hand; a `Pick` takes batch entries of several states and computes no others; `Ready` takes batch entries of values that
exist. `State.at`, `fork`, `put`, `where` and `stack` make Picks. The result of a plan does not depend on when it is read.
A chain of plans of any length is computed without recursion.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from .arena import Arena
from .errors import ContractError

Tensors = Mapping[str, torch.Tensor]


class PlanSource(Protocol):
    """The part of a State that plans read."""

    @property
    def batch(self) -> int: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def arenas(self) -> Mapping[str, Arena]: ...

    @property
    def deferred(self) -> Deferred | None: ...

    def __getitem__(self, name: str, /) -> torch.Tensor: ...

    def at(self, index: torch.Tensor) -> PlanSource: ...

    def narrowed(self, rows: torch.Tensor) -> PlanSource: ...


@dataclass(frozen=True)
class Step:
    """Tensors computed by `run(before, now)` from an earlier State and from tensors `now` [B, ...] of the same batch."""

    run: Callable[[Any, Tensors], Tensors]
    before: PlanSource
    now: Tensors

    @property
    def batch(self) -> int:
        return self.before.batch

    @property
    def device(self) -> torch.device:
        return self.before.device

    @property
    def arenas(self) -> Mapping[str, Arena]:
        return self.before.arenas

    @property
    def sources(self) -> tuple[PlanSource, ...]:
        return (self.before,)

    def narrowed(self) -> Step:
        """The step itself: it needs all of its earlier state."""
        return self

    def at(self, rows: torch.Tensor) -> Step:
        """The plan for the batch entries `rows` alone."""
        return Step(self.run, self.before.at(rows), {name: tensor[rows] for name, tensor in self.now.items()})

    def compute(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """The tensors; the sources must have no deferred tensors left."""
        values = dict(self.run(self.before, self.now))
        if set(values) != set(names) or any(len(tensor) != self.batch for tensor in values.values()):
            shapes = {name: tuple(tensor.shape) for name, tensor in values.items()}
            raise ValueError(f"a deferred step owes {names} of batch {self.batch}; it gave {shapes}")
        return values


@dataclass(frozen=True)
class Pick:
    """The batch entries `index` [n] of several states, which are counted one after the other."""

    sources: tuple[PlanSource, ...]
    index: torch.Tensor

    @property
    def batch(self) -> int:
        return len(self.index)

    @property
    def device(self) -> torch.device:
        return self.index.device

    @property
    def arenas(self) -> Mapping[str, Arena]:
        return self.sources[0].arenas

    def narrowed(self) -> Pick:
        """The same pick from sources that hold only the picked entries."""
        index, kept, low, start = self.index.new_zeros(self.batch), [], 0, 0
        for source in self.sources:
            mine = (self.index >= low) & (self.index < low + source.batch)
            rows, place = torch.unique(self.index[mine] - low, return_inverse=True)
            low += source.batch
            if len(rows):
                index[mine] = start + place
                start += len(rows)
                kept.append(source if len(rows) == source.batch else source.narrowed(rows))
        if not kept:  # nothing is picked: one entry still gives the shapes
            some = next((source for source in self.sources if source.batch), self.sources[0])
            kept.append(some if some.batch < 2 else some.narrowed(index.new_zeros(1)))
        return Pick(tuple(kept), index)

    def at(self, rows: torch.Tensor) -> Pick:
        """The plan for the batch entries `rows` alone."""
        return Pick(self.sources, self.index[rows])

    def compute(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """The tensors; the sources must have no deferred tensors left."""
        if not len(self.index):
            return {name: self.sources[0][name][:0] for name in names}
        kinds = {name: {tuple(source[name].shape[1:]) for source in self.sources} for name in names}
        for name in (name for name in names if len(kinds[name]) > 1):
            raise ContractError(f"'{name}' has the shapes {sorted(kinds[name])} here; join states of one world.")
        return {name: torch.cat([source[name] for source in self.sources])[self.index] for name in names}


@dataclass(frozen=True)
class Ready:
    """The batch entries `index` [n] of values [B, ...] that exist; `arenas` are those that the values point into."""

    values: Tensors
    arenas: Mapping[str, Arena]
    index: torch.Tensor
    sources: tuple[PlanSource, ...] = ()

    @property
    def batch(self) -> int:
        return len(self.index)

    @property
    def device(self) -> torch.device:
        return self.index.device

    def narrowed(self) -> Ready:
        """The plan itself: it has no sources."""
        return self

    def at(self, rows: torch.Tensor) -> Ready:
        """The plan for the batch entries `rows` alone."""
        return Ready(self.values, self.arenas, self.index[rows])

    def compute(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """The tensors."""
        return {name: self.values[name][self.index] for name in names}


class Deferred:
    """The tensors `names` of a state and the plan that computes them: Deferred(("rgb",), Step(draw, before, now)), once, under the
    gradient mode in which this object was made; then the plan is released. Thread-safe."""

    def __init__(self, names: Iterable[str], plan: Step | Pick | Ready):
        self.names, self.batch, self.device = tuple(names), plan.batch, plan.device
        self._plan: Step | Pick | Ready | None = plan
        self._values: dict[str, torch.Tensor] | None = None
        self._lock = threading.Lock()
        self._modes = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
        lengths = [earlier.length for source in plan.sources if (earlier := source.deferred) is not None]
        self.length = 1 + max(lengths, default=0)  # most plans in the chain that ends here

    @property
    def done(self) -> bool:
        """Whether the tensors have been computed."""
        return self._values is not None

    def values(self) -> dict[str, torch.Tensor]:
        """The tensors by name, [B, ...]; computes the chain behind them first, oldest first."""
        stack = [] if self.done else [self]
        while stack:
            if earlier := stack[-1]._uncomputed_sources():
                stack += earlier
            else:
                stack.pop()._compute()
        assert self._values is not None
        return self._values

    def at(self, rows: torch.Tensor, arenas: Mapping[str, Arena]) -> Deferred:
        """The batch entries `rows`, computed without the others; `arenas` are those that the tensors point into."""
        with self._lock:
            plan = self._plan
        if plan is None:  # another thread has computed it meanwhile
            plan = Ready(self.values(), arenas, torch.arange(self.batch, device=rows.device))
        return Deferred(self.names, plan.at(rows))

    def _uncomputed_sources(self) -> list[Deferred]:
        with self._lock:
            if self._plan is None:
                return []
            self._plan = self._plan.narrowed()
            return [earlier for source in self._plan.sources if (earlier := source.deferred) is not None]

    def _compute(self) -> None:
        with self._lock, torch.inference_mode(self._modes[0]), torch.set_grad_enabled(self._modes[1]):
            if self._plan is None:
                return
            values = self._plan.compute(self.names)
            for name, arena in self._plan.arenas.items():
                if name in values:
                    arena.hold(values[name])
            self._values, self._plan, self.length = values, None, 0
