"""The page's sections on conduct: whether dreams obey, where they lead, what they pay, what they remember and admit."""

from __future__ import annotations

import math
from html import escape

from .closure import Closure
from .page_parts import (
    charts_of,
    colour_of,
    figure_box,
    figure_text,
    hundredths,
    named,
    percent,
    picture_of,
    section,
    steps_text,
    table_of,
)
from .plot import Line, line_chart
from .roll import PREDICTED
from .scorecard import Picture, Scorecard
from .statistics import Figure


def control(card: Scorecard) -> str:
    rows = []
    for row in card.control:
        figures = [figure_text(figure) for figure in (row.difference, row.true_actions, row.other_actions)]
        rows.append([escape(f"{row.place}, {row.arm}"), steps_text(row.horizon, row.seconds), *figures])
    heads = ("places, arm", "steps", "difference", "true actions", "another's")
    lead = "PSNR in dB when the world is given the player's own actions, and when it is given those of another clip."
    return section("Does it obey?", lead, table_of(heads, rows) if rows else "")


def position(card: Scorecard) -> str:
    charts = charts_of(card, "position", "distance from the true place, m")
    rows = []
    for row in card.position:
        figures = [percent(row.mean_share), percent(row.median_share), figure_text(row.heading_deg)]
        rows.append([escape(f"{row.place}, {row.arm}"), steps_text(row.horizon, row.seconds), *figures])
    heads = ("places, arm", "steps", "mean, %", "median, %", "heading, degrees")
    lead = (
        "Where the world believes the player to be under the true actions; "
        "the table gives it as a share of the distance walked."
    )
    return section("Position", lead, charts + (table_of(heads, rows) if rows else ""))


def risk(card: Scorecard) -> str:
    """Risk-coverage curves of the arms, with the oracle's, and what the uncertainty is worth."""
    if not card.risks:
        return ""
    inside, ticks = "", [(k / 4, f"{25 * k}%") for k in range(5)]
    for place in dict.fromkeys(row.place for row in card.risks):
        rows = [row for row in card.risks if row.place == place and row.motion == PREDICTED]
        lines = []
        for row in rows:
            colour, x, chance = colour_of(card, row.arm), row.coverage, [row.random.value] * len(row.coverage)
            for name, y, dash in (
                ("its own order", row.risk, ""),
                ("an oracle", row.best, "2 3"),
                ("chance", chance, "5 4"),
            ):
                lines.append(Line(f"{row.arm}, {name}", x, y, y, y, colour, dash))
        if lines:
            svg = line_chart(lines, ticks, "share of the frames kept, the surest first", "mean error of those")
            heading = "all places together" if place == "all" else f"{place} places"
            inside += figure_box(heading, svg, lines)
    rows = []
    for row in card.risks:
        name = f"{escape(named(row.arm, row.motion))}<small>{escape(row.place)} places, {row.aurc.count} clips</small>"
        found = f"{100 * row.closed.value:.0f}%<small>{100 * row.closed.low:.0f} to {100 * row.closed.high:.0f}</small>"
        areas = [hundredths(row.aurc), hundredths(row.random), hundredths(row.oracle)]
        rows.append([name, *areas, found, hundredths(row.expected), hundredths(row.off)])
    heads = ("arm", "area under the curve", "by chance", "by an oracle", "of the way to it", "error expected", "off")
    lead = (
        "Each frame comes with the error that the world expects of it. If the least certain frames are set aside, how large is "
        "the mean absolute error of the rest (in % of full brightness)? Solid: by the world's own uncertainty; dotted: by an "
        "oracle that knows the errors; dashed: by chance, which is also the mean error found, beside the error expected. "
        "<i>Off</i> is the mean distance of both in eight equal bins."
    )
    return section("Does it know when it invents?", lead, f"<div class=charts>{inside}</div>{table_of(heads, rows)}")


def fates(card: Scorecard) -> str:
    """A table of what dreams tell of rewards, vitals and ends."""
    if not card.fates:
        return ""
    vitals = list(dict.fromkeys(name for row in card.fates for name in row.vitals))
    heads = ["arm", "reward", "that it pays", "it ends", *vitals]
    rows = []
    for row in card.fates:
        name = (
            f"{escape(row.arm)}<small>{escape(row.place)} places, {row.horizon} step{'s'[: row.horizon == 1]}</small>"
        )
        cells = [f"{row.reward.value:.3g}<small>{row.reward_usual.value:.3g} by the usual</small>"]
        for share, count in ((row.reward_auc, row.paid), (row.done_auc, row.ended)):
            found = f"{share:.2f}" if math.isfinite(share) else "-"
            cells.append(f"{found}<small>{count} of {row.reward.count} clips</small>")
        for vital in vitals:
            if vital not in row.vitals:  # recorded elsewhere alone
                cells.append("-")
                continue
            error, copied = row.vitals[vital], row.vitals_copied[vital]
            cells.append(f"{error.value:.3g}<small>{copied.value:.3g} by a copy</small>")
        rows.append([name, *cells])
    lead = (
        "What dreams tell of rewards, vitals and ends: the mean absolute error of the reward summed over the steps, beside "
        "that of always paying the usual; how well the dreamt sum tells clips that paid more, and the dream's end tells clips "
        "that ended (area under the ROC curve: 1 always, 0.5 by chance); the error of each vital, beside leaving it as it was. "
        "Half of the stretches are taken from shortly before an end, where there are ends."
    )
    return section("What it pays and costs", lead, table_of(heads, rows))


