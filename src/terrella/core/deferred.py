"""Deferred tensors of a state: computed when one is first read, once, however long the chain of steps behind it is.

A `Step` gives tensors from an earlier state (whose own may wait, too) and from tensors at hand. Picking entries of a state
that waits (`at`, `fork`, `put`, `where`, `stack`) makes a `Pick`, which computes only the entries that are asked for. Both
are pure: what they give does not depend on when it is read.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from .errors import ContractError

if TYPE_CHECKING:
    from .arena import Arena
    from .state import State


@dataclass(frozen=True)
class Step:
    """Tensors that `run(before, now)` gives: of an earlier State and of tensors `now` [B, ...] of the same batch."""

    run: Callable[[State, Mapping[str, torch.Tensor]], Mapping[str, torch.Tensor]]
    before: State
    now: Mapping[str, torch.Tensor]

    @property
    def batch(self) -> int:
        return self.before.batch

    @property
    def sources(self) -> tuple[State, ...]:
        return (self.before,)

    def ready(self) -> Step:
        """The same; a step needs its earlier state whole."""
        return self

    def at(self, rows: torch.Tensor) -> Step:
        """The entries `rows` alone."""
        return Step(self.run, self.before.at(rows), {name: tensor[rows] for name, tensor in self.now.items()})

    def found(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """The tensors; nothing that they need waits any more."""
        found = dict(self.run(self.before, self.now))
        if set(found) != set(names) or any(len(tensor) != self.batch for tensor in found.values()):
            shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
            raise ValueError(f"a deferred step owes {names} of batch {self.batch}; it gave {shapes}")
        return found


@dataclass(frozen=True)
class Pick:
    """The entries `index` [n] of several states, counted through all of them one after the other."""

    sources: tuple[State, ...]
    index: torch.Tensor

    @property
    def batch(self) -> int:
        return len(self.index)

    def ready(self) -> Pick:
        """The same of sources that hold no more than the picked entries."""
        index, kept, low, start = self.index.new_zeros(self.batch), [], 0, 0
        for source in self.sources:
            mine = (self.index >= low) & (self.index < low + source.batch)
            rows, place = torch.unique(self.index[mine] - low, return_inverse=True)
            low += source.batch
            if len(rows):
                index[mine] = start + place
                start += len(rows)
                kept.append(source if len(rows) == source.batch else source.narrowed(rows))
        if not kept:  # nothing is picked: one entry says what shapes nothing has
            some = next((source for source in self.sources if source.batch), self.sources[0])
            kept.append(some if some.batch < 2 else some.narrowed(index.new_zeros(1)))
        return Pick(tuple(kept), index)

    def at(self, rows: torch.Tensor) -> Pick:
        """The entries `rows` alone."""
        return Pick(self.sources, self.index[rows])

    def found(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """The tensors; nothing that they need waits any more."""
        if not len(self.index):
            return {name: self.sources[0][name][:0] for name in names}
        kinds = {name: {tuple(source[name].shape[1:]) for source in self.sources} for name in names}
        for name in (name for name in names if len(kinds[name]) > 1):
            raise ContractError(
                f"'{name}' has the shapes {sorted(kinds[name])} in these states; join those of one world."
            )
        return {name: torch.cat([source[name] for source in self.sources])[self.index] for name in names}


class Deferred:
    """The tensors `names` of a state, by a plan: Deferred(("rgb",), Step(draw, before, {"seed": seeds})).

    They are computed with the gradient mode in which this was made; then what they were made of is let go.
    """

    def __init__(self, names: Iterable[str], plan: Step | Pick):
        self.names, self.batch = tuple(names), plan.batch
        self._plan: Step | Pick | None = plan
        self._values: dict[str, torch.Tensor] | None = None
        self._lock = threading.Lock()
        self._modes = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
        waiting = [waits.length for source in plan.sources if (waits := source.deferred) is not None]
        self.length = 1 + max(waiting, default=0)  # of the chain behind it, at most

    @property
    def done(self) -> bool:
        return self._values is not None

    def values(self) -> dict[str, torch.Tensor]:
        """The tensors by name, [B, ...]; what they follow from is computed first, the oldest first."""
        stack = [] if self.done else [self]
        while stack:
            waiting = stack[-1]._waits_for()
            if waiting:
                stack += waiting
            else:
                stack.pop()._compute()
        assert self._values is not None
        return self._values

    def at(self, rows: torch.Tensor, arenas: Mapping[str, Arena]) -> Deferred:
        """The entries `rows` alone, without the work for the others; arenas: those that the tensors point into."""
        with self._lock:
            plan = self._plan
        if plan is None:  # another thread has computed it meanwhile
            plan = Pick((_whole(self.values(), arenas),), torch.arange(self.batch, device=rows.device))
        return Deferred(self.names, plan.at(rows))

    def _waits_for(self) -> list[Deferred]:
        """What has to be computed before this."""
        with self._lock:
            if self._plan is None:
                return []
            self._plan = self._plan.ready()
            return [waits for source in self._plan.sources if (waits := source.deferred) is not None]

    def _compute(self) -> None:
        with self._lock, torch.inference_mode(self._modes[0]), torch.set_grad_enabled(self._modes[1]):
            if self._plan is None:
                return
            found = self._plan.found(self.names)
            for name, arena in self._plan.sources[0].arenas.items():
                if name in found:
                    arena.hold(found[name])
            self._values, self._plan, self.length = found, None, 0


def _whole(values: Mapping[str, torch.Tensor], arenas: Mapping[str, Arena]) -> State:
    from .state import State

    return State(values, arenas)
