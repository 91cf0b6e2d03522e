"""Flat HDF5 arrays, as D4RL and OGBench keep them (observations, actions, rewards, terminals, timeouts), cut into episodes."""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Source, Take
from . import arrays, flat, hdf5_file, rows, stacked


def read(path: Path, fps: float | None) -> Source:
    """A file of flat arrays, cut into takes as flat.py says.

    With next_observations a take has one more observation than actions. Other arrays with a row per step become "info.*"
    (pictures: observations); metadata/* and the attributes are kept in facts["d4rl"].
    """
    with hdf5_file.open_file(path) as file:
        if groups := groups_of(file):
            return _grouped(path, file, groups, fps)
        episodes = stacked.split(_stored(file), str(path))
        bare = flat.is_bare(episodes.stored)
        sensors, notes = arrays.columns(episodes.stored, partial(flat.guess, bare), "the array")
        metadata, more = _metadata(file)
        more += [
            f"'{arrays.spelled(place)}' holds JPEG files, read as RGB; some recorders exchange red and blue: look at one."
            for place, item in hdf5_file.all_datasets(file)
            if item.ndim in (1, 2) and len(episodes.stored.get(flat.home(place), item).shape) == 4
        ]
        facts = {"attributes": hdf5_file.attributes(file), **({"metadata": metadata} if metadata else {})}
    if not episodes.spans[-1][1]:
        raise DatasetError(f"{path} has no rows; there is nothing to read.")

    def takes(rate: float) -> Iterator[Take]:
        with hdf5_file.open_file(path) as file:
            episodes = stacked.split(_stored(file), str(path))
            for number, span in enumerate(episodes.spans):
                take = episodes.take(number, sensors, lambda count: np.arange(count) / rate, str(path))
                yield replace(take, facts={"rows": list(span), **take.facts})

    notes += [*more, *episodes.notes, *([flat.BARE] if bare else [])]
    return arrays.source("D4RL's layout", path.stem, sensors, takes, fps=fps, notes=notes, facts={"d4rl": facts})


def groups_of(file: hdf5_file.File) -> list[str]:
    """The paths of groups that hold an episode each: traj_0 and traj_1, 0 and 1, data/demo-0 and data/demo-1, in their order."""
    for head in ("", "data/", "episodes/", "trajectories/"):
        parent = hdf5_file.subgroup(file, head[:-1]) if head and head[:-1] in file else file
        names = [name for name in hdf5_file.names_in(parent) if re.fullmatch(r"\D{0,40}\d+", name)]
        groups = [name for name in names if isinstance(hdf5_file.child(parent, name), hdf5_file.Group)]
        if (not head or parent is not file) and any(
            set(flat.SPELLINGS[rows.ACTION]).intersection(hdf5_file.subgroup(parent, name)) for name in groups
        ):
            return [f"{head}{name}" for name in sorted(groups, key=rows.natural)]
    return []


def _grouped(path: Path, file: hdf5_file.File, groups: list[str], fps: float | None) -> Source:
    """A file with a group for each episode, as ManiSkill keeps them; what its simulator's states were is kept as "info.*"."""
    every = {name: flat.split(_stored(file, name), f"{path}/{name}", whole=True) for name in groups}
    stored = arrays.union(episodes.stored for episodes in every.values())
    bare = flat.is_bare(stored)
    sensors, notes = arrays.columns(stored, partial(flat.guess, bare), "the array")
    others = [name for name in hdf5_file.names_in(file) if not any(it.split("/")[0] == name for it in groups)]
    notes += [f"'{name}' is left out: it is no episode." for name in others]
    facts = {"attributes": hdf5_file.attributes(file)}

    def takes(rate: float) -> Iterator[Take]:
        for name in groups:
            with hdf5_file.open_file(path) as again:
                where = f"{path}/{name}"
                episode = flat.split(_stored(again, name), where, whole=True)
                yield episode.take(0, sensors, lambda count: np.arange(count) / rate, where)

    notes += [flat.BARE] if bare else []
    return arrays.source("the file", path.stem, sensors, takes, fps=fps, notes=notes, facts={"hdf5": facts})


def _stored(file: hdf5_file.File, group: str = "") -> dict[arrays.Place, arrays.Array]:
    """The arrays of a file, or of a group of it, by their places there."""
    stored: dict[arrays.Place, arrays.Array] = {}
    above = tuple(group.split("/")) if group else ()
    for place, item in hdf5_file.all_datasets(hdf5_file.subgroup(file, *above)):
        if place[0] != "metadata":
            stored |= arrays.fields(flat.home(place), hdf5_file.array_at(file, (*above, *place), item))
    return stored


def _metadata(file: hdf5_file.File) -> tuple[dict[str, object], list[str]]:
    """The single values under metadata/, and a note on each other array there."""
    if "metadata" not in file:
        return {}, []
    kept, notes = {}, []
    for place, item in hdf5_file.all_datasets(hdf5_file.subgroup(file, "metadata")):
        value = rows.json_or_none(item[()]) if item.ndim == 0 else None
        if value is None:
            notes.append(f"'metadata/{arrays.spelled(place)}' is left out: it is not a single value.")
        else:
            kept[arrays.spelled(place)] = value
    return kept, notes
