"""What the page of a scorecard is put together from: sections, tables, figures in words, charts and pictures."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape

import numpy as np

from .drift import COPY_LAST
from .plot import Line, line_chart, y_span
from .roll import PREDICTED
from .scorecard import Curve, Picture, Scorecard
from .statistics import Band, Figure
from .strip import join_row, jpeg

COLOURS = ("#6fd3c1", "#e3a857", "#8ea6ff", "#e07a9b", "#b6d36f")
QUIET = "#8b93a3"


def section(heading: str, lead: str, inside: str) -> str:
    return f"<section><h2>{escape(heading)}</h2><p>{lead}</p>{inside}</section>" if inside else ""


def figure_text(figure: Figure | None, digits: int = 2, unit: str = "") -> str:
    if figure is None or not math.isfinite(figure.value):
        return "&ndash;"
    value = f"{figure.value:.{digits}f} {escape(unit)}".rstrip()
    if not math.isfinite(figure.low):
        return value
    return f"{value}<small>{figure.low:.{digits}f} to {figure.high:.{digits}f}</small>"


def values(band: Band) -> list[float]:
    return [*band.value, *band.low, *band.high]


def named(arm: str, motion: str) -> str:
    return f"{arm}, {motion} motion" if motion else arm


def points_line(label: str, points: Sequence[tuple[int, Figure]], colour: str, dash: str) -> Line:
    x, figures = [step for step, _ in points], [figure for _, figure in points]
    y, low, high = ([getattr(figure, key) for figure in figures] for key in ("value", "low", "high"))
    return Line(label, x, y, low, high, colour, dash)


def table_of(heads: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """A table of ready-made cells; the first `texts` columns are words, the others numbers set to the right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(f"<{tag}{'' if k < texts else ' class=n'}>{cell}</{tag}>" for k, cell in enumerate(row))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{cells('th', heads)}</tr></thead><tbody>{body}</tbody></table></div>"


def steps_text(horizon: int, seconds: float) -> str:
    return f"{horizon}<small>{seconds:.2f} s</small>"


def percent(figure: Figure) -> str:
    return figure_text(Figure(figure.value * 100, figure.low * 100, figure.high * 100, figure.count), 1)


def hundredths(figure: Figure) -> str:
    words = f"{100 * figure.value:.2f}"
    if not math.isfinite(figure.low):
        return words
    return f"{words}<small>{100 * figure.low:.2f} to {100 * figure.high:.2f}</small>"


def charts_of(card: Scorecard, what: str, y_label: str, guides: Sequence[float] = ()) -> str:
    """One chart of every arm and motion for each place, all on one scale."""
    curves = [curve for curve in card.curves if curve.what == what]
    if not curves:
        return ""
    span = y_span([value for curve in curves for value in values(curve.band)] + list(guides))
    steps = sorted({row.horizon for row in card.fidelity})
    boxes = []
    for place in card.places:
        lines = [_line(card, curve) for curve in curves if curve.place == place.name]
        svg = line_chart(lines, [(s, str(s)) for s in steps], "steps", y_label, True, span, guides)
        boxes.append(figure_box(f"{place.name} places", svg, lines))
    return f"<div class=charts>{''.join(boxes)}</div>"


def _line(card: Scorecard, curve: Curve) -> Line:
    dash = "" if curve.motion == PREDICTED else "5 4" if curve.motion else "2 3"
    x = list(range(1, len(curve.band.value) + 1))
    return Line(
        named(curve.arm, curve.motion),
        x,
        curve.band.value,
        curve.band.low,
        curve.band.high,
        colour_of(card, curve.arm),
        dash,
    )


def figure_box(title: str, svg: str, lines: Sequence[Line]) -> str:
    keys = "".join(
        f'<span><svg viewBox="0 0 22 6" class=key><path d="M0 3H22" stroke="{line.colour}" stroke-width="2.5"'
        + (f' stroke-dasharray="{line.dash}"' if line.dash else "")
        + f"/></svg>{escape(line.label)}</span>"
        for line in lines
    )
    return f"<figure><h3>{escape(title)}</h3>{svg}<figcaption>{keys}</figcaption></figure>"


def colour_of(card: Scorecard, arm: str) -> str:
    return QUIET if arm == COPY_LAST else COLOURS[list(card.worlds).index(arm) % len(COLOURS)]


def picture_of(picture: Picture) -> str:
    least, most = 116 * len(picture.columns), 160 * len(picture.columns)
    heads = "".join(f"<span>{escape(column)}</span>" for column in picture.columns)
    rows = "".join(f"<h4>{escape(label)}</h4>{_image(frames, label)}" for label, frames in picture.rows.items())
    inside = f'<div style="min-width:{least}px;max-width:{most}px"><div class=columns>{heads}</div>{rows}</div>'
    return f"<div class=strip><h3>{escape(picture.title)}</h3><div class=scroll>{inside}</div></div>"


def _image(frames: np.ndarray, label: str) -> str:
    data = base64.b64encode(jpeg(join_row(frames))).decode()
    return f'<img alt="{escape(label)}" src="data:image/jpeg;base64,{data}">'
