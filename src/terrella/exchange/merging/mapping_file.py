"""The mapping of a merge as a commented TOML file, for a person to edit."""

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import tomlkit
from tomlkit.items import InlineTable, Table

from ...core.errors import DatasetError
from ...core.typed_values import typed
from .mapping import MergeMapping, Number, SourceMapping, check_inside

_TOP = "Where each number of each robot goes in the merged recording. Edit this file and merge again with it."
_ROWS = {
    "fps": "rows per second of the merged recording",
    "images": "images, depth, points: previous (the newest one up to the row) or nearest",
    "continuous": "observed numbers: linear (between two readings), previous or nearest",
    "actions": "actions: previous (the one being executed), nearest or linear",
    "max_gap_s": "longer gaps of a sensor, in seconds, are masked; without this line none are",
}
_DIMENSIONS = "The merged numbers, in order. Where a robot lacks one, the value is 0 and the mask False."
_CAMERAS = 'The merged cameras: kind "image" or "depth"; pictures are letterboxed into height x width pixels.'
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
    """Writes the mapping with a comment on each part; `read_mapping` is the inverse."""
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
    """A dataclass as { key = value, … }, without default values."""
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
        table["fps"].comment("its own rows per second")
    if source.notes:
        table.add(tomlkit.comment("check these"))
        table.add("notes", _lines((note, "") for note in source.notes))
    for key, words in _SOURCE.items():
        if getattr(source, key):
            table.add(key, _table(getattr(source, key), words))
    if source.vectors:
        vectors = tomlkit.table(is_super_table=True)
        for name, vector in source.vectors.items():
            part = _table({"frame": vector.frame} if vector.frame else {}, *_NUMBERS)
            units = {to: it.unit for to, it in mapping.dimensions(name).items()}
            part.add("numbers", _lines((_inline(it), _converted(it, units.get(it.to, ""))) for it in vector.numbers))
            vectors.add(name, part)
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
    """Reads a mapping file. DatasetError names the line of a TOML error, or the key of any other: an unknown or missing key,
    a value of the wrong type, a number mapped twice or to an unknown dimension, units or frames that do not match. The
    sources themselves are compared with it by `check_mapping`.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"the mapping {path} cannot be read ({error.strerror}); check the path.") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise DatasetError(f"{path} is not TOML ({error}); mend it there.") from error
    try:
        mapping = mapping_of(tables)
        check_inside(mapping)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error
    return mapping


def mapping_of(tables: dict) -> MergeMapping:
    """The mapping in parsed TOML; DatasetError where a key is unknown or missing, or a value has the wrong type."""
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
    values = {key: typed(hints[key], given[key], f"[{key}]", DatasetError) for key in known}
    return MergeMapping(**values, sources=tuple(_read_source(it, f"source {i}") for i, it in enumerate(sources, 1)))


def _read_source(values: Any, where: str) -> SourceMapping:
    named = isinstance(values, dict) and isinstance(values.get("embodiment"), str)
    return typed(SourceMapping, values, f"{where} ({values['embodiment']})" if named else where, DatasetError)
