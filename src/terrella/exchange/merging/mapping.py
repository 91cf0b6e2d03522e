"""The mapping of a merge: which number of each robot fills which merged number; and its checks."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ...core.errors import DatasetError
from ...data.resample import Policy
from ...data.source import Source
from ..formats.rows import MAX_SIDE
from .units import convert

ACTION = "action"
STATE = "observation.state"
CAMERAS_MASK, EMBODIMENT = "observation.cameras_mask", "embodiment"
NAME = re.compile(r"\w[\w.-]*")  # a sensor name that every format can store
FOLLOWS = "next."  # next.reward, next.done, …: outcomes of a row


@dataclass(frozen=True)
class MergeRows:
    """How the merged rows are made."""

    fps: float  # rows per second
    images: Literal["previous", "nearest"] = "previous"  # policy for images, depth and points
    continuous: Policy = "linear"  # policy for observed numbers
    actions: Policy = "previous"  # policy for actions
    max_gap_s: float | None = 1.0  # longer gaps of a sensor are masked; None for no limit


@dataclass(frozen=True)
class Dimension:
    """One named number of the merged action or state."""

    unit: str = ""
    frame: str = ""


@dataclass(frozen=True)
class MergedCamera:
    """One merged camera: kind "image" or "depth", size in pixels."""

    kind: Literal["image", "depth"]
    height: int
    width: int


@dataclass(frozen=True)
class Number:
    """One number of a sensor: it fills the dimension `to` with scale * number + offset, or is left out for the reason `out`. With
    `scale` None it is converted from `unit` to the dimension's unit, where both are stated."""

    name: str = ""
    to: str = ""
    unit: str = ""
    scale: float | None = None
    offset: float = 0.0
    out: str = ""


@dataclass(frozen=True)
class Vector:
    """One sensor's numbers in order, and their coordinate frame."""

    numbers: tuple[Number, ...]
    frame: str = ""


@dataclass(frozen=True)
class SourceMapping:
    """Where one source's sensors go."""

    path: str  # of the source, and its key in `merge`
    embodiment: str  # name of the robot; sources of one embodiment share their statistics
    fps: float | None = None  # rows per second of the source, None where each sensor has its own clock
    # sensor -> its numbers; "action" fills the merged action, every other sensor the merged state
    vectors: Mapping[str, Vector] = field(default_factory=dict)
    cameras: Mapping[str, str] = field(default_factory=dict)  # sensor (image or depth) -> merged camera
    # sensor (points, next.reward, a wide vector, …) -> the name under which it is kept whole
    keep: Mapping[str, str] = field(default_factory=dict)
    out: Mapping[str, str] = field(default_factory=dict)  # sensor -> why it is left out
    notes: tuple[str, ...] = ()  # guesses that a person should check


@dataclass(frozen=True)
class MergeMapping:
    """The whole mapping. Merged numbers and cameras keep the order of these tables."""

    rows: MergeRows
    action: Mapping[str, Dimension]
    state: Mapping[str, Dimension]
    cameras: Mapping[str, MergedCamera]
    sources: tuple[SourceMapping, ...]

    def dimensions(self, sensor: str) -> Mapping[str, Dimension]:
        """The merged numbers that this sensor may fill."""
        return self.action if sensor == ACTION else self.state

    @property
    def embodiments(self) -> tuple[str, ...]:
        """The robots in the order of the sources; the index of one is its number in the merged set."""
        return tuple(dict.fromkeys(source.embodiment for source in self.sources))


def mask_of(sensor: str) -> str:
    """The name of the mask of a merged sensor's numbers, or of a sensor that is kept whole."""
    return f"{sensor}_mask"


MERGED = (ACTION, mask_of(ACTION), STATE, mask_of(STATE), CAMERAS_MASK, EMBODIMENT)  # sensors of every merge


def affine(number: Number, dimension: Dimension) -> tuple[float, float]:
    """(scale, offset) from a sensor's number to the dimension that it fills; DatasetError where units do not agree."""
    if number.scale is not None:
        return number.scale, number.offset
    scale, offset = convert(number.unit, dimension.unit)
    return scale, offset + number.offset


def check_inside(mapping: MergeMapping) -> None:
    """Checks what does not depend on the sources; DatasetError where it does not hold."""
    taken = set(MERGED) | set(mapping.cameras)
    for what, value in (("fps", mapping.rows.fps), ("max_gap_s", mapping.rows.max_gap_s)):
        _check_positive(value, f"[rows] {what}")
    for name, camera in mapping.cameras.items():
        if not (0 < camera.height <= MAX_SIDE and 0 < camera.width <= MAX_SIDE):
            size = f"{camera.height} x {camera.width}"
            raise DatasetError(f"[cameras] '{name}' is {size}; give 1 to {MAX_SIDE} pixels each way.")
        if not name.startswith("observation.") or name in MERGED or not NAME.fullmatch(name):
            raise DatasetError(
                f"[cameras] '{name}' must begin with 'observation.', have only letters, digits, '.', '_' and '-', and be "
                f"none of {', '.join(MERGED)}."
            )
    for to in {to for source in mapping.sources for to in source.keep.values()}:
        if {to, mask_of(to)} & taken or not to.startswith(("observation.", FOLLOWS)) or not NAME.fullmatch(to):
            raise DatasetError(
                f"'{to}' cannot name a kept sensor: take a free name of letters, digits, '.', '_' and '-' after "
                f"'observation.' or '{FOLLOWS}'."
            )
        taken |= {to, mask_of(to)}
    for count, source in enumerate(mapping.sources, 1):
        where = f"source {count} ({source.embodiment})"
        _check_positive(source.fps, f"{where} fps")
        places: dict[str, str] = {}
        for table in ("vectors", "cameras", "keep", "out"):
            for sensor in getattr(source, table):
                if sensor in places:
                    raise DatasetError(f"{where} has '{sensor}' under {places[sensor]} and {table}; leave it in one.")
                places[sensor] = table
        _check_numbers(mapping, source, where)
        for table in ("cameras", "keep"):
            filled: dict[str, str] = {}
            for sensor, to in getattr(source, table).items():
                if to in filled:
                    raise DatasetError(f"{where} {table}: '{filled[to]}' and '{sensor}' both fill '{to}'; drop one.")
                if table == "cameras" and to not in mapping.cameras:
                    raise DatasetError(f"{where} cameras: '{sensor}' goes to '{to}', which [cameras] does not have.")
                filled[to] = sensor
    if len({source.path for source in mapping.sources}) < len(mapping.sources):
        raise DatasetError("two sources have one path; merge a recording once.")


