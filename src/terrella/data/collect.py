"""collect: many workers play the episodes of one recording; each is committed once, in order, even if workers die."""

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
from ..core.spec import Spec
from ..core.world import World, make_rng
from .format import Layout
from .recorder import Recorder
from .recording import LONGEST, base_of, play_episode, seed_of
from .staged import Parcel

AHEAD = 3  # finished episodes a worker that may wait for an earlier one
PATIENCE_S = 1.0
MOST_DEATHS = 3  # workers that may die in one episode
Open = Callable[[], tuple[World, Callable[[], Policy]]]


@dataclass(frozen=True)
class Job:
    """What workers are to record; it is sent to them, so it must be picklable."""

    open: Open  # opens the world; gives it and a function that makes the policy of an episode
    layout: Layout  # sensors and rate of the recording
    task: str  # the instruction of every episode
    base: int  # the number from which the seeds of all episodes follow
    steps: int  # steps after which an episode is cut off
    scratch: str | None = None  # a folder for unfinished episodes, which its sender removes; None makes one

    @staticmethod
    def of(open: Open, spec: Spec, rng: torch.Generator, layout: Layout | None = None) -> Job:
        """A job for the world that `open` opens and `spec` describes."""
        task, steps = f"explore {spec.name}", spec.max_episode_steps or LONGEST
        return Job(open, layout or Layout.of(spec), task, base_of(rng), steps)


class Player:
    """Plays episodes of a job by their numbers; the world is opened once."""

    def __init__(self, job: Job, label: str = ""):
        """label: names this player's own temporary folder, which is cleared of what a dead player of that name left."""
        self._job, self._opened = job, None
        if label:
            self._folder = Path(tempfile.gettempdir()) / f"terrella-{label}"
            self.clear()
            self._folder.mkdir()
        else:
            self._folder = Path(tempfile.mkdtemp(prefix="terrella-", dir=job.scratch))

    def clear(self) -> None:
        """Removes the files of this player, which plays no more."""
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
    """The processes that play. `ask` never waits, `answers` waits for one episode or more. A worker that dies is replaced,
    and its episode is played again."""

    size: int

    def begin(self, job: Job) -> None: ...

    def ask(self, number: int) -> None: ...

    def answers(self) -> list[tuple[int, Parcel | str]]: ...

    def close(self) -> None: ...


def collect(
    job: Job,
    root: str | Path,
    workers: Workers,
    episodes: int | None = None,
    frames: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Recorder:
    """Records whole episodes until `root` holds `episodes` episodes, or `frames` rows or more. Those of an earlier run count.

    Episodes are committed in the order of their numbers, and each follows from the seed and its number alone. So the
    recording is the same with any number of workers and however often it was stopped. With a policy that does not learn,
    `record` gives the same recording, but may cut the last episode. Returns the closed recorder.
    DatasetError as Recorder raises it; TerrellaError for a fault of the world, or where an episode ends its worker each
    time. Episodes committed before are safe.
    """
    if (episodes is None) == (frames is None) or (episodes or frames or 0) < 1:
        raise DatasetError("say how much to record: a number of episodes, or of frames, from 1 up.")
    with Recorder(root, job.layout, job.task, "discard") as recorder:

        def missing() -> bool:
            return recorder.episodes < episodes if episodes is not None else recorder.rows < (frames or 0)

        def report() -> None:
            if progress:
                progress(*((recorder.rows, frames) if frames is not None else (recorder.episodes, episodes or 0)))

        if missing():
            try:
                workers.begin(job)
                _gather(recorder, workers, episodes, missing, report)
            finally:
                workers.close()
    return recorder


def _gather(
    recorder: Recorder,
    workers: Workers,
    episodes: int | None,
    missing: Callable[[], bool],
    report: Callable[[], None],
) -> None:
    next_number, done = recorder.episodes, dict[int, Parcel]()
    while missing():
        upto = recorder.episodes + AHEAD * workers.size
        for number in range(next_number, upto if episodes is None else min(upto, episodes)):
            workers.ask(number)
            next_number = number + 1
        for number, answer in workers.answers():
            if isinstance(answer, str):
                safe = f"{recorder.episodes:,} episodes are safe in {recorder.root}."
                raise TerrellaError(f"{answer.rstrip('.')}. {safe}")
            done[number] = answer
        while missing() and recorder.episodes in done:
            recorder.put_episode(done.pop(recorder.episodes))
            report()


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
        answers = []
        while not answers:
            self._hand_out()
            for pipe in wait(list(self._busy)):
                assert isinstance(pipe, Connection)
                number = self._busy.pop(pipe)
                try:
                    answers.append((number, pipe.recv()))
                    self._idle.append(pipe)
                except (EOFError, OSError):
                    answers += self._died(pipe, number)
        return answers

    def close(self) -> None:
        for pipe in [*self._idle, *self._busy]:
            pipe.close()
        until = time.monotonic() + PATIENCE_S  # a process that waits for work ends by itself
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
            with suppress(OSError):  # it has died: `answers` will notice
                pipe.send(number)

    def _died(self, pipe: Connection, number: int) -> list[tuple[int, str]]:
        pipe.close()
        self._deaths[number] += 1
        if self._deaths[number] == MOST_DEATHS:
            return [(number, f"episode {number} ended its worker {MOST_DEATHS} times (killed, crashed, out of memory)")]
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
    """Processes started in here ignore Ctrl-C, which is for this one."""
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
