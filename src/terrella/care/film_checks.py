"""Faults of videos: wrong lengths, damaged frames, exchanged or missing files."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..core.errors import DatasetError
from ..data import stats
from ..data.meta import Episode
from ..data.staged import SAMPLE_EVERY, picture_statistics
from ..data.storage import mp4
from ..data.storage.films import Packets, read_packets
from .survey import LEFTOVER, RESTORE, Fault, Survey

_SHORTEN = "use --repair, which keeps the rows that the video shows"
_EXCHANGE = "swap the two videos, as --repair does"
_SAMPLES, _OF_STRANGERS = 64, 24  # most pictures of an episode that are decoded
# differences from the statistics, as a share of full brightness: below is equal, above is different
_LIKE, _UNLIKE = 0.01, 0.06
_BETTER = 3.0  # another episode's statistics must be this many times closer
_USUAL, _FEW = 6.0, 4  # multiple of the median difference that is no chance; episodes from which a median is taken

Key = tuple[int, str]  # episode, camera


@dataclass
class FilmFacts:
    """What the videos show."""

    digests: dict[int, hashlib.blake2b] = field(default_factory=dict)  # episode -> digest of its packets
    static: set[int] = field(default_factory=set)  # episodes whose pictures do not change
    looks: dict[Key, np.ndarray] = field(default_factory=dict)  # mean and deviation of each colour [6]
    noise: dict[Key, float] = field(default_factory=dict)  # sampling error of `looks`
    exchanged: dict[Key, Key] = field(default_factory=dict)  # of swapped videos: key -> the key whose pictures it shows


def examine_films(survey: Survey, shown: FilmFacts, busy: bool) -> Iterator[Fault]:
    """Checks every video that meta/episodes names: reads its packets, decodes its first, its last and some more frames."""
    named: dict[tuple[str, str], list[Episode]] = {}
    for episode in survey.episodes.values():
        for camera, film in episode.videos.items():
            named.setdefault((camera, film.file), []).append(episode)
    existing, moving = set(survey.films), set()
    for (camera, file), episodes in named.items():
        if file in existing:
            yield from _film(survey, camera, file, episodes, shown, moving)
        else:
            yield from (Fault(file, episode.start, "the video is missing", RESTORE) for episode in episodes)
    shown.static -= moving
    yield from _looks(survey, shown)
    if survey.complete and not busy:
        for file in sorted(existing - {file for _, file in named}):
            yield Fault(file, None, "no episode of info.json uses this file", LEFTOVER)


def _film(
    survey: Survey, camera: str, file: str, episodes: list[Episode], shown: FilmFacts, moving: set[int]
) -> Iterator[Fault]:
    first = min(episode.start for episode in episodes)
    try:
        packets = read_packets(survey.path(file), survey.fps)
    except DatasetError:
        yield Fault(file, first, "the video is truncated or not mp4", RESTORE)
        return
    count, needed = packets.count, 0
    for episode in sorted(episodes, key=lambda episode: episode.videos[camera].first):
        begin = episode.videos[camera].first
        end = begin + episode.length
        if begin < needed:
            what = f"episode {episode.number} begins at frame {begin}, which belongs to the episode before it"
            yield Fault(file, episode.start, what, "use --repair, which finds the episodes in the video again")
        needed = max(needed, end)
        if end > count:
            what = f"the video has {count} frames, but episode {episode.number} needs {end}"
            yield Fault(file, episode.start + max(0, min(count - begin, episode.length - 1)), what, _SHORTEN)
        stop = min(end, count) if len(episodes) > 1 else count
        if episode.length and stop > begin:
            yield from _decoded(survey, camera, episode, packets, stop - begin, shown, moving)
    if len(packets.frames) > needed + (len(episodes) > 1):
        what = f"the video has {len(packets.frames)} frames, but its episodes need {needed}"
        yield Fault(file, first, what, "use --repair, which leaves out the frames that belong to no row")


def _decoded(
    survey: Survey, camera: str, episode: Episode, packets: Packets, count: int, shown: FilmFacts, moving: set[int]
) -> Iterator[Fault]:
    """Decodes some of the `count` pictures of an episode."""
    film, shape = episode.videos[camera], tuple(survey.features[camera]["shape"])
    path, seen, first = survey.path(film.file), [], None
    inside = (packets.frames >= film.first) & (packets.frames < film.first + episode.length)
    shown.digests.setdefault(episode.number, hashlib.blake2b(digest_size=16)).update(packets.digests[inside].tobytes())
    zeroed = np.sort(packets.frames[inside & packets.zeroed]) - film.first
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
            what = f"its pictures are {picture.shape[0]}x{picture.shape[1]}, but info.json states {shape[0]}x{shape[1]}"
            yield Fault(film.file, episode.start, what, "set the shape in info.json to that of the video")
            return
        if np.abs(picture.astype(np.int16) - first).max() >= 8:
            moving.add(episode.number)
        if not survey.ours or row % SAMPLE_EVERY == 0:
            seen.append(picture_statistics(picture))
    merged = stats.merge([{camera: each} for each in seen])[camera]
    shown.looks[episode.number, camera] = np.concatenate([merged["mean"].ravel(), merged["std"].ravel()])
    halves = [np.mean([each["mean"].ravel() for each in seen[at::2] or seen], 0) for at in (0, 1)]
    shown.noise[episode.number, camera] = 0.0 if survey.ours else float(np.abs(halves[0] - halves[1]).max())


def _sampled(survey: Survey, count: int) -> list[int]:
    """Rows whose pictures are decoded: the rows of our recorder's statistics, else a sample; always the first and the last."""
    if survey.ours:
        return sorted({*range(0, count, SAMPLE_EVERY * -(-count // (SAMPLE_EVERY * _SAMPLES))), count - 1})
    return sorted({round(row) for row in np.linspace(0, count - 1, _OF_STRANGERS)})


def _looks(survey: Survey, shown: FilmFacts) -> Iterator[Fault]:
    """Compares the pictures with their statistics in meta/episodes: finds videos that were swapped or replaced."""
    keys = [key for key in survey.looks if key in shown.looks]
    if not keys:
        return
    kept = np.stack([np.concatenate(survey.looks[key]) for key in keys])
    looks = np.stack([shown.looks[key] for key in keys])
    for camera in {camera for _, camera in keys}:  # the change that video coding makes to all pictures
        mine = np.array([camera == of for _, of in keys])
        usual = np.median(looks[mine] - kept[mine], 0) if mine.sum() >= _FEW else np.zeros(6)
        looks[mine] -= np.where(np.abs(usual) <= _LIKE, usual, 0)
    own, noise = _distance(looks, kept), np.array([shown.noise[key] for key in keys])
    shown.exchanged |= _exchanged(keys, looks, kept, noise)
    for i, key in enumerate(keys):
        number, camera = key
        episode = survey.episodes[number]
        file, what = episode.videos[camera].file, ""
        if key in shown.exchanged:
            other, of = shown.exchanged[key]
            what = f"the video of episode {number} shows what episode {other} looked like{f' to {of}' * (of != camera)}"
            yield Fault(file, episode.start, f"{what} when it was recorded: the two videos were exchanged", _EXCHANGE)
        elif own[i] > _UNLIKE + noise[i]:
            means = shown.looks[key][:3].mean(), kept[i, :3].mean()
            what = f"the pictures of episode {number} differ from those that were recorded"
            what += f": their mean brightness is {means[0]:.0%}, and {means[1]:.0%} in meta/episodes"
            yield Fault(file, episode.start, what, "restore the video from a copy, or leave the episode out")


def _exchanged(keys: list[Key], looks: np.ndarray, kept: np.ndarray, noise: np.ndarray) -> dict[Key, Key]:
    """Among the videos that differ from their statistics, those that match the statistics of one another."""
    own = _distance(looks, kept)
    usual = _USUAL * float(np.median(own)) if len(keys) >= _FEW else 0.0
    unusual = own > np.maximum(_LIKE, np.maximum(noise, usual))
    suspects = np.flatnonzero(unusual | (own > np.maximum(2 * _LIKE, noise)))
    exchanged: dict[Key, Key] = {}
    for i in suspects:
        distance = _distance(looks[i], kept[suspects])
        distance[suspects == i] = np.inf
        if len(suspects) > 1 and distance.min() * _BETTER < own[i]:
            exchanged[keys[i]] = keys[suspects[int(distance.argmin())]]
    while lonely := [key for key, other in exchanged.items() if other not in exchanged]:
        for key in lonely:
            del exchanged[key]
    return exchanged if len(set(exchanged.values())) == len(exchanged) else {}


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference of two looks [..., 6]; deviations count half, since coding smooths them."""
    return (np.abs(a - b) * np.array([1, 1, 1, 0.5, 0.5, 0.5])).max(-1)


def equal_digests(seen: Mapping[int, str]) -> Iterator[tuple[int, int]]:
    """(first, later) of the episodes that have the same digest."""
    first: dict[str, int] = {}
    for number, digest in seen.items():
        if digest in first:
            yield first[digest], number
        first.setdefault(digest, number)
