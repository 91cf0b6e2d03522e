"""Small SVG plots of points with intervals: scatter plots and dot plots."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from .plot import round_ticks, y_span
from .statistics import Figure

_SIDE, _LEFT, _TOP, _RIGHT, _BOTTOM = 380, 52, 16, 14, 40
_ROW, _WORDS, _WIDE = 26, 190, 860


@dataclass(frozen=True)
class ScatterPoint:
    """A point with an interval in x and in y."""

    label: str
    x: Figure
    y: Figure
    colour: str


def scatter(points: Sequence[ScatterPoint], x_label: str, y_label: str) -> str:
    """An <svg> with one scale for both axes, and the diagonal."""
    low, high = y_span([end for point in points for each in (point.x, point.y) for end in _ends(each)])
    across, up = _SIDE - _LEFT - _RIGHT, _SIDE - _TOP - _BOTTOM

    def at(x: float, y: float) -> tuple[float, float]:
        right, above = (x - low) / (high - low) * across, (y - low) / (high - low) * up
        return round(_LEFT + right, 1), round(_SIDE - _BOTTOM - above, 1)

    parts = [f'<svg viewBox="0 0 {_SIDE} {_SIDE}" role="img" aria-label="{escape(y_label)} against {escape(x_label)}">']
    for value in round_ticks(low, high):
        x, y = at(value, value)
        parts.append(f'<path class="grid" d="M{_LEFT} {y}H{_SIDE - _RIGHT}M{x} {_TOP}V{_SIDE - _BOTTOM}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4}" text-anchor="end">{value:,g}</text>')
        parts.append(f'<text x="{x}" y="{_SIDE - _BOTTOM + 17}" text-anchor="middle">{value:,g}</text>')
    (x0, y0), (x1, y1) = at(low, low), at(high, high)
    parts.append(f'<path class="guide" d="M{x0} {y0}L{x1} {y1}"/>')
    for point in points:
        x, y = at(point.x.value, point.y.value)
        bars = ""
        if math.isfinite(point.x.low):
            bars += f"M{at(point.x.low, low)[0]} {y}H{at(point.x.high, low)[0]}"
        if math.isfinite(point.y.low):
            bars += f"M{x} {at(low, point.y.low)[1]}V{at(low, point.y.high)[1]}"
        if bars:
            parts.append(f'<path d="{bars}" stroke="{point.colour}" stroke-width="1.4" opacity="0.7" fill="none"/>')
        name = f"<title>{escape(point.label)}: {point.x.value:.4g}, {point.y.value:.4g}</title>"
        parts.append(f'<circle cx="{x}" cy="{y}" r="4.5" fill="{point.colour}">{name}</circle>')
    parts.append(f'<text x="{_LEFT + across / 2}" y="{_SIDE - 5}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(f'<text x="{_LEFT + 2}" y="{_TOP - 4}">{escape(y_label)}</text></svg>')
    return "".join(parts)


def dot_plot(
    rows: Sequence[tuple[str, Sequence[tuple[Figure, str]]]], x_label: str, guides: Sequence[tuple[float, str]] = ()
) -> str:
    """An <svg>: a row for each name with its figures (figure, colour), on one scale; guides: (value, colour) of dotted lines."""
    values = [end for _, figures in rows for figure, _ in figures for end in _ends(figure)] + [at for at, _ in guides]
    low, high = y_span(values)
    height = _TOP + _ROW * len(rows) + _BOTTOM

    def at(value: float) -> float:
        return round(_WORDS + (value - low) / (high - low) * (_WIDE - _WORDS - _RIGHT), 1)

    parts = [f'<svg viewBox="0 0 {_WIDE} {height}" role="img" aria-label="{escape(x_label)} of each">']
    foot = height - _BOTTOM
    for value in round_ticks(low, high, 8):
        parts.append(f'<path class="grid" d="M{at(value)} {_TOP}V{foot}"/>')
        parts.append(f'<text x="{at(value)}" y="{foot + 17}" text-anchor="middle">{value:,g}</text>')
    for value, colour in guides:
        parts.append(f'<path class="guide" d="M{at(value)} {_TOP}V{foot}" style="stroke:{colour}"/>')
    for place, (name, figures) in enumerate(rows):
        middle = _TOP + _ROW * (place + 0.5)
        parts.append(f'<text x="{_WORDS - 12}" y="{middle + 4}" text-anchor="end">{escape(name)}</text>')
        for number, (figure, colour) in enumerate(figures):
            y = middle + 7 * (number - (len(figures) - 1) / 2)
            if math.isfinite(figure.low):
                bar = f"M{at(figure.low)} {y}H{at(figure.high)}"
                parts.append(f'<path d="{bar}" stroke="{colour}" stroke-width="1.6" opacity="0.7"/>')
            parts.append(
                f'<circle cx="{at(figure.value)}" cy="{y}" r="3.5" fill="{colour}"><title>{escape(name)}: {figure.value:.4g}'
                "</title></circle>"
            )
    middle = (_WORDS + _WIDE - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{height - 5}" text-anchor="middle">{escape(x_label)}</text></svg>')
    return "".join(parts)


def _ends(figure: Figure) -> tuple[float, float, float]:
    return figure.value, figure.low, figure.high
