"""One self-contained HTML page of a scorecard: bars, curves, strips of truth against dream, and how it was measured."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from .bars import Bar, summary
from .closure import Closure
from .drift import COPY_LAST, Drift
from .plot import Line, line_chart, y_span
from .roll import PREDICTED
from .scorecard import Curve, Picture, Scorecard
from .statistics import Band, Figure
from .strip import join_row, jpeg

COLOURS = ("#6fd3c1", "#e3a857", "#8ea6ff", "#e07a9b", "#b6d36f")
_QUIET = "#8b93a3"
_HERE = Path(__file__).parent


def page(card: Scorecard, bars: Sequence[Bar], title: str) -> str:
    """HTML that needs nothing from outside: styles, SVG and JPEGs are inside it."""
    style = (_HERE / "page.css").read_text(encoding="utf-8")
    sections = [
        _bars(bars),
        _strips(card),
        _psnr(card),
        _sharpness(card),
        _drift(card),
        _risk(card),
        _fates(card),
        _looks(card),
        _control(card),
        _position(card),
    ]
    sections += [_closures(card), _endurance(card), _speeds(card), _method(card)]
    places = " &middot; ".join(
        f"{place.clips} clips of {escape(place.name)} places ({place.moving_share:.0%} moving)" for place in card.places
    )
    worlds = " &middot; ".join(f"{escape(arm)}: {escape(name)}" for arm, name in card.worlds.items())
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><meta name="color-scheme" content="dark">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><header><h1>{escape(title)}</h1>"
        f"<p>{places}</p><p>{worlds}</p></header><main>{''.join(sections)}</main></body></html>\n"
    )


def _section(heading: str, lead: str, inside: str) -> str:
    return f"<section><h2>{escape(heading)}</h2><p>{lead}</p>{inside}</section>" if inside else ""


def _bars(bars: Sequence[Bar]) -> str:
    if not bars:
        return ""
    mine = [bar for bar in bars if not bar.side and (bar.motion == PREDICTED or bar.name.startswith("closure"))]
    others = {
        "The same pictures at the true poses": [bar for bar in bars if not bar.side and bar not in mine],
        "Over the same seconds as 8 and 32 steps at frame-skip 4": [bar for bar in bars if bar.side],
    }
    inside = _bar_table(mine)
    for heading, rest in others.items():
        inside += f"<details><summary>{heading}</summary>{_bar_table(rest)}</details>" if rest else ""
    lead = f"{summary(mine)}. An outlined status means that the 95% interval reaches over the target."
    return _section("Bars", lead[0].upper() + lead[1:], inside)


def _bar_table(bars: Sequence[Bar]) -> str:
    rows = []
    for bar in bars:
        where = [f"{bar.place} places", "motion given" if bar.motion == "true" else "motion predicted"]
        if bar.horizon and bar.seconds is not None:
            where.append(f"{bar.horizon:,} steps, {bar.seconds:.2f} s")
        words = [escape(" \N{MIDDLE DOT} ".join(where)), *([escape(bar.note)] if bar.note else [])]
        kind = bar.status.replace(" ", "-") + ("" if bar.sure else " unsure")
        rows.append(
            f"<tr><td>{escape(bar.name[0].upper() + bar.name[1:])}{''.join(f'<small>{line}</small>' for line in words)}</td>"
            f"<td class=n>{_figure(bar.figure, unit=bar.unit)}</td><td class=n>{escape(bar.target)}</td>"
            f"<td><span class='status {kind}'>{bar.status}</span></td></tr>"
        )
    head = "<tr><th>bar</th><th class=n>measured</th><th class=n>target</th><th></th></tr>"
    return f"<table class=bars><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _figure(figure: Figure | None, digits: int = 2, unit: str = "") -> str:
    if figure is None or not math.isfinite(figure.value):
        return "&ndash;"
    value = f"{figure.value:.{digits}f} {escape(unit)}".rstrip()
    if not math.isfinite(figure.low):
        return value
    return f"{value}<small>{figure.low:.{digits}f} to {figure.high:.{digits}f}</small>"


def _psnr(card: Scorecard) -> str:
    tables = "".join(_fidelity_table(card, place.name) for place in card.places)
    lead = (
        "How close each dreamt frame is to the recorded one. "
        "The grey line only repeats the last frame that was shown; shades are 95% intervals."
    )
    return _section("Likeness over time", lead, _charts(card, "psnr", "PSNR, dB") + tables)


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
            [f"{name}<small>{label}</small>", *(_figure(getattr(row, kind)) for row in mine)] for label, kind in kinds
        ]
    rows.append(["copy last<small>PSNR</small>", *(_figure(row.copy_last) for row in mine)])
    table = _table(["steps", *(_steps(row.horizon, row.seconds) for row in mine)], rows)
    return f"<details><summary>All figures, {escape(place)} places</summary>{table}</details>"


def _sharpness(card: Scorecard) -> str:
    charts = _charts(card, "sharpness", "gradient energy, dream / game", (0.7, 1.0, 1.3))
    lead = "Gradient energy of the dreams over the game's: below 1 is blurred, above 1 too rough. Dotted: 0.7, 1, 1.3."
    return _section("Sharpness over time", lead, charts)


def _drift(card: Scorecard) -> str:
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
        span = y_span([v for band in bands for v in (_values(band) if what == "psnr" else band.value)] + list(guides))
        for place in dict.fromkeys(row.place for row in ordered):
            lines = [_drift_line(card, row, what) for row in ordered if row.place == place]
            svg = line_chart(lines, ticks, "steps", label, True, span, guides, named=True)
            inside += f"<figure class=wide><h3>{escape(place)} places, {label.partition(',')[0]}</h3>"
            inside += f"<div class=scroll>{svg}</div></figure>"
    rows = []
    for row in drifts:
        name = f"{escape(_named(row.arm, row.motion))}<small>{escape(row.place)} places, {row.psnr.count} clips</small>"
        rows.append([name, _steps_within(row.usable, row), _steps_within(row.usable_shared, row)])
    heads = ("arm", "twice its own first error", "twice copy-last's")
    lead = (
        f"The same over {steps:,} steps ({drifts[0].seconds:.1f} s), on clips long enough for that. A dot marks how far a "
        "dream can be used: the last step up to which its error stays within twice that of its own first step, which is "
        "where the curve has fallen by 3 dB. The table adds the same from copy-last's first step, one yardstick for all."
    )
    return _section("Drift", lead, inside + _table(heads, rows))


def _drift_line(card: Scorecard, row: Drift, what: str) -> Line:
    band, mark = getattr(row, what), int(row.usable.value) if what == "psnr" else None
    dash = "" if row.motion == PREDICTED else "5 4" if row.motion else "2 3"
    steps, colour = list(range(1, row.steps + 1)), _colour(card, row.arm)
    return Line(_named(row.arm, row.motion), steps, band.value, band.low, band.high, colour, dash, mark)


def _risk(card: Scorecard) -> str:
    """Risk-coverage curves of the arms, with the oracle's, and what the uncertainty is worth."""
    if not card.risks:
        return ""
    inside, ticks = "", [(k / 4, f"{25 * k}%") for k in range(5)]
    for place in dict.fromkeys(row.place for row in card.risks):
        rows = [row for row in card.risks if row.place == place and row.motion == PREDICTED]
        lines = []
        for row in rows:
            colour, x, chance = _colour(card, row.arm), row.coverage, [row.random.value] * len(row.coverage)
            for name, y, dash in (
                ("its own order", row.risk, ""),
                ("an oracle", row.best, "2 3"),
                ("chance", chance, "5 4"),
            ):
                lines.append(Line(f"{row.arm}, {name}", x, y, y, y, colour, dash))
        if lines:
            svg = line_chart(lines, ticks, "share of the frames kept, the surest first", "mean error of those")
            heading = "all places together" if place == "all" else f"{place} places"
            inside += _figure_box(heading, svg, lines)
    rows = []
    for row in card.risks:
        name = f"{escape(_named(row.arm, row.motion))}<small>{escape(row.place)} places, {row.aurc.count} clips</small>"
        found = f"{100 * row.closed.value:.0f}%<small>{100 * row.closed.low:.0f} to {100 * row.closed.high:.0f}</small>"
        areas = [_hundredths(row.aurc), _hundredths(row.random), _hundredths(row.oracle)]
        rows.append([name, *areas, found, _hundredths(row.expected), _hundredths(row.off)])
    heads = ("arm", "area under the curve", "by chance", "by an oracle", "of the way to it", "error expected", "off")
    lead = (
        "Each frame comes with the error that the world expects of it. If the least certain frames are set aside, how large is "
        "the mean absolute error of the rest (in % of full brightness)? Solid: by the world's own uncertainty; dotted: by an "
        "oracle that knows the errors; dashed: by chance, which is also the mean error found, beside the error expected. "
        "<i>Off</i> is the mean distance of both in eight equal bins."
    )
    return _section("Does it know when it invents?", lead, f"<div class=charts>{inside}</div>{_table(heads, rows)}")


