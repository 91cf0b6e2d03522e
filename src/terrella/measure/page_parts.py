"""Parts of the page of a scorecard: sections, charts, tables of figures, pictures."""

import base64
import math
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from .plot import Line, line_chart, y_span
from .scorecard import COPY_LAST, TRUE, Curve, DreamFilm, Picture, Row, Scorecard, place_label
from .statistics import Figure
from .strip import film, join_row, jpeg

COLOURS = ("#6fd3c1", "#e3a857", "#8ea6ff", "#e07a9b", "#b6d36f")
QUIET = "#8b93a3"


def section(heading: str, lead: str, inside: str) -> str:
    return f"<section><h2>{escape(heading)}</h2><p>{lead}</p>{inside}</section>" if inside else ""


def document(title: str, sections: Sequence[str], below_title: str = "") -> str:
    """A self-contained HTML page; `below_title` is HTML."""
    style = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><meta name="color-scheme" content="dark">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><header><h1>{escape(title)}</h1>"
        f"{below_title}</header><main>{''.join(sections)}</main></body></html>\n"
    )


def legend(lines: Sequence[Line]) -> str:
    """The legend of a chart."""
    keys = "".join(
        f'<span><svg viewBox="0 0 22 6" class=key><path d="M0 3H22" stroke="{line.colour}" stroke-width="2.5"'
        + (f' stroke-dasharray="{line.dash}"' if line.dash else "")
        + f"/></svg>{escape(line.label)}</span>"
        for line in lines
    )
    return f"<figcaption>{keys}</figcaption>"


def words_and_interval(words: str) -> str:
    """A cell of "VALUE [LOW, HIGH]", the interval small."""
    value, _, interval = words.partition(" [")
    low_high = interval.rstrip("]").replace(", ", " to ")
    return escape(value) + (f"<small>{escape(low_high)}</small>" if interval else "")


def number(value: float) -> str:
    """A number to three digits."""
    if not math.isfinite(value):
        return "&ndash;"
    if value == 0 or abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"


def figure_text(figure: Figure, unit: str = "") -> str:
    value = f"{number(figure.value)} {escape(unit)}".rstrip()
    if not math.isfinite(figure.low):
        return value
    return f"{value}<small>{number(figure.low)} to {number(figure.high)}</small>"


def steps_words(step: int) -> str:
    return f"{step:,} step{'s'[: step != 1]}"


def named(arm: str, motion: str) -> str:
    return f"{arm}, true motion" if motion == TRUE else arm


