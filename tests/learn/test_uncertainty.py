"""Senses: an eye that learns from a small made-up place, and a doubt that learns which errors to expect."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tests.learn.small import POSED
from tests.learn.stopping import goes_on_exactly, quiet, resumes_exactly
from tests.space.rooms import CAMERA, painted, pose_at, room_depth

from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, ObservationError
from terrella.data import ClipCache, Dataset, Recorder, split
from terrella.learn.calibration import pool_adjacent_violators
from terrella.learn.objectives import uncertainty as uncertainty_module
from terrella.learn.objectives.estimator import learn_estimator, recoloured, relative_motion
from terrella.learn.objectives.uncertainty import (
    ARMS,
    DreamFrames,
    DreamSettings,
    calibrate,
    dream,
    expected_error,
    fit_uncertainty,
)
from terrella.learn.recipes import video
from terrella.learn.recipes.parts import EstimatorTraining, SensesConfig, train_estimator, train_uncertainty
from terrella.learn.recipes.video import train_video
from terrella.learn.recording import Recording
from terrella.learn.trainer import Run, Trainer
from terrella.space.camera import planar_pose
from terrella.space.estimator import load_estimator
from terrella.worlds.checkpoint import data_file
from terrella.worlds.folder import load_world
from terrella.worlds.uncertainty import INPUT_MAPS, KNOTS, SITUATION

from ..data.layouts import layout_of


@pytest.fixture(scope="module")
def bare(bare_run):
    return bare_run[0] / "world"


def test_an_estimator_learns(tmp_path):
    """The room of the geometry tests, from 70 places: where its colours are, so is its depth."""
    places = torch.rand(70, 3, generator=make_rng(0)) * torch.tensor([5.0, 5.0, 6.28]) - torch.tensor([2.5, 2.5, 0.0])
    pose = torch.cat([pose_at(*place) for place in places.tolist()])
    depth = room_depth(pose)
    rgb = painted(pose, depth).permute(0, 2, 3, 1).contiguous()
    parts = {"rgb": rgb.numpy(), "depth": depth.numpy(), "pose": pose.numpy(), "world": {"camera": CAMERA}}
    room = Recording(SimpleNamespace(**parts), np.zeros(70, np.int64), np.ones(70, bool))  # pyright: ignore
    off = []
    for steps in (1, 60):
        estimator = learn_estimator(Run(tmp_path / str(steps), {}, quiet), room, steps, batch=6)
        off.append(float((estimator.depth(room.rgb(np.arange(70))).log() - depth.log()).abs().mean()))
        assert estimator.config.near_m < depth.min() and estimator.config.far_m > 0.9 * depth.max()
    assert off[1] < 0.8 * off[0], off


@pytest.mark.exact
def test_a_stopped_run_goes_on_exactly(corridor, tmp_path):
    def train(out):
        facts = train_estimator(corridor, out, EstimatorTraining((16, 32), 3, 2), quiet)
        assert load_estimator(facts["estimator"]) and facts["recorded"]["frames"]

    goes_on_exactly(train, tmp_path / "a", tmp_path / "b", {"estimator": 1})


def test_motion_is_in_the_frame_of_the_first_pose():
    zero, height = torch.zeros(1), torch.ones(1)
    before = planar_pose(height, height, height, torch.tensor([torch.pi / 2]))
    after = planar_pose(height - 0.5, height + 2.0, height, torch.tensor([torch.pi / 2 + 0.1]))
    assert torch.allclose(relative_motion(before, after), torch.tensor([[2.0, 0.5, 0.1]]), atol=1e-5)
    assert torch.allclose(relative_motion(before, before), torch.cat([zero, zero, zero])[None])


def test_pictures_are_recoloured_now_and_then():
    pictures = torch.rand(3, 3, 8, 8, generator=make_rng(0))
    changed = 0
    for seed in range(12):
        other = recoloured(pictures, np.random.default_rng(seed))
        assert other.shape == pictures.shape and 0 <= other.min() and other.max() <= 1
        changed += not torch.equal(other, pictures)
    assert 2 < changed < 10


def test_a_recording_without_poses_is_refused(tmp_path):
    with Recorder(tmp_path / "set", layout_of(10.0, ("left",), rgb=(24, 32))) as recorder:
        for step in range(60):
            recorder.add({"rgb": np.full((24, 32, 3), step, np.uint8)}, np.array([step % 2]), 0.0, False)
    with pytest.raises(DatasetError, match="holds no depth"):
        train_estimator(tmp_path / "set", tmp_path / "out", EstimatorTraining(steps=2), quiet)


@pytest.fixture(scope="module")
def sensing(corridor, bare, tmp_path_factory):
    out = tmp_path_factory.mktemp("sensing")
    return out / "world", train_uncertainty(bare, corridor, out, SensesConfig(2, 60), quiet)


def test_a_world_is_given_an_estimator_and_an_uncertainty(bare, sensing):
    world = load_world(bare)
    picture = world.render(world.start(1, make_rng(0)), ("rgb",))["rgb"]
    with pytest.raises(ObservationError, match="train uncertainty"):
        world.observe({"rgb": picture}, None, make_rng(0))
    out, facts = sensing
    assert facts["uncertainty"]["invents"] > facts["uncertainty"]["sure"] > 0
    world = load_world(out)
    assert "observes" in check_world(world) and world.spec.card["uncertainty"] == facts["uncertainty"]
    state = world.observe({"rgb": picture}, None, make_rng(0))
    assert torch.equal(world.render(state, ("rgb",))["rgb"], picture)
    gone = world.imagine(state, world.spec.sample_action(1, make_rng(0)), make_rng(0))
    assert float(gone["uncertainty"]) > 0 and float(gone["gone"][0, 0]) == 1
    assert not list(out.glob("*.partial"))
    assert data_file(out, "memory").read_bytes() == data_file(bare, "memory").read_bytes()


def test_a_foreign_picture_begins_in_an_empty_corner(sensing):
    world = load_world(sensing[0])
    noise = torch.randint(0, 256, (2, 24, 32, 3), generator=make_rng(0), dtype=torch.uint8)
    state = world.observe({"rgb": noise}, None, make_rng(0))
    assert float(state["pose"][:, 0].min()) > float(world.memory.pose[:, 0].max()) + 900
    ahead = state
    for _ in range(4):
        ahead = world.imagine(ahead, torch.tensor([[0, 0, 0, 0, 1, 0]] * 2, dtype=torch.int8), make_rng(0))
    assert not ahead["done"].any()
    alone, seen = world.without_memory(), world.render(ahead, ("known",))["known"]
    again = alone.observe({"rgb": noise}, None, make_rng(0))
    for _ in range(4):
        again = alone.imagine(again, torch.tensor([[0, 0, 0, 0, 1, 0]] * 2, dtype=torch.int8), make_rng(0))
    assert torch.equal(alone.render(again, ("known",))["known"], seen), "the recordings do not mix in"
    with pytest.raises(ObservationError, match="uint8"):
        world.observe({"rgb": noise.float()}, None, make_rng(0))


def test_a_picture_seen_on_the_way_keeps_the_pose(sensing):
    world = load_world(sensing[0])
    state = world.start(1, make_rng(0))
    noise = torch.randint(0, 256, (1, 24, 32, 3), generator=make_rng(0), dtype=torch.uint8)
    seen = world.observe({"rgb": noise}, state, make_rng(0))
    assert torch.equal(seen["pose"], state["pose"]) and torch.equal(world.render(seen, ("rgb",))["rgb"], noise)


def test_dreams_are_those_of_the_seed_and_of_all_kinds(corridor, bare):
    world = load_world(bare)
    cache = ClipCache.open(Dataset(corridor), (24, 32))
    seen = Recording.of(cache, split(len(cache.episodes))[0], None)
    rollout = DreamSettings(horizon=3, batch=2)
    first, second = ([dream(world, seen, rollout, number) for number in range(3)] for _ in range(2))
    assert [ARMS[int(part.arm[0])] for part in first] == ["memory", "holes", "no memory"]
    for one, two in zip(first, second):
        assert torch.equal(one.error, two.error) and torch.equal(one.clues, two.clues)
        assert one.clues.shape == (6, INPUT_MAPS, 6, 8) and one.situation.shape == (6, SITUATION)
        assert (one.error > 0).all() and torch.allclose(one.cells.mean((1, 2)), one.error, atol=1e-5)
    assert first[2].episode.tolist() == [4, 5] * 3


@pytest.mark.slow
def test_a_stopped_training_of_an_uncertainty_goes_on_exactly(corridor, bare, sensing, tmp_path):
    resumes_exactly(
        lambda out: train_uncertainty(bare, corridor, out, SensesConfig(2, 60), quiet),
        sensing[0].parent, tmp_path, {"uncertainty": 1},
    )  # fmt: skip


@pytest.mark.slow
def test_a_world_without_geometry_is_given_an_uncertainty(flat_run):
    world = load_world(flat_run[0] / "world")
    assert "uncertainty" in world.spec.channels and world.spec.card["uncertainty"] == flat_run[1]["uncertainty"]


@pytest.mark.slow
def test_a_stopped_uncertainty_of_a_world_without_geometry_goes_on_exactly(corridor, flat_run, tmp_path):
    def train(out):
        train_uncertainty(flat_run[0] / "world", corridor, out, SensesConfig(2, 60), quiet)

    goes_on_exactly(train, tmp_path / "a", tmp_path / "b", {"uncertainty": 1})


def in_episodes(*lengths: int) -> Recording:
    """A recording of episodes of these lengths, without anything else in it."""
    start = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    cache = SimpleNamespace(action_valid=np.ones(len(start), bool), done=None)
    return Recording(cache, start, np.ones(len(start), bool))  # pyright: ignore


def test_the_horizon_of_rollouts_is_not_that_of_the_longest_episode_alone():
    horizon = lambda *lengths: uncertainty_module._horizon(in_episodes(*lengths), 9000)  # noqa: E731
    assert horizon(*[120] * 3) == 64 and horizon(40, 40) == 30
    assert horizon(*[30] * 20, 200) == 20, "else all would begin in the one long episode"
    assert horizon(5, 5, 40) == 30, "episodes that are too short for any do not count"
    assert horizon(17, 17) == 0, "too short for any"


def made_up(count: int, seed: int) -> DreamFrames:
    """Frames whose error is told by one number of their situation, and noise."""
    rng = make_rng(seed)
    level = torch.rand(count, generator=rng)
    situation = torch.zeros(count, SITUATION)
    situation[:, 0] = level
    error = (0.01 + 0.2 * level**2) * (0.7 + 0.6 * torch.rand(count, generator=rng))
    maps = torch.rand(count, INPUT_MAPS, 6, 8, generator=rng).half()
    arms = torch.where(level < 0.5, ARMS.index("memory"), ARMS.index("no memory"))
    return DreamFrames(maps, situation, error[:, None, None].expand(-1, 3, 4), error, torch.arange(count), arms)


def test_an_uncertainty_learns_the_error_to_expect(tmp_path):
    uncertainty = fit_uncertainty(Run(tmp_path, {}, quiet), made_up(600, 0), 150)
    calibrate(uncertainty, made_up(400, 1))
    others = made_up(400, 2)
    expected = expected_error(uncertainty, others)
    truth = 0.01 + 0.2 * others.situation[:, 0] ** 2
    assert float((expected - truth).abs().mean()) < 0.012
    assert float(uncertainty.sure) < float(uncertainty.invents)
    meant: Any = uncertainty.meant
    assert torch.equal(meant, meant.sort().values) and len(meant) == KNOTS


def test_calibration_never_turns_the_order(tmp_path):
    uncertainty = fit_uncertainty(Run(tmp_path, {}, quiet), made_up(64, 0), 2)
    calibrate(uncertainty, made_up(64, 1))
    answer = torch.linspace(0, 2, 500)
    meant = uncertainty.calibrated(answer)
    assert (meant.diff() >= 0).all() and 0 <= meant.min() and meant.max() <= 1
    assert uncertainty.calibrated(torch.tensor([torch.nan])).isnan().all(), "no index beyond the knots"


def test_neighbours_that_fall_are_pooled():
    assert pool_adjacent_violators([1.0, 3.0, 2.0, 4.0], [1, 1, 3, 1]) == pytest.approx([1.0, 2.25, 2.25, 4.0])
    assert pool_adjacent_violators([3.0, 2.0, 1.0], [1, 1, 1]) == pytest.approx([2.0, 2.0, 2.0])


@pytest.mark.exact
def test_a_finished_run_is_not_taught_again(corridor, posed_run, tmp_path, monkeypatch):
    def fail(*_):
        raise AssertionError("it was taught again")

    monkeypatch.setattr(video, "learn_senses", fail)
    monkeypatch.setattr(Trainer, "_step", fail)
    run = shutil.copytree(posed_run[0], tmp_path / "run")  # the shared one is only read
    facts = train_video(corridor, run, POSED, quiet)
    assert {**facts, "world": posed_run[1]["world"]} == posed_run[1] and load_world(
        run / "world"
    ).uncertainty is not None
