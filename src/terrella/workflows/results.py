"""What every workflow returns: a frozen result that can be printed, or written as JSON."""

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol


class Result(Protocol):
    """The result of a workflow."""

    def to_json(self) -> dict[str, Any]:
        """Every figure, as values that JSON has."""
        ...

    def summary(self) -> str:
        """Lines for people, the verdict first."""
        ...


def jsonable(value: Any) -> Any:
    """The same value as JSON has it: null for a number that is not finite, text for a path."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table_lines(heads: list[str], rows: list[list[str]]) -> list[str]:
    """Rows of text under their heads, in columns."""
    widths = [max(len(row[at]) for row in [heads, *rows]) for at in range(len(heads))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in [heads, *rows]]


def command(*words: object, **options: object) -> str:
    """A command that can be pasted into a shell. options: its --options; those without a value (None, False, ()) are left out."""
    given = [str(word) for word in words]
    for name, value in options.items():
        if value is not None and value is not False and value != ():
            values = [str(one) for one in (value if isinstance(value, tuple) else () if value is True else (value,))]
            flag = f"--{name.replace('_', '-')}"
            dashed = values[:1] and values[0].startswith("-")  # no option: --goal=-1,0
            given += [f"{flag}={values[0]}", *values[1:]] if dashed else [flag, *values]
    return shlex.join(given)


def changed_settings(config: Any) -> dict[str, Any]:
    """The settings of a dataclass, and of those in it, that differ from their defaults: name -> value, as `command` takes them."""
    changed: dict[str, Any] = {}
    for part in fields(config):
        value = getattr(config, part.name)
        if is_dataclass(value):
            changed |= changed_settings(value)
        elif value != part.default:
            changed |= {f"no_{part.name}": True} if value is False else {part.name: value}
    return changed


def folder_name(world: str) -> str:
    """The name of a world as a folder's name."""
    return re.sub(r"[^\w.-]+", "-", world.strip("/:")) or "world"
