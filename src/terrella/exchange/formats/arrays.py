"""Episodes of named arrays, as HDF5, Minari and .npz store them: a format lists the arrays of an episode (`Array`, by place)
and says what the first key of a place means (`names`); sensors, readings and the whole source are made of these."""

import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Lazy, Readings, Sensor, Source, Take
from . import rows

Place = tuple[str | int, ...]  # ("obs", "front"): keys of groups or Dicts, indices of Tuples
Shapes = Mapping[Place, tuple[int, ...]]  # the shape of one row, as the spaces declare it
GYMNASIUM = {  # the arrays of a rollout, as Gymnasium and Minari name them
    "observations": rows.OBSERVATION,
    "actions": rows.ACTION,
    "rewards": rows.REWARD,
    "terminations": rows.DONE,
    "truncations": rows.TRUNCATED,
}
_JPEG = b"\xff\xd8\xff"  # how such a file begins
Guess = Callable[[Place, tuple[int, ...], np.dtype], Sensor | None]


def _unreadable(start: int, stop: int) -> np.ndarray:
    raise DatasetError("only the header of this array is known.")


@dataclass(frozen=True)
class Array:
    """A stored array of an episode, shape (rows, ...); `read(start, stop)` returns some of its rows."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[int, int], np.ndarray] = _unreadable

    @property
    def is_numeric(self) -> bool:
        return self.dtype.kind in "biuf" and self.dtype.itemsize <= 8 and len(self.shape) > 0

    @property
    def is_text(self) -> bool:
        """Whether it holds texts: a numpy type of them, or that of h5py."""
        return self.dtype.kind in "US" or (self.dtype.metadata or {}).get("vlen") is str


def jpeg_rows(count: int, shape: tuple[int, ...], packed: Callable[[int], bytes], where: str) -> Array:
    """An array with one JPEG file per row; reading a damaged one, or one of another size, is a DatasetError."""

    def decode(i: int) -> np.ndarray:
        try:
            with Image.open(io.BytesIO(packed(i)), formats=("JPEG",)) as picture:
                size = (picture.height, picture.width, len(picture.getbands()))
                if size != (*shape[:2], math.prod(shape[2:])):
                    raise DatasetError(f"{where} has a picture of {list(size)} where the space says {list(shape)}.")
                return np.asarray(picture, np.uint8).reshape(shape)
        except rows.PICTURE_ERRORS as error:
            raise DatasetError(f"{where}, row {i}, is a damaged JPEG ({error}); restore it from a copy.") from error

    def read(start: int, stop: int) -> np.ndarray:
        return np.stack([decode(i) for i in range(start, stop)])

    return Array((count, *shape), np.dtype(np.uint8), read)


def fields(place: Place, array: Array) -> Iterator[tuple[Place, Array]]:
    """The array, or one array for each field of its records (a structured dtype); rows that are JPEG files are pictures."""
    for name in array.dtype.names or ():
        base, inner = array.dtype[name].subdtype or (array.dtype[name], ())

        def read(start: int, stop: int, name=name) -> np.ndarray:
            return array.read(start, stop)[name]

        yield from fields((*place, name), Array((*array.shape, *inner), base, read))
    if not array.dtype.names:
        yield place, _unpacked(place, array)


def _unpacked(place: Place, array: Array) -> Array:
    """The pictures of an array with a JPEG file per row: of one length, padded, as ALOHA keeps them, or of lengths of their own."""
    padded = array.dtype == np.uint8 and len(array.shape) == 2
    apart = (array.dtype.metadata or {}).get("vlen") == np.uint8 and len(array.shape) == 1
    if not (padded or apart) or not array.shape[0] or array.read is _unreadable:
        return array

    def packed(i: int) -> bytes:
        return np.asarray(array.read(i, i + 1)[0], np.uint8).tobytes()

    first = packed(0)
    if not first.startswith(_JPEG):
        return array
    try:
        with Image.open(io.BytesIO(first), formats=("JPEG",)) as picture:
            shape = picture.height, picture.width, len(picture.getbands())
    except rows.PICTURE_ERRORS:
        return array
    return jpeg_rows(array.shape[0], shape, packed, f"'{spelled(place)}'")


def texts(array: Array) -> list[str]:
    """The texts of all rows of an array, or of one without rows."""
    stored = np.atleast_1d(array.read(0, array.shape[0] if array.shape else 0))
    return [it.decode("utf-8", "replace") if isinstance(it, bytes) else str(it) for it in stored.tolist()]


def joined(place: Place) -> str:
    """A place as part of a sensor's name: ("agent", 0) -> "agent.0"."""
    return ".".join(rows.clean(part) for key in place for part in str(key).split("."))


def spelled(place: Place) -> str:
    """A place as a path: ("agent", 0) -> "agent/0"."""
    return "/".join(map(str, place))


def sensor_at(names: Mapping[str, str], place: Place, shape: tuple[int, ...], dtype: np.dtype) -> Sensor | None:
    """The sensor of an array with rows of that shape; None for one whose first key is not in `names`: first key ->
    "observation", "action" or "info" (further keys become the sensor's name), or a whole name.
    """
    name = names.get(str(place[0]))
    if name is None:
        return None
    if name in (rows.DONE, rows.TRUNCATED):
        dtype = np.dtype(bool)
    if len(place) > 1 or name == rows.OBSERVATION:
        return rows.sensor_for(name, joined(place[1:]), shape, dtype)
    return rows.sensor_for("", name, shape, dtype)


