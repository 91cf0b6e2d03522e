"""What is recorded or converted here opens in the real `lerobot` package, and what that package records opens here.

`make test-lerobot` makes an environment of its own for that package (tests/lerobot_setup.sh) and names its python in
TERRELLA_LEROBOT_PYTHON; without it these tests are skipped.
"""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from terrella.care import doctor
from terrella.data import ClipCache, Dataset
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.convert import open_source, write_source
from terrella.exchange.formats.lerobot import LeRobotRows
from terrella.exchange.merging.write import merge_into

PYTHON = os.environ.get("TERRELLA_LEROBOT_PYTHON")
pytestmark = pytest.mark.skipif(
    not PYTHON, reason="run `make test-lerobot`: TERRELLA_LEROBOT_PYTHON names no python with lerobot 0.4"
)

# torchvision's compiled operators may be missing beside a CPU torch; lerobot does not call them.
HEAD = """
import json, sys
import numpy as np, torch
try:
    import torchvision
except RuntimeError:
    for module in [name for name in sys.modules if name.startswith("torchvision")]:
        del sys.modules[module]
    library = torch.library.Library("torchvision", "DEF")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from lerobot.datasets.lerobot_dataset import LeRobotDataset
root = sys.argv[1]
"""

READ = """
data = LeRobotDataset("local/test", root=root)
facts = {"length": len(data), "episodes": data.num_episodes, "fps": data.fps, "rows": {}}
facts["stats"] = {name: np.ravel(part["mean"]).tolist() for name, part in data.meta.stats.items()}
facts["lengths"] = [int(length) for length in data.meta.episodes["length"]]
for at in json.loads(sys.argv[2]):
    item = data[at]
    facts["rows"][at] = {name: np.asarray(value).tolist() for name, value in item.items() if "images" not in name}
    for name in data.meta.camera_keys:
        facts["rows"][at][name] = (item[name].permute(1, 2, 0) * 255).round().int().tolist()
print(json.dumps(facts))
"""

WRITE = """
features = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    "observation.images.front": {"dtype": "video", "shape": (64, 96, 3), "names": ["height", "width", "channels"]},
    "observation.images.wrist": {"dtype": "image", "shape": (16, 24, 3), "names": ["height", "width", "channels"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
}
data = LeRobotDataset.create("local/test", fps=10, features=features, root=root)
for episode in range(3):
    for i in range(12 + episode):
        data.add_frame({
            "observation.state": np.array([episode, i], np.float32),
            "observation.images.front": np.full((64, 96, 3), 20 * episode + 5 * i, np.uint8),
            "observation.images.wrist": np.full((16, 24, 3), 10 * episode + i, np.uint8),
            "action": np.array([i, -i], np.float32),
            "task": ["push", "pull", "push"][episode],
        })
    data.save_episode()
data.finalize()
"""


def _lerobot(script: str, root, rows=()) -> str:
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    command = [str(PYTHON), "-c", HEAD + script, str(root), json.dumps(list(rows))]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_lerobot_reads_what_was_recorded(recording):
    facts = json.loads(_lerobot(READ, recording, (0, 29, 30, 44, 99)).splitlines()[-1])
    dataset = Dataset(recording)
    assert (facts["length"], facts["episodes"], facts["fps"]) == (100, 4, 35)
    for at, row in facts["rows"].items():
        episode = next(episode for episode in dataset.episodes if episode.start <= int(at) < episode.stop)
        mine, place = dataset.episode(episode.number), int(at) - episode.start
        assert np.array_equal(np.array(row["observation.depth"]), np.round(mine["depth"][place] * 1000))
        assert np.allclose(row["observation.state"], mine["pose"][place], atol=1e-6)
        assert row["action"] == mine["action"][place].tolist() and row["task"] == "explore corridor"
        assert row["action_valid"] == mine["action_valid"][place] and row["next.done"] == mine["done"][place]
        assert np.abs(np.array(row["observation.images.rgb"]) - mine["rgb"][place].astype(int)).mean() < 2


def test_what_lerobot_records_opens_here(tmp_path):
    _lerobot(WRITE, tmp_path / "theirs")
    dataset = Dataset(tmp_path / "theirs")
    assert dataset.length == 39 and [episode.length for episode in dataset.episodes] == [12, 13, 14]
    found = dataset.episode(2)
    assert found["action"].tolist() == [[i, -i] for i in range(14)] and not found["action_valid"][-1]
    assert found["observation.state"].tolist() == [[2, i] for i in range(14)] and "pose" not in found
    assert np.abs(found["rgb"].mean((1, 2, 3)) - (40 + 5 * np.arange(14))).max() < 4
    assert [episode.task for episode in dataset.episodes] == ["push", "pull", "push"]
    assert dataset.cameras == ("observation.images.front", "observation.images.wrist")
    wrist = dataset.episode(1, ["observation.images.wrist"])["observation.images.wrist"]
    assert np.array_equal(wrist, np.broadcast_to((10 + np.arange(13))[:, None, None, None], (13, 16, 24, 3)))
    clips = ClipCache.open(dataset, (32, 48))
    assert clips.pose is None and clips.depth is None and clips.rgb.shape == (39, 32, 48, 3)
    assert doctor(dataset.root) == []


