"""The page of `terrella evaluate`: the verdict, dream against reality, each policy, and how the dream's error grows."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from .page_parts import COLOURS, QUIET, document, keys_of, section, table_of, words_and_interval
from .plot import Line, line_chart, y_span
from .plot_points import ScatterPoint, dot_plot, scatter
from .policy_evaluation import (
    CONTROL,
    DREAM,
    HELD,
    RANDOM,
    REAL,
    SUCCESS,
    UNCERTAINTY,
    PolicyEvaluation,
    table,
    verdict,
)
from .statistics import Band

_REAL, _DREAM = COLOURS[1], COLOURS[0]


def policy_evaluation_page(title: str, judged: PolicyEvaluation, facts: Mapping[str, object]) -> str:
    """HTML that needs nothing from outside."""
    lines = [line[:1].upper() + line[1:] for line in verdict(judged)]
    heads, cells = table(judged)
    found = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    known = {name.replace("_", " "): value for name, value in facts.items() if value is not None}
    settings = "".join(f"<li>{escape(name)}: {escape(str(value))}</li>" for name, value in known.items())
    words = "".join(f"<li>{escape(line)}</li>" for line in lines[1:])
    parts = [
        f"<section><h2>{escape(lines[0])}</h2><ul>{words}</ul></section>",
        section("Dream against reality", _lead(judged), _scatter(judged)),
        section(f"The {judged.what} of each policy", "With 95% intervals; the best first.", _listed(judged) + found),
        section(
            "Where the dream is wrong",
            "The dream begins where real episodes did and is given their actions alone: how far it then is from them, in shares of "
            "each channel's range where it has one. Mean of all policies, with its interval.",
            _errors(judged),
        ),
        section("How this was measured", "", _method(judged) + f"<h3>Settings</h3><ul>{settings}</ul>"),
    ]
    return document(title, parts)


def _lead(judged: PolicyEvaluation) -> str:
    return (
        f"A point is a policy: its {judged.what} in reality and in the dream, with 95% intervals. On the dotted line both are the "
        "same; a ranking needs no more than that the points rise."
    )


def _scatter(judged: PolicyEvaluation) -> str:
    if judged.dream is None:
        return ""
    boxes = ""
    for arm, title in ((DREAM, "The dream"), (CONTROL, "The control: the dream hears other actions")):
        rows = {name: judged.rows[name] for name in judged.policies}
        points = [
            ScatterPoint(name, row[REAL], row[arm], _DREAM if arm == DREAM else QUIET) for name, row in rows.items()
        ]
        svg = scatter(points, f"{judged.what} in reality", f"{judged.what} in the dream")
        boxes += f"<figure><h3>{escape(title)}</h3>{svg}</figure>"
    return f"<div class=charts>{boxes}</div>"


def _listed(judged: PolicyEvaluation) -> str:
    real = judged.dream is not None
    names = sorted(judged.policies, key=lambda name: -judged.rows[name][REAL if real else DREAM].value)
    shown = {REAL: _REAL, DREAM: _DREAM} if real else {DREAM: _DREAM}
    rows = [(name, [(judged.rows[name][arm], colour) for arm, colour in shown.items()]) for name in names]
    floor = judged.rows.get(RANDOM)
    guides = [(floor[REAL if real else DREAM].value, QUIET)] if floor else []
    keys = {{REAL: "in reality", DREAM: "in the dream"}[arm]: colour for arm, colour in shown.items()}
    keys |= {"acting at random" + (" in reality" if real else ""): QUIET} if floor else {}
    label = "share of successes" if judged.what == SUCCESS else judged.what
    return f'<div class=scroll><div style="min-width:560px">{dot_plot(rows, label, guides)}</div></div>{keys_of(keys)}'


def _errors(judged: PolicyEvaluation) -> str:
    boxes = ""
    for channel, band in sorted(judged.curves.items(), key=lambda curve: curve[0] == UNCERTAINTY):
        if channel.endswith(HELD) or len(band.value) < 2:
            continue
        held = judged.curves.get(channel + HELD)
        lines = [_line("the dream", band, _DREAM)] + ([_line("what stands still", held, QUIET, "2 3")] if held else [])
        span = y_span([0.0, *(v for line in lines for v in (*line.y, *line.low, *line.high))])
        last = len(band.value) - 1
        ticks = [(float(2**k), str(2**k)) for k in range(12) if 2**k <= last]
        is_uncertainty = channel == UNCERTAINTY
        title = "The uncertainty that the dream tells" if is_uncertainty else f"Error in {channel}"
        svg = line_chart(
            lines, ticks, "steps", "expected error" if is_uncertainty else "distance to reality", True, span
        )
        keys = keys_of({line.label: line.colour for line in lines})
        boxes += f"<figure><h3>{escape(title)}</h3>{svg}{keys}</figure>"
    return f"<div class=charts>{boxes}</div>" if boxes else ""


def _line(label: str, band: Band, colour: str, dash: str = "") -> Line:
    steps = list(map(float, range(1, len(band.value))))
    return Line(label, steps, band.value[1:], band.low[1:], band.high[1:], colour, dash)


def _method(judged: PolicyEvaluation) -> str:
    lines = ["Intervals of single scores: " + ("Wilson's." if judged.what == SUCCESS else "a bootstrap over episodes.")]
    if judged.dream is not None:
        scale = "" if judged.what == SUCCESS else ", here in shares of the range of the real scores"
        lines += [
            "Each episode of the dream began by observing the first moment of a real one; all policies began from the same starts.",
            "Pearson and Spearman: the correlation of the mean scores, and of their ranks. MMRV, SIMPLER's mean maximum rank "
            f"violation: the most by which a policy really differs from one that the dream puts on its other side{scale}; the mean "
            "of that over policies.",
            "Their intervals are percentiles of a bootstrap over policies and episodes.",
            "The control is the same policies, dream and starts, but for one thing: the dream hears the actions that the same "
            "policy took in another episode, so that they answer to nothing. What it ranks as well needs no dream that obeys.",
            "The gap is the dream's score less reality's, start by start.",
        ]
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"
