"""Several episodes of an environment that cannot be copied, each in a process of its own."""

from __future__ import annotations

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

MOST = 64
Row = dict[str, np.ndarray]


class ProcessEpisode(Protocol):
    """What a process holds: one episode at a time. `begin` and `move` give what is seen, a value [*shape] a channel."""

    def begin(self, seed: int) -> Row: ...

    def move(self, action: np.ndarray) -> Row: ...

    def look(self, name: str) -> np.ndarray: ...


class _Seat:
    """The near end of a process, which episode it plays, how many steps of it, and what was seen last."""

    def __init__(self, pipe: Connection):
        self.pipe, self.number, self.age, self.row = pipe, -1, 0, dict[str, Any]()


class Processes:
    """The verbs of a World over as many processes as the largest state has entries; `make`, which is sent to each, builds an
    ProcessEpisode there.

    States are tickets: an entry is the number of an episode and of its step. A fresh start waits until it is first looked at or
    moved, and then takes a process that no other entry of that state has; so after `state.put(index, fresh)` it has that of the
    episode in whose place it was put.
    """

    def __init__(self, name: str, make: Callable[[], ProcessEpisode]):
        self._name, self._make = name, make
        self._seats: list[_Seat] = []
        self._waiting: dict[int, int] = {}  # number -> seed
        self._next = 0
        self._launched: list[subprocess.Popen] = []
        self.close = weakref.finalize(self, _end, self._seats, self._launched)

    def start(self, seeds: Sequence[int]) -> State:
        numbers = range(self._next, self._next + len(seeds))
        self._next = numbers.stop
        self._waiting |= dict(zip(numbers, seeds))
        blank = torch.zeros(len(seeds), dtype=torch.int64)
        return State({"episode": torch.tensor(numbers), "age": blank, "truncated": blank.bool()})

    def imagine(self, state: State, actions: np.ndarray) -> State:
        seats = self._seated(state)
        moved = [(seat, action) for seat, action in zip(seats, actions) if not seat.row["done"]]
        for seat in seats:
            seat.age, seat.row = seat.age + 1, {**seat.row, "reward": np.float32(0)}
        for (seat, _), row in zip(
            moved, self._ask([seat for seat, _ in moved], "move", [action for _, action in moved])
        ):
            seat.row = row
        truncated = torch.tensor([bool(seat.row["truncated"]) for seat in seats])
        return state.replace(age=state["age"] + 1, truncated=truncated)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        seats, seen = self._seated(state), {}
        for name in channels:
            known = name in seats[0].row
            values = [seat.row[name] for seat in seats] if known else self._ask(seats, "look", [name] * len(seats))
            seen[name] = torch.from_numpy(np.stack(values))
        return seen

    def _seated(self, state: State) -> list[_Seat]:
        """The processes of the state's entries, in their order."""
        numbers, ages = state["episode"].tolist(), state["age"].tolist()
        held = {seat.number: seat for seat in self._seats}
        gone = [
            one
            for one, age in zip(numbers, ages)
            if one not in self._waiting and (one not in held or held[one].age != age)
        ]
        if gone or len(set(numbers)) < len(numbers):
            raise StaleStateError(f"{self._name} has moved on since this state and cannot go back or be forked.")
        fresh = [number for number in numbers if number in self._waiting]
        free = [seat for seat in self._seats if seat.number not in numbers]
        if len(free) < len(fresh):
            free += self._launch(len(fresh) - len(free))
        taken = free[: len(fresh)]
        for seat, number in zip(taken, fresh):
            seat.number, seat.age = number, 0
        for seat, row in zip(taken, self._ask(taken, "begin", [self._waiting.pop(number) for number in fresh])):
            seat.row = row
        held = {seat.number: seat for seat in self._seats}
        return [held[number] for number in numbers]

    def _ask(self, seats: Sequence[_Seat], verb: str, given: Sequence[Any]) -> list[Any]:
        """What the processes answer, which all work at the same time; TerrellaError after all of them where one failed."""
        for seat, value in zip(seats, given):
            with suppress(OSError):
                seat.pipe.send((verb, value))
        answers, failed = [], ""
        for seat in seats:
            try:
                done, answer = seat.pipe.recv()
                failed = failed or ("" if done else answer)
                answers.append(answer)
            except (EOFError, OSError):
                seat.pipe.close()
                if seat in self._seats:
                    self._seats.remove(seat)
                failed = f"a process of {self._name} crashed or was killed; after a reset another takes its place."
        if failed:
            raise TerrellaError(failed)
        return answers

    def _launch(self, count: int) -> list[_Seat]:
        """One process that has imported everything and then forks itself: the caller's __main__ is not run again there."""
        pairs = [Pipe() for _ in range(count)]
        theirs = [far.fileno() for _, far in pairs]
        around = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path), "OMP_NUM_THREADS": "1"}
        code = f"from {__name__} import work; work({theirs})"
        command = [sys.executable, "-P", "-c", code]
        more = {"pass_fds": theirs, "stdin": subprocess.DEVNULL, "stdout": 2, "start_new_session": True}
        self._launched.append(subprocess.Popen(command, env={**os.environ, **around}, **more))
        for _, far in pairs:
            far.close()
        seats = [_Seat(near) for near, _ in pairs]
        self._ask(seats, "make", [pickle.dumps(CloudpickleWrapper(self._make))] * count)  # pyright: ignore[reportArgumentType]
        self._seats += seats
        return seats


def _end(seats: list[_Seat], launched: list[subprocess.Popen]) -> None:
    """Hangs up, at which the processes end; one that hangs is killed."""
    for seat in seats:
        seat.pipe.close()
    seats.clear()
    for process in launched:
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    launched.clear()


def work(pipes: Sequence[int]) -> None:
    """In the process that was launched: a child for each pipe, until all have ended."""
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
                if verb == "make":  # of the caller's own pipe, never of a file: read here, so that a fault is an answer
                    episode, answer = pickle.loads(given)(), None
                else:
                    answer = getattr(episode, verb)(given)
                answer = True, answer
            except Exception as error:
                whole = f"an episode cannot be played in a process of its own: {type(error).__name__}: {error}"
                answer = False, str(error) if isinstance(error, TerrellaError) else whole
            pipe.send(answer)
