"""Videos as other programs write them: names that FFmpeg could take for addresses, covers, sound, pixels that are not square."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
import pytest

from terrella.core.errors import DatasetError
from terrella.core.files import creating, remedy_of
from terrella.data import Dataset
from terrella.data.storage.mp4 import Mp4Writer, decode_frames, finish_video
from terrella.exchange import open_source, write_source
from terrella.exchange.merging.write import merge_into
from terrella.space.pictures.reading import video_pictures

RGB = "observation.images.rgb"
NAMES = ["2024-11-26T10:00:00", "concat:a|b", "-first", "shot%03d", "two words", "größe", "file:x", "http:y", "a?b#c"]


def film(path, count=6, size=(64, 96), ratio=None, cover=0, sound=False, cover_codec="mjpeg"):
    """An H.264 film whose grey rises by 8 a frame, behind `cover` white pictures of another stream."""
    with av.open(f"file:{path}", "w", format="matroska" if str(path).endswith("mkv") else "mp4") as container:
        first = container.add_stream(cover_codec, rate=10) if cover else None
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        if ratio:
            stream.codec_context.sample_aspect_ratio = ratio
        tone = container.add_stream("aac", rate=8000) if sound else None
        if first is not None:
            first.height, first.width, first.pix_fmt = 48, 48, "yuvj420p"
            white = av.VideoFrame.from_ndarray(np.full((48, 48, 3), 255, np.uint8), format="rgb24")
            for number in range(cover):
                white.pts = number
                container.mux(first.encode(white))
            container.mux(first.encode())
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((*size, 3), 40 + 8 * number, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if tone is not None:
            quiet = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            quiet.rate = 8000
            container.mux([*tone.encode(quiet), *tone.encode()])


@pytest.mark.parametrize("name", [*NAMES[:4], *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES[4:])])
def test_a_name_is_a_file_and_never_an_address(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)  # relative paths, as people give them
    (tmp_path / name).mkdir()
    film(f"{name}/{name}.mp4")
    write_source(open_source(name), f"{name}.set")
    write_source(open_source(f"{name}.set"), f"{name}.films", "videos")
    (take,) = open_source(f"{name}.films").takes()
    assert len(take.readings[RGB].values) == Dataset(f"{name}.set").length == 6
    assert abs(int(take.readings[RGB].values[5].mean()) - 80) < 6
    assert len(video_pictures(f"{name}/{name}.mp4", 3, 128)) == 3
    (single,) = open_source(f"{name}/{name}.mp4").takes()
    assert len(single.readings[RGB].values) == 6 and single.facts == {"file": name}
    assert [path.name for path in (tmp_path / f"{name}.films").iterdir()] == ["take_0.mp4"]


def test_the_recorders_films_lie_under_any_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    writer = Mp4Writer("10:30.mp4", (32, 48), 10)
    writer.add(np.full((32, 48, 3), 90, np.uint8))
    writer.close()
    assert finish_video("10:30.mp4", "data:done.mp4") == 1
    (frame,) = decode_frames("data:done.mp4", 0, 1, 10)
    assert frame.shape == (32, 48, 3) and abs(int(frame.mean()) - 90) < 6


@pytest.mark.parametrize("error, words", [(28, "free some space"), (13, "writable"), (2, "check")])
def test_space_is_asked_for_only_where_there_is_none(tmp_path, error, words):
    with pytest.raises(DatasetError, match=words) as raised, creating(tmp_path / "set"):
        raise OSError(error, "it failed")
    assert ("free some space" in str(raised.value)) == (error == 28) == ("free some" in remedy_of(OSError(error, "")))


@pytest.mark.parametrize("suffix, cover", [("mkv", 1), ("mp4", 3)])
def test_a_cover_is_not_the_film(tmp_path, suffix, cover):
    (tmp_path / "films").mkdir()
    film(tmp_path / "films" / f"a.{suffix}", cover=cover, sound=True)
    notes = write_source(open_source(tmp_path / "films"), tmp_path / "set")
    rows = Dataset(tmp_path / "set").episode(0, ["rgb"])["rgb"]
    assert rows.shape == (6, 64, 96, 3) and abs(int(rows[0].mean()) - 40) < 6
    assert any("sound" in note for note in notes) and any("48 x 48" in note for note in notes)
    assert video_pictures(tmp_path / "films" / f"a.{suffix}", 2, 96)[0].mean() < 90
    facts, _ = merge_into({"a": open_source(tmp_path / "films")}, tmp_path / "merged")
    assert any("sound" in note for note in facts["notes"])


@pytest.mark.parametrize("ratio, width", [(Fraction(16, 11), 140), (Fraction(1, 2), 48), (Fraction(1), 96)])
def test_pixels_that_are_not_square_are_made_so(tmp_path, ratio, width):
    film(tmp_path / "a.mp4", ratio=ratio)
    source = open_source(tmp_path)
    (take,) = source.takes()
    assert source.sensors[RGB].shape == take.readings[RGB].values[3].shape == (64, width, 3)
    assert video_pictures(tmp_path / "a.mp4", 2, 512)[0].shape == (64, width, 3)
