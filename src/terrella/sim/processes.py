"""Parallel episodes of an environment that cannot be copied, each in its own process."""

import os
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector.utils import CloudpickleWrapper

from ..core.errors import StaleStateError, TerrellaError
from ..core.state import State

MAX_EPISODES = 64
Row = dict[str, np.ndarray]


class ProcessEpisode(Protocol):
    """The episode in a process. `begin` and `step` return a value [*shape] per channel, `look` that of one channel."""

    def begin(self, seed: int) -> Row: ...

    def step(self, action: np.ndarray) -> Row: ...

    def look(self, name: str) -> np.ndarray: ...


class _Worker:
    """Our end of a process: its episode's number, age in steps, and latest channels."""

    def __init__(self, pipe: Connection):
        self.pipe, self.number, self.age, self.row = pipe, -1, 0, dict[str, Any]()


class Processes:
    """Parallel episodes behind the methods of a World. `make` is sent to each process and builds a ProcessEpisode there.

    A state is a ticket: the number of each entry's episode and its age. A new episode is reset when first rendered or stepped, in a
    process that no other entry of that state uses; after `state.put(index, fresh)`, that of the episode which it replaces."""

    def __init__(self, name: str, make: Callable[[], ProcessEpisode]):
        self._name, self._make = name, make
        self._workers: list[_Worker] = []
        self._waiting: dict[int, int] = {}  # number -> seed
        self._next = 0
        self._launched: list[subprocess.Popen] = []
        self.close = weakref.finalize(self, _end, self._workers, self._launched)

    def start(self, seeds: Sequence[int]) -> State:
        numbers = range(self._next, self._next + len(seeds))
        self._next = numbers.stop
        self._waiting |= dict(zip(numbers, seeds))
        blank = torch.zeros(len(seeds), dtype=torch.int64)
        return State({"episode": torch.tensor(numbers), "age": blank, "truncated": blank.bool()})

    def imagine(self, state: State, actions: np.ndarray) -> State:
        workers = self._assigned(state)
        running = [(worker, action) for worker, action in zip(workers, actions) if not worker.row["done"]]
        for worker in workers:
            worker.age, worker.row = worker.age + 1, {**worker.row, "reward": np.float32(0)}
        for (worker, _), row in zip(
            running, self._ask([worker for worker, _ in running], "step", [action for _, action in running])
        ):
            worker.row = row
        truncated = torch.tensor([bool(worker.row["truncated"]) for worker in workers])
        return state.replace(age=state["age"] + 1, truncated=truncated)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        workers, seen = self._assigned(state), {}
        for name in channels:
            known = name in workers[0].row
            values = (
                [worker.row[name] for worker in workers] if known else self._ask(workers, "look", [name] * len(workers))
            )
            seen[name] = torch.from_numpy(np.stack(values))
        return seen

    def _assigned(self, state: State) -> list[_Worker]:
        """The processes of the state's entries, in order. New episodes are reset."""
        numbers, ages = state["episode"].tolist(), state["age"].tolist()
        held = {worker.number: worker for worker in self._workers}
        gone = [
            one
            for one, age in zip(numbers, ages)
            if one not in self._waiting and (one not in held or held[one].age != age)
        ]
        if gone or len(set(numbers)) < len(numbers):
            raise StaleStateError(f"{self._name} has moved on since this state and cannot go back or be forked.")
        fresh = [number for number in numbers if number in self._waiting]
        free = [worker for worker in self._workers if worker.number not in numbers]
        if len(free) < len(fresh):
            free += self._launch(len(fresh) - len(free))
        taken = free[: len(fresh)]
        for worker, number in zip(taken, fresh):
            worker.number, worker.age = number, 0
        for worker, row in zip(taken, self._ask(taken, "begin", [self._waiting.pop(number) for number in fresh])):
            worker.row = row
        held = {worker.number: worker for worker in self._workers}
        return [held[number] for number in numbers]

    def _ask(self, workers: Sequence[_Worker], verb: str, given: Sequence[Any]) -> list[Any]:
        """The answers of the processes, which work in parallel; TerrellaError, after all have answered, if one failed."""
        for worker, value in zip(workers, given):
            with suppress(OSError):
                worker.pipe.send((verb, value))
        answers, failed = [], ""
        for worker in workers:
            try:
                done, answer = worker.pipe.recv()
                failed = failed or ("" if done else answer)
                answers.append(answer)
            except (EOFError, OSError):
                worker.pipe.close()
                if worker in self._workers:
                    self._workers.remove(worker)
                failed = f"a process of {self._name} crashed or was killed; a reset starts another one."
        if failed:
            raise TerrellaError(failed)
        return answers

    def _launch(self, count: int) -> list[_Worker]:
        """Starts one process that imports everything and then forks itself; it does not run the caller's __main__ again."""
        pairs = [Pipe() for _ in range(count)]
        theirs = [far.fileno() for _, far in pairs]
        around = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path), "OMP_NUM_THREADS": "1"}
        code = f"from {__name__} import work; work({theirs})"
        command = [sys.executable, "-P", "-c", code]
        more = {"pass_fds": theirs, "stdin": subprocess.DEVNULL, "stdout": 2, "start_new_session": True}
        self._launched.append(subprocess.Popen(command, env={**os.environ, **around}, **more))
        for _, far in pairs:
            far.close()
        workers = [_Worker(near) for near, _ in pairs]
        self._ask(workers, "make", [pickle.dumps(CloudpickleWrapper(self._make))] * count)  # pyright: ignore[reportArgumentType]
        self._workers += workers
        return workers


def _end(workers: list[_Worker], launched: list[subprocess.Popen]) -> None:
    """Closes the pipes, which ends the processes; one that does not end is killed."""
    for worker in workers:
        worker.pipe.close()
    workers.clear()
    for process in launched:
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    launched.clear()


def work(pipes: Sequence[int]) -> None:
    """Runs in the launched process: forks a child for each pipe, and waits until all have ended."""
    for number, pipe in enumerate(pipes):
        if not os.fork():
            for other in pipes[number + 1 :]:
                os.close(other)
            _serve(Connection(pipe))
            os._exit(0)
        os.close(pipe)
    for _ in pipes:
        os.wait()


def _serve(pipe: Connection) -> None:
    episode: Any = None
    with suppress(EOFError, OSError):
        while True:
            verb, given = pipe.recv()
            try:
                if verb == "make":  # from the caller's own pipe, never from a file; an error here becomes an answer
                    episode, answer = pickle.loads(given)(), None
                else:
                    answer = getattr(episode, verb)(given)
                answer = True, answer
            except Exception as error:
                whole = f"an episode cannot run in its own process: {type(error).__name__}: {error}"
                answer = False, str(error) if isinstance(error, TerrellaError) else whole
            pipe.send(answer)
