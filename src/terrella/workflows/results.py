"""What every workflow returns: a frozen result that can be printed, or written as JSON."""

import math
import re
from collections.abc import Mapping
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


def folder_name(world: str) -> str:
    """The name of a world as a folder's name."""
    return re.sub(r"[^\w.-]+", "-", world.strip("/:")) or "world"
