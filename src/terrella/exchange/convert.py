"""convert: from any format that Terrella knows into any other; the format of a path is recognised from its content."""

import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Literal, get_args

from ..core.errors import DatasetError
from ..data.format import INFO, some_of
from ..data.source import Sensor, Source, Take, without
from .formats.folders import IMAGES, VIDEOS
from .formats.rows import facts_of

Format = Literal["lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"]
_MAX_DEPTH = 4  # levels of subfolders that are searched for recordings
_PICTURES_ONLY = ("videos", "images")
_SENSOR_FACTS = ("names", "units", "frame", "facts")


@dataclass(frozen=True)
class _Kind:
    """A file format: its code, and which parts of a source it can store."""

    name: str
    read: str  # "module.function" of `formats`, imported when used: (path, fps) -> Source
    write: str  # likewise: (source, path, progress) -> notes
    suffixes: Collection[str] = ()
    # "text" (string features), "task", "language", "start_ns", "sensors" (names, units, facts), "facts" (of takes), or
    # single facts of takes by name
    keeps: Collection[str] = ()
    depth: int = 1  # levels of folders in which its files lie; 0 where its own folders are known


def _call(function: str, *args: Any, **kwargs: Any) -> Any:
    module, _, name = function.partition(".")
    return getattr(import_module(f".formats.{module}", __package__), name)(*args, **kwargs)


_ALL = {"text", "task", "language", "start_ns", "facts", "sensors"}
_NO_DATA = ("terrella.json", "readme", "license", "licence")  # names of files, as they begin, that hold no recording
_LEROBOT = ("meta", "data", "videos", "streams", "images")
_KINDS: dict[str, _Kind] = {
    "lerobot": _Kind("LeRobot v3", "lerobot.read", "lerobot.write", keeps=_ALL, depth=0),  # its notes name the rest
    "mcap": _Kind("MCAP", "mcap.read", "mcap_write.write", (".mcap",), _ALL - {"text"}),
    "minari": _Kind("Minari", "minari.read", "minari.write", (), ("task", "start_ns", "sensors", "minari", "texts"), 0),
    "robomimic": _Kind(
        "HDF5", "hdf5.read", "robomimic.write", (".hdf5", ".h5", ".hdf"), ("task", "sensors", "robomimic"), 9
    ),
    "rollouts": _Kind("npz rollouts", "rollouts.read", "rollouts.write", (".npz",), ("task", "start_ns", "sensors")),
    "videos": _Kind("videos", "videos.read", "videos.write", VIDEOS, depth=2),
    "images": _Kind("images", "images.read", "images.write", IMAGES, depth=3),
}
_NO_KIND = {  # what to do with files of formats that are not read, by suffix
    ".zarr": "copy its arrays under the same names (data/action, meta/episode_ends) into an .hdf5 file by h5py, and name that",
    ".bag": "convert it to MCAP (`mcap convert IN.bag OUT.mcap`), and name that",
    ".db3": "convert it to MCAP (`mcap convert IN.db3 OUT.mcap`), and name that",
    ".pkl": "a pickle is not opened, for it may run code; save its arrays as an .npz file (numpy.savez), and name that",
    ".tfrecord": "save each episode of this RLDS dataset as an .npz file of observations and actions, and name their folder",
}
_READ = ", ".join(kind.name for kind in _KINDS.values())


def open_source(path: str | Path, fps: float | None = None, episodes: int = 10, seed: int = 0) -> Source:
    """Opens a recording as a Source; its format is recognised.

    path: a LeRobot v3 folder (or its address, "hf://…", "s3://…"); an .mcap file or a folder of them; a Minari dataset; HDF5
          as robomimic, D4RL or DIAMOND's Counter-Strike recordings; .npz rollouts, videos or images (a folder or a file); or
          "gym:ID" for `episodes` rollouts of random actions, drawn with `seed`.
    fps:  rows per second of images and rollouts, which may not store it; None for the format's default.
    DatasetError where there is no known recording.
    """
    name = str(path)
    if name.startswith("gym:"):
        return _call("environments.from_env", name.removeprefix("gym:"), episodes=episodes, seed=seed, fps=fps)
    if "://" in name:
        return _call(_KINDS["lerobot"].read, name, fps=fps)
    kind = _KINDS[_kind(Path(path))]
    source = _call(kind.read, Path(path), fps=fps)
    return replace(source, notes=(*source.notes, *_unread_files(Path(path), kind)))


def _unread_files(path: Path, kind: _Kind) -> list[str]:
    """A note on the files of a folder that are not read: of other formats, or deeper than the format's own."""
    if path.is_file():
        return []
    unread = []
    for file in sorted(path.rglob("*")):
        parts = file.relative_to(path).parts
        own = file.suffix.lower() in kind.suffixes and len(parts) <= kind.depth
        own |= not kind.depth and (parts[0] in _LEROBOT or not kind.suffixes and kind.name == "Minari")
        plain = any(part.startswith(".") for part in parts) or parts[-1].lower().startswith(_NO_DATA)
        if file.is_file() and not own and not plain:
            unread.append("/".join(parts))
    return [f"files of {path.name} that are no {kind.name} were left out: {some_of(unread)}."] if unread else []


