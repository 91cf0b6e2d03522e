"""In which order clips are read: a shuffle of any length that is computed, not stored, and where each clip begins."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isqrt

import numpy as np

from ...core.errors import DatasetError

_ROUNDS = 8


def shuffled(places: np.ndarray, count: int, *key: int) -> np.ndarray:
    """What stands at `places` (int64 [n], 0 <= place < count) in a shuffle of 0 .. count - 1 that `key` alone decides.

    A Feistel network on the smallest a x b rectangle that holds `count` numbers (Black and Rogaway, "Ciphers with
    arbitrary finite domains", 2002); the few that it sends beyond `count` are sent on until they come back. It takes
    no memory, whatever the count.
    """
    a = isqrt(max(count - 1, 0)) + 1
    b = -(-count // a)
    rounds = np.random.SeedSequence(key).generate_state(_ROUNDS, np.uint64)
    found = np.array(places, np.int64)
    beyond = np.arange(len(found))
    while len(beyond):
        left, right = np.divmod(found[beyond].astype(np.uint64), np.uint64(b))
        for turn in range(0, _ROUNDS, 2):
            left = (left + _mixed(right ^ rounds[turn]) % np.uint64(a)) % np.uint64(a)
            right = (right + _mixed(left ^ rounds[turn + 1]) % np.uint64(b)) % np.uint64(b)
        found[beyond] = (left * np.uint64(b) + right).astype(np.int64)
        beyond = beyond[found[beyond] >= count]
    return found


def _mixed(x: np.ndarray) -> np.ndarray:
    """The finisher of SplitMix64 (Steele, Lea and Flood, 2014) on uint64 [n]."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@dataclass(frozen=True)
class ClipStarts:
    """Every place where a clip may begin, numbered 0 .. count - 1 without a list of them.

    first:  int64 [E], the first row of each stretch of rows; before: int64 [E + 1], clips before each stretch.
    """

    first: np.ndarray
    before: np.ndarray

    @staticmethod
    def of(first: np.ndarray, counts: np.ndarray) -> ClipStarts:
        """`counts[i]` clips begin at rows first[i], first[i] + 1, …"""
        return ClipStarts(np.asarray(first, np.int64), np.append(0, np.cumsum(counts, dtype=np.int64)))

    @property
    def count(self) -> int:
        return int(self.before[-1])

    def at(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(index of the stretch, first row) of clips by number, int64 [n] each."""
        stretch = np.searchsorted(self.before, numbers, side="right") - 1
        return stretch, self.first[stretch] + numbers - self.before[stretch]


@dataclass(frozen=True)
class ClipOrder:
    """Which clips a reader gives, and in which order; `ClipsConfig` explains each attribute."""

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
            raise DatasetError(f"rank={self.rank} is none of {self.world_size} ranks, which count from 0.")
        if self.seed < 0:
            raise DatasetError(f"seed={self.seed} is negative; give a whole number from 0 on.")

    @property
    def span(self) -> int:
        """Rows from the first to the last of a clip, both counted."""
        return (self.length - 1) * self.stride + 1

    def order(self, places: np.ndarray, count: int, *key: int) -> np.ndarray:
        """What stands at `places` in the order of 0 .. count - 1 that the seed and `key` decide."""
        return shuffled(places, count, self.seed, *key) if self.shuffle else np.asarray(places, np.int64)

    def rows(self, first: np.ndarray) -> np.ndarray:
        """int64 [n, length]: the rows of clips that begin at `first` [n]."""
        return first[:, None] + np.arange(self.length) * self.stride

    def batches(self, mine: int, least: int) -> int:
        """Batches of an epoch of which `mine` clips are this rank's and `least` that of the rank with the fewest."""
        return least // self.batch if self.drop_last else -(-mine // self.batch)

    def facts(self, counts: np.ndarray) -> dict:
        """JSON values that, with the epoch, decide the order of clips, of which counts[i] begin in episode i."""
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
    """Copies the rows [n, length] of n clips; `episode` of each, and `shift`, by which its rows lie later in the dataset."""
    for name, out in target.items():
        if name == "row":
            out[:] = rows + np.reshape(shift, (-1, 1))
        elif name == "episode":
            out[:] = episode[:, None]
        else:
            np.take(source[name], rows, axis=0, out=out, mode="clip")  # "raise" would copy twice


def episodes_to_read(episodes: Sequence[int] | None, count: int) -> np.ndarray:
    """int64: the numbers of the episodes to read, ascending; None: all `count`."""
    if episodes is None:
        return np.arange(count)
    try:
        found = np.array([operator.index(number) for number in episodes], np.int64)
    except TypeError as error:
        raise DatasetError(f"episodes are named by whole numbers ({error}).") from error
    wrong = found[(found < 0) | (found >= count)]
    if len(wrong):
        raise DatasetError(f"the recording has episodes 0 to {count - 1}, no episode {wrong[0]}.")
    if len(np.unique(found)) < len(found):
        raise DatasetError("an episode is named twice; name each once.")
    return np.sort(found)
