"""The verdict: is the world better than copying the last frame, and after how many steps?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .statistics import Figure

if TYPE_CHECKING:
    from .scorecard import Row, Scorecard

BETTER, UNCLEAR, WORSE = "better", "no clear difference", "worse"


def verdict(card: Scorecard) -> list[str]:
    """Sentences, the answer first: that of the first arm's main channel, then one for each channel and place."""
    arm = next(iter(card.worlds))
    rows = [row for row in card.rows if row.gain is not None and row.arm == arm and row.motion == "predicted"]
    name = card.worlds[arm]
    if not rows:
        needs = "; ".join(dict.fromkeys(f"{gone.probe}: {gone.why}" for gone in card.missing if gone.arm == arm))
        return [f"{name} was not held against copying the last frame ({needs or 'no probe could be asked'})."]
    main = [row for row in rows if (row.channel, row.what) == (rows[0].channel, rows[0].what)]
    found = {judged(row) for row in main}
    horizons = _steps([row.horizon for row in main if row.place == main[0].place])
    last = "frame" if rows[0].unit == "dB" else "observation"
    if found == {BETTER}:
        first = f"{name} is better than copying the last {last} at every horizon: after {horizons}."
    elif BETTER not in found:
        first = f"{name} is not better than copying the last {last}, after {horizons}."
    else:
        where = [
            f"after {_steps([row.horizon for row in main if row.place == place and judged(row) == BETTER])} in {place} places"
            for place in dict.fromkeys(row.place for row in main)
            if any(row.place == place and judged(row) == BETTER for row in main)
        ]
        first = f"{name} is better than copying the last {last} {' and '.join(where)}; not at the other horizons."
    kinds = dict.fromkeys((row.channel, row.what, row.place) for row in rows)
    return [first, *(_line([row for row in rows if (row.channel, row.what, row.place) == kind]) for kind in kinds)]


def judged(row: Row) -> str:
    """Better or worse where the whole interval of the gain says so; one clip alone cannot say."""
    gain: Figure | None = row.gain
    if gain is None or not math.isfinite(gain.low):
        return UNCLEAR
    return BETTER if gain.low > 0 else WORSE if gain.high < 0 else UNCLEAR


def _line(rows: Sequence[Row]) -> str:
    parts = []
    for row in rows:
        words, gain = judged(row), row.gain.value if row.gain else math.nan
        parts.append(f"{row.horizon}: {gain:+.3g} {row.unit}".rstrip() + ("" if words == BETTER else f" ({words})"))
    return (
        f"{rows[0].channel}, {rows[0].what}, {rows[0].place} places: gain over copy-last after steps {', '.join(parts)}"
    )


def _steps(horizons: Sequence[int]) -> str:
    numbers = [str(step) for step in horizons]
    whole = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
    return f"{whole} step{'s'[: horizons[-1] != 1]}"
