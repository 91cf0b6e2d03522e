"""The commands `terrella list` and `terrella convert-world`."""

import json as json_text
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..workflows.results import command
from .say import Json


def list_worlds(
    folders: Annotated[tuple[Path, ...], Positional, arg(metavar="[FOLDER ...]")] = (), json: Json = False
) -> None:
    """List the available worlds, each with its card.

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
    for name, install in library.not_installed().items():
        print(f"not installed: {name}: {install}")
    print(f"next: {command('terrella', 'play', entries[0].name)}")


def convert_world(
    old: Annotated[Path, Positional, arg(metavar="OLD")], new: Annotated[Path, Positional, arg(metavar="NEW")]
) -> None:
    """Convert a world of an earlier release to the format of this one. Nothing is lost.

    Args:
        old: Its folder, which is not changed.
        new: The folder to write.
    """
    from ..worlds import convert

    convert.convert_world(old, new)
    print(f"{new} is ready: {command('terrella', 'play', new)}")
