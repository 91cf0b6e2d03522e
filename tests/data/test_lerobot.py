"""What is recorded or converted here opens in the real `lerobot` package, and what that package records opens here.

Its policies act here as they do there, and ours there as here.

`make test-lerobot` makes an environment of its own for that package (tests/lerobot_setup.sh) and names its python in
TERRELLA_LEROBOT_PYTHON; without it these tests are skipped.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load, save
from tests.act.reach import NAME as REACH

import terrella
from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig, ActorNetwork
from terrella.act.imitation import ImitationActor
from terrella.act.imitation_network import ImitationConfig, ImitationNetwork
from terrella.care import doctor
from terrella.cli import main
from terrella.core import chance
from terrella.core.errors import CheckpointError
from terrella.core.feature_names import features_of
from terrella.core.instruction import text_to_bytes
from terrella.core.spec import TEXT, Spec
from terrella.core.world import make_rng
from terrella.data import ClipCache, Dataset
from terrella.data.source import Readings, Sensor, Source, Take
from terrella.exchange.convert import open_source, write_source
from terrella.exchange.formats.lerobot import LeRobotRows
from terrella.exchange.merging.write import merge_into

ROOT = Path(__file__).parents[2]
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


POLICIES = """
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
inputs = {
    "observation.images.rgb": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
    "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
}
outputs = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
numbers = {"mean": [1.0, -2.0], "std": [3.0, 0.5], "min": [-4.0, -5.0], "max": [4.0, 4.0]}
stats = {"observation.state": numbers, "action": {name: [0.1 * x for x in values] for name, values in numbers.items()}}
levels = {"mean": 0.4, "std": 0.3, "min": 0.0, "max": 1.0}
stats["observation.images.rgb"] = {name: [[[x]]] * 3 for name, x in levels.items()}
stats = {key: {name: torch.tensor(x) for name, x in one.items()} for key, one in stats.items()}
sizes = {
    "act": dict(chunk_size=6, n_action_steps=4, dim_model=32, n_heads=2, dim_feedforward=64, n_encoder_layers=1,
                n_vae_encoder_layers=1, latent_dim=8, pretrained_backbone_weights=None),
    "diffusion": dict(horizon=8, n_action_steps=4, down_dims=(16, 32), diffusion_step_embed_dim=16, n_groups=4,
                      num_train_timesteps=20, num_inference_steps=5, spatial_softmax_num_keypoints=4, crop_shape=None),
}
sizes["ensemble"] = {**sizes["act"], "n_action_steps": 1, "temporal_ensemble_coeff": 0.01}
for name, settings in sizes.items():
    torch.manual_seed(0)
    kind = name.replace("ensemble", "act")
    config = make_policy_config(kind, input_features=inputs, output_features=outputs, device="cpu", **settings)
    for part in (get_policy_class(kind)(config), *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(f"{root}/{name}")
"""

ACT = """
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
seen = np.load(f"{root}/seen.npz")
actions = {}
for name in json.loads(sys.argv[2]):
    config = PreTrainedConfig.from_pretrained(f"{root}/{name}")
    policy = get_policy_class(config.type).from_pretrained(f"{root}/{name}")
    before, after = make_pre_post_processors(config, f"{root}/{name}")
    policy.reset()
    actions[name] = []
    for at, seed in enumerate(seen["seeds"]):
        given = preprocess_observation({"pixels": {"rgb": seen["rgb"][at]}, "agent_pos": seen["state"][at]})
        torch.manual_seed(int(seed))
        with torch.inference_mode():
            actions[name] += after(policy.select_action(before(given))).tolist()
print(json.dumps(actions))
"""


TRAIN = """
from lerobot.configs.types import FeatureType
from lerobot.datasets.utils import dataset_to_policy_features
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
where, = json.loads(sys.argv[2])
data = LeRobotDataset("local/test", root=root, delta_timestamps={"action": [step / 10 for step in range(4)]})
features = dataset_to_policy_features(data.meta.features)
outputs = {name: one for name, one in features.items() if one.type is FeatureType.ACTION and name == "action"}
inputs = {name: one for name, one in features.items() if one.type in (FeatureType.VISUAL, FeatureType.STATE)}
config = make_policy_config(
    "act", input_features=inputs, output_features=outputs, device="cpu", chunk_size=4, n_action_steps=4, dim_model=32,
    n_heads=2, dim_feedforward=64, n_encoder_layers=1, n_vae_encoder_layers=1, pretrained_backbone_weights=None,
)
torch.manual_seed(0)
policy = get_policy_class("act")(config)
before, after = make_pre_post_processors(config, dataset_stats=data.meta.stats)
optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
for batch, _ in zip(torch.utils.data.DataLoader(data, 8, shuffle=True), range(4)):
    loss, _ = policy.forward(before(batch))
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
for part in (policy, before, after):
    part.save_pretrained(where)
print(json.dumps({"inputs": list(inputs), "loss": loss.item()}))
"""

OURS = """
from pathlib import Path
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()  # finds the package by the prefix of its name
from lerobot_policy_terrella.__main__ import main
answers = {}
for name in json.loads(sys.argv[2]):
    assert main([f"{root}/{name}", f"{root}/{name}-there"]) is None
    for place, times in ((f"{root}/{name}-there", 1), (f"{root}/{name}-again", 0)):
        config = PreTrainedConfig.from_pretrained(place)
        assert config.type == "terrella"
        policy = get_policy_class("terrella").from_pretrained(place, strict=True)
        before, after = make_pre_post_processors(config, place)
        seen, actions = np.load(f"{root}/{name}.npz"), []
        batch = {key: torch.from_numpy(value) for key, value in seen.items() if key.startswith("observation")}
        torch.manual_seed(3)
        policy.reset()
        for at in range(len(seen["observation.state"])):
            task = {"task": [str(one) for one in seen["task"]]} if "task" in seen else {}
            with torch.inference_mode():
                given = before({key: value[at] for key, value in batch.items()} | task)
                actions.append(after(policy.select_action(given)).tolist())
        with torch.inference_mode():
            chunk = policy.predict_action_chunk(given)
        answers[place[len(root) + 1 :]] = {"actions": actions, "chunk": list(chunk.shape)}
        for part in (policy, before, after) if times else ():
            part.save_pretrained(f"{root}/{name}-again")
    given.pop("observation.state")
    try:
        policy.select_action(given)
    except ValueError as error:
        answers[name] = str(error)
try:
    policy.forward(given)
except NotImplementedError as error:
    answers["forward"] = str(error)
answers["other"] = main([f"{root}/other", f"{root}/there"])
print(json.dumps(answers))
"""


# The imports take ten seconds: they are made once, and every script runs in a fork of that process.
SERVE = """
import os, traceback
import lerobot.policies.factory
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    for stream in (1, 2):
        os.dup2(os.open(asked["said"][stream - 1], os.O_WRONLY | os.O_CREAT), stream)
    sys.path[:0], sys.argv[1:], root = asked["path"], asked["words"], asked["words"][0]
    code = 1
    try:
        exec(asked["script"])
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)
"""


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    """lerobot(script, root, rows, path) -> what the script printed in the other environment; path is searched for modules first."""
    folder, count = tmp_path_factory.mktemp("said"), itertools.count()
    environment, pipe = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}, subprocess.PIPE
    with subprocess.Popen(
        [str(PYTHON), "-c", HEAD + SERVE], stdin=pipe, stdout=pipe, text=True, env=environment
    ) as server:
        assert server.stdin and server.stdout

        def ran(script: str, root, rows=(), path: tuple[Path, ...] = ()) -> str:
            number = next(count)
            out, err = (folder / f"{number}.{stream}" for stream in ("out", "err"))
            asked = {"script": script, "words": [str(root), json.dumps(list(rows))], "path": [str(one) for one in path]}
            server.stdin.write(json.dumps({**asked, "said": [str(out), str(err)]}) + "\n")
            server.stdin.flush()
            assert server.stdout.readline() == "0\n", err.exists() and err.read_text()[-3000:]
            return out.read_text()

        yield ran
        server.stdin.close()


def test_lerobot_reads_what_was_recorded(recording, lerobot):
    facts = json.loads(lerobot(READ, recording, (0, 29, 30, 44, 99)).splitlines()[-1])
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


def test_what_lerobot_records_opens_here(tmp_path, lerobot):
    lerobot(WRITE, tmp_path / "theirs")
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


def test_a_rig_and_its_conversions_open_in_lerobot(tmp_path, lerobot):
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
        facts = json.loads(lerobot(READ, tmp_path / name, (0, 7, 27, 39)).splitlines()[-1])
        assert (facts["length"], facts["episodes"], facts["fps"]) == (40, 2, 10)
        for at, row in facts["rows"].items():
            place = int(at) % 20
            newest = np.searchsorted(imu, front[place], side="right") - 1
            assert np.allclose(row["observation.imu"], readings["observation.imu"].values[newest])
            assert np.allclose(row["observation.state"], readings["observation.state"].values[place])
            assert row["task"] == ["look", "go"][int(at) // 20] and np.allclose(row["time_s"], front[place])
            assert row["action"] == (place if place < 19 else 0) and row["action_valid"] == (place < 19)
            assert np.abs(np.array(row["observation.images.front"]) - 90).max() <= 2


def test_png_merged_tables_and_statistics_open_in_lerobot(tmp_path, monkeypatch, lerobot):
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
    facts = json.loads(lerobot(READ, tmp_path / "png", (0, 8, 21)).splitlines()[-1])
    assert facts["lengths"] == [4, 5, 6, 7] and facts["length"] == 22
    for at, (take, row) in {0: (0, 0), 8: (1, 4), 21: (3, 6)}.items():
        found = np.array(facts["rows"][str(at)][camera.name])
        assert np.array_equal(found, takes[take].readings[camera.name].values[row])
    every = np.concatenate([take.readings[state.name].values for take in takes]).astype(np.float32)
    assert np.allclose(facts["stats"][state.name], every.mean(0)) and len(facts["stats"][camera.name]) == 3


def test_several_robots_merged_open_in_lerobot(tmp_path, recording, lerobot):
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
    facts = json.loads(lerobot(READ, tmp_path / "all", (0, 104)).splitlines()[-1])
    assert facts["length"] == 109 and facts["episodes"] == 5 and facts["rows"]["104"]["task"] == "grasp"
    width = len(facts["rows"]["0"]["action"])
    assert facts["rows"]["104"]["action"] == [0.0] * (width - 1) + [0.5]
    assert facts["rows"]["104"]["action_mask"] == [False] * (width - 1) + [True]
    assert facts["rows"]["0"]["embodiment"] != facts["rows"]["104"]["embodiment"]


def _reach():
    return terrella.load(REACH)


@pytest.fixture(scope="module")
def policies(tmp_path_factory, lerobot):
    """Tiny untrained policies of LeRobot: ACT, ACT with a temporal ensemble, and diffusion."""
    root = tmp_path_factory.mktemp("policies")
    lerobot(POLICIES, root)
    return root


def test_policies_of_lerobot_act_as_they_do_there(policies, capsys, tmp_path, lerobot):
    world, steps, seen = _reach(), 9, {}
    state = world.start(1, make_rng(0))
    for _ in range(steps):  # the same episode for all, under random actions
        for name, value in world.render(state, ("rgb", "state")).items():
            seen.setdefault(name, []).append(value)
        state = world.imagine(state, world.spec.sample_action(1, make_rng(len(seen["rgb"]))), make_rng(0))
    rng = make_rng(7)
    seeds = [chance.seeds(1, rng).item() for _ in range(steps)]
    np.savez(policies / "seen.npz", seeds=seeds, **{name: torch.cat(value).numpy() for name, value in seen.items()})
    kinds = ("act", "ensemble", "diffusion")
    theirs = json.loads(lerobot(ACT, policies, kinds).splitlines()[-1])
    for kind in kinds:
        policy, rng = terrella.load_policy(policies / kind, world.spec), make_rng(7)
        memory, actions = policy.begin(1, rng), []
        for at in range(steps):
            action, memory = policy.act({name: value[at] for name, value in seen.items()}, memory, rng)
            actions.append(action[0].numpy())
        assert np.abs(np.array(actions) - np.clip(theirs[kind], -1, 1)).max() < 1e-5
        assert np.ptp(actions, 0).min() > 1e-4 and np.abs(theirs[kind]).min() < 1, "or nothing was compared"
    words = ["evaluate", *(str(policies / kind) for kind in kinds), "idle", "--in", REACH, "--real", REACH]
    assert main([*words, "--episodes", "4", "--out", str(tmp_path), "--json"]) == 0
    evaluated = json.loads(capsys.readouterr().out)
    assert "ranks these 4 policies as reality does" in evaluated["verdict"][0]
    for kind in ("act", "diffusion"):
        assert evaluated["rows"][kind]["real"] == evaluated["rows"][kind]["dream"] != evaluated["rows"]["idle"]["real"]


def test_a_policy_that_lerobot_trained_on_our_recording_acts_here(tmp_path, capsys, lerobot):
    recording, trained = tmp_path / "recording", tmp_path / "trained"
    assert main(["record", "world", REACH, "--frames", "60", "--out", str(recording)]) == 0
    facts = json.loads(lerobot(TRAIN, recording, (str(trained),)).splitlines()[-1])
    assert {"observation.images.rgb", "observation.state"} <= set(facts["inputs"]) and np.isfinite(facts["loss"])
    capsys.readouterr()
    words = ["evaluate", str(trained), "--in", REACH, "--episodes", "2", "--out", str(tmp_path / "out")]
    assert main(words) == 0 and "In the dream the best of 1 is trained" in capsys.readouterr().out


def test_a_policy_of_lerobot_with_statistics_of_another_is_refused(policies):
    post = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
    whole = (policies / "act" / post).read_bytes()
    stats = load(whole)
    (policies / "act" / post).write_bytes(save({**stats, "action.std": 2 * stats["action.std"]}))
    try:
        with pytest.raises(CheckpointError, match="the statistics of actions differ"):
            terrella.load_policy(policies / "act", _reach().spec)
    finally:
        (policies / "act" / post).write_bytes(whole)


PICTURE, TWO = spaces.Box(0, 255, (32, 32, 3), np.uint8), spaces.Box(-1, 1, (2,), np.float32)
ARM = Spec("arm", spaces.Box(-1, 1, (2,), np.float32), {"rgb": PICTURE, "rgb.wrist": PICTURE, "state": TWO}, (), 0.1)
GRID = Spec(
    "grid",
    spaces.Discrete(3, start=1),
    {"grid": spaces.Box(0, 9, (5, 5, 2), np.uint8), "observation": spaces.Box(-9, 9, (3,), np.float32), "text": TEXT},
    (),
    0.1,
)


def _imitator(folder, spec: Spec, **settings) -> ImitationActor:
    torch.manual_seed(0)
    config = ActorConfig.of(spec, tuple(name for name in spec.channels if name != "text"), 16)
    network = ImitationNetwork(ImitationConfig(config, size=(32, 32), **settings))
    for weights in network.parameters():  # the last layers begin near 0
        weights.data += 0.1 * torch.randn_like(weights)
    ImitationActor.write(network, folder, {})
    return terrella.load_policy(folder, spec)


def test_our_policies_act_in_lerobot_as_they_do_here(tmp_path, lerobot):
    _imitator(tmp_path / "arm", ARM, chunk=4, execute=3, own_actions=True)
    _imitator(tmp_path / "grid", GRID, chunk=2, remember=4, vocabulary=("blue", "go", "red", "to"))
    Actor(ActorNetwork(ActorConfig.of(ARM, ("state",), 8)), ARM).save(tmp_path / "other")
    here, rng, texts = {}, np.random.default_rng(0), ["go to red", "go to blue"]
    for name, spec in (("arm", ARM), ("grid", GRID)):
        seen = {
            channel: rng.integers(0, 9, (8, 2, *space.shape)).astype(space.dtype)
            for channel, space in spec.channels.items()
            if channel != "text"
        }
        there = {channel: value for channel, value in seen.items() if not channel.startswith("rgb")}
        there = {features_of([channel])[channel]: value for channel, value in there.items()}
        there["observation.state"] = there.pop("observation", there.get("observation.state"))
        for channel in ("rgb", "rgb.wrist") if name == "arm" else ():
            pictures = seen[channel].transpose(0, 1, 4, 2, 3).astype(np.float32) / 255
            there[features_of([channel])[channel]] = pictures
        np.savez(tmp_path / f"{name}.npz", **there, **({"task": texts} if name == "grid" else {}))
        policy, generator, actions = terrella.load_policy(tmp_path / name, spec), make_rng(3), []
        memory = policy.begin(2, generator)
        words = {"text": torch.from_numpy(np.stack([text_to_bytes(text) for text in texts]))} if name == "grid" else {}
        for at in range(8):
            given = {channel: torch.from_numpy(value[at]) for channel, value in seen.items()}
            action, memory = policy.act({**given, **words}, memory, generator)
            actions.append(action.float().reshape(2, -1).tolist())
        here[name] = np.array(actions)
    (tmp_path / "site/lerobot_policy_terrella-0.1.0.dist-info").mkdir(parents=True)
    (tmp_path / "site/lerobot_policy_terrella-0.1.0.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_policy_terrella\nVersion: 0.1.0\n"
    )
    path = (ROOT / "src", ROOT / "plugins/lerobot_policy_terrella/src", tmp_path / "site")
    answers = json.loads(lerobot(OURS, tmp_path, ("arm", "grid"), path).splitlines()[-1])
    for name, chunk in (("arm", [2, 4, 2]), ("grid", [2, 2, 1])):
        for place in ("there", "again"):
            answer = answers[f"{name}-{place}"]
            assert np.abs(np.array(answer["actions"]) - here[name]).max() < 1e-5 and answer["chunk"] == chunk
        assert np.ptp(here[name], 0).max() > 0.1, "or nothing was compared"
        assert "the policy sees observation.state, which the batch lacks; it holds " in answers[name]
    assert "terrella train policy --method imitation" in answers["forward"]
    assert "expected kind 'imitation'" in answers["other"]
