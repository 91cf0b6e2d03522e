"""The mapping file of a merge: which number of which robot fills which named number of the merged set, for a person to edit."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from ...core.errors import DatasetError
from ...data.resample import Policy
from ...data.source import Kind, Source
from .units import convert

ACTION = "action"
STATE = "observation.state"
CAMERAS_MASK, EMBODIMENT = "observation.cameras_mask", "embodiment"
NAME = re.compile(r"\w[\w.-]*")  # of a sensor that any format can hold
FOLLOWS = "next."  # next.reward, next.done, …: what followed a row


@dataclass(frozen=True)
class Rows:
    """How the merged rows are made.

    fps:        rows a second.
    images:     policy for images, depth and points.
    continuous: policy for the numbers that are observed.
    actions:    policy for actions.
    max_gap_s:  a row has no value from a sensor that was silent for longer; None for no limit.
    """

    fps: float
    images: Literal["previous", "nearest"] = "previous"
    continuous: Policy = "linear"
    actions: Policy = "previous"
    max_gap_s: float | None = 1.0


@dataclass(frozen=True)
class Dimension:
    """One named number of the merged action or state."""

    unit: str = ""
    frame: str = ""


@dataclass(frozen=True)
class Camera:
    """One merged camera: kind "image" or "depth", size in pixels."""

    kind: Kind
    height: int
    width: int


@dataclass(frozen=True)
class Number:
    """One number of a sensor: it fills the dimension `to`, or is left out for the reason `out`.

    Where `scale` is None the number is converted from `unit` to the dimension's unit (if both are stated), else the
    dimension is filled with scale * number + offset.
    """

    name: str = ""
    to: str = ""
    unit: str = ""
    scale: float | None = None
    offset: float = 0.0
    out: str = ""


@dataclass(frozen=True)
class Vector:
    """One sensor's numbers in their order, and the frame that they are in."""

    numbers: tuple[Number, ...]
    frame: str = ""


@dataclass(frozen=True)
class SourceMapping:
    """Where one source's sensors go.

    path:       where the source lies, the key under which `merge` is given it.
    embodiment: name of the robot; sources of one embodiment share their statistics.
    fps:        rows a second of the source itself, None where each sensor has a clock of its own.
    vectors:    sensor -> its numbers; "action" fills the merged action, every other one the merged state.
    cameras:    sensor (image or depth) -> merged camera.
    keep:       sensor (points, next.reward, a wide vector, …) -> the name under which it is kept whole.
    out:        sensor -> why it is left out.
    notes:      what a person should look at.
    """

    path: str
    embodiment: str
    fps: float | None = None
    vectors: Mapping[str, Vector] = field(default_factory=dict)
    cameras: Mapping[str, str] = field(default_factory=dict)
    keep: Mapping[str, str] = field(default_factory=dict)
    out: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MergeMapping:
    """The whole file. Merged numbers and cameras come in the order in which they stand here."""

    rows: Rows
    action: Mapping[str, Dimension]
    state: Mapping[str, Dimension]
    cameras: Mapping[str, Camera]
    sources: tuple[SourceMapping, ...]

    def dimensions(self, sensor: str) -> Mapping[str, Dimension]:
        """The merged numbers that this sensor may fill."""
        return self.action if sensor == ACTION else self.state

    @property
    def embodiments(self) -> tuple[str, ...]:
        """Each once, in the order of the sources: its place is its number in the merged set."""
        return tuple(dict.fromkeys(source.embodiment for source in self.sources))


def mask_of(sensor: str) -> str:
    """The name of the bool vector that says which of a merged sensor's numbers (or whether a kept one) are there."""
    return f"{sensor}_mask"


MADE = (ACTION, mask_of(ACTION), STATE, mask_of(STATE), CAMERAS_MASK, EMBODIMENT)  # by every merge


def affine(number: Number, dimension: Dimension) -> tuple[float, float]:
    """(scale, offset) from a sensor's number to the dimension that it fills; DatasetError where units do not agree."""
    if number.scale is not None:
        return number.scale, number.offset
    scale, offset = convert(number.unit, dimension.unit)
    return scale, offset + number.offset


def write_mapping(mapping: MergeMapping, path: str | Path) -> None:
    """Writes the file with a comment on each part; `read_mapping` gives the same back."""
    try:
        Path(path).write_text(to_toml(mapping), encoding="utf-8", newline="\n")
    except (OSError, UnicodeEncodeError) as error:
        raise DatasetError(f"cannot write the mapping {path} ({error}); name another place.") from error


