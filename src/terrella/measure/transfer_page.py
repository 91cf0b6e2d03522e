"""The page of `terrella transfer`: the verdict, each arm, success against real episodes and against the gap, and the method."""

import re
from collections.abc import Mapping, Sequence
from html import escape

from .page_parts import COLOURS, QUIET, document, legend, section, table_of, words_and_interval
from .plot import Line, line_chart
from .plot_points import dot_plot
from .statistics import Figure
from .transfer_scores import FLOORS, NOMINAL, ORACLE, RECOVERS, SUCCEEDS, TransferScores, camera_table, table, verdict

METHOD = (
    "Intervals are Clopper-Pearson over all episodes of all seeds as one sample: they cover the chance of episodes; the column "
    "of seeds shows that of training.",
    "Every policy played the same real starts, on which none was trained. Success is defined by the task.",
    "Gap recovered: (arm - nominal) / (oracle - nominal).",
    "All arms but random and idle start from the nominal policy and train for the same number of further steps; nominal goes on "
    "in the simulator.",
    "identified N: system identification. The simulator's parameters, within the ranges of the randomised arm, are fitted to N "
    "real episodes; then training in narrow ranges around them.",
    "model N: the simulator and a learned residual, fitted to N real episodes, as one world model; then training in it. Half of "
    "the episodes come from the nominal policy, half from the policy trained in the model of the first half.",
    "With a camera: an encoder reads the goal from one picture at the start of an episode. It is trained on pictures of the "
    "simulator with goals (nominal); with many appearances (randomised); on those and on real pictures without goals, by gradient "
    "reversal (adversarial); or on real pictures with goals (oracle). visual: the nominal policy with the randomised encoder; "
    "both: the randomised policy with it.",
    "MMRV (SIMPLER): for each policy, the largest real difference to a policy that is ranked on the wrong side; the mean over "
    "policies. Each seed has its own model; policies trained in the real environment are left out.",
)


def transfer_page(title: str, scores: TransferScores, facts: Mapping[str, object]) -> str:
    """A self-contained HTML page."""
    lines = [line[:1].upper() + line[1:] for line in verdict(scores)]
    words = "".join(f"<li>{escape(line)}</li>" for line in lines[1:])
    heads, cells = table(scores)
    figures = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    colours = {
        arm: QUIET if arm in (*FLOORS, ORACLE) else COLOURS[1] if arm == NOMINAL else COLOURS[0] for arm in scores.arms
    }
    rows = [(arm, [(figure, colours[arm])]) for arm, figure in scores.arms.items()]
    svg = dot_plot(rows, "success rate in the real environment", [(SUCCEEDS, QUIET)])
    given = {name.replace("_", " "): str(value) for name, value in facts.items() if value not in ("", [], ())}
    settings = "".join(f"<li>{escape(name)}: {escape(value)}</li>" for name, value in given.items())
    parts = [
        f"<section><h2>{escape(lines[0])}</h2><ul>{words}</ul></section>",
        section("The arms", f"With 95% intervals; dotted: {SUCCEEDS:.0%}.", _wide(svg) + figures),
        section("Few real episodes", "Success rate against the number of real episodes used.", _few(scores)),
        section("Goal read from a camera", "The real environment also looks different.", _camera(scores)),
        section("The gap, scaled", "The same policies in an environment with a part of the whole gap.", _dialled(scores)),
        section(
            "How this was measured", "", f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in METHOD)}</ul>"
            f"<h3>Settings</h3><ul>{settings}</ul>",
        ),
    ]  # fmt: skip
    return document(title, parts)


def _wide(svg: str) -> str:
    return f'<div class=scroll><div style="min-width:560px">{svg}</div></div>'


def _few(scores: TransferScores) -> str:
    kinds: dict[str, list[tuple[int, Figure]]] = {}
    for arm, figure in scores.arms.items():
        match = re.fullmatch(r"(\w+) (\d+)", arm)
        if match:
            kinds.setdefault(match[1], []).append((int(match[2]), figure))
    lines = [_line(name, sorted(points), COLOURS[at]) for at, (name, points) in enumerate(kinds.items())]
    if not any(len(line.x) > 1 for line in lines):
        return ""
    counts = sorted({int(x) for line in lines for x in line.x})
    guides = []
    if NOMINAL in scores.arms and ORACLE in scores.arms:
        low, high = scores.arms[NOMINAL].value, scores.arms[ORACLE].value
        guides = [low, low + RECOVERS * (high - low), high]
    ticks = [(float(count), str(count)) for count in counts]
    svg = line_chart(lines, ticks, "real episodes", "success rate", True, (0.0, 1.0), guides)
    note = f"<p>Dotted: nominal, {RECOVERS:.0%} of the gap, oracle.</p>" if guides else ""
    return f"<div class=charts><figure>{svg}{legend(lines)}</figure></div>{note}"


def _camera(scores: TransferScores) -> str:
    if not scores.camera:
        return ""
    heads, cells = camera_table(scores)
    rows = [(arm, [(figure, QUIET if "oracle" in arm else COLOURS[0])]) for arm, figure in scores.camera.items()]
    figures = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    return _wide(dot_plot(rows, "success rate in the real environment", [(SUCCEEDS, QUIET)])) + figures


def _dialled(scores: TransferScores) -> str:
    dial = enumerate(scores.dial.items())
    lines = [_line(arm, sorted(gaps.items()), COLOURS[at % len(COLOURS)]) for at, (arm, gaps) in dial]
    if not lines:
        return ""
    ticks = [(float(x), f"{x:g}") for x in lines[0].x]
    svg = line_chart(lines, ticks, "gap", "success rate", False, (0.0, 1.0))
    return f"<div class=charts><figure>{svg}{legend(lines)}</figure></div>"


def _line(label: str, points: Sequence[tuple[float, Figure]], colour: str) -> Line:
    figures = [figure for _, figure in points]
    ends = [one.low for one in figures], [one.high for one in figures]
    return Line(label, [float(x) for x, _ in points], [one.value for one in figures], *ends, colour)
