"""The curve of success against compute: what is halved, and what is said of it."""

from __future__ import annotations

import pytest

from terrella.act.planning import PlayedEpisode, PlayResult, SearchConfig
from terrella.measure.statistics import wilson
from terrella.workflows.compute_curve import CurvePoint, conclusion, halved

PLAIN = SearchConfig(samples=16).filled()


def test_plans_and_milliseconds_are_halved_and_two_plans_are_the_fewest():
    assert [one.samples for one in halved(PLAIN)] == [2, 4, 8]
    assert [one.samples for one in halved(SearchConfig().filled())] == [4, 8, 16, 32]
    by_the_clock = halved(SearchConfig(budget_ms=40).filled())
    assert [one.budget_ms for one in by_the_clock] == [2.5, 5, 10, 20] and {one.samples for one in by_the_clock} == {64}


@pytest.mark.parametrize(
    "reached, said",
    [
        (
            (0, 5, 20, 20),
            "Thinking longer helps, by 1 [1, 1] (n=20) in success from 2 plans a round to 16 plans a round; ",
        ),
        ((0, 5, 20, 20), "more than 8 plans a round is not seen to help"),
        ((0, 1, 5, 20), "no plateau is seen yet"),
        ((10, 11, 12, 10), "Thinking longer is not seen to help"),
        ((10, 10, 10, 11), "Thinking longer is not seen to help"),
        ((20, 10, 5, 0), "Thinking longer is not seen to help"),
    ],
)
def test_whether_it_helped_is_told_with_its_plateau(reached, said):
    points = [
        CurvePoint(searching, 10.0 * searching.samples, wilson(count, 20), _played(count))
        for searching, count in zip([*halved(PLAIN), PLAIN], reached)
    ]
    assert said in conclusion(points, "success", 0)


def _played(reached: int) -> PlayResult:
    return PlayResult([PlayedEpisode(success=at < reached) for at in range(20)], 0)
