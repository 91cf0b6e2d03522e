"""Clips: seeded, exactly resumable batches of clips for training, from the clip cache or from a remote recording."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DatasetError
from ...core.instruction import embed_all
from ..dataset import Dataset
from ..storage.remote import Files
from .cache import INSTRUCTION, ClipCache, Kinds, array_for, episodes_with, further_cameras
from .order import ClipOrder, ClipStarts, copy_rows, episodes_to_read
from .windows import Windows

Fill = Callable[[int, int, Mapping[str, np.ndarray]], None]
_PLACES: Kinds = {"episode": (np.dtype(np.int64), ()), "row": (np.dtype(np.int64), ())}  # every recording has these


@dataclass(frozen=True)
class ClipsConfig:
    """Which clips to read, in which batches."""

    length: int  # rows of a clip
    channels: Sequence[str] = ("rgb", "action")  # channels to read, see `Clips`
    batch: int = 16  # clips in a batch
    size: tuple[int, int] = (96, 128)  # height and width of the pictures, pixels; a ClipCache has its own
    stride: int = 1  # rows from one row of a clip to the next
    episodes: Sequence[int] | None = None  # numbers of the episodes to read; None reads all of them
    seed: int = 0  # seed of the order, which (seed, epoch) alone decide
    shuffle: bool = True  # whether to shuffle the clips of an epoch
    drop_last: bool = True  # whether to leave out the clips of an epoch that do not fill a batch
    workers: int = 0  # threads that copy batches ahead; their number does not change the order
    rank: int = 0  # this process, of `world_size` that share each epoch
    world_size: int = 1  # processes that share each epoch
    torch: bool = False  # whether batches hold torch tensors instead of numpy arrays, over the same memory
    budget_bytes: int = 8 << 30
    """For a URL, bytes that may be kept on this machine: half for files on the disk, a quarter for each of two windows in
    memory (one is read while the next is fetched). Windows come in shuffled order; clips are shuffled within a window."""
    cache_dir: str | Path | None = None  # for a URL, the folder for its files; None is under $XDG_CACHE_HOME

    def __post_init__(self):
        if isinstance(self.channels, str) or not self.channels:
            raise DatasetError(f"channels={self.channels!r} must be a sequence of names, such as ('rgb', 'action').")
        if self.workers < 0:
            raise DatasetError(f"workers={self.workers} is negative; 0 copies each batch when it is asked for.")

    @property
    def order(self) -> ClipOrder:
        """The part that decides which clips make which batch."""
        return ClipOrder(
            self.length, self.stride, self.batch, self.seed, self.shuffle, self.drop_last, self.rank, self.world_size
        )


class Clips:
    """Batches of clips of `length` rows, `stride` rows apart, in an order that (seed, epoch) alone decides.

        clips = Clips("recordings/doom", ClipsConfig(length=16, channels=("rgb", "action"), batch=32))
        for batch in clips:                      # the rest of this epoch; the next loop is the next epoch
            batch["rgb"]                         # uint8 [32, 16, 96, 128, 3]
            saved = clips.state()                # JSON; Clips(...).resume(saved) goes on with the batch after this one

    A clip never crosses an episode, and an epoch visits every row at which a clip can start once. Episodes that have no reading
    of a channel are left out (`padded`), for their rows hold padding. Channels are those of
    the recorded world ("rgb", "rgb.wrist", "depth", "pose", "health", …); the arrays of the ClipCache ("action",
    "action_valid", "reward", "done", or a vector by its key); "task" (int64, index into `tasks`) and "instruction" (float32
    [D], its embedding); and "episode" and "row" (int64) of each frame. The memory of a batch is reused once neither the
    batch nor a view of it is referenced any more.

    source:    a Dataset, a ClipCache, a folder, or a URL (hf://…, s3://…, file://…); remote recordings are read in windows.
    progress:  `progress(done, total)` counts episodes while the cache is built.
    """

    def __init__(
        self,
        source: Dataset | ClipCache | str | Path,
        config: ClipsConfig,
        progress: Callable[[int, int], None] | None = None,
    ):
        order, channels, budget = config.order, config.channels, config.budget_bytes
        self._order, self._workers, self._torch, self._memory = order, config.workers, config.torch, _Memory()
        if isinstance(source, str | Path):
            source = Dataset(_files(source, config.cache_dir, budget))
        if isinstance(source, Dataset) and isinstance(source.files, Files):
            self._shelf: _Whole | Windows = Windows(source, order, channels, config.size, config.episodes, budget // 4)
        else:
            if isinstance(source, Dataset):
                source = ClipCache.open(source, config.size, progress, further_cameras(source, channels), budget)
            self._shelf = _Whole(source, order, channels, config.episodes)
        self._keys, self._kinds = self._chosen(channels)
        self._meanings = embed_all(self.tasks)
        self._epoch, self._next = 0, 0
        self._batches(0)

    @property
    def padded(self) -> tuple[int, ...]:
        """The episodes that are left out because they have no reading of one of the channels."""
        return self._shelf.padded

    @property
    def tasks(self) -> tuple[str, ...]:
        """The texts that the channel "task" numbers."""
        return self._shelf.tasks

    def _chosen(self, channels: Sequence[str]) -> tuple[dict[str, str], Kinds]:
        """(channel -> its array, kinds of the arrays to read)."""
        kinds, keys = {**_PLACES, **self._shelf.kinds}, {}
        for name in channels:
            key = array_for(name, kinds, self._shelf.keys)
            if key is None:
                names = {*kinds, *self._shelf.keys, *([INSTRUCTION] if "task" in kinds else [])}
                raise DatasetError(f"the recording has no '{name}'; it has {', '.join(sorted(names))}.")
            keys[name] = key
        return keys, {key: kinds[key] for key in keys.values()}

    def __len__(self) -> int:
        """Batches in this epoch."""
        return self._batches(self._epoch)

    @property
    def epoch(self) -> int:
        """The epoch of the next batch, from 0."""
        return self._epoch

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The remaining batches of this epoch."""
        return self._run(range(self._epoch, self._epoch + 1))

    def forever(self) -> Iterator[dict[str, Any]]:
        """The remaining batches of this epoch and those of all later epochs, without a pause in between."""
        return self._run(range(self._epoch, 1 << 62))

    def state(self) -> dict:
        """The position after the last batch, as JSON values."""
        return {"epoch": self._epoch, "batch": self._next, "of": self._shelf.facts()}

    def resume(self, state: Mapping) -> Clips:
        """Continues at `state`, with any number of workers; DatasetError where it belongs to other clips."""
        try:
            epoch, batch, stated = int(state["epoch"]), int(state["batch"]), dict(state["of"])
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"this is not a state of Clips ({error!r}); pass the result of `state()`.") from error
        for name, mine in self._shelf.facts().items():
            if stated.get(name) != mine:
                raise DatasetError(
                    f"the state was saved with {name}={stated.get(name)} and these clips have {name}={mine}; "
                    "make them from the same recording with the same arguments."
                )
        if epoch < 0 or not 0 <= batch < self._batches(epoch):
            raise DatasetError(f"the state names batch {batch} of epoch {epoch}, which does not exist.")
        self._epoch, self._next = epoch, batch
        return self

    def _batches(self, epoch: int) -> int:
        count = self._shelf.batches(epoch)
        if not count:
            raise DatasetError(
                f"{self._shelf.facts()['clips']} clips of {self._order.length} rows make no batch of {self._order.batch} "
                f"for each of {self._order.world_size} ranks; ask for fewer or shorter clips, or for drop_last=False (and where "
                "it is read in windows, which are dealt to the ranks, for a smaller budget_bytes)."
            )
        return count

    def _run(self, epochs: range) -> Iterator[dict[str, Any]]:
        first = self._next
        places = (
            (epoch, number)
            for epoch in epochs
            for number in range(first if epoch == epochs.start else 0, self._batches(epoch))
        )
        with self._shelf.reading(epochs, first) as fill:
            for (epoch, number), arrays in self._made(fill, places):
                last = number + 1 == self._batches(epoch)
                self._epoch, self._next = (epoch + 1, 0) if last else (epoch, number + 1)
                yield _as_torch(arrays) if self._torch else arrays

    def _made(self, fill: Fill, places: Iterator[tuple[int, int]]) -> Iterator[tuple[tuple[int, int], dict]]:
        """Each place with its batch, in order; each worker is at most two batches ahead."""
        if not self._workers:
            yield from ((place, self._make(fill, *place)) for place in places)
            return
        pool = ThreadPoolExecutor(self._workers, "clips")
        try:
            ahead = deque((place, pool.submit(self._make, fill, *place)) for place in islice(places, 2 * self._workers))
            while ahead:
                place, job = ahead.popleft()
                arrays = job.result()
                ahead.extend((more, pool.submit(self._make, fill, *more)) for more in islice(places, 1))
                yield place, arrays
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def _make(self, fill: Fill, epoch: int, number: int) -> dict[str, np.ndarray]:
        clips = min(self._order.batch, self._shelf.clips(epoch) - number * self._order.batch)
        kinds, length = self._kinds.items(), self._order.length
        arrays = {name: self._memory.empty((clips, length, *shape), dtype) for name, (dtype, shape) in kinds}
        fill(epoch, number, arrays)
        return {name: self._meant(name, arrays[key]) for name, key in self._keys.items()}

    def _meant(self, channel: str, array: np.ndarray) -> np.ndarray:
        """The array of a channel: as read, or, for instructions, the embeddings of its tasks."""
        if channel != INSTRUCTION or array.dtype.kind == "f":
            return array
        out = self._memory.empty((*array.shape, self._meanings.shape[1]), self._meanings.dtype)
        return np.take(self._meanings, array, axis=0, out=out, mode="clip")


