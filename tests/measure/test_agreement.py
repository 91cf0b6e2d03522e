"""Agreement of two judges: against slow twins, a hand-worked example, and the verdict's words."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from terrella.measure.agreement import (
    agreement,
    halves,
    mean_maximum_rank_violation,
    pearson,
    ranks,
    spearman,
)
from terrella.measure.policy_evaluation import as_dict, evaluate_policies, table, verdict
from terrella.measure.policy_evaluation_page import policy_evaluation_page

RNG = torch.Generator()


@pytest.fixture(autouse=True)
def seeded():
    RNG.manual_seed(0)


def slow_violation(dream, real):
    worst = []
    for i in range(len(dream)):
        mine = [0.0]
        for j in range(len(dream)):
            if (dream[i] > dream[j]) != (real[i] > real[j]):
                mine.append(abs(real[i] - real[j]))
        worst.append(max(mine))
    return sum(worst) / len(worst)


def slow_ranks(scores):
    return [sum(b < a for b in scores) + (sum(b == a for b in scores) - 1) / 2 for a in scores]


def test_rank_violation_by_hand():
    """The dream swaps the second and the third, which really differ by 0.5; the first is ranked right."""
    found = mean_maximum_rank_violation(torch.tensor([0.1, 0.5, 0.4]), torch.tensor([0.2, 0.4, 0.9]))
    assert float(found) == pytest.approx((0 + 0.5 + 0.5) / 3)
    assert float(mean_maximum_rank_violation(torch.tensor([1.0, 2, 3]), torch.tensor([10.0, 20, 90]))) == 0


def test_all_measures_against_slow_twins():
    for size in (2, 5, 12):
        dream, real = torch.randint(0, 6, (2, size), generator=RNG).double()
        assert float(mean_maximum_rank_violation(dream, real)) == pytest.approx(
            slow_violation(dream.tolist(), real.tolist())
        )
        assert ranks(dream).tolist() == slow_ranks(dream.tolist())
        if dream.std() and real.std():
            assert float(pearson(dream, real)) == pytest.approx(np.corrcoef(dream, real)[0, 1])
            assert float(spearman(dream, real)) == pytest.approx(
                np.corrcoef(slow_ranks(dream.tolist()), slow_ranks(real.tolist()))[0, 1]
            )
    batch = torch.randn(7, 2, 9, generator=RNG)
    each = [mean_maximum_rank_violation(one[0], one[1]) for one in batch]
    assert torch.allclose(mean_maximum_rank_violation(batch[:, 0], batch[:, 1]), torch.stack(each))


def drawn(agree, policies=10, episodes=60):
    worth = torch.linspace(0, 1, policies)[:, None]
    real = worth + 0.2 * torch.randn(policies, episodes, generator=RNG)
    other = worth if agree else torch.zeros_like(worth)
    return other + 0.2 * torch.randn(policies, episodes, generator=RNG), real


def test_intervals_hold_the_value_and_tell_agreement_from_none():
    alike, unlike = agreement(*drawn(True), RNG), agreement(*drawn(False), RNG)
    for figure in (alike.pearson, alike.spearman, alike.mmrv, unlike.pearson, unlike.mmrv):
        assert figure.low <= figure.value <= figure.high
    assert alike.spearman.low > 0.6 and alike.mmrv.value < 0.05 < unlike.mmrv.value
    assert unlike.spearman.low < 0 < unlike.spearman.high
    assert abs(alike.scale - 1) < 0.2
    assert halves(drawn(True)[1], RNG).spearman.value > 0.8 and halves(torch.zeros(3, 2), RNG) is None


def test_nothing_is_correlated_where_nothing_differs():
    same = agreement(torch.ones(5, 8), drawn(True, 5, 8)[1], RNG)
    assert math.isnan(same.pearson.value) and math.isnan(same.spearman.value) and same.mmrv.value > 0
    two = agreement(*drawn(True, 2), RNG)
    assert math.isnan(two.spearman.value) and math.isnan(two.mmrv.value)


def scores_of(dream, real, control=None, measure="return"):
    control = torch.zeros_like(dream) if control is None else control
    names = [f"p{at}" for at in range(len(dream))]
    scores = {
        name: {"dream": {measure: dream[at]}, "real": {measure: real[at]}, "control": {measure: control[at]}}
        for at, name in enumerate(names)
    }
    return {**scores, "random": scores[names[0]]}, names


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: drawn(True), "ranks these 10 policies as reality does: Spearman"),
        (lambda: drawn(False), "does not reliably rank these 10 policies"),
        (lambda: (-drawn(True)[1], drawn(True)[1]), "the wrong way round"),
        (lambda: (torch.ones(5, 8), drawn(True, 5, 8)[1]), "cannot rank these 5 policies: all have the same"),
        (lambda: (drawn(True, 5, 8)[1], torch.ones(5, 8)), "nothing to rank"),
        (lambda: drawn(True, 3), "too few"),
        (lambda: drawn(True, 2), "2 policies are too few"),
        (lambda: drawn(True, 1), "One policy has no ranking"),
    ],
)
def test_the_verdict_comes_first(make, said):
    scores, names = scores_of(*make())
    found = evaluate_policies(scores, {}, names, 0)
    lines = verdict(found)
    assert said in lines[0] and all("nan" not in line for line in lines)
    assert lines == as_dict(found)["verdict"] and len(table(found)[1]) == len(names) + 1


def test_a_verdict_is_doubted_where_a_control_that_answers_to_nothing_ranks_as_well():
    dream, real = drawn(True)
    for control, doubted in ((dream, True), (drawn(False)[0], False)):
        scores, names = scores_of(dream, real, control)
        assert ("this proves little" in verdict(evaluate_policies(scores, {}, names, 0))[0]) is doubted


def test_successes_have_wilsons_intervals_and_curves_their_page():
    dream, real = ((scores > 0.5).double() for scores in drawn(True, 6, 40))
    scores, names = scores_of(dream, real, measure="success")
    curve = [0.0, 0.1, 0.2, math.nan]
    followed = {name: {"x": curve, "x of the start": curve, "uncertainty": [0.0, 0.3, 0.4, 0.5]} for name in names}
    found = evaluate_policies(scores, followed, names, 0)
    assert found.what == "success" and found.dream.scale == 1
    assert 0 <= found.rows["p0"]["real"].low and "error in x" in " ".join(verdict(found))
    assert len(found.curves["x"].value) == 3 and found.expected == 1
    page = policy_evaluation_page("judged <here>", found, {"in": "a & b"})
    assert "judged &lt;here&gt;" in page and "a &amp; b" in page and page.count("<svg") > 4 and "NaN" not in page
    json.dumps(as_dict(found))


def test_without_reality_the_dream_alone_is_told():
    scores, names = scores_of(*drawn(True))
    alone = {name: {arm: found for arm, found in arms.items() if arm != "real"} for name, arms in scores.items()}
    found = evaluate_policies(alone, {}, names, 0)
    assert found.dream is None and "In the dream the best of 10 is p9" in verdict(found)[0]
    same = evaluate_policies(dict.fromkeys(("one", "two"), alone["p9"]), {}, ["one", "two"], 0)
    assert "In the dream the best of 2 are one, two alike, return" in verdict(same)[0]
    assert "--real" in verdict(found)[0] and "<svg" in policy_evaluation_page("x", found, {})