def _check_positive(value: float | None, what: str) -> None:
    if value is not None and not 0 < value < math.inf:
        raise DatasetError(f"{what} = {value:g} must be positive and finite.")


def _check_numbers(mapping: MergeMapping, source: SourceMapping, where: str) -> None:
    filled: dict[tuple[bool, str], str] = {}
    for sensor, vector in source.vectors.items():
        dimensions, table = mapping.dimensions(sensor), "action" if sensor == ACTION else "state"
        for place, number in enumerate(vector.numbers):
            this = f"{where} vectors '{sensor}' number {place}" + (f" ({number.name})" if number.name else "")
            if bool(number.to) == bool(number.out):
                raise DatasetError(f"{this} needs either `to` or `out`.")
            for key, value in (("scale", number.scale or 0), ("offset", number.offset)):
                if not math.isfinite(value):
                    raise DatasetError(f"{this} {key} = {value} must be finite.")
            if number.scale == 0:
                raise DatasetError(f"{this} has scale 0, which erases it; give `out` with a reason instead.")
            if number.out:
                continue
            if number.to not in dimensions:
                raise DatasetError(f"{this} goes to '{number.to}', which [{table}] does not have.")
            before = filled.setdefault((sensor == ACTION, number.to), this)
            if before != this:
                raise DatasetError(f"'{number.to}' of [{table}] is filled twice: by {before} and by {this}.")
            dimension = dimensions[number.to]
            if vector.frame and dimension.frame and vector.frame != dimension.frame:
                raise DatasetError(
                    f"{this} is in the frame '{vector.frame}' and '{number.to}' in '{dimension.frame}'; give both the same "
                    "name if they are the same frame, or give the number its own dimension."
                )
            try:
                affine(number, dimension)
            except DatasetError as error:
                raise DatasetError(f"{this}: {error}") from error


def check_mapping(mapping: MergeMapping, sources: Mapping[str, Source]) -> None:
    """DatasetError where the mapping and the sources do not match: paths, sensors, numbers, kinds."""
    check_inside(mapping)
    kept: dict[str, tuple] = {}
    for count, source in enumerate(mapping.sources, 1):
        where = f"source {count} ({source.embodiment})"
        if source.path not in sources:
            raise DatasetError(f"{where} has the path '{source.path}'; the given sources are {', '.join(sources)}.")
        sensors = sources[source.path].sensors
        for table in ("vectors", "cameras", "keep", "out"):
            for name in getattr(source, table):
                if name not in sensors:
                    raise DatasetError(f"{where} {table}: there is no sensor '{name}'; it has {', '.join(sensors)}.")
        for name, vector in source.vectors.items():
            sensor = sensors[name]
            if sensor.kind != "vector" or sensor.shape != (len(vector.numbers),) or sensor.dtype == "string":
                raise DatasetError(
                    f"{where} vectors '{name}' lists {len(vector.numbers)} numbers; that sensor is of kind "
                    f"{sensor.kind}, {sensor.dtype} and shape {sensor.shape}: list each of its numbers once."
                )
            for place, number in enumerate(vector.numbers):
                if sensor.names and number.name and number.name != sensor.names[place]:
                    raise DatasetError(
                        f"{where} vectors '{name}' number {place} is called '{number.name}' but is "
                        f"'{sensor.names[place]}' there; keep the sensor's order."
                    )
        for name, to in source.cameras.items():
            if sensors[name].kind != mapping.cameras[to].kind:
                raise DatasetError(
                    f"{where} cameras: '{name}' is of kind {sensors[name].kind}, '{to}' is {mapping.cameras[to].kind}."
                )
        for name, to in source.keep.items():
            sensor = sensors[name]
            if sensor.kind in ("image", "depth"):
                raise DatasetError(f"{where} keep: '{name}' is of kind {sensor.kind}; put it under cameras.")
            if sensor.dtype == "string" or (name.startswith(FOLLOWS) and sensor.shape != (1,)):
                raise DatasetError(
                    f"{where} keep: '{name}' is {sensor.dtype} of shape {sensor.shape}; text cannot be kept, nor an "
                    f"outcome ({FOLLOWS}…) of more than one number."
                )
            if name == ACTION or name.startswith(FOLLOWS) != to.startswith(FOLLOWS):
                raise DatasetError(
                    f"{where} keep: '{name}' cannot be kept as '{to}'; begin both or neither with '{FOLLOWS}'."
                )
            form = (sensor.kind, sensor.shape, sensor.dtype, sensor.names)
            form = form[:2] if name.startswith(FOLLOWS) else form
            if kept.setdefault(to, form) != form:
                raise DatasetError(
                    f"{where} keep: '{name}' differs in shape or dtype from others kept as '{to}'; rename one."
                )
    for path in sources:
        if path not in {source.path for source in mapping.sources}:
            raise DatasetError(f"the mapping has no [[source]] with the path '{path}'; add one, or leave that out.")