def _fates(card: Scorecard) -> str:
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
    return _section("What it pays and costs", lead, _table(heads, rows))


def _hundredths(figure: Figure) -> str:
    words = f"{100 * figure.value:.2f}"
    if not math.isfinite(figure.low):
        return words
    return f"{words}<small>{100 * figure.low:.2f} to {100 * figure.high:.2f}</small>"


def _steps_within(figure: Figure, row: Drift) -> str:
    words = (
        f"all {row.steps} steps" if figure.value >= row.steps else f"{figure.value:.0f} step{'s'[: figure.value != 1]}"
    )
    if not math.isfinite(figure.low):
        return words
    return f"{words}<small>{figure.low:.0f} to {figure.high:.0f}</small>"


def _values(band: Band) -> list[float]:
    return [*band.value, *band.low, *band.high]


def _named(arm: str, motion: str) -> str:
    return f"{arm}, {motion} motion" if motion else arm


def _looks(card: Scorecard) -> str:
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
            lines.append(_points_line(f"{arm}, {motion} motion", points, _colour(card, arm), dash))
        lines.append(_points_line("real frames (copy last)", [(r.horizon, r.copy_last) for r in looks], _QUIET, "2 3"))
        lines.append(
            _points_line("the game blurred by 1 pixel", [(r.horizon, r.blurred) for r in looks], _QUIET, "7 3")
        )
        every += [value for line in lines for value in (*line.y, *line.low, *line.high)]
        boxes.append((place.name, lines))
    steps = [(step, str(step)) for step in sorted({row.horizon for row in card.looks})]
    span, charts = y_span(every), ""
    for name, lines in boxes:
        svg = line_chart(lines, steps, "steps", "Frechet distance of looks", True, span)
        charts += _figure_box(f"{name} places", svg, lines)
    lead = (
        "How far the dreams, all together, look from the game, in the features of a fixed encoder: 0 is alike, and blur "
        "does not help. It asks only whether a picture could be the game's, not whether it is the right one."
    )
    return _section("Looks over time", lead, f"<div class=charts>{charts}</div>")


