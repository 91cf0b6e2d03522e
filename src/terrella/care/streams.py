"""Streams next to the rows: what a doctor finds in them, and how a repair cuts them to the pieces of an episode."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import DatasetError
from ..data.format import TIME, stream_path
from ..data.meta import Episode
from ..data.source import Sensor
from ..data.storage import mp4
from ..data.storage.films import cut_video, read_packets, whole_frames
from ..data.storage.tables import read_whole
from ..data.writer import NAME
from .features import BROKEN
from .pieces import RowReader, WholeRows, message_of
from .survey import LEFTOVER, RESTORE, Fault, Survey, list_files


def examine_streams(survey: Survey, busy: bool) -> Iterator[Fault]:
    """Every stream of every episode: its times ascend, its values are of its shape, its film is as long as its times."""
    files = set(list_files(survey.root, "streams", ".parquet")) | set(list_files(survey.root, "streams", ".mp4"))
    known: set[str] = set()
    for name, sensor in survey.streams.items():
        for episode in survey.episodes.values():
            place, film = _places(name, episode.number)
            known |= {place, film}
            if place in files:
                yield from _stream(survey, sensor, episode, film in files)
            elif film in files:
                yield Fault(film, episode.start, "the times of this film are missing", RESTORE)
        if survey.episodes and not any(_places(name, number)[0] in files for number in survey.episodes):
            what = f"stream '{name}' is declared in meta/terrella.json, but no episode has any of it"
            yield Fault(f"streams/{name}", None, what, "restore its files from a copy, or record anew")
    if survey.complete and not busy:
        for file in sorted(files - known):
            yield Fault(file, None, "no episode and no stream of meta/terrella.json uses this file", LEFTOVER)


def _stream(survey: Survey, sensor: Sensor, episode: Episode, has_film: bool) -> Iterator[Fault]:
    place, film = _places(sensor.name, episode.number)
    try:
        time_s, _ = _readings(survey.path(place), sensor)
    except DatasetError:
        yield Fault(place, episode.start, "the table is missing, truncated or not parquet", RESTORE)
        return
    except BROKEN as error:
        yield Fault(place, episode.start, f"it holds no readings ({error})", RESTORE)
        return
    for at in np.flatnonzero(~_in_order(time_s))[:1]:
        what = f"reading {at} of stream '{sensor.name}' is at {time_s[at]:g} s, which does not ascend"
        yield Fault(place, episode.start, what, "let --repair leave out the readings that are out of order")
    if sensor.kind != "image":
        return
    if not has_film:
        yield Fault(film, episode.start, f"the film of stream '{sensor.name}' is missing", RESTORE)
        return
    rate = sensor.rate_hz or survey.fps
    try:
        packets = read_packets(survey.path(film), rate)
    except DatasetError:
        yield Fault(film, episode.start, "the video is truncated or not mp4", RESTORE)
        return
    if packets.count != len(time_s):
        what = f"the film has {packets.count} frames, its table {len(time_s)} times"
        yield Fault(film, episode.start, what, "let --repair keep the frames that have a time")
        return
    try:
        if packets.zeroed.any():
            raise DatasetError("zeros")
        shown = mp4.Frames(survey.path(film), 0, len(time_s), rate)
        for at in {0, len(time_s) - 1} if len(time_s) else ():
            shown[at]
    except DatasetError:
        yield Fault(film, episode.start, "frames of the film cannot be decoded", "let --repair keep those before them")


@dataclass(frozen=True)
class StreamMender:
    """Cuts streams to pieces of rows; films go to the folder `staging`, what was left out is added to `notes`."""

    survey: Survey
    features: Mapping[str, dict]
    streams: Mapping[str, Sensor]
    staging: Path
    notes: list[str]

    def cut_streams(self, piece: WholeRows) -> tuple[dict, dict, float]:
        """(readings by stream, films by stream, seconds from the episode's time 0 to the piece's own)."""
        begin, end, shift = self._times(piece)
        return *self._streams(piece.number, begin, end, shift), shift

    def _times(self, piece: WholeRows) -> tuple[float, float, float]:
        """(begin, end, shift): true times between which streams belong to the piece, and its own time 0."""
        if piece.whole or not self.streams:
            return -np.inf, np.inf, 0.0
        fps = self.survey.fps
        episode = self.survey.episodes.get(piece.number)
        time_s = piece.frame + np.arange(piece.count) / fps
        if TIME in self.features:
            time_s = np.concatenate([columns[TIME].reshape(-1) for columns in RowReader(self.features).columns(piece)])
        first, last = piece.frame == 0, episode is not None and piece.frame + piece.count == episode.length
        shift = 0.0 if first else float(time_s[0])
        return (-np.inf if first else float(time_s[0])), (np.inf if last else float(time_s[-1]) + 1 / fps), shift

    def _streams(self, number: int, begin: float, end: float, shift: float) -> tuple[dict, dict]:
        streams, films = {}, {}
        for name, sensor in self.streams.items():
            place, film = _places(name, number)
            try:
                if not self.survey.path(place).exists():
                    continue
                time_s, values = _readings(self.survey.path(place), sensor)
                keep = _in_order(time_s) & (time_s >= begin) & (time_s < end)
                if sensor.kind == "image":
                    at = self._stream_film(name, sensor, film, np.flatnonzero(keep))
                    if not len(at):
                        continue
                    films[name] = self.staging / f"stream-{name}.mp4"
                    streams[name] = [(float(time_s[i] - shift), None) for i in at]
                else:
                    streams[name] = [(float(time_s[i] - shift), values[i]) for i in np.flatnonzero(keep)]
                if not keep.all() and np.isinf(begin) and np.isinf(end):
                    self.notes.append(
                        f"episode {number}: {int((~keep).sum())} readings of stream {name} were out of order and left out"
                    )
            except BROKEN as error:
                self.notes.append(f"episode {number}: stream {name} is left out ({message_of(error)})")
        return streams, films

    def _stream_film(self, name: str, sensor: Sensor, film: str, wanted: np.ndarray) -> np.ndarray:
        """Cuts the wanted frames out of a stream's film, up to the first that is damaged; returns which they are."""
        rate, path = sensor.rate_hz or self.survey.fps, self.survey.path(film)
        opened = read_packets(path, rate)
        good = np.append(whole_frames(path, 0, opened.count, rate), False)
        follows_on = np.diff(wanted, prepend=wanted[:1] - 1) == 1
        bad = np.flatnonzero(~(good[wanted.clip(max=opened.count)] & follows_on))
        usable = wanted[: bad[0]] if len(bad) else wanted
        if len(usable):
            cut_video(path, int(usable[0]), len(usable), rate, self.staging / f"stream-{name}.mp4", opened)
        return usable


