"""HDF5 recordings: robomimic's layout (read and written), the Counter-Strike files DIAMOND learned from, D4RL's flat arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from . import rows
from .arrays import Array, Place

try:
    from h5py import Dataset, File, Group, HardLink, string_dtype
except ImportError as missing:
    raise DatasetError("HDF5 files need the package h5py: pip install 'terrella[hdf5]'.") from missing

SUFFIXES = (".hdf5", ".h5", ".hdf")
OURS = "terrella"  # the attribute under which our description of the sensors is kept
TEXT = string_dtype("utf-8")
_UNTOLD_BYTES, _BEST_RATIO = 1 << 26, 1100  # deflate packs at most 1032 to 1: who claims more than that is lying
_DEEPEST = 16  # groups in groups
_STUMBLES = (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError, MemoryError)


def read(path: str | Path, fps: float | None = None) -> Source:
    """An HDF5 file, or a folder of them (takes in the natural order of their names), as a Source; its keys say which layout.

    robomimic:      data/demo_i/{actions, obs/*, …}: see robomimic.py.
    Counter-Strike: frame_i_x, frame_i_y, …, one file a take: see counter_strike.py.
    D4RL:           observations, actions, terminals, timeouts, …: see d4rl.py.

    fps: rows a second; by default the file's own (robomimic's control_freq, Counter-Strike's 16), else rows.FPS_UNKNOWN,
    and a note says so.
    DatasetError where a file is missing, truncated, of another layout, or links to what lies outside it.
    """
    path = Path(path)
    rows.check_fps(fps, str(path))
    if path.is_dir():
        files = sorted((p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()), key=rows.natural)
        if not files:
            raise DatasetError(f"{path} has no HDF5 files ({', '.join(SUFFIXES)}); name a folder that has.")
    else:
        files = [path]
    from . import counter_strike, d4rl, robomimic

    layout = _layout_of(files[0])
    if layout == "counter-strike":
        return counter_strike.read(path, files, fps)
    one = robomimic.read if layout == "robomimic" else d4rl.read
    parts = [one(file, fps) for file in files]
    return parts[0] if len(parts) == 1 else _chained(path.name, parts, files)


def _layout_of(path: Path) -> str:
    with opened(path) as file:
        names = members(file)
        if "data" in names and isinstance(data := child(file, "data"), Group):
            if any(re.fullmatch(r"demo_\d+", name) for name in members(data)):
                return "robomimic"
        if "frame_0_x" in names and "frame_0_y" in names:
            return "counter-strike"
        if "observations" in names and "actions" in names:
            return "d4rl"
        found = ", ".join(sorted(names, key=rows.natural)[:12]) or "nothing"
    raise DatasetError(
        f"{path} is none of the known layouts (robomimic: data/demo_0; Counter-Strike: frame_0_x, frame_0_y; D4RL: "
        f"observations, actions); it holds {found}."
    )


# -- HDF5 without trust


@contextmanager
def opened(path: Path) -> Iterator[File]:
    """The file, for reading; whatever HDF5 stumbles over inside is a DatasetError."""
    try:
        with _open(path) as file:
            yield file
    except _STUMBLES as error:
        raise DatasetError(f"{path} is damaged ({_first_line(error)}); restore it from a copy.") from error


def _open(path: Path) -> File:
    try:
        return File(path, "r")
    except FileNotFoundError as error:
        raise DatasetError(f"{path} does not exist; name an HDF5 file.") from error
    except _STUMBLES as error:
        why = _first_line(error)
        raise DatasetError(f"{path} is truncated or no HDF5 file ({why}); restore it from a copy.") from error


def members(parent: Group) -> list[str]:
    """The names in a group."""
    return [str(name) for name in parent]


def child(parent: Group, name: str | int) -> Group | Dataset:
    """parent[name], of the same file: links elsewhere are refused, as are datasets whose bytes lie elsewhere.

    An index of a Tuple is "_index_i", as Minari has it.
    """
    name = f"_index_{name}" if isinstance(name, int) else name
    where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
    try:
        link = parent.get(name, getlink=True)
        if link is not None and not isinstance(link, HardLink):
            raise DatasetError(f"{where} is a link, which may lead out of the file; repack the file without links.")
        found = parent[name]
    except _STUMBLES as error:
        raise DatasetError(f"{where} is missing or damaged ({_first_line(error)}); restore it from a copy.") from error
    if not isinstance(found, Group | Dataset):
        raise DatasetError(f"{where} is neither a group nor an array; restore the file from a copy.")
    if isinstance(found, Dataset) and (found.is_virtual or found.external):
        raise DatasetError(f"{where} keeps its values in other files; repack the file so that it holds them.")
    return found


def numbers(parent: Group, name: str | int, count: int | None = None) -> Dataset:
    """The dataset of numbers `name` with `count` rows; DatasetError where it is another or claims more than it stores."""
    where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
    found = child(parent, name)
    if not isinstance(found, Dataset) or found.dtype.kind not in "biuf" or found.ndim < 1:
        raise DatasetError(f"{where} is not an array of numbers with a row for each step.")
    size = found.size * found.dtype.itemsize
    if size > max(_UNTOLD_BYTES, _BEST_RATIO * found.id.get_storage_size()):
        raise DatasetError(f"{where} claims {size} bytes but the file does not hold them; restore it from a copy.")
    if count is not None and len(found) != count:
        raise DatasetError(f"{where} has {len(found)} rows where {count} are needed; the file is inconsistent.")
    return found


def inside(parent: Group, *names: str | int) -> Group:
    """parent[name][…], which must be a group."""
    for name in names:
        found = child(parent, name)
        if not isinstance(found, Group):
            where = f"{parent.file.filename}{parent.name.rstrip('/')}/{name}"
            raise DatasetError(f"{where} is not a group; the file is inconsistent.")
        parent = found
    return parent


def walked(parent: Group, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Dataset]]:
    """Every dataset in a group and the groups in it, with its place."""
    if len(place) > _DEEPEST:
        raise DatasetError(f"{parent.file.filename} nests its groups too deep; it is damaged.")
    for name in members(parent):
        item = child(parent, name)
        if isinstance(item, Group):
            yield from walked(item, (*place, name))
        else:
            yield (*place, name), item


def array(file: File, count: int, *pieces: tuple[Place, int, int]) -> Array:
    """Rows of datasets one after the other, of each piece those from its second number to its third.

    All must have `count` rows. Rows read after `file` was closed open it anew, once.
    """
    path = Path(file.filename)
    held = [numbers(inside(file, *names[:-1]), names[-1], count) for names, _, _ in pieces]

    def read(start: int, stop: int) -> np.ndarray:
        if not all(held):
            again = _open(path)
            held[:] = [numbers(inside(again, *names[:-1]), names[-1], count) for names, _, _ in pieces]
        parts, row = [], 0
        for dataset, (_, first, last) in zip(held, pieces):
            begin, end = max(start - row, 0) + first, min(stop - row + first, last)
            try:
                parts += [np.asarray(dataset[begin:end])] if begin < end else []
            except _STUMBLES as error:
                where = f"{path}{dataset.name}"
                raise DatasetError(f"{where} cannot be read ({_first_line(error)}); restore it from a copy.") from error
            row += last - first
        return np.concatenate(parts) if parts else np.asarray(held[0][:0])

    size = sum(last - first for _, first, last in pieces)
    for dataset in held[1:]:
        if dataset.shape[1:] != held[0].shape[1:]:
            raise DatasetError(f"{path}{dataset.name} has another shape than {held[0].name}; drop the episode.")
    return Array((size, *held[0].shape[1:]), held[0].dtype, read)


def headers(items: Iterable[tuple[tuple[str, ...], Dataset]]) -> dict[Place, Array]:
    """What is known of datasets without reading them."""
    return {place: Array(item.shape, item.dtype) for place, item in items}


def texts(dataset: Group | Dataset) -> list[str]:
    """The values of a dataset [n] of texts."""
    if (
        not isinstance(dataset, Dataset)
        or dataset.dtype.kind not in "OS"
        or dataset.ndim != 1
        or len(dataset) > 1 << 24
    ):
        raise DatasetError(f"{dataset.file.filename}{dataset.name} holds no texts; restore it from a copy.")
    return [it.decode("utf-8", "replace") if isinstance(it, bytes) else str(it) for it in np.asarray(dataset)]


def set_attributes(item: Group, given: object) -> None:
    """Gives a group what of a mapping its attributes can hold."""
    for key, value in given.items() if isinstance(given, Mapping) else ():
        if isinstance(value, str | int | float | list):
            item.attrs[key] = value


def store(
    parent: Group,
    targets: Mapping[str, int],
    shape: tuple[int, ...],
    sensor: Sensor,
    readings: Readings,
    where: str,
    dtype: str = "",
) -> None:
    """Writes a sensor's readings as datasets of `shape`; targets: name -> the number of its first reading."""
    more = {}
    if sensor.kind != "vector":
        more = {"chunks": (1, *shape[1:]), "compression": "gzip", "compression_opts": 1}
    made = {parent.create_dataset(name, shape, dtype or sensor.dtype, **more): at for name, at in targets.items()}
    row = 0
    for part in rows.batches(readings.values, sensor, where, min(len(readings.values), shape[0] + max(made.values()))):
        stored = rows.to_stored(part, sensor).reshape(len(part), *shape[1:])
        for dataset, first in made.items():
            begin, end = max(row, first), min(row + len(part), first + shape[0])
            if begin < end:
                dataset[begin - first : end - first] = stored[begin - row : end - row]
        row += len(part)


def _first_line(error: BaseException) -> str:
    return (str(error).strip('"').splitlines() or [type(error).__name__])[0]


def attributes(item: Group, without: Sequence[str] = ()) -> dict[str, object]:
    """The attributes that JSON can hold."""
    found = {}
    for name in item.attrs:
        if name not in without:
            try:
                value = rows.json_or_none(item.attrs[name])
            except _STUMBLES:
                continue
            if value is not None:
                found[name] = value
    return found


def json_attribute(item: Group, name: str) -> dict:
    """The attribute as a JSON object, {} where it is missing or is none."""
    return json_object(attributes(item).get(name))


def json_object(text: object) -> dict:
    """The JSON object that a text holds, {} where it is none."""
    try:
        found = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _chained(name: str, parts: list[Source], files: list[Path]) -> Source:
    first = parts[0]
    for part, file in zip(parts, files):
        if part.sensors != first.sensors or part.fps != first.fps:
            raise DatasetError(f"{file} has other sensors than {files[0]}; convert each, and merge the results.")
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    facts = {"files": {file.name: part.facts for file, part in zip(files, parts)}}

    def takes() -> Iterator[Take]:
        for part in parts:
            yield from part.takes()

    return replace(first, name=name, takes=takes, notes=notes, facts=facts)