def _kind(path: Path) -> str:
    if not path.exists():
        raise DatasetError(f"{path} does not exist; name a recording.")
    if path.is_file():
        kind = _by_suffix({path.suffix.lower()})
        if kind is None:
            raise DatasetError(f"{path} is of no known format ({_READ}){_way_in([path])}.")
        return kind
    if (path / INFO).exists() or (path / "meta" / "episodes").exists():
        return "lerobot"
    if (path / "data" / "main_data.hdf5").exists() or (path / "data" / "metadata.json").exists():
        return "minari"
    folders, seen = [path], [path]
    for _ in range(_MAX_DEPTH):
        files = [file for folder in folders for file in folder.iterdir() if not file.name.startswith(".")]
        kind = _by_suffix({file.suffix.lower() for file in files if file.is_file()})
        if kind:
            return kind
        folders = [folder for folder in files if folder.is_dir()]
        seen += files
    raise DatasetError(f"{path} holds no recording of a known format ({_READ}){_way_in(seen)}.")


def _way_in(paths: list[Path]) -> str:
    """What to do with the first of these files and folders whose format is known but not read; "" where none is."""
    named = (
        way for path in paths for suffix, way in _NO_KIND.items() if re.search(rf"\{suffix}(\.|-|$)", path.name.lower())
    )
    return "".join(f"; {way}" for way in islice(named, 1))


def _by_suffix(suffixes: set[str]) -> str | None:
    return next((name for name, kind in _KINDS.items() if suffixes.intersection(kind.suffixes)), None)


def format_of(path: str | Path) -> str:
    """The format to write at a path, by its suffix: MCAP for .mcap, robomimic's HDF5 for .hdf5, else LeRobot."""
    suffix = Path(path).suffix.lower()
    return next((name for name in ("mcap", "robomimic") if suffix in _KINDS[name].suffixes), "lerobot")


def write_source(
    source: Source,
    path: str | Path,
    to: Format | None = None,
    rows=None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Writes a Source at a new path, completely or not at all. Returns a note on everything that reading (`source.notes`) or
    writing left out or changed.

    to:   the format; None chooses it by the path's suffix.
    rows: formats.lerobot.LeRobotRows, how rows are made, for LeRobot only.
    DatasetError where the path is not empty, the disk is full, or the takes do not fit the format.
    """
    chosen, path = to or format_of(path), Path(path)
    if chosen not in get_args(Format):
        raise DatasetError(f"there is no format '{chosen}' to write; choose {', '.join(get_args(Format))}.")
    if chosen != "lerobot" and path.exists() and (path.is_file() or any(path.iterdir())):
        raise DatasetError(f"{path} exists already; convert into a new one.")
    more = {"how": rows} if rows and chosen == "lerobot" else {}
    kind, notes = _KINDS[chosen], dict.fromkeys(source.notes)  # a dict as an ordered set
    kept = _without_text(source, notes, kind) if "text" not in kind.keeps else source
    lost: dict[str, None] = {}
    seen: dict[str, list[int]] = {}
    watched = replace(kept, takes=lambda: _takes_noting_losses(kept, kind, lost, notes, seen))
    written = _call(kind.write, watched, path, progress=progress, **more)
    if "sensors" not in kind.keeps:
        bare = Sensor("", "image", ())
        for name, sensor in kept.sensors.items():
            facts = [part for part in _SENSOR_FACTS if getattr(sensor, part) != getattr(bare, part)]
            calibration = ["calibration"] * ("calibration" in sensor.facts)
            if facts and sensor.kind in ("image", "depth"):
                lost[f"{', '.join(calibration or facts)} of '{name}'"] = None
    notes |= dict.fromkeys(written)
    if "facts" not in kind.keeps and chosen in _PICTURES_ONLY and kept.facts:
        lost[f"what is known of the recording ({', '.join(kept.facts)})"] = None
    absent = _absences(kept, seen, "; its rows there are marked as padding" if chosen == "lerobot" else "")
    return [*notes, *absent, *(f"{what} has no place in {kind.name} and was left out." for what in lost)]


def _without_text(source: Source, notes: dict[str, None], kind: _Kind) -> Source:
    texts = [name for name, sensor in source.sensors.items() if sensor.dtype == "string"]
    notes |= {f"'{name}' is text, which {kind.name} has no place for, and was left out.": None for name in texts}
    return without(source, texts)


def _absences(source: Source, seen: dict[str, list[int]], then: str) -> Iterator[str]:
    """A note on each sensor that some takes lack; seen: sensor -> the takes that have it, "" -> all."""
    every = seen.get("", [])
    for name in source.sensors:
        lacking = sorted(set(every).difference(seen.get(name, ())))
        if lacking:
            some = f"{len(lacking)} of {len(every)} takes ({some_of(lacking)})"
            where = "any take" if len(lacking) == len(every) else some
            yield f"'{name}' has no readings in {where}{then}."


def _takes_noting_losses(
    source: Source, kind: _Kind, lost: dict[str, None], notes: dict[str, None], seen: dict[str, list[int]]
) -> Iterator[Take]:
    """The takes. Adds what the format cannot store to `lost`, what could not be read to `notes`, and who has what to `seen`."""
    seen.clear()
    for number, take in enumerate(source.takes()):
        notes |= dict.fromkeys(take.notes)
        for name in ("", *(name for name, readings in take.readings.items() if len(readings.time_s))):
            seen.setdefault(name, []).append(number)
        language = take.facts.get("language")
        for part, present in (("task", take.task), ("language", language), ("start_ns", take.start_ns is not None)):
            if present and part not in kind.keeps:
                lost[_TAKE_PARTS[part]] = None
        if "facts" not in kind.keeps:
            for name in facts_of(take):
                if name.split(" ")[0] not in kind.keeps:
                    lost[f"the fact '{name}' of takes"] = None
        yield take


_TAKE_PARTS = {  # parts of a take that a format may not store
    "task": "the instruction of takes",
    "language": "changes of the instruction within a take",
    "start_ns": "the wall-clock time of takes",
}
