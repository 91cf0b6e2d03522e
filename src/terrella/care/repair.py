"""repair: writes a mended copy of a damaged recording that keeps every whole row; the original does not change."""

import math
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..core import files
from ..core.errors import DatasetError
from ..data import stats
from ..data.features import decode_picture, sensors_of
from ..data.format import ACTION_VALID, AUTOMATIC, INFO, TIME, Layout, schema, whole_rate
from ..data.source import is_action, is_outcome
from ..data.staged import LOG, Staged, picture_statistics, sampled_statistics
from ..data.storage import mp4
from ..data.storage.films import cut_video, whole_frames
from ..data.storage.tables import read_json
from ..data.writer import ROWS_PER_GROUP, Draft, Writer, fresh_folder
from .features import BROKEN, mended_features, schemas_of
from .footage import Footage
from .footers import rebuild_footer
from .pieces import RowReader, Table, WholeRows, message_of, pieces_of, read_table, true_runs, without_overlaps
from .streams import StreamMender, can_be_stored
from .survey import Survey, cameras_of, survey

_REBUILT = ".rebuilt"  # data files with new footers, while they are read
_INTERRUPTED = ".interrupted"  # the episode in flight, while it is read
_MOST_PIECES = 8  # a repair that makes more episodes than two of each plus this many asks first


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
    allow_loss: bool | Callable[[str], bool] = False,
) -> list[str]:
    """Writes a valid copy of all that is whole in `root` to `out`; returns sentences that say what was done.

    Whole episodes are copied bit for bit: the values of rows, the streams, the packets of videos. A damaged episode keeps
    every row that all its cameras show. It is split where rows are missing, or where a number is not finite in a column
    that is finite in most rows. Counters, timestamps, statistics and all of meta/ are computed from the rows. The
    unfinished episode of a killed recorder becomes an episode.

    keep:       numbers of the episodes to copy; None copies all.
    progress:   `progress(done, total)` is called after each piece of rows.
    allow_loss: what to do where most rows would be lost, or episodes cut to many pieces: True goes on; a function is
                given a sentence and returns whether to go on; False raises DatasetError.

    DatasetError, too, where `root` holds nothing whole, `out` is not empty, or the disk is full. Whatever happens, `out`
    is complete or does not exist.
    """
    root, out = Path(root), Path(out)
    source = survey(root)
    if out.resolve() == root.resolve() or root.resolve() in out.resolve().parents:
        raise DatasetError(f"the mended copy cannot lie in {root} itself; choose another folder for it.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} is not empty; choose another folder for the mended copy.")
    with files.creating(out) as staged:
        return _Mender(source, staged, keep, progress, allow_loss).mend()