def _points_line(label: str, points: Sequence[tuple[int, Figure]], colour: str, dash: str) -> Line:
    x, figures = [step for step, _ in points], [figure for _, figure in points]
    y, low, high = ([getattr(figure, key) for figure in figures] for key in ("value", "low", "high"))
    return Line(label, x, y, low, high, colour, dash)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """A table of ready-made cells; the first `texts` columns are words, the others numbers set to the right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(f"<{tag}{'' if k < texts else ' class=n'}>{cell}</{tag}>" for k, cell in enumerate(row))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{cells('th', heads)}</tr></thead><tbody>{body}</tbody></table></div>"


def _steps(horizon: int, seconds: float) -> str:
    return f"{horizon}<small>{seconds:.2f} s</small>"


def _control(card: Scorecard) -> str:
    rows = []
    for row in card.control:
        figures = [_figure(figure) for figure in (row.difference, row.true_actions, row.other_actions)]
        rows.append([escape(f"{row.place}, {row.arm}"), _steps(row.horizon, row.seconds), *figures])
    heads = ("places, arm", "steps", "difference", "true actions", "another's")
    lead = "PSNR in dB when the world is given the player's own actions, and when it is given those of another clip."
    return _section("Does it obey?", lead, _table(heads, rows) if rows else "")


def _position(card: Scorecard) -> str:
    charts = _charts(card, "position", "distance from the true place, m")
    rows = []
    for row in card.position:
        figures = [_percent(row.mean_share), _percent(row.median_share), _figure(row.heading_deg)]
        rows.append([escape(f"{row.place}, {row.arm}"), _steps(row.horizon, row.seconds), *figures])
    heads = ("places, arm", "steps", "mean, %", "median, %", "heading, degrees")
    lead = (
        "Where the world believes the player to be under the true actions; "
        "the table gives it as a share of the distance walked."
    )
    return _section("Position", lead, charts + (_table(heads, rows) if rows else ""))


def _percent(figure: Figure) -> str:
    return _figure(Figure(figure.value * 100, figure.low * 100, figure.high * 100, figure.count), 1)


def _endurance(card: Scorecard) -> str:
    if not card.endurance:
        return ""
    first = card.endurance[0]
    boxes = []
    for name, pick in (("sharpness", _sharp_of), ("brightness", _bright_of), ("contrast", _contrast_of)):
        lines = []
        for run in card.endurance:
            band = [pick(bucket) for bucket in run.buckets]
            y, low, high = ([getattr(figure, key) for figure in band] for key in ("value", "low", "high"))
            lines.append(Line(run.arm, [bucket.last for bucket in run.buckets], y, low, high, _colour(card, run.arm)))
        ticks = [(x, f"{x:g}") for x in sorted({lines[0].x[0], first.steps // 2, first.steps})]
        svg = line_chart(lines, ticks, "steps", "dream / game", guides=(0.7, 1.0, 1.3))
        boxes.append(_figure_box(name, svg, lines))
    pictures = ""
    for run in card.endurance:
        columns = ["1", *(str(bucket.last) for bucket in run.buckets)]
        pictures += _picture(Picture(f"{run.arm}: one story, by steps", columns, {run.arm: run.picture}))
    low, high = first.natural
    lead = escape(
        f"{first.stories} dreams of {first.steps:,} steps on end, by stretches, each frame against {first.reference}; "
        f"brightness and contrast are those of green. As many real stretches of that length stray to {low:.2f} to "
        f"{high:.2f} in sharpness and to {first.natural_colour[0]:.2f} to {first.natural_colour[1]:.2f} in a colour "
        "statistic by themselves."
    )
    return _section("A long dream", lead, f"<div class=charts>{''.join(boxes)}</div>{pictures}")


def _sharp_of(bucket) -> Figure:
    return bucket.sharpness


def _bright_of(bucket) -> Figure:
    return bucket.colour_mean[1]


def _contrast_of(bucket) -> Figure:
    return bucket.colour_std[1]


def _strips(card: Scorecard) -> str:
    lead = "The first column is the last frame that was shown to the world; everything to its right is dreamt."
    return _section("Truth against dream", lead, "".join(map(_picture, card.pictures)))


def _closures(card: Scorecard) -> str:
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
        parts.append(_picture(Picture(f"{way}, {place} places", columns, strips)))
    lead = (
        "The camera goes away and back in small steps, and away once more. Back again, the picture should be the first one "
        "(PSNR, dB); below it: the far view, which the world drew itself, seen a second time against the first time. Where the "
        "view never changed on the way, that proves nothing and is called void."
    )
    return _section("Does it remember?", lead, _table(("there and back", *map(escape, arms)), rows) + "".join(parts))


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


def _speeds(card: Scorecard) -> str:
    if not card.speeds:
        return ""
    rows = []
    for run in card.speeds:
        times = [f"{value:.1f}" for value in (run.median_ms, run.p95_ms, run.first_ms, run.last_ms)]
        rows.append([escape(run.arm), *times, f"{run.growth:+.1%}", str(run.threads)])
    heads = ("arm", "median", "95%", "first tenth", "last tenth", "growth", "threads")
    lead = f"Milliseconds for one imagined and drawn step of one story, over {card.speeds[0].steps:,} steps on end."
    return _section("Speed", lead, _table(heads, rows))


def _method(card: Scorecard) -> str:
    text = (_HERE / "method.html").read_text(encoding="utf-8")
    context = card.places[0].context if card.places else 0
    filled = text.format(context=context, dt_ms=card.dt_s * 1e3, rate=1 / card.dt_s)
    return f"<section><h2>How this was measured</h2>{filled}</section>"


def _charts(card: Scorecard, what: str, y_label: str, guides: Sequence[float] = ()) -> str:
    """One chart of every arm and motion for each place, all on one scale."""
    curves = [curve for curve in card.curves if curve.what == what]
    if not curves:
        return ""
    span = y_span([value for curve in curves for value in _values(curve.band)] + list(guides))
    steps = sorted({row.horizon for row in card.fidelity})
    boxes = []
    for place in card.places:
        lines = [_line(card, curve) for curve in curves if curve.place == place.name]
        svg = line_chart(lines, [(s, str(s)) for s in steps], "steps", y_label, True, span, guides)
        boxes.append(_figure_box(f"{place.name} places", svg, lines))
    return f"<div class=charts>{''.join(boxes)}</div>"


def _line(card: Scorecard, curve: Curve) -> Line:
    dash = "" if curve.motion == PREDICTED else "5 4" if curve.motion else "2 3"
    x = list(range(1, len(curve.band.value) + 1))
    return Line(
        _named(curve.arm, curve.motion),
        x,
        curve.band.value,
        curve.band.low,
        curve.band.high,
        _colour(card, curve.arm),
        dash,
    )


def _figure_box(title: str, svg: str, lines: Sequence[Line]) -> str:
    keys = "".join(
        f'<span><svg viewBox="0 0 22 6" class=key><path d="M0 3H22" stroke="{line.colour}" stroke-width="2.5"'
        + (f' stroke-dasharray="{line.dash}"' if line.dash else "")
        + f"/></svg>{escape(line.label)}</span>"
        for line in lines
    )
    return f"<figure><h3>{escape(title)}</h3>{svg}<figcaption>{keys}</figcaption></figure>"


def _colour(card: Scorecard, arm: str) -> str:
    return _QUIET if arm == COPY_LAST else COLOURS[list(card.worlds).index(arm) % len(COLOURS)]


def _picture(picture: Picture) -> str:
    least, most = 116 * len(picture.columns), 160 * len(picture.columns)
    heads = "".join(f"<span>{escape(column)}</span>" for column in picture.columns)
    rows = "".join(f"<h4>{escape(label)}</h4>{_image(frames, label)}" for label, frames in picture.rows.items())
    inside = f'<div style="min-width:{least}px;max-width:{most}px"><div class=columns>{heads}</div>{rows}</div>'
    return f"<div class=strip><h3>{escape(picture.title)}</h3><div class=scroll>{inside}</div></div>"


def _image(frames: np.ndarray, label: str) -> str:
    data = base64.b64encode(jpeg(join_row(frames))).decode()
    return f'<img alt="{escape(label)}" src="data:image/jpeg;base64,{data}">'
