"""ClipCache: a recording as memory-mapped arrays with pictures of one size, so that training never decodes video."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import islice
from pathlib import Path

import numpy as np

from ...core import files
from ...core.errors import DatasetError
from ..channels import ESTIMATES, channel_of, current_feature, feature_of
from ..dataset import Dataset
from ..format import INFO
from ..source import Lazy
from ..storage.remote import BUDGET_BYTES, LocalFiles

Kinds = Mapping[str, tuple[np.dtype, tuple[int, ...]]]  # (dtype, shape of a row) by array
INSTRUCTION = "instruction"
_FORMAT = 3
_FETCHING = 4  # episodes of a remote recording that are fetched at once
_TYPES = {
    "rgb": np.uint8, "depth": np.float16, "pose": np.float32, "action": np.float32, "action_valid": np.bool_,
    "reward": np.float32, "done": np.bool_, "task": np.int64,
}  # fmt: skip
_NUMBERS = {"float64": "float32"} | {
    name: name
    for name in ("float16", "float32", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool")
}


class ClipCache:
    """Read-only, memory-mapped arrays over all N rows of a dataset. Opening reads none of them, however long they are.

    episodes: (start, stop) row ranges; `ranges` is the same as int64 [E, 2].
    arrays:   name -> array: those below that the recording has, and its other vectors ("observation.state", …).
    keys:     channel -> name of its array.
    absent:   name of an array -> the episodes in which it is padding: they have no reading of it.
    """

    rgb: np.ndarray | None  # uint8 [N, H, W, 3]; like the others, None where the recording has none
    depth: np.ndarray | None  # float16 [N, h, w], metres; 65.5 or more is beyond range
    pose: np.ndarray | None  # float32 [N, 7]
    action: np.ndarray  # float32 [N, A]
    action_valid: np.ndarray  # bool [N]
    reward: np.ndarray  # float32 [N]
    done: np.ndarray  # bool [N]
    task: np.ndarray | None  # int64 [N], index into `tasks`

    def __init__(self, path: Path):
        self.path = path
        try:
            about = json.loads((path / "about.json").read_text(encoding="utf-8"))
            self.arrays = {name: np.load(path / f"{name}.npy", mmap_mode="r") for name in about["arrays"]}
            self.ranges = ranges = np.load(path / "episodes.npy", mmap_mode="r")
            self.episodes = Lazy(len(ranges), lambda i: tuple(ranges[i].tolist()))
            self.length = self.episodes[-1][1]
            self.fps, self.action_names, self.world = about["fps"], tuple(about["action_names"]), about["world"]
            self.tasks: tuple[str, ...] = tuple(about["tasks"])
            self.keys: dict[str, str] = dict(about["keys"])
            self.absent: dict[str, list[int]] = dict(about.get("absent", {}))
            short = [name for name, array in self.arrays.items() if len(array) != self.length]
            if short:
                raise ValueError(f"{short[0]} has {len(self.arrays[short[0]])} of {self.length} rows")
        except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
            raise DatasetError(f"the cache {path} is damaged ({error}); delete it, and it is built again.") from error
        for name in _TYPES:
            setattr(self, name, self.arrays.get(name))

    @property
    def further(self) -> dict[str, np.ndarray]:
        """The recording's other channels ("things", "health", ...), by name.

        Pictures are left out, and so are a learned world's estimates, which are no evidence.
        """
        prefix = "observation."
        names = {key: key.removeprefix(prefix) for key in self.arrays if key.startswith(prefix)}
        hidden = {key for key, name in names.items() if name in ESTIMATES or name.startswith("images.")}
        return {name: self.arrays[key] for key, name in names.items() if key not in hidden}

    @property
    def vitals(self) -> dict[str, np.ndarray]:
        """Those of `further` that are one number a row."""
        return {name: array for name, array in self.further.items() if int(np.prod(array.shape[1:])) == 1}

    @staticmethod
    def open(
        dataset: Dataset | str | Path,
        size: tuple[int, int] = (96, 128),
        progress: Callable[[int, int], None] | None = None,
        cameras: Sequence[str] = (),
        budget_bytes: int = BUDGET_BYTES,
        joined: Sequence[str] = (),
    ) -> ClipCache:
        """The cache of `dataset` with pictures of `size` (height, width), built if it is missing or out of date.

        cameras:      features of further cameras to keep, at the same size, in `arrays`.
        joined:       features of cameras whose pictures of `size` lie side by side in `rgb`, from the left, in the place of the
                      main camera's.
        progress:     `progress(done, total)` counts episodes.
        budget_bytes: most bytes of the cache of a remote recording.

        It lies in ROOT/.cache/terrella, or under $XDG_CACHE_HOME where that folder cannot be written or is remote. A build
        that is killed leaves no cache.
        """
        dataset = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
        if not dataset.length:
            raise DatasetError(f"{dataset.root} has no finished episode yet; record some first.")
        shelf, cameras = _shelf(dataset), sorted(set(cameras))
        more = "".join(f"+{hashlib.sha256(name.encode()).hexdigest()[:8]}" for name in cameras)
        more += f"-{hashlib.sha256('|'.join(joined).encode()).hexdigest()[:8]}" if joined else ""
        kind = f"{size[0]}x{size[1]}{more}"
        path = shelf / f"{kind}-{_key(dataset, size)}"
        if path.is_dir():
            return ClipCache(path)
        with open(shelf / ".lock", "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another process may be building the same
            if not path.is_dir():
                for old in [*shelf.glob(f"{kind}-*"), *shelf.glob(".building*")]:
                    shutil.rmtree(old, ignore_errors=True)
                try:
                    _build(dataset, size, cameras, joined, path, budget_bytes, progress)
                except OSError as error:
                    raise DatasetError(f"cannot build the cache {path} ({error}); {files.remedy_of(error)}.") from error
                finally:
                    shutil.rmtree(shelf / ".building", ignore_errors=True)
        return ClipCache(path)


def split(n_episodes: int, held_out: float = 0.05, seed: int = 0) -> tuple[list[int], list[int]]:
    """(train, held_out) episode numbers, ascending; of two or more episodes at least one is held out."""
    count = min(max(1, round(n_episodes * held_out)), n_episodes - 1) if held_out > 0 and n_episodes > 1 else 0
    chosen = set(np.random.default_rng(seed).permutation(n_episodes)[:count].tolist())
    return [i for i in range(n_episodes) if i not in chosen], sorted(chosen)


def shrink_pictures(pictures: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 [T, H, W, 3] -> uint8 [T, *size, 3]: each pixel the mean of the area that it covers, rounded half up."""
    count, height, width, _ = pictures.shape
    if (height, width) == tuple(size):
        return pictures
    if height % size[0] == 0 and width % size[1] == 0:
        down, across = height // size[0], width // size[1]
        tall = pictures[:, ::down].astype(np.uint16 if down * across <= 256 else np.uint32)
        for y in range(1, down):
            tall += pictures[:, y::down]
        small = np.empty((count, *size, 3), np.uint8)
        for colour in range(3):  # one at a time: numpy is slow where the innermost axis has three elements
            total = tall[:, :, ::across, colour] + tall.dtype.type(down * across // 2)
            for x in range(1, across):
                total += tall[:, :, x::across, colour]
            total //= tall.dtype.type(down * across)
            small[..., colour] = total
        return small
    tall = _box(height, size[0]) @ pictures.reshape(count, height, width * 3).astype(np.float32)
    tall = tall.reshape(count, size[0], width, 3).transpose(2, 0, 1, 3).reshape(width, -1)
    mixed = (_box(width, size[1]) @ tall).reshape(size[1], count, size[0], 3).transpose(1, 2, 0, 3)
    return (mixed + 0.5).clip(0, 255).astype(np.uint8)


def _box(source: int, target: int) -> np.ndarray:
    """float32 [target, source]: the share of each source pixel in each target pixel."""
    edges = np.arange(target + 1) * source / target
    pixel = np.arange(source)
    cover = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return (cover.clip(0) / (source / target)).astype(np.float32)


def _key(dataset: Dataset, size: tuple[int, int]) -> str:
    """A hash that changes when the recording does: of its info, meta/episodes and the size of every file."""
    digest, files = hashlib.sha256(json.dumps([_FORMAT, list(size)]).encode()), dataset.files
    for name in (INFO, *files.list("meta/episodes", ".parquet")):
        with open(files.local(name), "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    last: tuple[str, ...] = ()
    for episode in dataset.episodes:
        for name in sorted(set(episode.files).difference(last)):
            digest.update(f"{name}:{files.mark(name)};".encode())
        last = episode.files
    digest.update(json.dumps(absent_of(dataset)).encode() if absent_of(dataset) else b"")
    return digest.hexdigest()[:16]


def _shelf(dataset: Dataset) -> Path:
    """The folder of a dataset's caches: its own, or the user's where that cannot be written or is remote."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "terrella"
    if isinstance(dataset.files, LocalFiles):
        name, near = str(dataset.root.resolve()), [dataset.root / ".cache" / "terrella"]
    else:
        name, near = str(dataset.files), []
    shelves = [*near, home / hashlib.sha256(name.encode()).hexdigest()[:16]]
    for shelf in shelves:
        try:
            shelf.mkdir(parents=True, exist_ok=True)
            (shelf / ".lock").touch()
            return shelf
        except OSError:
            continue
    tried = " or ".join(str(shelf) for shelf in shelves)
    raise DatasetError(f"no cache can be written in {tried}; set XDG_CACHE_HOME to a folder that can.")


def _build(
    dataset: Dataset,
    size: tuple[int, int],
    cameras: Sequence[str],
    joined: Sequence[str],
    path: Path,
    budget: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    staged, near = path.parent / ".building", isinstance(dataset.files, LocalFiles)
    staged.mkdir()
    kinds = dict(kinds_of(dataset, size, cameras))
    if joined:
        kinds["rgb"] = np.dtype(np.uint8), (size[0], len(joined) * size[1], 3)
    need, free = bytes_a_row(kinds) * dataset.length, shutil.disk_usage(staged).free
    if need > free:
        raise DatasetError(
            f"the cache of {dataset.root} needs {need / 1e9:.1f} GB and {free / 1e9:.1f} GB are free at {path.parent}."
        )
    if need > budget and not near:
        raise DatasetError(
            f"the cache of {dataset.files} needs {need / 1e9:.2g} GB and {budget / 1e9:.2g} GB may be kept here: allow more, "
            "ask for smaller pictures, or read it in windows with Clips."
        )
    arrays = filled = new_arrays(staged, kinds, dataset.length)
    if joined:
        parts = np.split(arrays["rgb"], len(joined), 2)  # views
        filled = {name: array for name, array in arrays.items() if name != "rgb"} | dict(zip(joined, parts))

    def fill(number: int) -> None:
        with dataset.files.holding(*(() if near else dataset.episodes[number].files)):
            fill_episode(dataset, number, size, filled)

    workers = os.cpu_count() or 1  # decoding and resizing release the interpreter lock
    with ThreadPoolExecutor(workers if near else min(workers, _FETCHING)) as pool:
        jobs = [pool.submit(fill, number) for number in range(len(dataset.episodes))]
        try:
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                if progress:
                    progress(done, len(jobs))
        except BaseException:
            for job in jobs:
                job.cancel()
            raise
    ranges = np.stack([dataset.episodes.starts, dataset.episodes.stops], 1)
    facts = {"action_names": list(dataset.action_names), "world": dataset.world, "tasks": list(dataset.tasks)}
    facts |= {"keys": keys_of(dataset), "absent": absent_of(dataset)}
    finish_cache(staged, path, arrays, ranges, dataset.fps, facts)


def further_cameras(dataset: Dataset, channels: Sequence[str]) -> list[str]:
    """The features of the cameras among `channels`, without the main one."""
    features = [dataset.feature(name) for name in channels]
    return [name for name in features if name in dataset.cameras and name != dataset.rgb_key]


def array_for(channel: str, arrays: Collection[str], keys: Mapping[str, str]) -> str | None:
    """The array that `channel` (a channel, a feature or the name of an array) means; None for none."""
    task = "task" if channel == INSTRUCTION else None
    meant = (channel, keys.get(channel), keys.get(channel_of(channel)), feature_of(channel), task)
    return next((name for name in meant if name in arrays), None)


def keys_of(dataset: Dataset) -> dict[str, str]:
    """channel -> the array that holds it."""
    arrays = {dataset.feature(name): name for name in _TYPES if dataset.feature(name)}
    return {channel: arrays.get(feature, current_feature(feature)) for channel, feature in dataset.channels.items()}


def absent_of(dataset: Dataset) -> dict[str, list[int]]:
    """array -> the episodes that have no reading of it, where others have. An episode without `done` is none of these: it did
    not end."""
    arrays = {dataset.feature(name): name for name in _TYPES if dataset.feature(name)}
    absent: dict[str, list[int]] = {}
    for number, episode in enumerate(dataset.episodes):
        for feature in episode.absent:
            absent.setdefault(arrays.get(feature, current_feature(feature)), []).append(number)
    every = len(dataset.episodes)
    return {name: numbers for name, numbers in absent.items() if name != "done" and len(numbers) < every}


def episodes_with(channels: Iterable[str], numbers: np.ndarray, absent: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Those of the episodes `numbers` that have readings of all `channels`, names of arrays; DatasetError where none has."""
    lacking = {name: absent[name] for name in channels if name in absent}
    whole = numbers[~np.isin(numbers, sorted({number for part in lacking.values() for number in part}))]
    if len(numbers) and not len(whole):
        raise DatasetError(f"no episode has readings of all of {', '.join(lacking)}; choose fewer channels.")
    return whole


def kinds_of(dataset: Dataset, size: tuple[int, int], cameras: Sequence[str] = ()) -> Kinds:
    """(dtype, shape of a row) of every array in the cache of a dataset, with pictures of `size` (height, width)."""
    if min(size) < 1:
        raise DatasetError(f"pictures of {size[0]}x{size[1]} pixels are impossible; give a (height, width).")
    seen = dataset.feature("depth")
    shapes = {
        "rgb": (*size, 3),
        "depth": () if seen is None else dataset.sensors[seen].shape,
        "pose": (7,),
        "action": (len(dataset.action_names),),
    }
    kinds = {name: (np.dtype(_TYPES[name]), shapes.get(name, ())) for name in _TYPES if _has(dataset, name)}
    taken = {dataset.feature(name) for name in kinds}
    for name, sensor in dataset.sensors.items():
        if Path(name).name != name:
            raise DatasetError(f"a feature is named '{name[:100]}', which no file can be; rename it in meta/info.json.")
        if sensor.kind == "depth" and name not in taken:
            kinds[current_feature(name)] = (np.dtype(np.float16), sensor.shape)
        elif sensor.kind == "vector" and sensor.dtype in _NUMBERS and name not in taken:
            kinds[current_feature(name)] = (np.dtype(_NUMBERS[sensor.dtype]), sensor.shape)
    for name in cameras:
        if name not in dataset.cameras:
            raise DatasetError(f"{dataset.root} has no camera '{name}'; it has {', '.join(dataset.cameras) or 'none'}.")
        kinds[name] = (np.dtype(np.uint8), (*size, 3))
    return {name: kind for name, kind in kinds.items() if np.prod(kind[1]) > 0}


def _has(dataset: Dataset, name: str) -> bool:
    return bool(dataset.tasks) and dataset.feature(name) is not None if name == "task" else dataset.has(name)


def bytes_a_row(kinds: Kinds) -> int:
    return sum(kind.itemsize * int(np.prod(shape)) for kind, shape in kinds.values())


def new_arrays(folder: Path, kinds: Kinds, rows: int) -> dict[str, np.ndarray]:
    """Writable memory-mapped arrays [rows, ...], a file each; OSError where the disk is too small for them."""
    arrays = {}
    for name, (dtype, shape) in kinds.items():
        path = folder / f"{name}.npy"
        arrays[name] = np.lib.format.open_memmap(path, "w+", dtype, (rows, *shape))
        if hasattr(os, "posix_fallocate"):  # a full disk is an error here, not a crash when the mapping is written
            with open(path, "rb+") as file:
                os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
    return arrays


def finish_cache(
    staged: Path,
    path: Path,
    arrays: Mapping[str, np.ndarray],
    ranges: np.ndarray,
    fps: float,
    facts: Mapping[str, object] | None = None,
) -> None:
    """Makes a folder of filled arrays and `ranges` int64 [E, 2] the cache at `path`, in one step.

    facts: action_names, world, tasks, keys and absent, where they are known.
    """
    np.save(staged / "episodes.npy", ranges)
    for name in [*arrays, "episodes"]:
        files.sync_file(staged / f"{name}.npy")
    unknown = {"action_names": [], "world": {}, "tasks": [], "keys": {}}
    files.write_json(staged / "about.json", {**unknown, **(facts or {}), "arrays": sorted(arrays), "fps": fps})
    files.move_into_place(staged, path)


def fill_episode(
    dataset: Dataset,
    number: int,
    size: tuple[int, int],
    arrays: Mapping[str, np.ndarray],
    at: int | None = None,
    first: int = 0,
    count: int | None = None,
) -> None:
    """Writes `count` rows of an episode (None: all that are left), from its row `first` on, into the arrays.

    They begin at row `at` of the arrays, or (None) where they lie in the dataset.
    """
    episode = dataset.episodes[number]
    at = episode.start + first if at is None else at
    count = episode.length - first if count is None else count
    pictured = [name for name in arrays if name == "rgb" or name in dataset.cameras]
    for name, values in dataset.episode(number, [name for name in arrays if name not in pictured]).items():
        array = arrays[name]
        array[at : at + count] = values[first : first + count].reshape(count, *array.shape[1:])
    for name in pictured:
        pictures = dataset.frames(number, None if name == "rgb" else name, first, count)
        done = at
        while batch := list(islice(pictures, 4)):  # few, so that they stay in the processor's cache
            arrays[name][done : done + len(batch)] = shrink_pictures(np.stack(batch), size)
            done += len(batch)
