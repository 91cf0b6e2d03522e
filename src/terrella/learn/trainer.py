"""Trainer: the one training loop. A feed gives batches, an objective gives losses.

All randomness of a step is seeded by (seed, step), so a stopped and resumed run sees what an unbroken one does. On Ctrl-C the
step under way ends, the run is saved and stops; the same command resumes exactly there.
"""

from __future__ import annotations

import copy
import itertools
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import nn

from ..core.errors import TrainingError
from ..core.world import make_rng
from .budget import Budget
from .run_folder import load_run, resume_file, save_run, trim_log, write_log

Report = Callable[[float, float, str], None]
Paced = Callable[[int], None]
LOG_EVERY = 20  # steps
PACE_S = 30.0  # of training after which its pace is known, or sooner: after the first picture
LOOK_S = 30.0  # between looks at how busy the machine is
BUSY = 1.5  # processes that run, for each core, from which a machine is busy
CPU = torch.device("cpu")
RETIRED = ("generator",)  # settings of earlier runs that no longer exist
Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class TrainStep:
    """One training step. share: the part of the training that lies before it, by steps or by time, whichever is more;
    rng, noise: its randomness, seeded by (seed, step)."""

    step: int
    share: float
    device: torch.device
    rng: np.random.Generator
    noise: torch.Generator = field(repr=False)

    def randn(self, *shape: int) -> torch.Tensor:
        """Standard normal noise on the device; drawn on the CPU, so that it is the same on any device."""
        return torch.randn(*shape, generator=self.noise).to(self.device)

    def rand(self, *shape: int) -> torch.Tensor:
        """Uniform noise in 0..1, likewise."""
        return torch.rand(*shape, generator=self.noise).to(self.device)

    def half(self) -> torch.autocast:
        """A context in which networks compute in half precision, where that is native."""
        return half_precision(self.device)


class Ema(nn.Module, Generic[Module]):
    """An exponential moving average of a module's weights, which play uses; its decay ramps up to `limit`."""

    updates: torch.Tensor
    module: Module

    def __init__(self, raw: Module, limit: float):
        super().__init__()
        self.limit, self.module = limit, copy.deepcopy(raw).eval().requires_grad_(False)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def update(self, raw: nn.Module) -> None:
        number = int(self.updates)
        keep = min(self.limit, (number + 1) / (number + 20))
        for mean, weight in zip(self.module.parameters(), raw.parameters()):
            mean.lerp_(weight, 1 - keep)
        self.updates += 1


@dataclass(frozen=True)
class Learner:
    """An optimiser and the modules whose parameters it updates.

    rate:    the learning rate at a step, times the "pace" of each parameter group that has one; None: constant.
    average: of the first module's weights.
    clip:    the norm to which each module's gradient is clipped.
    """

    optimiser: torch.optim.Optimizer
    modules: Sequence[nn.Module]
    rate: Callable[[TrainStep], float] | None = None
    average: Ema[Any] | None = None
    clip: float = 1.0


def adamw(
    modules: Sequence[nn.Module],
    rate: Callable[[TrainStep], float],
    decay: float = 1e-4,
    betas: tuple[float, float] = (0.9, 0.99),
    average: Ema[Any] | None = None,
) -> Learner:
    """AdamW for all parameters of the modules."""
    weights = [weight for module in modules for weight in module.parameters()]
    return Learner(torch.optim.AdamW(weights, betas=betas, weight_decay=decay), modules, rate, average)


def warmup_cosine(peak: float, steps: int, low: float = 0.0) -> Callable[[TrainStep], float]:
    """Linear warm-up to `peak` over `steps` steps, then cosine decay to `low` times it over the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps) * cosine_decay(now.share, low)


def hold_then_decay(peak: float, steps: int) -> Callable[[TrainStep], float]:
    """Linear warm-up to `peak` over `steps` steps, constant, then linear decay to 0 over the last 30% of the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps, (1 - now.share) / 0.3)


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


