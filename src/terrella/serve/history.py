"""The recent past of a session, within fixed budgets: pictures to show, and states to go back to."""

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from ..core.state import State, memory_of


class Image(NamedTuple):
    """A picture as the page gets it."""

    world: int  # its number on the page
    camera: int  # its number among the cameras of that world
    jpeg: bytes


@dataclass(frozen=True)
class Moment:
    """One step: its pictures and, if the worlds can fork, the states to go on from it."""

    step: int
    images: tuple[Image, ...]
    flags: int = 0
    episode_return: float = 0.0
    states: tuple[State, ...] | None = None
    rngs: tuple[torch.Tensor, ...] | None = None  # states of the random generators after this step
    uncertainty: float = -1.0  # expected error of the last image; -1 if its world has no such channel
    drifted: float = 0.0  # the part of it that follows from a position that has drifted; the rest is invention
    vitals: tuple[float, ...] = ()  # numbers of the first world, such as the player's health
    age: int = 0  # steps since its episode began
    imagined: int = 0  # steps since the last world began or last observed something


class History:
    """Moments in order: at most `frames` of them, and states of the newest that fit in `state_bytes`: storages of tensors and arena
    rows (keyframes), each counted once, even if several states share it."""

    def __init__(self, frames: int, state_bytes: int):
        if frames < 1:
            raise ValueError("a history holds at least one moment")
        self._frames, self._budget = frames, state_bytes
        self._pictures: deque[Moment] = deque()
        self._stateful: deque[Moment] = deque()
        self._held: dict[Hashable, list[int]] = {}  # a storage or row -> [moments that hold it, bytes]
        self.state_bytes = 0

    def __len__(self) -> int:
        return len(self._pictures)

    @property
    def newest(self) -> Moment:
        return self._pictures[-1]

    @property
    def oldest_step(self) -> int:
        """The oldest step that can be returned to; the newest step if no states are kept."""
        return self._stateful[0].step if self._stateful else self.newest.step

    def pictures(self) -> list[tuple[Image, ...]]:
        return [moment.images for moment in self._pictures]

    def push(self, moment: Moment) -> None:
        if self._pictures and moment.step != self.newest.step + 1:
            raise ValueError("moments follow one another")
        self._pictures.append(moment)
        if moment.states is not None:
            self._stateful.append(moment)
            self._count(moment, +1)
        while len(self._pictures) > self._frames:
            gone = self._pictures.popleft()
            if self._stateful and self._stateful[0] is gone:
                self._drop_oldest_state()
        while self.state_bytes > self._budget and len(self._stateful) > 1:
            self._drop_oldest_state()

    def at(self, step: int) -> Moment:
        """The moment at `step`, clamped to those that can be returned to."""
        if not self._stateful:
            return self.newest
        first = self._stateful[0].step
        return self._stateful[min(max(step - first, 0), len(self._stateful) - 1)]

    def forget_after(self, step: int) -> None:
        while self.newest.step > step:
            gone = self._pictures.pop()
            if self._stateful and self._stateful[-1] is gone:
                self._count(self._stateful.pop(), -1)

    def clear(self) -> None:
        self._pictures.clear()
        self._stateful.clear()
        self._held.clear()
        self.state_bytes = 0

    def _drop_oldest_state(self) -> None:
        gone = self._stateful.popleft()
        self._count(gone, -1)
        if self._pictures and self._pictures[0].step <= gone.step:  # the picture stays, without its state
            index = gone.step - self._pictures[0].step
            self._pictures[index] = replace(gone, states=None, rngs=None)

    def _count(self, moment: Moment, sign: int) -> None:
        for key, size in memory_of(moment.states or ()).items():
            entry = self._held.setdefault(key, [0, size])
            if sign > 0 and entry[0] == 0:
                self.state_bytes += size
            entry[0] += sign
            if entry[0] == 0:
                self.state_bytes -= entry[1]
                del self._held[key]
