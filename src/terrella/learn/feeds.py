"""Feeds: what the trainer learns from. Random batches, or clips of a local or remote recording."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ..core.errors import DatasetError
from ..data import Clips, ClipsConfig
from ..space.keyframes import Keyframes
from ..worlds.config import VideoConfig
from .batches import Dream, place_batch
from .moving_batches import moving_batch
from .recording import Recording
from .sized_feed import Feed
from .train_step import TrainStep


class RandomBatches:
    """Batches that depend on the randomness of a step alone; they have no position to resume."""

    def __init__(self, draw: Callable[[TrainStep], Any]):
        self.batch = draw

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass


class ClipStream:
    """Batches made of clips of a recording in their order, see data.Clips."""

    def __init__(self, clips: Clips, make: Callable[[dict, TrainStep], Any]):
        self.clips, self.make = clips, make
        self._stream: Iterator[dict] | None = None

    def batch(self, now: TrainStep) -> Any:
        self._stream = self.clips.forever() if self._stream is None else self._stream
        return self.make(next(self._stream), now)

    def state(self) -> dict:
        return self.clips.state()

    def resume(self, state: Mapping) -> None:
        if state:  # empty where batches were cut from a recording on a GPU, in no order
            self.clips.resume(state)
        self._stream = None


def place_feed(recording: Recording, memory: Keyframes, config: VideoConfig, size: int, dream: Dream | None) -> Feed:
    """Batches of `size` views of places with a `memory`."""
    of_place = moving_batch if config.moving else place_batch
    return RandomBatches(lambda now: of_place(recording, memory, config, size, now, dream))


def clips_of(recording: Recording, length: int, size: int, config: VideoConfig, seed: int) -> Clips:
    """Clips of `length` rows, up to `size` at a time, of the episodes for training."""
    ranges = recording.cache.episodes  # an episode with rows that are kept out is left out as a whole
    whole = [number for number in recording.seen if recording.usable[slice(*ranges[number])].all()]
    if not whole:
        raise DatasetError(f"every episode of {recording.name} comes to the part that is kept out; drop --keep-out.")
    channels = ("rgb", "action", "row")
    settings = ClipsConfig(length, channels, size, config.size, seed=seed, drop_last=False, episodes=whole)
    return Clips(recording.cache, settings)


def fitting_rollout(lengths: np.ndarray, slots: int, most: int) -> int:
    """The steps, up to `most`, that clips predict after a history of `slots` rows: as many as half of the rows of episodes of these
    lengths allow. DatasetError if all are too short."""
    rows = lambda steps: lengths[lengths >= slots + steps].sum()  # noqa: E731
    tried = (most, most // 2, max(1, most // 4))
    if not rows(tried[-1]):
        raise DatasetError(f"no episode has the {slots + tried[-1]} rows that a clip has; record longer ones.")
    return next(steps for steps in tried if rows(steps) >= 0.5 * rows(tried[-1]))
