"""Runs that are stopped by Ctrl-C within a step and resumed: they leave what an unbroken run leaves."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from terrella.learn.trainer import Trainer


def quiet(done, total, words=""):
    pass


def resumes_exactly(train: Callable[[Path], object], whole: Path, cut: Path, stages: dict[str, int]) -> None:
    """Trains in `cut` with Ctrl-C within the given step of each of the stages, as the unbroken run in `whole` did."""
    for stage, step in stages.items():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Trainer, "_step", _interrupting(Trainer._step, stage, step))
            with pytest.raises(KeyboardInterrupt):
                train(cut)
        facts = saved_facts(cut, stage)
        assert facts["step"] == step + 1, "the step that was under way ended and was saved"
        assert logged(cut, stage) == [], "no log beyond what was done"
    train(cut)
    for stage in stages:
        same_run(whole, cut, stage)


def goes_on_exactly(train: Callable[[Path], object], whole: Path, cut: Path, stages: dict[str, int]) -> None:
    """The same, with the unbroken run trained first."""
    train(whole)
    resumes_exactly(train, whole, cut, stages)


def _interrupting(whole_step, stage: str, at: int):
    def step(self, number):
        if self.stage == stage and number == at:
            signal.raise_signal(signal.SIGINT)
        return whole_step(self, number)

    return step


def saved_facts(run: Path, stage: str) -> dict:
    with safe_open(run / f"resume-{stage}.safetensors", "pt") as file:
        return json.loads(file.metadata()["facts"])


def logged(run: Path, stage: str) -> list[dict]:
    path = run / "log.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [
        {name: value for name, value in line.items() if name != "seconds"} for line in lines if line["stage"] == stage
    ]


def same_run(one: Path, other: Path, stage: str) -> None:
    whole, resumed = (load_file(run / f"resume-{stage}.safetensors") for run in (one, other))
    assert whole.keys() == resumed.keys()
    for name in whole:
        assert torch.allclose(whole[name].double(), resumed[name].double(), rtol=1e-4, atol=1e-5), name
    logs = logged(one, stage), logged(other, stage)
    assert [line["step"] for line in logs[0]] == [line["step"] for line in logs[1]]
    for line, again in zip(*logs):
        assert line.pop("stage") == again.pop("stage") and line == pytest.approx(again, rel=1e-3, abs=1e-5)
