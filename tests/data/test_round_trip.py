"""What was recorded is what is read: bit for bit, and within the codec's loss for pictures."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pytest
from corridor import BUTTONS, Corridor, keys, picture
from hypothesis import given
from hypothesis import strategies as st
from layouts import layout_of

from terrella.core import make_rng
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Recorder, record
from terrella.data.format import DEPTH_BEYOND, schema, to_arrow, to_numpy


def test_every_lossless_array_comes_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    layout = layout_of(30, ("gas", "wheel"), depth=(5, 7), pose=True, vectors={"lidar": 3, "fuel": 1})
    truth = {
        "depth": (rng.integers(0, 60_000, (600, 5, 7)) / 1000).astype(np.float32),
        "pose": rng.normal(size=(600, 7)).astype(np.float32),
        "lidar": rng.normal(size=(600, 3)).astype(np.float32),
        "fuel": rng.normal(size=(600, 1)).astype(np.float32),
    }
    action = rng.normal(size=(600, 2)).astype(np.float32)
    reward = rng.normal(size=600).astype(np.float32)
    with Recorder(tmp_path / "set", layout, "drive") as recorder:
        for start, stop in ((0, 523), (523, 600)):  # more rows than a row group holds, and fewer
            for i in range(start, stop - 1):
                recorder.add({name: value[i] for name, value in truth.items()}, action[i], reward[i], i == stop - 2)
            recorder.add({name: value[stop - 1] for name, value in truth.items()})
            recorder.end_episode()
    dataset = Dataset(tmp_path / "set")
    assert [(e.start, e.stop, e.task) for e in dataset.episodes] == [(0, 523, "drive"), (523, 600, "drive")]
    assert dataset.action_names == ("gas", "wheel")
    for episode in dataset.episodes:
        rows, found = slice(episode.start, episode.stop), dataset.episode(episode.number)
        assert set(found) >= {"depth", "pose", "action", "action_valid", "reward", "done", "observation.lidar"}
        assert "rgb" not in found
        np.testing.assert_array_equal(np.round(found["depth"] * 1000), np.round(truth["depth"][rows] * 1000))
        np.testing.assert_array_equal(found["pose"], truth["pose"][rows])
        np.testing.assert_array_equal(found["observation.lidar"], truth["lidar"][rows])
        np.testing.assert_array_equal(found["observation.fuel"], truth["fuel"][rows])
        np.testing.assert_array_equal(found["action"][:-1], action[rows][:-1])
        np.testing.assert_array_equal(found["reward"][:-1], reward[rows][:-1])
        assert found["action_valid"].tolist() == [True] * (episode.length - 1) + [False]
        assert found["done"].tolist() == [False] * (episode.length - 2) + [True, True]


def test_depth_keeps_millimetres_and_says_what_is_beyond(tmp_path):
    given_m = np.array([[0.0, 0.0004, 0.0016], [-1.0, 65.534, 70.0], [np.inf, np.nan, 12.3456]], np.float32)
    with Recorder(tmp_path, layout_of(10, ("go",), depth=(3, 3))) as recorder:
        recorder.add({"depth": given_m}, [1.0])
        recorder.add({"depth": given_m})
    want = [[0, 0, 2], [0, 65534, DEPTH_BEYOND], [DEPTH_BEYOND, DEPTH_BEYOND, 12346]]
    np.testing.assert_array_equal(np.round(Dataset(tmp_path).episode(0)["depth"][1] * 1000), want)


def test_pictures_come_back_above_35_db_in_the_right_order(recording):
    dataset = Dataset(recording)
    for episode in dataset.episodes:
        found = dataset.episode(episode.number)
        truth = np.stack([_picture_at(pose) for pose in found["pose"]])
        error = ((found["rgb"].astype(float) - truth) ** 2).mean((1, 2, 3))
        assert (10 * np.log10(255**2 / error)).min() > 35
    assert dataset.world["name"] == "corridor" and dataset.world["camera"] == [0.5, 0.8, 0.5, 0.5]
    assert dataset.action_names == BUTTONS


def _picture_at(pose):
    return picture(pose[0], pose[1], 2 * np.arctan2(pose[6], pose[3]))


@pytest.fixture(scope="module")
def every_picture(_recorded):
    dataset = Dataset(_recorded)
    return np.concatenate([dataset.episode(i, ["rgb"])["rgb"] for i in range(4)])


@given(st.lists(st.integers(0, 99), min_size=0, max_size=12))
def test_rgb_at_is_the_episodes_pictures_in_any_order(_recorded, every_picture, indices):
    np.testing.assert_array_equal(Dataset(_recorded).rgb_at(indices), every_picture[indices])


@given(st.integers(1, 5), st.integers(1, 4), st.integers(2, 4))
def test_arrow_and_numpy_are_inverse(rows, height, width):
    features = {
        "map": {"dtype": "uint16", "shape": [height, width]},
        "list": {"dtype": "float32", "shape": [width]},
        "flag": {"dtype": "bool", "shape": [1]},
    }
    rng = np.random.default_rng(rows)
    for field in schema(features):
        shape = tuple(features[field.name]["shape"])
        array = rng.integers(0, 2, (rows, *shape)).astype(features[field.name]["dtype"])
        column = to_arrow(array, field.type)
        assert column.type == field.type
        np.testing.assert_array_equal(to_numpy(pa.chunked_array([column]), shape), array)


def test_statistics_of_all_episodes_are_those_of_all_rows(recording):
    stats = json.loads((recording / "meta/stats.json").read_text())
    dataset = Dataset(recording)
    pose = np.concatenate([dataset.episode(i, ["pose"])["pose"] for i in range(4)]).astype(np.float64)
    for name, value in (("min", pose.min(0)), ("max", pose.max(0)), ("mean", pose.mean(0)), ("std", pose.std(0))):
        np.testing.assert_allclose(stats["observation.state"][name], value, atol=1e-9)
    assert {value["count"][0] for value in stats.values()} == {100}
    assert np.shape(stats["observation.images.rgb"]["mean"]) == (3, 1, 1)


def test_record_stops_at_done_and_counts_the_frames_of_an_earlier_run(tmp_path):
    world = Corridor(goal_m=3.0)
    first = record(world, keys, tmp_path / "once", frames=90, rng=make_rng(5))
    lengths = [episode.length for episode in Dataset(tmp_path / "once").episodes]
    assert first.rows == sum(lengths) and first.rows in (89, 90) and len(lengths) > 1
    assert all(Dataset(tmp_path / "once").episode(i)["done"][-2] for i in range(len(lengths) - 1))
    record(world, keys, tmp_path / "twice", frames=lengths[0], rng=make_rng(5))
    record(world, keys, tmp_path / "twice", frames=90, rng=make_rng(5))
    for i in range(len(lengths)):  # a run in two parts is the run in one
        one, two = Dataset(tmp_path / "once").episode(i), Dataset(tmp_path / "twice").episode(i)
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])


def test_what_does_not_fit_is_refused_and_leaves_the_recording_whole(tmp_path):
    recorder = Recorder(tmp_path, layout_of(10, ("go",), pose=True))
    recorder.add({"pose": np.zeros(7)}, [1.0])
    with pytest.raises(DatasetError, match="lacks"):
        recorder.add({}, [1.0])
    with pytest.raises(DatasetError, match="shape"):
        recorder.add({"pose": np.zeros(6)}, [1.0])
    with pytest.raises(DatasetError, match=r"shape \(1,\)"):
        recorder.add({"pose": np.zeros(7)}, [1.0, 2.0])
    with pytest.raises(DatasetError, match="finite"):
        recorder.add({"pose": np.full(7, np.nan)}, [1.0])
    recorder.add({"pose": np.ones(7)})
    recorder.close()
    assert Dataset(tmp_path).episode(0)["pose"].tolist() == [[0.0] * 7, [1.0] * 7]
    with pytest.raises(DatasetError, match="rows a second"):
        Recorder(tmp_path / "slow", layout_of(3e-5, ("go",), pose=True))
    with pytest.raises(DatasetError, match="even"):
        Recorder(tmp_path / "odd", layout_of(10, ("go",), rgb=(15, 16)))


def test_an_observation_that_the_caller_changes_later_is_recorded_as_it_was(tmp_path):
    frame, pose = np.zeros((16, 16, 3), np.uint8), np.zeros(7, np.float32)
    with Recorder(tmp_path, layout_of(10, ("go",), rgb=(16, 16), pose=True)) as recorder:
        for value in (10, 200):
            frame[:], pose[:] = value, value
            recorder.add({"rgb": frame, "pose": pose}, [0.0])
        frame[:], pose[:] = 99, 99
    found = Dataset(tmp_path).episode(0)
    assert found["pose"][:, 0].tolist() == [10.0, 200.0]
    assert np.abs(found["rgb"].mean((1, 2, 3)) - [10, 200]).max() < 4
    assert found["action_valid"].tolist() == [True, False]
