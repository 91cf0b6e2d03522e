"""Risk against coverage, on errors whose answer is known."""

from __future__ import annotations

import pytest
import torch

from terrella.core import make_rng
from terrella.measure.risk import pooled, risk


def errors(clips: int = 6, steps: int = 50) -> torch.Tensor:
    return torch.rand(clips, steps, generator=make_rng(0)) * torch.linspace(0.01, 0.2, clips)[:, None]


def test_an_oracle_and_chance_are_told_apart():
    wrong = errors()
    sure = risk("new", "memory", "predicted", wrong, wrong, make_rng(1))
    assert sure.aurc.value == pytest.approx(sure.oracle.value) and sure.closed.value == pytest.approx(1)
    assert sure.off.value == pytest.approx(0, abs=1e-9) and sure.risk == sure.best
    blind = risk("new", "memory", "predicted", wrong, torch.rand(wrong.shape, generator=make_rng(2)), make_rng(1))
    assert blind.aurc.value == pytest.approx(blind.random.value, rel=0.12) and abs(blind.closed.value) < 0.2
    assert blind.random.value == pytest.approx(float(wrong.mean()), rel=1e-5)
    contrary = risk("new", "memory", "predicted", wrong, -wrong, make_rng(1))
    assert contrary.aurc.value > contrary.random.value and contrary.closed.value < 0


def test_the_area_is_that_of_the_curve():
    wrong = torch.tensor([[0.1, 0.4], [0.2, 0.3]])
    found = risk("new", "a", "predicted", wrong, torch.tensor([[1.0, 2.0], [4.0, 3.0]]), make_rng(0))
    running = [0.1, 0.25, 0.8 / 3, 0.25]  # in the order 0.1, 0.4, 0.3, 0.2
    assert found.aurc.value == pytest.approx(sum(running) / 4)
    assert found.coverage[-1] == 1 and found.risk[-1] == pytest.approx(0.25)


def test_what_was_expected_is_held_against_what_came():
    wrong = errors()
    timid = risk("new", "memory", "predicted", wrong, wrong + 0.03, make_rng(1))
    assert timid.expected.value == pytest.approx(timid.random.value + 0.03, rel=1e-4)
    assert timid.off.value == pytest.approx(0.03, rel=1e-4)
    assert all(meant == pytest.approx(found + 0.03, rel=1e-4) for meant, found in timid.reliability)


def test_intervals_are_over_clips_and_one_clip_has_none():
    wrong = errors()
    found = risk("new", "memory", "predicted", wrong, wrong, make_rng(1))
    assert found.random.low < found.random.value < found.random.high and found.random.count == 6
    alone = risk("new", "memory", "predicted", wrong[:1], wrong[:1], make_rng(1))
    assert alone.aurc.low != alone.aurc.low, "not a number"


def test_places_together_are_easier_to_tell_apart_than_each_alone():
    known, new = errors() * 0.1, errors() + 0.2
    said = [(known, torch.full_like(known, 0.01)), (new, torch.full_like(new, 0.3))]
    together = pooled(said, "memory", "predicted", make_rng(0))
    assert together.place == "all" and together.closed.value > 0.8
