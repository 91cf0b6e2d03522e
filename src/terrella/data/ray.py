"""RayWorkers: the workers of `collect` as processes on a Ray cluster, or on this machine."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# ray is an extra

import os
import sys
import uuid
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..core.errors import TerrellaError
from .collect import MOST_DEATHS, Job, Player
from .staged import Parcel

START_S, CLEAR_S = 180.0, 5.0  # seconds that workers may take to start, and to remove their files


@contextmanager
def _finding_our_modules() -> Iterator[None]:
    """Processes started in here have the import path of this one."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


class RayWorkers:
    """`size` actors of one processor each, on the cluster at RAY_ADDRESS, or on a local Ray that ends with this process.

    Episodes come back through Ray: the machines need the same packages but no shared disk. TerrellaError where Ray is not
    installed, or the cluster has too few processors.
    """

    def __init__(self, size: int):
        if size < 1:
            raise TerrellaError(f"{size} workers play nothing; ask for one or more.")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's default of 15 would starve them on a busy machine
        try:
            import ray
        except ImportError as error:
            raise TerrellaError("--on ray needs Ray: pip install 'terrella[ray]'.") from error
        self.size, self._ray = size, ray
        self._asked: dict[Any, tuple[int, int]] = {}  # what was asked -> the episode, and of whom

    def begin(self, job: Job) -> None:
        ray = self._ray
        self._ours = not ray.is_initialized()
        if self._ours:
            local = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": self.size, "include_dashboard": False}
            try:
                with _finding_our_modules():
                    ray.init(log_to_driver=False, logging_level="ERROR", **local)
            except Exception as error:
                first = (str(error).strip() or type(error).__name__).splitlines()[0]
                raise TerrellaError(f"Ray did not start ({first}); check RAY_ADDRESS, or unset it.") from error
        here = int(ray.cluster_resources().get("CPU", 0))
        if here < self.size:
            raise TerrellaError(f"this Ray has {here} processors; ask for as many --workers or fewer.")
        again = {"max_restarts": -1, "max_task_retries": MOST_DEATHS - 1}
        made, run = ray.remote(num_cpus=1, **again)(Player), uuid.uuid4().hex[:12]
        self._actors = [made.remote(job, f"{run}-{at}") for at in range(self.size)]
        self._started()

    def _started(self) -> None:
        """Continues with the workers that have started, which may be fewer than `size`; TerrellaError where none has."""
        ready = {actor.__ray_ready__.remote(): actor for actor in self._actors}
        _, late = self._ray.wait(list(ready), num_returns=self.size, timeout=START_S)
        if len(late) == self.size:
            raise TerrellaError(
                f"no worker has started on Ray within {START_S:.0f} s: its processors are busy (`ray status` says with what). Wait "
                "until some are free, or leave --on ray out."
            )
        for one in late:
            self._ray.kill(ready[one])
            self._actors.remove(ready[one])
        if late:
            warnings.warn(f"{len(late)} of {self.size} workers found no free processor; others start.", stacklevel=2)
        self.size = len(self._actors)

    def ask(self, number: int) -> None:
        load = [0] * self.size
        for _, at in self._asked.values():
            load[at] += 1
        at = load.index(min(load))
        self._asked[self._actors[at].play.remote(number)] = number, at

    def answers(self) -> list[tuple[int, Parcel | str]]:
        (done,), _ = self._ray.wait(list(self._asked), num_returns=1)
        number, _ = self._asked.pop(done)
        try:
            return [(number, self._ray.get(done))]
        except self._ray.exceptions.RayError as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            return [(number, f"episode {number} ended its worker {MOST_DEATHS} times, or fails on Ray ({first})")]

    def close(self) -> None:
        actors = getattr(self, "_actors", [])
        try:
            if actors:
                self._ray.wait([actor.clear.remote() for actor in actors], num_returns=len(actors), timeout=CLEAR_S)
        finally:
            for actor in actors:
                self._ray.kill(actor)
            self._asked.clear()
            if getattr(self, "_ours", False):
                self._ray.shutdown()
