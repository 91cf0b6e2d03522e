"""Intervals cover what they should, repeat from their seed, and do not pretend where there is one clip."""

from __future__ import annotations

import math

import pytest
import torch

from terrella.core import make_rng
from terrella.measure.statistics import (
    Figure,
    interval_of,
    mean_band,
    mean_interval,
    median_interval,
    ratio_interval,
    wilson,
)


def test_interval_of_a_normal_sample_is_close_to_the_textbook():
    values = torch.randn(400, generator=make_rng(3), dtype=torch.float64) * 2 + 7
    figure = mean_interval(values, make_rng(0))
    half = 1.96 * float(values.std()) / 20
    assert math.isclose(figure.value, float(values.mean()))
    assert figure.low == pytest.approx(figure.value - half, abs=0.15 * half)
    assert figure.high == pytest.approx(figure.value + half, abs=0.15 * half)


def test_intervals_cover_the_true_mean_about_as_often_as_they_say():
    rng = make_rng(1)
    covered = 0
    for trial in range(200):
        figure = mean_interval(torch.rand(60, generator=rng), make_rng(trial))
        covered += figure.low <= 0.5 <= figure.high
    assert 0.88 <= covered / 200 <= 0.99


def test_same_seed_same_interval_and_bands_are_columns():
    values = torch.randn(30, 4, generator=make_rng(0))
    assert mean_band(values, make_rng(5)) == mean_band(values, make_rng(5))
    assert mean_band(values, make_rng(5)) != mean_band(values, make_rng(6))
    assert mean_band(values, make_rng(5)).low[0] == pytest.approx(mean_interval(values[:, 0], make_rng(5)).low)


def test_ratio_is_of_the_sums_and_exact_where_clips_agree():
    bottom = torch.tensor([1e-3, 4.0, 10.0])
    figure = ratio_interval(bottom * 1.5, bottom, make_rng(0))
    assert (figure.value, figure.low, figure.high) == pytest.approx((1.5, 1.5, 1.5))
    assert ratio_interval(torch.tensor([1.0, 4.0]), torch.tensor([0.1, 9.9]), make_rng(0)).value == pytest.approx(0.5)


def test_median_ignores_one_wild_clip():
    values = torch.tensor([1.0] * 20 + [1e6])
    figure = median_interval(values, make_rng(0))
    assert (figure.value, figure.high) == (1.0, 1.0)


def test_one_clip_has_no_interval():
    for figure in (mean_interval(torch.tensor([3.0]), make_rng(0)), median_interval(torch.tensor([3.0]), make_rng(0))):
        assert figure.value == 3.0 and math.isnan(figure.low) and figure.count == 1


def test_wilsons_interval_is_that_of_the_textbook():
    for successes, count, low, high in ((0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662)):
        figure = wilson(successes, count)
        assert (figure.value, figure.count) == (successes / count, count)
        assert figure.low == pytest.approx(low, abs=1e-4) and figure.high == pytest.approx(high, abs=1e-4)
    assert math.isnan(wilson(0, 0).value)


def test_figures_are_read_without_exponents():
    assert str(Figure(-1074.2, -1410.0, -0.798, 4)) == "-1,074 [-1,410, -0.798] (n=4)"
    assert str(Figure(999.7, 12.345, 1e5, 9)) == "1,000 [12.3, 100,000] (n=9)"


def test_an_interval_of_draws_is_their_quantiles():
    draws = torch.rand(1000, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ends = torch.tensor([0.025, 0.975], dtype=torch.float64)
    assert torch.allclose(torch.stack(interval_of(draws)), draws.quantile(ends, dim=0), rtol=0, atol=1e-12)
    draws[:300, 2] = math.nan
    low, high = interval_of(draws)
    assert torch.equal(torch.stack([low, high])[:, 2], draws[300:, 2].quantile(ends))
