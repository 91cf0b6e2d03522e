"""pieces: the whole rows of a damaged recording, as runs without a gap."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..data.features import decode_picture
from ..data.format import AUTOMATIC, to_numpy
from ..data.storage.tables import BATCH_BYTES, BROKEN, TEXT_ROWS, damaged_table, open_parquet
from .survey import Survey

_LARGEST = 4 << 30  # most bytes of numbers that a row group may unpack to
_REPEATED = 256 << 20  # the same of texts and pictures, which compress without limit
_A_BYTE = 4  # unpacked bytes of texts and pictures allowed for each byte of a larger file


def read_batches(
    path: Path, features: Mapping[str, dict], columns: Sequence[str]
) -> Iterator[tuple[int, int, pa.Table | DatasetError]]:
    """(first row, rows, table) of a data file, some megabytes at a time; DatasetError where the file is broken. A batch that cannot
    be read is given as the error itself, and reading goes on with the next row group."""
    texts = any(features[name]["dtype"] in ("image", "string") for name in columns)
    wide = 8 + sum(16 * math.prod(features[name]["shape"]) for name in columns if features[name]["dtype"] != "image")
    try:
        file = open_parquet(path)
        few = max(_REPEATED, _A_BYTE * path.stat().st_size)
        step, most = (TEXT_ROWS, few) if texts else (max(1, BATCH_BYTES // wide), _LARGEST)
    except BROKEN as error:
        raise damaged_table(path, error) from error
    with file:
        at = 0
        for number in range(file.num_row_groups):
            rows, done, size = file.metadata.row_group(number).num_rows, 0, 0
            try:
                for batch in file.iter_batches(step, row_groups=[number], columns=list(columns)):
                    size += batch.nbytes
                    if size > most:
                        raise ValueError(f"it unpacks to more than {most:,} bytes")
                    if batch.num_rows:
                        yield at + done, batch.num_rows, pa.Table.from_batches([batch])
                    done += batch.num_rows
                if done < rows:
                    raise ValueError(f"{rows - done} rows are missing")
            except BROKEN as error:
                yield at + done, max(0, rows - done), damaged_table(path, error)
            at += rows


_MOST_LOST = 10_000_000  # most unreadable rows in one batch; a larger claim is damage


@dataclass(frozen=True)
class WholeRows:
    """Consecutive whole rows of one episode."""

    number: int  # of the episode, as stored in the rows
    file: str  # data file, relative to the dataset
    path: Path  # that file, or a rebuilt copy of it
    row: int  # place of the first row in the file
    frame: int  # place of the first row in the episode
    task: np.ndarray  # task_index of each row
    whole: bool = False  # whether meta/episodes lists no further rows of the episode

    @property
    def count(self) -> int:
        return len(self.task)

    def part(self, begin: int, end: int) -> WholeRows:
        """Its rows [begin, end)."""
        whole = self.whole and (begin, end) == (0, self.count)
        return replace(self, row=self.row + begin, frame=self.frame + begin, task=self.task[begin:end], whole=whole)


@dataclass
class Table:
    """The counters of the rows of one data file; good: rows that can be read and hold finite numbers."""

    file: str
    path: Path
    columns: dict[str, np.ndarray]
    good: np.ndarray
    missing: dict[str, np.ndarray]  # column -> rows in which it is not finite


def read_table(survey: Survey, file: str, path: Path, features: Mapping[str, dict]) -> Table:
    """Reads all columns of a data file and keeps its counters; DatasetError where the file cannot be opened."""
    stored = [name for name, feature in features.items() if feature["dtype"] != "video"]
    floats = [name for name in stored if features[name]["dtype"].startswith("float") and name != "timestamp"]
    with open_parquet(path) as opened:
        names = opened.schema_arrow.names
    for name in sorted(set(stored) - set(names) - set(AUTOMATIC)):
        raise DatasetError(f"{file} lacks the column '{name}' that other rows have.")
    parts: dict[str, list[np.ndarray]] = {name: [np.zeros(0)] for name in AUTOMATIC}
    missing: dict[str, list[np.ndarray]] = {name: [np.zeros(0, bool)] for name in floats}
    good = [np.zeros(0, bool)]
    for _, count, table in read_batches(path, features, [name for name in stored if name in names]):
        if isinstance(table, DatasetError) and count > _MOST_LOST:
            raise table  # a batch that claims more rows has none
        broken = isinstance(table, DatasetError)
        columns, whole = ({}, np.zeros(count, bool)) if broken else _numbers_of(table, features)
        good.append(whole)
        for name, some in parts.items():
            some.append(columns[name].reshape(-1).astype(np.float64) if name in columns else np.full(count, np.nan))
        for name, some in missing.items():
            some.append(np.zeros(count, bool))
            if name in columns:
                some[-1] |= ~np.isfinite(columns[name].reshape(count, -1)).all(1)
    joined, bad = ({name: np.concatenate(some) for name, some in kind.items()} for kind in (parts, missing))
    return Table(file, path, joined, np.concatenate(good), bad)


def _numbers_of(table: pa.Table, features: Mapping[str, dict]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """(columns of numbers, bool [n]: the rows of which all columns can be read)."""
    columns, whole = {}, np.ones(len(table), bool)
    for name in table.column_names:
        shape = tuple(features[name]["shape"])
        try:
            if features[name]["dtype"] == "image":
                whole &= whole_pictures(table[name], shape)
            else:
                columns[name] = to_numpy(table[name], shape)
        except (ValueError, TypeError, NotImplementedError):
            whole[:] = False
    return columns, whole


def whole_pictures(column: pa.ChunkedArray, shape: tuple[int, ...]) -> np.ndarray:
    """bool [n]: which of the pictures can be read."""
    good = np.zeros(len(column), bool)
    for i, picture in enumerate(column):
        with suppress(DatasetError):
            decode_picture(picture.as_py(), shape, "the camera")
            good[i] = True
    return good


def pieces_of(survey: Survey, table: Table, notes: list[str]) -> Iterator[WholeRows]:
    """The whole rows of a file, episode after episode in the order of the file."""
    numbers = _numbers(survey, table)
    for number in dict.fromkeys(numbers[numbers >= 0].tolist()):
        rows = np.flatnonzero(numbers == number)
        good = table.good[rows] & ~_unmeasured(table, rows, int(number), notes)
        listed = survey.episodes.get(int(number))
        frames = _frames(survey, table, rows, None if listed is None else listed.start)
        task = np.nan_to_num(table.columns["task_index"][rows], nan=-1).astype(np.int64)
        cuts = np.flatnonzero((np.diff(frames) != 1) | (np.diff(rows) != 1) | (np.diff(good.astype(np.int8)) != 0)) + 1
        length = None if listed is None else listed.length
        for begin, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(rows)]):
            if good[begin] and frames[begin] >= 0:
                whole = frames[begin] == 0 and end - begin == (len(rows) if length is None else length)
                yield WholeRows(
                    int(number), table.file, table.path, int(rows[begin]), int(frames[begin]), task[begin:end], whole
                )


def _numbers(survey: Survey, table: Table) -> np.ndarray:
    """int64: the episode of each row; without the column, the only episode that lists this file, else -1."""
    numbers = table.columns["episode_index"]
    here = [episode.number for episode in survey.episodes.values() if episode.data == table.file]
    if np.isnan(numbers).all() and len(here) == 1:
        return np.full(len(numbers), here[0], np.int64)
    return np.where(np.isfinite(numbers) & (np.abs(numbers) < 2**53), numbers, -1).astype(np.int64)


def _frames(survey: Survey, table: Table, rows: np.ndarray, start: int | None) -> np.ndarray:
    """int64: each row's place in its episode, by majority of frame_index, index, timestamp and the order of the rows."""
    frame, index = table.columns["frame_index"][rows], table.columns["index"][rows]
    time = np.round(table.columns["timestamp"][rows] * survey.fps)
    if start is None:
        values, counts = np.unique((index - frame)[np.isfinite(index - frame)], return_counts=True)
        start = int(values[counts.argmax()]) if len(values) else 0
    votes = np.stack([frame, index - start, time])
    votes = np.where(np.isfinite(votes) & (np.abs(votes) < 2**53), votes, -1).astype(np.int64)
    if (votes == np.arange(len(rows))).sum(0).min(initial=3) >= 2:  # as in an undamaged recording
        return np.arange(len(rows))
    frames, due = np.empty(len(rows), np.int64), 0
    for i, stated in enumerate(votes.T):
        choices = [int(vote) for vote in stated if vote >= 0]
        best = max([*choices, due], key=lambda at: (choices.count(at) + (at == due), at == due))
        frames[i] = best
        due = best + 1
    return frames


