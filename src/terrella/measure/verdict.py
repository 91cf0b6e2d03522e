"""The verdict of a scorecard, computed from figures and their intervals: one sentence, then lines; and the card as JSON."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

from .endurance import COLOUR_WITHIN, SHARP_WITHIN
from .scorecard import CHANGE, COPY_LAST, EARLY, GAIN, OTHERS, POOLED, PREDICTED, Curve, Row, Scorecard, place_label
from .statistics import Figure

BETTER, UNCLEAR, WORSE = "better", "no clear difference", "worse"
REMEMBERED_DB = 25.0  # PSNR of the first picture on return, from which a world remembers
RATIO_RANGE = 0.7, 1.3  # of sharpness and change per step, predicted over recorded
BLUR_STEPS = 32
EARLY_SHARE = 0.2  # of clips that a world may end too early


def to_json(card: Scorecard) -> str:
    """The scorecard as a strict JSON document: no pictures, NaN as null, six digits."""
    return json.dumps(as_dict(card), indent=1, allow_nan=False)


def as_dict(card: Scorecard) -> dict:
    """The content of `to_json` as plain data, the verdict first."""
    names = [part.name for part in dataclasses.fields(card) if part.name not in ("pictures", "films")]
    return {
        "verdict": verdict(card),
        "good_for": good_for(card),
        **{name: _plain(getattr(card, name)) for name in names},
    }


def verdict(card: Scorecard) -> list[str]:
    """Sentences: the verdict on the first arm, then one for each measure and set of clips that was compared."""
    arm = next(iter(card.worlds))
    rows, name = compared(card), card.worlds[arm]
    curves = [curve for curve in card.curves if curve.arm == arm and curve.what.endswith(GAIN)]
    if not curves:
        needs = "; ".join(f"{gone.probe} {gone.why}" for gone in card.missing if gone.arm == arm)
        return [f"{name} was not compared with copying the last frame ({needs or 'no probe applies'})."]
    traits = ", ".join(_traits(card, arm))
    traits = f"; it {traits}" if traits else ""
    kinds = dict.fromkeys((row.channel, row.what, row.place) for row in rows)
    lines = (_line([row for row in rows if (row.channel, row.what, row.place) == kind]) for kind in kinds)
    return [f"{name} is {_copying(curves, rows)}{traits}.", *lines]


def good_for(card: Scorecard) -> str:
    """For how long the first arm's main measure stays better than copying the last frame, in a few words; "" if not compared."""
    arm = next(iter(card.worlds))
    curves = [
        curve for curve in card.curves if (curve.arm, curve.motion) == (arm, PREDICTED) and curve.what.endswith(GAIN)
    ]
    if not curves:
        return ""
    lead = curves[0]
    same = [
        curve for curve in curves if (curve.channel, curve.what, curve.place) == (lead.channel, lead.what, lead.place)
    ]
    longest = max(same, key=lambda curve: max(curve.x))
    verdicts = [gain_verdict(longest.band.at(at)) for at in range(len(longest.x))]
    until = verdicts.index(WORSE) if WORSE in verdicts else len(verdicts)
    better = [at for at in range(until) if verdicts[at] == BETTER]
    if not better:
        return "Not yet better than repeating the last picture"
    seconds = longest.x[better[-1]] * card.dt_s
    words = f"{seconds:.0f} seconds" if seconds >= 10 else f"{seconds:.1f} seconds"
    return f"Good for at least {words}" if better[-1] == len(verdicts) - 1 else f"Good for about {words}"


def compared(card: Scorecard) -> list[Row]:
    """The rows of the first arm, under actions alone, that have copying the last frame as a baseline."""
    arm = next(iter(card.worlds))
    mine = [row for row in card.rows if row.gain is not None and (row.arm, row.motion) == (arm, PREDICTED)]
    return [row for row in mine if COPY_LAST in row.baselines]


