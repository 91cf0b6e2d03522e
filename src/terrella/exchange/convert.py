"""convert: from any format that Terrella knows into any other; the format of a path is recognised from its content."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from ..core.errors import DatasetError
from ..data.format import INFO
from ..data.source import Sensor, Source, Take
from .formats.folders import IMAGES, VIDEOS

Format = Literal["lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"]
_DEEPEST = 4  # folders below the one named that are looked into
_SENSOR_FACTS = ("names", "units", "frame", "facts")


@dataclass(frozen=True)
class _Kind:
    """One format: what people call it, where its code is, and which of a take's and sensors' facts it has a place for.

    read:  "leaf.function" of `formats`, imported when it is used: (path, fps) -> Source; write: (source, path, progress)
           -> sentences.
    keeps: "text" (string features), "task", "language", "start_ns", "sensors" (their names, units, facts), "facts" (of
           takes), or single facts of takes by name.
    """

    name: str
    read: str
    write: str
    suffixes: frozenset[str] = frozenset()
    keeps: frozenset[str] = frozenset()


def _call(function: str, *given: Any, **more: Any) -> Any:
    leaf, _, name = function.partition(".")
    return getattr(import_module(f".formats.{leaf}", __package__), name)(*given, **more)


_ALL = frozenset({"text", "task", "language", "start_ns", "facts", "sensors"})
_KINDS: dict[str, _Kind] = {
    "lerobot": _Kind("LeRobot v3", "lerobot.read", "lerobot.write", keeps=_ALL),  # it says which facts it leaves out
    "mcap": _Kind("MCAP", "mcap.read", "mcap_write.write", frozenset({".mcap"}), _ALL - {"text"}),
    "minari": _Kind(
        "Minari", "minari.read", "minari.write", keeps=frozenset({"task", "start_ns", "sensors", "minari", "texts"})
    ),
    "robomimic": _Kind(
        "HDF5",
        "hdf5.read",
        "robomimic.write",
        frozenset({".hdf5", ".h5", ".hdf"}),
        frozenset({"task", "sensors", "robomimic"}),
    ),
    "rollouts": _Kind(
        "npz rollouts",
        "rollouts.read",
        "rollouts.write",
        frozenset({".npz"}),
        frozenset({"task", "start_ns", "sensors"}),
    ),
    "videos": _Kind("videos", "videos.read", "videos.write", VIDEOS),
    "images": _Kind("images", "images.read", "images.write", IMAGES),
}
_READ = ", ".join(kind.name for kind in _KINDS.values())


def open_source(path: str | Path, fps: float | None = None, episodes: int = 10, seed: int = 0) -> Source:
    """What lies at `path`, as a Source.

    A LeRobot v3 folder (or its address, "hf://…", "s3://…"); an .mcap file or a folder of them; a Minari dataset; HDF5 as
    robomimic, D4RL or the Counter-Strike recordings lay it out; a folder of .npz rollouts; of videos; of images; or
    "gym:ID", from which `episodes` rollouts of random actions are drawn with `seed`.
    fps: for images and rollouts, which do not say it themselves; None for what the format takes as given.
    DatasetError where nothing known lies there.
    """
    name = str(path)
    if name.startswith("gym:"):
        from .formats import environments

        return environments.from_env(name.removeprefix("gym:"), episodes=episodes, seed=seed, fps=fps)
    kind = _KINDS["lerobot" if "://" in name else _kind(Path(path))]
    return _call(kind.read, name if "://" in name else Path(path), fps=fps)


def _kind(path: Path) -> str:
    if not path.exists():
        raise DatasetError(f"there is nothing at {path}; name a recording.")
    if path.is_file():
        kind = _by_suffix({path.suffix.lower()})
        if kind is None:
            raise DatasetError(f"{path} is of no format that is read here ({_READ}).")
        return kind
    if (path / INFO).exists() or (path / "meta" / "episodes").exists():
        return "lerobot"
    if (path / "data" / "main_data.hdf5").exists() or (path / "data" / "metadata.json").exists():
        return "minari"
    folders = [path]
    for _ in range(_DEEPEST):
        files = [file for folder in folders for file in folder.iterdir() if not file.name.startswith(".")]
        kind = _by_suffix({file.suffix.lower() for file in files if file.is_file()})
        if kind:
            return kind
        folders = [folder for folder in files if folder.is_dir()]
    raise DatasetError(f"{path} holds no recording that is read here ({_READ}).")


def _by_suffix(found: set[str]) -> str | None:
    return next((name for name, kind in _KINDS.items() if found & kind.suffixes), None)


def format_of(path: str | Path) -> str:
    """The format that a new path's name asks for: MCAP for .mcap, robomimic's HDF5 for .hdf5, else LeRobot."""
    suffix = Path(path).suffix.lower()
    return next((name for name in ("mcap", "robomimic") if suffix in _KINDS[name].suffixes), "lerobot")


def write_source(
    source: Source,
    path: str | Path,
    to: Format | None = None,
    rows=None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Writes a Source at a new path, all of it or nothing; returns a sentence on each thing that was left out or changed,
    in reading it (`source.notes`) and in writing it.

    to: None for what the path's name asks for. rows: formats.lerobot.LeRobotRows, how it becomes rows, for LeRobot alone.
    DatasetError where something lies there already, the disk is full, or the takes do not fit the format.
    """
    chosen, path = to or format_of(path), Path(path)
    if chosen not in get_args(Format):
        raise DatasetError(f"there is no format '{chosen}' to write; choose {', '.join(get_args(Format))}.")
    if chosen != "lerobot" and path.exists() and (path.is_file() or any(path.iterdir())):
        raise DatasetError(f"{path} is there already; convert into a new one.")
    more = {"how": rows} if rows and chosen == "lerobot" else {}
    kind, said = _KINDS[chosen], dict.fromkeys(source.notes)
    kept = _without_text(source, said, kind) if "text" not in kind.keeps else source
    lost: dict[str, None] = {}
    counted = replace(kept, takes=lambda: _seen(kept, kind, lost))
    notes = _call(kind.write, counted, path, progress=progress, **more)
    if "sensors" not in kind.keeps:
        bare = Sensor("", "image", ())
        for name, sensor in kept.sensors.items():
            here = [part for part in _SENSOR_FACTS if getattr(sensor, part) != getattr(bare, part)]
            calibrated = ["calibration"] * ("calibration" in sensor.facts)
            if here and sensor.kind in ("image", "depth"):
                lost[f"{', '.join(calibrated or here)} of '{name}'"] = None
    said |= dict.fromkeys(notes)
    return [*said, *(f"{what} has no place in {kind.name} and was left out." for what in lost)]


