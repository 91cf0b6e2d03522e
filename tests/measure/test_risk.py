"""Risk against coverage, on errors whose answer is known."""

from __future__ import annotations

import pytest
import torch
from gymnasium import spaces
from panorama import Panorama, card_of, some_clips

from terrella.core import make_rng
from terrella.measure.risk import risk_coverage_report


def errors(clips: int = 6, steps: int = 50) -> torch.Tensor:
    return torch.rand(clips, steps, generator=make_rng(0)) * torch.linspace(0.01, 0.2, clips)[:, None]


def figures(wrong, uncertainty):
    found = risk_coverage_report("new", "memory", "predicted", wrong, uncertainty, make_rng(1))
    return {row.what: row for row in found.rows}, found.curves


def test_an_oracle_and_chance_are_told_apart():
    wrong = errors()
    sure, curves = figures(wrong, wrong)
    assert sure["AURC"].figure.value == pytest.approx(sure["AURC"].baselines["by an oracle"].value)
    assert sure["order quality"].figure.value == pytest.approx(100)
    assert sure["calibration error"].figure.value == pytest.approx(0, abs=1e-6)
    assert curves[0].band.value == curves[1].band.value
    blind, _ = figures(wrong, torch.rand(wrong.shape, generator=make_rng(2)))
    assert blind["AURC"].figure.value == pytest.approx(blind["AURC"].baselines["by chance"].value, rel=0.12)
    assert abs(blind["order quality"].figure.value) < 20
    assert blind["AURC"].baselines["by chance"].value == pytest.approx(100 * float(wrong.mean()), rel=1e-5)
    contrary, _ = figures(wrong, -wrong)
    assert contrary["AURC"].figure.value > contrary["AURC"].baselines["by chance"].value
    assert contrary["order quality"].figure.value < 0


def test_the_area_is_that_of_the_curve():
    wrong = torch.tensor([[0.1, 0.4], [0.2, 0.3]])
    found, curves = figures(wrong, torch.tensor([[1.0, 2.0], [4.0, 3.0]]))
    running = [0.1, 0.25, 0.8 / 3, 0.25]  # in the order 0.1, 0.4, 0.3, 0.2
    assert found["AURC"].figure.value == pytest.approx(100 * sum(running) / 4)
    assert curves[0].x[-1] == 100 and curves[0].band.value[-1] == pytest.approx(25)


def test_what_was_expected_is_held_against_what_came():
    wrong = errors()
    timid, _ = figures(wrong, wrong + 0.03)
    found = timid["error expected"].baselines["error found"].value
    assert timid["error expected"].figure.value == pytest.approx(found + 3, rel=1e-4)
    assert timid["calibration error"].figure.value == pytest.approx(3, rel=1e-4)


def test_intervals_are_over_clips_and_one_clip_has_none():
    wrong = errors()
    found = figures(wrong, wrong)[0]["AURC"].baselines["by chance"]
    assert found.low < found.value < found.high and found.count == 6
    alone = figures(wrong[:1], wrong[:1])[0]["AURC"].figure
    assert alone.low != alone.low, "not a number"


def test_places_together_are_asked_as_well():
    class Doubting(Panorama):
        """Says that it errs by how old its frame is."""

        @property
        def spec(self):
            whole = super().spec
            whole.channels["uncertainty"] = spaces.Box(0, 1, (), "float32")
            return whole

        def render(self, state, channels):
            seen = super().render(state, [name for name in channels if name != "uncertainty"])
            return {**seen, "uncertainty": state["age"] / 1000}

    card = card_of({"a": Doubting("fading")}, {"recorded": some_clips(4), "new": some_clips(4, seed=9)})
    rows = {row.place: row.figure for row in card.rows if row.what == "order quality" and row.motion == "predicted"}
    assert set(rows) == {"recorded", "new", "all"} and rows["all"].value > 50, "older is worse"
