"""Every channel of any world is recorded and comes back, or is refused by name; what the world is comes back with it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from layouts import layout_of
from two_cameras import MOUNT, WRIST, TwoCameras

from terrella.care import doctor
from terrella.core import Camera, Spec, check_world, make_rng
from terrella.core.errors import DatasetError
from terrella.core.policy import Replay
from terrella.data import ClipCache, Clips, ClipsConfig, Dataset, Layout, Recorder, RecordOptions, check_game, record
from terrella.data.channels import channel_of, feature_of, features_of

STEPS = 7


def recorded(root, pictures="png", world=None) -> Dataset:
    world = world or TwoCameras()
    actions = torch.linspace(-1, 1, 2 * STEPS).reshape(STEPS, 1, 2)
    record(
        world,
        Replay(actions),
        root,
        STEPS + 1,
        make_rng(0),
        options=RecordOptions(task="lift the red cup", pictures=pictures),
    )
    return Dataset(root)


def test_a_world_of_two_cameras_and_axes_keeps_the_contract():
    check_world(TwoCameras())


def test_every_channel_comes_back_as_it_was_shown(tmp_path):
    world, dataset = TwoCameras(), recorded(tmp_path / "recording")
    names = [name for name in world.spec.channels if name not in ("reward", "done")]
    found = dataset.episode(0, [*names, "action"])
    for name in names:
        truth = [world.truth(name, 0, (0, 0))] + [world.truth(name, i + 1, found["action"][i]) for i in range(STEPS)]
        expected = np.stack(truth).reshape(found[name].shape)
        assert found[name].dtype == expected.dtype, name
        np.testing.assert_allclose(found[name], expected, atol=6e-4 if "depth" in name else 0, err_msg=name)
    assert doctor(tmp_path / "recording") == []


def test_names_are_kept_for_the_main_camera_and_go_back_to_their_channels(tmp_path):
    dataset = recorded(tmp_path / "recording")
    assert {"observation.images.rgb", "observation.images.wrist", "observation.depth.wrist"} <= set(dataset.features)
    assert "observation" in dataset.features and "observation.observation" not in dataset.features
    assert dataset.features["observation.pose"]["shape"] == [7]  # since `state` is a channel of its own
    assert set(TwoCameras().spec.channels) | {"action"} == set(dataset.channels)
    assert layout_of(10, ("go",), rgb=(8, 8), depth=(4, 4), pose=True).sensors.keys() >= {
        "observation.images.rgb",
        "observation.depth",
        "observation.state",
    }


NAME = st.from_regex(r"\A[a-z][a-z_]{0,8}(\.[a-z]{1,6})?\Z")


@given(st.lists(NAME, unique=True, max_size=8))
def test_names_are_reversible_or_refused(channels):
    try:
        features = features_of(channels)
    except DatasetError as error:
        assert "rename one" in str(error)
        return
    assert len(set(features.values())) == len(channels)
    names = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    for channel, feature in features.items():
        back = channel_of(feature, names if channel == "pose" else ())
        assert channel in (back, "cast", "state") or {channel, back} == {"rgb.rgb", "rgb"}, (channel, feature, back)


def test_what_the_world_is_comes_back(tmp_path):
    dataset = recorded(tmp_path / "recording")
    spec = TwoCameras().spec
    assert dataset.camera_models == dict(spec.cameras)
    assert dataset.camera_models["rgb.wrist"] == Camera((0.7, 0.9, 0.5, 0.4), WRIST, "pose.wrist", MOUNT)
    assert dataset.world["action_names"] == ["lift", "turn"] and dataset.world["action_units"] == ["m", "rad"]
    assert dataset.world["action_mode"] == "position" and dataset.world["action_frame"] == "tool"
    assert dataset.world["action_low"] == [-1, -1] and dataset.world["action_high"] == [1, 1]
    assert dataset.sensors["action"].units == {"lift": "m", "turn": "rad"}
    assert dataset.sensors["observation.state"].units == {f"state_{i}": "rad" for i in range(3)}


def test_an_old_recording_of_one_camera_still_has_it(recording):
    path = recording / "meta/terrella.json"
    about = json.loads(path.read_text())
    about["world"].pop("cameras")
    path.write_text(json.dumps({key: value for key, value in about.items() if key != "channels"}))
    dataset = Dataset(recording)
    assert dataset.camera_models == {"rgb": Camera((0.5, 0.8, 0.5, 0.5), (48, 64))}
    assert dataset.channels["pose"] == "observation.state" and dataset.has("pose")


def test_old_recordings_of_objects_are_read_by_their_name_of_now(tmp_path):
    layout = layout_of(10, ("go",), rgb=(8, 8), pose=True, arrays={"cast": ((2, 4), "float32")})
    with Recorder(tmp_path / "recording", layout) as recorder:
        for i in range(6):
            seen = {"rgb": np.zeros((8, 8, 3), np.uint8), "pose": np.arange(7), "cast": np.full((2, 4), i)}
            recorder.add_row({layout.channels.get(n, feature_of(n)): v for n, v in seen.items()} | {"action": [1.0]})
    dataset = Dataset(tmp_path / "recording")
    for name in ("objects", "observation.objects", "observation.cast"):
        assert dataset.episode(0, [name])[name][5].max() == 5
    assert np.array_equal(ClipCache.open(dataset, (8, 8)).further["objects"][:, 0, 0], np.arange(6))
    assert next(iter(Clips(dataset, ClipsConfig(2, ("objects",), 2, (8, 8)))))["objects"].shape == (2, 2, 2, 4)


@pytest.mark.parametrize(
    ("name", "space", "words"),
    [
        ("rgb_wrist", spaces.Box(0, 255, (8, 8, 3), np.uint8), None),
        ("rgb.left", spaces.Box(0, 1, (8, 8, 3), np.float32), "rgb.left.*uint8"),
        ("rgb.rgb", spaces.Box(0, 255, (8, 8, 3), np.uint8), "'rgb' and 'rgb.rgb' would both"),
        ("STATE", spaces.Box(0, 1, (3,), np.float32), "'state' and 'STATE' would both"),
        ("deep", spaces.Box(0, 1, (1, 2, 1, 2, 1, 2), np.float32), "'deep'.*1 to 5 axes"),
        ("none", spaces.Box(0, 1, (0,), np.float32), "'none'.*none of them empty"),
        ("both", spaces.Dict({"a": spaces.Discrete(2)}), "'both'.*not one array"),
    ],
)
def test_what_cannot_be_recorded_is_refused_by_its_name(name, space, words):
    spec = TwoCameras(**{name: space}).spec
    if words is None:  # an array of three axes is kept as it is
        assert Layout.of(spec).sensors["observation.rgb_wrist"].shape == (8, 8, 3)
        return
    with pytest.raises(DatasetError, match=words):
        Layout.of(spec)


def test_a_channel_without_a_place_is_an_error_and_not_left_out(tmp_path):
    layout = layout_of(10, ("go",), pose=True)
    with Recorder(tmp_path / "recording", layout) as recorder:
        with pytest.raises(DatasetError, match=r"no place for 'observation\.heat'"):
            recorder.add({"pose": np.arange(7), "heat": np.ones(1)}, [0.0])


def test_a_mount_on_no_pose_does_not_break_the_recording(tmp_path):
    spec = TwoCameras().spec
    cameras = {**spec.cameras, "rgb.wrist": Camera((1, 1, 0.5, 0.5), WRIST, "pose.elbow")}
    layout = Layout.of(Spec(spec.name, spec.action, spec.channels, (), 0.1, cameras=cameras))
    assert layout.world["cameras"]["rgb.wrist"]["pose"] == "pose.elbow"  # pyright: ignore


def test_clips_of_any_channel(tmp_path):
    dataset = recorded(tmp_path / "recording", "video")
    channels = (
        "rgb",
        "rgb.wrist",
        "depth.wrist",
        "pose.wrist",
        "state",
        "voxels",
        "instruction",
        "action",
        "observation",
    )
    batch = next(iter(Clips(dataset, ClipsConfig(3, channels, 2, (8, 16), shuffle=False))))
    assert batch["rgb.wrist"].shape == (2, 3, 8, 16, 3) and batch["depth.wrist"].shape == (2, 3, 4, 6)
    assert batch["voxels"].shape == (2, 3, 2, 3, 4, 2) and batch["state"].shape == (2, 3, 3)
    assert batch["instruction"].shape == (2, 3, 5)  # the recorded channel, not the embedding of the task
    assert set(ClipCache.open(dataset, (8, 16)).vitals) == {"count"}


NO_TORCH = """
import sys
from dataclasses import replace
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ImportError("torch is not here")
sys.meta_path.insert(0, Block())
import terrella.data, terrella.exchange, terrella.care
from terrella.care import doctor, repair
from terrella.data import Clips, ClipsConfig, Dataset
from terrella.exchange.convert import open_source, write_source
root, out = sys.argv[1:]
assert Dataset(root).episode(0)["rgb"].shape[0] == 30
assert doctor(root) == []
write_source(open_source(root), out + "/converted", "mcap")
write_source(open_source(out + "/converted"), out + "/back")
assert len(Dataset(out + "/back").episodes) == 4
next(iter(Clips(root, ClipsConfig(4, ("rgb", "action", "instruction"), 2, (12, 16)))))
try:
    terrella.data.record
