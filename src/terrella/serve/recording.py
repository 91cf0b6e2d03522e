"""What is played, as rows of a dataset: each observation with the action, reward and end that followed it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import torch

from ..core.errors import ServeError, TerrellaError


class Sink(Protocol):
    """Where rows go, such as data.Recorder. The last row of an episode has action None: its terminal observation."""

    def add(
        self, observation: Mapping[str, np.ndarray], action: np.ndarray | None, reward: float, done: bool | None
    ) -> None: ...

    def end_episode(self) -> object: ...

    def close(self) -> None: ...


SinkFactory = Callable[[], Sink]


class Recording:
    """Off until `begin`. Play goes on where a recording cannot: `fault` then says why it stopped."""

    def __init__(self, factory: SinkFactory | None):
        self.fault = ""
        self._factory = factory
        self._sink: Sink | None = None
        self._seen: dict[str, np.ndarray] | None = None  # the observation that the next action answers

    @property
    def on(self) -> bool:
        return self._sink is not None

    def begin(self) -> None:
        """ServeError where there is nowhere to record to."""
        if self._sink is None:
            if self._factory is None:
                raise ServeError("there is no folder to record to; start the server with --record FOLDER.")
            self._sink, self._seen, self.fault = self._factory(), None, ""

    def add(self, seen: Mapping[str, torch.Tensor], action: torch.Tensor | None, reward: float, done: bool) -> None:
        """The observation [1, ...] of this moment, and the action [1, ...] that led to it (None at an episode's start)."""
        if self._sink is None:
            return
        if self._seen is not None and action is not None:
            self._put(self._seen, action[0].cpu().numpy(), reward, done)
        self._seen = {name: tensor[0].cpu().numpy() for name, tensor in seen.items() if name not in ("reward", "done")}

    def end_episode(self) -> None:
        if self._sink is not None and self._seen is not None:
            self._put(self._seen, None, 0.0, None)
            self._seen = None
            self._put()

    def close(self) -> None:
        self.end_episode()
        self._drop()

    def _put(self, *row) -> None:
        """A row; without one, the end of an episode."""
        try:
            if self._sink is not None and row:
                self._sink.add(*row)
            elif self._sink is not None:
                self._sink.end_episode()
        except (TerrellaError, OSError) as error:
            self._stopped(error)
            self._drop()

    def _drop(self) -> None:
        sink, self._sink, self._seen = self._sink, None, None
        try:
            if sink is not None:
                sink.close()
        except (TerrellaError, OSError) as error:
            self._stopped(error)

    def _stopped(self, error: Exception) -> None:
        self.fault = self.fault or f"the recording stopped: {error}"
