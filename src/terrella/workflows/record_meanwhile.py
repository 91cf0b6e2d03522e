"""Recording in processes of its own while training has begun."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from ..core.errors import TerrellaError
from ..data.collect import Job, LocalWorkers, collect

PATIENCE_S = 10.0
FROM_CORES, MOST = 4, 8  # cores from which some are spare; workers at most


def spare_workers(cuda: bool) -> int:
    """The workers for which training leaves cores free: all but two on a GPU, a quarter where the CPU trains."""
    cores = os.cpu_count() or 1
    return 0 if cores < FROM_CORES else min(MOST, cores - 2 if cuda else cores // 4)


class Recorded:
    """A recording under way. `trouble()` is a sentence, once, where its processes have ended too early."""

    def __init__(self, process: BaseProcess, pipe: Connection):
        self._process, self._pipe, self._said = process, pipe, False

    def trouble(self) -> str | None:
        if self._said or self._process.is_alive() or self._process.exitcode == 0:
            return None
        self._said = True
        try:
            why = str(self._pipe.recv())
        except EOFError:
            why = f"its process ended ({self._process.exitcode})"
        return f"Recording has stopped: {why.rstrip('.')}. Training goes on with what is recorded."


@contextmanager
def recording_meanwhile(job: Job, out: Path, workers: int, frames: int) -> Iterator[Recorded]:
    """Inside, `workers` processes record episodes of `job` in `out` until there are `frames` rows; then they are stopped. What
    they committed is kept; the same call continues it."""
    near, far = multiprocessing.Pipe(False)
    process = multiprocessing.get_context("spawn").Process(
        target=_record, args=(job, out, workers, frames, os.getpid(), far)
    )
    process.start()
    far.close()
    try:
        yield Recorded(process, near)
    finally:
        if process.is_alive() and process.pid is not None:
            os.kill(process.pid, signal.SIGINT)
        process.join(PATIENCE_S)
        process.kill()
        process.join()
        near.close()


def _record(job: Job, out: Path, workers: int, frames: int, parent: int, pipe: Connection) -> None:
    try:
        collect(job, out, LocalWorkers(workers), frames=frames, progress=partial(_while_lives, parent))
    except KeyboardInterrupt:
        pass
    except TerrellaError as error:
        pipe.send(str(error))
        raise SystemExit(1) from None


def _while_lives(parent: int, done: int, total: int) -> None:
    """KeyboardInterrupt where the process that began this one has ended."""
    if os.getppid() != parent:
        raise KeyboardInterrupt
