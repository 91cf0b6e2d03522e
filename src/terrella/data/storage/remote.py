"""Files of a local or remote recording. Remote files are fetched whole, when needed, into a bounded cache (fsspec)."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from ...core import files
from ...core.errors import DatasetError
from ..format import checked_name, path_inside

BUDGET_BYTES = 8 << 30
_LOCKS = 64
_PACKAGES = {  # scheme -> what to install
    **dict.fromkeys(("s3", "s3a", "hf"), "'terrella[remote]'"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("abfs", "az"), "adlfs"),
}
_Result = TypeVar("_Result")


def open_files(root: str | os.PathLike[str]) -> LocalFiles | Files:
    """The files under a folder, or under an address with a scheme ("hf://datasets/user/name", "s3://bucket/set")."""
    if isinstance(root, LocalFiles | Files):
        return root
    return Files(root) if isinstance(root, str) and "://" in root else LocalFiles(Path(root))


class LocalFiles:
    """The files of a folder, by their names relative to it; DatasetError for a name that leads out of it."""

    def __init__(self, root: str | os.PathLike[str]):
        self.root = Path(root)

    def __fspath__(self) -> str:
        return str(self.root)

    __str__ = __fspath__

    def local(self, name: str) -> Path:
        """The path of a file, whether it exists or not."""
        return path_inside(self.root, name)

    def exists(self, name: str) -> bool:
        return self.local(name).is_file()

    def mark(self, name: str) -> str:
        """A string that changes when the file does: its size; "" for no such file."""
        path = self.local(name)
        return str(path.stat().st_size) if path.is_file() else ""

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Sorted names, relative to the root, of the files anywhere under `folder` ("" for all) that end in `suffix`.

        Skips hidden files and linked folders.
        """
        paths = []
        for place, folders, names in os.walk(self.root / checked_name(folder) if folder else self.root):
            folders[:] = (name for name in folders if not name.startswith("."))
            names = (name for name in names if name.endswith(suffix) and not name.startswith("."))
            paths += [Path(place, name).relative_to(self.root).as_posix() for name in names]
        return sorted(paths)

    @contextmanager
    def holding(self, *names: str) -> Iterator[None]:
        """Does nothing: local files are never evicted."""
        yield


