"""collect: many workers play the episodes of one recording; each is committed once, in order, whatever becomes of the workers."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

import torch

from ..core.errors import DatasetError, TerrellaError
from ..core.policy import Policy
from ..core.world import World, make_rng
from .format import Layout
from .recorder import Recorder
from .recording import LONGEST, base_of, play_episode, seed_of
from .staged import Parcel

AHEAD = 3  # episodes for each worker that may wait for an earlier one
PATIENCE_S = 1.0
MOST_DEATHS = 3  # workers that one episode may cost
Open = Callable[[], tuple[World, Callable[[], Policy]]]


@dataclass(frozen=True)
class Job:
    """What a worker is sent. open: gives the world, and what makes the policy of an episode; base: of the seeds; steps: of an
    episode at most."""

    open: Open
    layout: Layout
    task: str
    base: int
    steps: int
    scratch: str | None = None  # a folder for what is not finished, which whoever sends the job removes


class Player:
    """Plays episodes of a job by their numbers; the world is opened once."""

    def __init__(self, job: Job, label: str = ""):
        """label: of a folder among temporary files that is this player's alone; it clears what one of that name left who died."""
        self._job, self._opened = job, None
        if label:
            self._folder = Path(tempfile.gettempdir()) / f"terrella-{label}"
            self.clear()
            self._folder.mkdir()
        else:
            self._folder = Path(tempfile.mkdtemp(prefix="terrella-", dir=job.scratch))

    def clear(self) -> None:
        """Removes what it keeps on disk; it plays no more."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def play(self, number: int) -> Parcel | str:
        """The episode, or a sentence that says why there is none."""
        job = self._job
        try:
            if self._opened is None:
                torch.set_num_threads(1)
                self._opened = *job.open(), Recorder(self._folder, job.layout, job.task)
            world, policy, recorder = self._opened
            recorder.drop_episode()
            play_episode(world, policy(), recorder, make_rng(seed_of(job.base, number)), job.steps)
            return recorder.take_episode() or f"episode {number} of {world.spec.name} has no step."
        except Exception as error:
            return str(error) if isinstance(error, TerrellaError) else f"{type(error).__name__}: {error}"


class Workers(Protocol):
    """Who plays: `ask` never waits, `answers` waits for one or more. A worker that dies is replaced, and what it was asked for is
    played again."""

    size: int

    def begin(self, job: Job) -> None: ...

    def ask(self, number: int) -> None: ...

    def answers(self) -> list[tuple[int, Parcel | str]]: ...

    def close(self) -> None: ...


def collect(
    open: Open,
    world: World,
    root: str | Path,
    rng: torch.Generator,
    workers: Workers,
    episodes: int | None = None,
    frames: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    layout: Layout | None = None,
) -> Recorder:
    """Records whole episodes, up to the limit of `world` or LONGEST steps, until `root` holds `episodes`, or `frames` or more (what
    an earlier run left there counts).

    `open` is sent to the workers (it must be picklable), and opens the same world there. Episodes are committed in the order of
    their numbers and each is made of the seed and its number alone: the recording is the same with any number of workers, however
    often it was stopped. Of a policy that does not learn `record` makes the same, but for the last episode, which it may cut.
    Returns the closed recorder.
    DatasetError as Recorder raises it; TerrellaError for what goes wrong in a world, or where an episode ends its worker
    each time; what was committed before is safe.
    """
    if (episodes is None) == (frames is None) or (episodes or frames or 0) < 1:
        raise DatasetError("say how much to record: a number of episodes, or of frames, from 1 up.")
    layout, task = layout or Layout.of(world.spec), f"explore {world.spec.name}"
    job = Job(open, layout, task, base_of(rng), world.spec.max_episode_steps or LONGEST)
    with Recorder(root, layout, task, "discard") as recorder:

        def missing() -> bool:
            return recorder.episodes < episodes if episodes is not None else recorder.rows < (frames or 0)

        if missing():
            with _at_work(workers, job):
                _gather(
                    recorder,
                    workers,
                    episodes,
                    missing,
                    progress and (lambda: _told(progress, recorder, episodes, frames)),
                )
    return recorder


def _gather(
    recorder: Recorder,
    workers: Workers,
    episodes: int | None,
    missing: Callable[[], bool],
    report: Callable[[], None] | None,
) -> None:
    asked, done = recorder.episodes, dict[int, Parcel]()
    while missing():
        upto = recorder.episodes + AHEAD * workers.size
        for number in range(asked, upto if episodes is None else min(upto, episodes)):
            workers.ask(number)
            asked = number + 1
        for number, found in workers.answers():
            if isinstance(found, str):
                raise TerrellaError(f"{found.rstrip('.')}. {recorder.episodes:,} episodes are safe in {recorder.root}.")
            done[number] = found
        while missing() and recorder.episodes in done:
            recorder.put_episode(done.pop(recorder.episodes))
            if report:
                report()


def _told(progress: Callable[[int, int], None], recorder: Recorder, episodes: int | None, frames: int | None) -> None:
    progress(*((recorder.rows, frames) if frames is not None else (recorder.episodes, episodes or 0)))


@contextmanager
def _at_work(workers: Workers, job: Job) -> Iterator[None]:
    try:
        workers.begin(job)
        yield
    finally:
        workers.close()


class LocalWorkers:
    """Processes of this machine."""

    def __init__(self, size: int):
        if size < 1:
            raise TerrellaError(f"{size} workers play nothing; ask for one or more.")
        self.size = size
        self._waiting: deque[int] = deque()
        self._busy: dict[Connection, int] = {}
        self._idle: list[Connection] = []
        self._deaths: Counter[int] = Counter()
        self._processes: list[Any] = []
        self._scratch: tempfile.TemporaryDirectory | None = None

    def begin(self, job: Job) -> None:
        self._scratch = tempfile.TemporaryDirectory(prefix="terrella-", ignore_cleanup_errors=True)
        self._job = replace(job, scratch=self._scratch.name)
        for _ in range(self.size):
            self._launch()

    def ask(self, number: int) -> None:
        self._waiting.append(number)
        self._hand_out()

    def answers(self) -> list[tuple[int, Parcel | str]]:
        found = []
        while not found:
            self._hand_out()
            for pipe in wait(list(self._busy)):
                assert isinstance(pipe, Connection)
                number = self._busy.pop(pipe)
                try:
                    found.append((number, pipe.recv()))
                    self._idle.append(pipe)
                except (EOFError, OSError):
                    found += self._died(pipe, number)
        return found

    def close(self) -> None:
        for pipe in [*self._idle, *self._busy]:
            pipe.close()
        until = time.monotonic() + PATIENCE_S  # who waits for work ends by itself, and its world with it
        for process in self._processes:
            process.join(max(0.0, until - time.monotonic()))
            process.kill()
            process.join()
        if self._scratch is not None:
            self._scratch.cleanup()
        self._processes.clear()
        self._idle.clear()
        self._busy.clear()
        self._waiting.clear()

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            pipe, number = self._idle.pop(), self._waiting.popleft()
            self._busy[pipe] = number
            with suppress(OSError):  # it has died: `answers` will see
                pipe.send(number)

    def _died(self, pipe: Connection, number: int) -> list[tuple[int, str]]:
        pipe.close()
        self._deaths[number] += 1
        if self._deaths[number] == MOST_DEATHS:
            return [
                (number, f"episode {number} ended its worker {MOST_DEATHS} times (killed, crashed, or out of memory)")
            ]
        self._waiting.appendleft(number)
        self._launch()
        return []

    def _launch(self) -> None:
        near, far = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=_serve, args=(far, self._job), daemon=True)
        with _uninterrupted():
            process.start()
        far.close()
        self._processes.append(process)
        self._idle.append(near)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Processes that begin here do not hear Ctrl-C, which is for this one."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(pipe: Connection, job: Job) -> None:
    player = Player(job)
    with suppress(EOFError, OSError):
        while True:
            pipe.send(player.play(pipe.recv()))