def gain_verdict(gain: Figure | None) -> str:
    """Better or worse if the whole interval of a gain is; unclear for a single clip."""
    if gain is None or not math.isfinite(gain.low):
        return UNCLEAR
    return BETTER if gain.low > 0 else WORSE if gain.high < 0 else UNCLEAR


def _copying(curves: Sequence[Curve], rows: Sequence[Row]) -> str:
    """The steps at which the world is worse, and better, than copying, in its main measure and by set of clips; of pictures also
    where mean PSNR is worse but pooled PSNR is not."""
    lead, last = curves[0], "frame" if curves[0].unit == "dB" else "observation"
    than = {
        curve.place: _spans(curve.x, [gain_verdict(curve.band.at(at)) for at in range(len(curve.x))])
        for curve in curves
        if (curve.channel, curve.what) == (lead.channel, lead.what)
    }
    (first, text), *others = than.items()
    means = [row for row in rows if (row.channel, row.what, row.place) == (lead.channel, "PSNR", first)]
    worse = [row.horizon for row in means if gain_verdict(row.gain) == WORSE and "worse" not in text]
    text += f", though by mean PSNR worse after {_steps(worse)}" if worse else ""
    text = text.replace("THAN", f"than copying the last {last}", 1)
    parts = [text, *(f"in {place_label(place)} {words}" for place, words in others if words != than[first])]
    return "; ".join(parts).replace(" THAN", "")


def _spans(steps: Sequence[float], verdicts: Sequence[str]) -> str:
    """ "worse THAN beyond 4 steps, better THAN up to 2 steps": runs of steps with one verdict. Unclear steps do not divide a run,
    but a run with unclear steps is not called better, nor worse at every step."""
    known, texts = [(kind, at) for at, kind in enumerate(verdicts) if kind != UNCLEAR], []
    runs = [(kind, [at for _, at in some]) for kind, some in groupby(known, lambda one: one[0])]
    for kind in (WORSE, BETTER):
        spans = [(places[0], places[-1]) for run, places in runs if run == kind]
        gaps = verdicts.count(kind) < sum(last + 1 - first for first, last in spans)
        if len(spans) > 2 or gaps and (kind == BETTER or spans == [(0, len(verdicts) - 1)]):
            texts.append(f"{kind} THAN at {verdicts.count(kind)} of {_steps(steps[-1:])}")
        elif spans:
            texts.append(f"{kind} THAN {' and '.join(_span(steps, *span) for span in spans)}")
    return ", ".join(texts) or f"not clearly better THAN at any step up to {steps[-1]}"


def _span(steps: Sequence[float], first: int, last: int) -> str:
    if first == last:
        return f"after {_steps([steps[first]])}"
    if last == len(steps) - 1:
        return f"beyond {_steps([steps[first - 1]])}" if first else f"at every step up to {steps[last]}"
    return f"from {steps[first]} to {_steps([steps[last]])}" if first else f"up to {_steps([steps[last]])}"


def _steps(numbers: Sequence[float]) -> str:
    """ "1, 8 and 32 steps"."""
    *most, last = map(str, numbers)
    return f"{', '.join(most)}{' and ' if most else ''}{last} step{'s'[: numbers[-1] != 1]}"