class Files:
    """The files under a remote address, by their names relative to it.

    `local` fetches a whole file, checks its size and renames it into the cache. Processes can share one cache: together
    they keep it within `budget_bytes`, by removing the files used longest ago, except those that a process is `holding`.
    A file is fetched again when its size, tag or date on the remote has changed. DatasetError where the remote cannot be
    reached, refuses, or is silent for `timeout_s` seconds, after `attempts` attempts; where a package is missing; where
    the cache is too small.
    """

    def __init__(
        self,
        root: str,
        cache_dir: str | os.PathLike[str] | None = None,
        budget_bytes: int = BUDGET_BYTES,
        timeout_s: float = 30.0,
        attempts: int = 4,
    ):
        self.root, self.budget_bytes = root.rstrip("/"), budget_bytes
        self._timeout_s, self._attempts = timeout_s, max(1, attempts)
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "terrella" / "remote"
        self._cache = Path(cache_dir) if cache_dir is not None else home
        self._listed: dict[str, dict[str, tuple[int, str]]] = {}  # folder -> name -> (bytes, tag)
        self._system, self._base, self._callback = _file_system(self.root)
        try:
            (self._cache / ".coming").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DatasetError(f"{self._cache} cannot be written ({error}); name another cache_dir.") from error

    def __fspath__(self) -> str:
        return self.root

    __str__ = __fspath__

    def exists(self, name: str) -> bool:
        return self._facts(name) is not None

    def mark(self, name: str) -> str:
        """A string that changes when the file does: its size, and its tag or date; "" for no such file."""
        return ":".join(map(str, self._facts(name) or ("",)))

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Sorted names, relative to the root, of the files anywhere under `folder` ("" for all) that end in `suffix`."""
        where = f"{self._base}/{checked_name(folder)}" if folder else self._base
        depth = len(self._base.strip("/").split("/"))
        try:
            entries = self._ask(f"list {folder}", lambda alive: self._system.find(where, detail=True))
        except FileNotFoundError:
            return []
        names = []
        for path, about in entries.items():
            parts = path.strip("/").split("/")[depth:]
            if about["type"] == "file" and parts and not any(part.startswith(".") for part in parts):
                names.append(checked_name("/".join(parts)))
                self._listed.setdefault("/".join(parts[:-1]), {})[parts[-1]] = _size_and_mark(self.root, about)
        return sorted(name for name in names if name.endswith(suffix))

    def local(self, name: str) -> Path:
        """The path of a local copy, fetched if there is none. Use it within `holding`, or it may be evicted."""
        facts = self._facts(name)
        if facts is None:
            raise DatasetError(f"there is no {name} at {self.root}; it is incomplete, or the address is wrong.")
        size, tag = facts
        mark = hashlib.sha256(f"{self.root}\n{name}\n{size}\n{tag}".encode()).hexdigest()[:24]
        path = self._cache / f"{mark}-{name.rsplit('/', 1)[-1]}"
        if not _touched(path, size):
            try:
                with _locked(self._cache / f".lock-{int(mark[:8], 16) % _LOCKS}"):  # one process fetches, others wait
                    if not _touched(path, size):
                        self._fetch(name, size, path)
            except OSError as error:
                raise DatasetError(
                    f"{name} of {self.root} cannot be kept in {self._cache} ({error}); {files.remedy_of(error)}."
                ) from error
        return path

    @contextmanager
    def holding(self, *names: str) -> Iterator[None]:
        """Keeps these files in the cache, for all processes, until the context ends."""
        held: list[int] = []
        try:
            for name in names:
                held.append(self._held(name))
            yield
        finally:
            for file in held:
                os.close(file)

    def _held(self, name: str) -> int:
        """An open file with a shared lock, which keeps it from eviction."""
        while True:
            path = self.local(name)
            try:
                file = os.open(path, os.O_RDONLY)
            except FileNotFoundError:  # evicted since
                continue
            fcntl.flock(file, fcntl.LOCK_SH)
            if os.fstat(file).st_nlink:
                return file
            os.close(file)

    def _facts(self, name: str) -> tuple[int, str] | None:
        """(bytes, mark that changes with the content) of a remote file; None for no such file."""
        folder, _, last = checked_name(name).rpartition("/")
        if folder not in self._listed:
            try:
                where = f"{self._base}/{folder}"
                entries = self._ask(f"list {folder}", lambda alive: self._system.ls(where, detail=True))
            except (FileNotFoundError, NotADirectoryError):
                entries = []
            files = (about for about in entries if about["type"] == "file")
            facts = {about["name"].rsplit("/", 1)[-1]: _size_and_mark(self.root, about) for about in files}
            self._listed[folder] = facts
        return self._listed[folder].get(last)

    def _fetch(self, name: str, size: int, path: Path) -> None:
        def get(alive: Callable[[], None]) -> Path:
            handle, made = tempfile.mkstemp(prefix="part-", dir=room)
            os.close(handle)
            beat = self._callback(hooks={"alive": alive})  # called as bytes arrive
            self._system.get_file(f"{self._base}/{name}", made, callback=beat)
            got = os.stat(made).st_size
            if got != size:
                raise OSError(f"{got} of {size} bytes arrived")
            return Path(made)

        with self._room(name, size) as room:
            try:
                part = self._ask(f"fetch {name}", get)
            except FileNotFoundError as error:
                raise DatasetError(f"{name} is gone from {self.root}; open the recording again.") from error
            files.sync_file(part)
            files.move_into_place(part, path)

    def _ask(self, what: str, action: Callable[[Callable[[], None]], _Result]) -> _Result:
        """`action(alive)`, repeated where it fails; the action calls `alive()` when it makes progress."""
        last: Exception = TimeoutError()
        for attempt in range(self._attempts):
            if attempt:
                time.sleep(min(0.1 * 3**attempt, 5.0))
            try:
                return _in_time(action, self._timeout_s)
            except (FileNotFoundError, NotADirectoryError, DatasetError):
                raise
            except PermissionError as error:
                raise DatasetError(f"{self.root} refuses to {what} ({error}); check your credentials.") from error
            except Exception as error:  # every file system has errors of its own
                last = error
        why = (str(last).splitlines() or [""])[0][:300] or type(last).__name__
        raise DatasetError(
            f"{self.root} cannot be reached (tried {self._attempts} times to {what}: {why}); check the address, the "
            "network and your credentials."
        ) from last

    @contextmanager
    def _room(self, name: str, size: int) -> Iterator[Path]:
        """A folder for a file to be fetched; its `size` bytes are reserved until the context ends."""
        if size > self.budget_bytes:
            raise DatasetError(f"{name} of {self.root} has {size:,} bytes, and only {self.budget_bytes:,} fit here.")
        deadline = time.monotonic() + self._timeout_s
        while (claim := self._claimed(size)) is None:
            if time.monotonic() > deadline:
                raise DatasetError(
                    f"{self._cache} is full of files in use, and {name} needs {size:,} of its {self.budget_bytes:,} bytes; "
                    "allow more, or use fewer processes."
                )
            time.sleep(0.02)
        handle, folder = claim
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(handle)

    def _claimed(self, size: int) -> tuple[int, Path] | None:
        """A locked folder named after the reserved bytes; None where files in use leave too little space."""
        with _locked(self._cache / ".lock"):
            if self._evicted(size) + size > self.budget_bytes:
                return None
            folder = Path(tempfile.mkdtemp(prefix=f"{size}-", dir=self._cache / ".coming"))
            handle = os.open(folder, os.O_RDONLY)
            fcntl.flock(handle, fcntl.LOCK_EX)
            return handle, folder

    def _evicted(self, size: int) -> int:
        """Bytes in use, after files used longest ago were removed to make room for `size`."""
        # Reservations are counted before files: a file that arrives in between counts twice, never not at all.
        # A reservation without a lock is of a process that was killed.
        coming = [one for one in os.scandir(self._cache / ".coming") if not _let_go(Path(one.path), shutil.rmtree)]
        kept = [entry for entry in os.scandir(self._cache) if not entry.name.startswith(".")]
        files = [(entry.stat().st_mtime_ns, entry.stat().st_size, entry.path) for entry in kept]
        total = sum(int(entry.name.split("-")[0]) for entry in coming) + sum(bytes_ for _, bytes_, _ in files)
        for _, bytes_, path in sorted(files):
            if total + size <= self.budget_bytes:
                break
            if _let_go(Path(path), os.unlink):
                total -= bytes_
        return total


def _file_system(root: str) -> tuple[Any, str, Any]:
    """(fsspec file system of an address, path in it, fsspec's Callback class)."""
    scheme = root.split("://", 1)[0]
    try:
        import fsspec
    except ImportError as error:
        raise DatasetError(f"reading {root} needs fsspec: pip install 'terrella[remote]'.") from error
    try:
        system, base = fsspec.core.url_to_fs(root)
        system.invalidate_cache()
        return system, base, fsspec.callbacks.Callback
    except ImportError as error:
        need = f"pip install {_PACKAGES[scheme]}" if scheme in _PACKAGES else "install it"
        raise DatasetError(f"reading {scheme}:// needs a package that is missing ({error}): {need}.") from error
    except ValueError as error:
        raise DatasetError(f"{root} is not a valid address ({error}); begin with hf://, s3:// or file://.") from error
    except Exception as error:  # every file system has errors of its own
        raise DatasetError(f"{root} cannot be opened ({error}); check the address and your credentials.") from error


def _size_and_mark(root: str, about: dict) -> tuple[int, str]:
    """The size in bytes of a listed file, and a mark that changes when its content does."""
    if not isinstance(about.get("size"), int):
        raise DatasetError(f"{root} does not state the size of {about.get('name')}; copy it to this machine.")
    for key in ("ETag", "etag", "blob_id", "md5Hash", "LastModified", "last_modified", "mtime", "created"):
        if about.get(key):
            return about["size"], str(about[key])
    return about["size"], ""


def _in_time(action: Callable[[Callable[[], None]], _Result], silence_s: float) -> _Result:
    """`action(alive)` in a thread of its own; TimeoutError once it has not called `alive` for `silence_s` seconds."""
    heard, answer = [time.monotonic()], Future[_Result]()

    def alive(*_, **__) -> None:
        heard[0] = time.monotonic()

    def work() -> None:
        try:
            answer.set_result(action(alive))
        except BaseException as error:  # handed to the caller's thread
            answer.set_exception(error)

    threading.Thread(target=work, name="remote", daemon=True).start()
    while (left := heard[0] + silence_s - time.monotonic()) > 0:
        if wait([answer], left).done:
            break
    if not answer.done():
        raise TimeoutError(f"it was silent for {silence_s:g} s")
    return answer.result()


def _touched(path: Path, size: int) -> bool:
    """Whether the file exists and is whole; if so, marks it as just used."""
    try:
        whole = path.stat().st_size == size
        if whole:
            os.utime(path)
        return whole
    except FileNotFoundError:
        return False


def _let_go(path: Path, remove: Callable[[Path], object]) -> bool:
    """Removes a path that no process has locked; returns whether it is gone."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        remove(path)
        return True
    except FileNotFoundError:  # removed by its owner since
        return True
    except BlockingIOError:
        return False
    finally:
        os.close(handle)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with open(path, "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
