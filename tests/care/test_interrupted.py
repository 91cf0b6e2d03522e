"""What a killed recorder left in flight is an episode when the folder is opened again, up to its last whole frame."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from layouts import layout_of
from sweeps import sweep

from terrella.care import repair
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Layout, Recorder
from terrella.data.channels import RGB, STATE
from terrella.data.resample import resample
from terrella.data.source import Sensor

LIDAR, SIDE = "observation.points.lidar", "observation.images.side"
LAYOUT = Layout(
    20,
    layout_of(20, ("go",), rgb=(32, 48), pose=True).sensors,
    streams={LIDAR: Sensor(LIDAR, "points", (0, 3)), SIDE: Sensor(SIDE, "image", (16, 16, 3), "uint8", rate_hz=5)},
    clock=True,
)

SCRIPT = """
import sys
sys.path[:0] = {folders!r}
from test_interrupted import drive
from terrella.data import Recorder
from test_interrupted import LAYOUT
recorder = Recorder({root!r}, LAYOUT, "patrol")
drive(recorder, 7)
recorder.end_episode()
drive(recorder, 10_000, tell=True)
"""


def drive(recorder: Recorder, rows: int, tell: bool = False) -> None:
    """Rows whose numbers say which row they are; one lidar reading a row, one picture from the side every fourth."""
    for i in range(rows):
        row = {"rgb": np.full((32, 48, 3), 20 + i % 200, np.uint8), "pose": np.full(7, i)}
        recorder.add(row, [float(i)], reward=i, time_s=i / 20)
        recorder.log(LIDAR, np.full((1 + i % 3, 3), i, np.float32), time_s=i / 20 + 0.01)
        if i % 4 == 0:
            recorder.log(SIDE, np.full((16, 16, 3), 10 + i % 100, np.uint8), time_s=i / 20 + 0.02)
        if tell:
            print(i, flush=True)


def check(root: Path, number: int, least: int) -> int:
    """The episode holds rows 0, 1, 2, ... as they were driven; returns how many."""
    dataset = Dataset(root)
    found = dataset.episode(number)
    length = len(found["pose"])
    assert length >= least
    assert np.array_equal(found["pose"][:, 0], np.arange(length)) and found["reward"].tolist() == list(range(length))
    assert np.array_equal(found["action"][:-1, 0], np.arange(length - 1)) and not found["action_valid"][-1]
    assert np.abs(found["rgb"].mean((1, 2, 3)) - (20 + np.arange(length) % 200)).max() < 4
    assert np.allclose(dataset.time_s(number), np.arange(length) / 20)
    points, side = dataset.readings(number, LIDAR), dataset.readings(number, SIDE)
    for i, (time_s, cloud) in enumerate(zip(points.time_s, points.values)):
        assert time_s == i / 20 + 0.01 and np.array_equal(cloud, np.full((1 + i % 3, 3), i))
    assert np.allclose(side.time_s, np.arange(len(side.time_s)) / 5 + 0.02)
    assert all(abs(side.values[i].mean() - (10 + 4 * i % 100)) < 4 for i in range(len(side.time_s)))
    return length


@pytest.mark.parametrize("rows", sweep([90, 300], 90))
def test_kill_9_keeps_every_whole_frame_of_the_episode_in_flight(tmp_path, rows):
    root = tmp_path / "killed"
    script = SCRIPT.format(
        folders=[str(Path(__file__).parents[i]) + end for i, end in ((0, ""), (1, "/data"))], root=str(root)
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        while int(process.stdout.readline()) < rows:
            pass
        os.kill(process.pid, signal.SIGKILL)
    assert [episode.length for episode in Dataset(root).episodes] == [7]
    with Recorder(root, LAYOUT, "patrol") as again:
        assert again.recovered == Dataset(root).episodes[1].length
    assert check(root, 0, 7) == 7
    assert (
        check(root, 1, rows - 70) >= 2 and Dataset(root).episodes[1].task == "patrol"
    )  # 64 frames may wait for the encoder
    Recorder(root, LAYOUT).close()
    assert len(Dataset(root).episodes) == 2  # it is kept once


def test_an_interrupted_episode_may_be_thrown_away(tmp_path):
    recorder = _left_in_flight(tmp_path, 9)
    assert recorder.in_flight == 9
    shutil.copytree(tmp_path, tmp_path.with_name("other"))
    with Recorder(tmp_path, LAYOUT, "patrol", "discard") as again:
        assert again.recovered == 0
    assert len(Dataset(tmp_path).episodes) == 0 and not (tmp_path / ".staging").exists()
    with Recorder(tmp_path.with_name("other"), LAYOUT, "explore", "discard") as again:  # it was not this task's
        assert again.recovered == 9


@pytest.mark.parametrize("name", ["rows.log", f"{RGB}.growing.mp4", f"stream-{SIDE}.growing.mp4"])
def test_a_write_cut_anywhere_costs_what_was_not_whole(tmp_path, name):
    """The power goes: the last write of one file is cut at any byte."""
    _left_in_flight(tmp_path / "left", 12)
    whole = (tmp_path / "left/.staging" / name).read_bytes()
    lengths = []
    for cut in range(0, len(whole), max(1, len(whole) // 24)):
        root = tmp_path / f"cut-{cut}"
        shutil.copytree(tmp_path / "left", root)
        (root / ".staging" / name).write_bytes(whole[:cut])
        with Recorder(root, LAYOUT) as again:
            lengths.append(again.recovered)
        if lengths[-1]:
            assert check(root, 0, 2) == lengths[-1]
    assert lengths == sorted(lengths), lengths  # the later the cut, the more is kept
    assert lengths[-1] >= 11 if "stream" not in name else set(lengths) == {12}


@pytest.mark.parametrize("name", ["rows.log", f"{RGB}.growing.mp4"])
@pytest.mark.parametrize("zeros", sweep([8192, 3], 8192))
def test_zeros_at_the_end_cost_nothing_that_was_whole(tmp_path, name, zeros):
    """What a power cut leaves on many file systems."""
    _left_in_flight(tmp_path, 12)
    with open(tmp_path / ".staging" / name, "ab") as file:
        file.write(bytes(zeros))
    with Recorder(tmp_path, LAYOUT) as again:
        assert again.recovered == 12
    assert check(tmp_path, 0, 12) == 12


def test_a_damaged_frame_ends_the_episode_before_it(tmp_path):
    _left_in_flight(tmp_path, 40)
    film = tmp_path / ".staging" / f"{RGB}.growing.mp4"
    data = bytearray(film.read_bytes())
    middle = data.index(b"mdat", len(data) // 2)
    data[middle + 8 : middle + 40] = bytes(range(32))
    film.write_bytes(data)
    with Recorder(tmp_path, LAYOUT) as again:
        assert 8 <= again.recovered < 40
    check(tmp_path, 0, 8)


def test_repair_keeps_an_interrupted_first_episode(tmp_path):
    _left_in_flight(tmp_path / "set", 12)
    repair(tmp_path / "set", tmp_path / "mended")
    assert check(tmp_path / "mended", 0, 12) == 12


def test_a_closed_recorder_leaves_the_next_one_alone(tmp_path):
    first = Recorder(tmp_path, LAYOUT, "patrol")
    first.close()
    with Recorder(tmp_path, LAYOUT, "patrol") as second:
        drive(second, 8)
        first.end_episode()
        first.drop_episode()
        first.close()
    assert check(tmp_path, 0, 8) == 8


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.EIO, "Input/output error")])
def test_what_cannot_be_kept_now_is_kept_later(tmp_path, monkeypatch, error):
    _left_in_flight(tmp_path, 9)

    def failing(*_):
        raise error

    for place in ("terrella.data.recorder.Staged", "terrella.data.writer.Writer.put"):
        with monkeypatch.context() as patch:
            patch.setattr(place, failing)
            with pytest.raises((DatasetError, KeyboardInterrupt)):
                Recorder(tmp_path, LAYOUT)
    with Recorder(tmp_path, LAYOUT) as again:
        assert again.recovered == 9


def test_what_was_interrupted_fits_by_name_not_by_order(tmp_path):
    one = Layout(10, {name: Sensor(f"observation.{name}", "vector", (1,)) for name in "ab"})
    one = Layout(10, {sensor.name: sensor for sensor in one.sensors.values()})
    other = Layout(10, dict(reversed(one.sensors.items())))
    recorder = Recorder(tmp_path, one)
    for i in range(5):
        recorder.add_row({"observation.a": np.array([i]), "observation.b": np.array([10 * i])})
    recorder._journal.close()
    recorder._writer.close()
    with Recorder(tmp_path, other) as again:
        assert again.recovered == 5
    found = Dataset(tmp_path).episode(0)
    assert found["observation.a"].ravel().tolist() == [0, 1, 2, 3, 4]
    assert found["observation.b"].ravel().tolist() == [0, 10, 20, 30, 40]


def _left_in_flight(root: Path, rows: int) -> Recorder:
    """A recorder whose process died: its lock is free, its files are as they were."""
    recorder = Recorder(root, LAYOUT, "patrol")
    drive(recorder, rows)
    for video in [*recorder._videos.values(), *recorder._films.values()]:
        video.close()
    recorder._journal.close()
    recorder._writer.close()
    recorder._videos, recorder._films = {}, {}
    return recorder


def test_streams_keep_their_true_times_and_come_to_the_rows_by_a_stated_policy(tmp_path):
    with Recorder(tmp_path, LAYOUT) as recorder:
        drive(recorder, 40)
    assert check(tmp_path, 0, 40) == 40
    dataset = Dataset(tmp_path)
    clouds, valid = _aligned(dataset, 0, LIDAR)  # previous: row i sees the reading of row i - 1, for it came 10 ms late
    assert valid.tolist() == [False, *[True] * 39] and [cloud[0, 0] for cloud in clouds[1:]] == list(range(39))
    clouds, valid = _aligned(dataset, 0, LIDAR, "nearest")
    assert valid.all() and [cloud[0, 0] for cloud in clouds] == list(range(40))
    _, valid = _aligned(dataset, 0, SIDE, max_gap_s=0.1)
    assert valid.sum() == 20  # of four rows, those that are 30 ms and 80 ms after a picture
    assert STATE in dataset.sensors and dataset.episodes[0].start_ns


def test_a_stream_that_goes_back_in_time_is_refused(tmp_path):
    with Recorder(tmp_path, LAYOUT) as recorder:
        recorder.log(LIDAR, np.zeros((2, 3)), time_s=1.0)
        with pytest.raises(DatasetError, match=r"0.5 s after one at 1.0 s"):
            recorder.log(LIDAR, np.zeros((2, 3)), time_s=0.5)
        with pytest.raises(DatasetError, match="no stream 'sonar'"):
            recorder.log("sonar", np.zeros(3))
        with pytest.raises(DatasetError, match=r"points of shape \[n, 3\]"):
            recorder.log(LIDAR, np.zeros((2, 4)))


def _aligned(dataset, number, name, policy="previous", max_gap_s=None):
    sensor = (dataset.streams | dataset.sensors)[name]
    return resample(dataset.readings(number, name), sensor, dataset.time_s(number), policy, max_gap_s)
