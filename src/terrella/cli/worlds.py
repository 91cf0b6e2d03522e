"""The commands about saved worlds: list them, and convert one of an earlier release."""

from __future__ import annotations

import json as json_text
from pathlib import Path

from tyro.conf import Positional

from .say import Json


def list_worlds(folders: Positional[tuple[Path, ...]] = (), json: Json = False) -> None:
    """Show the worlds at hand, each with what is known of it.

    Args:
        folders: Folders with checkpoints of your own.
    """
    from .. import library

    entries = library.worlds(folders)
    if json:
        print(json_text.dumps([entry._asdict() for entry in entries], indent=1))
        return
    for entry in entries:
        print(f"{entry.name}  [{entry.source}]")
        for fact, value in entry.card.items():
            print(f"    {fact}: {value if isinstance(value, str) else json_text.dumps(value)}")


def convert_world(old: Positional[Path], new: Positional[Path]) -> None:
    """Convert a world that an earlier release saved to the format of this one. Nothing is lost.

    Args:
        old: Its folder; it stays as it is.
        new: The folder to write.
    """
    from ..worlds import convert

    convert.convert_world(old, new)
    print(f"{new} is ready: terrella play {new}")
