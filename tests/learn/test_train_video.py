"""Training on a small made-up place: exact resume, honest failures, a world that loads and plays."""

from __future__ import annotations

import json
from dataclasses import replace

import fsspec
import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file
from tests.learn.small import BARE, FLAT, POSED
from tests.learn.stopping import quiet, resumes_exactly, same_run

from terrella.core import Spec, check_world, make_rng
from terrella.core.errors import CheckpointError, DatasetError, TrainingError
from terrella.core.spec import Camera
from terrella.data import ClipCache, Dataset, Layout, Recorder
from terrella.learn import moves
from terrella.learn.batches import Batch, augmented
from terrella.learn.feeds import clips_of
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_flat import FLOW_ROLLOUT
from terrella.learn.recording import Recording, choose_keyframes, usable_rows
from terrella.space.keyframes import Glimpse
from terrella.worlds.checkpoint import data_file
from terrella.worlds.config import VideoConfig
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.generator import Conditioning, context_thumbnail

from ..data.layouts import layout_of


def test_a_trained_world_keeps_the_contract_with_memory_and_without(posed_run):
    out, facts = posed_run
    assert facts["step"] == 4
    for memory in (True, False):
        world = load_world(out / "world", memory=memory)
        assert (
            (len(world.memory) > 0) == memory and world.estimator is not None and "uncertainty" in world.spec.channels
        )
        assert "observes" in check_world(world)
    assert list(out.glob("strip-*.png"))


def test_a_stopped_run_goes_on_exactly(corridor, bare_run, tmp_path):
    resumes_exactly(lambda out: train_video(corridor, out, BARE, quiet), bare_run[0], tmp_path, {"flow": 1})


@pytest.mark.slow
def test_a_stopped_run_without_geometry_goes_on_exactly(corridor, flat_run, tmp_path):
    resumes_exactly(lambda out: train_video(corridor, out, FLAT, quiet), flat_run[0], tmp_path, {"flow": 0})


@pytest.mark.slow
def test_a_run_that_is_stopped_in_each_of_its_stages_goes_on_exactly(corridor, posed_run, flat_run, tmp_path):
    stages = {"motion": 7, "estimator": 1, "flow": 0, "uncertainty": 3}
    resumes_exactly(lambda out: train_video(corridor, out, POSED, quiet), posed_run[0], tmp_path / "posed", stages)
    worlds = [load_file(data_file(run / "world", "weights")) for run in (posed_run[0], tmp_path / "posed")]
    assert all(torch.allclose(worlds[0][name].float(), worlds[1][name].float(), atol=1e-4) for name in worlds[0])
    stages = {"outcome": 1, "flow": 0}
    resumes_exactly(lambda out: train_video(corridor, out, FLAT, quiet), flat_run[0], tmp_path / "flat", stages)


def test_a_training_that_fails_leaves_no_folder(corridor, tmp_path):
    with pytest.raises(TrainingError, match="multiples of 8"):
        train_video(corridor, tmp_path / "run", replace(BARE, size=(20, 30)), quiet)
    with pytest.raises(DatasetError, match="leaves 0 frames"):
        train_video(corridor, tmp_path / "run", replace(BARE, keep_out=(-99, -99, 99, 99)), quiet)
    with pytest.raises(TrainingError, match="--device tpu: PyTorch has no such device here"):
        train_video(corridor, tmp_path / "run", replace(BARE, device="tpu"), quiet)
    assert not (tmp_path / "run").exists()


def test_a_run_with_other_settings_is_refused(corridor, posed_run):
    with pytest.raises(TrainingError, match=r"other settings \(keyframes \d+, not 7"):
        train_video(corridor, posed_run[0], replace(POSED, keyframes=7), quiet)


def test_training_ends_after_its_hours_and_says_where(corridor, tmp_path):
    facts = train_video(corridor, tmp_path, replace(BARE, hours=1e-9), quiet)
    assert facts["step"] == 1 and facts["step"] < BARE.steps
    assert json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1])["step"] == 1


