"""convert: from any format that Terrella knows into any other; which one a path holds is told from what lies there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

from ..core.errors import DatasetError
from ..data.format import INFO
from ..data.source import Source
from .formats import pictures

Format = Literal["lerobot", "mcap", "minari", "robomimic", "rollouts", "videos", "images"]
_HDF5 = (".hdf5", ".h5", ".hdf")
_DEEPEST = 4  # folders below the one named that are looked into


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
        from .formats import rollouts

        return rollouts.from_env(name.removeprefix("gym:"), episodes=episodes, seed=seed, fps=fps)
    if "://" in name:
        from .formats import lerobot

        return lerobot.read(name)
    return _open(Path(path), _kind(Path(path)), fps)


def _open(path: Path, kind: str, fps: float | None) -> Source:
    if kind == "lerobot":
        from .formats import lerobot

        return lerobot.read(path)
    if kind == "mcap":
        from .formats import mcap

        return mcap.read(path, verify=True)
    if kind == "minari":
        from .formats import minari

        return minari.read(path, fps)
    if kind == "hdf5":
        from .formats import hdf5

        return hdf5.read(path, fps)
    if kind == "rollouts":
        from .formats import rollouts

        return rollouts.read(path, fps)
    return pictures.read_videos(path) if kind == "videos" else pictures.read_images(path, fps or 10.0)


def _kind(path: Path) -> str:
    if not path.exists():
        raise DatasetError(f"there is nothing at {path}; name a recording.")
    if path.is_file():
        kind = _by_suffix({path.suffix.lower()})
        if kind is None:
            raise DatasetError(f"{path} is of no format that is read here ({', '.join(_read())}).")
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
    raise DatasetError(f"{path} holds no recording that is read here ({', '.join(_read())}).")


def _by_suffix(found: set[str]) -> str | None:
    kinds = {
        "mcap": (".mcap",),
        "hdf5": _HDF5,
        "rollouts": (".npz",),
        "videos": pictures.VIDEOS,
        "images": pictures.IMAGES,
    }
    return next((kind for kind, suffixes in kinds.items() if found & set(suffixes)), None)


def _read() -> list[str]:
    return ["LeRobot v3", "MCAP", "Minari", "HDF5", "npz rollouts", "videos", "images"]


def format_of(path: str | Path) -> Format:
    """The format that a new path's name asks for: MCAP for .mcap, robomimic's HDF5 for .hdf5, else LeRobot."""
    suffix = Path(path).suffix.lower()
    return "mcap" if suffix == ".mcap" else "robomimic" if suffix in _HDF5 else "lerobot"


def write_source(
    source: Source,
    path: str | Path,
    to: Format | None = None,
    rows=None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Writes a Source at a new path; returns sentences on what could not be carried over.

    to: None for what the path's name asks for. rows: formats.lerobot.Rows, how it becomes rows, for LeRobot alone.
    DatasetError where something lies there already.
    """
    to, path = to or format_of(path), Path(path)
    if to not in get_args(Format):
        raise DatasetError(f"there is no format '{to}' to write; choose {', '.join(get_args(Format))}.")
    if to == "lerobot":
        from .formats import lerobot

        return lerobot.write(source, path, rows or lerobot.Rows(), progress)
    if path.exists() and (path.is_file() or any(path.iterdir())):
        raise DatasetError(f"{path} is there already; convert into a new one.")
    if to == "mcap":
        from .formats import mcap

        return mcap.write(source, path, progress=progress)
    if to == "minari":
        from .formats import minari

        return minari.write(source, path, progress=progress)
    if to == "robomimic":
        from .formats import hdf5

        return hdf5.write(source, path, progress=progress)
    if to == "rollouts":
        from .formats import rollouts

        return rollouts.write(source, path, progress=progress)
    write = pictures.write_videos if to == "videos" else pictures.write_images
    return write(source, path, progress=progress)
