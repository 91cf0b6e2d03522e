"""The page of `terrella transfer`: the verdict, each arm, successes against real episodes and against the gap, and the method."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape

from .page_parts import COLOURS, QUIET, document, keys_of, section, table_of, words_and_interval
from .plot import Line, line_chart
from .plot_points import dot_plot
from .statistics import Figure
from .transfer_scores import FLOORS, NOMINAL, ORACLE, RECOVERS, SUCCEEDS, TransferScores, camera_table, table, verdict

METHOD = (
    "Intervals are Clopper and Pearson's, of all episodes of all seeds as one sample: they tell the chance of episodes, the column "
    "of seeds that of training.",
    "Every policy played the same real starts, which none was trained on. Success is the task's own, yes or no.",
    "Gap recovered: (arm less nominal) over (oracle less nominal).",
    "All arms but random and idle begin with the nominal policy and practise as many steps more; nominal goes on in the simulator.",
    "identified N: the simulator with the parameters, within the ranges of the randomised arm, under which it repeats N real "
    "episodes best; then practice in narrow ranges around them.",
    "model N: the simulator and a learned residual, fitted to N real episodes, as one world model; then practice in it. Half of "
    "the episodes are the nominal policy's, half that of the policy which practised in the model of the first half.",
    "With a camera: an encoder reads the goal off one picture when an episode begins. It learned from pictures of the simulator "
    "with their goals (nominal); of many looks of it (randomised); of those, and of the real one without goals, which an adversary "
    "must not tell apart (adversarial, by gradient reversal); or of the real one with goals (oracle). visual: the nominal policy "
    "with the randomised encoder; both: the randomised policy with it.",
    "MMRV (SIMPLER): the most by which a policy really differs from one that is put on its other side; the mean over policies. "
    "Each seed has its own model; policies that were trained in the real one are left out.",
)


def transfer_page(title: str, found: TransferScores, facts: Mapping[str, object]) -> str:
    """HTML that needs nothing from outside."""
    lines = [line[:1].upper() + line[1:] for line in verdict(found)]
    words = "".join(f"<li>{escape(line)}</li>" for line in lines[1:])
    heads, cells = table(found)
    figures = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    colours = {
        arm: QUIET if arm in (*FLOORS, ORACLE) else COLOURS[1] if arm == NOMINAL else COLOURS[0] for arm in found.arms
    }
    rows = [(arm, [(figure, colours[arm])]) for arm, figure in found.arms.items()]
    svg = dot_plot(rows, "share of successes in the real one", [(SUCCEEDS, QUIET)])
    settings = "".join(
        f"<li>{escape(name.replace('_', ' '))}: {escape(str(value))}</li>"
        for name, value in facts.items()
        if value not in ("", [], ())
    )
    parts = [
        f"<section><h2>{escape(lines[0])}</h2><ul>{words}</ul></section>",
        section("The arms", f"With 95% intervals; dotted: {SUCCEEDS:.0%}.", _wide(svg) + figures),
        section("Few real episodes", "Successes of what learned from so many real episodes.", _few(found)),
        section("Told the goal by a camera", "The real one looks otherwise, too.", _camera(found)),
        section("The gap, dialled", "The same policies where the real one differs by a part of the whole gap.", _dialled(found)),
        section(
            "How this was measured", "", f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in METHOD)}</ul>"
            f"<h3>Settings</h3><ul>{settings}</ul>",
        ),
    ]  # fmt: skip
    return document(title, parts)


def _wide(svg: str) -> str:
    return f'<div class=scroll><div style="min-width:560px">{svg}</div></div>'


def _few(found: TransferScores) -> str:
    kinds: dict[str, list[tuple[int, Figure]]] = {}
    for arm, figure in found.arms.items():
        said = re.fullmatch(r"(\w+) (\d+)", arm)
        if said:
            kinds.setdefault(said[1], []).append((int(said[2]), figure))
    lines = [_line(name, sorted(points), COLOURS[at]) for at, (name, points) in enumerate(kinds.items())]
    if not any(len(line.x) > 1 for line in lines):
        return ""
    counts = sorted({int(x) for line in lines for x in line.x})
    guides = []
    if NOMINAL in found.arms and ORACLE in found.arms:
        low, high = found.arms[NOMINAL].value, found.arms[ORACLE].value
        guides = [low, low + RECOVERS * (high - low), high]
    ticks = [(float(count), str(count)) for count in counts]
    svg = line_chart(lines, ticks, "real episodes", "successes", True, (0.0, 1.0), guides)
    note = f"<p>Dotted: nominal, {RECOVERS:.0%} of the gap, oracle.</p>" if guides else ""
    return f"<div class=charts><figure>{svg}{keys_of({line.label: line.colour for line in lines})}</figure></div>{note}"


def _camera(found: TransferScores) -> str:
    if not found.camera:
        return ""
    heads, cells = camera_table(found)
    rows = [(arm, [(figure, QUIET if "oracle" in arm else COLOURS[0])]) for arm, figure in found.camera.items()]
    figures = table_of(list(map(escape, heads)), [[words_and_interval(cell) for cell in line] for line in cells])
    return _wide(dot_plot(rows, "share of successes in the real one", [(SUCCEEDS, QUIET)])) + figures


def _dialled(found: TransferScores) -> str:
    lines = [
        _line(arm, sorted(gaps.items()), COLOURS[at % len(COLOURS)])
        for at, (arm, gaps) in enumerate(found.dial.items())
    ]
    if not lines:
        return ""
    ticks = [(float(x), f"{x:g}") for x in lines[0].x]
    svg = line_chart(lines, ticks, "gap", "successes", False, (0.0, 1.0))
    return f"<div class=charts><figure>{svg}{keys_of({line.label: line.colour for line in lines})}</figure></div>"


def _line(label: str, points: Sequence[tuple[float, Figure]], colour: str) -> Line:
    figures = [figure for _, figure in points]
    ends = [one.low for one in figures], [one.high for one in figures]
    return Line(label, [float(x) for x, _ in points], [one.value for one in figures], *ends, colour)
