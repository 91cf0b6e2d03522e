"""What came of judging policies in a dream beside reality: figures for each, how far the two agree, and a verdict in sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from .agreement import LEAST, Agreement, agreement, halves, spearman
from .statistics import RESAMPLES, Band, Figure, mean_interval, wilson

REAL, DREAM, CONTROL = "real", "dream", "control"
RETURN, SUCCESS = "return", "success"
RANDOM = "random"
HELD, UNCERTAINTY = " of the start", "uncertainty"
ALIKE = 0.9  # a rank correlation from which two rankings are called the same
UNLIKELY = 0.05  # how often chance may rank as well
_POINTS = 1500  # of curves that are correlated

Scores = Mapping[str, Mapping[str, torch.Tensor]]  # arm -> measure -> [N]


@dataclass(frozen=True)
class PolicyEvaluation:
    """what: the measure that policies are ranked by. policies: those that are ranked; rows: of each, and of acting at random, its
    figures by name. dream, control, itself: how reality's scores agree with the dream's, with the control's, and with its own
    from other starts. worst: two policies between which the dream errs most. curves: channel -> its error by step."""

    what: str
    policies: list[str]
    rows: dict[str, dict[str, Figure]]
    dream: Agreement | None = None
    control: Agreement | None = None
    itself: Agreement | None = None
    worst: tuple[str, str] | None = None
    curves: dict[str, Band] = field(default_factory=dict)
    expected: float = math.nan  # the rank correlation of the dream's uncertainty with its error


def evaluate_policies(
    scores: Mapping[str, Scores],
    followed: Mapping[str, Mapping[str, Sequence[float]]],
    ranked: Sequence[str],
    seed: int,
) -> PolicyEvaluation:
    """Figures of policies from their episodes, n of all arms and policies having begun alike.

    scores: policy -> arm -> measure -> [N]; RANDOM is the floor. followed: policy -> channel -> error by step, NaN where unknown.
    ranked: the policies that are compared; the floor only if it is one of them.
    """
    rng = torch.Generator().manual_seed(seed)
    what = SUCCESS if SUCCESS in scores[ranked[0]][DREAM] else RETURN
    rows = {name: _row(arms, scores.get(RANDOM), what, seed) for name, arms in scores.items()}
    found = PolicyEvaluation(what, list(ranked), rows)
    arms = {
        arm: [scores[name][arm][what].double() for name in ranked if arm in scores[name]]
        for arm in (REAL, DREAM, CONTROL)
    }
    if not arms[REAL]:
        return found
    real, dream, control = (torch.stack(arms[arm]) for arm in (REAL, DREAM, CONTROL))
    scale = 1.0 if what == SUCCESS else None
    curves = {name: followed[name] for name in ranked if name in followed}
    return dataclasses.replace(
        found,
        dream=agreement(dream, real, rng, scale),
        control=agreement(control, real, rng, scale),
        itself=halves(real, rng),
        worst=_worst(dream.mean(1), real.mean(1), list(ranked)),
        curves=_curves(curves, rng),
        expected=_expected(curves),
    )


def _row(arms: Scores, floor: Scores | None, what: str, seed: int) -> dict[str, Figure]:
    def interval(values: torch.Tensor) -> Figure:  # the same episodes are drawn for all
        return mean_interval(values, torch.Generator().manual_seed(seed))

    row: dict[str, Figure] = {}
    for arm, measures in arms.items():
        for name, values in measures.items():
            values = values.double()
            label = arm if name == what else f"{arm} {name}"
            known = wilson(int(values.sum()), len(values)) if name == SUCCESS else interval(values)
            row[label] = known
        if floor is not None and arm in floor and arms is not floor and arm != CONTROL:
            apart = measures[what].double() - floor[arm][what].double()
            row[f"{arm} over random"] = interval(apart)
    if REAL in arms:
        row["gap"] = interval(arms[DREAM][what].double() - arms[REAL][what].double())
    return row


def _worst(dream: torch.Tensor, real: torch.Tensor, names: list[str]) -> tuple[str, str] | None:
    """The two that differ most in reality, the better first, of those that the dream ranks the other way round."""
    apart = real[:, None] - real[None, :]
    wrong = torch.where((apart > 0) & (dream[:, None] <= dream[None, :]), apart, 0.0)
    at = int(wrong.argmax())
    return (names[at // len(names)], names[at % len(names)]) if wrong.max() > 0 else None


def _curves(followed: Mapping[str, Mapping[str, Sequence[float]]], rng: torch.Generator) -> dict[str, Band]:
    """The mean over policies of each curve, with an interval over policies; up to where half of them are still there."""
    found = {}
    for channel in dict.fromkeys(name for curves in followed.values() for name in curves):
        some = [
            torch.tensor(list(curves[channel]), dtype=torch.float64)
            for curves in followed.values()
            if channel in curves
        ]
        values = torch.nn.utils.rnn.pad_sequence(some, batch_first=True, padding_value=math.nan)
        known = torch.isfinite(values)
        enough = int((known.double().mean(0) >= 0.5).cumprod(0).sum())
        values, known = values[:, :enough].nan_to_num(), known[:, :enough].double()
        count = len(values)
        ones = torch.ones(RESAMPLES, count, dtype=torch.float64)
        weights = torch.zeros_like(ones).scatter_add_(1, torch.randint(count, (RESAMPLES, count), generator=rng), ones)
        drawn = (weights @ values) / (weights @ known)
        low, high = drawn.nanquantile(torch.tensor([0.025, 0.975], dtype=torch.float64), dim=0)
        nothing = [math.nan] * enough
        centre = (values.sum(0) / known.sum(0)).tolist()
        found[channel] = Band(centre, *((low.tolist(), high.tolist()) if count > 1 else (nothing, nothing)), count)
    return found


def _expected(followed: Mapping[str, Mapping[str, Sequence[float]]]) -> float:
    """The rank correlation, over steps and policies, of the dream's uncertainty with its error in the first channel."""
    pairs = []
    for curves in followed.values():
        channel = next((name for name in curves if name != UNCERTAINTY and not name.endswith(HELD)), "")
        if UNCERTAINTY in curves and channel:
            pairs += list(zip(curves[UNCERTAINTY], curves[channel]))[1:]
    known = torch.tensor([pair for pair in pairs if all(map(math.isfinite, pair))], dtype=torch.float64).reshape(-1, 2)
    known = known[:: max(1, len(known) // _POINTS)]
    return float(spearman(known[:, 0], known[:, 1])) if len(known) > 2 else math.nan


# -- in words ---------------------------------------------------------------------------------------------------------


def with_interval(figure: Figure) -> str:
    """A figure and its interval, three digits as people write them."""
    words = [_number(value) for value in (figure.value, figure.low, figure.high)]
    return f"{words[0]} [{words[1]}, {words[2]}]" if math.isfinite(figure.low) else words[0]


def percent(figure: Figure) -> str:
    return f"{figure.value:.0%} [{figure.low:.0%}, {figure.high:.0%}]"


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    value = 0.0 if abs(value) < 0.005 else value  # no -0.00
    return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:.1f}" if abs(value) >= 9.995 else f"{value:.2f}"


def verdict(judged: PolicyEvaluation) -> list[str]:
    """Sentences, the answer first."""
    say = percent if judged.what == SUCCESS else with_interval
    rows, count = judged.rows, len(judged.policies)
    if judged.dream is None:
        best = max(judged.policies, key=lambda name: rows[name][DREAM].value)
        floor = f"; acting at random {say(rows[RANDOM][DREAM])}" if RANDOM in rows and best != RANDOM else ""
        held = "nothing says yet whether that holds in reality: --real ENV would."
        return [f"In the dream the best of {count} is {best}, {judged.what} {say(rows[best][DREAM])}{floor}; {held}"]
    lines = [_ranking(judged)]
    if count >= LEAST:
        lines.append(_figures("dream", judged.dream, judged))
        lines.append(_control(judged))
        if judged.itself is not None and math.isfinite(judged.itself.spearman.value):
            other = (
                f"with half as many episodes, from other starts, reality agrees with itself by {_ranked(judged.itself)}"
            )
            lines.append(f"what can be hoped for: {other}")
    return [*lines, *_wrong(judged), *_errors(judged)]


def _ranking(judged: PolicyEvaluation) -> str:
    count, said = len(judged.policies), judged.dream
    assert said is not None
    if count < LEAST:
        words = "One policy has no rank" if count == 1 else f"{count} policies are too few to speak of their ranking"
        return f"{words}: give {LEAST} or more."
    if not math.isfinite(said.spearman.value):
        real = {judged.rows[name][REAL].value for name in judged.policies}
        if len(real) == 1:
            return f"Reality itself gives all {count} policies the same {judged.what}: there is nothing to rank."
        return f"The dream cannot tell these {count} policies apart: it gives all the same {judged.what}."
    low, value = said.spearman.low, said.spearman.value
    figure = f"Spearman {with_interval(said.spearman)}"
    if value >= ALIKE and said.chance > UNLIKELY:
        return (
            f"These {count} policies are too few to say whether the dream ranks them as reality does: {figure}, which chance gives "
            f"{said.chance:.0%} of the time."
        )
    if said.spearman.high < 0:
        return f"The dream ranks these {count} policies the wrong way round: {figure}."
    if not low > 0:
        return f"The dream cannot be seen to tell these {count} policies apart as reality does: {figure}."
    alike = "as reality does" if value >= ALIKE else "somewhat as reality does"
    if _no_better(judged):
        figure += ", but a control whose actions answer to nothing does so nearly as well: this proves little"
    return f"The dream ranks these {count} policies {alike}: {figure}."


def _no_better(judged: PolicyEvaluation) -> bool:
    """Whether a dream that hears the actions of another episode ranks the policies nearly as well."""
    dream, control = judged.dream, judged.control
    return dream is not None and control is not None and control.spearman.value >= ALIKE * dream.spearman.value


def _ranked(agreed: Agreement) -> str:
    return f"Spearman {with_interval(agreed.spearman)}, Pearson {with_interval(agreed.pearson)}"


def _figures(arm: str, agreed: Agreement, judged: PolicyEvaluation) -> str:
    unit = "of all episodes" if judged.what == SUCCESS else "of what the policies differ by"
    mmrv = f"MMRV {with_interval(agreed.mmrv)} {unit}"
    return (
        f"{arm} and reality: Pearson {with_interval(agreed.pearson)}, Spearman {with_interval(agreed.spearman)}, {mmrv}"
    )


def _control(judged: PolicyEvaluation) -> str:
    agreed = judged.control
    assert agreed is not None
    if not math.isfinite(agreed.spearman.value):
        return f"control (the dream hears the actions of another episode): gives all policies the same {judged.what}"
    words = f"control (the dream hears the actions of another episode): {_ranked(agreed)}"
    if _no_better(judged):
        return f"{words}: these policies are ranked nearly as well without their actions answering to anything"
    return words


def _wrong(judged: PolicyEvaluation) -> list[str]:
    """Where dream and reality are apart."""
    rows, say = judged.rows, percent if judged.what == SUCCESS else with_interval
    gaps = {name: rows[name]["gap"] for name in judged.policies}
    lines, mean = [], sum(gap.value for gap in gaps.values()) / len(gaps)
    far = max(gaps, key=lambda name: abs(gaps[name].value))
    more = "more" if mean > 0 else "less"
    size = f"{abs(mean):.1%}" if judged.what == SUCCESS else _number(abs(mean))
    lines.append(
        f"the dream promises {size} {more} than reality gives, in the mean; it is most wrong of {far}: "
        f"{say(rows[far][DREAM])} dreamt, {say(rows[far][REAL])} real"
    )
    if judged.worst is not None:
        one, other = judged.worst
        lines.append(
            f"its worst error of rank: {one} is really better than {other} ({say(rows[one][REAL])} to {say(rows[other][REAL])}), "
            f"and is dreamt {say(rows[one][DREAM])} to {say(rows[other][DREAM])}"
        )
    return lines


def _errors(judged: PolicyEvaluation) -> list[str]:
    lines = []
    for channel, band in judged.curves.items():
        if channel == UNCERTAINTY or channel.endswith(HELD):
            continue
        held = judged.curves.get(channel + HELD)
        steps = [step for step in (1, 10, 30, 100, 300) if step < len(band.value)]
        if not steps:
            continue
        grown = ", ".join(f"{band.value[step]:.3f} after {step}" for step in steps)
        beside = f" (what stands still: {held.value[steps[-1]]:.3f})" if held else ""
        lines.append(f"given the real actions, its error in {channel} is {grown} steps{beside}")
    if math.isfinite(judged.expected):
        lines.append(f"its uncertainty goes with that error by a rank correlation of {judged.expected:.2f} over steps")
    return lines


def table(judged: PolicyEvaluation) -> tuple[list[str], list[list[str]]]:
    """Heads and lines, the best first: of each policy its scores, and of acting at random."""
    say = percent if judged.what == SUCCESS else with_interval
    first = REAL if judged.dream is not None else DREAM
    heads = [name for name in (REAL, DREAM, "gap", CONTROL) if any(name in row for row in judged.rows.values())]
    names = sorted(judged.rows, key=lambda name: -judged.rows[name][first].value)
    floor = {name: f"{name} (floor)" if name not in judged.policies else name for name in names}
    more = [
        head for head in (f"{REAL} {RETURN}", f"{DREAM} {RETURN}") if any(head in row for row in judged.rows.values())
    ]
    lines = []
    for name in names:
        row = judged.rows[name]
        cells = [(with_interval if head == "gap" else say)(row[head]) if head in row else "" for head in heads]
        lines.append([floor[name], *cells, *(with_interval(row[head]) if head in row else "" for head in more)])
    return ["policy", *heads, *more], lines


def as_dict(judged: PolicyEvaluation) -> dict[str, Any]:
    """Plain data for JSON, the verdict first."""
    plain = dataclasses.asdict(judged)
    return {"verdict": verdict(judged), **plain}
