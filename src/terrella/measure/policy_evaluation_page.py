"""The page of `terrella evaluate`: the verdict, dream against reality, each policy, and the growth of the dream's error."""

from collections.abc import Mapping
from html import escape

from . import policy_evaluation as scores
from .page_parts import COLOURS, QUIET, document, legend, section, table_of, words_and_interval
from .plot import Line, line_chart, y_span
from .plot_points import ScatterPoint, dot_plot, scatter
from .policy_evaluation import CONTROL, DREAM, PERSISTENCE, RANDOM, REAL, SUCCESS, UNCERTAINTY, PolicyEvaluation
from .statistics import Band

_REAL, _DREAM = COLOURS[1], COLOURS[0]


def policy_evaluation_page(title: str, evaluation: PolicyEvaluation, facts: Mapping[str, object]) -> str:
    """A self-contained HTML page."""
    lines = [line[:1].upper() + line[1:] for line in scores.verdict(evaluation)]
    heads, cells = scores.table(evaluation)
    figures = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    known = {name.replace("_", " "): value for name, value in facts.items() if value is not None}
    settings = "".join(f"<li>{escape(name)}: {escape(str(value))}</li>" for name, value in known.items())
    words = "".join(f"<li>{escape(line)}</li>" for line in lines[1:])
    parts = [
        f"<section><h2>{escape(lines[0])}</h2><ul>{words}</ul></section>",
        section("Dream against reality", _lead(evaluation), _scatter(evaluation)),
        section(
            f"The {evaluation.what} of each policy",
            "With 95% intervals; the best first.",
            _dot_plot(evaluation) + figures,
        ),
        section(
            "Where the dream is wrong",
            "The dream starts from the first observation of real episodes and is given their actions alone: its distance to them, "
            "in shares of each channel's range if it has one. Mean over policies, with its interval.",
            _errors(evaluation),
        ),
        section("How this was measured", "", _method(evaluation) + f"<h3>Settings</h3><ul>{settings}</ul>"),
    ]
    return document(title, parts)


def _lead(evaluation: PolicyEvaluation) -> str:
    return (
        f"Each point is a policy: its {evaluation.what} in reality and in the dream, with 95% intervals. On the dotted line both "
        "are equal; the ranking is right if the points rise."
    )


def _scatter(evaluation: PolicyEvaluation) -> str:
    if evaluation.dream is None:
        return ""
    boxes = ""
    for arm, title in ((DREAM, "The dream"), (CONTROL, "The control: the dream is given other actions")):
        rows, colour = {name: evaluation.rows[name] for name in evaluation.policies}, _DREAM if arm == DREAM else QUIET
        points = [ScatterPoint(name, row[REAL], row[arm], colour) for name, row in rows.items()]
        svg = scatter(points, f"{evaluation.what} in reality", f"{evaluation.what} in the dream")
        boxes += f"<figure><h3>{escape(title)}</h3>{svg}</figure>"
    return f"<div class=charts>{boxes}</div>"


def _dot_plot(evaluation: PolicyEvaluation) -> str:
    real = evaluation.dream is not None
    names = sorted(evaluation.policies, key=lambda name: -evaluation.rows[name][REAL if real else DREAM].value)
    shown = {REAL: _REAL, DREAM: _DREAM} if real else {DREAM: _DREAM}
    rows = [(name, [(evaluation.rows[name][arm], colour) for arm, colour in shown.items()]) for name in names]
    floor = evaluation.rows.get(RANDOM)
    guides = [(floor[REAL if real else DREAM].value, QUIET)] if floor else []
    names_of = {REAL: "in reality", DREAM: "in the dream"}
    keys = [Line(names_of[arm], (), (), (), (), colour) for arm, colour in shown.items()]
    keys += [Line("acting at random" + (" in reality" if real else ""), (), (), (), (), QUIET)] if floor else []
    label = "success rate" if evaluation.what == SUCCESS else evaluation.what
    return f'<div class=scroll><div style="min-width:560px">{dot_plot(rows, label, guides)}</div></div>{legend(keys)}'


def _errors(evaluation: PolicyEvaluation) -> str:
    boxes = ""
    for channel, band in sorted(evaluation.curves.items(), key=lambda curve: curve[0] == UNCERTAINTY):
        if channel.endswith(PERSISTENCE) or len(band.value) < 2:
            continue
        held = evaluation.curves.get(channel + PERSISTENCE)
        lines = [_line("the dream", band, _DREAM)]
        lines += [_line("first observation, held", held, QUIET, "2 3")] if held else []
        span = y_span([0.0, *(v for line in lines for v in (*line.y, *line.low, *line.high))])
        ticks = [(float(2**k), str(2**k)) for k in range(12) if 2**k < len(band.value)]
        title, y_label = f"Error in {channel}", "distance to reality"
        if channel == UNCERTAINTY:
            title, y_label = "Uncertainty of the dream", "expected error"
        svg = line_chart(lines, ticks, "steps", y_label, True, span)
        boxes += f"<figure><h3>{escape(title)}</h3>{svg}{legend(lines)}</figure>"
    return f"<div class=charts>{boxes}</div>" if boxes else ""


def _line(label: str, band: Band, colour: str, dash: str = "") -> Line:
    steps = list(map(float, range(1, len(band.value))))
    return Line(label, steps, band.value[1:], band.low[1:], band.high[1:], colour, dash)


def _method(evaluation: PolicyEvaluation) -> str:
    lines = ["Intervals of single scores: " + ("Wilson." if evaluation.what == SUCCESS else "bootstrap over episodes.")]
    if evaluation.dream is not None:
        scale = "" if evaluation.what == SUCCESS else ", here in shares of the range of the real scores"
        lines += [
            "Each episode of the dream started from the first observation of a real one; all policies had the same starts.",
            "Pearson and Spearman: the correlation of the mean scores, and of their ranks. MMRV, SIMPLER's mean maximum rank "
            f"violation: for each policy, the largest real difference to a policy that the dream ranks on the wrong side{scale}; "
            "the mean over policies.",
            "Their intervals are percentiles of a bootstrap over policies and episodes.",
            "The control has the same policies, dream and starts, but the dream is given the actions that the policy took in "
            "another episode. A ranking that the control finds as well does not show that the dream follows actions.",
            "The gap is the dream's score minus the real one, start by start.",
        ]
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"
