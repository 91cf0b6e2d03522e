"""Small SVG line charts with interval bands, for a dark page, legible on a phone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

_WIDTH, _HEIGHT, _RIGHT = 380, 250, 12
_LEFT, _TOP, _BOTTOM = 40, 14, 40  # left: at least


@dataclass(frozen=True)
class Line:
    """One curve with its band."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float]  # equal to y without a band
    high: Sequence[float]  # equal to y without a band
    colour: str
    dash: str = ""  # as in SVG; "" for solid
    mark: float | None = None  # an x to mark with a dot


def line_chart(
    lines: Sequence[Line],
    x_ticks: Sequence[tuple[float, str]],
    x_label: str,
    y_label: str,
    log_x: bool = False,
    y_range: tuple[float, float] | None = None,
    guides: Sequence[float] = (),
) -> str:
    """An <svg> of the lines, without title and legend; `guides`: y of dotted lines (targets)."""
    width, height, margin = _WIDTH, _HEIGHT, _RIGHT
    warp = math.log2 if log_x else float
    xs = [warp(x) for line in lines for x in line.x]
    bottom, top = y_range or y_span([v for line in lines for v in (*line.y, *line.low, *line.high)] + list(guides))
    left, right = min(xs), max(max(xs), min(xs) + 1e-9)
    ticks = [(value, f"{value:g}") for value in round_ticks(bottom, top)]
    start = max([_LEFT, *(10 + 7 * len(label) for _, label in ticks)])

    def at(x: float, y: float) -> tuple[float, float]:
        across = start + (warp(x) - left) / (right - left) * (width - start - margin)
        share = (min(max(y, bottom), top) - bottom) / (top - bottom)
        return round(across, 1), round(height - _BOTTOM - share * (height - _TOP - _BOTTOM), 1)

    about = f"{escape(y_label)} against {escape(x_label)}"
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{about}">']
    for value, label in ticks:
        y = at(lines[0].x[0], value)[1]
        parts.append(f'<path class="grid" d="M{start} {y}H{width - margin}"/>')
        parts.append(f'<text x="{start - 6}" y="{y + 4}" text-anchor="end">{label}</text>')
    for value, label in x_ticks:
        x = at(value, bottom)[0]
        parts.append(f'<path class="grid" d="M{x} {height - _BOTTOM}v4"/>')
        parts.append(f'<text x="{x}" y="{height - _BOTTOM + 17}" text-anchor="middle">{escape(label)}</text>')
    ys = [at(lines[0].x[0], value)[1] for value in guides]
    parts += [f'<path class="guide" d="M{start} {y}H{width - margin}"/>' for y in ys]
    parts += [_band_path(line, at) for line in lines]
    for line in lines:
        points = [at(x, y) for x, y in zip(line.x, line.y) if math.isfinite(y)]
        dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
        name = f"<title>{escape(line.label)}</title>"
        parts.append(f'<path class="line" d="{_path(points)}" stroke="{line.colour}"{dash}>{name}</path>')
        if line.mark is not None and line.mark in line.x:
            x, y = at(line.mark, line.y[line.x.index(line.mark)])
            parts.append(f'<circle class="mark" cx="{x}" cy="{y}" r="4.5" stroke="{line.colour}">{name}</circle>')
    middle = (start + width - margin) / 2
    parts.append(f'<text x="{middle}" y="{height - 5}" text-anchor="middle">{escape(x_label)}</text>')
    parts.append(f'<text x="{start + 4}" y="{_TOP - 3}">{escape(y_label)}</text></svg>')
    return "".join(parts)


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
    """A range of all finite values, with a margin."""
    known = [value for value in values if math.isfinite(value)] or [0.0]
    low, high = min(known), max(known)
    margin = 0.06 * (high - low) or 0.5
    return low - margin, high + margin


def round_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers inside the range."""
    raw = (high - low) / about
    scale = 10 ** math.floor(math.log10(raw))
    step = next(factor * scale for factor in (1, 2, 2.5, 5, 10) if factor * scale >= raw)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) for k in range(first, math.floor(high / step + 1e-9) + 1)]
