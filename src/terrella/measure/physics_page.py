"""The page of `terrella check`: the verdict beside the worst rollout, the laws, constants, violation by step, and the method."""

import base64
import math
from html import escape

from ..physics.laws.energy import energy
from .page_parts import COLOURS, QUIET, document, legend, section, table_of
from .physics import LawReport, PhysicsReport, WorstRollout, in_words, physics_verdict, table_of_laws
from .physics_film import film_of_bodies, framed
from .plot import Line, line_chart
from .plot_points import dot_plot
from .strip import film

METHOD = (
    "A law is judged on the decoded channels of the world, never on its latents.",
    "Tolerance: 1.1 times a quantile of the largest violation in true rollouts of the same length, so that at most 0.5% of them "
    "exceed it (split conformal prediction). With fewer than 199 rollouts it is their largest one, and the share is 1 / (n + 1).",
    "False alarms: the share of other true rollouts above the tolerance. Injected: one violation of twice the tolerance in each "
    "true rollout that has an occasion.",
    "Broken coarsely: by more than a share (--coarse) of the largest tolerance with which the law says something, such as half a "
    "body's size, or a quarter of gravity.",
    "Certified horizon: the steps before the first that breaks any law; median over rollouts.",
    "Steps in which something else may have touched a body are left out of free fall, momentum and friction.",
    "Intervals: bootstrap over rollouts (95%), Clopper-Pearson for shares.",
)


def physics_page(title: str, report: PhysicsReport) -> str:
    """A self-contained HTML page."""
    lines = physics_verdict(report)
    heads, rows = table_of_laws(report)
    table = table_of(list(map(escape, heads)), [list(map(escape, row)) for row in rows])
    missing = "".join(f"<li>{escape(name)}: {escape(why)}</li>" for name, why in report.missing.items())
    origin = report.laws[0].origin if report.laws else ""
    lead = f"Tolerances from {escape(origin)}; {report.rollouts} rollouts of the world, of {report.steps} steps."
    parts = [
        _hero(report, lines),
        section("The laws", lead, table + (f"<h3>Not applicable</h3><ul>{missing}</ul>" if missing else "")),
        section(
            "Violation by step", "Mean over rollouts; dotted: the tolerance, and the coarse one.", _by_step(report)
        ),
        section("Constants", "Estimated from the motion itself, with 95% intervals.", _constants(report)),
        section("Energy of that rollout", "Kinetic and potential, in J.", _energy(report)),
        section("How this was measured", "", f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in METHOD)}</ul>"),
    ]
    return document(title, parts)


def _hero(report: PhysicsReport, lines: list[str]) -> str:
    rest = "".join(f"<li>{escape(line)}</li>" for line in lines[1:])
    shown = ""
    if report.worst is not None:
        worst = report.worst
        broken = [False, *(not value <= worst.tolerance for value in worst.by_step)]
        frames = [film_of_bodies(worst.truth), framed(film_of_bodies(worst.dream, worst.truth), broken)]
        data = base64.b64encode(film(frames, max(report.dt_s, 0.05))).decode()
        height, width = frames[0].shape[1:3]
        shown = (
            f'<figure class=film style="aspect-ratio:{width}/{2 * height + 4}"><img alt="The truth above, the world below" '
            f'src="data:image/webp;base64,{data}"><figcaption><span>truth</span><span>dream</span></figcaption></figure>'
        )
        rest += f"<li>{escape(_shown(worst))}</li></ul>{_violation_of(worst)}<ul>"
    return f"<section class=hero>{shown}<div class=good><h2>{escape(lines[0])}</h2><ul>{rest}</ul></div></section>"


def _shown(worst: WorstRollout) -> str:
    largest = worst.by_step[worst.step - 1]
    most = f"{in_words(largest)} {worst.unit} in step {worst.step}, where {in_words(worst.tolerance)} would be seen"
    if not largest <= worst.tolerance:
        return f"Shown: the rollout that breaks {worst.law} by most, by {most}. Its frames are red while it breaks it."
    return f"No rollout visibly breaks a law. Shown: the one that comes nearest to it, {worst.law} by {most}."


def _violation_of(worst: WorstRollout) -> str:
    """The violation of the law that the film shows, by step."""
    x, y = [float(step) for step in range(1, len(worst.by_step) + 1)], list(worst.by_step)
    line = Line(worst.law, x, y, y, y, COLOURS[0], mark=float(worst.step))
    top = 1.05 * max([value for value in y if math.isfinite(value)] + [1.2 * worst.tolerance])
    svg = line_chart([line], _ticks(len(x)), "steps", worst.unit, False, (0.0, top), [worst.tolerance])
    return f"<div class=charts><figure><h3>{escape(worst.law)} in this rollout</h3>{svg}</figure></div>"


def _ticks(steps: int) -> list[tuple[float, str]]:
    every = max(1, round(steps / 4))
    return [(float(step), str(step)) for step in range(every, steps + 1, every)]


def _by_step(report: PhysicsReport) -> str:
    figures = "".join(_chart(report, law) for law in report.laws if not law.wrong_here)
    return f"<div class=charts>{figures}</div>" if figures else ""


def _chart(report: PhysicsReport, law: LawReport) -> str:
    x = [float(step + 1) for step in range(report.steps)]
    band = law.by_step
    lines = [Line(law.name, x, band.value, band.low, band.high, COLOURS[0])]
    top = max([value for value in (*band.value, *band.high) if math.isfinite(value)] + [1.2 * law.tolerance])
    guides = [value for value in (law.tolerance, law.coarse) if value <= 1.2 * top]
    svg = line_chart(lines, _ticks(report.steps), "steps", law.unit, False, (0.0, 1.05 * max([top, *guides])), guides)
    return f"<figure><h3>{escape(law.name)}</h3>{svg}</figure>"


def _constants(report: PhysicsReport) -> str:
    plots = ""
    for one in report.constants:
        rows = [("truth", [(one.truth, QUIET)]), ("world", [(one.dream, COLOURS[0])])]
        label = f"{one.name}, {one.unit}" if one.unit else one.name
        plots += f'<h3>{escape(label)}</h3><div class=scroll><div style="min-width:560px">{dot_plot(rows, label)}</div></div>'
    return plots


def _energy(report: PhysicsReport) -> str:
    if report.worst is None or "energy" in report.missing:
        return ""
    lines = []
    for label, part, colour in (("truth", report.worst.truth, QUIET), ("world", report.worst.dream, COLOURS[0])):
        y = energy(part)[:, 0].tolist()
        lines.append(Line(label, [float(step) for step in range(len(y))], y, y, y, colour))
    svg = line_chart(lines, _ticks(report.steps), "steps", "energy, J")
    return f"<div class=charts><figure>{svg}{legend(lines)}</figure></div>"
