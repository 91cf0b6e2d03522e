"""One self-contained HTML page of a scorecard: a film and the verdict, pictures, and behind a fold all figures and the method."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from .page_parts import charts_of, document, figure_table, film_of, number, picture_of, section, steps_words, table_of
from .scorecard import COPY_LAST, Row, Scorecard, place_label
from .verdict import BETTER, WORSE, compared, gain_verdict, good_for, verdict

if TYPE_CHECKING:
    from .exam import Probe


def page(card: Scorecard, title: str, probes: Sequence[Probe]) -> str:
    """Self-contained HTML with styles, SVG and JPEGs, and a section for each probe with results."""
    places = " &middot; ".join(
        f"{place.clips} {escape(place_label(place.name))} ({place.moving_share:.0%} moving)" for place in card.places
    )
    worlds = " &middot; ".join(f"{escape(arm)}: {escape(name)}" for arm, name in card.worlds.items())
    figures = [_gains(card), *(_section(card, probe) for probe in probes), _missing(card), _method(card)]
    about = f"<p>{places}</p><p>{worlds}</p>"
    summary = "<summary>More: all figures, and how they were measured</summary>"
    more = f"<details class=more>{summary}{about}{''.join(figures)}</details>"
    return document(title, [_hero(card), _pictures(card), more])


def _hero(card: Scorecard) -> str:
    """A film of truth over dream, for how long the world is good, and the verdict."""
    why = "So long its pictures are clearly better than a repeated last picture, with the same actions as in the recording."
    words = good_for(card)
    why = f"<p>{why}</p>" if words.startswith("Good") else ""
    text = f"<div class=good><h2>{escape(words)}</h2>{why}<p>{escape(verdict(card)[0])}</p></div>"
    return f"<section class=hero>{''.join(map(film_of, card.films[:1]))}{text}</section>"


def _pictures(card: Scorecard) -> str:
    shown = "".join(picture_of(picture) for picture in card.pictures if picture.probe == "pixels")
    return section("What it predicts", "The first row is the recording; the others are predicted.", shown)


def _gains(card: Scorecard) -> str:
    """A table of gains over copying the last frame, filled if the whole interval has one sign."""
    rows, lines = compared(card), []
    steps = sorted({row.horizon for row in rows})
    for kind in dict.fromkeys((row.channel, row.what, row.unit, row.place) for row in rows):
        mine = {row.horizon: row for row in rows if (row.channel, row.what, row.unit, row.place) == kind}
        unit = f", {kind[2]}" if kind[2] else ""
        about = f"{escape(f'{kind[0]} {kind[1]}{unit}')}<small>{escape(place_label(kind[3]))}</small>"
        lines.append([about, *(_gain(mine[step]) if step in mine else "" for step in steps)])
    heads = ["gain over copying the last frame", *(steps_words(step) for step in steps)]
    return section("Gain over copying the last frame", "", table_of(heads, lines) if lines else "")


def _gain(row: Row) -> str:
    judgement = gain_verdict(row.gain)
    kind = {BETTER: "met", WORSE: "missed"}.get(judgement, "void")
    text = number(abs(row.gain.value)) if row.gain else ""
    sign = "" if row.gain is None else "\u2212" if row.gain.value < 0 else "+"
    beside = f"<small>{number(row.figure.value)}; copied {number(row.baselines[COPY_LAST].value)}</small>"
    return f"<span class='status {kind}' title='{judgement}'>{sign}{text}</span>{beside}"


def _section(card: Scorecard, probe: Probe) -> str:
    rows = [row for row in card.rows if row.probe == probe.name]
    control = [row for row in card.rows if row.probe == "control"] if probe.name == "drift" else []
    pictures = "".join(
        picture_of(picture) for picture in card.pictures if picture.probe == probe.name and probe.name != "pixels"
    )
    charts = charts_of(card, probe.name)
    inside = charts + pictures + figure_table(rows, card.dt_s, open_=not charts)
    whole = section(probe.question, escape(probe.lead), inside)
    if not control:
        return whole
    lead = "The gain in accuracy of rollouts under the true actions over rollouts under other actions, clip by clip."
    return section("Does it follow actions?", lead, figure_table(control, card.dt_s)) + whole


def _missing(card: Scorecard) -> str:
    if not card.missing:
        return ""
    lines = "".join(f"<li>{escape(gone.probe)}, {escape(gone.arm)}: {escape(gone.why)}</li>" for gone in card.missing)
    return section("Not applicable", "Probes that were skipped, and what they need.", f"<ul>{lines}</ul>")


def _method(card: Scorecard) -> str:
    shown = {f"<li class={row.probe}>" for row in card.rows} | {
        "<ul>",
        "</ul>",
        "<li>",
    }  # only probes that were measured
    lines = (Path(__file__).parent / "method.html").read_text(encoding="utf-8").splitlines()
    text = "".join(line for line in lines if line[: line.index(">") + 1] in shown)
    context = card.places[0].context if card.places else 0
    filled = text.format(context=context, dt_ms=card.dt_s * 1e3, rate=1 / card.dt_s)
    return f"<section><h2>How this was measured</h2>{filled}</section>"