def _traits(card: Scorecard, arm: str) -> Iterable[str]:
    """Whether it obeys, remembers, stays sharp, keeps moving, holds still, ends episodes too early; nothing for what was not
    measured."""
    mine = [row for row in card.rows if row.arm == arm and not row.void and math.isfinite(row.figure.value)]
    sharp = [row for row in mine if (row.what, row.motion) == ("sharpness", PREDICTED) and row.probe == "pixels"]
    main = {row.channel for row in sharp[:1]}
    change = [row for row in mine if (row.what, row.motion) == (CHANGE, PREDICTED) and row.channel in main]
    change = [row for row in change if math.isfinite(row.figure.low)]
    reach = max((row.horizon for row in sharp if row.horizon <= BLUR_STEPS), default=0)
    control = [row for row in mine if row.probe == "control" and row.what.endswith(f"true actions over {OTHERS}")]
    control = [row for row in control if row.what.startswith(POOLED)] or control
    closed = [row for row in mine if row.probe == "memory" and not row.what.endswith("far view again")]
    early = [row for row in mine if row.what == EARLY]
    early = [row for row in early if row.horizon == early[-1].horizon]
    questions = (
        (_first(control), lambda row: _sure(row, 0, math.inf, "obeys", "does not clearly obey", "disobeys")),
        (closed, lambda row: _sure(row, REMEMBERED_DB, math.inf, "remembers", "does not surely remember", "forgets")),
        (_first([row for row in sharp if row.horizon == reach]), _sharpness),
        (_first([row for row in change if row.horizon == reach]), _moves),
        ([row for row in mine if row.probe == "stillness"], _stands),
        (early if any(_ends(row)[0] for row in early) else [], _ends),
    )
    for rows, say in questions:
        if rows:
            places = dict.fromkeys(row.place for row in rows)
            yield _by_place((place, max(say(row) for row in rows if row.place == place)[1]) for place in places)


def _first(rows: Sequence[Row]) -> list[Row]:
    """The rows of the main channel at the first horizon."""
    kinds = [(row.channel, row.what, row.horizon) for row in rows]
    return [row for row, kind in zip(rows, kinds) if kind == kinds[0]]


def _sure(row: Row, low: float, high: float, *words: str) -> tuple[int, str]:
    """Whether the whole interval lies between low and high (0), outside (2), or neither (1), and the word for it."""
    inside, outside = low < row.figure.low <= row.figure.high < high, row.figure.high < low or row.figure.low > high
    rank = 0 if inside else 2 if outside else 1
    return rank, words[rank]


def _sharpness(row: Row) -> tuple[int, str]:
    return _sure(
        row,
        *RATIO_RANGE,
        "stays sharp",
        *(("may blur", "blurs") if row.figure.value < 1 else ("may roughen", "roughens")),
    )


def _moves(row: Row) -> tuple[int, str]:
    much = "little" if row.figure.value < 1 else "much"
    return _sure(row, *RATIO_RANGE, "moves as much as the recording", f"may move too {much}", f"moves too {much}")


def _ends(row: Row) -> tuple[int, str]:
    rank = int(row.figure.value > EARLY_SHARE) + int(row.figure.low > EARLY_SHARE)
    return rank, ("does not clearly end too early", "may end too early", "ends too early")[rank]


def _stands(row: Row) -> tuple[int, str]:
    within = SHARP_WITHIN if row.what == "sharpness" else COLOUR_WITHIN
    fading = row.what == "sharpness" and row.figure.value < 1  # else something moves, or changes colour
    words = ("may fade", "fades") if fading else ("may change", "changes")
    return _sure(row, 1 - within, 1 + within, "holds still", *(f"{word} while the agent idles" for word in words))


def _by_place(texts: Iterable[tuple[str, str]]) -> str:
    """The text of the first set of clips, then of each set with another text."""
    (_, first), *others = texts
    return ", ".join([first, *(f"{words} in {place_label(place)}" for place, words in others if words != first)])


def _line(rows: Sequence[Row]) -> str:
    mine = " / ".join(f"{row.figure.value:.3g}" for row in rows)
    copied = " / ".join(f"{row.baselines[COPY_LAST].value:.3g}" for row in rows)
    verdicts = [gain_verdict(row.gain) for row in rows]
    about = f"{rows[0].channel} {rows[0].what}, {place_label(rows[0].place)}: {mine} {rows[0].unit}".rstrip()
    unanimous = verdicts[0] if len(set(verdicts)) == 1 else ", ".join(verdicts)
    return f"{about} after {_steps([row.horizon for row in rows])}; copy-last {copied} ({unanimous})"


def _plain(value) -> Any:
    if dataclasses.is_dataclass(value):
        return {part.name: _plain(getattr(value, part.name)) for part in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple, range)):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
