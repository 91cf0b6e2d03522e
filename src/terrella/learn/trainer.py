"""Trainer: the one training loop. A feed gives batches, an objective gives losses.

All randomness of a step is seeded by (seed, step), so a stopped and resumed run sees what an unbroken one does. On Ctrl-C the
step under way ends, the run is saved and stops; the same command resumes exactly there.
"""

from __future__ import annotations

import itertools
import json
import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from ..core import nvml
from ..core.errors import TrainingError, is_out_of_memory, reason_of
from ..core.precision import half_is_native
from ..core.world import make_rng
from .budget import Budget
from .devices import yield_cores
from .learners import Learner
from .run_folder import check_run, load_run, resume_file, save_run, trim_log, write_log
from .sized_feed import Feed, ResizableFeed
from .train_step import TrainStep
from .update import Update

Report = Callable[[float, float, str], None]
Paced = Callable[[int], None]
LOG_EVERY = 20  # steps
PACE_S = 30.0  # of training after which its pace is known, or sooner: after the first picture
LOOK_S = 30.0  # between looks at how busy the machine is
CPU = torch.device("cpu")
RETIRED = ("generator",)  # settings of earlier runs that no longer exist


@dataclass(frozen=True)
class Loss:
    """The loss that the learner of this name minimises next; `parts` are its terms, for the log."""

    learner: str
    value: torch.Tensor
    parts: Mapping[str, torch.Tensor]


class Objective(Protocol):
    """What is learned. `modules` are saved with the run and moved to its device. `losses` yields the losses of a step one by
    one; each is minimised by a gradient step before the next is computed."""

    @property
    def modules(self) -> Mapping[str, nn.Module]: ...
    @property
    def learners(self) -> Mapping[str, Learner]: ...
    def losses(self, batch: Any, now: TrainStep) -> Iterator[Loss]: ...


@dataclass(frozen=True)
class Run:
    """The folder of a training run, and what its stages share.

    recipe: JSON values that must stay the same for the run to be resumed.
    budget: the time that all stages share.
    usual:  settings at their defaults: a run that was saved before there was such a setting had that default.
    """

    out: Path
    recipe: Mapping[str, Any]
    report: Report
    seed: int = 0
    device: torch.device = CPU
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    budget: Budget = field(default_factory=Budget, compare=False)
    usual: frozenset[str] = frozenset()

    @staticmethod
    def of(
        out: str | Path, config: Any, report: Report, device: torch.device = CPU, free: Sequence[str] = (), **facts: Any
    ) -> Run:
        """The run of `config`, a dataclass. A resumed run must have the same settings and `facts`; the device, how often is saved
        and the settings in `free` may change. The stages share the `hours` of the settings, if they have any."""
        if config.seed < 0:
            raise TrainingError(f"--seed is 0 or more; got {config.seed}.")
        settings = asdict(config)
        check_run(Path(out), settings)
        times = {name: settings[name] for name in ("save_every_s", "strip_every_s") if name in settings}
        fixed = {name: value for name, value in settings.items() if name not in (*times, "device", *free)}
        budget = Budget(Path(out), settings.get("hours", math.inf))
        usual = frozenset(one.name for one in fields(config) if settings[one.name] == one.default)
        return Run(Path(out), {**fixed, **facts}, report, config.seed, device, **times, budget=budget, usual=usual)

    def saved_facts(self, stage: str) -> dict | None:
        """The facts of a stage that was begun; TrainingError if it had other settings, or another recording."""
        saved, recipe = load_run(resume_file(self.out, stage), {}, {}), json.loads(json.dumps(self.recipe))
        old = recipe
        if saved is not None:
            old = {name: value for name, value in saved.get("recipe", {}).items() if name not in RETIRED}
        both = {name: value for name, value in recipe.items() if name in old or name not in self.usual} | old
        other = [
            f"{name} {old.get(name)}, not {recipe.get(name)}" for name in both if recipe.get(name) != old.get(name)
        ]
        if other:
            unknown = any(name not in old for name in both)  # of an earlier release, which no command repeats
            raise TrainingError(
                f"{self.out} holds a run with other settings ({'; '.join(other)}); "
                f"{'' if unknown else 'repeat them, or '}give another --out."
            )
        return saved