def test_a_recording_without_depth_is_learned_from_history_alone(tmp_path, monkeypatch):
    with Recorder(tmp_path / "set", layout_of(10.0, ("left",), rgb=(24, 32))) as recorder:
        for _ in range(3):
            for step in range(60):
                picture = np.full((24, 32, 3), 40 + step, np.uint8)
                recorder.add({"rgb": picture}, np.array([step % 2]) if step < 59 else None, 0.5, False)
            recorder.end_episode()
    facts = train_video(tmp_path / "set", tmp_path / "run", BARE, quiet)
    world = load_world(tmp_path / "run" / "world")
    steps = json.loads((tmp_path / "run" / "log.jsonl").read_text().splitlines()[-1])["step"]
    whole = -(-BARE.steps // FLOW_ROLLOUT) * FLOW_ROLLOUT
    assert facts["step"] == steps == world.spec.card["steps"] == whole, (
        "each loss that is descended is a step, everywhere"
    )
    assert (tmp_path / "run" / f"strip-{steps:06d}.png").exists()
    monkeypatch.delattr(moves, "frequent_moves")  # what was found is not searched again
    assert train_video(tmp_path / "set", tmp_path / "run", BARE, quiet)["step"] == steps
    assert set(world.spec.channels) == {"rgb", "reward", "done"}
    assert "batches" in check_world(world)
    rng = make_rng(0)
    state = world.start(1, rng)
    still, left = (world.imagine(state, torch.tensor([[held]], dtype=torch.int8), make_rng(1)) for held in (0, 1))
    assert not torch.equal(still["actions"], left["actions"])
    with pytest.raises(DatasetError, match="without depth and poses"):
        train_video(tmp_path / "set", tmp_path / "other", replace(BARE, keep_out=(0, 0, 1, 1)), quiet)


def test_rows_in_the_box_are_kept_out(corridor):
    cache = ClipCache.open(Dataset(corridor), (24, 32))
    every = list(range(len(cache.episodes)))
    free = usable_rows(cache, every, None, (0.5, 0.8, 0.5, 0.5))
    assert free.all()
    x = np.median(cache.pose[:, 0])
    kept = usable_rows(cache, every, (x, -99, 99, 99), (0.5, 0.8, 0.5, 0.5))
    assert kept.sum() < free.sum()
    assert (cache.pose[kept][:, 0] <= x).all()


def test_keyframes_cover_the_recording_evenly():
    corners = np.array([[0, 0], [9, 0], [0, 9], [9, 9]], np.float32)
    place = np.concatenate([np.repeat(corners[:1], 50, 0), corners])
    pose = np.concatenate([place, np.zeros((54, 1)), np.tile([1, 0, 0, 0], (54, 1))], 1).astype(np.float32)
    picks = choose_keyframes(pose, np.arange(54), 4)
    assert {tuple(p) for p in place[picks]} == {tuple(c) for c in corners}


def test_checkpoints_of_another_kind_or_version_are_refused(posed_run, tmp_path):
    with pytest.raises(CheckpointError, match="world.json"):
        load_world(tmp_path)
    source = posed_run[0] / "world"
    for change, words in (({"kind": "latent"}, "kind"), ({"version": 99}, "version")):
        folder = tmp_path / words
        folder.mkdir()
        about = json.loads((source / "world.json").read_text()) | change
        (folder / "world.json").write_text(json.dumps(about))
        with pytest.raises(CheckpointError, match=words):
            load_world(folder)
    broken = tmp_path / "broken"
    broken.mkdir()
    for file in source.iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    weights = data_file(source, "weights").read_bytes()
    data_file(broken, "weights").write_bytes(weights[: len(weights) // 2])
    with pytest.raises(CheckpointError, match="damaged"):
        load_world(broken)


def test_a_world_without_memory_can_be_saved_and_loaded(posed_run, tmp_path):
    world = load_world(posed_run[0] / "world")
    save_world(world.without_memory(), tmp_path / "bare")
    bare = load_world(tmp_path / "bare")
    assert len(bare.memory) == 0 and len(bare.starts.pose) == len(world.starts.pose)  # pyright: ignore
    assert bare.start(1, make_rng(0))["rgb"].shape == (1, 3, 24, 32)


@pytest.mark.parametrize("posed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_axes_are_learned_from_pictures_and_beside_poses(posed, tmp_path):
    layout = layout_of(10.0, ("steer",), rgb=(24, 32), depth=(24, 32) if posed else None, pose=posed)
    layout = replace(layout, world={"camera": [0.5, 0.8, 0.5, 0.5]} if posed else {})
    with Recorder(tmp_path / "set", layout) as recorder:
        for _ in range(2):
            for step in range(80):
                seen = {"rgb": np.full((24, 32, 3), 40 + step, np.uint8)}
                if posed:
                    half = 0.02 * step
                    pose = np.array([0.05 * step, 0, 0, np.cos(half), 0, 0, np.sin(half)], np.float32)
                    seen |= {"depth": np.full((24, 32), 3.0), "pose": pose}
                recorder.add(seen, np.array([0.37 - step / 50]) if step < 79 else None, 0.0, False)
            recorder.end_episode()
    train_video(tmp_path / "set", tmp_path / "run", BARE, quiet)
    world = load_world(tmp_path / "run" / "world")
    space = world.spec.action
    assert isinstance(space, spaces.Box) and space.low[0] < -1 and space.high[0] == np.float32(0.37)
    assert ("pose" in world.spec.channels) == posed
    assert "batches" in check_world(world)


@pytest.fixture(params=["file", "memory"])
def far(request, corridor, tmp_path, monkeypatch):
    """The address of the same recording elsewhere."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if request.param == "file":
        return f"file://{corridor}"
    address = f"memory://{tmp_path.name}"
    fsspec.filesystem("memory").put(str(corridor), address, recursive=True)
    return address


def test_a_recording_far_away_gives_training_what_a_near_one_does(far, corridor):
    """All rows, what may be trained on, and clips in their order; the rest of a run is seeded."""
    near, other = (
        Recording.open(source, (24, 32), quiet, needs=("rgb", "action", "depth")) for source in (corridor, far)
    )
    assert near.controls == other.controls and near.held_out == other.held_out and near.seen == other.seen
    assert np.array_equal(near.usable, other.usable) and np.array_equal(near.start, other.start)
    assert near.cache.world == other.cache.world and near.cache.arrays.keys() == other.cache.arrays.keys()
    for name, array in near.cache.arrays.items():
        assert np.array_equal(np.asarray(array), np.asarray(other.cache.arrays[name])), name
    rows = np.arange(0, near.cache.length, 7)
    assert np.array_equal(near.dataset.rgb_at(rows), other.dataset.rgb_at(rows)), "pictures at their full size"
    clips = [clips_of(one, 5, 4, VideoConfig((1, 1, 0.5, 0.5), 6, (24, 32)), 0).forever() for one in (near, other)]
    for _ in range(6):
        one, two = map(next, clips)
        assert one.keys() == two.keys() and all(np.array_equal(one[name], two[name]) for name in one)


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [True, False])
def test_a_recording_far_away_is_learned_like_a_near_one(geometry, far, corridor, tmp_path):
    config = replace(BARE, geometry=geometry, steps=2, outcome_steps=2, motion_steps=3)
    for source, run in ((corridor, "near"), (far, "far")):
        train_video(source, tmp_path / run, config, quiet)
    same_run(tmp_path / "near", tmp_path / "far", "flow")


def test_of_two_cameras_the_main_one_is_learned_and_the_other_named_as_ignored(tmp_path):
    sizes = {"rgb": (24, 32), "rgb.wrist": (18, 24)}  # of equal size they would be learned side by side
    channels = {name: spaces.Box(0, 255, (*size, 3), np.uint8) for name, size in sizes.items()}
    views = {name: Camera((0.5, 0.8, 0.5, 0.5), size) for name, size in sizes.items()}
    pose = spaces.Box(-np.inf, np.inf, (7,), np.float32)
    arm = spaces.Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32))
    spec = Spec("arm", arm, {**channels, "pose": pose}, (), 0.1, cameras=views, action_names=("reach", "turn"))
    with Recorder(tmp_path / "set", Layout.of(spec)) as recorder:
        for _ in range(2):
            for step in range(90):
                seen: dict = {name: np.full((*size, 3), 40 + step, np.uint8) for name, size in sizes.items()}
                seen["pose"] = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
                recorder.add(seen, np.array([step / 90, -step / 90], np.float32) if step < 89 else None, 0.0, False)
            recorder.end_episode()
    train_video(tmp_path / "set", tmp_path / "run", BARE, quiet)
    world = load_world(tmp_path / "run" / "world")
    assert "wrist" in str(world.spec.card["ignored channels"]) and world.spec.action_names == ("reach", "turn")
    assert isinstance(world.spec.action, spaces.Box) and world.spec.action.high.tolist() == [1, 2]


def test_a_varied_batch_is_the_same_batch_in_another_world():
    """Where memory holds the truth itself it still does, mirrored and in other colours."""
    rng = make_rng(0)
    truth = torch.rand(2, 4, 16, 24, generator=rng)
    glimpse = Glimpse(truth[:, None, :3], torch.ones(2, 1, 16, 24), truth[:, 3], torch.ones(2, 16, 24))
    pixels = (truth[:, :3] * 255).to(torch.uint8)
    changed = set()
    for seed in range(12):
        shown = Conditioning(glimpse, truth, context_thumbnail(pixels))
        batch = augmented(Batch(shown, truth), np.random.default_rng(seed))
        seen, last, context = batch.shown.glimpse, batch.shown.last, batch.shown.context
        assert torch.equal(seen.rgb[:, 0], batch.truth[:, :3]) and torch.equal(last, batch.truth)
        assert torch.equal(seen.depth, batch.truth[:, 3])
        assert torch.allclose(context_thumbnail((batch.truth[:, :3] * 255).to(torch.uint8)), context, atol=1e-5)
        changed.add(not torch.equal(batch.truth, truth))
    assert changed == {True, False}
