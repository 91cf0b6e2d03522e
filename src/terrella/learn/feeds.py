"""Feeds: what the trainer learns from. Rows drawn at random, or clips of a recording near or far."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from ..core.errors import DatasetError
from ..data import Clips, ClipsConfig
from ..space.keyframes import Keyframes
from ..worlds.config import VideoConfig
from ..worlds.controls import Controls
from .batches import Dream, place_batch
from .history_batches import clip_length, history_batch
from .moving_batches import moving_batch
from .objectives import codec
from .recording import Recording
from .trainer import Feed, Now


class Drawn:
    """Batches that `draw` makes of a step's own randomness alone."""

    def __init__(self, draw: Callable[[Now], Any]):
        self.batch = draw

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass


class Streamed:
    """Batches that `make(clips, now)` makes of clips of a recording, in the clips' own order; see data.Clips."""

    def __init__(self, clips: Clips, make: Callable[[dict, Now], Any]):
        self.clips, self.make = clips, make
        self._given: Iterator[dict] | None = None

    def batch(self, now: Now) -> Any:
        self._given = self.clips.forever() if self._given is None else self._given
        return self.make(next(self._given), now)

    def state(self) -> dict:
        return self.clips.state()

    def resume(self, state: Mapping) -> None:
        self.clips.resume(state)
        self._given = None


def frames_feed(
    recording: Recording, memory: Keyframes | None, config: VideoConfig, size: int, seed: int, dream: Dream | None
) -> Feed:
    """Batches of `size` for a generator: of places, where things may move, with a `memory`; of clips without one."""
    if memory is not None:
        of_place = moving_batch if config.moving else place_batch
        return Drawn(lambda now: of_place(recording, memory, config, size, now, dream))
    clips = clips_of(recording, clip_length(config), size, config, seed)
    controls = recording.controls or Controls.buttons(config.actions)
    return Streamed(clips, lambda found, now: history_batch(found, controls, config, now, dream))


def codec_feed(recording: Recording, config: VideoConfig, flow: codec.CodecObjective, size: int, seed: int) -> Feed:
    """Clips for a codec, `size` at a time: of thrice as many those in which more happens are the likelier."""
    clips = clips_of(recording, flow.spans.length, 3 * size, config, seed, drop_last=False)
    controls = recording.controls or Controls.buttons(config.actions)
    parts = controls, flow.generator.moves.cpu(), flow.over, flow.spans, size  # clips are made where they are read
    return Streamed(clips, lambda found, now: codec.clip(found, *parts, now))


def clips_of(
    recording: Recording, length: int, size: int, config: VideoConfig, seed: int, drop_last: bool = True
) -> Clips:
    """Clips of `length` rows, `size` at a time, of the episodes that training may see."""
    ranges = recording.cache.episodes  # of what is kept out, whole episodes are left out: clips know no rows
    whole = [number for number in recording.seen if recording.usable[slice(*ranges[number])].all()]
    if not whole:
        raise DatasetError(f"every episode of {recording.name} comes to the part that is kept out; drop --keep-out.")
    channels = ("rgb", "action", *("instruction",) * ("task" in recording.cache.arrays))
    return Clips(
        recording.cache,
        ClipsConfig(length, channels, size, config.size, seed=seed, drop_last=drop_last, episodes=whole),
    )