def can_be_stored(sensor: Sensor) -> bool:
    """Whether a recording can hold the stream."""
    sizes = sensor.shape[1:] if sensor.kind == "points" else sensor.shape
    odd = sensor.kind == "image" and any(size % 2 for size in sensor.shape[:2])
    return bool(NAME.fullmatch(sensor.name)) and bool(sizes) and min(sizes) > 0 and not odd and sensor.dtype != "string"


def _places(name: str, number: int) -> tuple[str, str]:
    """The table and the film of a stream in an episode."""
    return stream_path(name, number, "parquet"), stream_path(name, number, "mp4")


def _readings(path: Path, sensor: Sensor) -> tuple[np.ndarray, list[np.ndarray]]:
    """(times, values, [] of a camera); DatasetError or ValueError where they are none of the sensor's."""
    table = read_whole(path)
    time_s = table["time_s"].to_numpy().astype(np.float64)
    if sensor.kind == "image":
        return time_s, []
    value = table["value"].combine_chunks()
    if value.null_count or value.values.null_count:
        raise ValueError("a reading is null")
    flat, offsets = value.values.to_numpy(zero_copy_only=False), value.offsets.to_numpy()
    sizes = np.diff(offsets)
    each = sensor.shape[1] if sensor.kind == "points" else int(np.prod(sensor.shape))
    for wrong in np.flatnonzero(sizes % each if sensor.kind == "points" else sizes != each)[:1]:
        raise ValueError(f"reading {wrong} has {sizes[wrong]} numbers, which is no {sensor.kind} of {sensor.shape}")
    return time_s, [flat[begin:end] for begin, end in zip(offsets, offsets[1:])]


def _in_order(time_s: np.ndarray) -> np.ndarray:
    """bool [n]: the readings that are at a finite time, none of them before one that came earlier."""
    finite = np.isfinite(time_s)
    return finite & (time_s >= np.maximum.accumulate(np.where(finite, time_s, -np.inf)))
