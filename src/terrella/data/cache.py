"""ClipCache: a recording as memory-mapped arrays of one size, built once, so that training never decodes video."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from . import durable
from .dataset import Dataset
from .format import INFO

_FORMAT = 1
_TYPES = {
    "rgb": np.uint8,
    "depth": np.float16,
    "pose": np.float32,
    "action": np.float32,
    "action_valid": np.bool_,
    "reward": np.float32,
    "done": np.bool_,
}


class ClipCache:
    """Read-only arrays over all N rows of a dataset; what the recording lacks is None.

    rgb uint8 [N, H, W, 3]; depth float16 [N, h, w] metres (>= 65.5: beyond range); pose float32 [N, 7]; action float32
    [N, A]; action_valid bool [N]; reward float32 [N]; done bool [N]; episodes: list of (start, stop) row ranges.
    """

    rgb: np.ndarray | None
    depth: np.ndarray | None
    pose: np.ndarray | None
    action: np.ndarray
    action_valid: np.ndarray
    reward: np.ndarray
    done: np.ndarray

    def __init__(self, path: Path):
        self.path = path
        try:
            about = json.loads((path / "about.json").read_text(encoding="utf-8"))
            for name in _TYPES:
                array = np.load(path / f"{name}.npy", mmap_mode="r") if name in about["arrays"] else None
                setattr(self, name, array)
        except (OSError, ValueError, KeyError) as error:
            raise DatasetError(
                f"the cache {path} is damaged ({error}); delete that folder and it is built anew."
            ) from error
        self.episodes = [tuple(pair) for pair in about["episodes"]]
        self.fps, self.action_names, self.world = about["fps"], tuple(about["action_names"]), about["world"]
        self.length = self.episodes[-1][1]

    @staticmethod
    def open(
        dataset: Dataset | str | Path,
        size: tuple[int, int] = (96, 128),
        progress: Callable[[int, int], None] | None = None,
    ) -> ClipCache:
        """The cache of `dataset` with rgb at `size` (height, width), built first where it is missing or out of date.

        It lies in ROOT/.cache/terrella, or under $XDG_CACHE_HOME where the dataset's folder cannot be written.
        `progress(done, total)` counts episodes. Killing the build leaves nothing that could be mistaken for a cache.
        """
        dataset = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
        if not dataset.length:
            raise DatasetError(f"{dataset.root} has no finished episode yet; record some first.")
        shelf = _shelf(dataset)
        path = shelf / f"{size[0]}x{size[1]}-{_key(dataset, size)}"
        if path.is_dir():
            return ClipCache(path)
        with open(shelf / ".lock", "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another process may be building the same
            if not path.is_dir():
                for old in [*shelf.glob(f"{size[0]}x{size[1]}-*"), *shelf.glob(".building*")]:
                    shutil.rmtree(old, ignore_errors=True)
                try:
                    _build(dataset, size, shelf, path, progress)
                except OSError as error:
                    raise DatasetError(f"cannot build the cache {path} ({error}); free some space there.") from error
                finally:
                    shutil.rmtree(shelf / ".building", ignore_errors=True)
        return ClipCache(path)


def split(n_episodes: int, held_out: float = 0.05, seed: int = 0) -> tuple[list[int], list[int]]:
    """Episode numbers (train, held_out), ascending; at least one is held out where there are two or more."""
    count = min(max(1, round(n_episodes * held_out)), n_episodes - 1) if held_out > 0 and n_episodes > 1 else 0
    chosen = set(np.random.default_rng(seed).permutation(n_episodes)[:count].tolist())
    return [i for i in range(n_episodes) if i not in chosen], sorted(chosen)


def shrink(pictures: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 [T, H, W, 3] -> uint8 [T, *size, 3]: each pixel the mean of the area that it covers, rounded half up."""
    height, width = pictures.shape[1:3]
    if (height, width) == tuple(size):
        return pictures
    if height % size[0] == 0 and width % size[1] == 0:
        down, across = height // size[0], width // size[1]
        total = np.zeros((len(pictures), *size, 3), np.uint16 if down * across <= 256 else np.uint32)
        for y in range(down):
            for x in range(across):
                total += pictures[:, y::down, x::across]
        return ((total + down * across // 2) // (down * across)).astype(np.uint8)
    mixed = np.einsum("yh,thwc->tywc", _box(height, size[0]), pictures.astype(np.float32), optimize=True)
    mixed = np.einsum("xw,tywc->tyxc", _box(width, size[1]), mixed, optimize=True)
    return (mixed + 0.5).clip(0, 255).astype(np.uint8)


def _box(source: int, target: int) -> np.ndarray:
    """float32 [target, source]: the share of each source pixel in each target pixel."""
    edges = np.arange(target + 1) * source / target
    pixel = np.arange(source)
    cover = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return (cover.clip(0) / (source / target)).astype(np.float32)


def _key(dataset: Dataset, size: tuple[int, int]) -> str:
    """Changes whenever the recording does: its info, its episodes' statistics and every file's size go in."""
    digest = hashlib.sha256(json.dumps([_FORMAT, list(size)]).encode())
    digest.update((dataset.root / INFO).read_bytes())
    for path in sorted((dataset.root / "meta" / "episodes").glob("*/*.parquet")):
        digest.update(path.read_bytes())
    for path in sorted({file for episode in dataset.episodes for file in (episode.data, episode.video) if file}):
        size_bytes = path.stat().st_size if path.exists() else -1
        digest.update(f"{path.relative_to(dataset.root)}:{size_bytes};".encode())
    return digest.hexdigest()[:16]


def _shelf(dataset: Dataset) -> Path:
    near = dataset.root / ".cache" / "terrella"
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    name = hashlib.sha256(str(dataset.root.resolve()).encode()).hexdigest()[:16]
    for shelf in (near, home / "terrella" / name):
        try:
            shelf.mkdir(parents=True, exist_ok=True)
            (shelf / ".lock").touch()
            return shelf
        except OSError:
            continue
    raise DatasetError(f"no cache can be written in {near} or {home}; set XDG_CACHE_HOME to a folder that can.")


def _build(dataset: Dataset, size: tuple[int, int], shelf: Path, path: Path, progress) -> None:
    staged = shelf / ".building"
    staged.mkdir()
    shapes = {name: _row_shape(dataset, name, size) for name in _TYPES if dataset.has(name)}
    need = sum(int(np.prod(shape)) * np.dtype(_TYPES[name]).itemsize for name, shape in shapes.items()) * dataset.length
    free = shutil.disk_usage(shelf).free
    if need > free:
        raise DatasetError(
            f"the cache of {dataset.root} needs {need / 1e9:.1f} GB and {free / 1e9:.1f} GB are free at {shelf}."
        )
    arrays = {
        name: _new_array(staged / f"{name}.npy", _TYPES[name], (dataset.length, *shape))
        for name, shape in shapes.items()
    }
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # decoding and resizing release the interpreter lock
        jobs = [pool.submit(_fill, dataset, number, size, arrays) for number in range(len(dataset.episodes))]
        try:
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                if progress:
                    progress(done, len(jobs))
        except BaseException:
            for job in jobs:
                job.cancel()
            raise
    for name in arrays:
        durable.sync_file(staged / f"{name}.npy")
    about = {
        "arrays": sorted(arrays),
        "episodes": [[episode.start, episode.stop] for episode in dataset.episodes],
        "fps": dataset.fps,
        "action_names": list(dataset.action_names),
        "world": dataset.world,
    }
    durable.write_json(staged / "about.json", about)
    durable.move_into_place(staged, path)


def _new_array(path: Path, dtype, shape: tuple[int, ...]) -> np.ndarray:
    array = np.lib.format.open_memmap(path, "w+", dtype, shape)
    if hasattr(os, "posix_fallocate"):  # a full disk is an error here, not a crash when the mapping is written
        with open(path, "rb+") as file:
            os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
    return array


def _row_shape(dataset: Dataset, name: str, size: tuple[int, int]) -> tuple[int, ...]:
    if name == "rgb":
        return (*size, 3)
    if name == "depth":
        return tuple(dataset.features["observation.depth"]["shape"])
    if name in ("pose", "action"):
        return (7,) if name == "pose" else (len(dataset.action_names),)
    return ()


def _fill(dataset: Dataset, number: int, size: tuple[int, int], arrays: dict[str, np.ndarray]) -> None:
    """Writes one episode's rows into the arrays."""
    episode = dataset.episodes[number]
    rows = dataset.episode(number, [name for name in arrays if name != "rgb"])
    for name, values in rows.items():
        arrays[name][episode.start : episode.stop] = values
    if "rgb" in arrays:
        at, batch = episode.start, []
        for picture in dataset.frames(number):
            batch.append(picture)
            if len(batch) == 32:
                arrays["rgb"][at : at + 32] = shrink(np.stack(batch), size)
                at, batch = at + 32, []
        if batch:
            arrays["rgb"][at : episode.stop] = shrink(np.stack(batch), size)
