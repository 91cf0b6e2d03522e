"""An episode in the staging folder of a recorder: written row by row, and read back as far as it is whole."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import Image

from ..core.errors import DatasetError
from . import stats
from .format import Layout, sensor_from_json, sensor_json
from .source import Sensor
from .storage import journal, mp4
from .storage.films import whole_frames
from .writer import Draft, group_columns

LOG = "rows.log"
SAMPLE_EVERY = 16  # rows from one picture to the next that enters the statistics
ROW, WORDS = 0, 0xFFFF  # kinds of journal records; streams are numbered from 1


def staging_facts(layout: Layout, number: int, task: str, start_ns: int) -> dict:
    """The first record of the journal of episode `number`: all facts that are needed to read it."""
    return {
        "episode": number, "task": task, "start_ns": start_ns, "fps": layout.fps, "pictures": layout.pictures,
        "rows": {name: sensor_json(sensor) for name, sensor in layout.rows.items()},
        "streams": {name: sensor_json(sensor) for name, sensor in layout.streams.items()},
    }  # fmt: skip


def pack_row(values: Mapping[str, np.ndarray], given: Sequence[bool], sensors: Sequence[Sensor]) -> list:
    """A row as raw bytes: a bit for each sensor that was given, then the values of `sensors` (no videos) in order."""
    return [np.packbits(given), *(_packed(values[sensor.name]) for sensor in sensors)]


def growing_film(folder: Path, camera: str) -> Path:
    """The growing film of a camera; `camera` is "stream-NAME" for a stream."""
    return folder / f"{camera}.growing.mp4"


class Staged:
    """The episode in a staging folder. ValueError, KeyError, TypeError or OSError where its first record is not whole.

    number, task, start_ns: from its first record. rows, streams: its Sensors. length: rows in the journal.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        stated = journal.read_about(folder / LOG)
        self.number, self.task, self.start_ns = int(stated["episode"]), str(stated["task"]), int(stated["start_ns"])
        self.fps, self.pictures = float(stated["fps"]), str(stated["pictures"])
        self.rows = {name: sensor_from_json(name, sensor) for name, sensor in stated["rows"].items()}
        self.streams = {name: sensor_from_json(name, sensor) for name, sensor in stated["streams"].items()}
        video = self.pictures == "video"
        self.cameras = [name for name, sensor in self.rows.items() if sensor.kind == "image" and video]
        self._packed = [sensor for name, sensor in self.rows.items() if name not in self.cameras]
        self.length = sum(1 for _ in self._journal(ROW))

    def fits(self, layout: Layout) -> bool:
        """Whether its rows and streams are those of a layout, in any order."""
        both = [(self.rows, layout.rows), (self.streams, layout.streams)]
        return all(a.keys() == b.keys() and all(map(_alike, a.values(), map(b.get, a))) for a, b in both)

    def whole(self) -> int:
        """Rows up to the first whose frame is cut or damaged in any camera; decodes every frame."""
        length = self.length
        for name in self.cameras:
            length = min(length, _good(growing_film(self.folder, name), self.folder / "tried.mp4", length, self.fps))
        return length

    def draft(self, length: int, start_ns: int | None, pictures: Mapping[str, stats.Summary] | None = None) -> Draft:
        """The first `length` rows as an episode. `pictures` are statistics of its cameras; None computes them."""
        videos = {name: self._finished(growing_film(self.folder, name), name, length) for name in self.cameras}
        films, streams = {}, {}
        for name, sensor in self.streams.items():
            if sensor.kind == "image":
                film, rate = growing_film(self.folder, f"stream-{name}"), sensor.rate_hz or self.fps
                times = [time_s for time_s, _ in self._readings(name)]
                count = _good(film, self.folder / "tried.mp4", len(times), rate) if pictures is None else len(times)
                if not count:
                    continue  # this camera has no frame
                films[name] = self._finished(film, f"stream-{name}", count)
                streams[name] = [(time_s, None) for time_s in times[:count]]
            else:
                streams[name] = self._readings(name)
        counts, tasks = self._counted(length)
        seen = self._sampled(videos, length) if pictures is None else pictures
        rows = group_columns(islice(self._rows(), length))
        return Draft(length, rows, videos, seen, self.task, streams, films, start_ns, tasks, counts)

    def _counted(self, length: int) -> tuple[dict[str, int], list[str]]:
        """(sensor -> rows up to the last that has it, if that is not the last row; task of each row, [] if all have `task`)."""
        newest = np.zeros(len(self.rows), int)
        tasks, task = [], self.task
        for number, _, raw in journal.read_records(self.folder / LOG):
            if number == WORDS:
                task = raw.decode()
            elif number == ROW and len(tasks) < length:
                tasks.append(task)
                newest[self._given(raw)] = len(tasks)
        counts = {name: int(count) for name, count in zip(self.rows, newest) if count != length}
        return counts, tasks if set(tasks) != {self.task} else []

    def _given(self, raw: bytes) -> np.ndarray:
        bits = np.frombuffer(raw, np.uint8, (len(self.rows) + 7) // 8)
        return np.unpackbits(bits, count=len(self.rows)).astype(bool)

    def _rows(self, encode: bool = True) -> Iterator[dict[str, np.ndarray]]:
        skip = (len(self.rows) + 7) // 8
        for _, raw in self._journal(ROW):
            yield _unpacked(raw[skip:], self._packed, encode)

    def _readings(self, stream: str) -> Iterator[tuple[float, np.ndarray | None]]:
        sensor = self.streams[stream]
        dtype = np.uint16 if sensor.kind == "depth" else np.dtype(sensor.dtype)
        for time_s, raw in self._journal(1 + list(self.streams).index(stream)):
            yield time_s, None if sensor.kind == "image" else np.frombuffer(raw, dtype)

    def _journal(self, wanted: int) -> Iterator[tuple[float, bytes]]:
        return ((time_s, raw) for number, time_s, raw in journal.read_records(self.folder / LOG) if number == wanted)

    def _finished(self, film: Path, name: str, length: int) -> Path:
        target = self.folder / f"{name}.mp4"
        mp4.trim_fragments(film)
        kept = mp4.finish_video(film, target, length)
        if kept != length:
            raise DatasetError(f"the film {film} has only {kept} of {length} frames.")
        return target

    def _sampled(self, videos: Mapping[str, Path], length: int) -> dict[str, stats.Summary]:
        """Statistics of the cameras, from every SAMPLE_EVERY-th row."""
        summaries = {name: sampled_statistics(mp4.Frames(video, 0, length, self.fps)) for name, video in videos.items()}
        images = [name for name, sensor in self.rows.items() if sensor.kind == "image" and name not in videos]
        rows = islice(self._rows(encode=False), 0, length, SAMPLE_EVERY) if images else ()
        return summaries | stats.merge({name: picture_statistics(row[name]) for name in images} for row in rows)


@dataclass(frozen=True)
class Parcel:
    """A whole episode in memory, sent from one recorder to another. Films in `draft` are file names; `films` has their bytes."""

    draft: Draft
    films: Mapping[str, bytes]

    @staticmethod
    def of(draft: Draft) -> Parcel:
        films = {path.name: path.read_bytes() for path in [*draft.videos.values(), *draft.films.values()]}
        streams = {name: list(readings) for name, readings in draft.streams.items()}
        return Parcel(_moved(replace(draft, rows=list(draft.rows), streams=streams), Path()), films)

    def unpacked(self, folder: Path) -> Draft:
        """The draft with its films in `folder`."""
        for name, film in self.films.items():
            (folder / name).write_bytes(film)
        return _moved(self.draft, folder)


def _moved(draft: Draft, folder: Path) -> Draft:
    videos, films = ({name: folder / path.name for name, path in of.items()} for of in (draft.videos, draft.films))
    return replace(draft, videos=videos, films=films)


def picture_statistics(picture: np.ndarray) -> stats.Summary:
    """Statistics of a picture [H, W, …], from every fourth row and column of pixels."""
    return stats.summarise_pictures(picture[None, ::4, ::4])


def sampled_statistics(pictures: Sequence[np.ndarray]) -> stats.Summary:
    """Statistics of an episode's pictures, from every SAMPLE_EVERY-th."""
    parts = [{"": picture_statistics(pictures[row])} for row in range(0, len(pictures), SAMPLE_EVERY)]
    return stats.merge(parts)[""]


def _alike(mine: Sensor, other: Sensor) -> bool:
    stated = sensor_from_json(mine.name, sensor_json(other))
    return (mine.kind, mine.shape, mine.dtype) == (stated.kind, stated.shape, stated.dtype)


def _good(film: Path, target: Path, most: int, fps: float) -> int:
    """Number of frames of a growing film, at most `most`, before the first that cannot be decoded."""
    if not most:
        return 0
    try:
        mp4.trim_fragments(film)
        count = mp4.finish_video(film, target, most)
        good = whole_frames(target, 0, count, fps)
        return int(count if good.all() else good.argmin())
    except (DatasetError, FileNotFoundError):
        return 0
    finally:
        target.unlink(missing_ok=True)


def _packed(value: np.ndarray) -> bytes | np.ndarray:
    """The value as stored in the journal; a text has its length in front."""
    if value.dtype != object:
        return value
    text = str(value[0]).encode()
    return len(text).to_bytes(4, "little") + text


def _unpacked(raw: bytes, sensors: Sequence[Sensor], encode: bool) -> dict:
    """The inverse of `_packed` for all values of a row; `encode` turns pictures into PNG."""
    values, at = {}, 0
    for sensor in sensors:
        if sensor.dtype == "string":
            size = int.from_bytes(raw[at : at + 4], "little")
            values[sensor.name] = raw[at + 4 : at + 4 + size].decode()
            at += 4 + size
            continue
        dtype = np.dtype(np.uint16 if sensor.kind == "depth" else sensor.dtype)
        array = np.frombuffer(raw, dtype, int(np.prod(sensor.shape)), at).reshape(sensor.shape)
        at += array.nbytes
        values[sensor.name] = encode_png(array) if sensor.kind == "image" and encode else array
    return values


def encode_png(picture: np.ndarray) -> bytes:
    """uint8 [H, W, 3] as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()
