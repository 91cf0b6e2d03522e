"""Killing, cutting, filling the disk: at most the episode in flight is lost, and the reader says what is wrong."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from corridor import Corridor, keys
from layouts import layout_of
from sweeps import sweep

from terrella.care import doctor
from terrella.core import files, make_rng
from terrella.core.errors import DatasetError
from terrella.data import ClipCache, Dataset, Recorder, RecordOptions, record

LAYOUT = layout_of(10, ("go",), rgb=(16, 16), pose=True)


def _episode(recorder: Recorder, rows: int, value: float = 0.0) -> None:
    for i in range(rows):
        frame = np.full((16, 16, 3), 40 + 3 * i, np.uint8)
        recorder.add({"rgb": frame, "pose": np.full(7, value)}, [float(i)])
    recorder.end_episode()


def _stop_at(monkeypatch, name: str, nth: int, error: BaseException) -> None:
    """The nth call of files.NAME raises instead."""
    real, calls = getattr(files, name), []

    def failing(*args, **named):
        calls.append(args)
        if len(calls) == nth:
            raise error
        return real(*args, **named)

    monkeypatch.setattr(files, name, failing)


SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
from corridor import Corridor, keys
from terrella.core import make_rng
from terrella.data import RecordOptions, record
def tell(rows, frames):
    print(rows, flush=True)
options = RecordOptions(max_episode_steps=29)
record(Corridor(), keys, {root!r}, frames=100_000, rng=make_rng(3), progress=tell, options=options)
"""


@pytest.mark.parametrize("rows", sweep([5, 75, 91], 75))
def test_kill_9_loses_at_most_the_episode_in_flight(tmp_path, rows):
    root = tmp_path / "killed"
    script = SCRIPT.format(folder=str(Path(__file__).parent), root=str(root))
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        seen = 0
        while seen < rows:
            seen = int(process.stdout.readline())
        os.kill(process.pid, signal.SIGKILL)
    before = Dataset(root)
    assert before.length == 30 * len(before.episodes) >= rows // 30 * 30
    kept = [before.episode(i) for i in range(len(before.episodes))]
    goal = before.length + 60
    record(Corridor(), keys, root, frames=goal, rng=make_rng(3), options=RecordOptions(max_episode_steps=29))
    after = Dataset(root)
    assert after.length == goal and doctor(root) == []
    record(
        Corridor(), keys, tmp_path / "never", frames=goal, rng=make_rng(3), options=RecordOptions(max_episode_steps=29)
    )
    for i, episode in enumerate(Dataset(tmp_path / "never").episodes):  # as if it had not been killed
        never, found = Dataset(tmp_path / "never").episode(episode.number), after.episode(i)
        assert all(np.array_equal(never[name], found[name]) for name in never)
        assert i >= len(kept) or all(np.array_equal(kept[i][name], found[name]) for name in found)


class Killed(BaseException):
    """Stands for a power cut: nothing after it runs."""


@pytest.mark.parametrize("name", ["sync_file", "move_into_place", "sync_folder"])
@pytest.mark.parametrize("nth", sweep(range(1, 9), 2, 5))
def test_a_cut_at_any_point_of_a_commit_loses_nothing(tmp_path, monkeypatch, name, nth):
    recorder = Recorder(tmp_path, LAYOUT)
    _episode(recorder, 4, 1.0)
    with monkeypatch.context() as patch:
        _stop_at(patch, name, nth, Killed())
        try:
            _episode(recorder, 6, 2.0)
        except Killed:
            pass
    recorder._writer.close()  # as the system does with a dead process
    assert [episode.length for episode in Dataset(tmp_path).episodes] in ([4], [4, 6])
    assert Dataset(tmp_path).episode(0)["pose"][0, 0] == 1.0
    with Recorder(tmp_path, LAYOUT) as again:  # which keeps the episode that was being committed
        _episode(again, 5, 3.0)
    assert [episode.length for episode in Dataset(tmp_path).episodes] == [4, 6, 5]
    assert [Dataset(tmp_path).episode(i)["pose"][0, 0] for i in range(3)] == [1.0, 2.0, 3.0]
    assert doctor(tmp_path) == []


