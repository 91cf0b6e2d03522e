"""The mapping of a merge as a TOML file that explains itself, for a person to edit."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tomlkit
from tomlkit.items import InlineTable, Table

from ...core.errors import DatasetError
from .mapping import MergeMapping, Number, SourceMapping, check_inside

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
    """The mapping that parsed TOML holds; DatasetError where a key is unknown or missing, or a value of another type."""
    sources = tables.get("source", [])
    if not isinstance(sources, list) or not sources:
        raise DatasetError("it has no [[source]] tables; add one for each recording to merge.")
    known = ("rows", "action", "state", "cameras")
    for key in tables:
        if key not in (*known, "source"):
            raise DatasetError(f"the file has an unknown key '{key}'; it may have {', '.join(known)}, source.")
    hints = get_type_hints(MergeMapping)
    given = {**dict.fromkeys(known, {}), **tables}
    if isinstance(given["rows"], dict):
        given["rows"] = {"max_gap_s": None, **given["rows"]}
    found = {key: _value(hints[key], given[key], f"[{key}]") for key in known}
    return MergeMapping(**found, sources=tuple(_read_source(it, f"source {i}") for i, it in enumerate(sources, 1)))


def _read_source(values: Any, where: str) -> SourceMapping:
    named = isinstance(values, dict) and isinstance(values.get("embodiment"), str)
    return _value(SourceMapping, values, f"{where} ({values['embodiment']})" if named else where)


def _value(hint: Any, value: Any, where: str) -> Any:
    """What TOML has of that type; DatasetError where it is another, or (of a table) has an unknown key or lacks one."""
    origin, parts = get_origin(hint), get_args(hint)
    if NoneType in parts:
        return None if value is None else _value(parts[0], value, where)
    kind = list if origin is tuple else str if origin is Literal else dict if origin or is_dataclass(hint) else hint
    if isinstance(value, bool) or not isinstance(value, (int, float) if kind is float else kind):
        raise DatasetError(f"{where} = {value!r} should be of type {'table' if kind is dict else kind.__name__}.")
    if origin is Literal and value not in parts:
        raise DatasetError(f"{where} = '{value}' is unknown; choose {' or '.join(parts)}.")
    if origin is tuple:
        return tuple(_value(parts[0], it, f"{where.removesuffix('s')} {i}") for i, it in enumerate(value))
    if is_dataclass(hint):
        return _table_as(hint, value, where)
    if kind is dict:
        return {key: _value(parts[1], it, f"{where} '{key}'") for key, it in value.items()}
    return float(value) if kind is float else value


def _table_as(cls: Any, values: dict, where: str) -> Any:
    hints = get_type_hints(cls)
    for key in values:
        if key not in hints:
            raise DatasetError(f"{where} has an unknown key '{key}'; it may have {', '.join(hints)}.")
    for field in fields(cls):
        if field.default is MISSING and field.default_factory is MISSING and field.name not in values:
            raise DatasetError(f"{where} lacks '{field.name}'; add it.")
    return cls(**{key: _value(hints[key], it, f"{where} {key}") for key, it in values.items()})
