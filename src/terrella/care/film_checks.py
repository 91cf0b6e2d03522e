"""What a doctor finds in the videos: lengths against rows, pictures that are damaged, exchanged or none."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..core.errors import DatasetError
from ..data import stats
from ..data.meta import Episode
from ..data.staged import SAMPLE_EVERY, look
from ..data.storage import mp4
from ..data.storage.films import Reel, reel
from .survey import LEFTOVER, RESTORE, Fault, Survey

_SHORTEN = "let --repair keep the rows that the video shows"
_EXCHANGE = "exchange the two videos, as --repair does"
_SAMPLES, _OF_STRANGERS = 64, 24  # pictures of an episode that are looked at, at most
_LIKE, _UNLIKE = 0.01, 0.06  # by so much of full brightness a look may, or must, differ from the statistics
_BETTER = 3.0  # times closer that the statistics of another episode must be
_USUAL, _FEW = 6.0, 4  # times the usual difference is no chance, where there are more episodes than a few

Key = tuple[int, str]  # episode, camera


@dataclass
class Shown:
    """What the videos show.

    digests: number of an episode -> what its pictures are; static: episodes whose pictures do not change;
    looks: mean and deviation of each colour [6]; noise: by how much looks differ because few pictures were looked at;
    exchanged: whose video shows the pictures of whom, where two were exchanged.
    """

    digests: dict[int, hashlib.blake2b] = field(default_factory=dict)
    static: set[int] = field(default_factory=set)
    looks: dict[Key, np.ndarray] = field(default_factory=dict)
    noise: dict[Key, float] = field(default_factory=dict)
    exchanged: dict[Key, Key] = field(default_factory=dict)


def examine_films(survey: Survey, shown: Shown, busy: bool) -> Iterator[Fault]:
    """Every video that meta/episodes names: its packets are read, the first, the last and some more frames decoded."""
    named: dict[tuple[str, str], list[Episode]] = {}
    for episode in survey.episodes.values():
        for camera, film in episode.videos.items():
            named.setdefault((camera, film.file), []).append(episode)
    there, moving = set(survey.films), set()
    for (camera, file), episodes in named.items():
        if file in there:
            yield from _film(survey, camera, file, episodes, shown, moving)
        else:
            yield from (Fault(file, episode.start, "the video is missing", RESTORE) for episode in episodes)
    shown.static -= moving
    yield from _looks(survey, shown)
    if survey.complete and not busy:
        for file in sorted(there - {file for _, file in named}):
            yield Fault(file, None, "no episode of info.json uses this file", LEFTOVER)


def _film(
    survey: Survey, camera: str, file: str, episodes: list[Episode], shown: Shown, moving: set[int]
) -> Iterator[Fault]:
    first = min(episode.start for episode in episodes)
    try:
        found = reel(survey.path(file), survey.fps)
    except DatasetError:
        yield Fault(file, first, "the video is truncated or not mp4", RESTORE)
        return
    count, needed = found.count, 0
    for episode in sorted(episodes, key=lambda episode: episode.videos[camera].first):
        begin = episode.videos[camera].first
        end = begin + episode.length
        if begin < needed:
            what = f"episode {episode.number} begins at frame {begin}, which the episode before it shows too"
            yield Fault(file, episode.start, what, "let --repair count anew where the episodes lie in the video")
        needed = max(needed, end)
        if end > count:
            what = f"the video has {count} frames, episode {episode.number} needs {end}"
            yield Fault(file, episode.start + max(0, min(count - begin, episode.length - 1)), what, _SHORTEN)
        stop = min(end, count) if len(episodes) > 1 else count
        if episode.length and stop > begin:
            yield from _decoded(survey, camera, episode, found, stop - begin, shown, moving)
    if len(found.frames) > needed + (len(episodes) > 1):
        what = f"the video has {len(found.frames)} frames, its episodes need {needed}"
        yield Fault(file, first, what, "let --repair leave out the frames that belong to no row")


def _decoded(
    survey: Survey, camera: str, episode: Episode, found: Reel, count: int, shown: Shown, moving: set[int]
) -> Iterator[Fault]:
    """Looks at some of the `count` pictures from the episode's first on."""
    film, shape = episode.videos[camera], tuple(survey.features[camera]["shape"])
    path, seen, first = survey.path(film.file), [], None
    inside = (found.frames >= film.first) & (found.frames < film.first + episode.length)
    shown.digests.setdefault(episode.number, hashlib.blake2b(digest_size=16)).update(found.digests[inside].tobytes())
    zeroed = np.sort(found.frames[inside & found.zeroed]) - film.first
    if len(zeroed):
        what = f"{len(zeroed)} frames of episode {episode.number} were overwritten with zeros and cannot be decoded"
        yield Fault(film.file, episode.start + int(zeroed[0]), what, RESTORE)
        return
    shown.static.add(episode.number)
    pictures = mp4.Frames(path, film.first, count, survey.fps)
    for row in _sampled(survey, count):
        try:
            picture = pictures[row]
        except DatasetError:
            what = f"the video's frame {film.first + row} cannot be decoded"
            yield Fault(film.file, episode.start + min(row, episode.length - 1), what, RESTORE)
            return
        first = picture if first is None else first
        if picture.shape != shape:
            what = f"its pictures are {picture.shape[0]}x{picture.shape[1]}, info.json promises {shape[0]}x{shape[1]}"
            yield Fault(film.file, episode.start, what, "set the shape in info.json to that of the video")
            return
        if np.abs(picture.astype(np.int16) - first).max() >= 8:
            moving.add(episode.number)
        if not survey.ours or row % SAMPLE_EVERY == 0:
            seen.append(look(picture))
    merged = stats.merge([{camera: each} for each in seen])[camera]
    shown.looks[episode.number, camera] = np.concatenate([merged["mean"].ravel(), merged["std"].ravel()])
    halves = [np.mean([each["mean"].ravel() for each in seen[at::2] or seen], 0) for at in (0, 1)]
    shown.noise[episode.number, camera] = 0.0 if survey.ours else float(np.abs(halves[0] - halves[1]).max())