def test_a_rig_and_its_conversions_open_in_lerobot(tmp_path):
    """Sensors with clocks of their own, resampled to rows; the same again through our own reader."""
    rng = np.random.default_rng(0)
    front, imu = np.arange(20) / 10 + 0.003, np.arange(100) / 50
    sensors = [
        Sensor("observation.images.front", "image", (32, 48, 3), "uint8", rate_hz=10.0),
        Sensor("observation.imu", "vector", (3,), names=("ax", "ay", "az"), rate_hz=50.0),
        Sensor("observation.points.lidar", "points", (0, 3), rate_hz=10.0),
        Sensor("observation.state", "vector", (2, 3), "float64"),
        Sensor("action", "vector", (1,), "int64", names=("button",)),
    ]
    readings = {
        "observation.images.front": Readings(front, np.full((20, 32, 48, 3), 90, np.uint8)),
        "observation.imu": Readings(imu, rng.normal(size=(100, 3)).astype(np.float32)),
        "observation.points.lidar": Readings(front, [rng.normal(size=(i, 3)).astype(np.float32) for i in range(20)]),
        "observation.state": Readings(front, rng.normal(size=(20, 2, 3))),
        "action": Readings(front[:-1], np.arange(19)[:, None]),
    }
    takes = [Take(readings, "look"), Take(readings, "go")]
    write_source(Source("rig", {sensor.name: sensor for sensor in sensors}, lambda: takes), tmp_path / "rig")
    write_source(open_source(tmp_path / "rig"), tmp_path / "again")
    for name in ("rig", "again"):
        facts = json.loads(_lerobot(READ, tmp_path / name, (0, 7, 27, 39)).splitlines()[-1])
        assert (facts["length"], facts["episodes"], facts["fps"]) == (40, 2, 10)
        for at, row in facts["rows"].items():
            place = int(at) % 20
            newest = np.searchsorted(imu, front[place], side="right") - 1
            assert np.allclose(row["observation.imu"], readings["observation.imu"].values[newest])
            assert np.allclose(row["observation.state"], readings["observation.state"].values[place])
            assert row["task"] == ["look", "go"][int(at) // 20] and np.allclose(row["time_s"], front[place])
            assert row["action"] == (place if place < 19 else 0) and row["action_valid"] == (place < 19)
            assert np.abs(np.array(row["observation.images.front"]) - 90).max() <= 2


def test_png_merged_tables_and_statistics_open_in_lerobot(tmp_path, monkeypatch):
    monkeypatch.setattr("terrella.data.writer.EPISODES_PER_TABLE", 3)
    camera = Sensor("observation.images.top", "image", (16, 24, 3), "uint8")
    state = Sensor("observation.state", "vector", (2,), names=("x_m", "y_m"))
    rng = np.random.default_rng(0)
    takes = []
    for length in (4, 5, 6, 7):
        at = np.arange(length) / 10
        pictures = rng.integers(0, 255, (length, 16, 24, 3), np.uint8)
        takes.append(
            Take({camera.name: Readings(at, pictures), state.name: Readings(at, rng.random((length, 2)))}, "see")
        )
    source = Source("png", {camera.name: camera, state.name: state}, lambda: takes, 10.0)
    write_source(source, tmp_path / "png", rows=LeRobotRows(pictures="png"))
    assert len(list((tmp_path / "png/meta/episodes/chunk-000").iterdir())) == 2
    facts = json.loads(_lerobot(READ, tmp_path / "png", (0, 8, 21)).splitlines()[-1])
    assert facts["lengths"] == [4, 5, 6, 7] and facts["length"] == 22
    for at, (take, row) in {0: (0, 0), 8: (1, 4), 21: (3, 6)}.items():
        found = np.array(facts["rows"][str(at)][camera.name])
        assert np.array_equal(found, takes[take].readings[camera.name].values[row])
    every = np.concatenate([take.readings[state.name].values for take in takes]).astype(np.float32)
    assert np.allclose(facts["stats"][state.name], every.mean(0)) and len(facts["stats"][camera.name]) == 3


def test_several_robots_merged_open_in_lerobot(tmp_path, recording):
    arm = Source(
        "arm",
        {
            "observation.state": Sensor("observation.state", "vector", (1,), names=("x_m",), units={"x_m": "m"}),
            "action": Sensor("action", "vector", (1,), names=("grip",)),
        },
        lambda: [
            Take({"observation.state": Readings(np.arange(9) / 35, np.ones((9, 1), np.float32)),
                  "action": Readings(np.arange(8) / 35, np.full((8, 1), 0.5, np.float32))}, "grasp")
        ],
        35.0,
        "arm",
    )  # fmt: skip
    merge_into({"corridor": open_source(recording), "arm": arm}, tmp_path / "all")
    facts = json.loads(_lerobot(READ, tmp_path / "all", (0, 104)).splitlines()[-1])
    assert facts["length"] == 109 and facts["episodes"] == 5 and facts["rows"]["104"]["task"] == "grasp"
    width = len(facts["rows"]["0"]["action"])
    assert facts["rows"]["104"]["action"] == [0.0] * (width - 1) + [0.5]
    assert facts["rows"]["104"]["action_mask"] == [False] * (width - 1) + [True]
    assert facts["rows"]["0"]["embodiment"] != facts["rows"]["104"]["embodiment"]
