"""The bars of the bundled Doom world: each figure beside its target, met or missed or void or not measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .roll import PREDICTED
from .scorecard import Fidelity, Scorecard
from .statistics import Figure

MET, MISSED, VOID, UNMEASURED = "met", "missed", "void", "not measured"
FRAME_SKIP = 4  # published Doom worlds step four tics at once; these step one, so 32 steps last as long as their 8


@dataclass(frozen=True)
class Bar:
    """status goes by the figure itself; `sure` says that its whole 95% interval lies on the same side of the target.
    side: bars that restate another over the same seconds as at frame-skip 4, for comparison only."""

    name: str
    place: str
    motion: str
    horizon: int | None
    seconds: float | None
    target: str
    unit: str
    figure: Figure | None
    status: str
    sure: bool
    side: bool = False
    note: str = ""


def bars(card: Scorecard, arm: str) -> list[Bar]:
    """The bars of the doom-maze world for one arm, from whatever the card holds; what it lacks is "not measured"."""
    found: list[Bar] = []
    for motion in _motions(card, arm):
        found += _fidelity_bars(card, arm, motion)
    for place in ("recorded", "new"):
        for step, target, side in ((8, 3.0, False), (32, 3.0, True)):
            found.append(_control_bar(card, arm, place, step, target, side))
        found.append(_obeys_bar(card, arm, place))
        found.append(_position_bar(card, arm, place))
    for place in ("recorded", "new"):
        found += _closure_bars(card, arm, place)
    return found + _endurance_bars(card, arm)


def _motions(card: Scorecard, arm: str) -> list[str]:
    seen = {row.motion for row in card.fidelity if row.arm == arm}
    return [PREDICTED, *sorted(seen - {PREDICTED})]


def _fidelity_bars(card: Scorecard, arm: str, motion: str) -> list[Bar]:
    wanted = [("recorded", 8, 26.0, False), ("recorded", 32, 26.0, True), ("new", 8, 23.0, False)]
    wanted += [("new", 32, 23.0, True), ("new", 32, 20.0, False), ("new", 128, 20.0, True)]
    found = []
    for place, step, target, side in wanted:
        rows = [r for r in card.fidelity if (r.place, r.arm, r.motion, r.horizon) == (place, arm, motion, step)]
        figure = rows[0].psnr if rows else None
        found.append(_at_least("PSNR", place, motion, step, card.dt_s, target, "dB", figure, side))
    key = ("recorded", arm, motion, 8, 64)
    drops = [row for row in card.drops if (row.place, row.arm, row.motion, row.first, row.last) == key]
    figure = drops[0].loss if drops else None
    name, target = "PSNR lost from 8 to 64 steps", "\u2264 1 dB"
    found.append(_bar(name, "recorded", motion, 64, card.dt_s, target, "dB", figure, -math.inf, 1.0))
    for place in ("recorded", "new"):
        rows = [row for row in card.fidelity if (row.place, row.arm, row.motion) == (place, arm, motion)]
        worst = max(rows, key=lambda row: _distance(row.sharpness.value), default=None)
        step, figure = (worst.horizon, worst.sharpness) if worst else (None, None)
        name = "sharpness against the game's, worst horizon"
        found.append(_bar(name, place, motion, step, card.dt_s, "0.7 to 1.3", "\u00d7", figure, 0.7, 1.3))
        if card.looks:  # frames may be too small for the encoder
            found.append(_looks_bar(card, place, motion, rows))
    return found


def _looks_bar(card: Scorecard, place: str, motion: str, rows: Sequence[Fidelity]) -> Bar:
    """The Frechet distance as a share of that of the game's own frames blurred by one pixel; the worst horizon."""
    soft = {looks.horizon: looks.blurred.value for looks in card.looks if looks.place == place}
    shares = {
        row.horizon: _scaled(row.frechet, 1 / soft[row.horizon])
        for row in rows
        if row.frechet is not None and soft.get(row.horizon, 0.0) > 0
    }
    step = max(shares, key=lambda horizon: shares[horizon].value, default=None)
    name, target = "Frechet distance over that of the game blurred by one pixel, worst horizon", "\u2264 1"
    figure = None if step is None else shares[step]
    return _bar(name, place, motion, step, card.dt_s, target, "\u00d7", figure, -math.inf, 1.0)


def _control_bar(card: Scorecard, arm: str, place: str, step: int, target: float, side: bool) -> Bar:
    rows = [row for row in card.control if (row.place, row.arm, row.horizon) == (place, arm, step)]
    figure = rows[0].difference if rows else None
    name = "PSNR, true minus another player's actions"
    return _at_least(name, place, PREDICTED, step, card.dt_s, target, "dB", figure, side)


def _obeys_bar(card: Scorecard, arm: str, place: str) -> Bar:
    """At 32 steps the difference must be clearly positive: the whole interval above zero."""
    rows = [row for row in card.control if (row.place, row.arm, row.horizon) == (place, arm, 32)]
    figure = rows[0].difference if rows else None
    clear = figure is not None and figure.low > 0
    status = UNMEASURED if figure is None else MET if clear else MISSED
    name = "obeys the keys: true minus another's actions, whole interval"
    return Bar(name, place, PREDICTED, 32, 32 * card.dt_s, "> 0 dB", "dB", figure, status, clear)


