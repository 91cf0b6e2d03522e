"""D4RL's flat HDF5 arrays (observations, actions, rewards, terminals, timeouts), split into episodes when read."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...core.errors import DatasetError
from ...data.source import Sensor, Source, Take
from . import arrays, hdf5_file, rows

_NAMES = {
    "observations": rows.OBSERVATION,
    "actions": rows.ACTION,
    "rewards": rows.REWARD,
    "terminals": rows.DONE,
    "timeouts": rows.TRUNCATED,
    "infos": rows.INFO,
}
_NEXT = ("next_observations",)


def read(path: Path, fps: float | None) -> Source:
    """A file of flat arrays, split into takes after each terminal and each timeout; rows after the last one are a take too.

    With next_observations a take has one more observation than actions, else as many. Other arrays with a row per step
    become "info.*"; metadata/* and the attributes are kept in facts["d4rl"].
    """
    with hdf5_file.open_file(path) as file:
        count = len(hdf5_file.numeric(file, "actions"))
        stored = dict(hdf5_file.all_datasets(file))
        has_next = _NEXT in stored
        metadata = {place[1]: rows.json_or_none(it[()]) for place, it in stored.items() if _is_metadata(place, it)}
        flat = hdf5_file.headers(item for item in stored.items() if item[0][0] not in ("metadata", *_NEXT))
        for place in flat:
            if place[0] in _NAMES and place[0] != "infos":
                hdf5_file.numeric(hdf5_file.subgroup(file, *place[:-1]), place[-1], count)  # raises where it is not
        flat = {place: it if it.shape[:1] == (count,) else arrays.Array((), it.dtype) for place, it in flat.items()}
        sensors, notes = arrays.columns(flat, _guess, "D4RL's")
        ends = np.zeros(count, bool)
        for name in ("terminals", "timeouts"):
            if (name,) in stored:
                ends |= stored[name,][()].reshape(-1).astype(bool)
        facts = {"attributes": hdf5_file.attributes(file)}
        facts |= {"metadata": {name: it for name, it in metadata.items() if it is not None}} if metadata else {}
    stops = sorted({*(np.flatnonzero(ends) + 1).tolist(), count} - {0})
    if not stops:
        raise DatasetError(f"{path} has no rows; there is nothing to read.")

    def takes(rate: float) -> Iterator[Take]:
        for start, stop in zip([0, *stops[:-1]], stops):
            with hdf5_file.open_file(path) as file:
                parts = {}
                for place in sensors:
                    after = [(_NEXT, stop - 1, stop)] if has_next and place == ("observations",) else []
                    parts[place] = hdf5_file.concatenated(file, count, (place, start, stop), *after)
                time_s = np.arange(stop - start + has_next) / rate
                yield Take(arrays.readings(parts, sensors, time_s, str(path)), facts={"rows": [start, stop]})

    return arrays.source("D4RL's layout", path.stem, sensors, takes, fps=fps, notes=notes, facts={"d4rl": facts})


def _guess(place: arrays.Place, shape: tuple[int, ...], dtype: np.dtype) -> Sensor | None:
    return arrays.sensor_at(_NAMES, place if place[0] in _NAMES else ("infos", *place), shape, dtype)


def _is_metadata(place: tuple[str, ...], item: hdf5_file.Dataset) -> bool:
    return place[0] == "metadata" and len(place) == 2 and item.ndim == 0
