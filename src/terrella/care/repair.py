"""repair: writes a mended copy of a damaged recording that keeps every whole row; the original is not touched."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..core.errors import DatasetError
from ..data import stats
from ..data.dataset import decoded
from ..data.episodes import Film
from ..data.format import (
    ACTION_VALID,
    AUTOMATIC,
    INFO,
    STREAM_PATH,
    TIME,
    Layout,
    fill,
    schema,
    sensors_of,
    tidy,
    where,
)
from ..data.source import Sensor, follows, is_action
from ..data.staged import LOG, Staged
from ..data.storage import durable, mp4
from ..data.storage.films import Reel, cut, reel, whole_frames
from ..data.storage.tables import read_json
from ..data.writer import NAME, ROWS_PER_GROUP, Draft, Writer, fresh
from .footers import rebuild
from .pieces import Piece, RowReader, Table, as_found, pieces_of, read_table, runs, uncovered
from .survey import Survey, survey
from .tables import open_parquet, read_whole

_REBUILT = ".rebuilt"  # data files with new footers, while they are read
_INTERRUPTED = ".interrupted"  # the episode in flight, while it is read
_LOOKED_AT = 24  # pictures of an episode for the statistics, the first and the last among them
_BROKEN = (DatasetError, OSError, pa.ArrowException, ValueError, KeyError, TypeError, AttributeError)


@dataclass(frozen=True)
class _SameLayout(Layout):
    """A layout with the features of another recording exactly as they are."""

    kept: Mapping[str, dict] = field(default_factory=dict)

    def features(self) -> dict[str, dict]:
        return dict(self.kept)


def repair(
    root: str | Path,
    out: str | Path,
    keep: Collection[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Writes a sound copy of what is whole in `root` to `out`; returns, in sentences, what was done.

    Whole episodes are carried over bit for bit: their rows' values, their streams, their videos' packets. Of a damaged
    one every row is kept that all its cameras still show; where rows are missing in the middle, or one holds a number
    that is not finite (in a column that mostly does), the episode is split there. Counters, timestamps, statistics and
    all of meta/ are made anew from the rows; an interrupted episode of a killed recorder is made an episode. `keep`: only
    the episodes of these numbers. `progress(pieces, of)` is called after each piece of rows is written. DatasetError
    where `root` holds nothing whole, or `out` is in use, or the disk is full.
    """
    root, out = Path(root), Path(out)
    found = survey(root)
    if out.resolve() == root.resolve() or root.resolve() in out.resolve().parents:
        raise DatasetError(f"the mended copy cannot lie in {root} itself; choose another folder for it.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} is not empty; choose another folder for the mended copy.")
    try:
        return _Mender(found, out, keep, progress).mend()
    except OSError as error:
        raise DatasetError(f"the mended copy at {out} cannot be written ({error}); free some space there.") from error


