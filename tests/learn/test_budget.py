"""The hours of a run: shared by its stages, counted over all its runs, and what the learning rate falls by."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from terrella.learn.budget import Budget
from terrella.learn.feeds import RandomBatches
from terrella.learn.learners import adamw, warmup_cosine
from terrella.learn.trainer import Loss, Run, Trainer


@pytest.fixture
def clock(monkeypatch):
    """Of which each look takes half a second."""
    now = [0.0]

    def look() -> float:
        now[0] += 0.5
        return now[0]

    for module in ("budget", "trainer"):
        monkeypatch.setattr(f"terrella.learn.{module}.time", SimpleNamespace(monotonic=look))
    return now


class Shares:
    """Learns nothing much, and notes how far the training was at each step."""

    def __init__(self):
        self.seen, self.layer = [], nn.Linear(1, 1)
        self.modules = {"layer": self.layer}
        self.learners = {"layer": adamw((self.layer,), warmup_cosine(1e-3, 1))}

    def losses(self, batch, now):
        self.seen.append(now.share)
        yield Loss("layer", self.layer(torch.ones(1, 1)).sum(), {})


def trained(out: Path, steps: int, hours: float, **shares: float) -> tuple[Trainer, Shares]:
    run = Run(out, {}, lambda *_: None, budget=Budget(out, hours, shares))
    objective = Shares()
    trainer = Trainer(run, "stage", RandomBatches(lambda now: None), objective, steps)
    trainer.train()
    return trainer, objective


def test_the_learning_rate_falls_by_time_where_that_is_over_first(tmp_path, clock):
    trainer, objective = trained(tmp_path, 10**9, 40 / 3600, stage=0.25)
    assert trainer.finished and 10 < trainer.facts["step"] < 25
    assert objective.seen == sorted(objective.seen) and objective.seen[0] == 0 and objective.seen[-1] > 0.9
    (group,) = objective.learners["layer"].optimiser.param_groups
    assert group["lr"] < 5e-5


def test_and_by_steps_where_those_are(tmp_path, clock):
    _, objective = trained(tmp_path, 4, 24.0, stage=0.25)
    assert objective.seen == [0, 0.25, 0.5, 0.75]


def test_what_earlier_runs_took_is_counted(tmp_path, clock):
    trained(tmp_path, 10, 1.0)
    again = Budget(tmp_path, 1.0)
    assert 5 < again.spent_s < 20 and again.left_s == pytest.approx(3600 - again.spent_s, abs=2)
    (tmp_path / "resume-other.safetensors").write_bytes(b"no stage at all")
    assert Budget(tmp_path, 1.0).spent_s > 5