class Feed(Protocol):
    """What is learned from. `state` gives JSON values that describe the position after the last batch; `resume` restores it."""

    def batch(self, now: TrainStep, /) -> Any: ...
    def state(self) -> dict: ...
    def resume(self, state: Mapping) -> None: ...


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
        settings = asdict(config)
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
            raise TrainingError(
                f"{self.out} holds a run with other settings ({'; '.join(other)}); repeat them, or give another --out."
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
        if saved:
            self.facts |= load_run(self._file, objective.modules, self._optimisers) or {}
            feed.resume(self.facts["feed"])
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
        began = saved = drawn = looked = time.monotonic()
        before, first = facts["seconds"], self.steps_done
        while not self.finished and not stop.is_set():
            parts = self._step(facts["step"])
            facts["step"] += 1
            facts["recent"].append(parts)
            now = time.monotonic()
            facts["seconds"] = before + now - began
            if len(facts["recent"]) == LOG_EVERY or self.finished:
                self._log((self.steps_done - first) / max(now - began, 1e-9))
            if now - saved > run.save_every_s:
                self.save()
                saved = now
            if now - looked > LOOK_S:
                yield_cores()
                looked = now
            if draw is not None and now - drawn > run.strip_every_s:
                draw()
                drawn = time.monotonic()
            if paced is not None and (drawn > began or now - began > PACE_S):
                spent_s = time.monotonic() - began
                at_pace = (self.limit_s - before) * (self.steps_done - first) / spent_s
                paced(min(self.batches * self.strides, first + int(at_pace)))
                paced = None
        self.save()
        if stop.is_set():
            done = f"{self.steps_done} steps of '{self.stage}' are saved in {run.out}"
            raise KeyboardInterrupt(f"{done}; the same command continues.")

    def time_steps(self, most_s: float) -> float:
        """Seconds of a gradient step, timed for about `most_s` after a first one, by three at least. It changes the modules."""
        began, ends = time.monotonic(), list[float]()
        for step in itertools.count():
            rng = np.random.default_rng([self.run.seed, step])
            now = TrainStep(step, 0.0, self.device, rng, make_rng(step))
            for loss in self.objective.losses(self.feed.batch(now), now):
                self._descend(loss, step * self.strides)
                ends.append(time.monotonic())
                if len(ends) > 3 and (ends[-1] - began > most_s or len(ends) > 60):
                    return (ends[-1] - ends[0]) / (len(ends) - 1)
        raise AssertionError  # a feed never ends

    def _step(self, step: int) -> dict[str, float]:
        """One batch, and one gradient step for each of its losses in turn. Returns the means of the losses' parts."""
        rng = np.random.default_rng([self.run.seed, step])
        noise = make_rng(int(rng.integers(2**62)))
        now = TrainStep(step, self.share, self.device, rng, noise)
        for learner in self.objective.learners.values():
            if learner.rate is not None:
                for group in learner.optimiser.param_groups:
                    group["lr"] = learner.rate(now) * group.get("pace", 1.0)
        parts: dict[str, list[float]] = {}
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(int(rng.integers(2**62)))  # dropout takes no generator
            for loss in self.objective.losses(self.feed.batch(now), now):
                self._descend(loss, step * self.strides)
                for name, part in loss.parts.items():
                    parts.setdefault(name, []).append(float(part.detach()))
        return {name: float(np.mean(values)) for name, values in parts.items()}

    def _descend(self, loss: Loss, step: int) -> None:
        """One gradient step."""
        learner = self.objective.learners[loss.learner]
        if not torch.isfinite(loss.value):
            raise TrainingError(_not_a_number("the loss", step))
        learner.optimiser.zero_grad()
        loss.value.backward()
        for module in learner.modules:
            if not torch.isfinite(nn.utils.clip_grad_norm_(module.parameters(), learner.clip)):
                raise TrainingError(_not_a_number("a gradient", step))
        learner.optimiser.step()
        if learner.average is not None:
            learner.average.update(learner.modules[0])

    def save(self) -> None:
        """Saves the run as it is after its last whole step."""
        self.run.out.mkdir(parents=True, exist_ok=True)
        self.facts |= {"feed": self.feed.state(), "spent": self.run.budget.spent_s}
        save_run(self._file, self.objective.modules, self._optimisers, self.facts)

    def compute_once(self, name: str, make: Callable[[], Any]) -> Any:
        """The result of `make()` (JSON values), computed the first time and kept with the run."""
        if name not in self.facts:
            self.facts[name] = make()
            self.save()
        return self.facts[name]

    def _log(self, steps_per_s: float) -> None:
        facts, recent = self.facts, self.facts["recent"]
        mean = {name: float(np.mean([one[name] for one in recent if name in one])) for name in recent[-1]}
        line = {"stage": self.stage, "step": self.steps_done, "seconds": round(facts["seconds"]), **mean}
        write_log(self.run.out, line)
        facts["recent"] = []
        words = " ".join(f"{name} {value:.4f}" for name, value in mean.items())
        pace = f"{steps_per_s:.1f} steps/s" if steps_per_s >= 1 else f"{1 / steps_per_s:.1f} s a step"
        self.run.report(min(self.share, 1.0), 1.0, f"{self.stage}: step {self.steps_done:,}, {pace}, {words}")


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


def cosine_decay(share: float, low: float = 0.0) -> float:
    """From 1 down to `low` as `share` goes from 0 to 1."""
    return low + (1 - low) * (0.5 + 0.5 * float(np.cos(np.pi * min(share, 1.0))))


def half_precision(device: torch.device) -> torch.autocast:
    """bfloat16 where the device computes it natively."""
    avx512 = device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX512"
    native = device.type == "cuda" or avx512 and _cpu_has_bf16()
    return torch.autocast(device.type if native else "cpu", torch.bfloat16, enabled=native)


def _cpu_has_bf16() -> bool:
    """Whether in hardware: emulated by oneDNN it is 2.7 times slower than float32."""
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def yield_cores() -> None:
    """Sets PyTorch to one thread where other processes use all cores: its threads would wait for each other."""
    if os.getloadavg()[0] > BUSY * (os.cpu_count() or 1):
        torch.set_num_threads(1)


def device_named(name: str) -> torch.device:
    """cpu, cuda, or auto (CUDA if there is one, else the CPU). TrainingError for a device that PyTorch does not have here."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
        return device
    except (RuntimeError, AssertionError, NotImplementedError, ModuleNotFoundError):
        raise TrainingError(f"--device {name}: PyTorch has no such device here; say cpu, cuda or auto.") from None
