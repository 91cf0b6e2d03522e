"""Drift curves: a perfect world stays usable to the end, a fading one to the step that its error says."""

from __future__ import annotations

import math

import pytest
import torch
from panorama import SHORT, Panorama, card_of, some_clips

from terrella.core import make_rng
from terrella.measure import LONG, PROBES, ExamConfig, page
from terrella.measure.statistics import last_step_above

STEPS = 64
CONFIG = ExamConfig((1, 8), (8,), **{**SHORT, "drop": (1, 8), "batch": 4})
OWN, SHARED = (f"PSNR: steps within twice {whose} first error" for whose in ("its", "copy-last's"))


@pytest.fixture(scope="module")
def card():
    arms = {"perfect": Panorama(), "fading": Panorama("fading"), "blind": Panorama("blind")}
    long = {"recorded": some_clips(6, STEPS), "new": some_clips(5, STEPS, seed=9)}
    return card_of(arms, {"recorded": some_clips(2, 8)}, CONFIG, sets={LONG: long})


def usable(card, what, arm, motion, place="recorded"):
    return next(r.figure for r in card.rows if (r.what, r.arm, r.motion, r.place) == (what, arm, motion, place))


def test_every_arm_has_a_curve_beside_copy_last(card):
    posed = {(arm, motion) for arm in ("perfect", "fading") for motion in ("predicted", "true")}
    curves = [curve for curve in card.curves if (curve.probe, curve.what) == ("drift", "PSNR")]
    for place in ("recorded", "new"):
        found = {(curve.arm, curve.motion) for curve in curves if curve.place == place}
        assert found == posed | {("copy last", ""), ("blind", "predicted")}
    for curve in curves:
        band = curve.band
        assert len(band.value) == STEPS == len(curve.x)
        assert all(low <= value <= high for low, value, high in zip(band.low, band.value, band.high))


def test_the_perfect_world_is_usable_to_the_end_and_the_fading_one_is_not(card):
    shared = usable(card, SHARED, "perfect", "true")
    assert shared.value == shared.low == STEPS
    fading = usable(card, OWN, "fading", "true")
    # contrast falls by exp(-age / 50), so the error grows with (1 - exp(-age / 50)) squared: twice as much at once
    assert fading.value == 1 <= usable(card, SHARED, "fading", "true").value < STEPS
    better = usable(card, "distance: steps better than copy-last", "perfect", "predicted")
    assert better.value == STEPS


def test_copy_last_is_its_own_yardstick(card):
    still = [usable(card, what, "copy last", "").value for what in (OWN, SHARED)]
    assert still[0] == still[1] and 1 <= still[0] < STEPS


def test_the_last_step_above_counts_up_to_the_first_that_is_below():
    values = torch.tensor([[9.0, 8.5, 8.0, 7.9, 9.0]]).expand(6, 5)
    figure = last_step_above(values, values[:, 0] - 1, make_rng(0))
    assert (figure.value, figure.low, figure.high, figure.count) == (3, 3, 3, 6)
    assert last_step_above(values, values[:, 0] + 1, make_rng(0)).value == 0
    assert last_step_above(values, values[:, 0] - 4, make_rng(0)).value == 5
    alone = last_step_above(values[:1], values[:1, 0] - 1, make_rng(0))
    assert alone.value == 3 and math.isnan(alone.low)


def test_the_interval_comes_from_the_clips():
    """Half of the clips fall at once, half never do: the mean crosses somewhere, and which half is drawn matters."""
    steps = torch.arange(1, 33, dtype=torch.float64)
    values = torch.cat([(30 - (steps - 1) * 1.5)[None].repeat(5, 1), torch.full((5, 32), 30.0, dtype=torch.float64)])
    figure = last_step_above(values, values[:, 0] - 3, make_rng(0))
    assert figure.value == 5  # the mean is 30 - 0.75 * (step - 1)
    assert figure.low < 5 < figure.high


def test_the_page_holds_the_curves(card):
    html = page(card, "x", PROBES)
    section = html.partition("<h2>How far can it be used?</h2>")[2].partition("</section>")[0]
    assert section.count("<svg viewBox") >= 2 and section.count('class="mark"') >= 5
    assert "perfect, true motion" in section and "nan" not in section.lower()
