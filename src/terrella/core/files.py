"""Files that are replaced whole: each is written under a hidden name beside its target, synced to the disk, and renamed. After a
power cut or kill -9 there is the old file or the new one, never half of one."""

import errno
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import DatasetError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # error numbers of a full disk
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_STALE_S = 3600.0  # a hidden file of this age was left behind by a process that was killed


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
    """Renames a synced file or folder over `target`; the rename is on the disk when this returns."""
    new = [parent for parent in target.parents if not parent.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(staged, target)
    sync_folder(target.parent)
    for folder in new:
        sync_folder(folder.parent)


@contextmanager
def replacing(target: str | Path, durable: bool = True) -> Iterator[Path]:
    """Gives a hidden path to write a file to; without an exception the file then replaces `target` in one step.

    The hidden path is the caller's own: two threads or processes may replace one target at the same time, and the last
    one counts. An OSError passes through, and nothing half-written stays. `durable=False` does not wait for the disk:
    a power cut may then leave an empty file, so use it only for files whose reader treats a damaged one as missing.
    """
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    staged = target.with_name(f".{target.name}.{os.getpid()}-{threading.get_ident()}.new")
    try:
        yield staged
        if durable:
            _remove_stale(target)
            sync_file(staged)
            move_into_place(staged, target)
        else:
            os.replace(staged, target)
    finally:
        staged.unlink(missing_ok=True)


def write_bytes(target: str | Path, data: bytes) -> None:
    """Replaces `target` by `data`, durably."""
    with replacing(target) as staged:
        staged.write_bytes(data)


def write_text(target: str | Path, text: str) -> None:
    """Replaces `target` by `text` in UTF-8, durably; line ends stay as they are."""
    write_bytes(target, text.encode())


def write_json(target: str | Path, value: object, indent: int | None = 2) -> None:
    """Replaces `target` by `value` as JSON, durably; without indentation (None) many times as fast. ValueError for NaN and
    infinity."""
    write_text(target, json.dumps(value, indent=indent, allow_nan=False) + "\n")


@contextmanager
def creating(path: str | Path) -> Iterator[Path]:
    """Gives a hidden path for a new file or folder, renamed to `path` if there is no exception; nothing half-written stays.
    DatasetError where `path` exists (an empty folder may), or the disk is full or fails."""
    path = Path(path)
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise DatasetError(f"{path} exists already; write to another path, or remove it first.")
        path.parent.mkdir(parents=True, exist_ok=True)
        staged = path.with_name(f".{path.name}.new")
        _remove(staged)
    except OSError as error:
        raise not_written(path, error) from error
    try:
        yield staged
        if path.is_dir():
            path.rmdir()
        move_into_place(staged, path)
    except OSError as error:
        raise not_written(path, error) from error
    finally:
        _remove(staged)


def not_written(path: Path, error: OSError) -> DatasetError:
    """The error to raise where the disk refused to write `path`, of which nothing is kept."""
    why = "the disk is full" if error.errno in FULL else error.strerror or str(error)
    return DatasetError(f"{path} was not written: {why}; {remedy_of(error)}, or choose another place, and try again.")


def remedy_of(error: BaseException) -> str:
    """What to do after a write that failed: "free some space" only where the disk is full."""
    number = getattr(error, "errno", None)
    if number in FULL or f"os error {errno.ENOSPC}" in str(error):  # safetensors gives its number in words
        return "free some space"
    return "make that folder writable" if number in _FORBIDDEN else "check that folder and its disk"


def _remove_stale(target: Path) -> None:
    """Removes hidden files that killed processes left beside `target`."""
    start = f".{target.name}."
    with suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if entry.name.startswith(start) and entry.name.endswith(".new"):
                if time.time() - entry.stat().st_mtime > _STALE_S:
                    os.unlink(entry.path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
