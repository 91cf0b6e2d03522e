"""The scorecard as data: figures with 95% intervals and baselines, curves, pictures, and what was not asked."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .statistics import Band, Figure

PREDICTED, TRUE = "predicted", "true"  # motion: the world is given actions alone; or at each step the true pose
OTHERS, IDLE = "other actions", "no action"  # actions of another clip; the action at rest, held
COPY_LAST = "copy last"
BETTER, UNCLEAR, WORSE = "better", "no clear difference", "worse"


@dataclass(frozen=True)
class Row:
    """One figure of one probe.

    channel: of which channel ("rgb.wrist"), "" for none; what: its name, unit: that of the figure; better: +1 where more
    is better, -1 where less is, 0 where 1 or nothing in particular is best; horizon: after how many steps, 0 for none;
    baselines: the same figure of those who know nothing; gain: over copying the last frame, clip by clip, positive is
    better; void: it was measured and proves nothing, `note` says why.
    """

    probe: str
    channel: str
    what: str
    unit: str
    place: str
    arm: str
    motion: str
    horizon: int
    figure: Figure
    better: int = 0
    baselines: Mapping[str, Figure] = field(default_factory=dict)
    gain: Figure | None = None
    void: bool = False
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """A figure along x (steps from 1, or shares); arm COPY_LAST for the last frame copied. mark: an x worth a dot."""

    probe: str
    channel: str
    what: str
    unit: str
    place: str
    arm: str
    motion: str
    x: Sequence[float]
    band: Band
    mark: float | None = None
    guides: tuple[float, ...] = ()


@dataclass(frozen=True)
class Picture:
    """Rows of frames uint8 [K, H, W, 3] to look at: label -> frames, one column label for each frame."""

    probe: str
    title: str
    columns: list[str]
    rows: dict[str, np.ndarray]


@dataclass(frozen=True)
class Missing:
    """A probe that was not applicable to an arm, and what it needs: "needs pose"."""

    probe: str
    arm: str
    why: str


@dataclass(frozen=True)
class Place:
    """What was shown: how many clips, the share of them in which anything moves, their lengths in steps."""

    name: str
    clips: int
    moving_share: float
    context: int
    horizon: int


@dataclass
class Report:
    """What one probe found."""

    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True)
class Scorecard:
    """Everything measured, as data; `pictures` are for the page and stay out of the JSON. worlds: arm -> its world."""

    worlds: dict[str, str]
    dt_s: float
    places: list[Place]
    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)

    def find(self, probe: str, what: str, **wanted) -> list[Row]:
        """The rows of a probe by name, and by whichever other fields are given."""
        return [
            row
            for row in self.rows
            if (row.probe, row.what) == (probe, what) and all(getattr(row, key) == wanted[key] for key in wanted)
        ]


def to_json(card: Scorecard) -> str:
    """The scorecard as one strict JSON document: no pictures, NaN as null, six digits."""
    return json.dumps(as_dict(card), indent=1, allow_nan=False)


def as_dict(card: Scorecard) -> dict:
    """What `to_json` writes, as plain data; the verdict comes first."""
    names = [part.name for part in dataclasses.fields(card) if part.name != "pictures"]
    return {"verdict": verdict(card), **{name: _plain(getattr(card, name)) for name in names}}


def verdict(card: Scorecard) -> list[str]:
    """Sentences, the answer first: that of the first arm's main channel; then one for each figure and place."""
    arm = next(iter(card.worlds))
    rows, name = compared(card), card.worlds[arm]
    if not rows:
        needs = "; ".join(f"{gone.probe} {gone.why}" for gone in card.missing if gone.arm == arm)
        return [f"{name} was not held against copying the last frame ({needs or 'no probe could be asked'})."]
    main = [row for row in rows if (row.channel, row.what) == (rows[0].channel, rows[0].what)]
    last = "frame" if rows[0].unit == "dB" else "observation"
    good = {
        place: [row.horizon for row in main if row.place == place and judged(row) == BETTER] for place in _places(main)
    }
    if all(judged(row) == BETTER for row in main):
        first = f"{name} is better than copying the last {last} at every horizon: after {_steps(good[main[0].place])}."
    elif not any(good.values()):
        horizons = _steps([row.horizon for row in main if row.place == main[0].place])
        first = f"{name} is not better than copying the last {last}, after {horizons}."
    else:
        where = [f"after {_steps(steps)} in {place} places" for place, steps in good.items() if steps]
        first = f"{name} is better than copying the last {last} {' and '.join(where)}; not at the other horizons."
    kinds = dict.fromkeys((row.channel, row.what, row.place) for row in rows)
    return [first, *(_line([row for row in rows if (row.channel, row.what, row.place) == kind]) for kind in kinds)]


def compared(card: Scorecard) -> list[Row]:
    """The rows of the first arm, under actions alone, that are compared with copying the last frame."""
    arm = next(iter(card.worlds))
    mine = [row for row in card.rows if row.gain is not None and (row.arm, row.motion) == (arm, PREDICTED)]
    return [row for row in mine if COPY_LAST in row.baselines]


def judged(row: Row) -> str:
    """Better or worse where the whole interval of the gain says so; one clip alone cannot say."""
    if row.gain is None or not math.isfinite(row.gain.low):
        return UNCLEAR
    return BETTER if row.gain.low > 0 else WORSE if row.gain.high < 0 else UNCLEAR


def _line(rows: Sequence[Row]) -> str:
    parts = []
    for row in rows:
        gain, words = row.gain.value if row.gain else math.nan, judged(row)
        parts.append(f"{gain:+.3g}" + ("" if words == BETTER else f" ({words})"))
    steps = _steps([row.horizon for row in rows])
    about = f"{rows[0].channel} {rows[0].what}, {rows[0].place} places"
    return f"{about}: gain {', '.join(parts)} {rows[0].unit} after {steps}"


def _places(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row.place for row in rows))


def _steps(horizons: Sequence[int]) -> str:
    numbers = [str(step) for step in horizons]
    whole = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
    return f"{whole} step{'s'[: horizons[-1] != 1]}"


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