def _sampled(survey: Survey, count: int) -> list[int]:
    """Rows whose pictures are looked at: where our recorder looked for its statistics, else some; always first and last."""
    if survey.ours:
        step = SAMPLE_EVERY * -(-count // (SAMPLE_EVERY * _SAMPLES))
        return sorted({*range(0, count, step), count - 1})
    return sorted({round(row) for row in np.linspace(0, count - 1, _OF_STRANGERS)})


def _looks(survey: Survey, shown: Shown) -> Iterator[Fault]:
    """The pictures against the statistics that meta/episodes keeps of them: exchanged, black or other ones are named."""
    keys = [key for key in survey.looks if key in shown.looks]
    if not keys:
        return
    kept = np.stack([np.concatenate(survey.looks[key]) for key in keys])
    there = np.stack([shown.looks[key] for key in keys])
    for camera in {camera for _, camera in keys}:  # what coding does to all pictures alike
        mine = np.array([camera == of for _, of in keys])
        usual = np.median(there[mine] - kept[mine], 0) if mine.sum() >= _FEW else np.zeros(6)
        there[mine] -= np.where(np.abs(usual) <= _LIKE, usual, 0)
    own, noise = _distance(there, kept), np.array([shown.noise[key] for key in keys])
    shown.exchanged |= _exchanged(keys, there, kept, noise)
    for i, key in enumerate(keys):
        number, camera = key
        episode = survey.episodes[number]
        file, what = episode.videos[camera].file, ""
        if key in shown.exchanged:
            other, of = shown.exchanged[key]
            what = f"the video of episode {number} shows what episode {other} looked like{f' to {of}' * (of != camera)}"
            yield Fault(file, episode.start, f"{what} when it was recorded: they were exchanged", _EXCHANGE)
        elif own[i] > _UNLIKE + noise[i]:
            means = shown.looks[key][:3].mean(), kept[i, :3].mean()
            what = f"the pictures of episode {number} are not those that were recorded"
            what += f": their mean brightness is {means[0]:.0%}, in meta/episodes {means[1]:.0%}"
            yield Fault(file, episode.start, what, "restore the video from a copy, or leave the episode out")


def _exchanged(keys: list[Key], there: np.ndarray, kept: np.ndarray, noise: np.ndarray) -> dict[Key, Key]:
    """Of episodes that look other than their statistics, those whose looks are one another's."""
    own = _distance(there, kept)
    usual = _USUAL * float(np.median(own)) if len(keys) >= _FEW else 0.0
    suspects = np.flatnonzero(
        (own > np.maximum(_LIKE, np.maximum(noise, usual))) | (own > np.maximum(2 * _LIKE, noise))
    )
    found: dict[Key, Key] = {}
    for i in suspects:
        distance = _distance(there[i], kept[suspects])
        distance[suspects == i] = np.inf
        if len(suspects) > 1 and distance.min() * _BETTER < own[i]:
            found[keys[i]] = keys[suspects[int(distance.argmin())]]
    while lonely := [key for key, other in found.items() if other not in found]:
        for key in lonely:
            del found[key]
    return found if len(set(found.values())) == len(found) else {}


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference of two looks [..., 6]; deviations, which coding smooths, count half."""
    return (np.abs(a - b) * np.array([1, 1, 1, 0.5, 0.5, 0.5])).max(-1)


def same(seen: Mapping[int, str]) -> Iterator[tuple[int, int]]:
    """(first, later) of the episodes that have the same digest."""
    first: dict[str, int] = {}
    for number, digest in seen.items():
        if digest in first:
            yield first[digest], number
        first.setdefault(digest, number)