def _files(source: str | Path, cache_dir: str | Path | None, budget_bytes: int) -> Any:
    return Files(source, cache_dir, budget_bytes // 2) if isinstance(source, str) and "://" in source else source


class _Whole:
    """All clips of one clip cache, which many processes can map at once. `Windows` has the same interface.

    `facts` are the JSON values that, with the epoch, decide the order. `clips` and `batches` count those of this rank in
    an epoch. `reading` gives a function `fill(epoch, batch, arrays)`, for batches from `first` of the first epoch on.
    """

    def __init__(self, cache: ClipCache, order: ClipOrder, channels: Sequence[str], episodes: Sequence[int] | None):
        self._order = order
        self._arrays = {name: np.asarray(array) for name, array in cache.arrays.items()}
        self.kinds: Kinds = {name: (array.dtype, array.shape[1:]) for name, array in self._arrays.items()}
        self.keys, self.tasks = cache.keys, cache.tasks
        numbers = episodes_to_read(episodes, len(cache.episodes))
        wanted = [key for name in channels if (key := array_for(name, self._arrays, self.keys))]
        self._episodes = episodes_with(wanted, numbers, cache.absent)
        self.padded = tuple(np.setdiff1d(numbers, self._episodes).tolist())
        first, stop = cache.ranges[self._episodes].T
        self._counts = np.maximum(stop - first - order.span + 1, 0)
        self._starts = ClipStarts.of(first, self._counts)

    def facts(self) -> dict:
        return self._order.facts(self._counts)

    def clips(self, epoch: int) -> int:
        return -(-(self._starts.count - self._order.rank) // self._order.world_size)

    def batches(self, epoch: int) -> int:
        return self._order.batches(self.clips(epoch), self._starts.count // self._order.world_size)

    def reading(self, epochs: range, first: int) -> AbstractContextManager[Fill]:
        return nullcontext(self._fill)

    def _fill(self, epoch: int, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        clips = len(next(iter(arrays.values())))
        places = (number * self._order.batch + np.arange(clips)) * self._order.world_size + self._order.rank
        stretch, first = self._starts.at(self._order.order(places, self._starts.count, epoch))
        copy_rows(self._arrays, self._order.rows(first), 0, self._episodes[stretch], arrays)


class _Memory:
    """Gives arrays whose memory is reused once neither they nor their views are referenced."""

    def __init__(self):
        self._spare: dict[int, deque[bytearray]] = {}

    def empty(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        size = int(np.prod(shape)) * dtype.itemsize
        spare = self._spare.setdefault(size, deque())
        try:
            memory = spare.pop()
        except IndexError:
            memory = bytearray(size)
        array = np.ndarray(shape, dtype, memory)  # views refer to it, because it does not own its memory
        weakref.finalize(array, spare.append, memory).atexit = False
        return array


def _as_torch(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    from torch import from_numpy

    return {name: from_numpy(array) for name, array in arrays.items()}
