"""A place that is made in the background: it can be polled, also by another program, and resumed once its process has ended. While
it is made, its process holds the lock of a file beside the record: a process number alone may be that of another one by now."""

import fcntl
import json
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

from ..core.errors import TerrellaError
from ..learn.recipes.splat_views import SplatFit
from ..space.files import replace_whole
from .generate_place import KINDS, PlaceConfig, Source, checked_source, make_place
from .splat_places import SpaceResult

ENDING, LOCK = ".job.json", ".job.lock"  # of a job's record and its lock, which lie beside the folder of its place


@dataclass(frozen=True)
class PlaceStatus:
    """How far a place is."""

    state: Literal["running", "done", "failed", "stopped"]  # stopped: its process ended; `resume_place` goes on
    text: str  # what is being done, or the sentence of the failure
    seconds: float  # since it began
    facts: Mapping[str, Any] = field(default_factory=dict)  # of the result, once it is done


class PlaceJob:
    """A place that a thread of this process makes."""

    def __init__(self, out: Path, name: str, source: str, settings: PlaceConfig):
        self._out, self._began, self._lines = out, time.time(), ()
        self._record: dict[str, Any] = {
            "source": {name: source}, "config": asdict(settings), "process": os.getpid(), "began": self._began,
        }  # fmt: skip
        self._status = PlaceStatus("running", "starting", 0.0)
        self._lock = _hold(out)
        self._note("running", "starting")
        self._thread = threading.Thread(target=self._run, args=(name, source, settings), daemon=True)
        self._thread.start()

    @property
    def status(self) -> PlaceStatus:
        """How far it is now."""
        return self._status

    def wait(self, timeout_s: float | None = None) -> SpaceResult:
        """Waits for the result. TerrellaError if it failed, or if it is not done after `timeout_s` seconds; it then goes on."""
        self._thread.join(timeout_s)
        if self._status.state != "done":
            late = f"{self._out} is not done after {timeout_s:g} s; ask again." if self._thread.is_alive() else ""
            raise TerrellaError(late or self._status.text)
        return SpaceResult(self._status.facts, self._lines)

    def _run(self, name: str, source: str, settings: PlaceConfig) -> None:
        try:
            result = make_place(self._out, name, source, settings, lambda text: self._note("running", text))
        except TerrellaError as error:
            self._note("failed", str(error))
        except BaseException as error:
            self._note("failed", f"{type(error).__name__}: {error}")
            raise
        else:
            self._lines = result.lines
            self._note("done", "", result.to_json())
        finally:
            _lock_of(self._out).unlink(missing_ok=True)
            self._lock.close()

    def _note(
        self, state: Literal["running", "done", "failed"], text: str, facts: Mapping[str, Any] | None = None
    ) -> None:
        self._status = PlaceStatus(state, text, round(time.time() - self._began, 1), facts or {})
        record = json.dumps({**self._record, **asdict(self._status)}, default=str)
        replace_whole(_record_of(self._out), lambda file: file.write_text(record))


def start_place(out: str | Path, *, config: PlaceConfig | None = None, **source: Source) -> PlaceJob:
    """Makes a place as `generate_place` does, in the background. The arguments are the same: one of text=, layout=, image=,
    panorama=, images= and video=, and its config. TerrellaError for wrong arguments, and where the folder's job still runs."""
    checked, out = checked_source(source, config), Path(out)
    _check_idle(out)
    return PlaceJob(out, *checked)


def place_status(out: str | Path) -> PlaceStatus:
    """How far the place in the folder `out` is, of whichever program makes it; TerrellaError if none ever began it."""
    record = _read(Path(out))
    ended = record["state"] == "running" and not _is_held(Path(out))
    text = "its process ended; terrella.resume_place goes on" if ended else record["text"]
    return PlaceStatus("stopped" if ended else record["state"], text, record["seconds"], record["facts"])


def resume_place(out: str | Path) -> PlaceJob:
    """Goes on with a job that was stopped or failed: fits exactly where they were, builds and lifts from the beginning.
    TerrellaError if there is none, or if it is done or still runs."""
    out, record = Path(out), _read(Path(out))
    if record["state"] == "done":
        raise TerrellaError(f"{out} is done; terrella.load opens it.")
    _check_idle(out)
    try:
        ((name, source),) = record["source"].items()
        kind = KINDS[name]
        config: dict[str, Any] = {
            key: tuple(one) if isinstance(one, list) else one for key, one in record["config"].items()
        }
        if kind is SplatFit:
            config["fit"] = type(SplatFit().fit)(**config["fit"])
        settings = kind(**config)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise TerrellaError(f"{_record_of(out)} is damaged ({error}); start the place anew.") from error
    return PlaceJob(out, name, source, settings)


def _record_of(out: Path) -> Path:
    return out.with_name(out.name + ENDING)


def _read(out: Path) -> dict[str, Any]:
    try:
        record = json.loads(_record_of(out).read_text())
        return {"process": 0, "seconds": 0.0, "facts": {}, "text": "", **record, "state": record["state"]}
    except FileNotFoundError as error:
        raise TerrellaError(f"no job makes {out}; terrella.start_place begins one.") from error
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise TerrellaError(f"{_record_of(out)} is damaged ({error}); start the place anew.") from error


def _check_idle(out: Path) -> None:
    if _is_held(out):
        number = _read(out)["process"] if _record_of(out).exists() else "of another program"
        raise TerrellaError(f"{out} is being made by process {number}; wait for it, or end that.")


def _lock_of(out: Path) -> Path:
    return out.with_name(out.name + LOCK)


def _hold(out: Path) -> IO[str]:
    """The lock of a job, held until it is closed or the process ends. TerrellaError where another one holds it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    handle = _lock_of(out).open("a")
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
        except BlockingIOError:
            _check_idle(out)
            time.sleep(0.01)  # it is only being polled


def _is_held(out: Path) -> bool:
    """Whether a running process holds the lock of a job."""
    try:
        with _lock_of(out).open() as handle:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False
