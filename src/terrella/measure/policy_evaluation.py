"""Policy evaluation in a learned world (the dream) against reality: scores, rank agreement, and a verdict in sentences."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from .agreement import LEAST, Agreement, agreement, halves, spearman
from .statistics import RESAMPLES, Band, Figure, interval_of, mean_interval, wilson

REAL, DREAM, CONTROL, REPLAY = "real", "dream", "control", "replay"
RETURN, SUCCESS = "return", "success"
RANDOM = "random"
PERSISTENCE, UNCERTAINTY = " of the start", "uncertainty"
SAME_RANKING = 0.9  # rank correlation from which two rankings are called the same
P_VALUE = 0.05  # largest share of random rankings that may agree as well
_MAX_POINTS = 1500  # of curves that are correlated

Scores = Mapping[str, Mapping[str, torch.Tensor]]  # arm -> measure -> [N]


@dataclass(frozen=True)
class PolicyEvaluation:
    """Scores of policies, and the agreement of dream and reality."""

    what: str  # the measure that policies are ranked by
    policies: list[str]  # those that are ranked
    rows: dict[str, dict[str, Figure]]  # policy, or random -> figures by name
    dream: Agreement | None = None  # of the dream's scores with the real ones
    control: Agreement | None = None  # of the control's scores with the real ones
    itself: Agreement | None = None  # of half of the real episodes with the other half
    worst: tuple[str, str] | None = None  # the pair with the largest ranking error, the really better first
    curves: dict[str, Band] = field(default_factory=dict)  # channel -> open-loop error by step
    expected: float = math.nan  # rank correlation of the dream's uncertainty with its error


def evaluate_policies(
    scores: Mapping[str, Scores],
    open_loop: Mapping[str, Mapping[str, Sequence[float]]],
    ranked: Sequence[str],
    seed: int,
) -> PolicyEvaluation:
    """Scores and agreement of policies from their episodes; episode n starts alike in all arms and for all policies.

    scores: policy -> arm -> measure -> [N]; RANDOM is the baseline. open_loop: policy -> channel -> error by step, NaN if unknown.
    ranked: the policies to compare; the baseline only if it is one of them.
    """
    rng = torch.Generator().manual_seed(seed)
    what = SUCCESS if SUCCESS in scores[ranked[0]][DREAM] else RETURN
    rows = {name: _figures_of(arms, scores.get(RANDOM), what, seed) for name, arms in scores.items()}
    evaluation = PolicyEvaluation(what, list(ranked), rows)
    arms = {}
    for arm in (REAL, DREAM, CONTROL):
        arms[arm] = [scores[name][arm][what].double() for name in ranked if arm in scores[name]]
    if not arms[REAL]:
        return evaluation
    real, dream, control = (torch.stack(arms[arm]) for arm in (REAL, DREAM, CONTROL))
    scale = 1.0 if what == SUCCESS else None
    curves = {name: open_loop[name] for name in ranked if name in open_loop}
    return dataclasses.replace(
        evaluation,
        dream=agreement(dream, real, rng, scale),
        control=agreement(control, real, rng, scale),
        itself=halves(real, rng),
        worst=_worst_pair(dream.mean(1), real.mean(1), list(ranked)),
        curves=_mean_curves(curves, rng),
        expected=_uncertainty_correlation(curves),
    )


def _figures_of(arms: Scores, floor: Scores | None, what: str, seed: int) -> dict[str, Figure]:
    def interval(values: torch.Tensor) -> Figure:  # the same resamples for all
        return mean_interval(values, torch.Generator().manual_seed(seed))

    row: dict[str, Figure] = {}
    for arm, measures in arms.items():
        for name, values in measures.items():
            values = values.double()
            label = arm if name == what else f"{arm} {name}"
            row[label] = wilson(int(values.sum()), len(values)) if name == SUCCESS else interval(values)
        if floor is not None and arm in floor and arms is not floor and arm in (REAL, DREAM):
            row[f"{arm} over random"] = interval(measures[what].double() - floor[arm][what].double())
    if REAL in arms:
        row["gap"] = interval(arms[DREAM][what].double() - arms[REAL][what].double())
    return row


def _worst_pair(dream: torch.Tensor, real: torch.Tensor, names: list[str]) -> tuple[str, str] | None:
    """The pair that differs most in reality, the better first, of all pairs that the dream ranks the other way round."""
    gap = real[:, None] - real[None, :]
    wrong = torch.where((gap > 0) & (dream[:, None] <= dream[None, :]), gap, 0.0)
    at = int(wrong.argmax())
    return (names[at // len(names)], names[at % len(names)]) if wrong.max() > 0 else None


def _mean_curves(open_loop: Mapping[str, Mapping[str, Sequence[float]]], rng: torch.Generator) -> dict[str, Band]:
    """The mean of each curve over policies, with an interval over policies, as long as half of them go on."""
    bands = {}
    for channel in dict.fromkeys(name for curves in open_loop.values() for name in curves):
        known = [list(curves[channel]) for curves in open_loop.values() if channel in curves]
        some = [torch.tensor(curve, dtype=torch.float64) for curve in known]
        values = torch.nn.utils.rnn.pad_sequence(some, batch_first=True, padding_value=math.nan)
        known = torch.isfinite(values)
        enough = int((known.double().mean(0) >= 0.5).cumprod(0).sum())
        values, known = values[:, :enough].nan_to_num(), known[:, :enough].double()
        count = len(values)
        ones = torch.ones(RESAMPLES, count, dtype=torch.float64)
        weights = torch.zeros_like(ones).scatter_add_(1, torch.randint(count, (RESAMPLES, count), generator=rng), ones)
        drawn = (weights @ values) / (weights @ known)
        low, high = interval_of(drawn)
        nothing = [math.nan] * enough
        centre = (values.sum(0) / known.sum(0)).tolist()
        bands[channel] = Band(centre, *((low.tolist(), high.tolist()) if count > 1 else (nothing, nothing)), count)
    return bands


def _uncertainty_correlation(open_loop: Mapping[str, Mapping[str, Sequence[float]]]) -> float:
    """The rank correlation, over steps and policies, of the dream's uncertainty with its error in the first channel."""
    pairs = []
    for curves in open_loop.values():
        channel = next((name for name in curves if name != UNCERTAINTY and not name.endswith(PERSISTENCE)), "")
        if UNCERTAINTY in curves and channel:
            pairs += list(zip(curves[UNCERTAINTY], curves[channel]))[1:]
    known = torch.tensor([pair for pair in pairs if all(map(math.isfinite, pair))], dtype=torch.float64).reshape(-1, 2)
    known = known[:: max(1, len(known) // _MAX_POINTS)]
    return float(spearman(known[:, 0], known[:, 1])) if len(known) > 2 else math.nan


# -- text -------------------------------------------------------------------------------------------------------------


def with_interval(figure: Figure) -> str:
    """A figure and its interval, to three digits."""
    value, low, high = (_number(each) for each in (figure.value, figure.low, figure.high))
    return f"{value} [{low}, {high}]" if math.isfinite(figure.low) else value


def percent(figure: Figure) -> str:
    return f"{figure.value:.0%} [{figure.low:.0%}, {figure.high:.0%}]"


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    value = 0.0 if abs(value) < 0.005 else value  # no -0.00
    return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:.1f}" if abs(value) >= 9.995 else f"{value:.2f}"


def verdict(evaluation: PolicyEvaluation) -> list[str]:
    """Sentences, the verdict first."""
    say = percent if evaluation.what == SUCCESS else with_interval
    rows, count = evaluation.rows, len(evaluation.policies)
    if evaluation.dream is None:
        most = max(rows[name][DREAM].value for name in evaluation.policies)
        best, *alike = (name for name in evaluation.policies if rows[name][DREAM].value == most)
        floor = f"; acting at random {say(rows[RANDOM][DREAM])}" if RANDOM in rows and best != RANDOM else ""
        hint = "give --real ENV to compare with reality."
        names = f"are {', '.join([best, *alike])} alike" if alike else f"is {best}"
        return [f"In the dream the best of {count} {names}, {evaluation.what} {say(rows[best][DREAM])}{floor}; {hint}"]
    lines = [_ranking(evaluation)]
    if count >= LEAST:
        lines += [_figures("dream", evaluation.dream, evaluation), _control(evaluation)]
        if evaluation.itself is not None and math.isfinite(evaluation.itself.spearman.value):
            bound = _correlations(evaluation.itself)
            lines.append(f"upper bound, real episodes against real episodes from other starts: {bound}")
    return [*lines, *_score_errors(evaluation), *_open_loop_errors(evaluation)]


def _ranking(evaluation: PolicyEvaluation) -> str:
    count, agreed = len(evaluation.policies), evaluation.dream
    assert agreed is not None
    if count < LEAST:
        few = "One policy has no ranking" if count == 1 else f"{count} policies are too few for a ranking"
        return f"{few}: give {LEAST} or more."
    if not math.isfinite(agreed.spearman.value):
        real = {evaluation.rows[name][REAL].value for name in evaluation.policies}
        if len(real) == 1:
            return f"In reality all {count} policies have the same {evaluation.what}: there is nothing to rank."
        return f"The dream cannot rank these {count} policies: all have the same {evaluation.what} in it."
    low, value = agreed.spearman.low, agreed.spearman.value
    figure = f"Spearman {with_interval(agreed.spearman)}"
    if value >= SAME_RANKING and agreed.chance > P_VALUE:
        return (
            f"{count} policies are too few to tell whether the dream ranks them as reality does: {figure}, which a random ranking "
            f"reaches with probability {agreed.chance:.0%}."
        )
    if agreed.spearman.high < 0:
        return f"The dream ranks these {count} policies the wrong way round: {figure}."
    if not low > 0:
        return f"The dream does not reliably rank these {count} policies as reality does: {figure}."
    alike = "as reality does" if value >= SAME_RANKING else "partly as reality does"
    if _control_as_good(evaluation):
        figure += ", but the control with unrelated actions ranks them nearly as well: this proves little"
    return f"The dream ranks these {count} policies {alike}: {figure}."


def _control_as_good(evaluation: PolicyEvaluation) -> bool:
    """Whether the control, a dream given the actions of another episode, ranks the policies nearly as well."""
    dream, control = evaluation.dream, evaluation.control
    return dream is not None and control is not None and control.spearman.value >= SAME_RANKING * dream.spearman.value


def _correlations(agreed: Agreement) -> str:
    return f"Spearman {with_interval(agreed.spearman)}, Pearson {with_interval(agreed.pearson)}"


def _figures(arm: str, agreed: Agreement, evaluation: PolicyEvaluation) -> str:
    unit = "of all episodes" if evaluation.what == SUCCESS else "of the range of the real scores"
    pearson, spearman, mmrv = map(with_interval, (agreed.pearson, agreed.spearman, agreed.mmrv))
    return f"{arm} and reality: Pearson {pearson}, Spearman {spearman}, MMRV {mmrv} {unit}"


def _control(evaluation: PolicyEvaluation) -> str:
    agreed = evaluation.control
    assert agreed is not None
    control = "control (the dream is given the actions of another episode)"
    if not math.isfinite(agreed.spearman.value):
        return f"{control}: all policies have the same {evaluation.what}"
    text = f"{control}: {_correlations(agreed)}"
    return f"{text}: the ranking hardly depends on the right actions" if _control_as_good(evaluation) else text


def _score_errors(evaluation: PolicyEvaluation) -> list[str]:
    """The mean and the largest errors of the dream's scores."""
    rows, say = evaluation.rows, percent if evaluation.what == SUCCESS else with_interval
    gaps = {name: rows[name]["gap"] for name in evaluation.policies}
    lines, mean = [], sum(gap.value for gap in gaps.values()) / len(gaps)
    far = max(gaps, key=lambda name: abs(gaps[name].value))
    bias = "over" if mean > 0 else "under"
    size = f"{abs(mean):.1%}" if evaluation.what == SUCCESS else _number(abs(mean))
    lines.append(
        f"the dream {bias}estimates the {evaluation.what} by {size} on average; its largest error is on {far}: "
        f"{say(rows[far][DREAM])} in the dream, {say(rows[far][REAL])} in reality"
    )
    if evaluation.worst is not None:
        one, other = evaluation.worst
        lines.append(
            f"its largest ranking error: {one} is better than {other} in reality ({say(rows[one][REAL])} to "
            f"{say(rows[other][REAL])}), not in the dream ({say(rows[one][DREAM])} to {say(rows[other][DREAM])})"
        )
    return lines


def _open_loop_errors(evaluation: PolicyEvaluation) -> list[str]:
    lines = []
    for channel, band in evaluation.curves.items():
        if channel == UNCERTAINTY or channel.endswith(PERSISTENCE):
            continue
        held = evaluation.curves.get(channel + PERSISTENCE)
        steps = [step for step in (1, 10, 30, 100, 300) if step < len(band.value)]
        if not steps:
            continue
        grown = ", ".join(f"{band.value[step]:.3f} after {step}" for step in steps)
        baseline = f" (holding the first observation: {held.value[steps[-1]]:.3f})" if held else ""
        lines.append(f"under the real actions, its error in {channel} is {grown} steps{baseline}")
    if math.isfinite(evaluation.expected):
        lines.append(f"the rank correlation of its uncertainty with that error over steps is {evaluation.expected:.2f}")
    return lines


def table(evaluation: PolicyEvaluation) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of a table of the scores of each policy and of random actions, the best first."""
    say = percent if evaluation.what == SUCCESS else with_interval
    first = REAL if evaluation.dream is not None else DREAM
    names = sorted(evaluation.rows, key=lambda name: -evaluation.rows[name][first].value)
    labels = {name: f"{name} (baseline)" if name not in evaluation.policies else name for name in names}
    columns = {name for row in evaluation.rows.values() for name in row}
    heads = [name for name in (REAL, DREAM, "gap", CONTROL) if name in columns]
    more, lines = [head for head in (f"{REAL} {RETURN}", f"{DREAM} {RETURN}") if head in columns], []
    for name in names:
        row = evaluation.rows[name]
        cells = [(with_interval if head == "gap" else say)(row[head]) if head in row else "" for head in heads]
        lines.append([labels[name], *cells, *(with_interval(row[head]) if head in row else "" for head in more)])
    return ["policy", *heads, *more], lines


def as_dict(evaluation: PolicyEvaluation) -> dict[str, Any]:
    """Plain data for JSON, the verdict first."""
    return {"verdict": verdict(evaluation), **dataclasses.asdict(evaluation)}
