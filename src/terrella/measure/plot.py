"""Small plain SVG plots: lines with interval bands, on a dark page, legible on a phone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

_WIDTH, _HEIGHT, _RIGHT = 380, 250, 12
_WIDE, _WIDE_HEIGHT, _LABELS = 900, 380, 190  # of a chart that names its lines at their ends, and the room for that
_LEFT, _TOP, _BOTTOM = 40, 14, 40


@dataclass(frozen=True)
class Line:
    """One curve: y at each x, with low and high of its band (equal to y for none); dash as in SVG, "" for solid;
    mark: an x at which a dot stands on it."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    colour: str
    dash: str = ""
    mark: float | None = None


def line_chart(
    lines: Sequence[Line],
    x_ticks: Sequence[tuple[float, str]],
    x_label: str,
    y_label: str,
    log_x: bool = False,
    y_range: tuple[float, float] | None = None,
    guides: Sequence[float] = (),
    named: bool = False,
) -> str:
    """An <svg> of the lines; `guides` are dotted horizontals (targets). Its title is the page's affair, and so is its
    legend, unless it is `named`: then it is wide and each line has its name at its end."""
    width, height, margin = (_WIDE, _WIDE_HEIGHT, _LABELS) if named else (_WIDTH, _HEIGHT, _RIGHT)
    warp = math.log2 if log_x else float
    xs = [warp(x) for line in lines for x in line.x]
    bottom, top = y_range or y_span([v for line in lines for v in (*line.y, *line.low, *line.high)] + list(guides))
    left, right = min(xs), max(max(xs), min(xs) + 1e-9)

    def at(x: float, y: float) -> tuple[float, float]:
        across = _LEFT + (warp(x) - left) / (right - left) * (width - _LEFT - margin)
        share = (min(max(y, bottom), top) - bottom) / (top - bottom)
        return round(across, 1), round(height - _BOTTOM - share * (height - _TOP - _BOTTOM), 1)

    about = f"{escape(y_label)} against {escape(x_label)}"
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{about}">']
    for value in _ticks(bottom, top):
        y = at(lines[0].x[0], value)[1]
        parts.append(f'<path class="grid" d="M{_LEFT} {y}H{width - margin}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4}" text-anchor="end">{value:g}</text>')
    for value, label in x_ticks:
        x = at(value, bottom)[0]
        parts.append(f'<path class="grid" d="M{x} {height - _BOTTOM}v4"/>')
        parts.append(f'<text x="{x}" y="{height - _BOTTOM + 17}" text-anchor="middle">{escape(label)}</text>')
    for value in guides:
        parts.append(f'<path class="guide" d="M{_LEFT} {at(lines[0].x[0], value)[1]}H{width - margin}"/>')
    for line in lines:
        parts.append(_band_path(line, at))
    for line in lines:
        points = [at(x, y) for x, y in zip(line.x, line.y) if math.isfinite(y)]
        dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
        name = f"<title>{escape(line.label)}</title>"
        parts.append(f'<path class="line" d="{_path(points)}" stroke="{line.colour}"{dash}>{name}</path>')
        if line.mark is not None and line.mark in line.x:
            x, y = at(line.mark, line.y[line.x.index(line.mark)])
            parts.append(f'<circle class="mark" cx="{x}" cy="{y}" r="4.5" stroke="{line.colour}">{name}</circle>')
    parts += _names(lines, at, height - _BOTTOM) if named else []
    middle = (_LEFT + width - margin) / 2
    parts.append(f'<text x="{middle}" y="{height - 5}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(f'<text x="{_LEFT + 4}" y="{_TOP - 3}">{escape(y_label)}</text></svg>')
    return "".join(parts)


def _names(
    lines: Sequence[Line], at: Callable[[float, float], tuple[float, float]], lowest: float, apart: float = 15.0
) -> list[str]:
    """The lines' names to the right of their ends, moved up and down until they are `apart`."""
    ends = [(*at(line.x[-1], line.y[-1]), line) for line in lines if math.isfinite(line.y[-1])]
    ends.sort(key=lambda end: end[1])
    heights: list[float] = []
    for _, y, _ in ends:
        heights.append(max(y, heights[-1] + apart) if heights else y)
    for k in reversed(range(len(heights))):
        heights[k] = min(heights[k], heights[k + 1] - apart if k + 1 < len(heights) else lowest)
    parts = []
    for (x, y, line), level in zip(ends, heights):
        parts.append(f'<path class="lead" d="M{x + 3} {y}L{x + 13} {level:g}" stroke="{line.colour}"/>')
        style = f'style="fill:{line.colour}"'
        parts.append(f'<text x="{x + 17}" y="{level + 4:g}" {style}>{escape(line.label)}</text>')
    return parts


def _band_path(line: Line, at) -> str:
    known = [k for k in range(len(line.x)) if math.isfinite(line.low[k]) and math.isfinite(line.high[k])]
    if not known:
        return ""
    up = [at(line.x[k], line.high[k]) for k in known]
    down = [at(line.x[k], line.low[k]) for k in reversed(known)]
    return f'<path d="{_path(up + down)}Z" fill="{line.colour}" fill-opacity="0.14"/>'


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points) if points else ""


def y_span(values: Sequence[float]) -> tuple[float, float]:
    """A range that holds all finite values with a little air."""
    known = [value for value in values if math.isfinite(value)] or [0.0]
    low, high = min(known), max(known)
    air = 0.06 * (high - low) or 0.5
    return low - air, high + air


def _ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers inside the range."""
    raw = (high - low) / about
    scale = 10 ** math.floor(math.log10(raw))
    step = next(factor * scale for factor in (1, 2, 2.5, 5, 10) if factor * scale >= raw)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) for k in range(first, math.floor(high / step + 1e-9) + 1)]
