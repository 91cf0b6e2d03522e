"""What a doctor finds in videos and streams: lengths against rows and times, files that cannot be read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..core.errors import DatasetError
from ..data.format import STREAM_PATH, where
from ..data.source import Sensor
from ..data.storage import mp4
from ..data.storage.films import Reel, reel
from .survey import LEFTOVER, RESTORE, Fault, Survey, Told, listed
from .tables import read_whole

_SHORTEN = "let --repair keep the rows that the video shows"


@dataclass
class Shown:
    """digests: number of an episode -> what its pictures are; static: episodes whose pictures do not change."""

    digests: dict[int, hashlib.blake2b] = field(default_factory=dict)
    static: set[int] = field(default_factory=set)


def examine_films(survey: Survey, shown: Shown, busy: bool) -> Iterator[Fault]:
    """Every video that meta/episodes names: its packets are read, the first and last frame of each episode decoded."""
    named: dict[tuple[str, str], list[Told]] = {}
    for episode in survey.told.values():
        for camera, film in episode.films.items():
            named.setdefault((camera, film.file), []).append(episode)
    there = set(survey.films)
    for (camera, file), episodes in named.items():
        if file in there:
            yield from _film(survey, camera, file, episodes, shown)
        else:
            yield from (Fault(file, episode.start, "the video is missing", RESTORE) for episode in episodes)
    if survey.complete and not busy:
        for file in sorted(there - {file for _, file in named}):
            yield Fault(file, None, "no episode of info.json uses this file", LEFTOVER)


def _film(survey: Survey, camera: str, file: str, episodes: list[Told], shown: Shown) -> Iterator[Fault]:
    first = min(episode.start for episode in episodes)
    try:
        found = reel(survey.path(file), survey.fps)
    except DatasetError:
        yield Fault(file, first, "the video is truncated or not mp4", RESTORE)
        return
    count, needed = found.count, 0
    for episode in sorted(episodes, key=lambda episode: episode.films[camera].first):
        begin = episode.films[camera].first
        end = begin + episode.length
        if begin < needed:
            what = f"episode {episode.number} begins at frame {begin}, which the episode before it shows too"
            yield Fault(file, episode.start, what, "let --repair count anew where the episodes lie in the video")
        needed = max(needed, end)
        if end > count:
            what = f"the video has {count} frames, episode {episode.number} needs {end}"
            yield Fault(file, episode.start + max(0, min(count - begin, episode.length - 1)), what, _SHORTEN)
        elif episode.length:
            yield from _decoded(survey, camera, episode, found, shown)
    if len(found.frames) > needed + (len(episodes) > 1):
        what = f"the video has {len(found.frames)} frames, its episodes need {needed}"
        yield Fault(file, first, what, "let --repair leave out the frames that belong to no row")


def _decoded(survey: Survey, camera: str, episode: Told, found: Reel, shown: Shown) -> Iterator[Fault]:
    film, shape = episode.films[camera], tuple(survey.features[camera]["shape"])
    ends = sorted({film.first, film.first + episode.length - 1})
    try:
        pictures = mp4.frames_at(survey.path(film.file), ends, survey.fps)
    except DatasetError:
        yield Fault(film.file, episode.start, "the video's first or last frame cannot be decoded", RESTORE)
        return
    if pictures.shape[1:] != shape:
        what = f"its pictures are {pictures.shape[1]}x{pictures.shape[2]}, info.json promises {shape[0]}x{shape[1]}"
        yield Fault(film.file, episode.start, what, "set the shape in info.json to that of the video")
    if len(pictures) < 2 or np.abs(pictures[0].astype(np.int16) - pictures[1]).max() < 8:
        shown.static.add(episode.number)
    inside = (found.frames >= film.first) & (found.frames < film.first + episode.length)
    digest = shown.digests.setdefault(episode.number, hashlib.blake2b(digest_size=16))
    digest.update(found.digests[inside].tobytes())


# -- streams ---------------------------------------------------------------------------------------------------------


def examine_streams(survey: Survey, busy: bool) -> Iterator[Fault]:
    """Every stream of every episode: its times ascend, its values are of its shape, its film is as long as its times."""
    files = set(listed(survey.root, "streams", ".parquet")) | set(listed(survey.root, "streams", ".mp4"))
    known: set[str] = set()
    for name, sensor in survey.streams.items():
        seen = False
        for episode in survey.told.values():
            place = STREAM_PATH.format(name=name, suffix="parquet", **where(episode.number))
            film = STREAM_PATH.format(name=name, suffix="mp4", **where(episode.number))
            known |= {place, film}
            if place in files:
                seen = True
                yield from _stream(survey, sensor, episode, place, film, film in files)
            elif film in files:
                yield Fault(film, episode.start, "the times of this film are missing", RESTORE)
        if survey.told and not seen:
            what = f"stream '{name}' is declared in meta/terrella.json, but no episode has any of it"
            yield Fault(f"streams/{name}", None, what, "restore its files from a copy, or record anew")
    if survey.complete and not busy:
        for file in sorted(files - known):
            yield Fault(file, None, "no episode and no stream of meta/terrella.json uses this file", LEFTOVER)


def _stream(survey: Survey, sensor: Sensor, episode: Told, place: str, film: str, has_film: bool) -> Iterator[Fault]:
    try:
        table = read_whole(survey.path(place))
        time_s = table["time_s"].to_numpy().astype(np.float64)
        if sensor.kind != "image":
            _checked_values(table, sensor)
    except (DatasetError, KeyError, ValueError, AttributeError, TypeError, NotImplementedError) as error:
        what = (
            "the table is missing, truncated or not parquet"
            if isinstance(error, DatasetError)
            else f"it holds no readings ({error})"
        )
        yield Fault(place, episode.start, what, RESTORE)
        return
    falls = np.flatnonzero(~(np.diff(time_s) >= 0) | ~np.isfinite(time_s[1:])) if len(time_s) else []
    if len(falls) or not np.isfinite(time_s[:1]).all():
        at = int(falls[0]) + 1 if len(falls) else 0
        what = f"reading {at} of stream '{sensor.name}' is at {time_s[at]:g} s, which does not ascend"
        yield Fault(place, episode.start, what, "let --repair leave out the readings that are out of order")
    if sensor.kind == "image":
        yield from _stream_film(survey, sensor, episode, film, has_film, len(time_s))


def _checked_values(table, sensor: Sensor) -> None:
    """ValueError where a reading has another size than the sensor's."""
    value = table["value"].combine_chunks()
    sizes = np.diff(value.offsets.to_numpy())
    each = sensor.shape[1] if sensor.kind == "points" else int(np.prod(sensor.shape))
    if value.null_count or value.values.null_count:
        raise ValueError("a reading is null")
    wrong = np.flatnonzero(sizes % each if sensor.kind == "points" else sizes != each)
    if len(wrong):
        raise ValueError(
            f"reading {int(wrong[0])} has {int(sizes[wrong[0]])} numbers, which is no {sensor.kind} of {sensor.shape}"
        )


def _stream_film(
    survey: Survey, sensor: Sensor, episode: Told, film: str, has_film: bool, times: int
) -> Iterator[Fault]:
    if not has_film:
        yield Fault(film, episode.start, f"the film of stream '{sensor.name}' is missing", RESTORE)
        return
    rate = sensor.rate_hz or survey.fps
    try:
        count = reel(survey.path(film), rate).count
    except DatasetError:
        yield Fault(film, episode.start, "the video is truncated or not mp4", RESTORE)
        return
    if count != times:
        what = f"the film has {count} frames, its table {times} times"
        yield Fault(film, episode.start, what, "let --repair keep the frames that have a time")
        return
    try:
        if times:
            mp4.frames_at(survey.path(film), sorted({0, times - 1}), rate)
    except DatasetError:
        yield Fault(film, episode.start, "the film's first or last frame cannot be decoded", RESTORE)


def same(seen: Mapping[int, str]) -> Iterator[tuple[int, int]]:
    """(first, later) of the episodes that have the same digest."""
    first: dict[str, int] = {}
    for number, digest in seen.items():
        if digest in first:
            yield first[digest], number
        first.setdefault(digest, number)
