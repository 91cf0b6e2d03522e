"""Feeds: what the trainer learns from, in batches, which become smaller where a device runs out of memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

from .train_step import TrainStep


class Feed(Protocol):
    """What is learned from. `state` gives JSON values that describe the position after the last batch; `resume` restores it."""

    def batch(self, now: TrainStep, /) -> Any: ...
    def state(self) -> dict: ...
    def resume(self, state: Mapping) -> None: ...


@runtime_checkable
class ResizableFeed(Feed, Protocol):
    """A feed whose batches can become smaller: `size` entries, `least` or more."""

    least: int

    @property
    def size(self) -> int: ...
    def resize(self, size: int) -> None: ...


class SizedFeed:
    """The feed `make(size)`, of batches of `size`, `least` or more; `resize` replaces it by one that begins anew."""

    def __init__(self, make: Callable[[int], Feed], size: int, least: int = 1):
        self._make, self.size, self.least = make, size, least
        self._feed = make(size)

    def resize(self, size: int) -> None:
        if size != self.size:
            self._feed, self.size = self._make(size), size

    def batch(self, now: TrainStep) -> Any:
        return self._feed.batch(now)

    def state(self) -> dict:
        return self._feed.state()

    def resume(self, state: Mapping) -> None:
        self._feed.resume(state)