def closures(card: Scorecard) -> str:
    if not card.closures:
        return ""
    arms = list(dict.fromkeys(done.arm for done in card.closures))
    rows, parts = [], []
    for way, place in dict.fromkeys((done.way, done.place) for done in card.closures):
        found = {done.arm: done for done in card.closures if (done.way, done.place) == (way, place)}
        name = f"{escape(way)}<small>{escape(place)} places</small>"
        rows.append([name, *(_closed(found[arm]) if arm in found else "" for arm in arms)])
        first = next(iter(found.values()))
        ends = (
            (f"{first.far_deg:.0f}\N{DEGREE SIGN}", f"{first.far_m:.1f} m")
            if first.far_deg
            else (f"{first.far_m:.1f} m",)
        )
        columns = ["first", "on the way", f"far, {ends[0]}", "on the way back", "back", "far again"]
        strips = {f"{arm}: {_closed_words(done)}": done.picture for arm, done in found.items()}
        parts.append(picture_of(Picture(f"{way}, {place} places", columns, strips)))
    lead = (
        "The camera goes away and back in small steps, and away once more. Back again, the picture should be the first one "
        "(PSNR, dB); below it: the far view, which the world drew itself, seen a second time against the first time. Where the "
        "view never changed on the way, that proves nothing and is called void."
    )
    return section("Does it remember?", lead, table_of(("there and back", *map(escape, arms)), rows) + "".join(parts))


def _closed(done: Closure) -> str:
    if done.void:
        return "void"
    inside = f"<small>{done.closed.low:.1f} to {done.closed.high:.1f}</small>" if math.isfinite(done.closed.low) else ""
    return f"{done.closed.value:.1f}{inside}<small>far again {_again(done)}</small>"


def _again(done: Closure) -> str:
    return "void" if done.void_again else f"{done.again.value:.1f}"


def _closed_words(done: Closure) -> str:
    if done.void:
        return f"void, the far view is not different ({done.far.value:.1f} dB)"
    far = f"the far view against the first: {done.far.value:.1f} dB, against itself when seen again: {_again(done)} dB"
    return f"closes at {done.closed.value:.1f} dB; {far}"


def endurance(card: Scorecard) -> str:
    if not card.endurance:
        return ""
    first = card.endurance[0]
    boxes = []
    for name, pick in (("sharpness", _sharp_of), ("brightness", _bright_of), ("contrast", _contrast_of)):
        lines = []
        for run in card.endurance:
            band = [pick(bucket) for bucket in run.buckets]
            y, low, high = ([getattr(figure, key) for figure in band] for key in ("value", "low", "high"))
            lines.append(Line(run.arm, [bucket.last for bucket in run.buckets], y, low, high, colour_of(card, run.arm)))
        ticks = [(x, f"{x:g}") for x in sorted({lines[0].x[0], first.steps // 2, first.steps})]
        svg = line_chart(lines, ticks, "steps", "dream / game", guides=(0.7, 1.0, 1.3))
        boxes.append(figure_box(name, svg, lines))
    pictures = ""
    for run in card.endurance:
        columns = ["1", *(str(bucket.last) for bucket in run.buckets)]
        pictures += picture_of(Picture(f"{run.arm}: one story, by steps", columns, {run.arm: run.picture}))
    low, high = first.natural
    lead = escape(
        f"{first.stories} dreams of {first.steps:,} steps on end, by stretches, each frame against {first.reference}; "
        f"brightness and contrast are those of green. As many real stretches of that length stray to {low:.2f} to "
        f"{high:.2f} in sharpness and to {first.natural_colour[0]:.2f} to {first.natural_colour[1]:.2f} in a colour "
        "statistic by themselves."
    )
    return section("A long dream", lead, f"<div class=charts>{''.join(boxes)}</div>{pictures}")


def _sharp_of(bucket) -> Figure:
    return bucket.sharpness


def _bright_of(bucket) -> Figure:
    return bucket.colour_mean[1]


def _contrast_of(bucket) -> Figure:
    return bucket.colour_std[1]
