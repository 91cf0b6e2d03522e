"""Writing files so that a power cut or kill -9 leaves either the old file or the new one, never half of one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path


def sync_file(path: Path) -> None:
    """Blocks until the file's bytes are on the disk."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Blocks until the folder's entries (creations, renames) are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def move_into_place(staged: Path, target: Path) -> None:
    """Renames a finished file or folder over `target`, durably."""
    new = [parent for parent in target.parents if not parent.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(staged, target)
    sync_folder(target.parent)
    for folder in new:
        sync_folder(folder.parent)


def write_whole(target: Path, write: Callable[[Path], object]) -> None:
    """`write(path)` fills a hidden neighbour of `target`, which then replaces `target` in one step."""
    target.parent.mkdir(parents=True, exist_ok=True)
    staged = target.with_name(f".{target.name}.new")
    write(staged)
    sync_file(staged)
    move_into_place(staged, target)


def write_json(target: Path, value: object) -> None:
    """Replaces `target` by `value` as indented JSON, durably."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_whole(target, lambda path: path.write_text(text, encoding="utf-8"))
