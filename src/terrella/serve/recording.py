"""Play as rows of a dataset: each observation with the action, reward and end that followed it."""

import contextlib
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


class SessionRecording:
    """A recording of a session, off until `begin`. If writing fails it stops, `fault` says why, and play goes on."""

    def __init__(self, factory: SinkFactory | None):
        self.fault = ""
        self.saved = ""  # what was saved when it was last closed, in a sentence
        self._rows = self._episodes = 0
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
            self._rows = self._episodes = 0

    def add(self, seen: Mapping[str, torch.Tensor], action: torch.Tensor | None, reward: float, done: bool) -> None:
        """The observation [1, ...] of this moment, and the action [1, ...] that led to it (None at an episode's start)."""
        if self._sink is None:
            return
        before = self._seen
        self._seen = {name: tensor[0].cpu().numpy() for name, tensor in seen.items() if name not in ("reward", "done")}
        if before is not None and action is not None:
            taken = action[0].cpu().numpy()
            self._try(lambda sink: sink.add(before, taken, reward, done))
            self._rows += 1

    def end_episode(self) -> None:
        last, self._seen = self._seen, None
        if last is not None:
            self._try(lambda sink: sink.add(last, None, 0.0, None))
            self._try(lambda sink: sink.end_episode())
            self._episodes += 1

    def close(self) -> None:
        on = self.on
        self.end_episode()
        self._try(lambda sink: sink.close())
        if on and self.on:
            several = "s" * (self._episodes != 1)
            self.saved = f"saved {self._rows:,} steps in {self._episodes} episode{several}."
        self._sink = None

    def _try(self, do: Callable[[Sink], object]) -> None:
        """Calls `do` if a recording is on; stops the recording if that fails."""
        sink = self._sink
        try:
            if sink is not None:
                do(sink)
        except (TerrellaError, OSError) as error:
            self.fault = f"the recording stopped: {error}"
            self._sink = self._seen = None
            with contextlib.suppress(TerrellaError, OSError):
                sink.close()
