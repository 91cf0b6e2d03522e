"""Trainer: the one training loop. A feed gives batches, an objective gives losses.

All of a step's randomness comes from (seed, step), so a run that was stopped sees what an unbroken one would. Ctrl-C
lets the step that is under way end, saves it and stops; the same command goes on exactly from there.
"""

from __future__ import annotations

import copy
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
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
LOG_EVERY = 20  # steps
CPU = torch.device("cpu")
Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Now:
    """One step: its number, the share of the training before it (of its steps or of its time, whichever is more), and its
    randomness, which (seed, step) alone decides."""

    step: int
    share: float
    device: torch.device
    rng: np.random.Generator
    noise: torch.Generator = field(repr=False)

    def randn(self, *shape: int) -> torch.Tensor:
        """Normal noise on the device, drawn on the CPU: the same on any device."""
        return torch.randn(*shape, generator=self.noise).to(self.device)

    def half(self) -> torch.autocast:
        """Within it networks compute in half precision, where that is native."""
        return half_precision(self.device)


class Average(nn.Module, Generic[Module]):
    """The moving average of a module's weights, which play will use; it follows slowly, at most by `limit`."""

    updates: torch.Tensor
    module: Module

    def __init__(self, raw: Module, limit: float):
        super().__init__()
        self.limit, self.module = limit, copy.deepcopy(raw).eval().requires_grad_(False)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def follow(self, raw: nn.Module) -> None:
        number = int(self.updates)
        keep = min(self.limit, (number + 1) / (number + 20))
        for mean, weight in zip(self.module.parameters(), raw.parameters()):
            mean.lerp_(weight, 1 - keep)
        self.updates += 1


@dataclass(frozen=True)
class Learner:
    """An optimiser and the modules that it moves.

    rate:    the learning rate at a step, times the "pace" of each group of parameters that has one; None: as it is.
    average: follows the first of the modules.
    clip:    the norm at which the gradient of each module is cut.
    """

    optimiser: torch.optim.Optimizer
    modules: Sequence[nn.Module]
    rate: Callable[[Now], float] | None = None
    average: Average[Any] | None = None
    clip: float = 1.0


def adamw(
    modules: Sequence[nn.Module],
    rate: Callable[[Now], float],
    decay: float = 1e-4,
    betas: tuple[float, float] = (0.9, 0.99),
    average: Average[Any] | None = None,
) -> Learner:
    """AdamW for all weights of the modules, which moves them by `rate`."""
    weights = [weight for module in modules for weight in module.parameters()]
    return Learner(torch.optim.AdamW(weights, betas=betas, weight_decay=decay), modules, rate, average)


