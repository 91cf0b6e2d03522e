"""The order of clips: a shuffle of any length that is computed and not stored, and the row at which each clip starts."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isqrt

import numpy as np

from ...core.errors import DatasetError

_ROUNDS = 8


def shuffled_numbers(places: np.ndarray, count: int, *key: int) -> np.ndarray:
    """The numbers at `places` (int64 [n], 0 <= place < count) of the shuffle of 0 to count - 1 that `key` seeds.

    A Feistel network on the smallest a x b rectangle with at least `count` cells (Black and Rogaway, "Ciphers with
    arbitrary finite domains", 2002); results of `count` or more are passed through it again. Memory does not grow with
    `count`.
    """
    a = isqrt(max(count - 1, 0)) + 1
    b = -(-count // a)
    rounds = np.random.SeedSequence(key).generate_state(_ROUNDS, np.uint64)
    numbers = np.array(places, np.int64)
    beyond = np.arange(len(numbers))
    while len(beyond):
        left, right = np.divmod(numbers[beyond].astype(np.uint64), np.uint64(b))
        for turn in range(0, _ROUNDS, 2):
            left = (left + _mixed(right ^ rounds[turn]) % np.uint64(a)) % np.uint64(a)
            right = (right + _mixed(left ^ rounds[turn + 1]) % np.uint64(b)) % np.uint64(b)
        numbers[beyond] = (left * np.uint64(b) + right).astype(np.int64)
        beyond = beyond[numbers[beyond] >= count]
    return numbers


def _mixed(x: np.ndarray) -> np.ndarray:
    """The finisher of SplitMix64 (Steele, Lea and Flood, 2014) on uint64 [n]."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@dataclass(frozen=True)
class ClipStarts:
    """The rows at which clips start, numbered 0 to count - 1; no list of them is stored.

    first:  int64 [E], the first row of each stretch of rows; before: int64 [E + 1], clips before each stretch.
    """

    first: np.ndarray
    before: np.ndarray

    @staticmethod
    def of(first: np.ndarray, counts: np.ndarray) -> ClipStarts:
        """counts[i] clips start at the rows first[i], first[i] + 1, …"""
        return ClipStarts(np.asarray(first, np.int64), np.append(0, np.cumsum(counts, dtype=np.int64)))

    @property
    def count(self) -> int:
        return int(self.before[-1])

    def at(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(index of the stretch, first row) of the clips `numbers`, int64 [n] each."""
        stretch = np.searchsorted(self.before, numbers, side="right") - 1
        return stretch, self.first[stretch] + numbers - self.before[stretch]


@dataclass(frozen=True)
class ClipOrder:
    """Which clips make which batch; `ClipsConfig` explains the attributes."""

    length: int
    stride: int = 1
    batch: int = 16
    seed: int = 0
    shuffle: bool = True
    drop_last: bool = True
    rank: int = 0
    world_size: int = 1

    def __post_init__(self):
        for name in ("length", "stride", "batch", "world_size"):
            if getattr(self, name) < 1:
                raise DatasetError(f"{name}={getattr(self, name)} makes no clips; it must be at least 1.")
        if not 0 <= self.rank < self.world_size:
            raise DatasetError(f"rank={self.rank} must be from 0 to world_size - 1 = {self.world_size - 1}.")
        if self.seed < 0:
            raise DatasetError(f"seed={self.seed} is negative; give 0 or more.")

    @property
    def span(self) -> int:
        """Rows from the first to the last row of a clip, inclusive."""
        return (self.length - 1) * self.stride + 1

    def order(self, places: np.ndarray, count: int, *key: int) -> np.ndarray:
        """The numbers at `places` in the order of 0 to count - 1 that the seed and `key` decide."""
        return shuffled_numbers(places, count, self.seed, *key) if self.shuffle else np.asarray(places, np.int64)

    def rows(self, first: np.ndarray) -> np.ndarray:
        """int64 [n, length]: the rows of the clips that start at rows `first` [n]."""
        return first[:, None] + np.arange(self.length) * self.stride

    def batches(self, mine: int, least: int) -> int:
        """Batches of an epoch; this rank has `mine` clips, and the rank with the fewest has `least`."""
        return least // self.batch if self.drop_last else -(-mine // self.batch)

    def facts(self, counts: np.ndarray) -> dict:
        """JSON values that, with the epoch, decide the order of clips; counts[i] is the number of clips in episode i."""
        stated = {name: value for name, value in asdict(self).items() if name != "rank"}
        digest = hashlib.sha256(np.ascontiguousarray(counts, np.int64).tobytes()).hexdigest()
        return stated | {"clips": int(counts.sum()), "episodes": digest[:16]}


def copy_rows(
    source: Mapping[str, np.ndarray],
    rows: np.ndarray,
    shift: np.ndarray | int,
    episode: np.ndarray,
    target: Mapping[str, np.ndarray],
) -> None:
    """Copies `rows` [n, length] of n clips to `target`. A row r of `source` is row r + shift of the dataset."""
    for name, out in target.items():
        if name == "row":
            out[:] = rows + np.reshape(shift, (-1, 1))
        elif name == "episode":
            out[:] = episode[:, None]
        else:
            np.take(source[name], rows, axis=0, out=out, mode="clip")  # "raise" would copy twice


def episodes_to_read(episodes: Sequence[int] | None, count: int) -> np.ndarray:
    """int64, ascending: the numbers of the episodes to read; None reads all `count`."""
    if episodes is None:
        return np.arange(count)
    try:
        chosen = np.array([operator.index(number) for number in episodes], np.int64)
    except TypeError as error:
        raise DatasetError(f"episodes must be whole numbers ({error}).") from error
    wrong = chosen[(chosen < 0) | (chosen >= count)]
    if len(wrong):
        raise DatasetError(f"the recording has episodes 0 to {count - 1}, no episode {wrong[0]}.")
    if len(np.unique(chosen)) < len(chosen):
        raise DatasetError("an episode is listed twice; list each once.")
    return np.sort(chosen)
