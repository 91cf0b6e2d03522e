"""The page's sections on likeness: how near dreams are to the truth, how sharp, for how long, and what they look like."""

from __future__ import annotations

import math
from html import escape

from .drift import Drift
from .page_parts import (
    QUIET,
    charts_of,
    colour_of,
    figure_box,
    figure_text,
    named,
    picture_of,
    points_line,
    section,
    steps_text,
    table_of,
    values,
)
from .plot import Line, line_chart, y_span
from .roll import PREDICTED
from .scorecard import Scorecard
from .statistics import Figure


def strips(card: Scorecard) -> str:
    lead = "The first column is the last frame that was shown to the world; everything to its right is dreamt."
    return section("Truth against dream", lead, "".join(map(picture_of, card.pictures)))


def psnr(card: Scorecard) -> str:
    tables = "".join(_fidelity_table(card, place.name) for place in card.places)
    lead = (
        "How close each dreamt frame is to the recorded one. "
        "The grey line only repeats the last frame that was shown; shades are 95% intervals."
    )
    return section("Likeness over time", lead, charts_of(card, "psnr", "PSNR, dB") + tables)


def _fidelity_table(card: Scorecard, place: str) -> str:
    kinds = [("PSNR", "psnr"), ("gain over copy last", "gain"), ("SSIM", "ssim"), ("sharpness", "sharpness")]
    kinds += [("Frechet distance", "frechet")] if card.looks else []
    found = sorted((row for row in card.fidelity if row.place == place), key=lambda row: row.horizon)
    if not found:
        return ""
    rows = []
    for arm, motion in dict.fromkeys((row.arm, row.motion) for row in found):
        mine = [row for row in found if (row.arm, row.motion) == (arm, motion)]
        name = escape(f"{arm}, {motion} motion")
        rows += [
            [f"{name}<small>{label}</small>", *(figure_text(getattr(row, kind)) for row in mine)]
            for label, kind in kinds
        ]
    rows.append(["copy last<small>PSNR</small>", *(figure_text(row.copy_last) for row in mine)])
    table = table_of(["steps", *(steps_text(row.horizon, row.seconds) for row in mine)], rows)
    return f"<details><summary>All figures, {escape(place)} places</summary>{table}</details>"


def sharpness(card: Scorecard) -> str:
    charts = charts_of(card, "sharpness", "gradient energy, dream / game", (0.7, 1.0, 1.3))
    lead = "Gradient energy of the dreams over the game's: below 1 is blurred, above 1 too rough. Dotted: 0.7, 1, 1.3."
    return section("Sharpness over time", lead, charts)


def drift(card: Scorecard) -> str:
    """PSNR and sharpness at every step of the long clips, each line ending in its name, and how far each can be used."""
    if not card.drifts:
        return ""
    drifts = list({(row.place, row.arm, row.motion): row for row in card.drifts}.values())  # cards are merged
    ordered = sorted(drifts, key=lambda row: row.motion == "")  # copy-last is drawn last
    steps = max(row.steps for row in ordered)
    ticks = [(2**k, str(2**k)) for k in range(steps.bit_length())]
    inside = ""
    for what, label, guides in (
        ("psnr", "PSNR, dB", ()),
        ("sharpness", "gradient energy, dream / game", (0.7, 1.0, 1.3)),
    ):
        bands = [
            getattr(row, what) for row in ordered if row.motion or what == "psnr"
        ]  # still frames may be very rough
        span = y_span([v for band in bands for v in (values(band) if what == "psnr" else band.value)] + list(guides))
        for place in dict.fromkeys(row.place for row in ordered):
            lines = [_drift_line(card, row, what) for row in ordered if row.place == place]
            svg = line_chart(lines, ticks, "steps", label, True, span, guides, named=True)
            inside += f"<figure class=wide><h3>{escape(place)} places, {label.partition(',')[0]}</h3>"
            inside += f"<div class=scroll>{svg}</div></figure>"
    rows = []
    for row in drifts:
        name = f"{escape(named(row.arm, row.motion))}<small>{escape(row.place)} places, {row.psnr.count} clips</small>"
        rows.append([name, _steps_within(row.usable, row), _steps_within(row.usable_shared, row)])
    heads = ("arm", "twice its own first error", "twice copy-last's")
    lead = (
        f"The same over {steps:,} steps ({drifts[0].seconds:.1f} s), on clips long enough for that. A dot marks how far a "
        "dream can be used: the last step up to which its error stays within twice that of its own first step, which is "
        "where the curve has fallen by 3 dB. The table adds the same from copy-last's first step, one yardstick for all."
    )
    return section("Drift", lead, inside + table_of(heads, rows))


def _drift_line(card: Scorecard, row: Drift, what: str) -> Line:
    band, mark = getattr(row, what), int(row.usable.value) if what == "psnr" else None
    dash = "" if row.motion == PREDICTED else "5 4" if row.motion else "2 3"
    steps, colour = list(range(1, row.steps + 1)), colour_of(card, row.arm)
    return Line(named(row.arm, row.motion), steps, band.value, band.low, band.high, colour, dash, mark)


def _steps_within(figure: Figure, row: Drift) -> str:
    words = (
        f"all {row.steps} steps" if figure.value >= row.steps else f"{figure.value:.0f} step{'s'[: figure.value != 1]}"
    )
    if not math.isfinite(figure.low):
        return words
    return f"{words}<small>{figure.low:.0f} to {figure.high:.0f}</small>"


def looks(card: Scorecard) -> str:
    """Frechet distances against horizon, each place by itself, with what real and blurred frames would get."""
    if not card.looks:
        return ""
    boxes, every = [], []
    for place in card.places:
        found = [row for row in card.fidelity if row.place == place.name and row.frechet is not None]
        looks = list({row.horizon: row for row in card.looks if row.place == place.name}.values())  # cards are merged
        if not looks:
            continue
        lines = []
        for arm, motion in dict.fromkeys((row.arm, row.motion) for row in found):
            mine = [row for row in found if (row.arm, row.motion) == (arm, motion)]
            dash = "" if motion == PREDICTED else "5 4"
            points = [(row.horizon, row.frechet) for row in mine if row.frechet is not None]
            lines.append(points_line(f"{arm}, {motion} motion", points, colour_of(card, arm), dash))
        lines.append(points_line("real frames (copy last)", [(r.horizon, r.copy_last) for r in looks], QUIET, "2 3"))
        lines.append(points_line("the game blurred by 1 pixel", [(r.horizon, r.blurred) for r in looks], QUIET, "7 3"))
        every += [value for line in lines for value in (*line.y, *line.low, *line.high)]
        boxes.append((place.name, lines))
    steps = [(step, str(step)) for step in sorted({row.horizon for row in card.looks})]
    span, charts = y_span(every), ""
    for name, lines in boxes:
        svg = line_chart(lines, steps, "steps", "Frechet distance of looks", True, span)
        charts += figure_box(f"{name} places", svg, lines)
    lead = (
        "How far the dreams, all together, look from the game, in the features of a fixed encoder: 0 is alike, and blur "
        "does not help. It asks only whether a picture could be the game's, not whether it is the right one."
    )
    return section("Looks over time", lead, f"<div class=charts>{charts}</div>")
