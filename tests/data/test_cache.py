"""The clip cache holds exactly what the recording shows, is rebuilt when that changes, and never half built."""

from __future__ import annotations

import numpy as np
import pytest
from corridor import Corridor, keys
from hypothesis import given
from hypothesis import strategies as st
from layouts import layout_of

from terrella.core import make_rng
from terrella.core.errors import DatasetError
from terrella.data import ClipCache, Dataset, Recorder, RecordOptions, record, split
from terrella.data.training import cache
from terrella.data.training.cache import shrink_pictures


def test_cache_equals_the_decoded_recording(recording):
    dataset, told = Dataset(recording), []
    clips = ClipCache.open(dataset, (24, 32), progress=lambda done, total: told.append((done, total)))
    assert clips.length == 100 and list(clips.episodes) == [(0, 30), (30, 60), (60, 90), (90, 100)]
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    for number, (start, stop) in enumerate(clips.episodes):
        truth, rows = dataset.episode(number), slice(start, stop)
        np.testing.assert_array_equal(clips.rgb[rows], shrink_pictures(truth["rgb"], (24, 32)))
        np.testing.assert_array_equal(clips.depth[rows], truth["depth"].astype(np.float16))
        for name in ("pose", "action", "action_valid", "reward", "done"):
            np.testing.assert_array_equal(getattr(clips, name)[rows], truth[name])
    kinds = {name: str(getattr(clips, name).dtype) for name in ("rgb", "depth", "pose", "action", "reward", "done")}
    assert set(kinds.values()) == {"uint8", "float16", "float32", "bool"} and kinds["depth"] == "float16"
    assert clips.action_names == dataset.action_names and clips.world == dataset.world and clips.fps == 35
    with pytest.raises(ValueError, match="read-only"):
        clips.rgb[0] = 0


def test_it_is_built_once_and_again_when_the_recording_grows(recording, monkeypatch):
    first = ClipCache.open(recording, (24, 32))
    monkeypatch.setattr(cache, "_build", None)  # a second build would fail
    assert ClipCache.open(recording, (24, 32)).path == first.path
    monkeypatch.undo()
    record(Corridor(), keys, recording, frames=130, rng=make_rng(0), options=RecordOptions(max_episode_steps=29))
    grown = ClipCache.open(recording, (24, 32))
    assert grown.length == 130 and grown.path != first.path
    assert first.rgb[99].shape == (24, 32, 3) and not first.path.exists()  # what is mapped stays readable
    other = ClipCache.open(recording, (12, 16))
    assert other.rgb.shape == (130, 12, 16, 3) and grown.path.exists()


def test_a_build_that_stops_half_way_is_never_taken_for_a_cache(recording, monkeypatch):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ClipCache.open(recording, (24, 32), progress=stop)
    left = recording / ".cache" / "terrella" / ".building"
    left.mkdir(exist_ok=True)  # what kill -9 leaves
    (left / "rgb.npy").write_bytes(b"half")
    assert ClipCache.open(recording, (24, 32)).rgb.shape == (100, 24, 32, 3)
    assert not left.exists()


def test_what_the_recording_lacks_is_none(tmp_path):
    with Recorder(tmp_path / "set", layout_of(10, ("go", "stop"))) as recorder:
        for i in range(5):
            recorder.add({}, [i, -i])
    clips = ClipCache.open(tmp_path / "set")
    assert clips.rgb is None and clips.depth is None and clips.pose is None
    np.testing.assert_array_equal(clips.action, [[i, -i] for i in range(5)])


def test_an_empty_recording_and_a_full_disk_are_said(tmp_path, recording, monkeypatch):
    Recorder(tmp_path / "empty", layout_of(10, ("go",))).close()
    with pytest.raises(DatasetError, match="no finished episode"):
        ClipCache.open(tmp_path / "empty")
    monkeypatch.setattr(cache.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 10_000})())
    with pytest.raises(DatasetError, match="GB are free"):
        ClipCache.open(recording, (24, 32))


def test_a_folder_that_cannot_be_written_keeps_its_cache_elsewhere(recording, tmp_path, monkeypatch):
    (recording / ".cache").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "elsewhere"))
    clips = ClipCache.open(recording, (24, 32))
    assert clips.path.is_relative_to(tmp_path / "elsewhere" / "terrella") and clips.length == 100


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 9), st.integers(1, 9))
def test_shrink_is_the_mean_over_the_area_that_a_pixel_covers(height, width, to_height, to_width):
    pictures = np.random.default_rng(height * 10 + width).integers(0, 256, (2, height, width, 3), np.uint8)
    found = shrink_pictures(pictures, (to_height, to_width))
    fine = pictures.repeat(to_height, 1).repeat(to_width, 2).astype(np.float64)  # the slow twin: on a common grid
    slow = fine.reshape(2, to_height, height, to_width, width, 3).mean((2, 4))
    assert found.shape == (2, to_height, to_width, 3)
    assert np.abs(found - slow).max() <= 0.501


def test_split_holds_out_a_fixed_share_and_never_everything():
    train, held = split(100)
    assert len(held) == 5 and sorted(train + held) == list(range(100)) and split(100) == (train, held)
    assert split(100, seed=1)[1] != held
    assert split(1) == ([0], []) and split(0) == ([], []) and len(split(2)[1]) == 1
    assert split(10, held_out=0.0) == (list(range(10)), [])