class Trainer:
    """One stage of a run. It resumes where it was stopped, and ends after `steps`, or after its share of the run's time,
    earlier runs included. TrainingError if the run's folder holds a run with another recipe.

    device:  where it runs, if not on the run's device.
    strides: gradient steps of the main learner per batch. `steps`, `steps_done`, the log and the summary count gradient steps.
    limit_s: seconds after which it ends.
    facts:   recipe, step (batches), seconds, and what `compute_once` added; saved with the run.
    """

    def __init__(
        self,
        run: Run,
        stage: str,
        feed: Feed,
        objective: Objective,
        steps: int,
        device: torch.device | None = None,
        strides: int = 1,
    ):
        self.run, self.stage, self.feed, self.objective = run, stage, feed, objective
        self.strides, self.batches = strides, -(-steps // strides)
        self.limit_s, self.device = run.budget.most_s(stage), device or run.device
        self.facts: dict[str, Any] = {"recipe": json.loads(json.dumps(run.recipe)), "step": 0}
        self.facts |= {"seconds": 0.0, "recent": []}
        self._file = resume_file(run.out, stage)
        saved = run.saved_facts(stage)
        for module in objective.modules.values():
            module.to(self.device)
        self._busy_percent = nvml.busy_percent() if self.device.type == "cuda" else None
        self._halved: list[bool] = []
        self._finite: list[torch.Tensor] = []  # of the steps since losses were last read
        self._updates: dict[str, Update] = {}  # of each learner
        if saved:
            self._load()
        trim_log(run.out, stage, self.steps_done)

    @property
    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {f"optimiser of {name}": learner.optimiser for name, learner in self.objective.learners.items()}

    @property
    def summary(self) -> dict[str, Any]:
        """The facts without those that only a resumed run needs."""
        inner = ("recipe", "recent", "feed", "spent", "asked", "shares")
        return {name: fact for name, fact in self.facts.items() if name not in inner} | {"step": self.steps_done}

    @property
    def steps_done(self) -> int:
        """Gradient steps so far, earlier runs included."""
        return self.facts["step"] * self.strides

    @property
    def finished(self) -> bool:
        return self.share >= 1

    @property
    def _waits(self) -> bool:
        """Whether each step is looked at, which costs nothing on a CPU."""
        return self.device.type == "cpu"

    @property
    def share(self) -> float:
        """The part of the training that is done, by steps or by time, whichever is more."""
        by_time = self.facts["seconds"] / self.limit_s if self.limit_s > 0 else 1.0
        return max(self.facts["step"] / self.batches if self.batches > 0 else 1.0, by_time)

    def train(self, draw: Callable[[], object] | None = None, paced: Paced | None = None) -> None:
        """Trains to the end; calls `draw()` every strip_every_s seconds, which leaves pictures to look at, and once, as soon as the
        pace is known, `paced(steps)` with the steps that there will be at it, earlier runs included."""
        if self.finished:
            return
        for learner in self.objective.learners.values():
            for module in learner.modules:
                module.train()
        with _stoppable() as stop:
            self._train(draw, stop, paced)

    def _train(self, draw: Callable[[], object] | None, stop: threading.Event, paced: Paced | None) -> None:
        facts, run = self.facts, self.run
        if half_is_native(self.device) and not self._file.exists():
            self.save()  # to go back to from what is not a number
        began = saved = drawn = looked = time.monotonic()
        before, first = facts["seconds"], self.steps_done
        timed = (began, first) if self._waits else None  # since when the pace counts, and the steps then
        while not self.finished and not stop.is_set():
            if not self._completed_step():
                continue
            now = time.monotonic()
            timed = timed or (now, self.steps_done)  # on a GPU the first batch is compiled
            facts["seconds"] = before + now - began
            if self.finished and not self._settled():
                began = now - facts["seconds"] + before  # the time since the last save is taken again
                continue
            if len(facts["recent"]) == LOG_EVERY or self.finished:
                since, done = timed if timed is not None and self.steps_done > timed[1] else (began, first)
                self._log((self.steps_done - done) / max(now - since, 1e-9))
            if now - saved > run.save_every_s and self._settled():
                self.save()
                saved = now
            if now - looked > LOOK_S:
                yield_cores()
                looked = now
            if draw is not None and now - drawn > run.strip_every_s:
                draw()
                if not self._waits and drawn == began:
                    timed = None  # nor does the first picture say how long the others take
                drawn = time.monotonic()
            if paced is None or timed is None or self.steps_done <= timed[1]:
                continue
            if now - timed[0] > PACE_S or (self._waits and drawn > began):
                per_s = (self.steps_done - timed[1]) / (time.monotonic() - timed[0])
                left_s = self.limit_s - before - (timed[0] - began)
                paced(min(self.batches * self.strides, timed[1] + int(left_s * per_s)))
                paced = None
        self._settled()
        self.save()
        if stop.is_set():
            done = f"{self.steps_done} steps of '{self.stage}' are saved in {run.out}"
            raise KeyboardInterrupt(f"{done}; the same command continues.")

    def _completed_step(self) -> bool:
        """Takes a step, unless the device has no memory for it, or half precision gives what is not a number: it is repeated with
        half of the batch, or in float32."""
        facts = self.facts
        try:
            facts["recent"].append(self._step(facts["step"]))
            facts["step"] += 1
            return (len(facts["recent"]) < LOG_EVERY and not self.finished) or self._settled()
        except _NotFinite as error:
            self._go_on_in_float32(error)
            return False
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            reason = reason_of(error)
        self._halve_batch(reason)  # here the tensors of the step are free
        if self._settled():
            self.save()  # with the smaller batch
        return False

    def _halve_batch(self, reason: str) -> None:
        feed, lacks = self.feed, f"{self.device} has too little memory for"
        if not isinstance(feed, ResizableFeed):
            raise TrainingError(
                f"{lacks} this batch; give a smaller --batch, or compute on the CPU. What was saved before is in {self.run.out}."
            )
        if feed.size < 2 * feed.least:
            raise TrainingError(
                f"{lacks} a batch of {feed.size} ({reason}); train smaller pictures or networks, or on the CPU (--device cpu). "
                f"What was saved before is in {self.run.out}."
            )
        feed.resize(feed.size // 2)
        torch.cuda.empty_cache()
        half = f"the batch is halved to {feed.size}, and training goes on"
        warnings.warn(f"{self.device} ran out of memory: {half}.", stacklevel=2)

    def _go_on_in_float32(self, error: TrainingError) -> None:
        """From the last save, as in half precision there is one; without it from these weights, which no such step changed."""
        if self.facts.get("float32") or not self._halved:
            raise error
        self._finite.clear()
        if self._file.exists():
            self._load()
        self.facts |= {"float32": True, "recent": []}
        warnings.warn(
            f"in bfloat16 {str(error).partition(';')[0]}: training goes on in float32 from step {self.steps_done}.",
            stacklevel=2,
        )

    def _load(self) -> None:
        """Restores the last save, with batches as large as then."""
        if isinstance(self.feed, ResizableFeed):
            saved = load_run(self._file, {}, {}) or {}
            self.feed.resize(saved.get("batch", self.feed.size))
        self.facts |= load_run(self._file, self.objective.modules, self._optimisers) or {}
        self._updates.clear()
        self.feed.resume(self.facts["feed"])

    def time_steps(self, most_s: float) -> float:
        """Seconds of a gradient step, timed for about `most_s` after a first one, by three at least. It changes the modules."""
        began, ends = time.monotonic(), list[float]()
        for step in itertools.count():
            rng = np.random.default_rng([self.run.seed, step])
            now = TrainStep(step, 0.0, self.device, rng, make_rng(step))
            try:
                for loss in self.objective.losses(self.feed.batch(now), now):
                    self._descend(loss, step * self.strides)
                    ends.append(time.monotonic())
                    if len(ends) > 3 and (ends[-1] - began > most_s or len(ends) > 60):
                        return (ends[-1] - ends[0]) / (len(ends) - 1)
                continue
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error):
                    raise
                reason = reason_of(error)
            self._halve_batch(reason)
            ends.clear()
        raise AssertionError  # a feed never ends

    def _step(self, step: int) -> dict[str, list[torch.Tensor]]:
        """One batch, and one gradient step for each of its losses in turn. Returns the losses' parts, which the device may still be
        computing."""
        rng = np.random.default_rng([self.run.seed, step])
        noise = make_rng(int(rng.integers(2**62)), "cuda" if self.device.type == "cuda" else "cpu")
        now = TrainStep(step, self.share, self.device, rng, noise, self.facts.get("float32", False), self._halved)
        for learner in self.objective.learners.values():
            if learner.rate is not None:
                for group in learner.optimiser.param_groups:
                    group["lr"] = learner.rate(now) * group.get("pace", 1.0)
        parts: dict[str, list[torch.Tensor]] = {}
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(int(rng.integers(2**62)))  # dropout takes no generator
            for loss in self.objective.losses(self.feed.batch(now), now):
                self._descend(loss, step * self.strides)
                for name, part in loss.parts.items():
                    parts.setdefault(name, []).append(part.detach())
        return parts

    def _read_losses(self) -> None:
        """Waits for the device: makes numbers of the losses since the last time."""
        recent = self.facts["recent"]
        waiting = [
            value for parts in recent for values in parts.values() if isinstance(values, list) for value in values
        ]
        if waiting:
            numbers = iter(torch.stack([value.double() for value in waiting]).tolist())
            for parts in recent:
                parts |= {
                    name: float(np.mean([next(numbers) for _ in values]))
                    for name, values in parts.items()
                    if isinstance(values, list)
                }

    def _settled(self) -> bool:
        """Whether all was finite since the last time, as it must be before a save. Else training goes on from the last save, in
        float32; TrainingError where it already computes so."""
        try:
            self._check_finite()
            return True
        except _NotFinite as error:
            self._go_on_in_float32(error)
            return False

    def _check_finite(self) -> None:
        """Waits for the device. TrainingError if a loss or a gradient was not a number since the last time."""
        finite, self._finite = self._finite, []
        if finite and not bool(torch.stack(finite).all()):
            raise _NotFinite(_not_a_number("a loss or a gradient", self.facts["step"] * self.strides))

    def _descend(self, loss: Loss, step: int) -> None:
        """One gradient step."""
        learner, waits = self.objective.learners[loss.learner], self._waits
        finite = torch.isfinite(loss.value.detach())
        if waits and not finite:
            raise _NotFinite(_not_a_number("the loss", step))
        learner.optimiser.zero_grad()
        loss.value.backward()
        if loss.learner not in self._updates:
            self._updates[loss.learner] = Update(learner)
        finite = self._updates[loss.learner](finite)
        if waits and not finite:
            raise _NotFinite(_not_a_number("a gradient", step))
        if not waits:  # another device is asked only now and then
            self._finite.append(finite)

    def save(self) -> None:
        """Saves the run as it is after its last whole step. TrainingError, and no save, if a weight is not a number."""
        self._read_losses()
        for module in self.objective.modules.values():
            if any(bool(weight.isnan().any()) for weight in module.parameters()):
                raise _NotFinite(_not_a_number("a weight", self.steps_done))
        self.run.out.mkdir(parents=True, exist_ok=True)
        if isinstance(self.feed, ResizableFeed):
            self.facts["batch"] = self.feed.size
        self.facts |= {"feed": self.feed.state(), "spent": self.run.budget.spent_s}
        save_run(self._file, self.objective.modules, self._optimisers, self.facts)

    def compute_once(self, name: str, make: Callable[[], Any]) -> Any:
        """The result of `make()` (JSON values), computed the first time and kept with the run."""
        if name not in self.facts:
            self.facts[name] = make()
            self.save()
        return self.facts[name]

    def _log(self, steps_per_s: float) -> None:
        self._read_losses()
        facts, recent = self.facts, self.facts["recent"]
        mean = {name: float(np.mean([one[name] for one in recent if name in one])) for name in recent[-1]}
        line = {"stage": self.stage, "step": self.steps_done, "seconds": round(facts["seconds"]), **mean}
        write_log(self.run.out, line)
        facts["recent"] = []
        words = " ".join(f"{name} {value:.4f}" for name, value in mean.items())
        pace = f"{steps_per_s:.1f} steps/s" if steps_per_s >= 1 else f"{1 / steps_per_s:.1f} s a step"
        pace += f" of {self.feed.size}" if isinstance(self.feed, ResizableFeed) else ""
        pace += f", GPU {self._busy_percent()}% busy" if self._busy_percent else ""
        self.run.report(min(self.share, 1.0), 1.0, f"{self.stage}: step {self.steps_done:,}, {pace}, {words}")


class _NotFinite(TrainingError):
    """A loss or a gradient is not a number."""


def _not_a_number(what: str, step: int) -> str:
    return (
        f"{what} is not a number at step {step}; the last save is good: lower --learning-rate, or give another --seed."
    )


@contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """A context in which the first Ctrl-C sets the event; only a second one interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def on_signal(number, frame) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, on_signal)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