@pytest.mark.parametrize("name", ["sync_file", "move_into_place", "write_json"])
@pytest.mark.parametrize("nth", sweep([1, 2, 3], 2))
def test_a_full_disk_is_said_clearly_and_loses_nothing(tmp_path, monkeypatch, name, nth):
    with Recorder(tmp_path, LAYOUT) as recorder:
        _episode(recorder, 4)
        with monkeypatch.context() as patch:
            _stop_at(patch, name, nth, OSError(errno.ENOSPC, "No space left on device"))
            try:
                _episode(recorder, 6)
                assert (name, nth) == ("write_json", 3)  # only two of them in a commit
            except DatasetError as error:
                assert "the disk is full" in str(error) and "1 episodes (4 frames) are safe" in str(error)
                assert [episode.length for episode in Dataset(tmp_path).episodes] == [4]
        _episode(recorder, 5)  # space was freed: the same recorder goes on, and what was in flight is an episode
    assert [episode.length for episode in Dataset(tmp_path).episodes] == [4, 6, 5]
    assert doctor(tmp_path) == []


def test_what_a_full_disk_left_in_flight_is_kept_by_the_next_recorder(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    recorder = Recorder(tmp_path, LAYOUT)
    with monkeypatch.context() as patch:
        _stop_at(patch, "move_into_place", 1, full)
        with pytest.raises(DatasetError, match="the 6 rows in flight are kept"):
            _episode(recorder, 6)
    recorder.close()
    with monkeypatch.context() as patch:  # still full
        _stop_at(patch, "sync_file", 1, full)
        with pytest.raises(DatasetError, match="the disk is full"):
            Recorder(tmp_path, LAYOUT)
    with Recorder(tmp_path, LAYOUT) as again:
        assert again.recovered == 6
    assert [episode.length for episode in Dataset(tmp_path).episodes] == [6] and doctor(tmp_path) == []


def test_an_interrupt_after_a_commit_does_not_commit_twice(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, LAYOUT)
    _episode(recorder, 4)
    monkeypatch.setattr(recorder._writer, "tidy", lambda: (_ for _ in ()).throw(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        _episode(recorder, 5)
    monkeypatch.undo()
    recorder.close()
    assert [episode.length for episode in Dataset(tmp_path).episodes] == [4, 5]


def test_an_interrupt_within_a_row_does_not_shift_the_frames(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, LAYOUT)
    for i in range(4):
        recorder.add({"rgb": np.full((16, 16, 3), 50 * i, np.uint8), "pose": np.full(7, i)}, [0.0])
    with monkeypatch.context() as patch:
        patch.setattr("terrella.data.recorder.Mp4Writer.add", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            recorder.add({"rgb": np.zeros((16, 16, 3), np.uint8), "pose": np.full(7, 9)}, [0.0])
    with pytest.raises(DatasetError, match="keeps 4 rows"):
        recorder.add({"rgb": np.zeros((16, 16, 3), np.uint8), "pose": np.full(7, 9)}, [0.0])
    recorder.close()
    found = Dataset(tmp_path).episode(0)
    assert found["pose"][:, 0].tolist() == [0, 1, 2, 3]
    assert np.abs(found["rgb"].mean((1, 2, 3)) - [0, 50, 100, 150]).max() < 4
    with pytest.raises(DatasetError, match="closed"):
        recorder.add({"rgb": np.zeros((16, 16, 3), np.uint8), "pose": np.full(7, 9)}, [0.0])


def test_many_episodes_share_a_table_and_a_killed_merge_is_finished(tmp_path, monkeypatch):
    monkeypatch.setattr("terrella.data.writer.EPISODES_PER_TABLE", 3)
    tables = tmp_path / "meta/episodes/chunk-000"
    with Recorder(tmp_path, LAYOUT) as recorder:
        for value in range(7):
            _episode(recorder, 2 + value, value)
    assert sorted(file.name for file in tables.iterdir()) == [f"file-00{i}.parquet" for i in (0, 3, 6)]
    last = pq.read_table(tables / "file-000.parquet").slice(2)  # as if it was killed while it removed the three
    pq.write_table(last, tables / "file-002.parquet")
    assert [episode.length for episode in Dataset(tmp_path).episodes] == list(range(2, 9))
    assert [Dataset(tmp_path).episode(i)["pose"][0, 0] for i in range(7)] == list(range(7))
    Recorder(tmp_path, LAYOUT).close()
    assert not (tables / "file-002.parquet").exists() and doctor(tmp_path) == []


def test_a_file_that_the_system_refuses_to_grow_ends_the_encoder_clearly(tmp_path):
    """A limit on file size is a full disk to the encoder's thread and to parquet, without a full disk."""
    script = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import numpy as np
from layouts import layout_of
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Recorder
layout = layout_of(10, ("go",), rgb=(64, 64))
recorder = Recorder({str(tmp_path / "set")!r}, layout)
rng = np.random.default_rng(0)
def episode(rows):
    for _ in range(rows):
        recorder.add({{"rgb": rng.integers(0, 255, (64, 64, 3), np.uint8)}}, [0.0])
    recorder.end_episode()
episode(3)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    episode(400)
except DatasetError as error:
    print(error)
    print([episode.length for episode in Dataset({str(tmp_path / "set")!r}).episodes])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "the disk is full" in done.stdout and done.stdout.strip().endswith("[3]"), done.stdout + done.stderr


def test_a_second_recorder_is_refused_until_the_first_is_closed(tmp_path):
    first = Recorder(tmp_path, LAYOUT)
    with pytest.raises(DatasetError, match="another recorder"):
        Recorder(tmp_path, LAYOUT)
    first.close()
    Recorder(tmp_path, LAYOUT).close()


def test_foreign_folders_are_neither_read_nor_written(tmp_path, recording):
    with pytest.raises(DatasetError, match="no dataset"):
        Dataset(tmp_path / "nowhere")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    with pytest.raises(DatasetError, match="not a LeRobot dataset"):
        Dataset(tmp_path / "photos")
    with pytest.raises(DatasetError, match="other files"):
        Recorder(tmp_path / "photos", LAYOUT)
    assert (tmp_path / "photos" / "cat.jpg").read_bytes() == b"cat"
    with pytest.raises(DatasetError, match="another layout"):
        Recorder(recording, LAYOUT)
    (tmp_path / "file").write_text("x")
    with pytest.raises(DatasetError, match="choose another folder"):
        Recorder(tmp_path / "file", LAYOUT)
    info = json.loads((recording / "meta/info.json").read_text())
    (recording / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    with pytest.raises(DatasetError, match="v2.1.*convert"):
        Dataset(recording)
    (recording / "meta/info.json").write_text("{")
    with pytest.raises(DatasetError, match="info.json"):
        Dataset(recording)


def test_too_short_an_episode_is_dropped(tmp_path):
    with Recorder(tmp_path, LAYOUT) as recorder:
        _episode(recorder, 1)
        _episode(recorder, 2)
    assert [episode.length for episode in Dataset(tmp_path).episodes] == [2]


@pytest.mark.parametrize("share", sweep([0.0, 0.1, 0.5, 0.85], 0.5))
@pytest.mark.parametrize("kind", ["mp4", "parquet"])
def test_truncated_files_are_named(recording, kind, share):
    folder = "videos" if kind == "mp4" else "data"
    file = next((recording / folder).rglob(f"file-001.{kind}"))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    dataset = Dataset(recording)
    with pytest.raises(DatasetError, match=f"file-001.{kind}"):
        dataset.episode(1)
    with pytest.raises(DatasetError, match=f"file-001.{kind}"):
        ClipCache.open(dataset, (24, 32))
    assert not list((recording / ".cache").rglob("rgb.npy"))
    assert dataset.episode(2)["rgb"].shape == (30, 48, 64, 3)


def test_truncated_episode_table_is_named(recording):
    file = recording / "meta/episodes/chunk-000/file-002.parquet"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(DatasetError, match="file-002.parquet"):
        Dataset(recording)


def test_a_recorder_that_nobody_closed_lets_go_and_loses_no_row(tmp_path):
    """A closed tab, or an exception that was swallowed, leaves a recorder behind."""
    layout = layout_of(10, ("go",), rgb=(16, 16))

    def left_behind() -> None:
        recorder = Recorder(tmp_path / "recording", layout)
        for i in range(9):
            recorder.add({"rgb": np.full((16, 16, 3), 20 * i, np.uint8)}, [i])

    left_behind()
    with Recorder(tmp_path / "recording", layout) as recorder:
        assert recorder.recovered == 9 and recorder.episodes == 1


def test_a_recorder_that_fails_on_closing_lets_go(tmp_path, monkeypatch):
    layout = layout_of(10, ("go",), pose=True)
    recorder = Recorder(tmp_path / "recording", layout)
    for i in range(9):
        recorder.add({"pose": np.arange(7) + i}, [i])

    def broken(*_):
        raise ValueError("no")

    with monkeypatch.context() as patch:
        patch.setattr("terrella.data.writer.Writer.put", broken)
        with pytest.raises(ValueError):
            recorder.close()
    with Recorder(tmp_path / "recording", layout) as again:
        assert again.recovered == 9