def _without_text(source: Source, said: dict[str, None], kind: _Kind) -> Source:
    texts = [name for name, sensor in source.sensors.items() if sensor.dtype == "string"]
    said |= {f"'{name}' is text, which {kind.name} has no place for, and was left out.": None for name in texts}
    sensors = {name: sensor for name, sensor in source.sensors.items() if name not in texts}

    def takes() -> Iterator[Take]:
        for take in source.takes():
            yield replace(take, readings={name: it for name, it in take.readings.items() if name not in texts})

    return replace(source, sensors=sensors, takes=takes) if texts else source


def _seen(source: Source, kind: _Kind, lost: dict[str, None]) -> Iterator[Take]:
    """The takes; what of each the format has no place for is added to `lost` as they go by."""
    for take in source.takes():
        language = take.facts.get("language")
        for what, there in (("task", take.task), ("language", language), ("start_ns", take.start_ns is not None)):
            if there and what not in kind.keeps:
                lost[_WORDS[what]] = None
        if "facts" not in kind.keeps:
            for name in take.facts:
                if name != "language" and name not in kind.keeps:
                    lost[f"the fact '{name}' of takes"] = None
        yield take


_WORDS = {  # what of a take may be lost, in words
    "task": "the instruction of takes",
    "language": "the course of the instruction within a take",
    "start_ns": "the wall-clock time of takes",
}
