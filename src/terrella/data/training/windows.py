"""Windows: reads a remote recording a few episodes at a time, and fetches the next window while one is used."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ...core.errors import DatasetError
from ..dataset import Dataset
from .cache import (
    Kinds,
    absent_of,
    array_for,
    bytes_a_row,
    episodes_with,
    fill_episode,
    further_cameras,
    keys_of,
    kinds_of,
)
from .order import ClipOrder, ClipStarts, copy_rows, episodes_to_read

_FILES, _CLIPS = 1, 2  # the two shuffles of an epoch


class Windows:
    """Clips of a recording in windows of at most `window_bytes`, two of which exist at a time.

    An epoch takes the files in shuffled order, cuts their rows into windows, deals these to the ranks in turn, and
    shuffles the clips of each window. A file is fetched once an epoch (twice where a window ends inside it). An episode
    longer than a window is spread over several; its clips stay the same. `kinds` has the channels that the recording has.
    """

    def __init__(
        self,
        dataset: Dataset,
        order: ClipOrder,
        channels: Sequence[str],
        size: tuple[int, int],
        episodes: Sequence[int] | None,
        window_bytes: int,
    ):
        kinds, self.keys = kinds_of(dataset, size, further_cameras(dataset, channels)), keys_of(dataset)
        wanted = [array_for(name, kinds, self.keys) for name in channels]
        self.kinds: Kinds = {key: kinds[key] for key in wanted if key is not None} or kinds
        self.window_rows = window_bytes // bytes_a_row(self.kinds)
        if self.window_rows < order.span:
            raise DatasetError(
                f"a window of {max(0, self.window_rows)} rows holds no clip of {order.span}; allow more bytes, smaller "
                "pictures or shorter clips."
            )
        self.dataset, self.size, self.order, self.tasks = dataset, size, order, dataset.tasks
        numbers = episodes_to_read(episodes, len(dataset.episodes))
        self._numbers = episodes_with(self.kinds, numbers, absent_of(dataset))
        self.padded = tuple(np.setdiff1d(numbers, self._numbers).tolist())
        lengths = (dataset.episodes.stops - dataset.episodes.starts)[self._numbers]
        self._counts = np.maximum(lengths - order.span + 1, 0)
        files = [self.files_of(int(number)) for number in self._numbers]
        self._shard = np.cumsum([before != after for before, after in zip([(), *files], files)], dtype=np.int64) - 1
        self.epoch = functools.lru_cache(4)(self._epoch)

    def files_of(self, number: int) -> tuple[str, ...]:
        """The files that hold the wanted channels of an episode."""
        episode, cameras = self.dataset.episodes[number], self.dataset.cameras
        wanted = {self.dataset.feature(name) for name in self.kinds} & set(cameras)
        films = [episode.videos[name].file for name in cameras if name in wanted and name in episode.videos]
        return (episode.data, *films)

    def facts(self) -> dict:
        return self.order.facts(self._counts) | {"window_rows": self.window_rows}

    def clips(self, epoch: int) -> int:
        return int(self.epoch(epoch).of_ranks[self.order.rank])

    def batches(self, epoch: int) -> int:
        return self.order.batches(self.clips(epoch), int(self.epoch(epoch).of_ranks.min()))

    @contextmanager
    def reading(self, epochs: range, first: int) -> Iterator:
        belt = _Belt(self, epochs, first)
        try:
            yield belt.fill
        finally:
            belt.close()

    def _epoch(self, epoch: int) -> _Epoch:
        shards = int(self._shard[-1]) + 1 if len(self._shard) else 0
        turn = np.empty(shards, np.int64)
        turn[self.order.order(np.arange(shards), shards, epoch, _FILES)] = np.arange(shards)
        windows: list[list[ClipRun]] = []
        room = 0
        for i in np.argsort(turn[self._shard], kind="stable").tolist():
            left, at = int(self._counts[i]), 0
            while left:
                rows = left + self.order.span - 1
                if room < min(rows, self.window_rows):  # rows that fit into a window stay together
                    windows.append([])
                    room = self.window_rows
                clips = min(left, room - self.order.span + 1)
                windows[-1].append(ClipRun(int(self._numbers[i]), at, clips))
                left, at, room = left - clips, at + clips, room - clips - self.order.span + 1
        counts = np.array([sum(piece.clips for piece in window) for window in windows], np.int64)
        ranks = range(self.order.world_size)
        of_ranks = np.array([counts[rank :: self.order.world_size].sum() for rank in ranks])
        mine = list(range(self.order.rank, len(windows), self.order.world_size))
        return _Epoch([windows[i] for i in mine], mine, np.append(0, np.cumsum(counts[mine])), of_ranks)


@dataclass(frozen=True)
class ClipRun:
    """Consecutive clips of an episode."""

    episode: int
    first: int  # row of the episode at which the first clip starts
    clips: int  # number of clips


@dataclass(frozen=True)
class _Epoch:
    """The windows of this rank in one epoch."""

    windows: list[list[ClipRun]]
    numbers: list[int]  # of the windows, among those of all ranks
    before: np.ndarray  # clips before each window
    of_ranks: np.ndarray  # clips of each rank


@dataclass(frozen=True)
class _Window:
    """The rows of several clip runs in one array; row r of run i is row r + shift[i] of the dataset."""

    arrays: dict[str, np.ndarray]
    starts: ClipStarts
    shift: np.ndarray
    episode: np.ndarray


class _Belt:
    """The queue of windows: a thread loads the next one while batches are filled from the current one."""

    def __init__(self, windows: Windows, epochs: range, first: int):
        self._windows, self._plan = windows, windows.order
        self._changed = threading.Condition()
        self._ready: dict[tuple[int, int], _Window] = {}
        self._left: dict[tuple[int, int], int] = {}  # clips that have not been copied
        self._error: BaseException | None = None
        self._closed = False
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1, "window")
        self._thread = threading.Thread(target=self._run, args=(epochs, first), name="windows", daemon=True)
        self._thread.start()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def fill(self, epoch: int, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Copies the clips of a batch, which may lie in several windows."""
        before, clips = self._windows.epoch(epoch).before, len(next(iter(arrays.values())))
        done, place = 0, number * self._plan.batch
        while done < clips:
            w = int(np.searchsorted(before, place + done, side="right")) - 1
            some = int(min(clips - done, before[w + 1] - place - done))
            window = self._wait(epoch, w)
            first = place + done - int(before[w])
            self._copy(window, epoch, w, first, {name: array[done : done + some] for name, array in arrays.items()})
            done += some
            del window
            with self._changed:
                self._left[epoch, w] -= some
                if not self._left[epoch, w]:
                    del self._left[epoch, w], self._ready[epoch, w]
                    self._changed.notify_all()

    def _wait(self, epoch: int, w: int) -> _Window:
        with self._changed:
            self._changed.wait_for(lambda: (epoch, w) in self._ready or self._error or self._closed)
            if (epoch, w) in self._ready:
                return self._ready[epoch, w]
            raise self._error or DatasetError("reading was stopped; start a new loop.")

    def _copy(self, window: _Window, epoch: int, w: int, first: int, arrays: Mapping[str, np.ndarray]) -> None:
        places = first + np.arange(len(next(iter(arrays.values()))))
        number = self._windows.epoch(epoch).numbers[w]
        clips = self._plan.order(places, window.starts.count, epoch, _CLIPS, number)
        piece, start = window.starts.at(clips)
        copy_rows(window.arrays, self._plan.rows(start), window.shift[piece], window.episode[piece], arrays)

    def _run(self, epochs: range, first: int) -> None:
        try:
            for epoch in epochs:
                plan, begin = self._windows.epoch(epoch), first * self._plan.batch if epoch == epochs.start else 0
                end = min(int(plan.before[-1]), self._windows.batches(epoch) * self._plan.batch)
                for w, pieces in enumerate(plan.windows):
                    left = min(int(plan.before[w + 1]), end) - max(int(plan.before[w]), begin)
                    if left <= 0:
                        continue
                    with self._changed:
                        self._changed.wait_for(lambda: len(self._ready) < 2 or self._closed)
                        if self._closed:
                            return
                    window = self._made(pieces)
                    with self._changed:
                        self._ready[epoch, w], self._left[epoch, w] = window, left
                        self._changed.notify_all()
                    del window
        except BaseException as error:  # raised in the waiting thread
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _made(self, pieces: list[ClipRun]) -> _Window:
        counts = np.array([piece.clips for piece in pieces])
        rows = counts + self._plan.span - 1
        at = np.cumsum(rows) - rows
        kinds = self._windows.kinds.items()
        arrays = {name: np.empty((int(rows.sum()), *shape), dtype) for name, (dtype, shape) in kinds}
        jobs = [
            self._pool.submit(self._load, piece, arrays, int(begin), int(n))
            for piece, begin, n in zip(pieces, at, rows)
        ]
        for job in jobs:
            job.result()
        episode = np.array([piece.episode for piece in pieces])
        first = np.array([piece.first for piece in pieces])
        shift = self._windows.dataset.episodes.starts[episode] + first - at
        return _Window(arrays, ClipStarts.of(at, counts), shift, episode)

    def _load(self, piece: ClipRun, arrays: Mapping[str, np.ndarray], at: int, rows: int) -> None:
        dataset = self._windows.dataset
        with dataset.files.holding(*self._windows.files_of(piece.episode)):
            fill_episode(dataset, piece.episode, self._windows.size, arrays, at, piece.first, rows)
