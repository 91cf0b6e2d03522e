"""Writing files so that a power cut or kill -9 leaves either the old file or the new one, never half of one."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ...core.errors import DatasetError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # what the system says of a full disk


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


@contextmanager
def in_whole(path: str | Path) -> Iterator[Path]:
    """A hidden neighbour of `path` (a folder to be made, or a file), renamed to `path` when all went well.

    However it ends, nothing half-written stays. DatasetError where something is at `path`, or the disk is full or fails.
    """
    path = Path(path)
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise DatasetError(f"{path} exists already; write to another path, or remove it first.")
        path.parent.mkdir(parents=True, exist_ok=True)
        staged = path.with_name(f".{path.name}.new")
        _remove(staged)
    except OSError as error:
        raise unwritten(path, error) from error
    try:
        yield staged
        if path.is_dir():
            path.rmdir()
        move_into_place(staged, path)
    except OSError as error:
        raise unwritten(path, error) from error
    finally:
        _remove(staged)


def unwritten(path: Path, error: OSError) -> DatasetError:
    """What to raise where writing failed on the disk: nothing of it is kept."""
    why = "the disk is full" if error.errno in FULL else error.strerror or str(error)
    return DatasetError(f"{path} was not written: {why}; free some space, or choose another place, and try again.")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
