"""Figures of transfer: exact intervals, the gap that is recovered, a page."""

from __future__ import annotations

import pytest
import torch

from terrella.measure.statistics import clopper_pearson
from terrella.measure.transfer_page import transfer_page
from terrella.measure.transfer_scores import best_arm, camera_table, compare_transfer_arms, verdict


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [(0, 10, 0.0, 0.3085), (5, 10, 0.1871, 0.8129), (10, 10, 0.6915, 1.0), (98, 100, 0.9296, 0.9976)],
)
def test_intervals_are_clopper_and_pearsons(successes, count, low, high):
    figure = clopper_pearson(successes, count)
    assert (figure.low, figure.high) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_the_gap_that_is_recovered():
    def seeds(*counts):
        return {seed: torch.tensor([1] * count + [0] * (10 - count)) for seed, count in enumerate(counts)}

    real = {"nominal": seeds(1, 1), "model 10": seeds(7, 8), "oracle": seeds(9, 9), "random": seeds(0, 0)}
    inside = {"the model": {arm: real[arm] for arm in ("nominal", "model 10", "random")}}
    found = compare_transfer_arms(real, {"nominal": {0.0: torch.ones(4), 1.0: torch.zeros(4)}}, inside, {}, {})
    assert found.recovered["model 10"] == pytest.approx(0.65 / 0.8) and best_arm(found) == "model 10"
    assert found.spread["model 10"] == (pytest.approx(0.7), pytest.approx(0.8))
    assert found.agreed["the model"].mmrv.value == 0 and found.agreed["the model"].pearson.count == 6
    lines = verdict(found)
    assert "10%" in lines[0] and "model 10" in lines[0] and "81%" in " ".join(lines)
    page = transfer_page("a <pair>", found, {"hash": "abc"})
    assert "a &lt;pair&gt;" in page and page.count("<svg") >= 3 and "abc" in page


def test_arms_with_a_camera():
    one = {0: torch.tensor([1, 0, 0, 0])}
    camera = {"nominal": one, "model 10, oracle encoder": {0: torch.ones(4)}, "visual": {0: torch.tensor([1, 1, 0, 0])}}
    found = compare_transfer_arms({"nominal": one}, {}, {}, camera, {"model 10, oracle encoder": [0.01, 0.02]})
    assert "visual, in 50%" in verdict(found)[-1]
    assert camera_table(found)[1][1][2] == "0.010 to 0.020" and "visual" in transfer_page("a", found, {})