class _Mender:
    """One repair: what was said, and of each episode which rows were kept (as runs of frames) and why others were not."""

    def __init__(self, found: Survey, out: Path, keep: Collection[int] | None, progress):
        self.found, self.out, self.only, self.progress = found, out, keep, progress
        self.said: list[str] = []
        self.reels: dict[str, Reel | None] = {}
        self.kept: dict[int, list[tuple[int, int]]] = {}
        self.why: dict[int, str] = {}

    def mend(self) -> list[str]:
        found = self.found
        self.staged = _staged(found) if self.only is None else None
        self.features = as_found(found, self.said)
        self.streams = {name: sensor for name, sensor in found.streams.items() if _possible(sensor)}
        self.said += [
            f"stream {name!r:.100} is none that can be kept" for name in found.streams if name not in self.streams
        ]
        pieces = self._pieces()
        if not pieces and self.staged is None:
            raise DatasetError(f"nothing in {found.root} is whole; restore it from a copy.")
        self.tasks = _sentences(found, pieces, self.said)
        self.films = self._films(pieces)
        self.writer = Writer(self.out, self._layout())
        self.reader = RowReader(self.features)
        fresh(self.writer.staging)
        try:
            for done, piece in enumerate(pieces, 1):
                self._put(piece)
                if self.progress:
                    self.progress(done, len(pieces))
            self._summarise(pieces)
            self._recover()
            self.writer.tidy(0)
            if not self.writer.episodes:
                raise DatasetError(
                    f"nothing of {found.root} could be kept: {'; '.join(self.said) or 'it has no rows'}."
                )
        finally:
            self.writer.close()
            for folder in (self.writer.staging, self.out / _REBUILT, self.out / _INTERRUPTED):
                shutil.rmtree(folder, ignore_errors=True)
        self._keep_facts()
        return self.said

    def _layout(self) -> Layout:
        found, ours = self.found, ("version", "world", "sensors", "streams", "terminal")
        return _SameLayout(
            fps=tidy(found.fps),
            sensors=sensors_of(self.features, found.known),
            streams=self.streams,
            clock=TIME in self.features,
            pictures="png" if any(feature["dtype"] == "image" for feature in self.features.values()) else "video",
            robot=str(found.info.get("robot_type") or ("terrella" if found.ours else "")),
            world=found.world,
            facts={key: value for key, value in found.about.items() if key not in ours},
            kept=self.features,
        )

    # -- which rows ---------------------------------------------------------------------------------------------

    def _pieces(self) -> list[Piece]:
        found, pieces = self.found, []
        named = list(dict.fromkeys(episode.data for episode in found.told.values()))
        for file in [*named, *(file for file in found.data if file not in set(named))]:
            try:
                pieces += pieces_of(found, self._table(file), self.said)
            except _BROKEN as error:
                self.said.append(f"{file} cannot be read ({_short(error)})")
                for episode in found.told.values():
                    if episode.data == file:
                        self.why[episode.number] = f"{file} cannot be read"
        if self.staged is not None:  # of an episode whose commit was killed, the staging folder has all
            pieces = [piece for piece in pieces if piece.number < self.staged]
        order = {file: at for at, file in enumerate(named)}
        pieces.sort(key=lambda piece: (piece.number, order.get(piece.file, len(order)), piece.frame))
        return [piece for piece in uncovered(pieces) if self.only is None or piece.number in self.only]

    def _table(self, file: str) -> Table:
        """A data file's counters; where it has no footer any more, those of a copy with a new one."""
        path = self.found.path(file)
        if not path.is_file():
            raise DatasetError("the file is missing")
        try:
            return read_table(self.found, file, path, self.features)
        except _BROKEN as error:
            try:
                copy = self.out / _REBUILT / file
                rows = rebuild(path, self._form(), self.features, copy)
                table = read_table(self.found, file, copy, self.features)
            except (DatasetError, ValueError, pa.ArrowException):
                raise error from None
            self.said.append(f"{file} has no footer that can be read: {rows} rows were found by its pages")
            return table

    def _form(self) -> pa.Schema:
        """The columns of a data file, as another one has them; where all are damaged, as they should be."""
        for file in self.found.data:
            try:
                with open_parquet(self.found.path(file)) as opened:
                    return opened.schema_arrow
            except _BROKEN:
                continue
        return schema(self.features)

    # -- videos -------------------------------------------------------------------------------------------------

    def _cameras(self) -> list[str]:
        return [name for name, feature in self.features.items() if feature["dtype"] == "video"]

    def _reel(self, file: str) -> Reel | None:
        """The packets of a video; None where it cannot be read."""
        if file not in self.reels:
            try:
                self.reels[file] = reel(self.found.path(file), self.found.fps)
            except _BROKEN as error:
                self.said.append(f"{file} cannot be read ({_short(error)})")
                self.reels[file] = None
        return self.reels[file]

    def _films(self, pieces: list[Piece]) -> dict[tuple[int, str], Film]:
        """(episode, camera) -> where its pictures lie: as meta/episodes tells, or by counting frames where it does not."""
        films = {(n, camera): film for n, episode in self.found.told.items() for camera, film in episode.films.items()}
        lengths: dict[int, int] = {}
        for piece in pieces:
            lengths[piece.number] = max(lengths.get(piece.number, 0), piece.frame + piece.count)
        for camera in self._cameras():
            unknown = [number for number in lengths if (number, camera) not in films]
            if unknown:
                films |= self._placed(camera, lengths, unknown)
        return films

    def _placed(self, camera: str, lengths: Mapping[int, int], unknown: list[int]) -> dict[tuple[int, str], Film]:
        """Of episodes that meta/episodes does not tell of: files of their own by their number, else one after another."""
        own = {n: fill(self.found.video_path, video_key=camera, **where(n)) for n in lengths}
        files = [file for file in self.found.films if f"/{camera}/" in f"/{file}"]
        if self.found.ours or set(files) >= set(own.values()):
            return {(n, camera): Film(own[n], 0) for n in unknown if own[n] in files}
        placed, rest = {}, sorted(lengths)
        for file in files:
            opened = self._reel(file)
            room, first = (opened.count if opened else 0), 0
            while rest and first + lengths[rest[0]] <= room:
                placed[rest[0], camera] = Film(file, first)
                first += lengths[rest.pop(0)]
            if first != room:
                self.said.append(
                    f"{file} has {room} frames, {first} of them of whole episodes: what follows cannot be told apart"
                )
                break
        found = {(n, camera): placed[n, camera] for n in unknown if (n, camera) in placed}
        if found:
            self.said.append(f"{len(found)} episodes were found in the videos of {camera} by counting frames")
        return found

    # -- one piece ----------------------------------------------------------------------------------------------

    def _put(self, piece: Piece) -> None:
        """Makes episodes of the rows of a piece that all cameras show."""
        for begin, end in runs(self._shown(piece, False)):
            part = piece.part(begin, end)
            if not self._tried(part):  # a frame that is there cannot be decoded: all are tried
                for a, b in runs(self._shown(part, True)):
                    self._tried(part.part(a, b))

    def _tried(self, piece: Piece) -> bool:
        try:
            draft, anew = self._draft(piece)
            self.writer.put(draft)
        except (DatasetError, ValueError, pa.ArrowException) as error:
            self.why[piece.number] = _short(error)
            return False
        for camera in anew:
            what = f"the video of {camera} from frame {piece.frame} on is encoded again, as no copy could begin there"
            self.said.append(f"episode {piece.number}: {what}")
        self.kept.setdefault(piece.number, []).append((piece.frame, piece.frame + piece.count))
        return True

    def _shown(self, piece: Piece, strict: bool) -> np.ndarray:
        """bool [count]: rows that all cameras show; strict: every frame is decoded."""
        shown = np.ones(piece.count, bool)
        for camera in self._cameras():
            film = self.films.get((piece.number, camera))
            opened = self._reel(film.file) if film else None
            there = np.zeros(piece.count, bool)
            if film and opened:
                first = film.first + piece.frame
                there = np.isin(first + np.arange(piece.count), opened.frames)
                if strict:
                    there &= whole_frames(self.found.path(film.file), first, piece.count, self.found.fps)
            if not there.all():
                self.why[piece.number] = f"{film.file if film else f'no video of {camera}'} shows no more"
            shown &= there
        return shown

    def _draft(self, piece: Piece) -> tuple[Draft, list[str]]:
        """(what the writer takes, cameras whose video was encoded again); DatasetError where a frame cannot be decoded."""
        staging, videos, pictures, anew = self.writer.staging, {}, {}, []
        looked_at = np.unique(np.linspace(0, piece.count - 1, _LOOKED_AT).round().astype(int)).tolist()
        for camera in self._cameras():
            film, videos[camera] = self.films[piece.number, camera], staging / f"{camera}.mp4"
            opened = self._reel(film.file)
            if opened is None:
                raise DatasetError(f"{film.file} cannot be read")
            first, path = film.first + piece.frame, self.found.path(film.file)
            if not cut(path, first, piece.count, self.found.fps, videos[camera], opened):
                anew.append(camera)
            if not whole_frames(videos[camera], 0, piece.count, self.found.fps).all():
                raise DatasetError(f"{film.file} has frames that cannot be decoded")
            some = mp4.frames_at(videos[camera], looked_at, self.found.fps)
            if some.shape[1:] != tuple(self.features[camera]["shape"]):
                raise DatasetError(f"the pictures of {film.file} have another size than the others of {camera}")
            pictures[camera] = stats.summarise_pictures(some[:, ::4, ::4])
        told = self.found.told.get(piece.number)
        begin, end, shift = self._times(piece)
        streams, films = self._streams(piece.number, begin, end, shift)
        start_ns = None if told is None or told.start_ns is None else told.start_ns + round(shift * 1e9)
        only = {} if told is None or len(told.tasks) != 1 else dict.fromkeys(piece.task.tolist(), told.tasks[0])
        texts = {**self.tasks, **only, **self.found.tasks}
        tasks = [texts[int(task)] for task in piece.task]
        pictures |= self._image_statistics(piece)
        rows, counts = self._rows(piece, shift), self._counts(piece)
        return Draft(piece.count, rows, videos, pictures, tasks[0], streams, films, start_ns, tasks, counts), anew

    def _image_statistics(self, piece: Piece) -> dict[str, stats.Summary]:
        """Of pictures that the rows hold themselves, from some of them."""
        names = [name for name, feature in self.features.items() if feature["dtype"] == "image"]
        parts = []
        for columns in RowReader({name: self.features[name] for name in names}).columns(piece) if names else ():
            for name in names:
                some = decoded({"bytes": columns[name][0]}, tuple(self.features[name]["shape"]), name)
                parts.append({name: stats.summarise_pictures(some[None, ::4, ::4])})
        return stats.merge(parts)

    def _counts(self, piece: Piece) -> dict[str, int]:
        """Sensor -> rows up to the last that has it, where that is not the piece's last."""
        told = self.found.told.get(piece.number)
        known = None if told is None else told.counts
        if known is None:
            length = piece.frame + piece.count if told is None else told.length
            ended = ACTION_VALID in self.features and self.found.about.get("terminal", True)
            known = {name: length - 1 for name in self.features if follows(name)} if ended else {}
        kept = {
            name: min(max(0, count - piece.frame), piece.count)
            for name, count in known.items()
            if name in self.features
        }
        if told is not None and piece.frame + piece.count < told.length and ACTION_VALID in self.features:
            reader = RowReader({ACTION_VALID: self.features[ACTION_VALID]})  # what comes after its last row is gone
            acted = np.flatnonzero(np.concatenate([part[ACTION_VALID].reshape(-1) for part in reader.columns(piece)]))
            last = int(acted[-1]) + 1 if len(acted) else 0
            kept |= {name: min(kept.get(name, last), last) for name in self.features if is_action(name)}
        return {name: count for name, count in kept.items() if count != piece.count}

    def _rows(self, piece: Piece, shift: float) -> Iterator[dict[str, np.ndarray]]:
        if all(feature["dtype"] == "video" or name in AUTOMATIC for name, feature in self.features.items()):
            yield from ({} for _ in range(0, piece.count, ROWS_PER_GROUP))
            return
        for columns in self.reader.columns(piece):
            if shift and TIME in columns:
                columns[TIME] = columns[TIME] - shift
            yield {name: column for name, column in columns.items() if name not in AUTOMATIC}

    def _summarise(self, pieces: list[Piece]) -> None:
        """Says which episodes are as they were, and which rows of the others are kept."""
        whole, rows = 0, 0
        lengths = {number: episode.length for number, episode in self.found.told.items()}
        for piece in pieces:
            if piece.number not in self.found.told:
                lengths[piece.number] = max(lengths.get(piece.number, 0), piece.frame + piece.count)
        for number, length in sorted(lengths.items()):
            kept = self.kept.get(number, [])
            if kept == [(0, length)]:
                whole, rows = whole + 1, rows + length
            elif self.staged is None or number < self.staged:
                spans = ", ".join(f"{begin} to {end - 1}" for begin, end in kept)
                what = f"its rows {spans} of {length} are kept" if kept else f"none of its {length} rows is kept"
                why = self.why.get(number, "others are missing, damaged or hold what is no finite number")
                self.said.append(f"episode {number}: {what}{' as episodes of their own' * (len(kept) > 1)} ({why})")
        self.said.insert(
            0, f"{whole} whole episodes ({rows} rows) are carried over; counters, statistics and meta/ are made anew"
        )

    # -- streams ------------------------------------------------------------------------------------------------

    def _times(self, piece: Piece) -> tuple[float, float, float]:
        """(begin, end, shift): true times between which streams belong to the piece, and its own time 0."""
        if piece.whole or not self.streams:
            return -np.inf, np.inf, 0.0
        fps = self.found.fps
        told = self.found.told.get(piece.number)
        time_s = piece.frame + np.arange(piece.count) / fps
        if TIME in self.features:
            time_s = np.concatenate([columns[TIME].reshape(-1) for columns in RowReader(self.features).columns(piece)])
        first, last = piece.frame == 0, told is not None and piece.frame + piece.count == told.length
        shift = 0.0 if first else float(time_s[0])
        return (-np.inf if first else float(time_s[0])), (np.inf if last else float(time_s[-1]) + 1 / fps), shift

    def _streams(self, number: int, begin: float, end: float, shift: float) -> tuple[dict, dict]:
        streams, films = {}, {}
        for name, sensor in self.streams.items():
            place = STREAM_PATH.format(name=name, suffix="parquet", **where(number))
            try:
                if not self.found.path(place).exists():
                    continue
                time_s, values = _readings(self.found.path(place), sensor)
                keep = _ascending(time_s) & (time_s >= begin) & (time_s < end)
                if sensor.kind == "image":
                    film = STREAM_PATH.format(name=name, suffix="mp4", **where(number))
                    at = self._stream_film(name, sensor, film, np.flatnonzero(keep))
                    if not len(at):
                        continue
                    films[name] = self.writer.staging / f"stream-{name}.mp4"
                    streams[name] = [(float(time_s[i] - shift), None) for i in at]
                else:
                    streams[name] = [(float(time_s[i] - shift), values[i]) for i in np.flatnonzero(keep)]
                if not keep.all() and np.isinf(begin) and np.isinf(end):
                    self.said.append(
                        f"episode {number}: {int((~keep).sum())} readings of stream {name} were out of order and left out"
                    )
            except _BROKEN as error:
                self.said.append(f"episode {number}: stream {name} cannot be read ({_short(error)}) and is left out")
        return streams, films

    def _stream_film(self, name: str, sensor: Sensor, film: str, wanted: np.ndarray) -> np.ndarray:
        """Cuts the wanted frames out of a stream's film, up to the first that is damaged; returns which they are."""
        rate, path = sensor.rate_hz or self.found.fps, self.found.path(film)
        opened = reel(path, rate)
        good = np.append(whole_frames(path, 0, opened.count, rate), False)
        follows_on = np.diff(wanted, prepend=wanted[:1] - 1) == 1
        bad = np.flatnonzero(~(good[wanted.clip(max=opened.count)] & follows_on))
        there = wanted[: bad[0]] if len(bad) else wanted
        if len(there):
            target = self.writer.staging / f"stream-{name}.mp4"
            cut(path, int(there[0]), len(there), rate, target, opened)
        return there

    # -- what is left -------------------------------------------------------------------------------------------

    def _recover(self) -> None:
        """Makes an episode of what a killed recorder left in flight."""
        if self.staged is None:
            return
        copy, source = fresh(self.out / _INTERRUPTED), self.found.root / ".staging"
        for file in source.iterdir():
            if file.name == LOG or file.name.endswith(".growing.mp4"):
                shutil.copyfile(self.found.path(f".staging/{file.name}"), copy / file.name)
        staged = Staged(copy)
        rows = staged.whole()
        if rows < 2:
            self.said.append("the interrupted episode has fewer than 2 whole rows and is left out")
            return
        if not staged.fits(self.writer.layout):
            self.said.append("the interrupted episode has other sensors than the rest and is left out")
            return
        try:
            draft = staged.draft(rows, staged.start_ns if self.writer.layout.clock else None)
            streams = {name: readings for name, readings in draft.streams.items() if name in self.streams}
            self.writer.put(replace(draft, streams=streams))
            self.said.append(f"the interrupted episode is recovered up to its last whole row: {rows} rows")
        except (DatasetError, ValueError, KeyError, pa.ArrowException) as error:
            self.said.append(f"the interrupted episode cannot be recovered ({_short(error)})")

    def _keep_facts(self) -> None:
        """What else meta/info.json said stays."""
        told = read_json(self.out / INFO)
        if isinstance(told, dict) and self.found.info:
            kept = {key: value for key, value in self.found.info.items() if key not in told}
            if self.found.info.get("total_episodes") == told["total_episodes"] and "splits" in self.found.info:
                kept["splits"] = self.found.info["splits"]
            durable.write_json(self.out / INFO, json.loads(json.dumps({**told, **kept}).replace("NaN", "null")))