def _unmeasured(table: Table, rows: np.ndarray, number: int, notes: list[str]) -> np.ndarray:
    """Rows with a number that is not finite, in columns that are finite in most rows of the episode."""
    bad = np.zeros(len(rows), bool)
    for name, missing in table.missing.items():
        here = missing[rows]
        if here.mean() > 0.5:
            notes.append(f"episode {number}: {name} is not finite in {int(here.sum())} of {len(rows)} rows, which stay")
        else:
            bad |= here
    return bad


class RowReader:
    """Rows of data files as columns; reading in order reads each file once."""

    def __init__(self, features: Mapping[str, dict]):
        self._features = features
        self._columns = [name for name, feature in features.items() if feature["dtype"] != "video"]
        self._path: Path | None = None

    def columns(self, piece: WholeRows) -> Iterator[dict[str, np.ndarray]]:
        """The piece's columns, some hundred rows at a time; pictures as their bytes."""
        begin, end = piece.row, piece.row + piece.count
        if self._path != piece.path or begin < self._at:
            self._path, self._at = piece.path, 0
            with open_parquet(piece.path) as opened:
                existing = set(opened.schema_arrow.names)
            wanted = [name for name in self._columns if name in existing]
            self._run = read_batches(piece.path, self._features, wanted)
            self._table: pa.Table | None = None
        while begin < end:
            if self._table is None or begin >= self._at + len(self._table):
                self._at, _, table = next(self._run, (end, 0, None))
                if table is None:
                    raise DatasetError(f"{piece.path} changed while it was read; try again when nothing writes to it.")
                self._table = None if isinstance(table, DatasetError) else table
                continue
            upto = min(end, self._at + len(self._table), begin + 256)
            yield self._arrays(self._table.slice(begin - self._at, upto - begin))
            begin = upto

    def _arrays(self, table: pa.Table) -> dict[str, np.ndarray]:
        arrays: dict[str, np.ndarray] = {}
        for name in table.column_names:
            feature = self._features[name]
            if feature["dtype"] == "image":
                column = np.empty(len(table), object)
                column[:] = [(value or {}).get("bytes") for value in table[name].to_pylist()]
                arrays[name] = column
            else:
                arrays[name] = to_numpy(table[name], tuple(feature["shape"]))
        return arrays


def true_runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """(begin, end) of each stretch in which the mask is True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2])]


def without_overlaps(pieces: Sequence[WholeRows]) -> Iterator[WholeRows]:
    """The pieces without rows that an earlier piece has too (of a copied file)."""
    taken: dict[int, set[int]] = {}
    for piece in pieces:
        seen = taken.setdefault(piece.number, set())
        mask = np.array([frame not in seen for frame in range(piece.frame, piece.frame + piece.count)], bool)
        for begin, end in true_runs(mask):
            yield piece.part(begin, end)
        seen.update(range(piece.frame, piece.frame + piece.count))


def message_of(error: BaseException) -> str:
    """The first sentence of an error, without its advice."""
    return (str(error).splitlines() or [type(error).__name__])[0].split(";")[0][:300]