def warmed(peak: float, steps: int, low: float = 0.0) -> Callable[[Now], float]:
    """A rate that goes up to `peak` over so many steps, and down to `low` of it along a cosine over the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps) * cosine(now.share, low)


def held(peak: float, steps: int) -> Callable[[Now], float]:
    """A rate that goes up to `peak` over so many steps, stays there, and goes down to 0 over the last 30% of the training."""
    return lambda now: peak * min(1, (now.step + 1) / steps, (1 - now.share) / 0.3)


@dataclass(frozen=True)
class Loss:
    """What the learner of this name descends next; `parts` are what the log tells of it."""

    learner: str
    value: torch.Tensor
    parts: Mapping[str, torch.Tensor]


class Objective(Protocol):
    """What is learned. `modules` are saved with the run and moved to its device; `losses` yields a step's losses one by
    one, each of which is descended before the next is asked for."""

    @property
    def modules(self) -> Mapping[str, nn.Module]: ...
    @property
    def learners(self) -> Mapping[str, Learner]: ...
    def losses(self, batch: Any, now: Now) -> Iterator[Loss]: ...


class Feed(Protocol):
    """What is learned from. `state` are JSON values after the batch that was given last; `resume` goes on from them."""

    def batch(self, now: Now, /) -> Any: ...
    def state(self) -> dict: ...
    def resume(self, state: Mapping) -> None: ...


@dataclass(frozen=True)
class Run:
    """The folder of a training run, and what its stages share.

    recipe: JSON values that must not change within the run.
    budget: the time that all stages share.
    """

    out: Path
    recipe: Mapping[str, Any]
    report: Report
    seed: int = 0
    device: torch.device = CPU
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    budget: Budget = field(default_factory=Budget, compare=False)

    @staticmethod
    def of(
        out: str | Path,
        config: Any,
        report: Report,
        device: torch.device = CPU,
        free: Sequence[str] = (),
        shares: Mapping[str, float] | None = None,
        **facts: Any,
    ) -> Run:
        """The run of a recipe's settings, a dataclass, of which all but `free` and where and how often it is saved must not
        change, nor may `facts`; `shares` of the settings' `hours`, if they have any, are the most that stages may take."""
        settings = asdict(config)
        times = {name: settings[name] for name in ("save_every_s", "strip_every_s") if name in settings}
        fixed = {name: value for name, value in settings.items() if name not in (*times, "device", *free)}
        budget = Budget(Path(out), settings.get("hours", math.inf), shares)
        return Run(Path(out), {**fixed, **facts}, report, config.seed, device, **times, budget=budget)

    def found(self, stage: str) -> dict | None:
        """The facts of a stage that was begun; TrainingError where that had other settings, or was of another recording."""
        found, recipe = load_run(resume_file(self.out, stage), {}, {}), json.loads(json.dumps(self.recipe))
        old = recipe if found is None else found.get("recipe", {})
        both = {**old, **recipe}
        other = [
            f"{name} {old.get(name)}, not {recipe.get(name)}" for name in both if recipe.get(name) != old.get(name)
        ]
        if other:
            raise TrainingError(
                f"{self.out} holds a run with other settings ({'; '.join(other)}); repeat them, or give another --out."
            )
        return found