def _staged(found: Survey) -> int | None:
    """The number of the interrupted episode in the staging folder; None where there is none that is not safe already."""
    if not found.ours:
        return None
    try:
        found.path(f".staging/{LOG}")
        number = Staged(found.root / ".staging").number
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DatasetError):
        return None
    total = found.info.get("total_episodes")
    missing = number == total if isinstance(total, int) else number not in found.told
    return number if missing else None


def _possible(sensor: Sensor) -> bool:
    """Whether a recording can hold the stream."""
    sizes = sensor.shape[1:] if sensor.kind == "points" else sensor.shape
    odd = sensor.kind == "image" and any(size % 2 for size in sensor.shape[:2])
    return bool(NAME.fullmatch(sensor.name)) and bool(sizes) and min(sizes) > 0 and not odd and sensor.dtype != "string"


def _sentences(found: Survey, pieces: list[Piece], said: list[str]) -> dict[int, str]:
    """task_index -> its sentence; where tasks.parquet is lost, by the episodes that have one task alone."""
    tasks = dict(found.tasks)
    for piece in pieces:
        told = found.told.get(piece.number)
        if told and len(told.tasks) == 1 and len(set(piece.task.tolist())) == 1:
            tasks.setdefault(int(piece.task[0]), told.tasks[0])
    lost = sorted({int(task) for piece in pieces for task in piece.task} - set(tasks))
    if lost:
        said.append(f"the sentences of {len(lost)} tasks are lost: they are called 'task {lost[0]}' and so on")
    return tasks | {task: f"task {task}" for task in lost}


def _readings(path: Path, sensor: Sensor) -> tuple[np.ndarray, list[np.ndarray]]:
    table = read_whole(path)
    time_s = table["time_s"].to_numpy().astype(np.float64)
    if sensor.kind == "image":
        return time_s, []
    value = table["value"].combine_chunks()
    flat, offsets = value.values.to_numpy(zero_copy_only=False), value.offsets.to_numpy()
    return time_s, [flat[begin:end] for begin, end in zip(offsets, offsets[1:])]


def _ascending(time_s: np.ndarray) -> np.ndarray:
    """bool [n]: the readings that are at a finite time, none of them before one that came earlier."""
    finite = np.isfinite(time_s)
    newest = np.maximum.accumulate(np.where(finite, time_s, -np.inf))
    return finite & (time_s >= newest)


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].split(";")[0][:300]