def table_of(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of HTML cells; the first column is text, the others numbers aligned right."""

    plain = [re.sub(r"<[^>]+>", " ", head).strip() for head in heads]  # for phones, where each cell has its own

    def cells(tag: str, row: Sequence[str]) -> str:
        named = [
            f' class=n data-head="{plain[place]}"' if place and tag == "td" else " class=n" for place in range(len(row))
        ]
        return "".join(f"<{tag}{named[place] if place else ''}>{cell}</{tag}>" for place, cell in enumerate(row))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{cells('th', heads)}</tr></thead><tbody>{body}</tbody></table></div>"


def figure_table(rows: Sequence[Row], dt_s: float, open_: bool = True) -> str:
    """A table for each place: a row for each figure and arm, a column for each horizon, baselines below each figure."""
    tables = ""
    for place in dict.fromkeys(row.place for row in rows):
        mine = [row for row in rows if row.place == place]
        steps = sorted({row.horizon for row in mine})
        lines = []
        for kind in dict.fromkeys((row.channel, row.what, row.unit, row.arm, row.motion) for row in mine):
            by_step = {
                row.horizon: row for row in mine if kind == (row.channel, row.what, row.unit, row.arm, row.motion)
            }
            channel, what, unit, arm, motion = kind
            about = [named(arm, motion), *([channel] if channel else [])]
            words = f"{escape(f'{what}, {unit}' if unit else what)}<small>{escape(', '.join(about))}</small>"
            lines.append([words, *(_cell(by_step[step]) if step in by_step else "" for step in steps)])
        heads = [
            escape(place_label(place)),
            *(f"{steps_words(step)}<small>{step * dt_s:.2f} s</small>" for step in steps),
        ]
        inside = table_of(heads, lines)
        folded = f"<details><summary>All figures, {escape(place_label(place))}</summary>{inside}</details>"
        tables += inside if open_ else folded
    return tables


def _cell(row: Row) -> str:
    baselines = "".join(f"<small>{escape(name)} {number(fig.value)}</small>" for name, fig in row.baselines.items())
    note = f"<small>{escape(row.note)}</small>" if row.note else ""
    return ("void" if row.void else figure_text(row.figure)) + baselines + note


def charts_of(card: Scorecard, probe: str) -> str:
    """One chart of all arms for each place and figure; charts of one figure share a scale."""
    curves = [curve for curve in card.curves if curve.probe == probe]
    groups: dict[tuple, list[Curve]] = {}
    for curve in curves:
        groups.setdefault((curve.channel, curve.what, curve.unit), []).append(curve)
    charts: list[str] = []
    for (channel, what, unit), some in groups.items():
        guides, boxes = some[0].guides, ""
        span = y_span([v for c in some for v in (*c.band.value, *c.band.low, *c.band.high)] + list(guides))
        for place in dict.fromkeys(curve.place for curve in some):
            mine = [curve for curve in some if curve.place == place]
            lines = [_line(card, curve) for curve in sorted(mine, key=lambda curve: curve.arm == COPY_LAST)]
            x_label, log = ("coverage in %, most certain first", False) if probe == "calibration" else ("steps", True)
            svg = line_chart(lines, _ticks(mine, log), x_label, f"{what}, {unit}" if unit else what, log, span, guides)
            title = f"{place_label(place)}, {what}" + (f" of {channel}" if channel not in ("", "rgb", "pose") else "")
            boxes += f"<figure><h3>{escape(title)}</h3>{svg}{legend(lines)}</figure>"
        charts.append(boxes)
    alone = len({curve.place for curve in curves}) == 1  # then all charts share one grid
    return "".join(f"<div class=charts>{boxes}</div>" for boxes in (["".join(charts)] if alone else charts))


def _ticks(curves: Sequence[Curve], log: bool) -> list[tuple[float, str]]:
    first, last = min(min(curve.x) for curve in curves), max(max(curve.x) for curve in curves)
    if not log:
        return [(share, f"{share}%") for share in range(0, 101, 25) if first <= share <= last]
    powers = [2**k for k in range(12) if first <= 2**k <= last]
    return [(step, str(step)) for step in (powers if len(powers) < 10 else powers[::2])] or [(first, str(first))]


def _line(card: Scorecard, curve: Curve) -> Line:
    copied = curve.arm == COPY_LAST
    colour = QUIET if copied else COLOURS[list(card.worlds).index(curve.arm.partition(",")[0]) % len(COLOURS)]
    dotted, dashed = copied or curve.arm.endswith("oracle"), curve.motion == TRUE or "chance" in curve.arm
    dash = "2 3" if dotted else "5 4" if dashed else ""
    band = curve.band
    label = named(curve.arm, curve.motion)
    return Line(label, list(curve.x), band.value, band.low, band.high, colour, dash, curve.mark)


def picture_of(picture: Picture) -> str:
    least, most = 116 * len(picture.columns), 160 * len(picture.columns)
    heads = "".join(f"<span>{escape(column)}</span>" for column in picture.columns)
    rows = "".join(f"<h4>{escape(label)}</h4>{_image(frames, label)}" for label, frames in picture.rows.items())
    inside = f'<div style="min-width:{least}px;max-width:{most}px"><div class=columns>{heads}</div>{rows}</div>'
    return f"<div class=strip><h3>{escape(picture.title)}</h3><div class=scroll>{inside}</div></div>"


def film_of(shown: DreamFilm) -> str:
    """A film, the recording above the prediction."""
    height, width = shown.truth.shape[1:3]
    data = base64.b64encode(film([shown.truth, shown.dream], shown.dt_s)).decode()
    return (
        f'<figure class=film style="aspect-ratio:{width}/{2 * height + 4}"><img alt="The recording above, the prediction below" '
        f'src="data:image/webp;base64,{data}"><figcaption><span>truth</span><span>dream</span></figcaption></figure>'
    )


def _image(frames: np.ndarray, label: str) -> str:
    data = base64.b64encode(jpeg(join_row(frames))).decode()
    return f'<img alt="{escape(label)}" src="data:image/jpeg;base64,{data}">'