class _Mender:
    """One repair: its notes, and for each episode the rows kept (as runs of frames) and why others were not."""

    def __init__(self, source: Survey, out: Path, keep: Collection[int] | None, progress, allow_loss):
        self.source, self.out, self.only, self.progress, self.allow_loss = source, out, keep, progress, allow_loss
        self.notes: list[str] = []
        self.kept: dict[int, list[tuple[int, int]]] = {}
        self.why: dict[int, str] = {}

    def mend(self) -> list[str]:
        source = self.source
        self.staged = _staged(source) if self.only is None else None
        self._features()
        self.streams = {name: sensor for name, sensor in source.streams.items() if can_be_stored(sensor)}
        self.notes += [f"stream {name!r:.100} cannot be stored" for name in source.streams if name not in self.streams]
        pieces = self._pieces()
        if not pieces and self.staged is None:
            raise DatasetError(f"nothing in {source.root} is whole; restore it from a copy.")
        self.tasks = _sentences(source, pieces, self.notes)
        self.footage = Footage(source, cameras_of(self.features), pieces, self.notes, self.why)
        self._ask(pieces, [end - begin for piece in pieces for begin, end in true_runs(self.footage.shown(piece))])
        self.writer = Writer(self.out, self._layout())
        self.reader = RowReader(self.features)
        staging = fresh_folder(self.writer.staging)
        self.stream_mender = StreamMender(source, self.features, self.streams, staging, self.notes)
        try:
            for done, piece in enumerate(pieces, 1):
                self._put(piece)
                if self.progress:
                    self.progress(done, len(pieces))
            self._ask(pieces, [end - begin for kept in self.kept.values() for begin, end in kept])
            self._summarise(pieces)
            self._recover()
            self.writer.tidy(0)
            if not self.writer.episodes:
                raise DatasetError(f"nothing of {source.root} can be kept: {'; '.join(self.notes) or 'no rows'}.")
        finally:
            self.writer.close()
            for folder in (self.writer.staging, self.out / _REBUILT, self.out / _INTERRUPTED):
                shutil.rmtree(folder, ignore_errors=True)
        self._keep_facts()
        return self.notes

    def _features(self) -> None:
        """Takes the features from the files, and corrects the rate in the facts of the videos."""
        source = self.source
        self.features = mended_features(
            source.root, source.features, source.data, source.films, source.video_path, self.notes
        )
        self.notes += [fault.what for fault in source.faults if fault.what.startswith("fps") and source.info]
        for name, feature in self.features.items():
            if isinstance(feature.get("info"), dict) and "video.fps" in feature["info"]:
                self.features[name] = {**feature, "info": {**feature["info"], "video.fps": source.fps}}

    def _ask(self, pieces: list[WholeRows], kept: list[int]) -> None:
        """Asks whether to go on where most rows would be lost, or episodes cut to many pieces. kept: lengths left of `pieces`."""
        rows, of, episodes = sum(kept), sum(piece.count for piece in pieces), len({piece.number for piece in pieces})
        if not rows or self.allow_loss is True or (2 * rows >= of and len(kept) <= 2 * episodes + _MOST_PIECES):
            return
        why = next(iter(self.why.values()), "others are damaged")
        sentence = f"only {rows} of {of} rows in {episodes} episodes would be kept, in {len(kept)} pieces ({why})"
        if not callable(self.allow_loss) or not self.allow_loss(f"{sentence}."):
            raise DatasetError(
                f"{sentence}; mend what the doctor names first, or allow the loss (--yes, in Python allow_loss=True)."
            )
        self.allow_loss = True

    def _layout(self) -> Layout:
        source, ours = self.source, ("version", "world", "sensors", "streams", "terminal")
        return _SameLayout(
            fps=whole_rate(source.fps), sensors=sensors_of(self.features, source.known), streams=self.streams,
            clock=TIME in self.features,
            pictures="png" if any(feature["dtype"] == "image" for feature in self.features.values()) else "video",
            robot=str(source.info.get("robot_type") or ("terrella" if source.ours else "")), world=source.world,
            facts={key: value for key, value in source.about.items() if key not in ours}, kept=self.features,
        )  # fmt: skip

    # -- which rows ---------------------------------------------------------------------------------------------

    def _pieces(self) -> list[WholeRows]:
        source, pieces = self.source, []
        named = list(dict.fromkeys(episode.data for episode in source.episodes.values()))
        for file in [*named, *(file for file in source.data if file not in set(named))]:
            try:
                pieces += pieces_of(source, self._table(file), self.notes)
            except BROKEN as error:
                self.notes.append(f"{file} cannot be read ({message_of(error)})")
                for episode in source.episodes.values():
                    if episode.data == file:
                        self.why[episode.number] = f"{file} cannot be read"
        if self.staged is not None:  # the staging folder has all of an episode whose commit was killed
            pieces = [piece for piece in pieces if piece.number < self.staged]
        order = {file: at for at, file in enumerate(named)}
        pieces.sort(key=lambda piece: (piece.number, order.get(piece.file, len(order)), piece.frame))
        return [piece for piece in without_overlaps(pieces) if self.only is None or piece.number in self.only]

    def _table(self, file: str) -> Table:
        """The counters of a data file; of a file without a footer, those of a copy with a new footer."""
        path = self.source.path(file)
        if not path.is_file():
            raise DatasetError("the file is missing")
        try:
            return read_table(self.source, file, path, self.features)
        except BROKEN as error:
            try:
                copy = self.out / _REBUILT / file
                form = next(schemas_of(self.source.root, self.source.data), None) or schema(self.features)
                rows = rebuild_footer(path, form, self.features, copy)
                table = read_table(self.source, file, copy, self.features)
            except (DatasetError, ValueError, pa.ArrowException):
                raise error from None
            self.notes.append(f"{file} has no readable footer: {rows} rows were recovered from its pages")
            return table

    # -- one piece ----------------------------------------------------------------------------------------------

    def _put(self, piece: WholeRows) -> None:
        """Makes episodes of those rows of a piece that all cameras show."""
        for begin, end in true_runs(self.footage.shown(piece)):
            part = piece.part(begin, end)
            if not self._tried(part):  # some frame cannot be decoded: try every one
                for a, b in true_runs(self.footage.shown(part, strict=True)):
                    self._tried(part.part(a, b))

    def _tried(self, piece: WholeRows) -> bool:
        try:
            draft, anew = self._draft(piece)
            self.writer.put(draft)
        except (DatasetError, ValueError, pa.ArrowException) as error:
            self.why[piece.number] = message_of(error)
            return False
        for camera in anew:
            what = f"the video of {camera} from frame {piece.frame} on is encoded again, not copied"
            self.notes.append(f"episode {piece.number}: {what}")
        self.kept.setdefault(piece.number, []).append((piece.frame, piece.frame + piece.count))
        return True

    def _draft(self, piece: WholeRows) -> tuple[Draft, list[str]]:
        """(draft for the writer, cameras whose video was encoded again); DatasetError where a frame cannot be decoded."""
        staging, videos, pictures, anew = self.writer.staging, {}, {}, []
        for camera in cameras_of(self.features):
            film, videos[camera] = self.footage.films[piece.number, camera], staging / f"{camera}.mp4"
            opened = self.footage.read_packets(film.file)
            if opened is None:
                raise DatasetError(f"{film.file} cannot be read")
            first, path = film.first + piece.frame, self.source.path(film.file)
            if not cut_video(path, first, piece.count, self.source.fps, videos[camera], opened):
                anew.append(camera)
            if not whole_frames(videos[camera], 0, piece.count, self.source.fps).all():
                raise DatasetError(f"{film.file} has frames that cannot be decoded")
            shown = mp4.Frames(videos[camera], 0, piece.count, self.source.fps)
            if shown[0].shape != tuple(self.features[camera]["shape"]):
                raise DatasetError(f"the pictures of {film.file} have another size than the others of {camera}")
            pictures[camera] = sampled_statistics(shown)
        listed = self.source.episodes.get(piece.number)
        streams, films, shift = self.stream_mender.cut_streams(piece)
        start_ns = None if listed is None or listed.start_ns is None else listed.start_ns + round(shift * 1e9)
        only = {} if listed is None or len(listed.tasks) != 1 else dict.fromkeys(piece.task.tolist(), listed.tasks[0])
        texts = {**self.tasks, **only, **self.source.tasks}
        tasks = [texts[int(task)] for task in piece.task]
        pictures |= self._image_statistics(piece)
        rows, counts = self._rows(piece, shift), self._counts(piece)
        return Draft(piece.count, rows, videos, pictures, tasks[0], streams, films, start_ns, tasks, counts), anew

    def _image_statistics(self, piece: WholeRows) -> dict[str, stats.Summary]:
        """Statistics of the pictures stored in rows, from a sample."""
        shapes = {name: tuple(f["shape"]) for name, f in self.features.items() if f["dtype"] == "image"}
        reader = RowReader({name: self.features[name] for name in shapes})
        return stats.merge(
            {
                name: picture_statistics(decode_picture({"bytes": columns[name][0]}, shape, name))
                for name, shape in shapes.items()
            }
            for columns in (reader.columns(piece) if shapes else ())
        )

    def _counts(self, piece: WholeRows) -> dict[str, int]:
        """Sensor -> rows up to the last that has it, where that is not the piece's last."""
        listed = self.source.episodes.get(piece.number)
        known = None if listed is None else listed.counts
        if known is None:
            length = piece.frame + piece.count if listed is None else listed.length
            ended = ACTION_VALID in self.features and self.source.about.get("terminal", True)
            known = {name: length - 1 for name in self.features if is_outcome(name)} if ended else {}
        known = {name: count for name, count in known.items() if name in self.features}
        kept = {name: min(max(0, count - piece.frame), piece.count) for name, count in known.items()}
        if listed is not None and piece.frame + piece.count < listed.length and ACTION_VALID in self.features:
            reader = RowReader({ACTION_VALID: self.features[ACTION_VALID]})  # the result of its last action is lost
            acted = np.flatnonzero(np.concatenate([part[ACTION_VALID].reshape(-1) for part in reader.columns(piece)]))
            last = int(acted[-1]) + 1 if len(acted) else 0
            kept |= {name: min(kept.get(name, last), last) for name in self.features if is_action(name)}
        return {name: count for name, count in kept.items() if count != piece.count}

    def _rows(self, piece: WholeRows, shift: float) -> Iterator[dict[str, np.ndarray]]:
        if all(feature["dtype"] == "video" or name in AUTOMATIC for name, feature in self.features.items()):
            yield from ({} for _ in range(0, piece.count, ROWS_PER_GROUP))
            return
        for columns in self.reader.columns(piece):
            if shift and TIME in columns:
                columns[TIME] = columns[TIME] - shift
            yield {name: column for name, column in columns.items() if name not in AUTOMATIC}

    def _summarise(self, pieces: list[WholeRows]) -> None:
        """Says which episodes are as they were, and which rows of the others are kept."""
        whole, rows = 0, 0
        lengths = {number: episode.length for number, episode in self.source.episodes.items()}
        for piece in pieces:
            if piece.number not in self.source.episodes:
                lengths[piece.number] = max(lengths.get(piece.number, 0), piece.frame + piece.count)
        for number, length in sorted(lengths.items()):
            kept = self.kept.get(number, [])
            if kept == [(0, length)]:
                whole, rows = whole + 1, rows + length
            elif (self.only is None or number in self.only) and (self.staged is None or number < self.staged):
                spans = ", ".join(f"{begin} to {end - 1}" for begin, end in kept)
                what = f"its rows {spans} of {length} are kept" if kept else f"none of its {length} rows is kept"
                why = self.why.get(number, "others are missing, damaged or hold what is no finite number")
                self.notes.append(f"episode {number}: {what}{' as episodes of their own' * (len(kept) > 1)} ({why})")
        self.notes.insert(
            0, f"{whole} whole episodes ({rows} rows) are carried over; counters, statistics and meta/ are made anew"
        )

    # -- what is left -------------------------------------------------------------------------------------------

    def _recover(self) -> None:
        """Makes an episode of what a killed recorder left in flight."""
        if self.staged is None:
            return
        copy, source = fresh_folder(self.out / _INTERRUPTED), self.source.root / ".staging"
        for file in source.iterdir():
            if file.name == LOG or file.name.endswith(".growing.mp4"):
                shutil.copyfile(self.source.path(f".staging/{file.name}"), copy / file.name)
        staged = Staged(copy)
        rows = staged.whole()
        if rows < 2:
            self.notes.append("the interrupted episode has fewer than 2 whole rows and is left out")
            return
        if not staged.fits(self.writer.layout):
            self.notes.append("the interrupted episode has other sensors than the rest and is left out")
            return
        try:
            draft = staged.draft(rows, staged.start_ns if self.writer.layout.clock else None)
            streams = {name: readings for name, readings in draft.streams.items() if name in self.streams}
            self.writer.put(replace(draft, streams=streams))
            self.notes.append(f"the interrupted episode is recovered up to its last whole row: {rows} rows")
        except (DatasetError, ValueError, KeyError, pa.ArrowException) as error:
            self.notes.append(f"the interrupted episode cannot be recovered ({message_of(error)})")

    def _keep_facts(self) -> None:
        """What else meta/info.json said stays."""
        info = read_json(self.out / INFO)
        if isinstance(info, dict) and self.source.info:
            kept = {key: value for key, value in self.source.info.items() if key not in info}
            if self.source.info.get("total_episodes") == info["total_episodes"] and "splits" in self.source.info:
                kept["splits"] = self.source.info["splits"]
            files.write_json(self.out / INFO, _finite({**info, **kept}))


def _finite(value: object) -> object:
    """A JSON value with null for each number that is not finite."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _staged(source: Survey) -> int | None:
    """The number of the interrupted episode in the staging folder; None where there is none that is not safe already."""
    if not source.ours:
        return None
    try:
        source.path(f".staging/{LOG}")
        number = Staged(source.root / ".staging").number
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DatasetError):
        return None
    total = source.info.get("total_episodes")
    missing = number == total if isinstance(total, int) else number not in source.episodes
    return number if missing else None


def _sentences(source: Survey, pieces: list[WholeRows], notes: list[str]) -> dict[int, str]:
    """task_index -> its sentence; where tasks.parquet is lost, by the episodes that have one task alone."""
    tasks = dict(source.tasks)
    for piece in pieces:
        listed = source.episodes.get(piece.number)
        if listed and len(listed.tasks) == 1 and len(set(piece.task.tolist())) == 1:
            tasks.setdefault(int(piece.task[0]), listed.tasks[0])
    lost = sorted({int(task) for piece in pieces for task in piece.task} - set(tasks))
    if lost:
        notes.append(f"the sentences of {len(lost)} tasks are lost: they are called 'task {lost[0]}' and so on")
    return tasks | {task: f"task {task}" for task in lost}
