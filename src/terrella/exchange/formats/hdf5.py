"""HDF5 recordings as Sources: robomimic's layout, DIAMOND's Counter-Strike files, D4RL's flat arrays."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Source, Take
from . import counter_strike, d4rl, flat, hdf5_file, robomimic, rows

SUFFIXES = (".hdf5", ".h5", ".hdf")


def read(path: str | Path, fps: float | None = None) -> Source:
    """An HDF5 file as a Source, or a folder of them in the natural order of their names. Its keys decide the layout.

    robomimic:      data/demo_i/{actions, obs/*, …}: see robomimic.py.
    Counter-Strike: frame_i_x, frame_i_y, …, one file per take: see counter_strike.py.
    D4RL:           observations, actions, terminals, timeouts, …: see d4rl.py.

    fps: rows per second. Default: the file's own (robomimic's control_freq, Counter-Strike's 16), else rows.FPS_UNKNOWN with
    a note. DatasetError where a file is missing, truncated, of an unknown layout, or links to other files.
    """
    path = Path(path)
    rows.check_fps(fps, str(path))
    if path.is_dir():
        files = sorted((p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()), key=rows.natural)
        if not files:
            raise DatasetError(f"{path} has no HDF5 files ({', '.join(SUFFIXES)}); name a folder that has.")
    else:
        files = [path]
    layout = _layout_of(files[0])
    if layout == "counter-strike":
        return counter_strike.read(path, files, fps)
    one = robomimic.read if layout == "robomimic" else d4rl.read
    parts = [one(file, fps) for file in files]
    return parts[0] if len(parts) == 1 else _chained(path.name, parts, files)


def _layout_of(path: Path) -> str:
    with hdf5_file.open_file(path) as file:
        names = hdf5_file.names_in(file)
        if "data" in names and isinstance(data := hdf5_file.child(file, "data"), hdf5_file.Group):
            if any(re.fullmatch(r"demo_\d+", name) for name in hdf5_file.names_in(data)):
                return "robomimic"
        if "frame_0_x" in names and "frame_0_y" in names:
            return "counter-strike"
        heads = {*names, *_below(file, names, "data"), *_below(file, names, "meta")}
        if heads & set(flat.SPELLINGS[rows.ACTION]) and len(heads) > 1:
            return "d4rl"
        if d4rl.groups_of(file):
            return "d4rl"
        contents = ", ".join(sorted(names, key=rows.natural)[:12]) or "nothing"
    raise DatasetError(
        f"{path} is none of the known layouts (robomimic: data/demo_0; Counter-Strike: frame_0_x, frame_0_y; D4RL: "
        f"observations, actions); it holds {contents}. Copy its episodes to data/demo_0, data/demo_1, ... with actions and obs."
    )


def _below(file: hdf5_file.File, names: list[str], name: str) -> list[str]:
    item = hdf5_file.child(file, name) if name in names else None
    return hdf5_file.names_in(item) if isinstance(item, hdf5_file.Group) else []


def _chained(name: str, parts: list[Source], files: list[Path]) -> Source:
    first, sensors = parts[0], dict(parts[0].sensors)
    for part, file in zip(parts, files):
        for sensor in part.sensors.values():
            known = sensors.setdefault(sensor.name, sensor)
            if (sensor.kind, sensor.shape) != (known.kind, known.shape) or part.fps != first.fps:
                raise DatasetError(f"{file} has other sensors than {files[0]}; convert each, and merge the results.")
            if sensor.dtype != known.dtype:
                sensors[sensor.name] = replace(known, dtype=np.promote_types(known.dtype, sensor.dtype).name)
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    facts = {"files": {file.name: part.facts for file, part in zip(files, parts)}}

    def takes() -> Iterator[Take]:
        for part in parts:
            yield from part.takes()

    return replace(first, name=name, sensors=sensors, takes=takes, notes=notes, facts=facts)
