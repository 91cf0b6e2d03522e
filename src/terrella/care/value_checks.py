"""What a doctor finds in the numbers of all rows together: statistics, sensors and actions that stand still."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from ..data import stats
from ..data.channels import ACTION
from ..data.format import STATS, names_of
from .row_checks import Rows, Seen
from .survey import Fault, Survey, read_object

_STILL_ROWS, _STILL_PART = 16, 32  # rows of a whole episode, or of half of one, in which a state may not stand still
_ACTIONS = 3  # changes of the action meanwhile


def statistics(survey: Survey, found: Rows) -> Iterator[Fault]:
    """meta/stats.json against the rows."""
    again, faults = "let --repair compute it from the rows", []
    if survey.info.get("total_episodes") == 0 and not survey.data:
        return
    said = read_object(survey.root, STATS, faults, again)
    yield from faults
    for name, summary in found.summary.items() if not (faults or found.broken) else ():
        if name not in said or not np.isfinite(summary["max"]).all():
            continue
        off = _differs(said[name], summary)
        if off:
            yield Fault(STATS, None, f"{name}: {off}", again)


def _differs(said: object, summary: stats.Summary) -> str:
    """The first figure that is not that of the rows; "" where all agree."""
    if not isinstance(said, dict):
        return "it is no summary"
    spread = np.maximum(summary["std"], 1e-3 * np.maximum(np.abs(summary["max"]), np.abs(summary["min"]))) + 1e-6
    for key in ("count", "min", "max", "mean", "std"):
        if key not in said:
            continue
        try:
            figure = np.asarray(said[key], np.float64).reshape(-1)
        except (ValueError, TypeError):
            return f"{key} is no list of numbers"
        true = np.asarray(summary[key], np.float64).reshape(-1)
        if len(figure) != len(true):
            return f"{key} has {len(figure)} numbers, the rows have {len(true)}"
        slack = 0.0 if key == "count" else 0.02 * spread
        for at in np.flatnonzero(~(np.abs(figure - true) <= slack))[:1]:
            return f"{key} {json.dumps(float(figure[at]))} is not that of the rows, {json.dumps(float(true[at]))}"
    return ""


def constants(survey: Survey, found: Rows) -> tuple[list[Fault], list[str]]:
    """(faults, notes): an action that never changes teaches nothing; single numbers that never change are worth knowing."""
    faults, notes = [], []
    rows = sum(seen.rows for seen in found.episodes.values())
    if rows < 32:
        return faults, notes
    for name, summary in {**found.summary, **found.acted}.items():
        if name != ACTION and not name.startswith("observation."):
            continue
        still = np.flatnonzero(summary["min"] == summary["max"])
        if not len(still):
            continue
        values = summary["min"].tolist()
        if len(still) == len(values):
            what = (
                f"the {name} is {values if len(values) <= 16 else values[:16]} in all {int(summary['count'][0])} rows"
            )
            if name == ACTION:
                faults.append(Fault("data", None, what, "check that actions are recorded, and record anew"))
            else:
                notes.append(f"{what}: a sensor that sees nothing, or was not plugged in?")
            continue
        names = names_of(survey.features[name])
        labels = [names[at] if len(names) == len(values) else f"number {at}" for at in still]
        notes.append(f"{name}: {', '.join(labels)} never change{'s' * (len(labels) == 1)} in {rows} rows")
    return faults, notes


def frozen(survey: Survey, found: Rows, unmoving: set[int]) -> Iterator[Fault]:
    """A state that stands still while the actions change. `unmoving`: episodes whose pictures stand still too."""
    pictured = any(feature["dtype"] in ("video", "image") for feature in survey.features.values())
    for number, seen in found.episodes.items():
        acted = _joined(seen, ACTION)
        for name in seen.moved:
            if name == ACTION or (begin_end := _still(_joined(seen, name))) is None:
                continue
            begin, end = begin_end
            changes = int(acted[begin + 1 : min(end, seen.rows - 1)].sum()) if ACTION in seen.moved else 0
            whole = end - begin == seen.rows
            moves = changes >= max(_ACTIONS, 0 if whole else (end - begin) // 16)
            moves |= ACTION not in seen.moved and pictured and whole
            if moves and not (whole and number in unmoving):
                where = "in all its rows" if whole else f"from row {begin} to row {end - 1} of it"
                meanwhile = f"the action changes {changes} times" if changes else "the pictures change"
                what = f"{name} of episode {number} is frozen {where}, while {meanwhile}"
                mend = "leave it out of training, and see whether the sensor was plugged in"
                yield Fault(seen.file, (seen.first or 0) + begin, what, mend)


def _joined(seen: Seen, name: str) -> np.ndarray:
    return np.concatenate(seen.moved.get(name, [np.zeros(0, bool)]))


def _still(moved: np.ndarray) -> tuple[int, int] | None:
    """[begin, end) of the longest stretch of equal rows, where it is too long to be a rest."""
    starts = np.concatenate([[0], np.flatnonzero(moved), [len(moved)]])
    longest = int(np.diff(starts).argmax()) if len(moved) else 0
    begin, end = int(starts[longest]), int(starts[longest + 1])
    least = _STILL_ROWS if end - begin == len(moved) else max(_STILL_PART, len(moved) / 2)
    return (begin, end) if end - begin >= least else None
