"""Feeds: what the trainer learns from. Random batches, or clips of a local or remote recording."""

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
from .objectives.flow_frames import FlowClipMaker
from .recording import Recording
from .trainer import Feed, TrainStep


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
        self.clips.resume(state)
        self._stream = None


def frames_feed(
    recording: Recording, memory: Keyframes | None, config: VideoConfig, size: int, seed: int, dream: Dream | None
) -> Feed:
    """Batches of `size` for a generator: of places with a `memory`, else of clips."""
    if memory is not None:
        of_place = moving_batch if config.moving else place_batch
        return RandomBatches(lambda now: of_place(recording, memory, config, size, now, dream))
    clips = clips_of(recording, clip_length(config), size, config, seed)
    controls = recording.controls or Controls.buttons(config.actions)
    return ClipStream(clips, lambda rows, now: history_batch(rows, controls, config, now, dream))


def codec_feed(recording: Recording, config: VideoConfig, flow: codec.CodecObjective, size: int, seed: int) -> Feed:
    """Clips for a codec, `size` at a time, chosen from three times as many, preferring those that change more."""
    clips = clips_of(recording, flow.spans.length, 3 * size, config, seed, drop_last=False)
    controls = recording.controls or Controls.buttons(config.actions)
    return ClipStream(clips, codec.ClipMaker(controls, flow.generator.moves.cpu(), flow.over, flow.spans, size))


def flow_feed(recording: Recording, config: VideoConfig, spans: codec.Spans, maker: FlowClipMaker, seed: int) -> Feed:
    """Clips for a flow of frames, chosen from three times as many, preferring those that change more."""
    return ClipStream(clips_of(recording, spans.length, 3 * maker.batch, config, seed, drop_last=False), maker)


def clips_of(
    recording: Recording, length: int, size: int, config: VideoConfig, seed: int, drop_last: bool = True
) -> Clips:
    """Clips of `length` rows, `size` at a time, of the episodes for training."""
    ranges = recording.cache.episodes  # an episode with rows that are kept out is left out as a whole
    whole = [number for number in recording.seen if recording.usable[slice(*ranges[number])].all()]
    if not whole:
        raise DatasetError(f"every episode of {recording.name} comes to the part that is kept out; drop --keep-out.")
    channels = ("rgb", "action", "row", *("instruction",) * ("task" in recording.cache.arrays))
    return Clips(
        recording.cache,
        ClipsConfig(length, channels, size, config.size, seed=seed, drop_last=drop_last, episodes=whole),
    )
