"""Presets: how large a network is by device, memory and minutes, and what is said of it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from functorch.compile import make_boxed_func
from tests.learn.small import FLAT
from tests.learn.stopping import quiet
from torch._dynamo.backends.common import aot_autograd

from terrella.core.errors import TrainingError
from terrella.learn.devices import Compiled, device_named
from terrella.learn.presets import GIB, PRESETS, STEPS, TrainingPlan
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_config import TrainConfig
from terrella.worlds.flow import FlowConfig, FlowNetwork
from terrella.worlds.folder import load_world

CPU, CARD = torch.device("cpu"), torch.device("cuda")


def plan(device=CARD, minutes=None, free_gib=math.inf, name="auto", **settings) -> TrainingPlan:
    return TrainingPlan.of(name, device, minutes, free_gib * GIB, **settings)


def test_the_presets_have_as_many_parameters_as_they_say():
    for preset in PRESETS:
        with torch.device("meta"):
            network = FlowNetwork(FlowConfig((64, 64), 4, 52, channels=preset.channels))
        assert sum(weight.numel() for weight in network.parameters()) / 1e6 == pytest.approx(preset.millions, rel=0.05)


@pytest.mark.parametrize(
    ("device", "minutes", "name"),
    [(CPU, 600, "small"), (CARD, 2, "small"), (CARD, 10, "medium"), (CARD, None, "medium"), (CARD, 90, "large"),
     (CARD, 1000, "huge")],
)  # fmt: skip
def test_the_device_and_the_minutes_choose(device, minutes, name):
    assert plan(device, minutes).preset.name == name


def test_a_day_is_a_day_and_not_the_default():
    day, default = TrainConfig(hours=24.0), TrainConfig()
    assert day.limit_hours == default.limit_hours == 24 and (day.minutes, default.minutes) == (1440, None)
    assert [plan(CARD, config.minutes).preset.name for config in (day, default)] == ["huge", "medium"]


def test_a_card_too_small_has_the_next_smaller_and_says_so():
    made = plan(minutes=90, free_gib=5.5)
    assert made.preset.name == "medium"
    assert made.sentence("cuda (a card, 6 GiB)") == (
        "cuda has 5.5 GiB free, and the preset large takes 7: the next smaller that fits is trained, medium. "
        "cuda (a card, 6 GiB), 90 min: the preset medium, 11M parameters (--preset), batches of 64 (--batch), "
        "compiled (--no-compile), bfloat16 (--no-half)."
    )
    assert plan(free_gib=0.5).preset.name == "small", "the smallest is tried anyhow"


def test_options_refuse_it():
    made = plan(minutes=10, name="huge", batch=16, compiled=False, half=False)
    assert made.sentence("cuda") == "cuda, 10 min: the preset huge, 43M parameters (--preset), batches of 16 (--batch)."
    assert plan(CPU).sentence("cpu", (8, 8, 8)) == "cpu: channels 8 8 8, batches of 8 (--batch)."


def test_a_run_that_was_begun_keeps_its_size():
    assert plan(minutes=600).kept({"preset": "medium"}).preset.name == "medium"
    assert plan(minutes=600).kept({}).preset.name == "small", "before there were presets"
    assert plan(minutes=600).kept(None).preset.name == "huge"


def test_a_world_is_trained_by_its_preset_which_is_said(corridor, tmp_path, monkeypatch):
    lines: list[str] = []
    config = replace(FLAT, channels=(), steps=None, batch=1, uncertainty_frames=0, outcome_steps=1)
    monkeypatch.setitem(STEPS, "cpu", 2)
    facts = train_video(corridor, tmp_path, config, quiet, say=lines.append)
    assert len(lines) == 1 and "the preset small, 2.4M parameters (--preset), batches of 1 (--batch)" in lines[0]
    assert load_world(tmp_path / "world").generator.config.channels == (64, 112, 160)
    with pytest.raises(TrainingError, match="preset auto, not large"):
        train_video(corridor, tmp_path, replace(config, preset="large"), quiet)
    monkeypatch.setitem(STEPS, "cpu", 3)  # as on a device with other defaults: the run keeps its steps
    assert train_video(corridor, tmp_path, config, quiet)["step"] == facts["step"]


def test_a_driver_that_is_too_old_is_said(monkeypatch):
    def old(*given, device):
        raise RuntimeError("The NVIDIA driver on your system is too old (found version 11040).\nUpdate it")

    monkeypatch.setattr(torch, "zeros", old)
    with pytest.raises(TrainingError, match=r"no such device here \(The NVIDIA driver .+ 11040\).\); say cpu, cuda or"):
        device_named("cuda")


def test_gradients_that_do_not_compile_are_computed_as_they_are(monkeypatch):
    """A compiler has them wait for the first backward pass, where nobody would catch it."""

    def broken(graph, inputs):
        raise RuntimeError("no registers left")

    backend = aot_autograd(fw_compiler=lambda graph, inputs: make_boxed_func(graph.forward), bw_compiler=broken)
    whole = torch.compile
    monkeypatch.setattr(torch, "compile", lambda function, **options: whole(function, backend=backend, **options))
    weight = torch.ones(2, requires_grad=True)
    with pytest.warns(UserWarning, match=r"torch.compile fails here \(.*\): training goes on uncompiled"):
        Compiled(lambda x: (weight * x).square())(torch.tensor([1.0, 2.0])).sum().backward()
    assert weight.grad is not None and weight.grad.tolist() == [2.0, 8.0]


def test_a_compiled_network_out_of_memory_is_no_fault_of_the_compiler(monkeypatch):
    def lacking(*given):
        raise RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`")

    monkeypatch.setattr(torch, "compile", lambda function, **options: lacking)
    with pytest.raises(RuntimeError, match="ALLOC_FAILED"):
        Compiled(lambda x: x)(1)


def test_without_a_compiler_it_computes_as_it_is_and_says_so(monkeypatch):
    def broken(function, **options):
        def run(*given):
            raise RuntimeError("no compiler is installed")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    double = Compiled(lambda x: 2 * x)
    with pytest.warns(UserWarning, match=r"torch.compile fails here \(no compiler is installed\): training goes on"):
        assert double(3) == 6
    assert double(4) == 8