def to_toml(mapping: MergeMapping) -> str:
    """The text of the mapping file."""
    rows, gap = mapping.rows, mapping.rows.max_gap_s
    lines = [
        "# Which number of which robot goes where in the merged recording. Edit it and merge again with this file.",
        "",
        "[rows]",
        f"fps = {_value(rows.fps)}  # rows a second of the merged recording",
        f"images = {_value(rows.images)}  # images, depth, points: previous (the newest not later than the row) or nearest",
        f"continuous = {_value(rows.continuous)}  # observed numbers: linear (between two readings), previous or nearest",
        f"actions = {_value(rows.actions)}  # actions: previous (what was being done), nearest or linear",
        "# Longer silences of a sensor, in seconds, are masked; without this line none are.",
        *([f"max_gap_s = {_value(gap)}"] if gap is not None else ["# max_gap_s = 1.0"]),
        "",
        "# The merged numbers, in order. A robot that lacks one has 0 there and False in the mask.",
        *_dimensions("action", mapping.action),
        "",
        *_dimensions("state", mapping.state),
        "",
        '# The merged cameras: kind "image" or "depth"; pictures are fitted into height x width pixels, aspect kept.',
        "[cameras]",
        *(
            f"{_key(name)} = {{ kind = {_value(camera.kind)}, height = {camera.height}, width = {camera.width} }}"
            for name, camera in mapping.cameras.items()
        ),
    ]
    for source in mapping.sources:
        lines += ["", *_source(mapping, source)]
    return "\n".join(lines) + "\n"


def _dimensions(table: str, dimensions: Mapping[str, Dimension]) -> list[str]:
    return [
        f"[{table}]",
        *(f"{_key(name)} = {_inline(unit=it.unit, frame=it.frame)}" for name, it in dimensions.items()),
    ]


def _source(mapping: MergeMapping, source: SourceMapping) -> list[str]:
    lines = [
        "[[source]]",
        f"path = {_value(source.path)}",
        f"embodiment = {_value(source.embodiment)}  # sources of one embodiment share their statistics",
        *([f"fps = {_value(source.fps)}  # its own rows a second"] if source.fps is not None else []),
    ]
    if source.notes:
        lines += ["notes = [  # look at these", *(f"  {_value(note)}," for note in source.notes), "]"]
    if source.cameras:
        lines += ["", "[source.cameras]  # its camera = merged camera", *_pairs(source.cameras)]
    if source.keep:
        lines += ["", "[source.keep]  # kept whole: its sensor = merged sensor", *_pairs(source.keep)]
    if source.out:
        lines += ["", "[source.out]  # left out: its sensor = why", *_pairs(source.out)]
    for name, vector in source.vectors.items():
        lines += [
            "",
            "# One entry per number, in the sensor's order: `to` a merged number, or `out` and why. Units are converted;",
            "# for anything else give scale and offset: merged = scale * number + offset.",
            f"[source.vectors.{_key(name)}]",
            *([f"frame = {_value(vector.frame)}"] if vector.frame else []),
            "numbers = [",
            *(f"  {_number(number, mapping.dimensions(name))}" for number in vector.numbers),
            "]",
        ]
    return lines


def _number(number: Number, dimensions: Mapping[str, Dimension]) -> str:
    scaling = {} if number.scale is None else {"scale": number.scale}
    scaling |= {"offset": number.offset} if number.offset else {}
    text = _inline(name=number.name, unit=number.unit, to=number.to, **scaling, out=number.out) + ","
    unit = dimensions[number.to].unit if number.to in dimensions else ""
    if number.scale is None and number.unit and unit and number.unit != unit:
        return text + f"  # converted to {_value(unit)}"
    return text


def _pairs(table: Mapping[str, str]) -> list[str]:
    return [f"{_key(key)} = {_value(value)}" for key, value in table.items()]


def _inline(**values: object) -> str:
    shown = ", ".join(f"{key} = {_value(value)}" for key, value in values.items() if value != "")
    return f"{{ {shown} }}" if shown else "{}"


def _key(name: str) -> str:
    return name if name and name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _value(name)


def _value(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float) and not isinstance(value, bool):
        return repr(float(value))
    return str(value)