def columns(
    arrays: Mapping[Place, Array], guess: Guess, what: str, described: Mapping[Place, Sensor] | None = None
) -> tuple[dict[Place, Sensor], list[str]]:
    """Place -> sensor for each array that `guess` recognises (or of `described`, our own description, where that fits the array),
    and a note on each array that is left out."""
    sensors: dict[Place, Sensor] = {}
    notes, taken = [], set()
    for place, array in arrays.items():
        sensor = guess(place, array.shape[1:], array.dtype) if array.is_numeric else None
        if sensor is None:
            why = (
                "a pickle, which is not opened"
                if array.dtype.kind == "O" and not array.is_text
                else "not a known array of numbers"
            )
            notes.append(f"{what} '{spelled(place)}' is left out: it is {why}.")
            continue
        if (
            array.dtype.kind == "f"
            and len(array.shape) == 4
            and rows.picture_layout(array.shape[1:], "uint8") in ("hwc", "chw")
        ):
            notes.append(f"{what} '{spelled(place)}' is kept as numbers; pictures are bytes of 0 to 255 (uint8).")
        own = (described or {}).get(place)
        if own is not None and own.dtype == sensor.dtype:
            own = rows.stored_as(own, array.shape[1:])
            sensor = own if rows.stored_shape(own) == array.shape[1:] else sensor
        sensors[place] = replace(sensor, name=rows.unique(sensor.name, taken))
        taken.add(sensors[place].name)
        parts = (part for key in place for part in str(key).split("."))
        if sensors[place].name != sensor.name or any(rows.clean(part) != part for part in parts):
            notes.append(f"{what} '{spelled(place)}' is called '{sensors[place].name}'.")
    return sensors, notes


def union(episodes: Iterable[Mapping[Place, Array]]) -> dict[Place, Array]:
    """The arrays that any episode has, of a dtype that holds the numbers of all."""
    arrays: dict[Place, Array] = {}
    for episode in episodes:
        for place, array in episode.items():
            known = arrays.setdefault(place, array)
            if known.is_numeric < array.is_numeric:
                arrays[place] = array
            elif known.is_numeric and array.is_numeric and known.dtype != array.dtype:
                arrays[place] = replace(known, dtype=np.promote_types(known.dtype, array.dtype))
    return arrays


def readings(
    arrays: Mapping[Place, Array], sensors: Mapping[Place, Sensor], time_s: np.ndarray, where: str
) -> dict[str, Readings]:
    """The readings of one take, row i at time_s[i]; arrays that it lacks have none. Pictures are read lazily.

    DatasetError where an array has another shape than its sensor, or more rows than there are times.
    """
    result = {}
    for place, sensor in sensors.items():
        what, want = f"'{spelled(place)}' in {where}", rows.stored_shape(sensor)
        if place not in arrays:
            continue
        array = arrays[place]
        if not array.is_numeric:
            raise DatasetError(f"{what} is not an array of numbers with a row for each step; restore it from a copy.")
        if array.shape[1:] != want:
            shape = list(array.shape[1:])
            raise DatasetError(f"{what} is {shape} a row where the first episode has {list(want)}; mend or drop it.")
        count = len(time_s[: array.shape[0]])
        if count < array.shape[0]:
            raise DatasetError(f"{what} has {array.shape[0]} rows where there are {count} observations; mend it.")

        def value(start: int, stop: int, array=array, sensor=sensor, what=what) -> np.ndarray:
            stored = array.read(start, stop)
            if stored.shape != (stop - start, *array.shape[1:]):
                raise DatasetError(f"{what} changed while it was read; read it again.")
            return rows.from_stored(stored.astype(sensor.dtype, copy=False), sensor)

        one = Lazy(count, lambda i, value=value: value(i, i + 1)[0])
        result[sensor.name] = Readings(time_s[:count], value(0, count) if sensor.kind == "vector" else one)
    return result


def source(
    what: str,
    name: str,
    sensors: Mapping[Place, Sensor],
    takes: Callable[[float], Iterable[Take]],
    *,
    fps: float | None,
    about: Mapping | None = None,
    notes: Iterable[str] = (),
    facts: Mapping[str, object] | None = None,
) -> Source:
    """The source of the takes that `takes(fps)` yields.

    fps:   rows per second given by the caller; else `about`'s, else a default with a note.
    about: our own description of the recording (fps, name, robot, facts), where there is one.
    """
    about = about or {}
    rate, more = rows.rate_of(fps, about.get("fps"), what)
    kept = about.get("facts")
    return Source(
        name=str(about.get("name") or name),
        sensors={sensor.name: sensor for sensor in sensors.values()},
        takes=lambda: takes(rate),
        fps=rate,
        robot=str(about.get("robot") or ""),
        notes=(*notes, *more),
        facts={**(kept if isinstance(kept, Mapping) else {}), **(facts or {})},
    )