class Trainer:
    """A stage of a run; it goes on where it was stopped, and ends after `steps` or when the share of the run's time is over that
    it may take; what earlier runs did counts.

    TrainingError where the run's folder holds one with another recipe.

    device:  where it is to run, if not where the others do.
    strides: losses of a batch, each of which is descended. People count them: `steps`, `taken`, the log and the summary do.
    limit_s: seconds after which it ends.
    facts:   recipe, step (batches), seconds, and what `once` added; saved with the rest.
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
        found = run.found(stage)
        for module in objective.modules.values():
            module.to(self.device)
        if found:
            self.facts |= load_run(self._file, objective.modules, self._optimisers) or {}
            feed.resume(self.facts["feed"])
        trim_log(run.out, stage, self.taken)

    @property
    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {f"optimiser of {name}": learner.optimiser for name, learner in self.objective.learners.items()}

    @property
    def summary(self) -> dict[str, Any]:
        """The facts that people read."""
        inner = ("recipe", "recent", "feed", "spent", "asked")
        return {name: fact for name, fact in self.facts.items() if name not in inner} | {"step": self.taken}

    @property
    def taken(self) -> int:
        """Steps that were taken, of all runs."""
        return self.facts["step"] * self.strides

    @property
    def finished(self) -> bool:
        return self.share >= 1

    @property
    def share(self) -> float:
        """How much of the training is done, of its steps or of its time, whichever is more."""
        by_time = self.facts["seconds"] / self.limit_s if self.limit_s > 0 else 1.0
        return max(self.facts["step"] / self.batches if self.batches > 0 else 1.0, by_time)

    def train(self, draw: Callable[[], None] | None = None) -> None:
        """Trains to the end; `draw()` now and then, which leaves what there is to look at."""
        if self.finished:
            return
        for learner in self.objective.learners.values():
            for module in learner.modules:
                module.train()
        with _stoppable() as stop:
            self._train(draw, stop)

    def _train(self, draw: Callable[[], None] | None, stop: threading.Event) -> None:
        facts, run = self.facts, self.run
        began = saved = drawn = time.monotonic()
        before = facts["seconds"]
        while not self.finished and not stop.is_set():
            parts = self._step(facts["step"])
            facts["step"] += 1
            facts["recent"].append(parts)
            now = time.monotonic()
            facts["seconds"] = before + now - began
            if len(facts["recent"]) == LOG_EVERY or self.finished:
                self._log()
            if now - saved > run.save_every_s:
                self.save()
                saved = now
            if draw is not None and now - drawn > run.strip_every_s:
                draw()
                drawn = time.monotonic()
        self.save()
        if stop.is_set():
            done = f"{self.taken} steps of '{self.stage}' are saved in {run.out}"
            raise KeyboardInterrupt(f"{done}; the same command goes on from there.")

    def _step(self, step: int) -> dict[str, float]:
        """One whole round: a batch, and down each of its losses in turn. Returns the means of their parts."""
        rng = np.random.default_rng([self.run.seed, step])
        noise = make_rng(int(rng.integers(2**62)))
        now = Now(step, self.share, self.device, rng, noise)
        for learner in self.objective.learners.values():
            if learner.rate is not None:
                for group in learner.optimiser.param_groups:
                    group["lr"] = learner.rate(now) * group.get("pace", 1.0)
        found: dict[str, list[float]] = {}
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(int(rng.integers(2**62)))  # dropout knows no generator of its own
            for loss in self.objective.losses(self.feed.batch(now), now):
                self._descend(loss, step * self.strides)
                for name, part in loss.parts.items():
                    found.setdefault(name, []).append(float(part.detach()))
        return {name: float(np.mean(values)) for name, values in found.items()}

    def _descend(self, loss: Loss, step: int) -> None:
        """One step down the gradient."""
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
            learner.average.follow(learner.modules[0])

    def save(self) -> None:
        """The run as it is after its last whole step."""
        self.run.out.mkdir(parents=True, exist_ok=True)
        self.facts |= {"feed": self.feed.state(), "spent": self.run.budget.spent_s}
        save_run(self._file, self.objective.modules, self._optimisers, self.facts)

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` finds once the training is over (JSON values), kept with the run."""
        if name not in self.facts:
            self.facts[name] = make()
            self.save()
        return self.facts[name]

    def _log(self) -> None:
        facts, recent = self.facts, self.facts["recent"]
        mean = {name: float(np.mean([one[name] for one in recent if name in one])) for name in recent[-1]}
        line = {"stage": self.stage, "step": self.taken, "seconds": round(facts["seconds"]), **mean}
        write_log(self.run.out, line)
        facts["recent"] = []
        words = " ".join(f"{name} {value:.4f}" for name, value in mean.items())
        self.run.report(min(self.share, 1.0), 1.0, f"{self.stage}: {words}")


def _not_a_number(what: str, step: int) -> str:
    return (
        f"{what} is not a number at step {step}; the last save is good: lower --learning-rate, or give another --seed."
    )


@contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """Within it the first Ctrl-C sets the event, and only a second one interrupts what is under way."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def asked(number, frame) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, asked)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def cosine(share: float, low: float = 0.0) -> float:
    """From 1 down to `low` as `share` goes from 0 to 1."""
    return low + (1 - low) * (0.5 + 0.5 * float(np.cos(np.pi * min(share, 1.0))))


def half_precision(device: torch.device) -> torch.autocast:
    """bfloat16 where the device computes it natively."""
    native = device.type == "cuda" or torch.backends.cpu.get_cpu_capability() == "AVX512" and _cpu_has_bf16()
    return torch.autocast(device.type, torch.bfloat16, enabled=native)


def _cpu_has_bf16() -> bool:
    """In hardware: where oneDNN only emulates it, it is 2.7 times slower than float32."""
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def device_named(name: str) -> torch.device:
    """cpu, cuda, or auto: a GPU where there is one. TrainingError for what PyTorch does not know or has not here."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
        return device
    except (RuntimeError, AssertionError, NotImplementedError, ModuleNotFoundError):
        raise TrainingError(f"--device {name}: PyTorch has no such device here; say cpu, cuda or auto.") from None