def _position_bar(card: Scorecard, arm: str, place: str) -> Bar:
    rows = [row for row in card.position if (row.place, row.arm, row.horizon) == (place, arm, 64)]
    note, figure = "", None
    if rows:
        figure = _scaled(rows[0].mean_share, 100)
        note = f"median {rows[0].median_share.value:.1%}, heading off by {rows[0].heading_deg.value:.1f} degrees"
    name = "predicted position error over distance walked, mean"
    return _bar(name, place, PREDICTED, 64, card.dt_s, "\u2264 5 %", "%", figure, -math.inf, 5.0, note=note)


def _closure_bars(card: Scorecard, arm: str, place: str) -> list[Bar]:
    """Each way there and back that was gone; at least those along poses."""
    rows = {row.way: row for row in card.closures if (row.arm, row.place) == (arm, place)}
    found = []
    asked = () if any(row.acted for row in rows.values()) else ("yaw 0-180-0", "yaw 0-90-0")  # where poses move the eye
    for way in dict.fromkeys((*asked, *rows)):
        name, least, row = f"closure of {way}", 27.0 if way == "yaw 0-180-0" else 25.0, rows.get(way)
        target = f"\u2265 {least:g} dB"
        if row is None:
            found.append(_bar(name, place, "true", None, card.dt_s, target, "dB", None, least, math.inf))
            continue
        motion = PREDICTED if row.acted else "true"
        far = f"{row.far_m:.1f} m away, the far view" if row.far_m > 0.1 else "far view"
        note = f"{far} against the first: {row.far.value:.1f} dB; it seen again: {row.again.value:.1f} dB"
        if row.void:
            note += ", not different enough: the picture hardly changed, so closure proves nothing"
            found.append(Bar(name, place, motion, row.steps, None, target, "dB", row.closed, VOID, False, note=note))
        else:
            bar = _bar(name, place, motion, row.steps, None, target, "dB", row.closed, least, math.inf, note=note)
            found.append(bar)
    return found


def _endurance_bars(card: Scorecard, arm: str) -> list[Bar]:
    runs = [run for run in card.endurance if run.arm == arm]
    worst: dict[str, Figure | None] = {"sharpness": None, "colour statistics": None}
    steps, notes = 1000, ["", ""]
    if runs:
        run = runs[0]
        steps = run.steps
        sharp = [bucket.sharpness for bucket in run.buckets]
        colours = [figure for bucket in run.buckets for figure in (*bucket.colour_mean, *bucket.colour_std)]
        worst = {what: max(all_, key=lambda f: _distance(f.value)) for what, all_ in zip(worst, (sharp, colours))}
        spans = (run.natural, run.natural_colour)
        matched = sum(bucket.matched for bucket in run.buckets) / len(run.buckets)
        against = f"against {run.reference} ({matched:.0%} of the frames have one)"
        notes = [f"{against}; real stretches stray to {a:.2f}-{b:.2f} by themselves" for a, b in spans]
    found = []
    place, target = card.places[0].name if card.places else "recorded", "0.7 to 1.3"
    for (what, figure), note in zip(worst.items(), notes):
        name = f"{what} over {steps:,} steps, worst stretch"
        found.append(_bar(name, place, PREDICTED, steps, card.dt_s, target, "\u00d7", figure, 0.7, 1.3, note=note))
    return found


def _at_least(name, place, motion, step, dt_s, target, unit, figure, side) -> Bar:
    note = f"as long as {step // FRAME_SKIP} steps at frame-skip {FRAME_SKIP}" if side else ""
    words = f"\u2265 {target:g} {unit}"
    return _bar(name, place, motion, step, dt_s, words, unit, figure, target, math.inf, side, note)


def _bar(name, place, motion, step, dt_s, target, unit, figure, low, high, side=False, note="") -> Bar:
    seconds = None if step is None or dt_s is None else step * dt_s
    if figure is None or not math.isfinite(figure.value):
        return Bar(name, place, motion, step, seconds, target, unit, None, UNMEASURED, False, side, note)
    inside = low <= figure.value <= high
    wholly_in = low <= figure.low and figure.high <= high
    wholly_out = figure.high < low or figure.low > high
    sure = wholly_in if inside else wholly_out
    return Bar(name, place, motion, step, seconds, target, unit, figure, MET if inside else MISSED, sure, side, note)


def _distance(ratio: float) -> float:
    """How far a ratio is from 1: 0.7 and 1.3 are equally far. What could not be measured is never the worst."""
    return abs(ratio - 1) if math.isfinite(ratio) else -1.0


def _scaled(figure: Figure, factor: float) -> Figure:
    return Figure(figure.value * factor, figure.low * factor, figure.high * factor, figure.count)


def summary(found: Sequence[Bar]) -> str:
    """One line: how many bars are met, missed, void, not measured."""
    counted = [bar for bar in found if not bar.side]
    parts = [f"{sum(bar.status == status for bar in counted)} {status}" for status in (MET, MISSED, VOID, UNMEASURED)]
    return ", ".join(part for part in parts if not part.startswith("0 "))
