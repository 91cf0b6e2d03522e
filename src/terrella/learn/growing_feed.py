"""Growing feed: batches of a recording, and of another one that workers record while training has begun."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from .sized_feed import Feed
from .train_step import TrainStep

LEAST = 0.1  # new rows, as a share of those in use, from which they are taken in: a clip cache is built then


class GrowingFeed:
    """Each batch is of one of two recordings, by chance, as often as their rows say. The other one is used as far as it was when it
    was last picked up, so that a resumed run sees what an unbroken one does.

    rows:     of the first recording.
    counted:  the episodes and rows of the other one that are on disk by now.
    feed_of:  of the first n episodes of the other one, their feed and rows.
    """

    def __init__(
        self, first: Feed, rows: int, counted: Callable[[], tuple[int, int]], feed_of: Callable[[int], tuple[Feed, int]]
    ):
        self._first, self._rows, self._counted, self._feed_of = first, rows, counted, feed_of
        self._other: Feed | None = None
        self._episodes = self.further = 0  # in use, of the other recording: episodes and rows

    def pick_up(self) -> bool:
        """Takes in what was recorded since; whether that is enough to count."""
        episodes, rows = self._counted()
        if rows - self.further < LEAST * (self._rows + self.further):
            return False
        self._use(episodes)
        return True

    def batch(self, now: TrainStep) -> Any:
        other = self._other is not None and now.rng.random() < self.further / (self._rows + self.further)
        feed = self._other if other and self._other is not None else self._first
        return feed.batch(now)

    def state(self) -> dict:
        if self._other is None:
            return self._first.state()
        return {"first": self._first.state(), "episodes": self._episodes, "other": self._other.state()}

    def resume(self, state: Mapping) -> None:
        self._first.resume(state.get("first", state))
        if "other" in state:
            self._use(state["episodes"])
            assert self._other is not None
            self._other.resume(state["other"])

    def _use(self, episodes: int) -> None:
        self._other, self.further = self._feed_of(episodes)
        self._episodes = episodes
