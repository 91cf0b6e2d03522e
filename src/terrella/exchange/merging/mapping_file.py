"""The mapping of a merge as a TOML file that explains itself, for a person to edit."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import tomlkit
from tomlkit.items import InlineTable, Table

from ...core.errors import DatasetError
from .mapping import Camera, Dimension, MergeMapping, Number, Rows, SourceMapping, Vector, check_inside

_T = TypeVar("_T")
_TOP = "Which number of which robot goes where in the merged recording. Edit it and merge again with this file."
_ROWS = {
    "fps": "rows a second of the merged recording",
    "images": "images, depth, points: previous (the newest not later than the row) or nearest",
    "continuous": "observed numbers: linear (between two readings), previous or nearest",
    "actions": "actions: previous (what was being done), nearest or linear",
    "max_gap_s": "longer silences of a sensor, in seconds, are masked; without this line none are",
}
_DIMENSIONS = "The merged numbers, in order. A robot that lacks one has 0 there and False in the mask."
_CAMERAS = 'The merged cameras: kind "image" or "depth"; pictures are fitted into height x width pixels, aspect kept.'
_SOURCE = {
    "cameras": "its camera = merged camera",
    "keep": "kept whole: its sensor = merged sensor",
    "out": "left out: its sensor = why",
}
_NUMBERS = (
    "One entry per number, in the sensor's order: `to` a merged number, or `out` and why. Units are converted;",
    "for anything else give scale and offset: merged = scale * number + offset.",
)


def write_mapping(mapping: MergeMapping, path: str | Path) -> None:
    """Writes the file with a comment on each part; `read_mapping` gives the same back."""
    try:
        Path(path).write_text(to_toml(mapping), encoding="utf-8", newline="\n")
    except (OSError, UnicodeEncodeError) as error:
        raise DatasetError(f"cannot write the mapping {path} ({error}); name another place.") from error


def to_toml(mapping: MergeMapping) -> str:
    """The text of the mapping file."""
    file = tomlkit.document()
    file.add(tomlkit.comment(_TOP))
    file.add(tomlkit.nl())
    rows = tomlkit.table()
    for key, words in _ROWS.items():
        value = getattr(mapping.rows, key)
        if value is None:
            rows.add(tomlkit.comment(f"{key} = 1.0  # {words}"))
        else:
            rows.add(key, value)
            rows[key].comment(words)
    file.add("rows", rows)
    for name, dimensions in (("action", mapping.action), ("state", mapping.state)):
        file.add(tomlkit.nl())
        file.add(name, _table({key: _inline(it) for key, it in dimensions.items()}, _DIMENSIONS))
    file.add(tomlkit.nl())
    file.add("cameras", _table({key: _inline(it) for key, it in mapping.cameras.items()}, _CAMERAS))
    sources = tomlkit.aot()
    for source in mapping.sources:
        sources.append(_source(mapping, source))
    file.add("source", sources)
    return tomlkit.dumps(file)


def _table(values: Mapping[str, Any], *comments: str) -> Table:
    table = tomlkit.table()
    for words in comments:
        table.add(tomlkit.comment(words))
    for key, value in values.items():
        table.add(tomlkit.key([key]) if not key else key, value)
    return table


def _inline(item: Any) -> InlineTable:
    """A dataclass as { key = value, … }, without what is as by default."""
    inline = tomlkit.inline_table()
    for field in fields(item):
        value = getattr(item, field.name)
        if value != field.default:
            inline.add(field.name, value)
    return inline


def _source(mapping: MergeMapping, source: SourceMapping) -> Table:
    table = _table({"path": source.path, "embodiment": source.embodiment})
    table["embodiment"].comment("sources of one embodiment share their statistics")
    if source.fps is not None:
        table.add("fps", source.fps)
        table["fps"].comment("its own rows a second")
    if source.notes:
        table.add(tomlkit.comment("look at these"))
        table.add("notes", _lines((note, "") for note in source.notes))
    for key, words in _SOURCE.items():
        if getattr(source, key):
            table.add(key, _table(getattr(source, key), words))
    if source.vectors:
        vectors = tomlkit.table(is_super_table=True)
        for name, vector in source.vectors.items():
            found = _table({"frame": vector.frame} if vector.frame else {}, *_NUMBERS)
            units = {to: it.unit for to, it in mapping.dimensions(name).items()}
            found.add("numbers", _lines((_inline(it), _converted(it, units.get(it.to, ""))) for it in vector.numbers))
            vectors.add(name, found)
        table.add("vectors", vectors)
    return table


def _converted(number: Number, unit: str) -> str:
    differs = number.scale is None and number.unit and unit and number.unit != unit
    return f'converted to "{unit}"' if differs else ""


def _lines(items: Any) -> Any:
    array = tomlkit.array()
    for item, words in items:
        array.add_line(item, indent="  ", comment=words or None)
    if len(array):
        array.add_line(indent="")
    return array


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
        mapping = mapping_of(tables)
        check_inside(mapping)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error
    return mapping


def mapping_of(tables: dict) -> MergeMapping:
    """The mapping that parsed TOML holds; DatasetError where a key or a value is wrong."""
    known = ("rows", "action", "state", "cameras", "source")
    for key, value in tables.items():
        if key not in known:
            raise DatasetError(f"the file has an unknown key '{key}'; it may have {', '.join(known)}.")
        if not isinstance(value, list if key == "source" else dict):
            raise DatasetError(f"the file: '{key}' must be {'[[source]] tables' if key == 'source' else 'a table'}.")
    rows = {"max_gap_s": None, **tables.get("rows", {})}
    for key, hint in get_type_hints(Rows).items():
        policies = [policy for part in (hint, *get_args(hint)) for policy in get_args(part) if isinstance(policy, str)]
        if policies and isinstance(rows.get(key), str) and rows[key] not in policies:
            raise DatasetError(f"[rows] {key} = '{rows[key]}' is no policy; choose {', '.join(policies)}.")
    found = _made(Rows, rows, "[rows]")
    for key in ("fps", "max_gap_s"):
        _positive(getattr(found, key), f"[rows] {key}")
    sources = tables.get("source", [])
    if not sources:
        raise DatasetError("it has no [[source]]; add one for each recording to merge.")
    return MergeMapping(
        rows=replace(found, fps=float(found.fps)),
        action={name: _made(Dimension, it, f"[action] '{name}'") for name, it in tables.get("action", {}).items()},
        state={name: _made(Dimension, it, f"[state] '{name}'") for name, it in tables.get("state", {}).items()},
        cameras={name: _camera(it, f"[cameras] '{name}'") for name, it in tables.get("cameras", {}).items()},
        sources=tuple(_read_source(source, f"source {i}") for i, source in enumerate(sources, 1)),
    )


def _camera(values: Any, where: str) -> Camera:
    camera = _made(Camera, values, where)
    if camera.kind not in ("image", "depth"):
        raise DatasetError(f"{where} has kind '{camera.kind}'; choose image or depth.")
    if not (0 < camera.height <= 16384 and 0 < camera.width <= 16384):
        raise DatasetError(f"{where} is {camera.height} x {camera.width}; give 1 to 16384 pixels each way.")
    return camera


def _read_source(values: Any, where: str) -> SourceMapping:
    source = _made(SourceMapping, values, where)
    where = f"{where} ({source.embodiment})"
    _positive(source.fps, f"{where} fps")
    for table in ("cameras", "keep", "out", "notes"):
        given = getattr(source, table)
        for key, value in given.items() if isinstance(given, dict) else enumerate(given):
            if not isinstance(value, str):
                raise DatasetError(f"{where} {table} has {key} = {value!r}, which should be of type str.")
    vectors = {}
    for name, given in source.vectors.items():
        place = f"{where} vectors '{name}'"
        vector = _made(Vector, given, place)
        numbers = (_number(it, f"{place} number {i}") for i, it in enumerate(vector.numbers))
        vectors[name] = replace(vector, numbers=tuple(numbers))
    fps = None if source.fps is None else float(source.fps)
    return replace(source, fps=fps, vectors=vectors, notes=tuple(source.notes))


def _number(values: Any, where: str) -> Number:
    number = _made(Number, values, where)
    for key in ("scale", "offset"):
        if not math.isfinite(getattr(number, key) or 0):
            raise DatasetError(f"{where} {key} = {getattr(number, key)} must be finite.")
    if number.scale == 0:
        raise DatasetError(f"{where} has scale 0, which keeps nothing of it; give `out` and why instead.")
    scale = None if number.scale is None else float(number.scale)
    return replace(number, scale=scale, offset=float(number.offset))


def _positive(value: float | None, what: str) -> None:
    if value is not None and not 0 < value < math.inf:
        raise DatasetError(f"{what} = {value} must be positive and finite.")


def _made(cls: type[_T], values: Any, where: str) -> _T:
    """cls(**values); DatasetError where a key is unknown or missing, or a value is not of its field's type."""
    hints = get_type_hints(cls)
    if not isinstance(values, dict):
        raise DatasetError(f"{where} must be a table {{ {', '.join(hints)} }}.")
    for key, value in values.items():
        if key not in hints:
            raise DatasetError(f"{where} has an unknown key '{key}'; it may have {', '.join(hints)}.")
        allowed = _kinds(hints[key])
        if not isinstance(value, allowed) or isinstance(value, bool):
            wanted = " or ".join(kind.__name__ for kind in allowed if kind is not NoneType)
            raise DatasetError(f"{where} has {key} = {value!r}, which should be of type {wanted}.")
    for field in fields(cls):  # type: ignore[arg-type]
        if field.default is MISSING and field.default_factory is MISSING and field.name not in values:
            raise DatasetError(f"{where} lacks '{field.name}'; add it.")
    return cls(**values)


def _kinds(hint: Any) -> tuple[type, ...]:
    """What TOML may give for a field of that type."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is tuple:
        return (list,)
    if origin is not None and issubclass(origin if isinstance(origin, type) else str, Mapping):
        return (dict,)
    if parts:  # a choice of texts, or of types
        return (str,) if isinstance(parts[0], str) else tuple(kind for part in parts for kind in _kinds(part))
    return (int, float) if hint is float else (hint,)
