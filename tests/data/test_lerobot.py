"""The recording opens in the real `lerobot` package, and a recording of that package opens here.

Set TERRELLA_LEROBOT_PYTHON to the python of an environment of its own that has lerobot 0.4. On a CPU with Python 3.11:
torch 2.13; `pip install --no-deps torchvision==0.28.0 lerobot==0.4.4 torchcodec==0.13.0`; "datasets>=4,<5" "av<16"
"huggingface-hub<0.36" jsonlines einops "opencv-python-headless<4.13" pillow draccus==0.10.0 termcolor deepdiff
"imageio[ffmpeg]" accelerate; and the system's ffmpeg.
"""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from terrella.data import ClipCache, Dataset, doctor

PYTHON = os.environ.get("TERRELLA_LEROBOT_PYTHON")
pytestmark = pytest.mark.skipif(not PYTHON, reason="TERRELLA_LEROBOT_PYTHON names no python with lerobot 0.4")

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
for at in (0, 29, 30, 44, 99):
    item = data[at]
    facts["rows"][at] = {name: np.asarray(value).tolist() for name, value in item.items() if name != "observation.images.rgb"}
    facts["rows"][at]["rgb"] = (item["observation.images.rgb"].permute(1, 2, 0) * 255).round().int().tolist()
print(json.dumps(facts))
"""

WRITE = """
features = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    "observation.images.front": {"dtype": "video", "shape": (64, 96, 3), "names": ["height", "width", "channels"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
}
data = LeRobotDataset.create("local/test", fps=10, features=features, root=root)
for episode in range(3):
    for i in range(12 + episode):
        data.add_frame({
            "observation.state": np.array([episode, i], np.float32),
            "observation.images.front": np.full((64, 96, 3), 20 * episode + 5 * i, np.uint8),
            "action": np.array([i, -i], np.float32),
            "task": "push",
        })
    data.save_episode()
data.finalize()
"""


def _lerobot(script: str, root) -> str:
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    done = subprocess.run(
        [str(PYTHON), "-c", HEAD + script, str(root)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_lerobot_reads_what_was_recorded(recording):
    facts = json.loads(_lerobot(READ, recording).splitlines()[-1])
    dataset = Dataset(recording)
    assert (facts["length"], facts["episodes"], facts["fps"]) == (100, 4, 35)
    for at, row in facts["rows"].items():
        episode = next(episode for episode in dataset.episodes if episode.start <= int(at) < episode.stop)
        mine, place = dataset.episode(episode.number), int(at) - episode.start
        assert np.array_equal(np.array(row["observation.depth"]), np.round(mine["depth"][place] * 1000))
        assert np.allclose(row["observation.state"], mine["pose"][place], atol=1e-6)
        assert row["action"] == mine["action"][place].tolist() and row["task"] == "explore corridor"
        assert row["action_valid"] == mine["action_valid"][place] and row["next.done"] == mine["done"][place]
        assert np.abs(np.array(row["rgb"]) - mine["rgb"][place].astype(int)).mean() < 2


def test_what_lerobot_records_opens_here(tmp_path):
    _lerobot(WRITE, tmp_path / "theirs")
    dataset = Dataset(tmp_path / "theirs")
    assert dataset.length == 39 and [episode.length for episode in dataset.episodes] == [12, 13, 14]
    found = dataset.episode(2)
    assert found["action"].tolist() == [[i, -i] for i in range(14)] and not found["action_valid"][-1]
    assert found["observation.state"].tolist() == [[2, i] for i in range(14)] and "pose" not in found
    assert np.abs(found["rgb"].mean((1, 2, 3)) - (40 + 5 * np.arange(14))).max() < 4
    clips = ClipCache.open(dataset, (32, 48))
    assert clips.pose is None and clips.depth is None and clips.rgb.shape == (39, 32, 48, 3)
    assert doctor(dataset.root) == []
