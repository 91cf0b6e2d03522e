"""One self-contained HTML page of a scorecard: bars, curves, strips of truth against dream, and how it was measured."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from .bars import Bar, summary
from .page_conduct import closures, control, endurance, fates, position, risk
from .page_likeness import drift, looks, psnr, sharpness, strips
from .page_parts import figure_text, section, table_of
from .roll import PREDICTED
from .scorecard import Scorecard

_HERE = Path(__file__).parent


def page(card: Scorecard, bars: Sequence[Bar], title: str) -> str:
    """HTML that needs nothing from outside: styles, SVG and JPEGs are inside it."""
    style = (_HERE / "page.css").read_text(encoding="utf-8")
    sections = [
        _bars(bars),
        strips(card),
        psnr(card),
        sharpness(card),
        drift(card),
        risk(card),
        fates(card),
        looks(card),
        control(card),
        position(card),
    ]
    sections += [closures(card), endurance(card), _speeds(card), _method(card)]
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
    return section("Bars", lead[0].upper() + lead[1:], inside)


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
            f"<td class=n>{figure_text(bar.figure, unit=bar.unit)}</td><td class=n>{escape(bar.target)}</td>"
            f"<td><span class='status {kind}'>{bar.status}</span></td></tr>"
        )
    head = "<tr><th>bar</th><th class=n>measured</th><th class=n>target</th><th></th></tr>"
    return f"<table class=bars><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _speeds(card: Scorecard) -> str:
    if not card.speeds:
        return ""
    rows = []
    for run in card.speeds:
        times = [f"{value:.1f}" for value in (run.median_ms, run.p95_ms, run.first_ms, run.last_ms)]
        rows.append([escape(run.arm), *times, f"{run.growth:+.1%}", str(run.threads)])
    heads = ("arm", "median", "95%", "first tenth", "last tenth", "growth", "threads")
    lead = f"Milliseconds for one imagined and drawn step of one story, over {card.speeds[0].steps:,} steps on end."
    return section("Speed", lead, table_of(heads, rows))


def _method(card: Scorecard) -> str:
    text = (_HERE / "method.html").read_text(encoding="utf-8")
    context = card.places[0].context if card.places else 0
    filled = text.format(context=context, dt_ms=card.dt_s * 1e3, rate=1 / card.dt_s)
    return f"<section><h2>How this was measured</h2>{filled}</section>"
