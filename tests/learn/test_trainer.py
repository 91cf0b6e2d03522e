"""The trainer on a toy objective: exact resume at every step, honest logs, rates, limits and failures."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tests.learn.stopping import logged, quiet, saved_facts
from torch import nn

from terrella.core import chance, make_rng
from terrella.core.errors import TrainingError
from terrella.learn import train_step
from terrella.learn import trainer as module
from terrella.learn.budget import Budget, Stage
from terrella.learn.device_clips import DeviceClips
from terrella.learn.feeds import ClipStream
from terrella.learn.learners import Ema, adamw, warmup_cosine
from terrella.learn.sized_feed import SizedFeed
from terrella.learn.train_step import TrainStep
from terrella.learn.trainer import Loss, Run, Trainer

STEPS = 7


class Walk:
    """A feed with a position of its own, as clips of a recording have; each batch depends on all before it."""

    def __init__(self):
        self.at = 1.0

    def batch(self, now):
        self.at = (self.at * 1.7 + 0.3) % 5
        return torch.full((3, 4), self.at) + torch.from_numpy(now.rng.standard_normal((3, 4))).float()

    def state(self):
        return {"at": self.at}

    def resume(self, state):
        self.at = state["at"]


class Toy:
    """Two losses a step, each with a learner of its own: dropout, noise, a schedule, an average and a buffer."""

    def __init__(self, scale: float = 1.0):
        torch.manual_seed(0)
        self.scale, self.begun = scale, []
        self.body = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.3), nn.BatchNorm1d(8), nn.Linear(8, 2))
        self.head, self.smooth = nn.Linear(2, 1), Ema(self.body, 0.99)
        self.modules = {"body": self.body, "head": self.head, "smooth": self.smooth}
        rate = warmup_cosine(1e-2, 3, 0.1)
        self.learners = {"body": adamw((self.body,), rate, average=self.smooth), "head": adamw((self.head,), rate)}

    def losses(self, batch, now):
        self.begun.append(now.step)
        code = self.body(batch)
        yield Loss("body", self.scale * (code - now.randn(3, 2)).square().mean(), {"code": code.mean()})
        off = (self.head(self.body(batch).detach()) - batch.mean()).abs().mean()
        yield Loss("head", off, {"off": off})


@dataclass(frozen=True)
class Settings:
    rate: float = 0.1
    hours: float = 24.0
    save_every_s: float = 1e9
    strip_every_s: float = 1e9
    seed: int = 3


def trainer_in(out: Path, steps: int = STEPS, objective: Toy | None = None, report=quiet, **settings) -> Trainer:
    run = Run.of(out, Settings(**settings), report, free=("hours",))
    return Trainer(run, "toy", Walk(), objective or Toy(), steps)


def stop_in_step(monkeypatch, at: int, with_signal: bool = True) -> None:
    """Ctrl-C within step `at`, once; or an exception that cuts the step short."""
    original = Trainer._step

    def step(self, number):
        parts = original(self, number)
        if number == at:
            monkeypatch.setattr(Trainer, "_step", original)
            if not with_signal:
                raise KeyboardInterrupt
            signal.raise_signal(signal.SIGINT)
        return parts

    monkeypatch.setattr(Trainer, "_step", step)


def assert_same_run(one: Path, other: Path) -> None:
    whole, resumed = (load_file(out / "resume-toy.safetensors") for out in (one, other))
    assert whole.keys() == resumed.keys() and any("optimiser" in name for name in whole)
    for name in whole:
        assert torch.equal(whole[name], resumed[name]), name
    assert logged(one, "toy") == logged(other, "toy")
    assert saved_facts(one, "toy")["feed"] == saved_facts(other, "toy")["feed"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    trainer_in(out).train()
    return out


@pytest.mark.parametrize("at", range(STEPS))
def test_a_run_that_is_stopped_in_any_step_resumes_exactly(at, whole, tmp_path, monkeypatch):
    """Weights, averages, buffers, both optimisers, the feed and the log: to the bit."""
    stop_in_step(monkeypatch, at)
    with pytest.raises(KeyboardInterrupt, match=f"{at + 1} steps of 'toy' are saved"):
        trainer_in(tmp_path).train()
    assert saved_facts(tmp_path, "toy")["step"] == at + 1, "the step under way ended and was saved"
    resumed = trainer_in(tmp_path)
    assert resumed.steps_done == at + 1
    resumed.train()
    assert_same_run(whole, tmp_path)


def test_a_run_that_is_stopped_in_every_step_resumes_exactly(whole, tmp_path, monkeypatch):
    for at in range(STEPS):
        stop_in_step(monkeypatch, at)
        with pytest.raises(KeyboardInterrupt):
            trainer_in(tmp_path).train()
    assert trainer_in(tmp_path).finished
    assert_same_run(whole, tmp_path)


def test_a_step_that_is_cut_short_is_done_again(whole, tmp_path, monkeypatch):
    """A second Ctrl-C, or a kill: what the step did to weights is forgotten."""
    stop_in_step(monkeypatch, 2, with_signal=False)
    first, second = Toy(), Toy()
    with pytest.raises(KeyboardInterrupt):
        trainer_in(tmp_path, objective=first, save_every_s=-1.0).train()
    trainer_in(tmp_path, objective=second).train()
    assert first.begun == [0, 1, 2] and second.begun == [2, 3, 4, 5, 6]
    assert_same_run(whole, tmp_path)


def test_the_log_repeats_no_step_after_a_kill(whole, tmp_path):
    """What a killed run logged after its last save is dropped, and a line that was cut."""
    trainer_in(tmp_path).train()
    path = tmp_path / "log.jsonl"
    lines = path.read_text()
    path.write_text(lines + json.dumps({"stage": "toy", "step": 99, "off": 0.5}) + '\n{"stage": "to')
    assert trainer_in(tmp_path).finished
    assert path.read_text() == lines


def test_a_finished_run_does_no_step_more(whole):
    objective = Toy()
    before = (whole / "resume-toy.safetensors").read_bytes()
    trainer_in(whole, objective=objective).train()
    assert not objective.begun and (whole / "resume-toy.safetensors").read_bytes() == before


def test_facts_are_computed_once(tmp_path):
    trainer_in(tmp_path).train()
    assert trainer_in(tmp_path).compute_once("figures", lambda: {"error": 1}) == {"error": 1}
    assert trainer_in(tmp_path).compute_once("figures", lambda: {"error": 2}) == {"error": 1}


def test_other_settings_and_foreign_files_are_refused(whole, tmp_path):
    with pytest.raises(TrainingError, match=r"other settings \(rate 0.1, not 0.2\); repeat them, or give another"):
        trainer_in(whole, rate=0.2)
    assert trainer_in(whole, hours=1.0, save_every_s=5.0).finished, "hours and saves may change"
    with pytest.raises(TrainingError, match="--seed is 0 or more; got -1"):
        trainer_in(tmp_path, seed=-1)
    (tmp_path / "resume-toy.safetensors").write_bytes(b"not a run at all")
    with pytest.raises(TrainingError, match="resume-toy.safetensors is not a run of this recipe"):
        trainer_in(tmp_path)


def test_a_run_goes_on_with_a_setting_that_is_newer_than_it_at_its_default_alone(whole, tmp_path):
    @dataclass(frozen=True)
    class Newer(Settings):
        way: str = "old"

    out = tmp_path / "run"
    shutil.copytree(whole, out)
    assert Trainer(Run.of(out, Newer(), quiet, free=("hours",)), "toy", Walk(), Toy(), STEPS).finished
    with pytest.raises(TrainingError, match=r"settings \(way None, not new\); give another --out"):
        Trainer(Run.of(out, Newer(way="new"), quiet, free=("hours",)), "toy", Walk(), Toy(), STEPS)


def test_a_run_goes_on_without_a_setting_that_is_gone(tmp_path):
    out = tmp_path / "run"
    Trainer(Run.of(out, Settings(), quiet, free=("hours",), generator="flow"), "toy", Walk(), Toy(), 2).train()
    assert trainer_in(out, steps=2).finished


def test_a_loss_that_is_not_a_number_stops_and_leaves_the_last_good_save(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "half_is_native", lambda device: False)
    broken = Toy(float("nan"))
    with pytest.raises(TrainingError, match="the loss is not a number at step 0"):
        trainer_in(tmp_path, objective=broken).train()
    assert not (tmp_path / "resume-toy.safetensors").exists()
    objective = Toy()
    trainer_in(tmp_path, 3, objective).train()
    good = (tmp_path / "resume-toy.safetensors").read_bytes()
    with pytest.raises(TrainingError, match="the loss is not a number at step 3"):
        trainer_in(tmp_path, STEPS, Toy(float("nan"))).train()
    assert (tmp_path / "resume-toy.safetensors").read_bytes() == good


def test_what_is_not_a_number_in_half_precision_goes_on_in_float32_from_the_last_save(tmp_path, monkeypatch):
    class Halved(Toy):
        def losses(self, batch, now):
            self.scale = 1.0 if now.precise or now.step < 3 else float("nan")
            with now.half():
                pass
            yield from super().losses(batch, now)

    monkeypatch.setattr(train_step, "half_is_native", lambda device: True)
    objective = Halved()
    with pytest.warns(UserWarning, match="in bfloat16 the loss is not a number at step 3: training goes on in float32"):
        trainer_in(tmp_path, 3, objective).train()
        trainer_in(tmp_path, STEPS, objective).train()
    assert objective.begun == [0, 1, 2, 3, 3, 4, 5, 6] and saved_facts(tmp_path, "toy")["float32"]
    assert all(math.isfinite(line["off"]) for line in logged(tmp_path, "toy") if "off" in line)
    assert trainer_in(tmp_path, STEPS).facts["float32"], "it stays so"


@pytest.mark.parametrize("stopped", [False, True])
def test_a_device_that_is_asked_now_and_then_never_saves_what_is_not_a_number(stopped, tmp_path, monkeypatch):
    class Overflows(Toy):
        def losses(self, batch, now):
            with now.half():  # statistics of the batch are broken, too, which no gradient repairs
                yield from super().losses(batch if now.precise or now.step != 3 else batch * float("nan"), now)

    for place in (train_step, module):
        monkeypatch.setattr(place, "half_is_native", lambda device: True)
    monkeypatch.setattr(train_step, "half_precision", lambda device: nullcontext())
    monkeypatch.setattr(Trainer, "_waits", False)
    every_s = 1e9 if stopped else 0.0
    if stopped:
        stop_in_step(monkeypatch, 4)
    ends = pytest.raises(KeyboardInterrupt) if stopped else nullcontext()
    with pytest.warns(UserWarning, match="training goes on in float32 from step"), ends:
        trainer_in(tmp_path, objective=Overflows(), save_every_s=every_s).train()
    saved, facts = load_file(tmp_path / "resume-toy.safetensors"), saved_facts(tmp_path, "toy")
    assert all(part.isfinite().all() for part in saved.values()) and facts["float32"]
    assert facts["step"] == (0 if stopped else STEPS), "from the last save, which was before the first step"


def test_what_is_not_a_number_in_the_last_seconds_is_learned_again(tmp_path, monkeypatch):
    class Overflows(Toy):
        def losses(self, batch, now):
            time.sleep(0.01)
            with now.half():
                yield from super().losses(batch if now.precise else batch * float("nan"), now)

    for place in (train_step, module):
        monkeypatch.setattr(place, "half_is_native", lambda device: True)
    monkeypatch.setattr(train_step, "half_precision", lambda device: nullcontext())
    monkeypatch.setattr(Trainer, "_waits", False)
    trainer = trainer_in(tmp_path, 10**6, objective=Overflows())
    trainer.limit_s = 0.1
    with pytest.warns(UserWarning, match="training goes on in float32 from step 0"):
        trainer.train()
    assert trainer.finished and trainer.facts["step"] > 1 and trainer.facts["float32"]


def test_a_weight_that_is_not_a_number_is_not_saved(tmp_path):
    trainer = trainer_in(tmp_path, 3)
    trainer.train()
    good = (tmp_path / "resume-toy.safetensors").read_bytes()
    torch.nn.init.constant_(next(trainer.objective.modules["head"].parameters()), float("nan"))
    with pytest.raises(TrainingError, match="a weight is not a number at step 3; the last save is good: lower"):
        trainer.save()
    assert (tmp_path / "resume-toy.safetensors").read_bytes() == good


class Fed(Walk):
    """Batches that fit on a device of a few."""

    def __init__(self, size: int, fits: int, error: Exception = torch.OutOfMemoryError("CUDA out of memory")):  # noqa: B008
        super().__init__()
        self.size, self.fits, self.error = size, fits, error

    def batch(self, now):
        if self.size > self.fits:
            raise self.error
        return super().batch(now)


LACKS = [
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB."),
    RuntimeError("CUDA error: out of memory"),
    RuntimeError("CUDA driver error: out of memory"),
    RuntimeError("Triton Error [CUDA]: out of memory"),
    RuntimeError("MPS backend out of memory (MPS allocated: 8 GiB, other allocations: 1 GiB, max allowed: 9 GiB)."),
    RuntimeError("unable to mmap 4096 bytes from file </torch_1>: Cannot allocate memory (12)"),
    RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
    RuntimeError("CUDA error: CUBLAS_STATUS_NOT_INITIALIZED when calling `cublasCreate(handle)`"),
    RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
    RuntimeError("cuDNN error: CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory"),
    MemoryError(),
]


@pytest.mark.parametrize("error", LACKS, ids=lambda error: str(error)[:40])
def test_a_device_out_of_memory_halves_the_batch_says_so_and_goes_on(error, tmp_path):
    def trainer(size: int, fits: int = 2) -> Trainer:
        feed = SizedFeed(lambda size: Fed(size, fits, error), size)
        return Trainer(Run.of(tmp_path, Settings(), quiet), "toy", feed, Toy(), STEPS)

    with pytest.warns(
        UserWarning, match="cpu ran out of memory: the batch is halved to [42], and training goes on"
    ) as said:
        trainer(8).train()
    assert [str(one.message).split("halved to ")[1][0] for one in said] == ["4", "2"]
    resumed = trainer(8)
    assert resumed.finished and resumed.facts["batch"] == 2, "the smaller batch is kept"
    with (
        pytest.warns(UserWarning),
        pytest.raises(TrainingError, match=r"too little memory for a batch of 1 \(.+\); train smaller"),
    ):
        Trainer(
            Run.of(tmp_path / "small", Settings(), quiet), "toy", SizedFeed(lambda size: Fed(size, 0), 2), Toy(), STEPS
        ).train()


def test_a_trial_of_the_pace_halves_the_batch_too(tmp_path):
    feed = SizedFeed(lambda size: Fed(size, 2), 8)
    with pytest.warns(UserWarning, match="halved to [42]"):
        assert Trainer(Run.of(tmp_path, Settings(), quiet), "toy", feed, Toy(), STEPS).time_steps(0.01) > 0


def test_another_error_of_the_device_is_no_lack_of_memory(tmp_path):
    feed = SizedFeed(lambda size: Fed(size, 2, RuntimeError("CUDA error: device-side assert triggered")), 8)
    with pytest.raises(RuntimeError, match="device-side assert"):
        Trainer(Run.of(tmp_path, Settings(), quiet), "toy", feed, Toy(), STEPS).train()


def test_a_feed_that_cannot_shrink_says_what_to_do_where_memory_is_out(tmp_path):
    with pytest.raises(TrainingError, match="cpu has too little memory for this batch; give a smaller --batch, or"):
        Trainer(Run.of(tmp_path, Settings(), quiet), "toy", Fed(4, 2), Toy(), STEPS).train()


def test_a_load_ends_what_was_captured(tmp_path):
    """A CUDA graph would go on with what the optimiser kept before."""
    trainer = trainer_in(tmp_path)
    trainer.train()
    assert set(trainer._updates) == {"body", "head"}
    trainer._load()
    assert not trainer._updates


def test_worlds_are_seeded_by_a_generator_of_the_cpu():
    """One of a GPU would draw the seeds of a batch one by one."""
    given, drawn = torch.device("cpu"), make_rng(5)
    assert TrainStep(0, 0.0, given, np.random.default_rng(0), drawn).seeding is drawn
    far: Any = SimpleNamespace(device=torch.device("cuda"), initial_seed=lambda: 5)
    step = TrainStep(0, 0.0, given, np.random.default_rng(0), far)
    assert step.seeding is step.seeding and step.seeding.device.type == "cpu"
    assert torch.equal(chance.seeds(3, step.seeding), chance.seeds(3, make_rng(5)))


def test_a_run_of_a_gpu_goes_on_without_one(tmp_path):
    """What a run and its feed keep names no device; clips cut on a GPU have no order to go on in."""

    @dataclass(frozen=True)
    class OnDevice(Settings):
        device: str = "auto"

    runs = [Run.of(tmp_path, OnDevice(device=name), quiet, torch.device(name)) for name in ("cuda", "cpu")]
    assert runs[0].recipe == runs[1].recipe
    clips: Any = SimpleNamespace(forever=lambda: iter([{"frame": 1}]))
    feed = ClipStream(clips, lambda batch, now: batch)
    feed.resume(DeviceClips.state(cast(Any, None)))
    assert feed.batch(cast(Any, None)) == {"frame": 1}


def test_progress_says_step_and_rate(tmp_path):
    lines = []
    trainer_in(tmp_path, 40, report=lambda done, total, words="": lines.append((done, total, words))).train()
    assert [(done, total) for done, total, _ in lines] == [(0.5, 1.0), (1.0, 1.0)]
    assert lines[1][2].startswith("toy: step 40, ") and "steps/s, code " in lines[1][2]
    feed = SizedFeed(lambda size: Fed(size, 8), 4)
    run = Run.of(tmp_path / "sized", Settings(), lambda done, total, words="": lines.append((done, total, words)))
    Trainer(run, "toy", feed, Toy(), 20).train()
    assert "steps/s of 4, code " in lines[-1][2], "how many frames that are"
    busy = Trainer(replace(run, out=tmp_path / "busy"), "toy", feed, Toy(), 20)
    busy._busy_percent = lambda: 87  # as on a GPU
    busy.train()
    assert "steps/s of 4, GPU 87% busy, code " in lines[-1][2]


def test_a_stage_without_a_share_ends_with_the_hours(tmp_path, monkeypatch):
    """So that its progress has an end, too."""
    monkeypatch.setattr(module, "LOG_EVERY", 1)
    lines = []
    report = lambda done, total, words="": lines.append(done)  # noqa: E731
    trainer = trainer_in(tmp_path, 10**9, report=report, hours=0.5 / 3600)
    assert trainer.limit_s == pytest.approx(0.5)
    trainer.train()
    assert trainer.finished and lines == sorted(lines) and 0 < lines[0] < 1 == lines[-1]


def test_the_steps_that_there_will_be_are_said_once_as_soon_as_the_pace_is_known(tmp_path, monkeypatch):
    now, said = 0.0, list[int]()

    def passes(seconds: float) -> None:
        nonlocal now
        now += seconds

    class Slow(Toy):
        def losses(self, batch, now):
            passes(4.0)
            yield from super().losses(batch, now)

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now))
    trainer_in(tmp_path / "a", 10**9, Slow(), hours=60 / 3600).train(paced=said.append)
    assert said == [15], "after 32 s of 60"
    trainer_in(tmp_path / "b", 12, Slow(), hours=60 / 3600).train(paced=said.append)
    assert said == [15, 12], "never more than were asked for"
    trainer_in(tmp_path / "c", 10**9, Slow(), strip_every_s=5.0, hours=60 / 3600).train(lambda: passes(2), said.append)
    assert said == [15, 12, 12], "pictures take their time, too"

    class Compiling(Slow):
        def losses(self, batch, now):
            passes(20.0 * (now.step == 0))
            yield from super().losses(batch, now)

    monkeypatch.setattr(module.Trainer, "_waits", False)  # as on a GPU
    trainer_in(tmp_path / "d", 10**9, Compiling(), hours=60 / 3600).train(paced=said.append)
    assert said == [15, 12, 12, 10], "the first step alone is compiled"
    pictures = iter([10.0] + [0.0] * 99)
    trainer_in(tmp_path / "e", 10**9, Compiling(), strip_every_s=5.0, hours=90 / 3600).train(
        lambda: passes(next(pictures)), said.append
    )
    assert said[4:] == [15], "and the first picture alone is slow: 24 s, 10 s, then 4 s a step"


def test_a_stage_takes_at_most_its_share(tmp_path):
    budget = Budget(tmp_path, 2.0)
    budget.divide([Stage("motion", 0.1, lambda: None), Stage("flow", None, lambda: None)])
    assert budget.most_s("motion") == pytest.approx(720) and budget.most_s("flow") == 7200


@pytest.mark.parametrize(("load", "threads"), [(0.5, 2), (99.0, 1)])
def test_a_machine_that_becomes_busy_leaves_training_one_thread(load, threads, tmp_path, monkeypatch):
    before = torch.get_num_threads()
    monkeypatch.setattr(module, "LOOK_S", -1.0)
    monkeypatch.setattr(os, "getloadavg", lambda: (load * (os.cpu_count() or 1), 0.0, 0.0))
    try:
        torch.set_num_threads(2)
        trainer_in(tmp_path, steps=2).train()
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
