"""Faults of rows: schema, counters, timestamps, values, pictures, statistics, and states that do not change."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..data import stats
from ..data.channels import ACTION, DONE, STATE
from ..data.format import ACTION_VALID, STATS, TASKS, names_of, schema, to_numpy
from ..data.source import is_outcome
from ..data.storage.tables import open_parquet
from .pieces import read_batches, whole_pictures
from .survey import FROM_ROWS, LEFTOVER, RESTORE, Fault, Survey, read_object

_LEAVE_OUT = "use --repair, which splits the episode around such rows, or leave it out of training"
_COUNT_ANEW = "use --repair, which counts again"
_KEPT_EPISODES, _KEPT_ROWS = 64, 1024  # episodes, and rows of each, that are kept for the test of alignment


@dataclass
class EpisodeRows:
    """What the rows of one episode hold."""

    number: int
    file: str
    rows: int = 0  # number of rows
    first: int | None = None  # column "index" of the first row
    changes: bool = False  # whether any state or action differs between rows
    digest: hashlib.blake2b = field(default_factory=lambda: hashlib.blake2b(digest_size=16))
    pictures: hashlib.blake2b = field(default_factory=lambda: hashlib.blake2b(digest_size=16))
    kept: dict[str, list[np.ndarray]] = field(default_factory=dict)  # columns of the first rows
    changed: dict[str, list[np.ndarray]] = field(default_factory=dict)  # bool: rows that differ from the row before
    done: list[np.ndarray] = field(default_factory=list)
    unreadable: dict[str, list[int]] = field(default_factory=dict)  # rows whose picture cannot be decoded
    wrong: dict[str, Fault] = field(default_factory=dict)
    last: dict[str, np.ndarray] = field(default_factory=dict)

    def note(self, kind: str, at: int, what: str, mend: str) -> None:
        """Keeps a fault of row `at` of the episode, if it is the first of its kind."""
        self.wrong.setdefault(kind, Fault(self.file, (self.first or 0) + at, what, mend))


@dataclass
class RowFacts:
    """What all rows hold: episodes by number; a Summary of each column; acted: a Summary of the valid actions."""

    episodes: dict[int, EpisodeRows] = field(default_factory=dict)
    summary: dict[str, stats.Summary] = field(default_factory=dict)
    acted: dict[str, stats.Summary] = field(default_factory=dict)
    padded: dict[str, list[int]] = field(default_factory=dict)  # observation -> the episodes that have no reading of it
    given: dict[str, stats.Summary] = field(default_factory=dict)  # of these, a Summary without the padding
    broken: set[str] = field(default_factory=set)  # files with rows that cannot be read
    unlisted: set[str] = field(default_factory=set)  # columns that info.json does not name


def examine_rows(survey: Survey, facts: RowFacts, busy: bool) -> Iterator[Fault]:
    """Reads every data file once; fills `facts`. `busy`: a recorder is at work, so a file not yet listed is no fault."""
    promised = schema(survey.features)
    for number, episode in survey.episodes.items():
        for name in episode.absent:
            if not is_outcome(name):
                facts.padded.setdefault(name, []).append(number)
    every = len(survey.episodes) or 1
    sampled = set(list(survey.episodes or range(_KEPT_EPISODES))[:: max(1, every // _KEPT_EPISODES)])
    firsts: dict[str, int] = {}
    for episode in survey.episodes.values():
        firsts[episode.data] = min(episode.start, firsts.get(episode.data, episode.start))
        if episode.data not in survey.data:
            facts.broken.add(episode.data)
            what = f"the table of episode {episode.number} is missing"
            yield Fault(episode.data, episode.start, what, RESTORE)
    for file in survey.data:
        if not survey.complete or file in firsts:
            yield from _file(survey, file, firsts.get(file), promised, facts, sampled)
        elif not busy:
            yield Fault(file, None, "no episode of info.json uses this file", LEFTOVER)
    for seen in facts.episodes.values():
        for name, rows in seen.unreadable.items():
            what = f"{len(rows)} of {seen.rows} pictures of {name} cannot be decoded"
            seen.note(f"pictures {name}", rows[0], what, _LEAVE_OUT)
        yield from seen.wrong.values()
    yield from _lengths(survey, facts)


def _file(
    survey: Survey, file: str, first: int | None, promised: pa.Schema, facts: RowFacts, sampled: set[int]
) -> Iterator[Fault]:
    try:
        with open_parquet(survey.path(file)) as table:
            form = table.schema_arrow
        wrong = [
            part.name
            for part in promised
            if part.name not in form.names or not _alike(form.field(part.name).type, part.type)
        ]
        for name in wrong:
            actual = f"is {form.field(name).type}" if name in form.names else "is missing"
            what = f"column '{name}' {actual}, but info.json states {promised.field(name).type}"
            yield Fault(file, first, what, RESTORE)
        facts.unlisted |= set(form.names) - set(promised.names)
        columns = [name for name in promised.names if name not in wrong]
        if "episode_index" not in columns:
            facts.broken.add(file)
            return
        for at, count, table in read_batches(survey.path(file), survey.features, columns):
            if isinstance(table, DatasetError):
                facts.broken.add(file)
                row = None if first is None else first + at
                what = str(table).split(";")[0].removeprefix(f"the table {survey.path(file)} ")
                yield Fault(file, row, f"{count} rows from row {at} on are unreadable: the table {what}", RESTORE)
            else:
                yield from _batch(survey, file, at, table, facts, sampled)
    except (DatasetError, OSError, pa.ArrowException, ValueError):
        facts.broken.add(file)
        yield Fault(file, first, "the table is missing, truncated or not parquet", RESTORE)


def _batch(survey: Survey, file: str, at: int, table: pa.Table, facts: RowFacts, sampled: set[int]) -> Iterator[Fault]:
    columns: dict[str, np.ndarray] = {}
    pictures: dict[str, pa.ChunkedArray] = {}
    for name in table.column_names:
        feature = survey.features[name]
        if feature["dtype"] == "image":
            pictures[name] = table[name]
            continue
        try:
            columns[name] = to_numpy(table[name], tuple(feature["shape"]))
        except (ValueError, TypeError, NotImplementedError) as error:
            facts.broken.add(file)
            yield Fault(file, None, f"column '{name}' is broken from row {at} of the file: {error}", RESTORE)
    if "episode_index" not in columns:
        return
    numbers = columns["episode_index"].reshape(-1).astype(np.int64)
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    for begin, end in zip(edges, edges[1:]):
        number = int(numbers[begin])
        seen = facts.episodes.setdefault(number, EpisodeRows(number, file))
        part = {name: column[begin:end] for name, column in columns.items()}
        if seen.file != file:
            what = f"rows of episode {number} lie here and in {seen.file}"
            seen.wrong.setdefault(f"file {file}", Fault(file, None, what, RESTORE))
            continue
        _counters(survey, seen, part)
        _values(survey, seen, part)
        for name, column in pictures.items():
            _pictures(survey, seen, name, column.slice(begin, end - begin))
        _keep(seen, part, number in sampled)
        seen.rows += end - begin
    _summarise(facts, columns, numbers)


# -- counters and values ---------------------------------------------------------------------------------------------


def _counters(survey: Survey, seen: EpisodeRows, part: Mapping[str, np.ndarray]) -> None:
    listed = survey.episodes.get(seen.number)
    frame = seen.rows + np.arange(len(part["episode_index"]))
    index = part["index"].reshape(-1) if "index" in part else None
    if seen.first is None:
        seen.first = listed.start if listed else (int(index[0]) if index is not None else 0)
    for name, due in {"frame_index": frame, "index": seen.first + frame}.items():
        if name in part:
            stored = part[name].reshape(-1)
            for at in np.flatnonzero(stored != due)[:1]:
                what = f"{name} is {int(stored[at])} where {int(due[at])} is expected: rows are missing or moved"
                seen.note(name, int(frame[at]), what, _COUNT_ANEW)
    if "timestamp" in part:
        late = np.abs(part["timestamp"].reshape(-1).astype(np.float64) - frame / survey.fps)
        late[~np.isfinite(late)] = 0  # reported by `_values`
        slack = 0.1 / survey.fps + 1e-6 * np.abs(frame / survey.fps)  # rounding of float32
        for at in np.flatnonzero(late > slack)[:1]:
            what = f"timestamp is {late[at]:.3f} s off frame_index / {survey.fps:g} frames per second"
            seen.note("timestamp", int(frame[at]), what, "set timestamp to frame_index / fps, as --repair does")


def _values(survey: Survey, seen: EpisodeRows, part: Mapping[str, np.ndarray]) -> None:
    for name, column in part.items():
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            bad = np.flatnonzero(~np.isfinite(column.reshape(len(column), -1)).all(1))
            seen.note(f"finite {name}", seen.rows + int(bad[0]), f"{name} is not a finite number", _LEAVE_OUT)
    if "task_index" in part and survey.tasks:
        task = part["task_index"].reshape(-1)
        for at in np.flatnonzero(~np.isin(task, list(survey.tasks)))[:1]:
            what, mend = f"task {int(task[at])} is not in {TASKS}", "use --repair, which makes it from meta/episodes"
            seen.note("task_index", seen.rows + int(at), what, mend)
    if DONE in part:
        seen.done.append(part[DONE].reshape(-1).astype(bool))


def _pictures(survey: Survey, seen: EpisodeRows, name: str, column: pa.ChunkedArray) -> None:
    for picture in column:
        seen.pictures.update((picture["bytes"].as_py() if picture.is_valid else None) or b"")
    bad = np.flatnonzero(~whole_pictures(column, tuple(survey.features[name]["shape"])))
    if len(bad):
        seen.unreadable.setdefault(name, []).extend((seen.rows + bad).tolist())


def _keep(seen: EpisodeRows, part: Mapping[str, np.ndarray], sampled: bool) -> None:
    sampled = sampled and sum(len(some) for some in seen.kept.get(ACTION, ())) < _KEPT_ROWS
    for name, column in part.items():
        if name != ACTION and not name.startswith("observation."):
            continue
        if column.dtype == object:
            seen.digest.update("\0".join(map(str, column.reshape(-1))).encode())
            continue
        seen.digest.update(np.ascontiguousarray(column).data.cast("B") if column.size else b"")
        flat = column.reshape(len(column), -1)
        changed = (np.concatenate([seen.last.get(name, flat[:1]), flat[:-1]]) != flat).any(1)
        seen.changes, seen.last[name] = seen.changes or bool(changed.any()), flat[-1:].copy()
        if name == ACTION or name.startswith(STATE):
            seen.changed.setdefault(name, []).append(changed)
        if sampled and column.ndim <= 2:
            seen.kept.setdefault(name, []).append(flat.astype(np.float64))
    if sampled and ACTION_VALID in part:
        seen.kept.setdefault(ACTION_VALID, []).append(part[ACTION_VALID].reshape(-1, 1).astype(np.float64))


def _summarise(facts: RowFacts, columns: Mapping[str, np.ndarray], numbers: np.ndarray) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        part = {
            name: stats.summarise(column)
            for name, column in columns.items()
            if column.dtype != object and column.ndim <= 2
        }
        facts.summary = stats.merge([facts.summary, part])
        for name in part.keys() & facts.padded:
            given = columns[name][~np.isin(numbers, facts.padded[name])]
            if len(given):
                facts.given = stats.merge([facts.given, {name: stats.summarise(given)}])
        if ACTION in part:
            acted = columns[ACTION]
            if ACTION_VALID in columns:
                acted = acted[columns[ACTION_VALID].reshape(-1).astype(bool)]
            if len(acted):
                facts.acted = stats.merge([facts.acted, {ACTION: stats.summarise(acted)}])


def _alike(stored: pa.DataType, promised: pa.DataType) -> bool:
    """Whether two Arrow types hold the same values; lists may be of fixed size or not, and extension types count."""
    while isinstance(stored, pa.BaseExtensionType):
        stored = stored.storage_type
    stored = stored.value_type if isinstance(stored, pa.DictionaryType) else stored
    while pa.types.is_nested(promised) and not pa.types.is_struct(promised):
        if not pa.types.is_nested(stored) or not hasattr(stored, "value_type"):
            return False
        stored, promised = stored.value_type, promised.value_type
    if pa.types.is_struct(promised):
        return pa.types.is_struct(stored) and "bytes" in {part.name for part in stored}
    return stored == promised or (pa.types.is_string(promised) and pa.types.is_large_string(stored))


# -- episodes and the whole ------------------------------------------------------------------------------------------


def _lengths(survey: Survey, facts: RowFacts) -> Iterator[Fault]:
    for number, episode in survey.episodes.items():
        seen = facts.episodes.get(number)
        if seen is None and episode.data not in facts.broken and episode.length:
            what = f"episode {number} has 0 rows here, but {episode.length} in meta/episodes"
            yield Fault(episode.data, episode.start, what, RESTORE)
        elif seen is not None and seen.file != episode.data and seen.file not in facts.broken:
            what = f"the rows of episode {number} lie here, but meta/episodes names {episode.data}"
            yield Fault(seen.file, episode.start, what, FROM_ROWS)
        elif seen is not None and seen.rows != episode.length and seen.file not in facts.broken:
            what = f"episode {number} has {seen.rows} rows here, but {episode.length} in meta/episodes"
            yield Fault(seen.file, episode.start, what, RESTORE)
    for number, seen in facts.episodes.items():
        if number not in survey.episodes and survey.complete:
            what = f"it holds {seen.rows} rows of episode {number}, which meta/episodes does not list"
            yield Fault(seen.file, seen.first, what, FROM_ROWS)
        done = np.concatenate(seen.done) if seen.done else np.zeros(0, bool)
        # the last two rows may be done: the last step and the terminal observation
        for at in np.flatnonzero(done[:-2])[:1]:
            what = f"done is set {len(done) - 1 - int(at)} rows before the end of episode {number}"
            mend = "split the episode there, or clear the flag"
            yield Fault(seen.file, (seen.first or 0) + int(at), what, mend)


# -- all rows together -----------------------------------------------------------------------------------------------

_STILL_ROWS, _STILL_PART = 16, 32  # rows without change that are too many: of a whole episode, of a part of one
_ACTIONS = 3  # changes of the action in that time


def check_statistics(survey: Survey, facts: RowFacts) -> Iterator[Fault]:
    """Compares meta/stats.json with the rows."""
    again, faults = "use --repair, which computes it from the rows", []
    if survey.info.get("total_episodes") == 0 and not survey.data:
        return
    stated = read_object(survey.root, STATS, faults, again)
    yield from faults
    for name, summary in facts.summary.items() if not (faults or facts.broken) else ():
        if name not in stated or not np.isfinite(summary["max"]).all():
            continue
        off = _differs(stated[name], facts.given.get(name, summary))
        off = off and _differs(stated[name], summary)  # earlier versions counted padding
        if off:
            yield Fault(STATS, None, f"{name}: {off}", again)


def _differs(stated: object, summary: stats.Summary) -> str:
    """The first figure that differs from that of the rows; "" where all agree."""
    if not isinstance(stated, dict):
        return "it is not a summary"
    spread = np.maximum(summary["std"], 1e-3 * np.maximum(np.abs(summary["max"]), np.abs(summary["min"]))) + 1e-6
    for key in ("count", "min", "max", "mean", "std"):
        if key not in stated:
            continue
        try:
            figure = np.asarray(stated[key], np.float64).reshape(-1)
        except (ValueError, TypeError):
            return f"{key} is not a list of numbers"
        true = np.asarray(summary[key], np.float64).reshape(-1)
        if len(figure) != len(true):
            return f"{key} has {len(figure)} numbers, but the rows have {len(true)}"
        slack = 0.0 if key == "count" else 0.02 * spread
        for at in np.flatnonzero(~(np.abs(figure - true) <= slack))[:1]:
            return f"{key} {json.dumps(float(figure[at]))} differs from {json.dumps(float(true[at]))}, computed from the rows"
    return ""


def constant_columns(survey: Survey, facts: RowFacts) -> tuple[list[Fault], list[str]]:
    """(faults, notes): an action that never changes is a fault; other columns that never change are notes."""
    faults, notes = [], []
    rows = sum(seen.rows for seen in facts.episodes.values())
    if rows < 32:
        return faults, notes
    for name, summary in {**facts.summary, **facts.given, **facts.acted}.items():
        if name != ACTION and not name.startswith("observation."):
            continue
        still = np.flatnonzero(summary["min"] == summary["max"])
        if not len(still):
            continue
        values = summary["min"].tolist()
        if len(still) == len(values):
            what = f"the {name} is {values[:16]} in all {int(summary['count'][0])} rows"
            if name == ACTION:
                faults.append(Fault("data", None, what, "check that actions are recorded, and record again"))
            else:
                notes.append(f"{what}: is the sensor covered, or not plugged in?")
            continue
        names = names_of(survey.features[name])
        labels = [names[at] if len(names) == len(values) else f"number {at}" for at in still]
        notes.append(f"{name}: {', '.join(labels)} never change{'s' * (len(labels) == 1)} in {rows} rows")
    return faults, notes


def frozen_states(survey: Survey, facts: RowFacts, unmoving: set[int]) -> Iterator[Fault]:
    """States that do not change while the actions do. `unmoving`: episodes whose pictures do not change either."""
    pictured = any(feature["dtype"] in ("video", "image") for feature in survey.features.values())
    for number, seen in facts.episodes.items():
        acted = _joined(seen, ACTION)
        padding = survey.episodes[number].absent if number in survey.episodes else ()
        for name in seen.changed:
            if name == ACTION or name in padding or (begin_end := _still(_joined(seen, name))) is None:
                continue
            begin, end = begin_end
            changes = int(acted[begin + 1 : min(end, seen.rows - 1)].sum()) if ACTION in seen.changed else 0
            whole = end - begin == seen.rows
            moves = changes >= max(_ACTIONS, 0 if whole else (end - begin) // 16)
            moves |= ACTION not in seen.changed and pictured and whole
            if moves and not (whole and number in unmoving):
                where = "in all its rows" if whole else f"from row {begin} to row {end - 1} of it"
                meanwhile = f"the action changes {changes} times" if changes else "the pictures change"
                what = f"{name} of episode {number} is frozen {where}, while {meanwhile}"
                mend = "leave it out of training, and check that the sensor was plugged in"
                yield Fault(seen.file, (seen.first or 0) + begin, what, mend)


def _joined(seen: EpisodeRows, name: str) -> np.ndarray:
    return np.concatenate(seen.changed.get(name, [np.zeros(0, bool)]))


def _still(changed: np.ndarray) -> tuple[int, int] | None:
    """[begin, end) of the longest stretch of equal rows, where it is too long to be a pause."""
    starts = np.concatenate([[0], np.flatnonzero(changed), [len(changed)]])
    longest = int(np.diff(starts).argmax()) if len(changed) else 0
    begin, end = int(starts[longest]), int(starts[longest + 1])
    least = _STILL_ROWS if end - begin == len(changed) else max(_STILL_PART, len(changed) / 2)
    return (begin, end) if end - begin >= least else None