except ImportError as error:
    assert "torch" in str(error)
assert "torch" not in sys.modules
"""


def test_recordings_are_read_examined_converted_and_cut_into_clips_without_torch(recording, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", NO_TORCH, recording, tmp_path], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize(
    ("recorded", "why"),
    [
        ((spaces.Discrete(6), ("observation",)), "holds no pictures, which learned observes"),
        ((spaces.Discrete(5), ("rgb",)), r"actions in Discrete\(5\), which are not those of learned \(Discrete\(6\)\)"),
        ((spaces.MultiBinary(6), ("rgb",)), r"action_0, .*action_5, which are not those of learned \(Discrete\(6\)\)"),
        ((spaces.Discrete(6), ("rgb",), tuple("uvwxyz")), r"actions u, v, .* not those of learned \(a, b, c"),
        ((spaces.Discrete(6), ("rgb",), tuple("abcdef")), ""),
        ((spaces.Discrete(6), ("rgb",)), ""),
    ],
)
def test_a_recording_of_another_game_is_known_by_what_it_says_of_itself(recorded, why, tmp_path):
    shown = {"rgb": spaces.Box(0, 255, (8, 8, 3), np.uint8), "observation": spaces.Box(-1, 1, (2,), np.float32)}
    space, channels, names = (*recorded, ())[:3]
    spec = Spec("game", space, {name: shown[name] for name in channels}, (), 0.1, action_names=names)
    learned = Spec("learned", spaces.Discrete(6), shown, ("rgb",), 0.1, action_names=tuple("abcdef"))
    with Recorder(tmp_path, replace(Layout.of(spec), pictures="png")) as recorder:
        for action in (space.sample(), None):
            recorder.add({name: np.zeros(shown[name].shape, shown[name].dtype) for name in channels}, action)
    if why:
        with pytest.raises(DatasetError, match=f"{why}.*recordings of its own game"):
            check_game(Dataset(tmp_path), learned)
    else:
        assert check_game(Dataset(tmp_path), learned) == ""
        other = replace(learned, card={"game": "chess"})
        assert "is of game; learned learned chess" in check_game(Dataset(tmp_path), other)
        slower = replace(learned, dt_s=0.2)
        assert "has 10 steps a second; learned learned 5." in check_game(Dataset(tmp_path), slower)
