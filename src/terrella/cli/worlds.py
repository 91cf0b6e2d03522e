"""The command `terrella list`: the worlds at hand, with their cards."""

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
        print(json_text.dumps([entry.as_dict() for entry in entries], indent=1))
        return
    for entry in entries:
        print(f"{entry.name}  [{entry.source}]")
        for fact, value in entry.card.items():
            print(f"    {fact}: {value if isinstance(value, str) else json_text.dumps(value)}")
