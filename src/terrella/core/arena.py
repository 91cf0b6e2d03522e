"""Arena: shared storage of large immutable rows. States hold row numbers; rows that no state holds are reused.

Row 0 is reserved: it is all zeros and means "none". A row is written once. Before an arena grows, it marks the rows that
living pointer tensors hold (by weak references to these) and frees the others.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch

from .errors import ContractError

Parts = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]  # name -> dtype and shape of one row


class Arena:
    """Rows of several parts, `parts[name]` = (dtype, shape), on one device; safe to share between threads."""

    def __init__(self, parts: Parts, device: torch.device | str = "cpu", room: int = 64):
        self.parts = {name: (dtype, tuple(shape)) for name, (dtype, shape) in parts.items()}
        self.device = torch.device(device)
        self._lock = threading.RLock()
        self._pointers: dict[int, weakref.ref[torch.Tensor]] = {}
        # the rows that each thread wrote last: it may still be building a state of them
        self._newest = threading.local()
        self._crowd = 1000  # number of noted pointers above which dead ones are dropped
        with torch.inference_mode(False):
            self._rows = {name: self._blank(name, room) for name in self.parts}
            self._free = torch.arange(1, room, device=self.device)

    def __repr__(self) -> str:
        return f"Arena({', '.join(self.parts)}: {self.capacity} rows on {self.device})"

    @property
    def capacity(self) -> int:
        """Rows that fit before the arena grows."""
        return len(next(iter(self._rows.values())))

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return sum(dtype.itemsize * torch.Size(shape).numel() for dtype, shape in self.parts.values())

    def same_layout(self, other: Arena) -> bool:
        """Whether another arena has the same parts."""
        return self.parts == other.parts

    def read(self, name: str) -> torch.Tensor:
        """All rows of one part, [capacity, ...]: read only, and only rows that a living pointer tensor holds."""
        return self._rows[name]

    def keep(self, values: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Writes n new rows, `values[name]` [n, ...] for every part; returns their numbers, int64 [n].

        The rows last while the returned tensor or another held pointer (see `hold`; a State holds its pointers) lives, and
        at least until this thread calls `keep` again. ContractError where the values do not fit the parts.
        """
        if set(values) != set(self.parts):
            raise ContractError(f"this arena keeps {', '.join(self.parts)}; got {', '.join(values)}.")
        sizes = {len(value) for value in values.values()}
        fits = all(tuple(value.shape[1:]) == self.parts[name][1] for name, value in values.items())
        if len(sizes) != 1 or not fits:
            shapes = {name: tuple(value.shape) for name, value in values.items()}
            raise ContractError(f"every part needs n rows of its shape, {self.parts}; got {shapes}.")
        count = sizes.pop()
        with self._lock, torch.inference_mode(False), torch.no_grad():
            rows = getattr(self._newest, "given", None)
            rows = self.reserve(count) if rows is None else rows
            for name, value in values.items():
                self._rows[name].index_copy_(0, rows, value.detach().to(self._rows[name]))
            return rows

    def reserve(self, count: int) -> torch.Tensor:
        """The numbers of `count` rows that are free, int64 [count]; they last as those of `keep` do."""
        with self._lock, torch.inference_mode(False), torch.no_grad():
            self.make_room(count)
            rows, self._free = self._free[:count], self._free[count:]
            self._newest.rows = rows
            return self.hold(rows)

    def make_room(self, count: int) -> None:
        """Frees rows, and grows the arena where fewer than `count` are free."""
        with self._lock, torch.inference_mode(False), torch.no_grad():
            if count > len(self._free):
                self._sweep(count)

    @contextmanager
    def writing_to(self, rows: torch.Tensor) -> Iterator[None]:
        """Inside, `keep` in this thread writes to these rows, which were reserved: for steps that are traced once and run often."""
        self._newest.given = rows
        try:
            yield
        finally:
            self._newest.given = None

    def hold(self, pointer: torch.Tensor) -> torch.Tensor:
        """Keeps the rows in `pointer` (int64 of any shape) for as long as that tensor lives; returns it."""
        with self._lock:
            self._pointers[id(pointer)] = weakref.ref(pointer)
            if len(self._pointers) > self._crowd:
                self._living()
        return pointer

    def used(self) -> torch.Tensor:
        """bool [capacity]: the rows that living pointer tensors hold."""
        marks = torch.zeros(self.capacity, dtype=torch.bool, device=self.device)
        with self._lock:
            for pointer in self._living():
                marks[_distinct(pointer).reshape(-1)] = True
        marks[0] = True
        return marks

    def adopt(self, pointer: torch.Tensor, other: Arena) -> torch.Tensor:
        """Copies the rows in `pointer` from another arena; returns their numbers here, in the shape of `pointer`."""
        if other is self:
            return pointer
        if not self.same_layout(other):
            raise ContractError(f"the state's memory has another layout, {other.parts}, than the world's {self.parts}.")
        rows, where = torch.unique(pointer, return_inverse=True)
        rows, where = (rows[1:], where) if len(rows) and rows[0] == 0 else (rows, where + 1)
        new = self.keep({name: other.read(name)[rows].to(self.device) for name in self.parts})
        return self.hold(torch.cat([new.new_zeros(1), new])[where.to(self.device)])

    def _living(self) -> list[torch.Tensor]:
        """The pointer tensors that still live; drops the others."""
        entries = [(key, ref, ref()) for key, ref in self._pointers.items()]
        self._pointers = {key: ref for key, ref, pointer in entries if pointer is not None}
        self._crowd = 1000 + 2 * len(self._pointers)
        return [pointer for _, _, pointer in entries if pointer is not None]

    def _sweep(self, count: int) -> None:
        """Frees the rows that no pointer holds; grows the arena where fewer than `count`, or few, are free."""
        before = self.capacity
        if self.device.type == "meta":  # which has no values
            free = self._free[:0]
        else:
            free = (~self.used()).nonzero()[:, 0]
        if len(free) < max(count, before // 4):  # with few free rows it would sweep again soon
            more = max(before, count)
            for name, old in self._rows.items():
                grown = self._blank(name, before + more)
                grown[:before] = old
                self._rows[name] = grown
            free = torch.cat([free, torch.arange(before, before + more, device=self.device)])
        self._free = free

    def _blank(self, name: str, rows: int) -> torch.Tensor:
        dtype, shape = self.parts[name]
        blank = torch.empty((rows, *shape), dtype=dtype, device=self.device)  # memory is given on the first write
        blank[:1] = 0
        return blank


def _distinct(pointer: torch.Tensor) -> torch.Tensor:
    """The tensor without the repeats of expanded axes."""
    for axis, stride in enumerate(pointer.stride()):
        if stride == 0 and pointer.shape[axis] > 1:
            pointer = pointer.narrow(axis, 0, 1)
    return pointer
