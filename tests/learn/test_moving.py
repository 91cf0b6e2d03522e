"""Learning from a recording that marks what moves: the world that comes of it keeps the contract and what it learned of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.corridor import DEPTH
from tests.learn.haunted import Peopled
from tests.learn.small import BARE
from tests.learn.stopping import quiet

from terrella.act import Explorer
from terrella.core import check_world, make_rng
from terrella.core.errors import DatasetError, ObservationError, TrainingError
from terrella.data import ClipCache, RecordOptions, record
from terrella.learn import moving_batches
from terrella.learn.moving_batches import mirrored, mirrored_buttons, moving_batch
from terrella.learn.recipes.parts import ObjectsTraining, train_objects
from terrella.learn.recipes.video import train_video
from terrella.learn.recipes.video_config import video_config
from terrella.learn.recording import THINGS, Recording, choose_keyframes
from terrella.learn.train_step import TrainStep
from terrella.worlds.body import follow_stairs
from terrella.worlds.config import VideoConfig
from terrella.worlds.folder import load_world, save_world
from terrella.worlds.objects import GOING, LOOK, NONE, NUMBER, RESTED, ROWS

pytestmark = pytest.mark.slow  # a sweep: `make test-all` runs it


def now(seed: int) -> TrainStep:
    return TrainStep(0, 0.0, torch.device("cpu"), np.random.default_rng(seed), make_rng(seed))


@pytest.fixture(scope="module")
def peopled(tmp_path_factory):
    """A world learned of the same, and its recording."""
    folder, world = tmp_path_factory.mktemp("peopled"), Peopled()
    record(world, Explorer(world.spec), folder / "set", 300, make_rng(0), options=RecordOptions(max_episode_steps=80))
    train_video(folder / "set", folder / "run", replace(BARE, objects_steps=20), quiet)
    return load_world(folder / "run" / "world"), folder


@pytest.fixture(scope="module")
def rows(haunted):
    cache = ClipCache.open(haunted, BARE.size)
    start = np.zeros(cache.length, np.int64)
    for first, last in cache.episodes:
        start[first:last] = first
    return Recording(cache, start, np.ones(cache.length, bool))


def test_a_world_learned_of_moving_things_keeps_the_contract(haunted, haunted_run):
    for memory in (True, False):
        world = load_world(haunted_run[0] / "world", memory=memory)
        assert (world.starts.depth == 0).any(), "what moves is in no keyframe"
        assert world.config.moving and {"things", "health", "reward", "done"} <= set(world.spec.channels)
        assert "observes" in check_world(world) and world.spec.may_observe == ("things", "health")
    state = world.start(2, make_rng(0))
    assert world.render(state, ("health",))["health"].tolist() == [100.0, 100.0]
    recording = Recording.open(haunted, BARE.size, quiet)
    assert [video_config(recording, replace(BARE, moving=moving)).moving for moving in (True, False)] == [True, False]


def test_a_world_whose_things_are_cards_keeps_the_contract(peopled, tmp_path):
    world, _ = peopled
    assert world.config.objects and world.objects is not None and world.spec.card["objects_looks"] >= 1
    assert "observes" in check_world(world) and world.spec.may_observe == ("things", "instances", "objects", "health")
    state = world.start(2, make_rng(0))
    assert (state["billboards"][:, 0, NUMBER] == 1).all() and (state["billboards"][:, 0, LOOK] != NONE).all()
    seen = world.render(state, ("objects", "instances", "things"))
    assert (seen["instances"] == 1).any((1, 2)).all() and (seen["things"] | (seen["instances"] == 0)).all()
    assert torch.equal(seen["objects"][:, 0], state["billboards"][:, 0, :4]) and (seen["instances"] <= 1).all()
    save_world(world, tmp_path / "again", dict(world.spec.card))
    again = load_world(tmp_path / "again")
    kept, read = world.objects.state_dict(), again.objects.state_dict()
    assert again.objects.config == world.objects.config and all(torch.equal(kept[name], read[name]) for name in kept)
    cards = [
        one.imagine(one.start(2, make_rng(1)), torch.zeros(2, 6), make_rng(1))["billboards"] for one in (world, again)
    ]
    assert torch.equal(*cards)
    bare = world.without_memory()
    assert bare.objects is world.objects


def test_a_world_takes_another_cast_and_keeps_the_rest(peopled, tmp_path):
    world, folder = peopled
    told = train_objects(folder / "run" / "world", folder / "set", tmp_path / "new", ObjectsTraining(5, seed=1), quiet)
    new = load_world(told["world"])
    assert torch.equal(new.memory.rgb, world.memory.rgb) and new.spec.may_observe == world.spec.may_observe
    assert torch.equal(new.generator.enter.weight, world.generator.enter.weight)
    assert not torch.equal(new.objects.goes.weight, world.objects.goes.weight) and told["objects_steps"] == 5
    assert torch.equal(new.objects.begun[..., NUMBER], world.objects.begun[..., NUMBER])


def test_a_world_without_things_and_a_recording_that_tells_none_apart_are_refused(peopled, haunted, bare_run, tmp_path):
    _, folder = peopled
    with pytest.raises(DatasetError, match="holds no observation.objects"):
        train_objects(folder / "run" / "world", haunted, tmp_path / "x", ObjectsTraining(5), quiet)
    with pytest.raises(TrainingError, match="knows no things"):
        train_objects(bare_run[0] / "world", folder / "set", tmp_path / "x", ObjectsTraining(5), quiet)


def test_evidence_of_cards_is_taken_and_bad_evidence_refused(peopled):
    world, rng = peopled[0], make_rng(0)
    state = world.start(1, rng)
    seen = world.render(state, ("rgb", "depth", "pose", "things", "instances", "objects"))
    told = seen["objects"].clone()
    told[0, 0, 0] = 77.0
    after = world.observe({**seen, "objects": told}, state, rng)
    assert after["billboards"][0, :, NUMBER].tolist()[:2] == [77.0, 1.0]  # the one not told of waits
    dreamt = world.imagine(state, torch.zeros(1, 6), rng)
    again = world.observe(seen, dreamt, rng)["billboards"][0, 0]  # a step after `state`, whatever was dreamt in between
    assert again[RESTED] == min(24, state["billboards"][0, 0, RESTED] + 1) and not again[GOING].any()
    stray = {**seen, "instances": torch.where(seen["instances"] == 0, 200, seen["instances"])}
    assert (world.observe(stray, state, rng)["instances"] <= 1).all()
    blank = world.observe({name: seen[name] for name in ("rgb", "depth", "pose")}, state, rng)
    assert not blank["billboards"].any() and not blank["instances"].any()
    for bad in (
        {"objects": told[:, :3]},
        {"objects": told[..., :3]},
        {"instances": seen["instances"][0]},
        {"instances": seen["instances"].float()},
        {"objects": told * torch.nan},
    ):
        with pytest.raises(ObservationError, match="objects is"):
            world.observe({**seen, **bad}, state, rng)


def test_a_batch_of_cards_hides_them_and_asks_nothing_of_what_they_cover(peopled, monkeypatch):
    world, folder = peopled
    cache = ClipCache.open(folder / "set", BARE.size)
    marks, told = (cache.arrays[f"observation.{name}"] for name in ("instances", "objects"))
    assert (
        marks.dtype == np.uint8
        and marks.shape[1:] == DEPTH
        and told.shape[1:] == (ROWS, 4)
        and (told[:, 0, 0] == 5).all()
    )
    start = np.zeros(cache.length, np.int64)
    rows = Recording(cache, start, np.ones(cache.length, bool))
    batch = moving_batch(rows, world.memory, world.config, 8, now(1), None)
    covered = batch.truth[:, 4] > 0.5  # nothing else moves here
    assert covered.any() and (batch.weight[:, 0][covered] == 0).all() and (batch.weight[:, 0][~covered] > 0).all()
    assert (batch.shown.last[:, 3][covered] == 0).float().mean() > 0.6 and not (batch.shown.last[:, 5] > 0.5).any()
    monkeypatch.setattr(moving_batches, "OFTEN", (0, 0, 0, 1))  # the same where the frames shown are dreamt
    dreamt = moving_batch(rows, world.memory, world.config, 8, now(1), lambda asked, now: 0 * asked.last[:, :5])
    assert (dreamt.shown.last[:, 3] > 0).float().mean() > 0.2
    assert (dreamt.shown.last[:, 3][dreamt.truth[:, 4] > 0.5] == 0).float().mean() > 0.6
    drawn = torch.zeros_like(batch.truth)
    judged = batch.judged(drawn)
    assert torch.equal(judged[:, :3].movedim(1, -1)[covered], batch.truth[:, :3].movedim(1, -1)[covered])
    assert (judged[:, :3].movedim(1, -1)[~covered] == 0).all()


def test_evidence_of_vitals_and_things_is_taken(haunted_run):
    world, rng = load_world(haunted_run[0] / "world"), make_rng(0)
    state = world.start(1, rng)
    seen = world.render(state, ("rgb", "depth", "pose"))
    things = torch.zeros(1, 24, 32, dtype=torch.bool)
    things[:, 3:6, 3:6] = True
    told = world.observe({**seen, "health": torch.tensor([42.0]), "things": things}, state, rng)
    assert float(world.render(told, ("health",))["health"]) == 42.0
    assert torch.equal(world.render(told, ("things",))["things"], things)


def test_a_batch_masks_memory_and_shows_the_thing_in_the_last_frame(rows):
    config = VideoConfig(tuple(rows.cache.world["camera"]), 6, BARE.size, moving=True)
    picks = choose_keyframes(np.asarray(rows.cache.pose), np.flatnonzero(rows.usable), 12)
    memory = rows.keyframes(picks, config.camera)
    assert (memory.depth == 0).float().mean() == pytest.approx(10 * 10 / (24 * 32), abs=0.005)  # the thing and its rim
    batch = moving_batch(rows, memory, config, 8, now(1), None)
    assert batch.shown.last.shape == (8, 10, 24, 32) and batch.truth.shape == (8, 5, 24, 32)
    truth = batch.truth[:, 4] > 0.5
    shown = batch.shown.last[:, 3].amax((1, 2)) > 0  # in some samples the last frame is unknown
    assert shown.any() and (batch.shown.last[shown, 5] > 0.5)[truth[shown]].float().mean() > 0.6
    assert batch.weight is not None and batch.weight[:, 0][truth].min() > batch.weight[:, 0][~truth].min()


def test_a_mirrored_batch_mirrored_again_is_itself(rows):
    config = VideoConfig(tuple(rows.cache.world["camera"]), 6, BARE.size, moving=True)
    memory = rows.keyframes(np.arange(4), config.camera)
    batch = moving_batch(rows, memory, config, 2, now(0), None)
    names = rows.cache.action_names
    once = mirrored(batch, names)
    again = mirrored(once, names)
    assert torch.equal(again.truth, batch.truth) and torch.equal(again.shown.context, batch.shown.context)
    assert not torch.equal(once.shown.context, batch.shown.context)


def test_the_other_side_of_a_button():
    names = ("MOVE_FORWARD", "MOVE_LEFT", "TURN_LEFT", "MOVE_RIGHT", "TURN_RIGHT", "ATTACK")
    assert mirrored_buttons(names) == [0, 3, 4, 1, 2, 5]
    assert THINGS == "observation.things"


def test_a_body_rises_with_the_recorded_ground_and_stays_where_it_stands():
    levels = torch.tensor([[0.0, 0, 1], [2.0, 0, 2]])  # a step up of a metre within two
    here, ahead, z = torch.tensor([[0.5, 0.0]]), torch.tensor([[0.8, 0.0]]), torch.tensor([1.4])
    assert follow_stairs(levels, here, here, z).item() == pytest.approx(1.4)
    assert 1.4 < follow_stairs(levels, ahead, ahead + 0.2, z).item() < 1.71
    assert follow_stairs(levels + 100, here, ahead, z).item() == pytest.approx(1.4), "none is near"
