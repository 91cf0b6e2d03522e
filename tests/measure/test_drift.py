"""Drift curves: a perfect world stays usable to the end, a fading one to the step that its error says."""

from __future__ import annotations

import math

import pytest
import torch
from panorama import Panorama, some_clips

from terrella.core import make_rng
from terrella.core.errors import DatasetError
from terrella.measure import ExamConfig, ScoreConfig, as_dict, drift, examine, page
from terrella.measure.drift import COPY_LAST
from terrella.measure.statistics import last_step_above

STEPS = 64


@pytest.fixture(scope="module")
def found():
    arms = {"perfect": Panorama(), "fading": Panorama("fading"), "blind": Panorama("blind")}
    clips = {"recorded": some_clips(6, STEPS), "new": some_clips(5, STEPS, seed=9)}
    return {(row.place, row.arm, row.motion): row for row in drift(arms, clips, make_rng(0), STEPS, batch=4)}


def test_every_arm_has_a_curve_beside_copy_last(found):
    posed = {(arm, motion) for arm in ("perfect", "fading") for motion in ("predicted", "true")}
    for place in ("recorded", "new"):
        assert {key[1:] for key in found if key[0] == place} == posed | {(COPY_LAST, ""), ("blind", "predicted")}
    for row in found.values():
        assert len(row.psnr.value) == len(row.sharpness.value) == STEPS == row.steps
        assert row.seconds == pytest.approx(STEPS / 35)
        assert all(low <= value <= high for low, value, high in zip(row.psnr.low, row.psnr.value, row.psnr.high))


def test_the_perfect_world_is_usable_to_the_end_and_the_fading_one_is_not(found):
    perfect, fading = (found["recorded", arm, "true"] for arm in ("perfect", "fading"))
    assert perfect.usable_shared.value == perfect.usable_shared.low == STEPS
    assert fading.usable.value <= fading.usable_shared.value < STEPS
    assert fading.sharpness.value[0] > 0.9 and fading.sharpness.value[-1] < 0.2
    # contrast falls by exp(-age / 50), so the error grows with (1 - exp(-age / 50)) squared: twice as much at once
    assert fading.usable.value == 1


def test_copy_last_is_its_own_yardstick(found):
    still = found["recorded", COPY_LAST, ""]
    assert still.usable.value == still.usable_shared.value
    assert 1 <= still.usable.value < STEPS


def test_the_same_seed_gives_the_same_curves():
    clips = {"recorded": some_clips(4, 8)}
    first, second = (drift({"fading": Panorama("fading")}, clips, make_rng(3), 8) for _ in range(2))
    assert first == second


def test_clips_that_are_too_short_are_refused():
    with pytest.raises(DatasetError, match="8 steps to dream, the largest horizon is 9"):
        drift({"perfect": Panorama()}, {"recorded": some_clips(2, 8)}, make_rng(0), 9)


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


def test_the_scorecard_and_its_page_hold_the_curves():
    arms = {"memory": Panorama(), "no <memory>": Panorama("fading")}
    short, long = some_clips(3, 8), some_clips(3, 40, seed=2)
    config = ExamConfig(ScoreConfig((1, 8), (8,), (8,), drop=(1, 8), strips=1), closure_deg=(), long_steps=0)
    shares: list[float] = []
    card = examine(
        arms, {"recorded": short}, make_rng(0), config, None, lambda s, _: shares.append(s), {"recorded": long}
    )
    assert shares == sorted(shares) and shares[-1] == 1
    assert {row["steps"] for row in as_dict(card)["drifts"]} == {40}
    html = page(card, [], "x")
    section = html.partition("<h2>Drift</h2>")[2].partition("</section>")[0]
    assert section.count("<svg") == 2 and section.count('class="mark"') == 5
    assert "no &lt;memory&gt;, true motion" in section and "all 40 steps" in section and "nan" not in section.lower()
    without = examine(arms, {"recorded": short}, make_rng(0), config)
    assert not without.drifts and "<h2>Drift</h2>" not in page(without, [], "x")
    assert without.fidelity == card.fidelity