def read_mapping(path: str | Path) -> MergeMapping:
    """Reads a mapping file. DatasetError names the place of whatever is wrong in it: a slip of TOML by its line, else by
    key: an unknown or missing one, a value of the wrong type, a number mapped twice or to a dimension that does not
    exist, units or frames that do not agree. What it says of the sources is compared with them by `check_mapping`.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"there is no mapping to read at {path} ({error.strerror}).") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise DatasetError(f"{path} is not TOML ({error}); mend it there.") from error
    try:
        mapping = _mapping(tables)
        _check_inside(mapping)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error
    return mapping


_NUMBER = (int, float)


def _mapping(tables: dict) -> MergeMapping:
    _only(tables, "the file", rows=dict, action=dict, state=dict, cameras=dict, source=list)
    rows = _table(tables, "rows", "the file")
    allowed = {"fps": _NUMBER, "images": str, "continuous": str, "actions": str, "max_gap_s": _NUMBER}
    _only(rows, "[rows]", **allowed)
    _need(rows, "[rows]", "fps")
    choices = {"images": ("previous", "nearest"), "continuous": get_args(Policy), "actions": get_args(Policy)}
    for key, policies in choices.items():
        if rows.get(key, "previous") not in policies:
            raise DatasetError(f"[rows] {key} = '{rows[key]}' is no policy; choose {', '.join(policies)}.")
    for key in ("fps", "max_gap_s"):
        if key in rows and not 0 < rows[key] < float("inf"):
            raise DatasetError(f"[rows] {key} = {rows[key]} must be positive and finite.")
    sources = tables.get("source", [])
    if not sources or not all(isinstance(source, dict) for source in sources):
        raise DatasetError("it has no [[source]]; add one for each recording to merge.")
    return MergeMapping(
        rows=Rows(**{"max_gap_s": None, **rows, "fps": float(rows["fps"])}),
        action=_read_dimensions(tables, "action"),
        state=_read_dimensions(tables, "state"),
        cameras={name: _read_camera(name, camera) for name, camera in tables.get("cameras", {}).items()},
        sources=tuple(_read_source(source, f"source {i}") for i, source in enumerate(sources, 1)),
    )


def _read_dimensions(tables: dict, table: str) -> dict[str, Dimension]:
    found = {}
    for name in _table(tables, table, "the file"):
        values, where = _table(tables[table], name, f"[{table}]"), f"[{table}] '{name}'"
        _only(values, where, unit=str, frame=str)
        found[name] = Dimension(**values)
    return found


def _read_camera(name: str, values: Any) -> Camera:
    where = f"[cameras] '{name}'"
    if not isinstance(values, dict):
        raise DatasetError(f"{where} must be a table {{ kind, height, width }}.")
    _only(values, where, kind=str, height=int, width=int)
    _need(values, where, "kind", "height", "width")
    if values["kind"] not in ("image", "depth"):
        raise DatasetError(f"{where} has kind '{values['kind']}'; choose image or depth.")
    if not (0 < values["height"] <= 16384 and 0 < values["width"] <= 16384):
        raise DatasetError(f"{where} is {values['height']} x {values['width']}; give 1 to 16384 pixels each way.")
    return Camera(**values)


def _read_source(values: dict, where: str) -> SourceMapping:
    allowed = {"path": str, "embodiment": str, "fps": _NUMBER, "notes": list}
    _only(values, where, **allowed, cameras=dict, keep=dict, out=dict, vectors=dict)
    _need(values, where, "path", "embodiment")
    where = f"{where} ({values['embodiment']})"
    if "fps" in values and not 0 < values["fps"] < float("inf"):
        raise DatasetError(f"{where} fps = {values['fps']} must be positive and finite.")
    for table in ("cameras", "keep", "out"):
        _only(values.get(table, {}), f"{where} {table}", **dict.fromkeys(values.get(table, {}), str))
    notes = tuple(values.get("notes", ()))
    if not all(isinstance(note, str) for note in notes):
        raise DatasetError(f"{where} notes must be a list of sentences.")
    vectors = {}
    for name in values.get("vectors", {}):
        place, vector = f"{where} vectors '{name}'", _table(values["vectors"], name, f"{where} vectors")
        _only(vector, place, frame=str, numbers=list)
        _need(vector, place, "numbers")
        numbers = tuple(_read_number(number, f"{place} number {i}") for i, number in enumerate(vector["numbers"]))
        vectors[name] = Vector(numbers, vector.get("frame", ""))
    rest = {table: values.get(table, {}) for table in ("cameras", "keep", "out")}
    fps = float(values["fps"]) if "fps" in values else None
    return SourceMapping(values["path"], values["embodiment"], fps, vectors, **rest, notes=notes)


def _read_number(values: Any, where: str) -> Number:
    if not isinstance(values, dict):
        raise DatasetError(f"{where} must be a table {{ name, unit, to }} or {{ name, out }}.")
    _only(values, where, name=str, to=str, unit=str, scale=_NUMBER, offset=_NUMBER, out=str)
    for key in ("scale", "offset"):
        if abs(values.get(key, 0)) == float("inf") or values.get(key, 0) != values.get(key, 0):
            raise DatasetError(f"{where} {key} = {values[key]} must be finite.")
        if key in values:
            values[key] = float(values[key])
    if values.get("scale") == 0:
        raise DatasetError(f"{where} has scale 0, which keeps nothing of it; give `out` and why instead.")
    return Number(**values)


def _table(values: dict, key: str, where: str) -> dict:
    found = values.get(key, {})
    if not isinstance(found, dict):
        raise DatasetError(f"{where}: '{key}' must be a table.")
    return found


def _only(values: dict, where: str, **allowed: Any) -> None:
    for key, value in values.items():
        if key not in allowed:
            raise DatasetError(f"{where} has an unknown key '{key}'; it may have {', '.join(allowed) or 'none'}.")
        if not isinstance(value, allowed[key]) or (isinstance(value, bool) and allowed[key] is not bool):
            kinds = allowed[key] if isinstance(allowed[key], tuple) else (allowed[key],)
            wanted = " or ".join(kind.__name__ for kind in kinds)
            raise DatasetError(f"{where} has {key} = {value!r}, which should be of type {wanted}.")


def _need(values: dict, where: str, *keys: str) -> None:
    for key in keys:
        if key not in values:
            raise DatasetError(f"{where} lacks '{key}'; add it.")


def _check_inside(mapping: MergeMapping) -> None:
    """What must hold whatever the sources are."""
    taken = set(MADE) | set(mapping.cameras)
    for name in mapping.cameras:
        if not name.startswith("observation.") or name in MADE or not NAME.fullmatch(name):
            raise DatasetError(
                f"[cameras] '{name}' must begin with 'observation.', have only letters, digits, '.', '_' and '-', and be "
                f"none of {', '.join(MADE)}."
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
                    raise DatasetError(
                        f"{where} {table}: '{filled[to]}' and '{sensor}' both fill '{to}'; take one out."
                    )
                if table == "cameras" and to not in mapping.cameras:
                    raise DatasetError(f"{where} cameras: '{sensor}' goes to '{to}', which [cameras] does not have.")
                filled[to] = sensor
    if len({source.path for source in mapping.sources}) < len(mapping.sources):
        raise DatasetError("two sources have one path; merge a recording once.")


def _check_numbers(mapping: MergeMapping, source: SourceMapping, where: str) -> None:
    filled: dict[tuple[bool, str], str] = {}
    for sensor, vector in source.vectors.items():
        dimensions, table = mapping.dimensions(sensor), "action" if sensor == ACTION else "state"
        for place, number in enumerate(vector.numbers):
            this = f"{where} vectors '{sensor}' number {place}" + (f" ({number.name})" if number.name else "")
            if bool(number.to) == bool(number.out):
                raise DatasetError(f"{this} needs either `to` or `out`.")
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
                    f"{this} is in the frame '{vector.frame}' and '{number.to}' in '{dimension.frame}'; only a person "
                    "can say that these are one: give both one name, or give it a dimension of its own."
                )
            try:
                affine(number, dimension)
            except DatasetError as error:
                raise DatasetError(f"{this}: {error}") from error


def check_mapping(mapping: MergeMapping, sources: Mapping[str, Source]) -> None:
    """DatasetError where the mapping speaks of what the sources do not have (a path, a sensor, a number, another kind), or
    not of a source at all.
    """
    _check_inside(mapping)
    kept: dict[str, tuple] = {}
    for count, source in enumerate(mapping.sources, 1):
        where = f"source {count} ({source.embodiment})"
        if source.path not in sources:
            raise DatasetError(f"{where} has the path '{source.path}'; given were {', '.join(sources)}.")
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
                    f"{where} keep: '{name}' is {sensor.dtype} of shape {sensor.shape}; text cannot be kept, nor, of what "
                    "followed, more than one number."
                )
            if name == ACTION or name.startswith(FOLLOWS) != to.startswith(FOLLOWS):
                raise DatasetError(
                    f"{where} keep: '{name}' cannot be kept as '{to}'; begin both with '{FOLLOWS}', or none."
                )
            form = (sensor.kind, sensor.shape, sensor.dtype, sensor.names)
            form = form[:2] if name.startswith(FOLLOWS) else form
            if kept.setdefault(to, form) != form:
                raise DatasetError(f"{where} keep: '{name}' has another form than what else fills '{to}'; rename one.")
    for path in sources:
        if path not in {source.path for source in mapping.sources}:
            raise DatasetError(f"the mapping has no [[source]] with the path '{path}'; add one, or leave that out.")
